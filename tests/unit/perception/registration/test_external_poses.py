"""Poses from another localization: accepted while they agree with the legs, refused with the reason otherwise."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from sextant.services.perception.registration.external_poses import ExternalPoses
from sextant.services.perception.registration.motion_prior import OdometryHistory
from sextant.services.perception.registration.params import ExternalPoseParams
from sextant.services.perception.registration.registration_result import RegistrationResult
from sextant.shared.geometry import Array, exp_se3, from_xyz_rpy, inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import ExternalPose, Odometry

MS, S = 1_000_000, 1_000_000_000
CAMERA = load_profile("phantomx_mk2").camera
T_FRAME_WORLD = from_xyz_rpy((7.0, -2.0, 0.4), (0.02, -0.01, 2.5))
COVARIANCE = np.eye(6) * 1e-4
DEPTH = np.zeros((2, 2), np.uint16)


def body_at(x: float, yaw: float = 0.0) -> Array:
    return from_xyz_rpy((x, 0.0, 0.11), (0.0, 0.0, yaw))


@dataclass
class Rig:
    """A robot that walks, its legs, and a source of poses."""

    params: ExternalPoseParams = field(default_factory=ExternalPoseParams)
    now_ns: int = 10 * S
    x: float = 0.0
    leg_share: float = 1.0  # of the distance that the legs measure
    T_world_odom: Array = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        self.odometry = OdometryHistory()
        self.poses = ExternalPoses(CAMERA.T_body_camera, self.odometry, self.params)
        self.legs()

    def legs(self) -> None:
        self.odometry.add(
            Odometry(self.now_ns, body_at(self.leg_share * self.x), abs(self.x), 0.0, np.ones(6, dtype=np.bool_), True)
        )

    def go(self, seconds: float = 0.02, speed: float = 0.0) -> None:
        for _ in range(round(seconds / 0.02)):
            self.now_ns += 20 * MS
            self.x += 0.02 * speed
            self.legs()

    def claim(self, shift: Array | None = None, **changes: object) -> ExternalPose:
        T = T_FRAME_WORLD @ body_at(self.x)
        made = ExternalPose(self.now_ns, "slam", T if shift is None else T @ shift)
        return replace(made, **changes)  # type: ignore[arg-type]

    def hear(self, shift: Array | None = None, **changes: object) -> str:
        self.poses.add(self.claim(shift, **changes), self.now_ns)
        return self.poses.problem

    def see(self) -> RegistrationResult:
        """Use the newest pose for a frame of now."""
        legs = self.odometry.motion_at(self.now_ns)
        assert legs is not None
        prior = self.T_world_odom @ legs.T_odom_body @ CAMERA.T_body_camera
        found = self.poses.update(DEPTH, self.now_ns, prior, COVARIANCE)
        if found.ok:
            self.T_world_odom = self.body(found) @ inverse(legs.T_odom_body)
        return found

    def body(self, found: RegistrationResult) -> Array:
        return np.asarray(found.T_world_camera @ inverse(CAMERA.T_body_camera))


def test_first_pose_fixes_the_frame_where_the_legs_are() -> None:
    rig = Rig()
    found = rig.see()
    assert not found.ok
    assert "no pose from elsewhere yet" in found.reason
    rig.go()
    assert not rig.hear()
    found = rig.see()
    assert found.ok
    np.testing.assert_allclose(rig.body(found), body_at(0.0), atol=1e-9)
    assert not len(found.degenerate), "the pose gives all directions"
    assert "'slam'" in rig.poses.describe(found)


def test_pose_follows_the_source_and_not_the_legs_that_slip() -> None:
    rig = Rig(leg_share=1.05)
    for _ in range(300):
        rig.go(0.04, speed=0.1)
        assert not rig.hear()
        found = rig.see()
    assert rig.x == pytest.approx(1.2)
    np.testing.assert_allclose(rig.body(found)[:3, 3], body_at(rig.x)[:3, 3], atol=2e-3)


def test_legs_carry_a_late_pose_to_the_time_of_the_frame() -> None:
    rig = Rig()
    rig.hear()
    rig.see()
    late = []
    for _ in range(100):
        rig.go(0.04, speed=0.1)
        late.append(rig.claim())
        if len(late) > 4:
            rig.poses.add(late.pop(0), rig.now_ns)
            assert not rig.poses.problem
            found = rig.see()
    np.testing.assert_allclose(rig.body(found)[:3, 3], body_at(rig.x)[:3, 3], atol=1e-6)


def test_noise_is_reduced() -> None:
    rig, rng = Rig(), np.random.default_rng(0)
    off = []
    for _ in range(200):
        rig.go(0.04)
        rig.hear(exp_se3(rng.normal(0.0, 0.005, 6)))
        off.append(rig.body(rig.see())[:3, 3] - body_at(0.0)[:3, 3])
    assert np.std(np.array(off)[10:], axis=0).max() < 0.003


def test_stopped_source_is_reported_and_used_again_when_it_returns() -> None:
    rig = Rig()
    rig.hear()
    assert rig.see().ok
    rig.go(0.4)
    assert rig.see().ok, "the legs bridge a short time"
    rig.go(0.4)
    found = rig.see()
    assert not found.ok
    assert found.reason == "no pose from elsewhere for 0.8 s; check that its source runs"
    assert found.reason in rig.poses.describe(found)
    rig.go(5.0, speed=0.02)
    assert not rig.hear()
    assert rig.see().ok


@pytest.mark.parametrize(
    ("shift", "words"),
    [
        (from_xyz_rpy((0.2, 0.0, 0.0), np.zeros(3)), "it jumps: 0.20 m and 0 deg"),
        (from_xyz_rpy((0.0, 0.0, -0.15), np.zeros(3)), "it jumps: 0.15 m"),
        (from_xyz_rpy(np.zeros(3), (0.0, 0.0, 0.3)), "it jumps: 0.00 m and 17 deg"),
        (inverse(T_FRAME_WORLD), "it jumps"),
    ],
)
def test_jump_is_refused_until_the_source_is_back(shift: Array, words: str) -> None:
    rig = Rig()
    rig.hear()
    rig.see()
    for _ in range(20):
        rig.go(0.04)
        assert words in rig.hear(shift)
    found = rig.see()
    assert not found.ok
    assert words in found.reason
    assert "restart perception" in found.reason
    rig.go()
    assert not rig.hear()
    assert rig.see().ok


def test_single_outlier_does_not_interrupt() -> None:
    rig = Rig()
    for k in range(50):
        rig.go(0.04)
        rig.hear(from_xyz_rpy((0.5, 0.0, 0.0), np.zeros(3)) if k % 5 == 4 else None)
        found = rig.see()
        assert found.ok
        np.testing.assert_allclose(rig.body(found), body_at(0.0), atol=1e-9)


def test_source_that_creeps_away_from_a_standing_robot_is_refused() -> None:
    rig = Rig()
    for k in range(200):
        rig.go(0.04)
        if rig.hear(from_xyz_rpy((0.002 * k, 0.0, 0.0), np.zeros(3))):  # 5 cm/s
            break
    assert "it jumps" in rig.poses.problem
    assert rig.now_ns < 13.5 * S


def test_new_odometry_frame_keeps_the_body_where_it_is() -> None:
    rig = Rig()
    rig.hear()
    rig.go(2.0, speed=0.1)
    rig.hear()
    rig.see()
    rig.go()
    rig.odometry.add(Odometry(rig.now_ns + MS, body_at(0.0), 0.0, 0.0, np.ones(6, dtype=np.bool_), True))
    assert rig.odometry.restarts == 1
    rig.poses.add(ExternalPose(rig.now_ns + MS, "slam", T_FRAME_WORLD @ body_at(rig.x)), rig.now_ns + MS)
    assert not rig.poses.problem
    found = rig.poses.update(DEPTH, rig.now_ns + MS, np.eye(4), COVARIANCE)
    np.testing.assert_allclose(rig.body(found), body_at(rig.x), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"stamp_ns": 12 * S}, "in the future; it must be of the robot's clock"),
        ({"stamp_ns": 1}, "old by its stamp, at most 0.5 s allowed"),
        ({"stamp_ns": 10 * S + 10 * MS}, "its stamps do not rise"),
        ({"frame": "map2"}, "the frame 'slam' expected, found 'map2'"),
        ({"position_sigma": 0.5}, "standard deviations of 0 to 0.2 m and rad expected, found 0.5 m"),
        ({"rotation_sigma": -1.0}, "found 0 m and -1 rad"),
    ],
)
def test_wrong_claims_are_refused_with_the_reason(changes: dict[str, object], words: str) -> None:
    rig = Rig()
    rig.hear()
    rig.see()
    rig.go()
    rig.hear()
    rig.see()
    rig.now_ns += 10 * MS
    assert words in rig.hear(**changes)
    assert rig.see().ok, "the pose before is still good"
    rig.go(0.02)
    assert not rig.hear(), "the next good pose is used"


def test_pose_that_tilts_the_body_against_its_legs_is_refused() -> None:
    rig = Rig(ExternalPoseParams(drift_rate=0.2, jump_angle=0.3))
    for k in range(300):
        rig.go(0.04)
        rig.hear(from_xyz_rpy(np.zeros(3), (0.002 * k, 0.0, 0.0)))  # 3 deg/s
        found = rig.see()
        if not found.ok:
            break
    assert "it tilts the body by 14 deg against its legs, 14 deg allowed" in found.reason


def test_stated_uncertainty_is_used_but_not_less_than_2_mm() -> None:
    for stated, expected in ((0.05, 0.05), (0.0, 0.01), (1e-6, 0.002)):
        rig = Rig()
        rig.hear(position_sigma=stated, rotation_sigma=1e-6)
        assert np.sqrt(rig.see().covariance[2, 2]) == pytest.approx(expected, abs=1e-3)


def test_restart_fixes_the_frame_again() -> None:
    rig = Rig()
    rig.hear()
    rig.see()
    rig.poses.restart()
    rig.go()
    assert not rig.hear(T_FRAME_WORLD, frame="other")
    found = rig.see()
    assert found.ok
    np.testing.assert_allclose(rig.body(found), body_at(0.0), atol=1e-9)
