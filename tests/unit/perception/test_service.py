"""Perception service on frames of a synthetic world."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.perception.calibration.floor_view import block_centres
from sextant.services.perception.config import Settings
from sextant.services.perception.service import Perception
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, is_rigid, rotation_from_rpy, yaw_of
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.robot.kinematics import body_inverse, leg_points
from sextant.shared.robot.profile import GRAVITY, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic, Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose, DepthImage, FloorView, Imu, Message, Odometry, Preview, Scan
from tests.support.states import actuator_state

MS = 1_000_000
FRAME = 33 * MS
HEIGHT = 0.10
SCAN_BYTES = 60_000
PHANTOM = load_profile("phantomx_mk2")
SMALL = Intrinsics(320, 240, 292.5, 292.5, 159.5, 119.5)
PROFILE = replace(PHANTOM, camera=replace(PHANTOM.camera, intrinsics=SMALL))


def body_at(x: float, y: float = 0.0, yaw: float = 0.0) -> Array:
    return from_xyz_rpy((x, y, HEIGHT), (0.0, 0.0, yaw))


EVERY_FRAME = Settings(scan_rate_hz=PROFILE.camera.sensor.rate_hz)


class Rig:
    """Perception, and a robot at given poses with given odometry and pictures."""

    def __init__(
        self,
        world,
        scene: str = "pillars",
        settings: Settings | None = None,
        profile: RobotProfile = PROFILE,
        settle_s: float = 0.0,
    ):  # type: ignore[no-untyped-def]
        self.world, self.boxes, self.profile = world, world.scenes[scene], profile
        # Most tests begin at once. The wait for a standing robot has a separate test.
        self.perception = Perception(profile, replace(settings or EVERY_FRAME, settle_s=settle_s))
        self.inbox = Inbox(
            [self.perception.trigger, *self.perception.subscribes], self.perception.stages, lambda topic: topic in self.wanted
        )
        self.wanted: set[AnyTopic] = set()
        self.now_ns = 1_000 * MS
        self.T_odom_start: Array = np.eye(4)  # {odom} in the test's {world}
        self.travelled = 0.0

    def picture(self, T_world_body: Array) -> NDArray[np.uint16]:
        camera = self.profile.camera
        image: NDArray[np.uint16] = self.world.depth_image(
            T_world_body @ camera.T_body_camera, self.boxes, intrinsics=camera.intrinsics, sensor=camera.sensor
        )
        return image

    def odometry(self, T_odom_body: Array, reliable: bool = True) -> None:
        message = Odometry(self.now_ns, T_odom_body, self.travelled, 0.0, np.ones(6, dtype=bool), reliable)
        self.inbox.receive(topics.ODOMETRY, codec.encode(message), self.now_ns)

    def frame(self, T: Array, odometry: Array | None = None, depth: NDArray[np.uint16] | None = None) -> list[Message]:
        """Process a frame at a true pose; without `odometry`, the odometry is correct."""
        self.now_ns += FRAME
        self.inbox.now_ns = self.now_ns
        self.travelled += 0.005
        self.odometry(inverse(self.T_odom_start) @ T if odometry is None else odometry)
        return self.see(T, depth)

    def see(self, T: Array, depth: NDArray[np.uint16] | None = None) -> list[Message]:
        image = DepthImage(self.now_ns, self.picture(T) if depth is None else depth)
        return list(self.perception.step(image, self.inbox))


def pose_of(messages: list[Message]) -> BodyPose:
    return next(m for m in messages if isinstance(m, BodyPose))


def test_world_of_a_robot_on_a_slope_is_level_by_its_inertial_sensor(world) -> None:  # type: ignore[no-untyped-def]
    rig, slope = Rig(world), rotation_from_rpy((0.0, np.radians(-8.0), 0.0))  # the feet's plane in a level {world}

    def feel(count: int) -> None:
        for _ in range(count):
            rig.now_ns += 10 * MS
            reading = Imu(rig.now_ns, np.zeros(3), GRAVITY * slope[2])
            rig.inbox.receive(topics.IMU, codec.encode(reading), rig.now_ns)

    feel(3)
    assert rig.frame(body_at(0.0)) == []
    assert rig.perception.status() == "waiting for the inertial sensor, which has begun to send"
    feel(40)
    first = pose_of(rig.frame(body_at(0.0))).T_world_body
    np.testing.assert_allclose(first[:3, :3], slope, atol=np.radians(0.3))
    feel(3)
    ahead = pose_of(rig.frame(body_at(0.02))).T_world_body[:3, 3] - first[:3, 3]
    np.testing.assert_allclose(ahead, 0.02 * slope[:, 0], atol=0.004)


def test_perception_waits_for_odometry_and_reports_it(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    assert rig.see(body_at(0.0)) == []
    assert "waiting for odometry" in rig.perception.status()
    assert rig.frame(body_at(0.0))


def test_world_frame_equals_odometry_frame_of_first_image(world) -> None:  # type: ignore[no-untyped-def]
    pose = pose_of(Rig(world).frame(body_at(0.2)))
    np.testing.assert_allclose(pose.T_world_body, body_at(0.2), atol=1e-9)
    np.testing.assert_allclose(pose.T_world_odom, np.eye(4), atol=1e-9)


def test_world_frame_is_set_only_once_robot_stands_still(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world, settle_s=0.3)
    first = -1
    for k in range(30):  # the robot sinks for 0.3 s, then stands
        made = rig.frame(body_at(0.0), from_xyz_rpy((0.0, 0.0, 0.1 - 0.001 * min(k, 9)), np.zeros(3)))
        if made:
            first = k
            break
        assert "stand still" in rig.perception.status()
    assert 0.2 < (first - 9) * FRAME * 1e-9 <= 0.34


def test_odometry_restart_before_first_frame_has_no_effect(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.travelled = 0.4
    rig.odometry(body_at(0.9))
    rig.now_ns += 20 * MS
    rig.travelled = 0.0
    rig.odometry(body_at(0.0))
    rig.now_ns += 20 * MS
    rig.perception.step(DepthImage(rig.now_ns, rig.picture(body_at(0.0))), rig.inbox)
    pose = pose_of(rig.frame(body_at(0.0)))
    np.testing.assert_allclose(pose.T_world_body, body_at(0.0), atol=1e-9)


def test_true_motion_is_tracked_with_odometry_prior(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    for k in range(8):
        truth = body_at(0.01 * k, 0.002 * k, 0.004 * k)
        messages = rig.frame(truth, body_at(0.0097 * k, 0.002 * k, 0.0041 * k))
        pose = pose_of(messages)
        assert pose.ok
        assert pose.reason == ""
        np.testing.assert_allclose(pose.T_world_body[:3, 3], truth[:3, 3], atol=4e-3)
        carried = pose.T_world_odom @ body_at(0.0097 * k, 0.002 * k, 0.0041 * k)
        np.testing.assert_allclose(carried[:3, 3], pose.T_world_body[:3, 3], atol=1e-9)  # tilt is smoothed
        assert yaw_of(carried) == pytest.approx(yaw_of(pose.T_world_body), abs=1e-4)
        assert np.linalg.eigvalsh(pose.covariance)[0] > 0
    assert "overlap" in rig.perception.status()


def test_pose_belongs_to_exposure_of_late_stamped_image(world) -> None:  # type: ignore[no-untyped-def]
    late = replace(PROFILE, camera=replace(PROFILE.camera, time_offset_s=2 * FRAME * 1e-9))
    rig = Rig(world, "flat", profile=late)
    for k in range(8):
        seen = body_at(0.02 * max(k - 2, 0))
        messages = rig.frame(seen, body_at(0.02 * k))
        if k < 2:
            continue  # exposed before the first odometry
        pose = pose_of(messages)
        assert pose.stamp_ns == rig.now_ns - 2 * FRAME
        np.testing.assert_allclose(pose.T_world_body[:3, 3], seen[:3, 3], atol=1e-3)


def test_unobservable_directions_on_level_ground_are_reported(world) -> None:  # type: ignore[no-untyped-def]
    poses = []
    for scene in ("flat", "pillars"):
        rig = Rig(world, scene)
        rig.frame(body_at(0.0))
        poses.append(pose_of(rig.frame(body_at(0.01))))
        assert ("x, y, yaw unobservable" in rig.perception.status()) is (scene == "flat")
    level, rough = poses
    assert level.degenerate.shape == (3, 6)
    assert np.abs(level.degenerate[:, [2, 3, 4]]).max() < 0.2  # height, roll and pitch are observed
    assert rough.degenerate.shape == (0, 6)


def test_odometry_restart_keeps_body_pose(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    for k in range(4):
        before = pose_of(rig.frame(body_at(0.01 * k)))
    rig.travelled = -0.005  # the actuator restarted: odometry begins at zero
    elsewhere = from_xyz_rpy((-0.7, 0.3, HEIGHT), (0.0, 0.0, 1.0))
    after = pose_of(rig.frame(body_at(0.03), elsewhere))
    np.testing.assert_allclose(after.T_world_body, before.T_world_body, atol=3e-3)
    np.testing.assert_allclose((after.T_world_odom @ elsewhere)[:3, 3], after.T_world_body[:3, 3], atol=1e-9)
    moved = elsewhere @ inverse(body_at(0.0)) @ body_at(0.01)
    assert pose_of(rig.frame(body_at(0.04), moved)).T_world_body[0, 3] == pytest.approx(0.04, abs=4e-3)


def test_tipped_pose_is_discarded_when_legs_report_upright_body(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.frame(body_at(0.0))
    blank = np.zeros_like(rig.picture(body_at(0.0)))
    for roll in np.linspace(0.0, 1.5, 9):  # as legs may report while the camera sees nothing
        lying = pose_of(rig.frame(body_at(0.0), from_xyz_rpy((0.0, 0.0, HEIGHT), (roll, 0.0, 0.0)), blank))
    assert lying.T_world_body[2, 2] < 0.1
    rig.travelled = -0.005  # odometry restarts, so the body keeps its pose
    given_up = pose_of(rig.frame(body_at(0.0)))
    assert not given_up.ok
    assert "the body on its side, but it stands on its legs" in given_up.reason
    after = pose_of(rig.frame(body_at(0.0)))
    assert after.ok
    assert after.T_world_body[2, 2] > 0.999
    assert after.T_world_body[2, 3] == pytest.approx(HEIGHT, abs=0.01)


def test_nearly_rigid_odometry_gives_rigid_poses(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    for k in range(12):
        scaled = body_at(0.001 * k)
        scaled[:3, :3] *= 1.0 + 4e-5  # the largest deviation from a rotation that a frame may have
        pose = pose_of(rig.frame(body_at(0.001 * k), scaled, np.zeros_like(rig.picture(body_at(0.0))) if k else None))
        codec.decode(codec.encode(pose), BodyPose)
    assert is_rigid(pose.T_world_body, 1e-9)


def test_frame_of_wrong_size_is_reported_and_skipped(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.frame(body_at(0.0))
    (pose,) = rig.frame(body_at(0.0), depth=np.zeros((120, 160), dtype=np.uint16))
    assert isinstance(pose, BodyPose)
    assert not pose.ok
    assert "(240, 320) expected" in pose.reason
    assert "(240, 320) expected" in rig.perception.status()
    assert "found (120, 160)" in rig.perception.status()
    assert pose_of(rig.frame(body_at(0.005))).ok


def test_empty_frame_falls_back_to_odometry_with_reason(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.frame(body_at(0.0))
    pose = pose_of(rig.frame(body_at(0.02), depth=np.zeros((240, 320), dtype=np.uint16)))
    assert not pose.ok
    assert pose.reason
    assert "odometry only" in rig.perception.status()
    np.testing.assert_allclose(pose.T_world_body, body_at(0.02), atol=1e-9)


def test_covariance_grows_on_odometry_alone(world) -> None:  # type: ignore[no-untyped-def]
    rig, dark = Rig(world), np.zeros((240, 320), dtype=np.uint16)
    rig.frame(body_at(0.0))
    spreads = [pose_of(rig.frame(body_at(0.01 * k), depth=dark)).covariance[0, 0] for k in range(1, 6)]
    assert (np.diff(spreads) > 0).all()


@pytest.mark.parametrize("travelled", [1e3, 1e12, -1e12])
def test_frame_is_registered_after_any_travelled_distance(world, travelled: float) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.frame(body_at(0.0))
    rig.travelled += travelled
    pose = pose_of(rig.frame(body_at(0.01)))
    assert pose.ok
    np.testing.assert_allclose(pose.T_world_body[:3, 3], body_at(0.01)[:3, 3], atol=0.02)


def test_blind_camera_sends_no_free_space_rays(world) -> None:  # type: ignore[no-untyped-def]
    rig, dark = Rig(world, "flat"), np.zeros((240, 320), dtype=np.uint16)
    for _ in range(5):
        rig.frame(body_at(0.0))
    scans = [m for _ in range(30) for m in rig.frame(body_at(0.0), depth=dark) if isinstance(m, Scan)]
    assert len(scans) > 20
    assert all(len(scan.free_rays_mm) == 0 for scan in scans)


@pytest.mark.slow
def test_missing_odometry_is_a_fault_only_on_unobservable_ground(world) -> None:  # type: ignore[no-untyped-def]
    for scene, told in (("flat", False), ("pillars", True)):
        rig = Rig(world, scene)
        for _ in range(5):
            rig.frame(body_at(0.0))
        made: list[Message] = []
        for _ in range(30):
            rig.now_ns += FRAME
            rig.inbox.now_ns = rig.now_ns
            made = rig.see(body_at(0.0))
        assert pose_of(made).ok is told
        assert any(isinstance(m, Scan) for m in made) is told
        if not told:
            assert "no odometry from the actuator for" in pose_of(made).reason
            assert "no odometry" in rig.perception.status()


def test_image_frozen_before_first_odometry_is_reported(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    frozen = rig.picture(body_at(0.0))
    for _ in range(3):
        rig.now_ns += FRAME
        rig.inbox.now_ns = rig.now_ns
        assert rig.see(body_at(0.0), frozen) == []
    poses = [pose_of(rig.frame(body_at(0.005 * k), depth=frozen)) for k in range(20)]
    assert not poses[-1].ok
    assert "frozen" in poses[-1].reason


def test_unreliable_odometry_has_larger_covariance(world) -> None:  # type: ignore[no-untyped-def]
    dark, spreads = np.zeros((240, 320), dtype=np.uint16), []
    for reliable in (True, False):
        rig = Rig(world)
        rig.frame(body_at(0.0))
        rig.now_ns += FRAME
        rig.odometry(body_at(0.0), reliable)
        spreads.append(np.diag(pose_of(rig.see(body_at(0.0), dark)).covariance))
    assert (spreads[1] > spreads[0]).all()


@pytest.mark.parametrize("every", [1, 3])
def test_scan_is_published_every_n_frames(world, every: int) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world, settings=Settings(scan_rate_hz=PROFILE.camera.sensor.rate_hz / every))
    scans = [any(isinstance(m, Scan) for m in rig.frame(body_at(0.0))) for _ in range(7)]
    assert scans == [(k + 1) % every == 0 for k in range(7)]


@pytest.mark.parametrize("scene", ["flat", "steps", "pillars"])
def test_scan_of_full_frame_is_at_most_60_kb(world, scene: str) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world, scene, profile=PHANTOM)
    scan = next(m for m in rig.frame(body_at(0.0)) if isinstance(m, Scan))
    assert len(scan.points_mm) > 1000
    assert len(codec.encode(scan)) <= SCAN_BYTES


def test_scan_of_max_points_on_roughest_ground_is_at_most_60_kb() -> None:
    n, rng = Settings().scan_points, np.random.default_rng(0)
    row, column = np.divmod(np.arange(n), 150)
    points = np.column_stack([10 * row, 10 * column, np.zeros(n)]) + rng.integers(0, [10, 10, 150], (n, 3))
    count, spread = rng.integers(1, 60, n), rng.integers(0, 60, n)
    scan = Scan(
        0, np.zeros(3), points.astype(np.int16), count.astype(np.uint8), spread.astype(np.uint8), np.zeros(3), np.zeros((6, 6))
    )
    assert len(codec.encode(scan)) <= SCAN_BYTES


def test_scan_lies_on_ground_and_has_covariance_of_camera_pose(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world, "flat", Settings(scan_rate_hz=PROFILE.camera.sensor.rate_hz))
    messages = rig.frame(body_at(0.0))
    scan, pose = next(m for m in messages if isinstance(m, Scan)), pose_of(messages)
    heights = scan.origin[2] + 1e-3 * scan.points_mm[:, 2]
    assert np.abs(np.median(heights)) < 2e-3
    assert scan.stamp_ns == pose.stamp_ns == rig.now_ns
    # The scan's covariance is the camera's, the pose's is the body's. A rotation of one moves the other.
    rng = np.random.default_rng(0)
    twists = rng.multivariate_normal(np.zeros(6), scan.pose_covariance, 200_000)
    r = pose.T_world_body[:3, 3] - scan.p_world_camera
    twists[:, :3] += np.cross(twists[:, 3:], r)
    np.testing.assert_allclose(np.cov(twists.T), pose.covariance, atol=0.02 * np.abs(pose.covariance).max())
    np.testing.assert_allclose(scan.p_world_camera, (pose.T_world_body @ PROFILE.camera.T_body_camera)[:3, 3], atol=1e-9)


@pytest.mark.parametrize("raw", [0, 100])  # no return, and nearer than the range
def test_scans_of_blind_camera_stop_after_a_while(world, raw: int) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.frame(body_at(0.0))
    scans = []
    for k in range(1, 20):
        rig.travelled += 0.05
        messages = rig.frame(body_at(0.05 * k), depth=np.full((240, 320), raw + k % 2 * (raw > 0), dtype=np.uint16))
        assert not pose_of(messages).ok
        scans.append(any(isinstance(m, Scan) for m in messages))
    assert scans == sorted(scans, reverse=True)
    assert 9 <= sum(scans) <= 12


@pytest.mark.parametrize("moving", [True, False])
def test_frozen_image_is_reported_once_legs_have_moved(world, moving: bool) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    for k in range(3):
        rig.frame(body_at(0.01 * k))
    stuck = rig.picture(body_at(0.02))
    for k in range(1, 6):
        messages = rig.frame(body_at(0.02 + 0.005 * k * moving), depth=stuck)
    pose = pose_of(messages)
    assert pose.ok is not moving
    assert ("frozen" in pose.reason) is moving
    assert any(isinstance(m, Scan) for m in messages) is not moving
    np.testing.assert_allclose(pose.T_world_body[:3, 3], body_at(0.02 + 0.025 * moving)[:3, 3], atol=12e-3)  # from the legs
    assert pose_of(rig.frame(body_at(0.05))).ok  # and it recovers with the next new picture


@pytest.mark.parametrize(
    ("name", "bad"),
    [("odometry_floor", 0.0), ("odometry_drift", np.nan), ("tilt_s", 0.0), ("scan_range", 40.0), ("settle_s", 2.0)],
)
def test_invalid_settings_are_refused(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match=f"{name}: .* expected, found .*{bad:g}"):
        Settings(**{name: bad})


@pytest.mark.slow
def test_preview_is_published_at_5_hz_only_with_subscribers(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    made = [m for _ in range(30) for m in rig.frame(body_at(0.0)) if isinstance(m, Preview)]
    assert made == []
    rig.wanted = {topics.PREVIEW}
    stamps = [m.stamp_ns for _ in range(30) for m in rig.frame(body_at(0.0)) if isinstance(m, Preview)]
    assert 5 <= len(stamps) <= 6
    assert all(not isinstance(m, Preview) for _ in range(12) for m in rig.frame(body_at(0.0))[:-1]), "it delays no scan"
    assert min(np.diff(stamps)) >= 180 * MS
    (picture,) = [m for _ in range(6) for m in rig.frame(body_at(0.0)) if isinstance(m, Preview)][:1]
    shown = cv2.imdecode(picture.depth_jpeg, cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape == (240, 320, 3)
    assert picture.color_jpeg.size == 0
    depth = rig.picture(body_at(0.0))
    depth = depth[:: depth.shape[0] // 240, :: depth.shape[1] // 320]
    assert shown[depth == 0].mean() < 40.0, "what is not known is dark"
    near, far = depth[depth > 0].min(), depth.max()
    blue, red = shown[..., 0].astype(int), shown[..., 2].astype(int)
    assert (red - blue)[(depth > 0) & (depth < near + (far - near) / 6)].mean() > 60.0, "near is red"


def test_previews_continue_after_camera_clock_reset(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    rig.wanted = {topics.PREVIEW}
    rig.now_ns = 1_000_000 * MS
    assert any(isinstance(m, Preview) for _ in range(6) for m in rig.frame(body_at(0.0)))
    rig.now_ns = 0
    assert any(isinstance(m, Preview) for _ in range(6) for m in rig.frame(body_at(0.0)))


def test_floor_is_published_at_10_hz_only_with_subscribers(world) -> None:  # type: ignore[no-untyped-def]
    rig = Rig(world)
    state = actuator_state(PROFILE, feet=PROFILE.rest_feet())
    rig.inbox.receive(topics.ACTUATOR_STATE, codec.encode(state), rig.now_ns)
    assert not [m for _ in range(4) for m in rig.frame(body_at(0.0)) if isinstance(m, FloorView)]
    rig.wanted = {topics.FLOOR}
    made = [rig.frame(body_at(0.0)) for _ in range(30)]
    views = [m for messages in made for m in messages if isinstance(m, FloorView)]
    assert 9 <= len(views) <= 11
    assert all(not isinstance(m, FloorView) for messages in made for m in messages[:-1]), "it delays no scan"
    assert {len(view.inverse_depth) for view in views} == {len(block_centres(SMALL)[0])}
    assert np.isfinite(views[0].inverse_depth).any()


def test_leg_before_the_camera_is_not_in_the_scan(world) -> None:  # type: ignore[no-untyped-def]
    sensor = replace(PROFILE.camera.sensor, min_range=0.1)
    camera, feet = replace(PROFILE.camera, sensor=sensor, mount_xyz=(0.0, 0.0, 0.2)), PROFILE.rest_feet()
    feet[0] = [0.235, 0.085, -0.03]  # lifted high and ahead
    q = body_inverse(PROFILE, feet)
    rig = Rig(world, profile=replace(PROFILE, camera=camera))
    p_knee, p_foot = apply(inverse(camera.T_body_camera), leg_points(PROFILE, q)[0, 2:])
    point = p_knee + 0.4 * (p_foot - p_knee)
    u, v = (round(f * point[k] / point[2] + c) for k, f, c in ((0, SMALL.fx, SMALL.cx), (1, SMALL.fy, SMALL.cy)))
    assert 8 <= u < SMALL.width - 8
    assert 8 <= v < SMALL.height - 8
    picture = rig.picture(body_at(0.0))
    picture[v - 6 : v + 7, u - 6 : u + 7] = round(point[2] * 1000)  # the shank

    def nearest(with_legs: bool) -> float:
        if with_legs:
            state = actuator_state(PROFILE, q=q)
            rig.inbox.receive(topics.ACTUATOR_STATE, codec.encode(state), rig.now_ns + FRAME)
        (scan,) = (m for m in rig.frame(body_at(0.0), depth=picture) if isinstance(m, Scan))
        p_world = np.append(point, 1.0) @ (body_at(0.0) @ camera.T_body_camera).T
        return float(np.linalg.norm(scan.points - p_world[:3], axis=1).min())

    assert nearest(with_legs=False) < 0.02
    assert nearest(with_legs=True) > 0.02
