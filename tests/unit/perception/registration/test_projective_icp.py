"""Projective ICP on a synthetic floor with boxes.

Constrained directions are estimated; the others keep the prior.
"""

import numpy as np
import pytest

from sextant.services.perception.registration.acceptance import Acceptance
from sextant.services.perception.registration.alignment import Aligned
from sextant.services.perception.registration.error_twist import apply_twist, error_twist
from sextant.services.perception.registration.params import KeyframeParams
from sextant.services.perception.registration.projective_icp import Registration
from sextant.services.perception.registration.relocalization_map import (
    MapContradiction,
    RelocalizationMap,
    RelocalizationResult,
)
from sextant.shared.geometry import exp_so3, inverse, orthonormal, transform
from sextant.shared.robot.camera import DepthSensor, Intrinsics

TIGHT = 1e-6 * np.eye(6)
WIDE = np.diag([0.02] * 3 + [0.02] * 3) ** 2
# The default camera at half its resolution with the same noise, for walks of many frames.
SMALL = Intrinsics(320, 240, 262.5, 262.5, 159.5, 119.5)
SMALL_SENSOR = DepthSensor(baseline=0.15)
SPREAD = np.array([[x, y] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])  # [m] points spread wider than one body
STEP = 0.02  # [m] between frames of the synthetic walk


def odometry_increment(T_before, T_after, scale=1.05, turn=1.0e-3):
    """Return a motion as measured by legs: 5 % too long, with extra yaw [rad]."""
    motion = inverse(T_before) @ T_after
    motion[:3, 3] *= scale
    return motion @ transform(exp_so3(T_after[:3, :3].T @ [0.0, 0.0, turn]), np.zeros(3))


def odometry_covariance(motion):
    moved_by = np.linalg.norm(motion[:3, 3])
    return np.diag([(0.1 * moved_by + 2e-4) ** 2] * 3 + [(0.5 * moved_by + 1e-4) ** 2] * 3)


def register_walk(world, scene, frames=101, seed=1):
    """Walk with wrong odometry; return three last poses, and all results.

    The last pose is the true one, the odometry's and the registered one.
    """
    registration = Registration(SMALL, SMALL_SENSOR)
    truth = world.walk(frames, STEP)
    rng = np.random.default_rng(seed)
    T_odometry, T, covariance, results = truth[0], truth[0], TIGHT, []
    for i in range(frames):
        if i:
            motion = odometry_increment(truth[i - 1], truth[i])
            T_odometry, T = T_odometry @ motion, T @ motion
            covariance = covariance + odometry_covariance(motion)
        depth = world.depth_image(truth[i], world.scenes[scene], rng, SMALL, SMALL_SENSOR)
        results.append(registration.update(depth, i, orthonormal(T), covariance))
        T, covariance = results[-1].T_world_camera, results[-1].covariance
    return truth[-1], T_odometry, T, results


def planar_error(T, T_truth):
    """Return the error of a camera pose in two parts.

    The first is x, y [m] and heading [rad], the second height [m], roll and pitch [rad].
    """
    twist = error_twist(T, T_truth)
    return twist[[0, 1, 5]], twist[[2, 3, 4]]


def test_first_frame_keeps_prior_pose(world):
    T = world.camera_pose(0.3)
    result = Registration(world.intrinsics, world.sensor).update(world.depth_image(T), 7, T, WIDE)
    assert result.ok
    assert result.stamp_ns == 7
    np.testing.assert_array_equal(result.T_world_camera, T)


def test_flat_floor_constrains_only_height_roll_and_pitch(world):
    truth, T_odometry, T, results = register_walk(world, "flat")
    assert all(r.ok for r in results)
    odometry_planar, _ = planar_error(T_odometry, truth)
    planar, vertical = planar_error(T, truth)
    assert np.abs(odometry_planar).min() > 0.05
    assert np.abs(planar - odometry_planar).max() < 0.1 * np.abs(odometry_planar).min()
    assert abs(vertical[0]) < 0.002
    assert np.degrees(np.abs(vertical[1:])).max() < 0.2
    # Three directions are open. They contain no height, and no rotation about a horizontal axis.
    open_directions = results[-1].degenerate
    assert len(open_directions) == 3
    floor_constrains = np.abs(open_directions[:, [2]])
    assert floor_constrains.max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "allowed_m", "allowed_deg"), [("steps", 0.010, 1.0), ("boxes", 0.030, 3.0)])
def test_structured_scene_corrects_odometry_error(world, scene, allowed_m, allowed_deg):
    truth, T_odometry, T, results = register_walk(world, scene)
    assert all(r.ok for r in results)
    odometry_planar, _ = planar_error(T_odometry, truth)
    planar, vertical = planar_error(T, truth)
    assert np.linalg.norm(odometry_planar[:2]) > 0.1
    assert np.linalg.norm(planar[:2]) < allowed_m
    assert np.degrees(abs(planar[2])) < allowed_deg
    assert abs(vertical[0]) < 0.002
    assert np.degrees(np.abs(vertical[1:])).max() < 0.2


def test_registration_is_deterministic(world):
    def run():
        _, _, _, results = register_walk(world, "boxes", frames=12)
        return b"".join(r.T_world_camera.tobytes() + r.covariance.tobytes() for r in results)

    assert run() == run()


@pytest.mark.slow
def test_standing_camera_does_not_drift(world):
    registration = Registration(world.intrinsics, world.sensor)
    rng = np.random.default_rng(2)
    T = world.camera_pose(0.2)
    result = registration.update(world.depth_image(T, world.scenes["steps"], rng), 0, T, TIGHT)
    for i in range(1, 25):
        depth = world.depth_image(T, world.scenes["steps"], rng)
        result = registration.update(depth, i, result.T_world_camera, result.covariance + 1e-8 * np.eye(6))
    assert len(registration.keyframe_poses) == 1
    assert np.abs(error_twist(result.T_world_camera, T)).max() < 1e-3


@pytest.mark.parametrize("offset", [[0.01, -0.01, 0.005, 0.01, -0.005, 0.01], [-0.015, 0.01, -0.01, 0.0, 0.01, -0.015]])
def test_wrong_prior_is_corrected_in_fully_observable_scene(world, offset):
    registration = Registration(world.intrinsics, world.sensor)
    boxes = world.scenes["pillars"]
    T = world.camera_pose(0.6)
    registration.update(world.depth_image(T, boxes, np.random.default_rng(3)), 0, T, TIGHT)
    T_next = world.camera_pose(0.63, 0.004, yaw=0.01)
    depth = world.depth_image(T_next, boxes, np.random.default_rng(4))
    result = registration.update(depth, 1, apply_twist(T_next, np.array(offset)), WIDE)
    assert result.ok
    assert len(result.degenerate) == 0
    error = error_twist(result.T_world_camera, T_next)
    assert np.abs(error[:3]).max() < 0.003
    assert np.degrees(np.abs(error[3:])).max() < 0.25


@pytest.mark.parametrize("scene", ["flat", "boxes", "steps"])
def test_covariance_is_never_wider_than_the_prior(world, scene):
    registration = Registration(world.intrinsics, world.sensor)
    T = world.camera_pose(0.3)
    rng = np.random.default_rng(5)
    registration.update(world.depth_image(T, world.scenes[scene], rng), 0, T, TIGHT)
    covariance = registration.update(world.depth_image(T, world.scenes[scene], rng), 1, T, WIDE).covariance
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert np.linalg.eigvalsh(WIDE - covariance).min() > -1e-9
    assert covariance[2, 2] < 1e-6  # any floor constrains the height


def test_failed_registration_returns_prior_and_reason(world):
    registration = Registration(world.intrinsics, world.sensor)
    T = world.camera_pose(0.3)
    registration.update(world.depth_image(T, world.scenes["steps"]), 0, T, TIGHT)
    prior = apply_twist(T, np.array([0.001, 0, 0, 0, 0, 0]))

    dark = registration.update(np.zeros((480, 640), np.uint16), 1, prior, WIDE)
    away = registration.update(world.depth_image(world.camera_pose(2.8)), 2, world.camera_pose(2.8), TIGHT)
    lifted = world.camera_pose(0.3, z=0.31)
    jumped = registration.update(world.depth_image(lifted, world.scenes["steps"]), 3, prior, TIGHT)

    assert [r.ok for r in (dark, away, jumped)] == [False, False, False]
    assert "measured" in dark.reason
    assert "overlap" in away.reason
    assert jumped.reason
    np.testing.assert_array_equal(dark.T_world_camera, prior)
    np.testing.assert_array_equal(dark.covariance, WIDE)
    # It recovers with the next good frame.
    assert registration.update(world.depth_image(T, world.scenes["steps"]), 4, prior, WIDE).ok


def test_lost_map_restarts_after_many_failures(world):
    registration = Registration(world.intrinsics, world.sensor)
    T = world.camera_pose(0.0)
    registration.update(world.depth_image(T), 0, T, TIGHT)
    far = world.camera_pose(3.0)
    results = [registration.update(world.depth_image(far), i, far, WIDE) for i in range(1, 70)]
    assert not results[0].ok
    restarted = next(i for i, r in enumerate(results) if "restarts" in r.reason)
    assert all(r.ok for r in results[restarted + 1 :])


@pytest.mark.slow
def test_restarted_map_accepts_rougher_surface(world):
    registration = Registration(world.intrinsics, world.sensor, Acceptance(patience=3))
    rng = np.random.default_rng(4)
    T = world.camera_pose(0.0)

    def picture(bump_mm):
        depth = world.depth_image(T, world.scenes["steps"], rng).astype(np.int64)
        bumps = np.kron(rng.choice([-bump_mm, bump_mm], (30, 40)), np.ones((16, 16), dtype=np.int64))
        return np.where(depth > 0, depth + bumps, 0).astype(np.uint16)

    for i in range(60):
        assert registration.update(picture(0), i, T, TIGHT).ok
    rough = [registration.update(picture(12), i, T, TIGHT) for i in range(60, 66)]
    assert [r.ok for r in rough] == [False] * 3 + [True] * 3
    assert "restarts" in rough[2].reason


def along_pillars(world):
    """Return a registration after a walk of 0.55 m along pillars, its camera pose (4, 4), and the generator of noise."""
    registration, rng, T = Registration(world.intrinsics, world.sensor), np.random.default_rng(3), np.eye(4)
    for x in np.arange(0.0, 0.6, 0.05):
        T = world.camera_pose(x)
        registration.update(world.depth_image(T, world.scenes["pillars"], rng), 0, T, TIGHT)
    return registration, T, rng


@pytest.mark.slow
def test_displaced_robot_is_relocalized(world):
    registration, expected, rng = along_pillars(world)
    T = world.camera_pose(0.35, 0.2, np.radians(15.0))  # placed elsewhere, unknown to the legs
    depth = world.depth_image(T, world.scenes["pillars"], rng)
    for i in range(12):
        found = registration.update(depth, i, expected, WIDE)
        expected = found.T_world_camera
    assert found.ok
    assert np.abs(error_twist(found.T_world_camera, T)).max() < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("objection", ["", "too little overlap"], ids=["frames register", "frames are refused"])
def test_relocalization_is_refused_unless_searches_agree(world, monkeypatch, objection):
    """Check a person who walks by: one place fits now, another half a second later."""
    registration, T, rng = along_pillars(world)
    monkeypatch.setattr(RelocalizationMap, "contradiction", lambda *_: MapContradiction(1.0, SPREAD))  # every frame is in doubt
    away = {"x": 0.0}

    def search(self, T_expected):
        away["x"] += 0.1
        return Aligned(
            apply_twist(T_expected, np.array([away["x"], 0.0, 0.0, 0.0, 0.0, 0.0])),
            WIDE,
            np.zeros((0, 6)),
            np.zeros((0, 6)),
            self._match,
        )

    monkeypatch.setattr(Registration, "_search", search)
    monkeypatch.setattr(Registration, "_rejection_reason", lambda *_: objection)
    registration._match = registration._aligner.align(T, np.linalg.inv(WIDE)).match
    for i in range(40):
        found = registration.update(world.depth_image(T, world.scenes["pillars"], rng), i, T, WIDE)
        assert np.abs(error_twist(found.T_world_camera, T)).max() < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("doubtful", [0, 4])
def test_slip_is_not_assumed_while_frames_contradict_the_map(world, monkeypatch, doubtful):
    """Check a camera that the frame shows 4 cm from its prior, after frames in which a person was in view."""
    registration, T, rng = along_pillars(world)
    with monkeypatch.context() as person:
        person.setattr(RelocalizationMap, "contradiction", lambda *_: MapContradiction(1.0, SPREAD))
        person.setattr(RelocalizationMap, "find", lambda *_: RelocalizationResult(None, "nowhere"))
        for i in range(doubtful):
            registration.update(world.depth_image(T, world.scenes["pillars"], rng), i, T, TIGHT)
        slipped = apply_twist(T, np.array([0.04, 0.0, 0.0, 0.0, 0.0, 0.0]))
        found = registration.update(world.depth_image(slipped, world.scenes["pillars"], rng), 9, T, TIGHT)
    is_taken = bool(np.abs(error_twist(found.T_world_camera, slipped)).max() < 0.005)
    assert is_taken is (doubtful == 0)


@pytest.mark.slow
@pytest.mark.parametrize("shown", [True, False])
def test_slip_is_not_assumed_in_directions_that_the_ground_did_not_show(world, monkeypatch, shown):
    """Check a camera that the frame shows 4 cm from its prior, where the frame before showed x, y and yaw or not."""
    registration, T, rng = along_pillars(world)
    monkeypatch.setattr(registration, "_unobserved", np.eye(6)[[] if shown else [0, 1, 5]])
    slipped = apply_twist(T, np.array([0.04, 0.0, 0.0, 0.0, 0.0, 0.0]))
    found = registration.update(world.depth_image(slipped, world.scenes["pillars"], rng), 9, T, TIGHT)
    is_taken = bool(np.abs(error_twist(found.T_world_camera, slipped)).max() < 0.005)
    assert is_taken is shown


def test_restarted_map_knows_nothing_of_what_the_old_ground_hid(world):
    """Check level ground, which shows neither x, y nor yaw, and a restart at pillars, which show them."""
    registration, rng = Registration(world.intrinsics, world.sensor, Acceptance(patience=3)), np.random.default_rng(3)
    T = world.camera_pose(-3.0)
    for i in range(3):
        flat = registration.update(world.depth_image(T, world.scenes["flat"], rng), i, T, TIGHT)
    assert len(flat.degenerate) == 3
    T = world.camera_pose(0.55)
    depth = world.depth_image(T, world.scenes["pillars"], rng)
    refused = [registration.update(depth, i, T, TIGHT) for i in range(3, 6)]
    assert "restarts" in refused[-1].reason
    assert len(registration._unobserved) == 0, "a slip may be assumed in any direction, as in a first map"
    assert not registration._doubt.lasts


def test_search_does_not_shift_unobservable_directions(world):
    """Check flat ground in front of the camera: nothing shows whether a pose further ahead is right."""
    registration = Registration(world.intrinsics, world.sensor)
    rng = np.random.default_rng(3)
    T = world.camera_pose(0.0)
    registration.update(world.depth_image(T, world.scenes["flat"], rng), 0, T, TIGHT)
    found = registration.update(world.depth_image(T, world.scenes["flat"], rng), 1, T, TIGHT)
    np.testing.assert_array_equal(registration._unobserved, found.degenerate, "a slip along these is not assumed either")
    assert len(found.degenerate) == 3
    for along, refused in ((0.0, False), (0.18, True)):
        better = registration._aligner.align(apply_twist(T, np.array([along, 0.0, 0.0, 0.0, 0.0, 0.0])), np.linalg.inv(WIDE))
        assert len(better.degenerate) == 3
        assert bool(registration._unobserved_shift(better, T)) is refused


@pytest.mark.slow
@pytest.mark.parametrize(("away", "taken"), [((0.03, 0.02, 0.02), True), ((0.5, -0.3, 0.4), False)])
def test_relocalization_candidate_must_fit_like_regular_frames(world, monkeypatch, away, taken):
    registration, T, rng = along_pillars(world)
    keyframes = len(registration.keyframe_poses)
    monkeypatch.setattr(RelocalizationMap, "contradiction", lambda *_: MapContradiction(1.0, SPREAD))  # every frame is in doubt
    monkeypatch.setattr(
        RelocalizationMap, "find", lambda *_: RelocalizationResult(world.camera_pose(0.55 + away[0], *away[1:]), "")
    )
    for i in range(5):
        found = registration.update(world.depth_image(T, world.scenes["pillars"], rng), i, T, WIDE)
        assert found.ok
        assert np.abs(error_twist(found.T_world_camera, T)).max() < 0.005
    assert len(registration.keyframe_poses) == keyframes, "what is in doubt is no part of the map"
    assert isinstance(registration._search(T), Aligned) is taken


@pytest.mark.slow
def test_frame_with_unusual_surface_distance_is_refused(world):
    registration = Registration(world.intrinsics, world.sensor)
    rng = np.random.default_rng(4)
    T = world.camera_pose(0.0)
    for i in range(60):
        registration.update(world.depth_image(T, world.scenes["steps"], rng), i, T, TIGHT)
    rough = world.depth_image(T, world.scenes["steps"], rng).astype(np.int64)
    bumps = np.kron(rng.choice([-9, 9], (30, 40)), np.ones((16, 16), dtype=np.int64))  # [mm] rougher than any surface before
    found = registration.update(np.where(rough > 0, rough + bumps, 0).astype(np.uint16), 60, T, TIGHT)
    assert not found.ok
    assert "mm apart" in found.reason


@pytest.mark.parametrize("fill", [0, 1, 499, 65535])
def test_image_without_surface_in_range_is_refused_with_reason(world, fill):
    registration = Registration(world.intrinsics, world.sensor)
    result = registration.update(np.full((480, 640), fill, np.uint16), 0, np.eye(4), WIDE)
    assert not result.ok
    assert result.reason


def test_noise_images_never_crash(world):
    registration = Registration(world.intrinsics, world.sensor)
    rng = np.random.default_rng(8)
    for i in range(5):
        result = registration.update(rng.integers(0, 65536, (480, 640), dtype=np.uint16), i, np.eye(4), WIDE)
        assert np.isfinite(result.T_world_camera).all()


@pytest.mark.parametrize("loss", [0.2, 0.6])
def test_registration_tolerates_dropped_pixels(world, loss):
    registration = Registration(world.intrinsics, world.sensor)
    rng = np.random.default_rng(9)
    T = world.camera_pose(0.4)
    for i in range(2):
        depth = world.depth_image(T, world.scenes["steps"], rng)
        depth[rng.random(depth.shape) < loss] = 0
        result = registration.update(depth, i, T, WIDE)
    assert result.ok
    assert np.abs(error_twist(result.T_world_camera, T)).max() < 0.003


def test_too_many_missing_pixels_are_reported_as_reason(world):
    registration = Registration(world.intrinsics, world.sensor)
    rng = np.random.default_rng(9)
    T = world.camera_pose(0.4)
    for i in range(2):
        depth = world.depth_image(T, world.scenes["steps"], rng)
        depth[rng.random(depth.shape) < 0.85] = 0
        result = registration.update(depth, i, T, WIDE)
    assert not result.ok
    assert "of the pixels in view have no measurement" in result.reason


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(160, 120), (320, 240), (424, 240), (1282, 722)])
def test_any_image_size_is_registered(world, width, height):
    f = width / 1.2
    intrinsics = Intrinsics(width, height, f, f, (width - 1) / 2, (height - 1) / 2)
    sensor = DepthSensor(baseline=0.075 * 525.0 / f)
    registration = Registration(intrinsics, sensor)
    rng = np.random.default_rng(6)
    T, T_next = world.camera_pose(0.3), world.camera_pose(0.31, 0.002, yaw=0.005)
    boxes = world.scenes["pillars"]
    registration.update(world.depth_image(T, boxes, rng, intrinsics, sensor), 0, T, TIGHT)
    result = registration.update(world.depth_image(T_next, boxes, rng, intrinsics, sensor), 1, T, WIDE)
    assert result.ok
    error = error_twist(result.T_world_camera, T_next)
    assert np.abs(error[:3]).max() < 0.004
    assert np.degrees(np.abs(error[3:])).max() < 0.3


def test_invalid_arguments_are_refused(world):
    registration = Registration(world.intrinsics, world.sensor)
    depth = np.zeros((480, 640), np.uint16)
    with pytest.raises(ValueError, match=r"uint16 depth image \(480, 640\)"):
        registration.update(depth[:100], 0, np.eye(4), WIDE)
    with pytest.raises(ValueError, match="positive definite"):
        registration.update(depth, 0, np.eye(4), np.zeros((6, 6)))
    with pytest.raises(ValueError, match="finite"):
        registration.update(depth, 0, np.full((4, 4), np.nan), WIDE)
    with pytest.raises(ValueError, match="active"):
        KeyframeParams(active=5, stored=4)
    with pytest.raises(ValueError, match="8x8"):
        Registration(Intrinsics(4, 4, 5.0, 5.0, 2.0, 2.0), world.sensor)
