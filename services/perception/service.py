"""Perception service: estimate the body pose and reduce depth frames to scans."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.cameras.image_quality import EMPTY, is_noise, measured_share
from sextant.services.perception.config import Settings
from sextant.services.perception.preview import preview
from sextant.services.perception.rate_control import RateControl
from sextant.services.perception.reduction.free_space_rays import compute_free_rays
from sextant.services.perception.reduction.scan_color import Coloring
from sextant.services.perception.reduction.scan_reduction import reduce_scan
from sextant.services.perception.registration.motion_prior import Motion, OdometryHistory
from sextant.services.perception.registration.observability import AXES, unobservable_directions
from sextant.services.perception.registration.projective_icp import HAND_HELD, Registration, RegistrationResult, refused_result
from sextant.shared.geometry import (
    Array,
    inverse,
    orthonormal,
    rotation_from_rpy,
    rpy_from_rotation,
    to_millimetres,
    transform,
    yaw_of,
)
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import BodyPose, ColorImage, DepthImage, Message, Preview, Scan

_MOST_DOUBT_M, _MOST_DOUBT_RAD = 10.0, 3.0  # [m] [rad] upper bounds of the prior's sigma
_PREVIEW_NS = 180_000_000  # [ns] minimum time between two previews
_SAMPLED = 8  # [px] row and column spacing of the pixels compared to detect a frozen image
_EMPTY_EVERY = 3  # [scans] interval at which pixels without a return count as free rays, because these are less reliable
_MAX_BLIND_TRAVEL_M = 0.6  # [m] largest distance walked over mapped ground while nothing is in the camera's range
_SILENT_S = 0.5  # [s] without odometry, after which directions that the scene does not constrain are unknown
_MOVED = 0.01  # [m] or [rad] body motion after which two identical images show a frozen camera
_MOST_TILT = 1.0  # [rad] largest tilt of a body on its legs; a pose with more is wrong
_OUT_OF_ORDER_NS = 1_000_000_000  # [ns] a frame older than the newest by less than this is late; by more, the clock has changed
_MAX_FRAME_AGE_S = 0.3  # [s] largest age of a frame, because the planner does not use an older pose


class Perception:
    """Pose estimation from depth frames, with leg odometry as prior in the cost.

    {world} is {odom} of the first frame.
    """

    name = "perception"
    trigger: AnyTopic = topics.DEPTH
    subscribes: tuple[AnyTopic, ...] = (topics.ODOMETRY, topics.ACTUATOR_STATE, topics.COLOR, topics.SCAN_RECEIPT)
    publishes: tuple[AnyTopic, ...] = (topics.BODY_POSE, topics.SCAN, topics.PREVIEW)

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Start without a pose."""
        cv2.setNumThreads(1)  # the other services need the other cores, and one thread is deterministic
        self.max_age_s = {topics.DEPTH.key: _MAX_FRAME_AGE_S}
        self.stages = Stages()
        self._profile, self._settings = profile, settings
        self._camera = profile.camera
        self._T_body_camera = profile.camera.T_body_camera
        self._T_camera_body = inverse(self._T_body_camera)
        self._registration = _make_registration(profile, settings)
        self._coloring = (
            Coloring(profile.camera.intrinsics, profile.camera.sensor.depth_scale) if profile.camera.color else None
        )
        if self._coloring is None:  # colour images are about 1 MB each: subscribe only if they are used
            self.subscribes = tuple(topic for topic in self.subscribes if topic is not topics.COLOR)
        self._odometry = OdometryHistory()
        self._restarts = 0
        self._T_world_odom: Array = np.eye(4)
        self._T_world_body: Array = np.eye(4)
        self._last: Motion | None = None  # at the last registered frame
        self._tilt: Array = np.zeros(2)  # [rad] roll and pitch of {odom} in {world}, averaged
        self._stamp_ns = -1
        self._frames = 0
        self._preview_ns = 0  # [ns] when the next preview is due
        self._looks = 0  # number of scans sent, which selects their free rays
        self._newest_ns = -_OUT_OF_ORDER_NS  # stamp of the newest frame
        self._every = settings.frames_per_scan(profile.camera.sensor.rate_hz)
        self._picture: tuple[NDArray[np.uint16], int, Motion | None] | None = None  # pixel sample, first stamp, and motion then
        self._link = RateControl()
        self._words = "waiting for the first frame"

    def doing(self) -> str:
        """Return the status of the registration and of the link to the mapper."""
        allowed = self._link.budget
        if self._link.share == 1.0:
            return self._words
        carries = f"the link to the mapper carries {allowed.scans:.0%} of the scans, and {allowed.points:.0%} of their points"
        return f"{self._words}; {carries}"

    def step(self, image: DepthImage, inbox: Inbox) -> Iterator[Message]:
        """Register every n-th frame and publish its pose and scan.

        Leg odometry carries the pose between these frames.
        """
        for message in inbox.drain(topics.ODOMETRY):
            self._odometry.add(message)
        for receipt in inbox.drain(topics.SCAN_RECEIPT):
            self._link.record_receipt(receipt.stamp_ns, inbox.now_ns)
        self._link.check_overdue(inbox.now_ns)
        self._frames += 1
        used = self._frames % self._every == 0
        if self._coloring is not None and not used:
            self._keep_for_color(image)
        if not used:
            return
        before_ns = self._preview_ns - image.stamp_ns
        waits = 0 < before_ns <= _PREVIEW_NS + _OUT_OF_ORDER_NS  # an older stamp is from another clock
        if not waits and inbox.wanted(topics.PREVIEW) and image.depth.size:
            self._preview_ns = image.stamp_ns + _PREVIEW_NS
            yield self._preview(image, inbox)
        if 0 <= self._newest_ns - image.stamp_ns < _OUT_OF_ORDER_NS:  # an older stamp is from another clock
            self._words = "the camera's frames arrive out of order; late frames are skipped"
            return
        self._newest_ns = image.stamp_ns
        motion = self._odometry.at(image.stamp_ns)
        useless = self._has_wrong_size(image) or _is_noise(image) or self._is_frozen(image, motion)
        if motion is None:
            self._words = "waiting for odometry from the actuator"
            return
        if self._last is None and not self._odometry.settled(self._settings.settle_s):
            self._words = "waiting for the legs to stand still"
            return
        if self._last is None:
            legs = inbox.latest(topics.ACTUATOR_STATE)
            if legs is not None:  # the robot walked before perception started: keep its {world}
                self._T_world_odom = np.array(legs.T_world_odom)
        prior, covariance = self._prior(motion)
        T_camera = prior @ self._T_body_camera
        covariance = _seen_from(covariance, T_camera[:3, 3] - prior[:3, 3])
        with self.stages("registration"):
            if useless:  # a frozen image would match its old pose and hold the estimate there
                found = refused_result(image.stamp_ns, T_camera, covariance, None, useless)
            else:
                found = self._registration.update(image.depth, image.stamp_ns, T_camera, covariance)
                if motion.silence_s > _SILENT_S and len(found.degenerate) and found.ok:
                    found = refused_result(image.stamp_ns, found.T_world_camera, found.covariance, None, _silent(motion))
            if self._is_overturned(found, motion):
                found = self._restart_registration(found, motion)
        # The rotation from odometry may not be exactly orthonormal; the error must not accumulate over frames.
        self._T_world_body = orthonormal(found.T_world_camera @ self._T_camera_body)
        self._T_world_odom = orthonormal(self._T_world_body @ inverse(motion.T_odom_body))
        self._steady_tilt(image.stamp_ns)
        if found.ok:
            self._last = motion  # after a failed frame the prior's covariance keeps growing
        yield self._pose(found, motion)
        if useless or not (found.ok or self._sees_nothing_yet(image, motion)):
            return  # points at an unknown pose would corrupt the map; the map ages and the planner stops the robot
        if not self._link.should_send():
            return
        with self.stages("reduction"):
            scan = self._scan(image, found)
        self._link.sent(scan.stamp_ns, inbox.now_ns)
        if self._coloring is not None:
            self._coloring.keep(image.stamp_ns, image.depth, np.array(found.T_world_camera))
            scan = self._colored(scan, inbox.latest(topics.COLOR), self._coloring)
        yield scan

    def _is_overturned(self, found: RegistrationResult, motion: Motion) -> bool:
        """Return whether the pose has the body on its side, but odometry upright."""
        carried = self._settings.legs and motion.reliable and motion.T_odom_body[2, 2] > np.cos(_MOST_TILT)
        upright = (found.T_world_camera @ self._T_camera_body)[2, 2] > np.cos(_MOST_TILT)
        return bool(carried and not upright)

    def _restart_registration(self, found: RegistrationResult, motion: Motion) -> RegistrationResult:
        """Restart the registration with the tilt and height of leg odometry."""
        T = found.T_world_camera @ self._T_camera_body
        R = rotation_from_rpy([0.0, 0.0, yaw_of(T)])
        p = T[:3, 3] - R @ motion.T_odom_body[:3, 3]
        T_world_body = transform(R, [p[0], p[1], 0.0]) @ motion.T_odom_body
        self._registration = _make_registration(self._profile, self._settings)
        self._stamp_ns = -1  # restarts the tilt average of {odom}
        reason = "the pose shows the body on its side, but it stands on its legs: the registration restarts"
        return refused_result(found.stamp_ns, np.asarray(T_world_body @ self._T_body_camera), found.covariance, None, reason)

    def _preview(self, image: DepthImage, inbox: Inbox) -> Preview:
        with self.stages("preview"):
            picture = inbox.latest(topics.COLOR) if self._coloring is not None else None
            return preview(image.stamp_ns, image.depth, self._camera.sensor, None if picture is None else picture.rgb)

    def _keep_for_color(self, image: DepthImage) -> None:
        """Store an unregistered frame with its odometry pose.

        A colour image for it may arrive later.
        """
        motion = self._odometry.at(image.stamp_ns)
        if self._coloring is None or self._last is None or motion is None:
            return
        if image.depth.shape == (self._camera.intrinsics.height, self._camera.intrinsics.width):
            T_world_camera = self._T_world_odom @ motion.T_odom_body @ self._T_body_camera
            self._coloring.keep(image.stamp_ns, image.depth, np.asarray(T_world_camera))

    def _colored(self, scan: Scan, picture: ColorImage | None, coloring: Coloring) -> Scan:
        """Return the scan with the colours of the newest image, if that image is new."""
        if picture is None:
            return scan
        with self.stages("color"):
            color = coloring.colors(scan.points, picture.stamp_ns, picture.rgb)
        if coloring.problem:
            self._words += f"; {coloring.problem}"
        return replace(scan, color=color) if len(color) else scan

    def _sees_nothing_yet(self, image: DepthImage, motion: Motion) -> bool:
        """Return whether nothing is in the camera's range but odometry is reliable.

        This happens before a wall or a drop.

        `cameras.image_quality` limits how long this may last.
        """
        if self._last is None or motion.silence_s > _SILENT_S:
            return False
        empty = measured_share(image.depth, self._camera.sensor) < EMPTY
        return bool(empty and motion.travelled - self._last.travelled < _MAX_BLIND_TRAVEL_M)

    def _has_wrong_size(self, image: DepthImage) -> str:
        """Return why an image does not have the profile's size, or an empty string."""
        expected = (self._camera.intrinsics.height, self._camera.intrinsics.width)
        if image.depth.shape == expected:
            return ""
        return f"a frame of {expected} expected by the profile, found {image.depth.shape}: check the camera's intrinsics"

    def _is_frozen(self, image: DepthImage, motion: Motion | None) -> str:
        """Return why an image is frozen, or an empty string.

        A frozen image stays the same although the body has moved.
        """
        sample = image.depth[::_SAMPLED, ::_SAMPLED]
        if self._picture is None or not np.array_equal(sample, self._picture[0]):
            self._picture = (sample.copy(), image.stamp_ns, motion)
            return ""
        first, since_ns, before = self._picture
        if before is None:  # no odometry since the first of these images
            self._picture = (first, since_ns, motion)
        if motion is None or before is None or not sample.any():
            return ""
        if np.abs(motion.T_odom_body - before.T_odom_body).max() <= _MOVED:
            return ""
        return f"the camera has sent the same image for {(image.stamp_ns - since_ns) * 1e-9:.1f} s while the legs moved: frozen"

    def _prior(self, motion: Motion) -> tuple[Array, Array]:
        """Predict the body pose (4, 4) and its covariance (6, 6) [m, rad].

        Both follow from the odometry since the last registered frame.
        """
        settings = self._settings
        if self._restarts != self._odometry.restarts:
            # The odometry restarted at zero; the body is assumed unmoved until a frame is registered.
            self._restarts = self._odometry.restarts
            if self._last is not None:
                self._T_world_odom = self._T_world_body @ inverse(motion.T_odom_body)
                self._last = motion
                self._stamp_ns = -1  # restarts the tilt average, because {odom} is new
        last = self._last or motion
        way = settings.odometry_drift * max(0.0, motion.travelled - last.travelled) + settings.odometry_floor
        turn = settings.odometry_turn * max(0.0, motion.turned - last.turned) + settings.odometry_floor
        level = settings.odometry_level
        if not motion.reliable:
            way, turn = way + settings.unreliable_way, turn + settings.unreliable_turn
            level += settings.unreliable_level
        way, turn = min(way, _MOST_DOUBT_M), min(turn, _MOST_DOUBT_RAD)  # odometry reports both distances and may be wrong
        sigma = np.array([way, way, level, level, level, turn])
        return self._T_world_odom @ motion.T_odom_body, np.diag(sigma**2)

    def _steady_tilt(self, stamp_ns: int) -> None:
        """Average the tilt of {odom} over a few steps.

        Each tripod tilts the body slightly and differently, about 1 mm in the map. A correction measured on one tripod and
        applied to the other would accumulate; the average keeps only the common part.
        """
        tilt = rpy_from_rotation(self._T_world_odom[:3, :3])[:2]
        since_s = max(0, stamp_ns - self._stamp_ns) * 1e-9 if self._stamp_ns >= 0 else np.inf
        self._stamp_ns = stamp_ns
        self._tilt = self._tilt + (1.0 - np.exp(-since_s / self._settings.tilt_s)) * (tilt - self._tilt)

    def _correction(self, T_odom_body: Array) -> Array:
        """Return T_world_odom (4, 4) with the averaged tilt, exact at the body position."""
        R = rotation_from_rpy([*self._tilt, yaw_of(self._T_world_odom)])
        return transform(R, self._T_world_body[:3, 3] - R @ T_odom_body[:3, 3])

    def _pose(self, found: RegistrationResult, motion: Motion) -> BodyPose:
        self._words = describe_registration(found)
        return BodyPose(
            stamp_ns=found.stamp_ns,
            T_world_body=self._T_world_body,
            T_world_odom=self._correction(motion.T_odom_body),
            covariance=_seen_from(found.covariance, self._T_world_body[:3, 3] - found.T_world_camera[:3, 3]),
            overlap=float(found.overlap),
            ok=found.ok,
            reason=found.reason,
            degenerate=_twists_from(found.degenerate, self._T_world_body[:3, 3] - found.T_world_camera[:3, 3]),
        )

    def _scan(self, image: DepthImage, found: RegistrationResult) -> Scan:
        settings = self._settings
        reduced = reduce_scan(
            image.depth,
            self._camera.intrinsics,
            self._camera.sensor,
            found.T_world_camera,
            resolution=settings.scan_resolution,
            max_range=settings.scan_range,
            max_points=max(1, round(self._link.budget.points * settings.scan_points)),
            ceiling=settings.scan_ceiling,
        )
        return Scan(
            stamp_ns=image.stamp_ns,
            origin=reduced.origin,
            points_mm=reduced.points,
            count=reduced.count,
            spread_mm=reduced.spread,
            p_world_camera=np.array(found.T_world_camera[:3, 3]),
            pose_covariance=np.asarray(found.covariance, dtype=np.float64),
            sights_mm=self._sights(image, found, reduced.origin),
        )

    def _sights(self, image: DepthImage, found: RegistrationResult, origin: Array) -> NDArray[np.int16]:
        """Return free rays of an image that end beyond the scan, [mm] from its origin."""
        self._looks += 1
        points = compute_free_rays(
            image.depth,
            self._camera.intrinsics,
            self._camera.sensor,
            found.T_world_camera,
            max_range=self._settings.scan_range,
            turn=self._looks,
            # An image without any return may come from a covered camera.
            believe_empty=found.ok and self._looks % _EMPTY_EVERY == 0,
        )
        return to_millimetres(points, origin)


def _carried(r: Array) -> Array:
    """Return J (6, 6) that moves an error twist by r (3,) [m] {world}: v + w x r."""
    J = np.eye(6)
    J[:3, 3:] = [[0.0, r[2], -r[1]], [-r[2], 0.0, r[0]], [r[1], -r[0], 0.0]]
    return J


def _seen_from(covariance: Array, r: Array) -> Array:
    """Return the covariance (6, 6) [m, rad] at a point r (3,) [m] {world} away."""
    J = _carried(r)
    return np.asarray(J @ covariance @ J.T, dtype=np.float64)


def _twists_from(twists: Array, r: Array) -> Array:
    """Return the unit twists (k, 6) at a point r (3,) [m] {world} away."""
    moved = twists @ _carried(r).T
    return np.asarray(moved / np.maximum(np.linalg.norm(moved, axis=1, keepdims=True), 1e-12), dtype=np.float64)


def _is_noise(image: DepthImage) -> str:
    """Return that the image is noise, or an empty string."""
    return "the camera sends noise: neighbouring pixels are unrelated" if is_noise(image.depth) else ""


def _silent(motion: Motion) -> str:
    return (
        f"no odometry from the actuator for {motion.silence_s:.1f} s, and registration alone does not determine the whole pose"
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


class RegistrationMethod(Protocol):
    """Interface of a registration; `sextant.Registration` documents the arguments."""

    def update(
        self, depth_raw: NDArray[np.uint16], stamp_ns: int, T_world_camera_prior: Array, prior_covariance: Array
    ) -> RegistrationResult:
        """Register one frame."""
        ...


def _make_registration(profile: RobotProfile, settings: Settings) -> RegistrationMethod:
    camera = profile.camera
    if settings.method == "kiss-icp":
        from sextant.services.perception.registration.kiss_icp_adapter import (
            KissRegistration,  # slow import, only if selected
        )

        return KissRegistration(camera.intrinsics, camera.sensor)
    return Registration(
        camera.intrinsics,
        camera.sensor,
        None if settings.legs else HAND_HELD,
        max_range=settings.registration_range,
        blocks_across=settings.blocks_across,
    )
