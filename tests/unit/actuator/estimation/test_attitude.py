"""Attitude from gyro and accelerometer: up is found, heading is not estimated.

Up is found from any start, during any rotation and with any gyro bias.
"""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sextant.services.actuator.estimation.attitude import Attitude, AttitudeEstimator
from sextant.services.simulator.sensors.imu import Imu, ImuNoise
from sextant.shared.geometry import Array, exp_so3, rotation_from_rpy, rotation_z, yaw_of

DT = 0.02
G = np.array([0.0, 0.0, 9.81])
WILD = settings(max_examples=8, deadline=None)

tilts = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
headings = st.floats(-3.0, 3.0)


def specific_force(R_world_body: Array) -> Array:
    return np.asarray(R_world_body.T @ G)


def hold(filter_: AttitudeEstimator, R_world_body: Array, for_s: float, gyro: Array | None = None) -> Attitude:
    rate = np.zeros(3) if gyro is None else gyro
    found = filter_.update(rate, specific_force(R_world_body), DT)
    for _ in range(round(for_s / DT)):
        found = filter_.update(rate, specific_force(R_world_body), DT)
    return found


def off(found: Attitude, R_world_body: Array) -> float:
    """Return the angle [rad] between the estimated and the true up direction."""
    return float(np.arccos(np.clip(found.up @ R_world_body[2], -1.0, 1.0)))


@pytest.mark.slow
@WILD
@given(st.tuples(st.floats(-3.0, 3.0), st.floats(-1.4, 1.4)), tilts, headings)
def test_up_is_found_from_any_start(start: tuple[float, float], tilt: tuple[float, float], yaw: float) -> None:
    first, then = rotation_from_rpy([*start, 0.0]), rotation_from_rpy([*tilt, yaw])
    assume(first[2] @ then[2] > -0.99)
    filter_ = AttitudeEstimator()
    filter_.update(np.zeros(3), specific_force(first), DT)
    found = hold(filter_, then, 40.0)  # for a while the filter takes the initial error for a gyro bias
    assert off(found, then) < 2e-3
    assert found.doubt < np.radians(1.0)


@WILD
@given(tilts, headings, st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3))
def test_attitude_of_turning_body_follows_the_gyro(tilt: tuple[float, float], yaw: float, rate: list[float]) -> None:
    R, filter_ = rotation_from_rpy([*tilt, yaw]), AttitudeEstimator()
    found = filter_.update(np.zeros(3), specific_force(R), DT)
    for _ in range(100):
        R = R @ exp_so3(DT * np.array(rate))
        found = filter_.update(np.array(rate), specific_force(R), DT)
    assert off(found, R) < 1e-3


@pytest.mark.slow
@WILD
@given(tilts, st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)))
def test_horizontal_gyro_bias_is_estimated(tilt: tuple[float, float], bias: tuple[float, float]) -> None:
    R, filter_ = rotation_from_rpy([*tilt, 0.3]), AttitudeEstimator()
    across = np.cross(R[2], [0.0, 0.0, 1.0] if abs(R[2, 2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    wrong = bias[0] * across + bias[1] * np.cross(R[2], across)  # a bias about the up axis is not observable
    found = hold(filter_, R, 90.0, wrong)
    np.testing.assert_allclose(filter_.bias, wrong, atol=3e-4)
    assert off(found, R) < 1e-3


@WILD
@given(tilts, headings, headings)
def test_attitude_is_independent_of_heading(tilt: tuple[float, float], yaw: float, turn: float) -> None:
    """Check that the same tilt gives the same result under any heading.

    The yaw of the result is zero.
    """
    a, b = AttitudeEstimator(), AttitudeEstimator()
    R = rotation_from_rpy([*tilt, yaw])
    one, other = hold(a, R, 0.1), hold(b, rotation_z(turn) @ R, 0.1)
    np.testing.assert_allclose(one.R_level_body, other.R_level_body, atol=1e-9)
    assert yaw_of(one.R_level_body) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(one.R_level_body, rotation_from_rpy([*tilt, 0.0]), atol=1e-9)


def test_external_acceleration_raises_doubt_but_does_not_tilt_up() -> None:
    """Check that a specific force longer or shorter than gravity does not tilt up.

    Such a force only increases the uncertainty.
    """
    filter_ = AttitudeEstimator()
    calm = hold(filter_, np.eye(3), 20.0)
    for _ in range(50):
        pushed = filter_.update(np.zeros(3), G + np.array([4.0, 0.0, 4.0]), DT)
    assert off(pushed, np.eye(3)) < np.radians(0.1)
    assert pushed.doubt > calm.doubt


@pytest.mark.parametrize("force", [np.zeros(3), G / 9.81, 3.0 * G])
def test_implausible_specific_force_keeps_attitude_uncertain(force: Array) -> None:
    """Check that a sensor that sends only zeros, or counts in g, stays uncertain."""
    filter_ = AttitudeEstimator()
    doubts = [filter_.update(np.zeros(3), force, DT).doubt for _ in range(500)]
    assert min(doubts) > np.radians(5.0)


def test_data_sheet_noise_gives_tilt_error_below_0_6_deg() -> None:
    """Check one sigma of the tilt: the accelerometer's bias appears as a tilt error."""
    errors, doubts = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        sensor, filter_ = Imu(ImuNoise(), rng), AttitudeEstimator()
        R = rotation_from_rpy([0.1, -0.05, 1.0])
        for _ in range(750):
            found = filter_.update(*sensor.update(np.zeros(3), specific_force(R), DT), DT)
        errors.append(off(found, R))
        doubts.append(found.doubt)
    assert np.sqrt(np.mean(np.square(errors)) / 2) < np.mean(doubts) < np.radians(0.6)


def test_zero_time_interval_is_refused() -> None:
    with pytest.raises(ValueError, match="positive interval"):
        AttitudeEstimator().update(np.zeros(3), G, 0.0)


@WILD
@given(tilts, st.lists(st.floats(-0.01, 0.01), min_size=3, max_size=3))
def test_vertical_gyro_bias_is_estimated_at_rest_and_removed_from_yaw(tilt: tuple[float, float], bias: list[float]) -> None:
    R, filter_, wrong = rotation_from_rpy([*tilt, 0.0]), AttitudeEstimator(), np.array(bias)
    for _ in range(500):
        filter_.update(wrong, specific_force(R), DT, still=True)
    assert (filter_.bias - wrong) @ R[2] == pytest.approx(0.0, abs=1e-4)
    before = filter_.update(wrong, specific_force(R), DT).turned
    for _ in range(200):
        R = rotation_z(0.004) @ R
        found = filter_.update(wrong + R.T @ [0.0, 0.0, 0.004 / DT], specific_force(R), DT)
    assert found.turned - before == pytest.approx(0.8, abs=2e-3)


def test_bias_is_known_after_a_second_at_rest_and_then_averaged_over_ten() -> None:
    rng, filter_, truth = np.random.default_rng(3), AttitudeEstimator(), np.array([0.004, -0.006, 0.006])
    filter_.update(np.zeros(3), G, DT)
    for _ in range(round(1.0 / DT)):
        assert not filter_.knows_bias
        filter_.update(truth + rng.normal(0.0, 1e-3, 3), G, DT, still=True)
    assert filter_.knows_bias
    assert filter_.bias[2] == pytest.approx(truth[2], abs=4e-4)
    again = AttitudeEstimator(filter_)  # after a gap
    assert again.knows_bias
    again.update(np.zeros(3), G, DT)
    before = again.bias[2]
    again.update(np.array([0.0, 0.0, before + 0.01]), G, DT, still=True)
    assert again.bias[2] - before < 0.01 * DT, "one reading hardly changes it"
    assert not AttitudeEstimator().knows_bias


def test_first_reading_gives_no_gyro_bias() -> None:
    """Check that the first reading gives no bias: the interval before it is unknown."""
    filter_ = AttitudeEstimator()
    filter_.update(np.full(3, 0.015), G, 1.0, still=True)
    np.testing.assert_array_equal(filter_.bias, np.zeros(3))


def test_heading_and_tilt_use_the_same_bias() -> None:
    """Check that heading uses the bias that the same reading has just estimated.

    A body at rest whose whole bias is found in one reading has not turned.
    """
    filter_ = AttitudeEstimator()
    filter_.update(np.zeros(3), G, DT)
    found = filter_.update(np.array([0.0, 0.0, 0.01]), G, 1.0, still=True)
    assert filter_.bias[2] == pytest.approx(0.01)
    assert found.turned == pytest.approx(0.0, abs=1e-12)


def test_rotation_during_stillness_is_not_taken_for_gyro_bias() -> None:
    filter_ = AttitudeEstimator()
    for _ in range(200):
        filter_.update(np.array([0.0, 0.0, 0.1]), G, DT, still=True)
    assert np.abs(filter_.bias).max() < 1e-9
