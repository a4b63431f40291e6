"""Laws of the calibration from motion: what it recovers, and what the motion does not show."""

import numpy as np
import pytest

from sextant.services.perception.calibration.motion_calibration import HEIGHT, ROTATION, SCALE, MotionCalibration, Registered
from sextant.services.perception.registration.error_twist import apply_twist, error_twist
from sextant.shared.geometry import Array, apply, exp_so3, inverse, transform

P_BODY_CAMERA = np.array([0.12, 0.0, 0.08])
PRIOR = np.diag([0.002, 0.002, 0.01, 0.01, 0.01, 0.002]) ** 2  # of one frame, as of leg odometry
SHARP = np.diag([1e4, 1e4, 1e4, 3e3, 3e3, 3e3]) ** 2  # information of images that show everything
NOTHING = np.zeros(10)


def walk(number: int, turn: float = 0.0) -> list[Array]:
    """Return motions (4, 4) of the body between frames, 1 cm each, with turn [rad] to alternating sides."""
    turns = turn * np.sin(np.arange(number) / 15.0)
    return [transform(exp_so3([0.0, 0.0, angle]), [0.01, 0.0, 0.0]) for angle in turns]


def seen_by(moved: Array, rotation: Array, scale: float) -> Array:
    """Return the motion (4, 4) of the body as a camera with these errors shows it."""
    X = transform(exp_so3(rotation), P_BODY_CAMERA - exp_so3(rotation) @ P_BODY_CAMERA)
    shown = X @ moved @ inverse(X)
    shown[:3, 3] += scale * (moved[:3, 3] + (moved[:3, :3] - np.eye(3)) @ P_BODY_CAMERA)
    return shown


def calibrated(motions: list[Array], rotation: Array, scale: float = 0.0, information: Array = SHARP) -> MotionCalibration:
    """Return the filter after a walk whose poses are registered with this information (6, 6)."""
    calibration = MotionCalibration(P_BODY_CAMERA)
    T = T_images = np.eye(4)
    covariance = np.linalg.inv(np.linalg.inv(PRIOR) + information)
    for moved in motions:
        T_images = T_images @ seen_by(moved, rotation, scale)
        T_prior = T @ moved
        twist = covariance @ information @ error_twist(T_images, T_prior)
        T = apply_twist(T_prior, twist)
        calibration.add(Registered(T_prior, PRIOR, twist, covariance, moved, 66_000_000), NOTHING)
    return calibration


@pytest.mark.parametrize("sharpness", [1.0, 1e-3, 1e-4])
def test_pitch_is_recovered_however_slowly_the_pose_follows_the_images(sharpness: float) -> None:
    found = calibrated(walk(300), np.array([0.0, 0.05, 0.0]), information=sharpness * SHARP)
    assert found.values[1] == pytest.approx(0.05, abs=0.006)
    assert found.sigma[1] < 0.01


def test_exact_camera_has_no_errors() -> None:
    found = calibrated(walk(200, 0.02), np.zeros(3))
    assert np.abs(found.values).max() < 1e-9


def test_straight_walk_shows_neither_roll_nor_height() -> None:
    found = calibrated(walk(300), np.array([0.05, 0.0, 0.0]))
    fresh = MotionCalibration(P_BODY_CAMERA)
    for value in (0, HEIGHT):
        assert found.values[value] == pytest.approx(0.0, abs=1e-3)
        assert found.sigma[value] == pytest.approx(fresh.sigma[value], rel=1e-3)


def test_turns_show_roll() -> None:
    straight, turning = calibrated(walk(300), np.zeros(3)), calibrated(walk(300, 0.05), np.array([0.05, 0.0, 0.0]))
    assert turning.values[0] == pytest.approx(0.05, abs=0.02)
    assert turning.sigma[0] < 0.5 * straight.sigma[0]


def test_direction_without_structure_says_nothing() -> None:
    """On a bare floor the images show neither x nor y nor yaw."""
    floor = SHARP.copy()
    floor[[0, 1, 5], [0, 1, 5]] = 0.0
    found = calibrated(walk(300), np.array([0.0, 0.0, 0.05]), 0.03, floor)
    fresh = MotionCalibration(P_BODY_CAMERA)
    assert found.values[2] == pytest.approx(0.0, abs=1e-3)
    assert found.values[SCALE] == pytest.approx(0.0, abs=1e-3)
    assert found.sigma[2] == pytest.approx(fresh.sigma[2], rel=1e-3)


def test_yaw_and_scale_are_shared_with_the_legs() -> None:
    """Legs that walk to the right look like a camera that is turned left."""
    found = calibrated(walk(300), np.array([0.0, 0.0, 0.05]), 0.03)
    assert 0.025 < found.values[2] < 0.05
    assert 0.015 < found.values[SCALE] < 0.03
    assert found.sigma[2] > 0.015


def test_slip_of_a_foot_is_not_used() -> None:
    frame = Registered(
        np.eye(4), PRIOR, np.array([-0.2, 0.0, 0.0, 0.0, 0.0, 0.0]), np.linalg.inv(SHARP), walk(1)[0], 66_000_000
    )
    calibration = MotionCalibration(P_BODY_CAMERA)
    assert [calibration.add(frame, NOTHING) for _ in range(11)] == [False] * 10 + [True]
    assert not calibration.values.any()
    assert calibration.way == 0.0


def test_interruption_drops_the_stretch() -> None:
    motions = walk(9)
    calibration = MotionCalibration(P_BODY_CAMERA)
    for _ in range(5):
        for moved in motions:
            frame = Registered(np.eye(4), PRIOR, np.full(6, 0.001), np.linalg.inv(SHARP), moved, 66_000_000)
            assert not calibration.add(frame, NOTHING)
        calibration.interrupt()
    assert not calibration.values.any()


def test_corrected_errors_are_not_learned_twice() -> None:
    corrected = NOTHING.copy()
    corrected[1] = 0.04
    calibration = MotionCalibration(P_BODY_CAMERA)
    for moved in walk(300):  # the camera is right now, so images and legs agree
        calibration.add(Registered(np.eye(4), PRIOR, np.zeros(6), np.linalg.inv(SHARP), moved, 66_000_000), corrected)
    assert calibration.values[1] == pytest.approx(0.04, abs=0.004)


@pytest.mark.parametrize(("rotation", "height"), [((0.05, 0.0, 0.0), 0.0), ((0.0, 0.05, 0.0), 0.0), ((0.0, 0.0, 0.0), 0.006)])
def test_heights_below_the_feet_show_roll_and_height(rotation: tuple[float, ...], height: float) -> None:
    """The legs measure the true ground. A wrong mount moves the ground of the map."""
    feet = np.array([[x, y, -0.1] for y in (0.15, -0.15) for x in (0.18, 0.0, -0.18)])
    R = exp_so3(rotation)
    X = transform(R, P_BODY_CAMERA - R @ P_BODY_CAMERA + [0.0, 0.0, height])  # from the true camera to the profile's
    legs = (feet - apply(X, feet))[:, 2]  # ground by the legs, minus the ground by the camera
    values, covariance = MotionCalibration(P_BODY_CAMERA).with_leg_heights(legs, feet, NOTHING)
    found, sigma = values[[0, 1, 2, HEIGHT]], np.sqrt(np.diag(covariance))[[0, 1, 2, HEIGHT]]
    assert (np.abs(found - [*rotation, height]) < 2.0 * sigma).all()
    which = int(np.argmax(np.abs([*rotation, height]) / [0.03, 0.03, 0.03, 0.006]))
    assert found[which] == pytest.approx([*rotation, height][which], rel=0.4)


def test_legs_that_have_not_touched_the_ground_say_nothing() -> None:
    calibration = MotionCalibration(P_BODY_CAMERA)
    values, covariance = calibration.with_leg_heights(np.full(6, np.nan), np.zeros((6, 3)), NOTHING)
    np.testing.assert_array_equal(values, calibration.values)
    np.testing.assert_array_equal(covariance, calibration.covariance)
    infinite = np.full(6, np.inf)
    assert (calibration.with_leg_heights(infinite, np.zeros((6, 3)), NOTHING)[0] == calibration.values).all()


def test_places_of_the_numbers_do_not_overlap() -> None:
    assert len({*range(ROTATION.start, ROTATION.stop), HEIGHT, SCALE}) == 5
