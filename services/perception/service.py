"""Perception service: estimate the body pose and reduce depth frames to scans."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from sextant.services.perception.calibration.floor_view import expected_floor, floor_view
from sextant.services.perception.calibration.online_calibration import OnlineCalibration
from sextant.services.perception.cameras.image_quality import EMPTY, measured_share
from sextant.services.perception.config import Settings
from sextant.services.perception.own_legs import without_legs
from sextant.services.perception.preview import preview
from sextant.services.perception.rate_control import RateControl
from sextant.services.perception.rectification import Rectifier
from sextant.services.perception.reduction.scan_color import Coloring
from sextant.services.perception.reduction.scan_reducer import ScanReducer
from sextant.services.perception.registration.error_twist import covariance_at, unit_twists_at
from sextant.services.perception.registration.external_poses import ExternalPoses
from sextant.services.perception.registration.frame_check import OUT_OF_ORDER_NS, FrameCheck
from sextant.services.perception.registration.frame_registration import SILENT_S, FrameRegistration, describe_registration
from sextant.services.perception.registration.motion_prior import Motion, OdometryHistory
from sextant.services.perception.registration.pose_tracking import PoseTracker
from sextant.services.perception.registration.registration_result import RegistrationResult
from sextant.services.perception.registration.rest_gravity import RestGravity
from sextant.shared.geometry import apply, inverse
from sextant.shared.robot.kinematics import leg_points
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import BodyPose, ColorImage, DepthImage, FloorView, Message, Preview, Scan

_PREVIEW_NS = 180_000_000  # [ns] minimum time between two previews
_FLOOR_NS = 90_000_000  # [ns] minimum time between two views of the floor
_MAX_BLIND_TRAVEL_M = 0.6  # [m] largest distance walked over mapped ground while nothing is in the camera's range
_CLOCK_S = 0.2  # [s] age up to which the newest odometry gives the robot's clock
_MAX_FRAME_AGE_S = 0.3  # [s] largest age of a frame, because the planner does not use an older pose


class Perception:
    """Pose estimation from depth frames, with leg odometry as prior in the cost.

    {world} is {odom} of the first frame, made level by an inertial sensor if there is one.
    """

    name = "perception"
    trigger: AnyTopic = topics.DEPTH
    subscribes: tuple[AnyTopic, ...] = (
        *(topics.ODOMETRY, topics.ACTUATOR_STATE, topics.IMU, topics.COLOR, topics.SCAN_RECEIPT),
        topics.EXTERNAL_POSE,
    )
    publishes: tuple[AnyTopic, ...] = (topics.BODY_POSE, topics.CAMERA_ERRORS, topics.FLOOR, topics.SCAN, topics.PREVIEW)

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Start without a pose."""
        cv2.setNumThreads(1)  # the other services need the other cores, and one thread is deterministic
        self.max_age_s = {topics.DEPTH.key: _MAX_FRAME_AGE_S}
        self.stages = Stages()
        intrinsics = profile.camera.intrinsics
        self._profile = profile
        self._time_offset_ns = round(profile.camera.time_offset_s * 1e9)
        self._rectify = Rectifier(intrinsics, profile.camera.distortion)
        self._rectify_gray = Rectifier(intrinsics.gray, profile.camera.distortion)
        profile = replace(profile, camera=profile.camera.rectified)
        self._settings, self._camera = settings, profile.camera
        self._odometry = OdometryHistory()
        self._gravity = RestGravity()
        self._check = FrameCheck((intrinsics.height, intrinsics.width))
        self._tracker = PoseTracker(settings)
        external = settings.method == "external"
        self._external = ExternalPoses(profile.camera.T_body_camera, self._odometry, settings.external) if external else None
        self._calibration = OnlineCalibration(profile, settings.correct_camera)
        self._calibrates = settings.legs and not external
        self._correction = self._calibration.correction
        self._registration = FrameRegistration(profile, settings, self._correction, self._external)
        self._reducer = ScanReducer(profile.camera, settings, self._correction)
        self._coloring = Coloring(intrinsics, profile.camera.sensor.depth_scale) if profile.camera.color else None
        # Colour images are about 1 MB each: subscribe only if they are used.
        used = {topics.COLOR: self._coloring is not None, topics.EXTERNAL_POSE: external}
        self.subscribes = tuple(topic for topic in self.subscribes if used.get(topic, True))
        self._link = RateControl()
        self._frames = 0
        self._every = settings.frames_per_scan(profile.camera.sensor.rate_hz)
        self._preview_due, self._floor_due = _Pace(_PREVIEW_NS), _Pace(_FLOOR_NS)
        self._words = "waiting for the first frame"

    def status(self) -> str:
        """Return the status of the registration and of the link to the mapper."""
        allowed, words = self._link.budget, self._words
        if finding := self._calibration.finding:
            words = f"{words}; {finding}"
        if self._link.share == 1.0:
            return words
        carries = f"the link to the mapper carries {allowed.scans:.0%} of the scans, and {allowed.points:.0%} of their points"
        return f"{words}; {carries}"

    def step(self, image: DepthImage, inbox: Inbox) -> Iterator[Message]:
        """Register every n-th frame and publish its pose and scan; then publish a preview and the floor in the frame.

        Leg odometry carries the pose between the registered frames.
        """
        yield from self._frame(image, inbox)
        yield from self._floor(image, inbox)

    def _frame(self, image: DepthImage, inbox: Inbox) -> Iterator[Message]:
        for message in inbox.drain(topics.ODOMETRY):
            self._odometry.add(message)
        for reading in inbox.drain(topics.IMU):
            self._gravity.add(reading)
        if self._external is not None and (found := inbox.latest(topics.EXTERNAL_POSE)) is not None:
            self._external.add(found, inbox.now_ns)
        for receipt in inbox.drain(topics.SCAN_RECEIPT):
            self._link.record_receipt(receipt.stamp_ns, inbox.now_ns)
            self._calibration.compare(receipt.leg_heights)
        self._link.check_overdue(inbox.now_ns)
        self._frames += 1
        if self._time_offset_ns:
            image = replace(image, stamp_ns=self._exposed_ns(image))
        if self._frames % self._every:
            if self._coloring is not None:
                self._keep_for_color(self._rectified(image), self._coloring)
            return
        image = self._rectified(image)
        yield from self._pose_and_scan(image, inbox)
        yield from self._preview(image, inbox)

    def _rectified(self, image: DepthImage) -> DepthImage:
        """Return an image without distortion."""
        depth = self._rectify.depth(image.depth)
        return image if depth is image.depth else replace(image, depth=depth, gray=self._rectify_gray.picture(image.gray))

    def _exposed_ns(self, image: DepthImage | ColorImage) -> int:
        """Return the time [ns] at which an image was exposed."""
        return max(0, image.stamp_ns - self._time_offset_ns)

    def _pose_and_scan(self, image: DepthImage, inbox: Inbox) -> Iterator[Message]:
        """Register a frame, and yield its pose and its scan."""
        newest_ns = self._odometry.newest_ns
        clock_ns = newest_ns if inbox.fresh(topics.ODOMETRY, _CLOCK_S) is not None else None
        wrong = self._check.stamp_fault(image.stamp_ns, clock_ns)
        if wrong and newest_ns is not None:
            image = replace(image, stamp_ns=newest_ns)  # the pose is that of odometry
        elif self._check.is_late(image.stamp_ns):
            self._words = "the camera's frames arrive out of order; late frames are skipped"
            return
        motion = self._odometry.motion_at(image.stamp_ns)
        fault = wrong or self._check.fault(image, motion) or self._tracker.distrusted(image.stamp_ns)
        if motion is None:
            self._words = "waiting for odometry from the actuator"
            return
        if self._tracker.last_registered is None and not self._odometry.settled(self._settings.settle_s):
            self._words = "waiting for the legs to stand still"
            return
        if self._tracker.last_registered is None and self._gravity.begins:
            self._words = "waiting for the inertial sensor, which has begun to send"
            return
        if not fault:
            image = self._without_legs(image, inbox)
        found = self._register(image, fault, motion, inbox)
        yield self._pose(found, motion)
        if (errors := self._calibration.news(image.stamp_ns)) is not None:
            yield errors
        # Points at an unknown pose would corrupt the map; without scans the map ages and the planner stops the robot.
        if not fault and (found.ok or self._sees_nothing_yet(image, motion)) and self._link.should_send():
            yield self._scan(image, found, inbox)

    def _without_legs(self, image: DepthImage, inbox: Inbox) -> DepthImage:
        """Return an image without the robot's own legs, if their joints are known."""
        legs = inbox.fresh(topics.ACTUATOR_STATE)
        if legs is None or not self._check.has_expected_size(image):
            return image
        with self.stages("legs"):
            points = apply(inverse(self._correction.T_body_camera), leg_points(self._profile, legs.q).reshape(-1, 3))
            camera = self._camera
            depth, removed = without_legs(image.depth, points.reshape(6, 4, 3), camera.intrinsics, camera.sensor)
        return replace(image, depth=depth) if removed else image

    def _register(self, image: DepthImage, fault: str, motion: Motion, inbox: Inbox) -> RegistrationResult:
        """Register a frame and track its pose."""
        tracker = self._tracker
        if tracker.last_registered is None:
            legs = inbox.latest(
                topics.ACTUATOR_STATE
            )  # of a robot that walked before perception started, which keeps its {world}
            tracker.begin(np.eye(4) if legs is None else legs.T_world_odom, motion, self._gravity.up())
        prior, covariance = tracker.predict(motion, self._odometry.restarts)
        with self.stages("registration"):
            found = self._registration.register(image, fault, motion, prior, covariance)
            T_world_body = self._registration.T_world_body(found)
            if self._registration.is_overturned(found, motion):
                self._calibration.restart()
                why = "the pose shows the body on its side, but it stands on its legs"
                found = self._registration.restart(found, T_world_body, motion, why)
                tracker.restart_tilt()
            elif self._settings.legs and found.ok and motion.reliable:
                why = tracker.contradiction(image.stamp_ns, T_world_body, motion)
                if why:
                    self._calibration.restart()
                    tracker.distrust(image.stamp_ns, why)
                    found = self._registration.restart(found, tracker.T_world_odom @ motion.T_odom_body, motion, why)
        T_world_body = self._registration.T_world_body(found)
        tracker.correct(image.stamp_ns, T_world_body, motion, found.ok)
        if self._calibrates:
            self._calibration.add(found, prior, covariance, T_world_body, motion, self._odometry.restarts)
        return found

    def _pose(self, found: RegistrationResult, motion: Motion) -> BodyPose:
        self._words = describe_registration(found) if self._external is None else self._external.describe(found)
        T_world_body = self._tracker.T_world_body
        from_camera = T_world_body[:3, 3] - found.T_world_camera[:3, 3]
        return BodyPose(
            stamp_ns=found.stamp_ns,
            T_world_body=T_world_body,
            T_world_odom=self._tracker.steady_T_world_odom(motion.T_odom_body),
            covariance=covariance_at(found.covariance, from_camera),
            overlap=float(found.overlap),
            ok=found.ok,
            reason=found.reason,
            degenerate=unit_twists_at(found.degenerate, from_camera),
        )

    def _sees_nothing_yet(self, image: DepthImage, motion: Motion) -> bool:
        """Return whether nothing is in the camera's range but odometry is reliable.

        This happens before a wall or a drop.

        `cameras.image_quality` limits how long this may last.
        """
        registered = self._tracker.last_registered
        if registered is None or motion.silence_s > SILENT_S:
            return False
        empty = measured_share(image.depth, self._camera.sensor) < EMPTY
        return bool(empty and motion.travelled - registered.travelled < _MAX_BLIND_TRAVEL_M)

    def _scan(self, image: DepthImage, found: RegistrationResult, inbox: Inbox) -> Scan:
        with self.stages("reduction"):
            scan = self._reducer.reduce(image, found, self._link.budget.points)
        self._link.sent(scan.stamp_ns, inbox.now_ns)
        if self._coloring is None:
            return scan
        self._coloring.keep(image.stamp_ns, image.depth, np.array(found.T_world_camera))
        return self._colored(scan, inbox.latest(topics.COLOR), self._coloring)

    def _colored(self, scan: Scan, picture: ColorImage | None, coloring: Coloring) -> Scan:
        """Return the scan with the colours of the newest image, if that image is new."""
        if picture is None:
            return scan
        with self.stages("color"):
            color = coloring.colors(scan.points, self._exposed_ns(picture), self._rectify.picture(picture.rgb))
        if coloring.problem:
            self._words += f"; {coloring.problem}"
        return replace(scan, color=color) if len(color) else scan

    def _keep_for_color(self, image: DepthImage, coloring: Coloring) -> None:
        """Store an unregistered frame with its odometry pose.

        A colour image for it may arrive later.
        """
        if self._tracker.last_registered is None or not self._check.has_expected_size(image):
            return
        motion = self._odometry.motion_at(image.stamp_ns)
        if motion is not None:
            T_world_camera = self._tracker.T_world_odom @ motion.T_odom_body @ self._correction.T_body_camera
            coloring.keep(image.stamp_ns, image.depth, np.asarray(T_world_camera))

    def _preview(self, image: DepthImage, inbox: Inbox) -> Iterator[Preview]:
        """Yield a small picture of the frame if one is due and wanted."""
        if not (inbox.wanted(topics.PREVIEW) and image.depth.size and self._preview_due(image.stamp_ns)):
            return
        with self.stages("preview"):
            picture = inbox.latest(topics.COLOR) if self._coloring is not None else None
            made = preview(image.stamp_ns, image.depth, self._camera.sensor, None if picture is None else picture.rgb)
        yield made

    def _floor(self, image: DepthImage, inbox: Inbox) -> Iterator[FloorView]:
        """Yield the floor in an unrectified frame if it is due and wanted."""
        if not inbox.wanted(topics.FLOOR) or (legs := inbox.latest(topics.ACTUATOR_STATE)) is None:
            return
        if self._floor_due(image.stamp_ns):
            with self.stages("floor"):
                camera = self._profile.camera
                soles = legs.feet - [0.0, 0.0, self._profile.foot.radius]
                found = floor_view(image.stamp_ns, image.depth, camera, expected_floor(camera, soles))
            yield found


class _Pace:
    """Tells when a message that is made at most once per period is due."""

    def __init__(self, period_ns: int):
        self._period_ns, self._due_ns = period_ns, 0

    def __call__(self, stamp_ns: int) -> bool:
        """Return whether it is due at this stamp [ns]; an older stamp than the last one is from another clock."""
        if 0 < self._due_ns - stamp_ns <= self._period_ns + OUT_OF_ORDER_NS:
            return False
        self._due_ns = stamp_ns + self._period_ns
        return True
