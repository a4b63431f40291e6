"""Registration of checked frames with odometry, and its status for the operator."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.config import Settings
from sextant.services.perception.registration.acceptance import Acceptance
from sextant.services.perception.registration.camera_correction import CameraCorrection
from sextant.services.perception.registration.error_twist import covariance_at
from sextant.services.perception.registration.external_poses import ExternalPoses
from sextant.services.perception.registration.motion_prior import Motion
from sextant.services.perception.registration.observability import AXES, unobservable_directions
from sextant.services.perception.registration.plugin_registration import PluginRegistration
from sextant.services.perception.registration.projective_icp import Registration
from sextant.services.perception.registration.registration_result import RegistrationResult, refused_result
from sextant.shared.geometry import Array, inverse, rotation_from_rpy, transform, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import DepthImage

SILENT_S = 0.5  # [s] without odometry, after which directions that the scene does not constrain are unknown
_MAX_TILT_RAD = 1.0  # [rad] largest tilt of a body on its legs; a pose with more is wrong


class RegistrationMethod(Protocol):
    """Interface of a registration; `sextant.Registration` documents the arguments."""

    def update(
        self, depth_raw: NDArray[np.uint16], stamp_ns: int, T_world_camera_prior: Array, prior_covariance: Array
    ) -> RegistrationResult:
        """Register one frame."""
        ...


class FrameRegistration:
    """Registers the frames of a robot's camera with the motion of its body as prior."""

    def __init__(
        self, profile: RobotProfile, settings: Settings, correction: CameraCorrection, external: ExternalPoses | None = None
    ):
        """Start without a map; `external` gives the poses in place of a registration."""
        self._profile, self._settings, self._correction, self._external = profile, settings, correction, external
        self._method: RegistrationMethod = external or _make_method(profile, settings)

    def register(self, image: DepthImage, fault: str, motion: Motion, prior: Array, covariance: Array) -> RegistrationResult:
        """Register one frame.

        Args:
            image: The frame.
            fault: Why the frame is useless, or an empty string.
            motion: Motion of the body at the frame.
            prior: (4, 4) expected body pose {world}.
            covariance: (6, 6) [m, rad] of its error twist at the body.
        """
        T_camera = prior @ self._correction.T_body_camera
        covariance = covariance_at(covariance, T_camera[:3, 3] - prior[:3, 3])
        if fault:  # a frozen image would match its old pose and hold the estimate there
            return refused_result(image.stamp_ns, T_camera, covariance, None, fault)
        T_track, covariance_track = self._correction.in_track(T_camera, covariance)
        frame = image.depth, image.stamp_ns, T_track, covariance_track
        method = self._method
        found = method.update(*frame, image.gray) if isinstance(method, Registration) else method.update(*frame)
        found = self._correction.in_world(found)
        if motion.silence_s > SILENT_S and len(found.degenerate) and found.ok:
            return refused_result(image.stamp_ns, found.T_world_camera, found.covariance, None, _silent(motion))
        return found

    def T_world_body(self, found: RegistrationResult) -> Array:
        """Return the body pose (4, 4) of a result."""
        return np.asarray(found.T_world_camera @ inverse(self._correction.T_body_camera))

    def is_overturned(self, found: RegistrationResult, motion: Motion) -> bool:
        """Return whether the pose has the body on its side, but odometry upright."""
        carried = self._settings.legs and motion.reliable and motion.T_odom_body[2, 2] > np.cos(_MAX_TILT_RAD)
        upright = self.T_world_body(found)[2, 2] > np.cos(_MAX_TILT_RAD)
        return bool(carried and not upright)

    def restart(self, found: RegistrationResult, T: Array, motion: Motion, why: str) -> RegistrationResult:
        """Start a new map with the tilt and height of leg odometry; return the frame's result.

        Args:
            found: The result that is wrong.
            T: (4, 4) body pose {world} that gives place and heading.
            motion: Motion of the body at the frame.
            why: Reason of the restart, as text.
        """
        R = rotation_from_rpy([0.0, 0.0, yaw_of(T)])
        p = T[:3, 3] - R @ motion.T_odom_body[:3, 3]
        T_world_body = transform(R, [p[0], p[1], 0.0]) @ motion.T_odom_body
        if self._external is not None:
            self._external.restart()
        else:
            self._method = _make_method(self._profile, self._settings)
        reason = f"{why}: the registration restarts"
        return refused_result(
            found.stamp_ns, np.asarray(T_world_body @ self._correction.T_body_camera), found.covariance, None, reason
        )


def describe_registration(found: RegistrationResult) -> str:
    """Return the status of a registration for the operator."""
    if not found.ok:
        return f"leg odometry only: {found.reason}"
    unobservable = unobservable_directions(found.degenerate)
    if len(unobservable) == len(AXES):
        return "first frame: a new map starts"
    words = f"registering, overlap {found.overlap:.0%}"
    return f"{words}; {', '.join(unobservable)} unobservable (leg odometry only)" if unobservable else words


def _silent(motion: Motion) -> str:
    return (
        f"no odometry from the actuator for {motion.silence_s:.1f} s, and registration alone does not determine the whole pose"
    )


def _make_method(profile: RobotProfile, settings: Settings) -> RegistrationMethod:
    camera = profile.camera
    if settings.registration:
        return PluginRegistration(profile, settings.registration)
    if settings.method == "kiss-icp":
        try:  # a slow import, only if it is selected
            from sextant.services.perception.registration.kiss_icp_adapter import KissRegistration
        except ImportError as error:
            raise ValueError(
                f"the registration kiss-icp needs the library kiss-icp: {error}; pip install kiss-icp, with a Python below 3.14"
            ) from error
        return KissRegistration(camera.intrinsics, camera.sensor)
    return Registration(
        camera.intrinsics,
        camera.sensor,
        Acceptance.of(settings.acceptance, settings.legs),
        alignment=settings.alignment,
        keyframes=settings.keyframes,
        texture=settings.texture if camera.color else None,
        max_range=settings.registration_range,
        blocks_across=settings.blocks_across,
    )
