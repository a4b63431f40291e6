"""Poses from another localization: their checks, and the pose of a depth frame by the newest good one."""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.error_twist import covariance_at
from sextant.services.perception.registration.motion_prior import Motion, OdometryHistory
from sextant.services.perception.registration.params import ExternalPoseParams
from sextant.services.perception.registration.registration_result import RegistrationResult, refused_result
from sextant.shared.geometry import Array, interpolate, inverse, log_so3, transform
from sextant.shared.wire.messages import ExternalPose

_AHEAD_NS = 100_000_000  # [ns] by which a stamp may be ahead of the robot's clock
_LEAST_SIGMA = 0.002  # [m] and [rad] a smaller uncertainty is not believed
_RESTART = "restart perception to fix its frame again"


class ExternalPoses:
    """Registration by poses from another localization.

    The frame of these poses is fixed in {world} by the first one. Each pose is compared with the place to which the legs have
    carried the earlier ones. The legs also carry it to the time of a depth frame.
    """

    def __init__(self, T_body_camera: Array, odometry: OdometryHistory, params: ExternalPoseParams):
        """Start without a pose; `odometry` is kept up to date by the caller."""
        self._T_body_camera, self._odometry, self._params = T_body_camera, odometry, params
        self.problem = ""  # why the newest pose was refused, or an empty string
        self._newest_ns = -1  # newest stamp so far, except of those in the future
        self._stamp_ns, self._arrived_ns = -1, -1  # stamp of the last pose, good or not, and when it arrived
        self._odometry_restarts = odometry.restarts
        self.restart()

    def restart(self) -> None:
        """Forget all poses: the next one fixes its frame in {world} again."""
        self._T_world_frame: Array | None = None
        self._frame = ""
        self._good: tuple[int, Array, Array] | None = None  # stamp, T_frame_odom and sigmas (2,) of the newest good pose
        self._T_frame_odom: Array = np.eye(4)  # to which a pose is compared
        self._T_frame_body: Array = np.eye(4)  # body pose by it at the last pose
        self._compared: tuple[int, Motion] | None = None  # stamp and motion at the last good pose

    def add(self, pose: ExternalPose, now_ns: int) -> None:
        """Check a pose received by `now_ns` [ns], and keep it if it is good; the same pose may come again."""
        if pose.stamp_ns == self._stamp_ns:
            return
        motion = self._odometry.motion_at(pose.stamp_ns)
        self.problem = self._fault(pose, motion, now_ns)
        self._stamp_ns, self._arrived_ns = pose.stamp_ns, now_ns
        if pose.stamp_ns <= now_ns + _AHEAD_NS:
            self._newest_ns = max(self._newest_ns, pose.stamp_ns)
        if self.problem or motion is None:
            return
        T_frame_odom = self._smoothed(pose, motion) @ inverse(motion.T_odom_body)
        sigmas = np.array([pose.position_sigma or self._params.sigma, pose.rotation_sigma or self._params.sigma_angle])
        self._follow(pose, motion)
        self._frame, self._good = pose.frame, (pose.stamp_ns, T_frame_odom, np.maximum(sigmas, _LEAST_SIGMA))

    def update(
        self,
        depth_raw: NDArray[np.uint16],
        stamp_ns: int,
        T_world_camera_prior: NDArray[np.float64],
        prior_covariance: NDArray[np.float64],
    ) -> RegistrationResult:
        """Return the pose of a frame; arguments, result and errors as in `Registration.update`."""
        motion = self._odometry.motion_at(stamp_ns)
        why = self._no_pose(stamp_ns)
        if why or self._good is None or motion is None:
            return refused_result(stamp_ns, T_world_camera_prior, prior_covariance, None, why or "no leg odometry")
        _, T_frame_odom, sigmas = self._good
        T_odom_camera = motion.T_odom_body @ self._T_body_camera
        if self._T_world_frame is None:
            self._T_world_frame = T_world_camera_prior @ inverse(T_frame_odom @ T_odom_camera)
        T_world_odom = self._T_world_frame @ T_frame_odom
        tilt = math.acos(min(max(float(T_world_odom[2, 2]), -1.0), 1.0))
        if tilt > self._params.max_tilt:
            self.problem = (
                f"it tilts the body by {math.degrees(tilt):.0f} deg against its legs, "
                f"{math.degrees(self._params.max_tilt):.0f} deg allowed; {_RESTART}"
            )
            return refused_result(stamp_ns, T_world_camera_prior, prior_covariance, None, self._refusal())
        T_world_camera = T_world_odom @ T_odom_camera
        body = np.diag(np.repeat(sigmas**2, 3))
        covariance = covariance_at(body, T_world_camera[:3, 3] - (T_world_odom @ motion.T_odom_body)[:3, 3])
        return RegistrationResult(stamp_ns, T_world_camera, covariance, 1.0, math.nan, np.zeros((0, 6)), True, "")

    def describe(self, found: RegistrationResult) -> str:
        """Return the status of a frame's pose for the operator."""
        if not found.ok or self._good is None:
            return f"leg odometry only: {found.reason}"
        words = f"pose from elsewhere in {self._frame!r}, {(found.stamp_ns - self._good[0]) * 1e-9:.2f} s old"
        return f"{words}; {self._refusal()}" if self.problem else words

    def _fault(self, pose: ExternalPose, motion: Motion | None, now_ns: int) -> str:
        """Return why a pose is not used, or an empty string."""
        age_s = (now_ns - pose.stamp_ns) * 1e-9
        if pose.stamp_ns > now_ns + _AHEAD_NS:
            return f"its stamp is {-age_s:.1f} s in the future; it must be of the robot's clock"
        if age_s > self._params.max_age_s:
            return f"it is {age_s:.1f} s old by its stamp, at most {self._params.max_age_s:g} s allowed"
        if self._newest_ns > pose.stamp_ns:
            return f"its stamps do not rise: one is {(self._newest_ns - pose.stamp_ns) * 1e-9:.2f} s older than an earlier one"
        if self._T_world_frame is not None and pose.frame != self._frame:
            return f"the frame {self._frame!r} expected, found {pose.frame!r}; {_RESTART}"
        sigma = max(pose.position_sigma, pose.rotation_sigma)
        if min(pose.position_sigma, pose.rotation_sigma) < 0.0 or sigma > self._params.max_sigma:
            return (
                f"standard deviations of 0 to {self._params.max_sigma:g} m and rad expected, "
                f"found {pose.position_sigma:g} m and {pose.rotation_sigma:g} rad"
            )
        if motion is None:
            return "there is no leg odometry of its time"
        return self._jump(pose, motion)

    def _jump(self, pose: ExternalPose, motion: Motion) -> str:
        """Return how a pose deviates from the motion of the legs by more than is allowed, or an empty string."""
        if self._odometry.restarts != self._odometry_restarts:  # {odom} is new; the body is assumed unmoved
            self._odometry_restarts = self._odometry.restarts
            self._T_frame_odom = self._T_frame_body @ inverse(motion.T_odom_body)
            self._good = None
            self._compared = None if self._compared is None else (pose.stamp_ns, motion)
        if self._compared is None:
            return ""
        before = self._compared[1]
        limits = np.array([self._params.jump, self._params.jump_angle]) + self._params.drift_share * np.array(
            [max(0.0, motion.travelled - before.travelled), max(0.0, motion.turned - before.turned)]
        )
        found = _distances(self._T_frame_odom @ motion.T_odom_body, pose.T_frame_body)
        if (found <= limits).all():
            return ""
        return (
            f"it jumps: {found[0]:.2f} m and {math.degrees(found[1]):.0f} deg from where the legs have carried the body, "
            f"at most {limits[0]:.2f} m and {math.degrees(limits[1]):.0f} deg allowed; {_RESTART}"
        )

    def _follow(self, pose: ExternalPose, motion: Motion) -> None:
        """Move the pose to which others are compared towards a good one, at a limited rate."""
        shares = np.ones(2)  # of position and rotation
        if self._compared is not None:
            stamp_ns, before = self._compared
            moved = np.array([motion.travelled - before.travelled, motion.turned - before.turned])
            since_s = (pose.stamp_ns - stamp_ns) * 1e-9
            allowed = self._params.drift_rate * max(0.0, since_s) + self._params.drift_share * np.maximum(moved, 0.0)
            off = _distances(self._T_frame_odom @ motion.T_odom_body, pose.T_frame_body)
            shares = np.minimum(1.0, allowed / np.maximum(off, 1e-9))
        legs = self._T_frame_odom @ motion.T_odom_body
        place, heading = (interpolate(legs, pose.T_frame_body, float(share)) for share in shares)
        self._T_frame_body = transform(heading[:3, :3], place[:3, 3])
        self._T_frame_odom = self._T_frame_body @ inverse(motion.T_odom_body)
        self._compared = pose.stamp_ns, motion

    def _smoothed(self, pose: ExternalPose, motion: Motion) -> Array:
        """Return the mean (4, 4) of a good pose and of those before, which the legs carry here."""
        if self._good is None:
            return pose.T_frame_body
        share = 1.0 - math.exp(-(pose.stamp_ns - self._good[0]) * 1e-9 / self._params.smooth_s)
        return interpolate(self._good[1] @ motion.T_odom_body, pose.T_frame_body, share)

    def _no_pose(self, stamp_ns: int) -> str:
        """Return why there is no good pose for a frame, or an empty string."""
        if self._good is not None and stamp_ns - self._good[0] <= self._params.max_age_s * 1e9:
            return ""
        if self._arrived_ns < 0:
            return "no pose from elsewhere yet; start its source, which publishes external/pose"
        silent_s = (stamp_ns - self._arrived_ns) * 1e-9
        if self.problem and silent_s <= self._params.max_age_s:
            return self._refusal()
        return f"no pose from elsewhere for {silent_s:.1f} s; check that its source runs"

    def _refusal(self) -> str:
        return f"the pose from elsewhere is refused: {self.problem}"


def _distances(T0: Array, T1: Array) -> Array:
    """Return the distance [m] and the angle [rad] between two poses."""
    return np.array([np.linalg.norm(T1[:3, 3] - T0[:3, 3]), np.linalg.norm(log_so3(T0[:3, :3].T @ T1[:3, :3]))])
