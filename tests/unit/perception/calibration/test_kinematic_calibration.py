"""Batch calibration on measurements that are computed from a known robot, by other formulas than those of the estimate."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from sextant.services.perception.calibration import kinematic_calibration
from sextant.services.perception.calibration.floor_view import BLOCK_PX, FloorView, block_centres, floor_view
from sextant.services.perception.calibration.kinematic_calibration import Estimate, JointTrack, Recording
from sextant.services.perception.calibration.survey import expected_floor, postures
from sextant.shared.geometry import Array, apply, from_xyz_rpy, interpolate, inverse
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profile import Foot, RobotProfile
from sextant.shared.robot.profiles import load_profile

PROFILE = replace(load_profile("phantomx_mk2"), foot=Foot(0.001))  # feet that hardly roll
MS = 1_000_000
STILL, MOVING = 4, 8  # images of a posture at rest and on the way to it


@dataclass(frozen=True)
class Truth:
    """A robot and the floor on which it measures itself."""

    robot: RobotProfile = PROFILE
    trims_deg: float = 0.0
    tilt_deg: float = 0.0  # of the floor in view
    uneven_m: float = 0.0  # heights of the floor below the feet
    share: float = 1.0  # of the motion


def recording(truth: Truth, seed: int = 0) -> tuple[Recording, Array]:
    """Return what a robot measures, and its trims (6, 3) [rad]."""
    rng = np.random.default_rng(seed)
    camera = truth.robot.camera
    trims = np.radians(rng.uniform(-truth.trims_deg, truth.trims_deg, (6, 3)))
    rest = apply(from_xyz_rpy((0.0, 0.0, PROFILE.stance.body_height), np.zeros(3)), PROFILE.rest_feet())
    feet = rest + [0.0, 0.0, 1.0] * rng.normal(0.0, truth.uneven_m, (6, 1))
    targets = [from_xyz_rpy([0.0, 0.0, PROFILE.stance.body_height], np.zeros(3))]
    targets += [targets[0] @ from_xyz_rpy(truth.share * p[:3], truth.share * p[3:]) for p in postures(PROFILE)]
    views, numbers, stamps, angles = [], [], [], []
    now_ns = 1_000 * MS
    for number in range(len(targets) - 1):
        shares = [*np.linspace(0.0, 1.0, MOVING, endpoint=False), *[1.0] * STILL]
        for s in shares:
            T = interpolate(targets[number], targets[number + 1], s)
            slid = feet + rng.normal(0.0, 0.0005, (6, 3)) * [1.0, 1.0, 0.0]
            q = body_inverse(PROFILE, apply(inverse(T), slid)) + trims + rng.normal(0.0, np.radians(0.08), (6, 3))
            stamps.append(now_ns)
            angles.append(q)
            depth = inverse_depth(truth, T) + rng.normal(0.0, 3e-4, len(block_centres(camera.intrinsics)[0]))
            views.append(FloorView(now_ns + round(1e9 * camera.time_offset_s), depth))
            numbers.append(number)
            now_ns += 60 * MS
    track = JointTrack(np.array(stamps), np.array(angles), np.ones((len(stamps), 6), dtype=np.bool_))
    return Recording(views, np.array(numbers), track), trims


def inverse_depth(truth: Truth, T_floor_body: Array) -> Array:
    """Return the measured inverse depth (blocks,) [1/m]: rays of the true camera meet the floor."""
    camera, lens = truth.robot.camera, truth.robot.camera.intrinsics
    u, v = block_centres(PROFILE.camera.intrinsics)
    T = T_floor_body @ camera.T_body_camera
    normal = from_xyz_rpy(np.zeros(3), np.radians([0.0, truth.tilt_deg, 0.0]))[:3, 2]
    rays = T[:3, :3] @ np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(len(u))])
    depth = -(normal @ T[:3, 3]) / (normal @ rays)
    seen = (depth > camera.sensor.min_range) & (depth < camera.sensor.max_range)
    return np.where(seen, 1.0 / (depth * (1.0 + camera.depth_error)), np.nan)


@pytest.fixture(scope="module")
def found() -> tuple[Truth, Estimate, Array]:
    """Return a robot that differs from the profile, its estimate and its trims."""
    lens = PROFILE.camera.intrinsics
    camera = replace(
        PROFILE.camera,
        mount_xyz=(0.104, -0.006, 0.143),
        roll_deg=-1.5,
        pitch_down_deg=32.0,
        yaw_deg=2.0,
        time_offset_s=0.03,
        depth_error=-0.02,
        intrinsics=replace(lens, fx=1.01 * lens.fx, fy=1.01 * lens.fy),
    )
    truth = Truth(replace(PROFILE, camera=camera), trims_deg=3.0)
    measured, trims = recording(truth)
    return truth, kinematic_calibration.estimate(PROFILE, measured), trims


def test_numbers_of_a_robot_are_recovered_within_their_uncertainty(found: tuple[Truth, Estimate, Array]) -> None:
    truth, estimate, trims = found
    true = truth.robot.camera
    for name, value in (
        ("place", np.subtract(true.mount_xyz, PROFILE.camera.mount_xyz)),
        ("scale", true.depth_error),
        ("focal", 0.01),
        ("delay", 0.03),
        ("trims", trims.ravel()),
    ):
        error = np.abs(estimate.of(name) - value)
        assert (error < 4.0 * estimate.sigma(name)).all(), name
    assert estimate.sigma("place").max() < 0.003
    assert estimate.sigma("delay")[0] < 0.003
    assert np.degrees(estimate.sigma("rotation")).max() < 0.4
    assert np.degrees(estimate.sigma("trims")).max() < 1.0


def test_flat_floor_is_no_surprise(found: tuple[Truth, Estimate, Array]) -> None:
    assert found[1].surprise("slope").max() < 3.0
    assert found[1].sigma_feet[2] < 0.0005


def test_floor_in_view_that_is_tilted_against_the_feet_is_noticed() -> None:
    estimate = kinematic_calibration.estimate(PROFILE, recording(Truth(tilt_deg=3.0))[0])
    assert estimate.surprise("slope").max() > 4.0


def test_small_motion_determines_less() -> None:
    estimate = kinematic_calibration.estimate(PROFILE, recording(Truth(share=0.05))[0])
    assert np.degrees(estimate.sigma("rotation")).max() > 0.7


def test_exact_links_leave_the_feet_where_they_are(found: tuple[Truth, Estimate, Array]) -> None:
    exact = found[1].with_exact_links()
    np.testing.assert_allclose(exact.of("links"), 0.0, atol=1e-12)
    assert np.degrees(np.abs(exact.of("trims") - found[2].ravel())).max() < 3.0


def test_blocks_that_are_not_floor_are_left_out() -> None:
    camera = PROFILE.camera
    lens = camera.intrinsics
    T = from_xyz_rpy([0.0, 0.0, PROFILE.stance.body_height], np.zeros(3)) @ camera.T_body_camera
    u, v = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones(u.shape)], axis=-1)
    with np.errstate(divide="ignore"):
        depth = -T[2, 3] / (rays @ T[2, :3])
    box = (slice(120, 320), slice(240, 400))
    depth[box] = 0.8  # an object on the floor
    seen = (depth > camera.sensor.min_range) & (depth < camera.sensor.max_range)
    raw = np.where(seen, depth * camera.sensor.depth_scale, 0.0).round().astype(np.uint16)
    soles = PROFILE.rest_feet() - [0.0, 0.0, PROFILE.foot.radius]
    view = floor_view(0, raw, camera, expected_floor(camera, soles))
    blocks = view.inverse_depth.reshape(lens.height // BLOCK_PX, lens.width // BLOCK_PX)
    assert np.isnan(blocks[3:6, 6:10]).all()
    assert np.isfinite(blocks[3:5, :5]).all()
    expected = expected_floor(camera, soles).reshape(blocks.shape)
    known = np.isfinite(blocks)
    np.testing.assert_allclose(blocks[known], expected[known], rtol=0.02)
    other_size = floor_view(0, raw[:100], camera, expected_floor(camera, soles))
    assert np.isnan(other_size.inverse_depth).all()


def test_postures_are_within_reach_and_spread_over_all_directions() -> None:
    for name in ("phantomx_mk2", "lotriet_rx64"):
        robot = load_profile(name)
        found = postures(robot)
        feet = robot.rest_feet()
        for posture in found:
            assert np.isfinite(body_inverse(robot, apply(inverse(from_xyz_rpy(posture[:3], posture[3:])), feet))).all()
        assert (found.std(axis=0) > [0.01, 0.01, 0.008, 0.06, 0.06, 0.06]).all(), name
