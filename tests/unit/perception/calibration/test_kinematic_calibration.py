"""Batch calibration on measurements that are computed from a known robot, by other formulas than those of the estimate."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.perception.calibration import kinematic_calibration
from sextant.services.perception.calibration.floor_view import BLOCK_PX, expected_floor, floor_view
from sextant.services.perception.calibration.kinematic_calibration import Estimate
from sextant.services.perception.calibration.survey import postures
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse
from sextant.shared.robot.kinematics import body_forward, body_inverse
from sextant.shared.robot.profiles import load_profile
from tests.unit.perception.calibration.measurements import PROFILE, Truth, recording


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
    assert estimate.sigma("place").max() < 0.0015
    assert estimate.sigma("delay")[0] < 0.003
    assert np.degrees(estimate.sigma("rotation")).max() < 0.2
    assert np.degrees(estimate.sigma("trims")).max() < 1.0


def test_flat_floor_is_no_surprise(found: tuple[Truth, Estimate, Array]) -> None:
    assert found[1].surprise("slope").max() < 3.0
    assert found[1].sigma_feet[2] < 0.0005


def test_floor_in_view_that_is_tilted_against_the_feet_is_noticed() -> None:
    estimate = kinematic_calibration.estimate(PROFILE, recording(Truth(tilt_deg=3.0))[0])
    assert estimate.surprise("slope").max() > 4.0


def test_images_whose_feet_are_in_the_air_despite_their_load_are_survived(found: tuple[Truth, Estimate, Array]) -> None:
    measured, _ = recording(found[0])
    q = measured.joints.q.copy()
    q[100:104, :, 1] += np.linspace(0.2, 0.5, 6)  # [rad] no two feet are at the same height
    views = list(measured.views)
    for number in range(100, 104):
        views[number] = replace(views[number], inverse_depth=np.full_like(views[number].inverse_depth, np.nan))
    estimate = kinematic_calibration.estimate(PROFILE, replace(measured, views=views, joints=replace(measured.joints, q=q)))
    assert np.abs(estimate.of("place") - found[1].of("place")).max() < 0.003


def test_small_motion_determines_less() -> None:
    estimate = kinematic_calibration.estimate(PROFILE, recording(Truth(share=0.05))[0])
    assert np.degrees(estimate.sigma("rotation")).max() > 0.7


def test_horns_make_up_for_links_that_stay_as_they_are(found: tuple[Truth, Estimate, Array]) -> None:
    _, estimate, trims = found
    exact = estimate.with_exact_links()
    np.testing.assert_allclose(exact.of("links"), 0.0, atol=1e-12)
    q = body_inverse(PROFILE, PROFILE.rest_feet())
    feet = body_forward(PROFILE, q + trims - exact.of("trims").reshape(6, 3))
    assert np.abs(feet - PROFILE.rest_feet()).max() < 0.004
    assert np.abs(body_forward(PROFILE, q + trims) - PROFILE.rest_feet()).max() > 0.008


def test_feet_on_uneven_floor_are_a_surprise(found: tuple[Truth, Estimate, Array]) -> None:
    assert found[1].surprise("feet")[2::3].max() < 1.5
    uneven = kinematic_calibration.estimate(PROFILE, recording(Truth(uneven_m=0.008))[0])
    assert uneven.surprise("feet")[2::3].max() > 4.0


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
