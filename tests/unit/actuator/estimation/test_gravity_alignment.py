"""Gravity alignment: an inertial sensor removes the tilt of {odom}.

The frame turns about the body and nothing else moves. Implausible readings are ignored.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.actuator.estimation.gravity_alignment import GravityAlignment
from sextant.shared.geometry import Array, exp_so3, from_xyz_rpy, is_rigid, log_so3, rotation_from_rpy, transform, yaw_of
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import Imu

G = np.array([0.0, 0.0, 9.81])
MS = 1_000_000
WILD = settings(max_examples=8, deadline=None)

leans = st.tuples(st.floats(-0.14, 0.14), st.floats(-0.14, 0.14))


def alignment_at_rest(R_level_body: Array, for_s: float = 15.0) -> tuple[GravityAlignment, int]:
    """Return a `GravityAlignment` that has received a body at rest, and the time [ns]."""
    plumb, now_ns = GravityAlignment(), 0
    for now_ns in range(0, round(for_s * 1e9), 20 * MS):
        plumb.take(Imu(now_ns, np.zeros(3), R_level_body.T @ G), now_ns)
    return plumb, now_ns


def lean(T: Array) -> float:
    return float(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))


@pytest.mark.slow
@WILD
@given(leans, st.floats(-3.0, 3.0), st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)))
def test_odom_frame_is_levelled_about_the_body(tilt: tuple[float, float], yaw: float, at: tuple[float, float]) -> None:
    """Check that {odom} turns level: the body is level, but the legs report a tilt."""
    plumb, now_ns = alignment_at_rest(np.eye(3))
    T = from_xyz_rpy([*at, 0.1], [*tilt, yaw])
    place, before = T[:3, 3].copy(), lean(T)
    for _ in range(2000):
        turn = plumb.turn(T, now_ns, 0.02)
        if turn is None:
            break
        assert is_rigid(turn)
        assert abs(log_so3(turn[:3, :3])[2]) < 1e-9, "about a level axis"
        T = turn @ T
        assert lean(T) <= before + 1e-9
        before = lean(T)
    np.testing.assert_allclose(T[:3, 3], place, atol=1e-9)
    assert lean(T) < np.radians(0.7)
    assert abs(np.sin(yaw_of(T) - yaw)) < 0.05


def test_tilt_below_imu_uncertainty_is_not_corrected() -> None:
    plumb, now_ns = alignment_at_rest(np.eye(3))
    assert plumb.turn(from_xyz_rpy(np.zeros(3), (np.radians(0.3), 0.0, 0.0)), now_ns, 0.02) is None
    assert plumb.turn(from_xyz_rpy(np.zeros(3), (np.radians(2.0), 0.0, 0.0)), now_ns, 0.02) is not None


def test_missing_imu_gives_no_correction_and_no_problem() -> None:
    plumb, leaning = GravityAlignment(), from_xyz_rpy(np.zeros(3), (0.5, 0.0, 0.0))
    assert plumb.turn(leaning, 0, 0.02) is None
    assert plumb.tipped(leaning, 0) == ""
    assert plumb.problem(0) == ""


@pytest.mark.parametrize(("off_deg", "said"), [(15.0, False), (25.0, True), (180.0, True)])
def test_tipping_is_reported_above_20_deg(off_deg: float, said: bool) -> None:
    plumb, now_ns = alignment_at_rest(rotation_from_rpy((np.radians(off_deg), 0.0, 0.0)))
    words = plumb.tipped(np.eye(4), now_ns)
    assert bool(words) == said
    assert not said or f"{off_deg:.0f} deg from" in words


def test_silent_imu_gives_no_attitude() -> None:
    plumb, now_ns = alignment_at_rest(rotation_from_rpy((0.6, 0.0, 0.0)))
    later_ns = now_ns + 500 * MS
    assert plumb.attitude(now_ns) is not None
    assert plumb.attitude(later_ns) is None
    assert plumb.tipped(np.eye(4), later_ns) == ""
    assert "no IMU readings for 0.5 s" in plumb.problem(later_ns)


def test_attitude_is_uncertain_after_a_gap() -> None:
    plumb, now_ns = alignment_at_rest(np.eye(3))
    later_ns = now_ns + 500 * MS
    plumb.take(Imu(later_ns, np.zeros(3), G), later_ns)
    assert plumb.attitude(later_ns) is None
    assert "uncertain by" in plumb.problem(later_ns)


def test_attitude_that_becomes_certain_after_the_start_is_no_problem() -> None:
    plumb = GravityAlignment()
    unknown = 0
    for now_ns in range(0, 4_000 * MS, 10 * MS):
        plumb.take(Imu(now_ns, np.zeros(3), G), now_ns)
        unknown += plumb.attitude(now_ns) is None
        assert plumb.problem(now_ns) == ""
    assert 100 < unknown < 300


def test_out_of_order_reading_is_ignored() -> None:
    plumb, now_ns = alignment_at_rest(np.eye(3))
    before = plumb.attitude(now_ns)
    assert before is not None
    plumb.take(Imu(now_ns - 50 * MS, np.ones(3), np.ones(3)), now_ns)
    after = plumb.attitude(now_ns)
    assert after is not None
    np.testing.assert_array_equal(after.up, before.up)
    assert after.doubt == before.doubt


def test_accelerometer_in_units_of_g_is_ignored_and_reported() -> None:
    plumb, now_ns = GravityAlignment(), 0
    for now_ns in range(0, 5_000 * MS, 10 * MS):
        plumb.take(Imu(now_ns, np.zeros(3), np.array([0.0, 0.0, 1.0])), now_ns)
    assert plumb.turn(from_xyz_rpy(np.zeros(3), (0.1, 0.0, 0.0)), now_ns, 0.02) is None
    assert "uncertain by" in plumb.problem(now_ns)


COMING = np.array([True, False, True, False, True, False])
FEET = load_profile("phantomx_mk2").rest_feet()


def heaving_feet(R_level_body: Array, T_odom_body: Array) -> NDArray[np.bool_]:
    """Return the feet reported as lifting a body that tilts while they come down.

    Before, the body's tilt is that of the legs' odometry.
    """
    plumb, now_ns = alignment_at_rest(T_odom_body[:3, :3])
    nothing = plumb.lifts_body(T_odom_body, FEET, np.zeros(6, dtype=bool), now_ns)
    assert not nothing.any()
    sudden, later_ns = alignment_at_rest(R_level_body)
    plumb._attitude, plumb._heard_ns = sudden.attitude(later_ns), now_ns
    return plumb.lifts_body(T_odom_body, FEET, COMING, now_ns)


@WILD
@given(st.sampled_from([0, 2, 4]), st.floats(2.5, 8.0), st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)))
def test_foot_under_rising_body_corner_is_reported_as_heaving(leg: int, angle_deg: float, lean: tuple[float, float]) -> None:
    """Check that only the foot whose corner of the body rises is reported.

    The result does not depend on the body's attitude before.
    """
    x, y = FEET[leg, :2] / np.hypot(*FEET[leg, :2])
    before = rotation_from_rpy([*lean, 0.0])
    R = before @ exp_so3(np.radians(angle_deg) * np.array([y, -x, 0.0]))
    np.testing.assert_array_equal(heaving_feet(R, from_xyz_rpy(np.zeros(3), [*lean, 0.0])), np.arange(6) == leg)


@pytest.mark.parametrize("angle_deg", [1.0, -5.0])
def test_heaving_requires_more_than_1_deg_and_a_descending_foot(angle_deg: float) -> None:
    x, y = (FEET[0] + FEET[5])[:2] / np.hypot(*(FEET[0] + FEET[5])[:2])
    found = heaving_feet(exp_so3(np.radians(angle_deg) * np.array([y, -x, 0.0])), np.eye(4))
    assert found.sum() == (angle_deg < -1.0)
    assert not found[~COMING].any()


@pytest.mark.parametrize("slipped", [0.0, 0.05, -0.08])
def test_gyro_corrects_heading_lost_by_slipping_feet(slipped: float) -> None:
    """Check that the gyro corrects heading: the body turns 0.5 rad, the legs see less."""
    plumb, now_ns = alignment_at_rest(np.eye(3))
    T, steps = from_xyz_rpy((1.0, 2.0, 0.1), np.zeros(3)), 100
    for i in range(300):
        rate = 0.5 / steps if i < steps else 0.0
        now_ns += 20 * MS
        plumb.take(Imu(now_ns, np.array([0.0, 0.0, rate / 0.02]), G), now_ns)
        seen = rate * (1.0 - slipped / 0.5)
        T = transform(T[:3, :3] @ exp_so3(np.array([0.0, 0.0, seen])), T[:3, 3])
        turn = plumb.turn(T, now_ns, 0.02, step=1)
        T = T if turn is None else turn @ T
    assert yaw_of(T) == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(T[:3, 3], (1.0, 2.0, 0.1), atol=1e-9)


@pytest.mark.parametrize("yaw", [0.15, 1.2])
def test_restarted_leg_odometry_causes_no_heading_correction(yaw: float) -> None:
    plumb, now_ns = alignment_at_rest(np.eye(3))
    plumb.turn(from_xyz_rpy(np.zeros(3), (0.0, 0.0, yaw)), now_ns, 0.02, step=1)
    plumb.restart()
    assert plumb.turn(np.eye(4), now_ns, 0.02, step=1) is None
    assert plumb.turn(np.eye(4), now_ns, 0.02, step=1) is None


def odom_turns_while_gyro_spins(
    plumb: GravityAlignment, now_ns: int, rate: float, step: int | None, cycles: int
) -> tuple[list[float], int]:
    """Return the turn [rad] of {odom} in each cycle, and the time [ns].

    The gyro reports `rate` [rad/s] and the legs do not turn.
    """
    turned = []
    for _ in range(cycles):
        now_ns += 20 * MS
        plumb.take(Imu(now_ns, np.array([0.0, 0.0, rate]), G), now_ns)
        turn = plumb.turn(np.eye(4), now_ns, 0.02, step)
        turned.append(0.0 if turn is None else yaw_of(turn))
    return turned, now_ns


@WILD
@given(st.floats(-4.0, 4.0), st.integers(1, 200))
def test_heading_correction_is_limited_in_rate_and_total(rate: float, cycles: int) -> None:
    """Check the limits of the correction for legs that do not see the turn.

    The correction is limited in rate and in total, and is zero at rest.
    """
    plumb, now_ns = alignment_at_rest(np.eye(3))
    at_rest, now_ns = odom_turns_while_gyro_spins(plumb, now_ns, rate, None, cycles)
    assert not np.any(at_rest)
    in_step, now_ns = odom_turns_while_gyro_spins(plumb, now_ns, rate, 1, cycles)
    assert np.abs(in_step).max() <= np.radians(3.0) * 0.02 + 1e-12
    assert abs(sum(in_step)) <= np.radians(5.0) + 1e-9


def test_inconsistent_gyro_heading_is_ignored_until_next_step() -> None:
    plumb, now_ns = alignment_at_rest(np.eye(3))
    _, now_ns = odom_turns_while_gyro_spins(plumb, now_ns, 1.0, 1, 50)
    assert "the legs' heading is used" in plumb.problem(now_ns)
    left, now_ns = odom_turns_while_gyro_spins(plumb, now_ns, 0.0, 1, 50)
    assert not np.any(left)
    following, now_ns = odom_turns_while_gyro_spins(plumb, now_ns, 0.02, 2, 50)
    assert np.all(following)
    assert plumb.problem(now_ns) == ""


@pytest.mark.slow
@WILD
@given(st.floats(0.25, 0.34), st.floats(-3.0, 3.0))
def test_levelling_stops_at_12_deg_and_is_reported(angle: float, way: float) -> None:
    """Check the 12 deg limit: the legs move the body back by their own odometry.

    The legs do so in the air too, and the sensor does not see the motion.
    """
    plumb, now_ns = alignment_at_rest(exp_so3(angle * np.array([np.cos(way), np.sin(way), 0.0])))
    total = np.eye(3)
    for _ in range(1000):
        turn = plumb.turn(np.eye(4), now_ns, 0.02)
        total = total if turn is None else turn[:3, :3] @ total
    assert np.radians(11.5) < np.arccos(total[2, 2]) <= np.radians(12.0) + 1e-9
    assert plumb.turn(np.eye(4), now_ns, 0.02) is None
    assert "more than the 12 deg" in plumb.problem(now_ns)
    righted, later_ns = alignment_at_rest(np.eye(3))
    plumb._attitude, leaning = righted.attitude(later_ns), from_xyz_rpy(np.zeros(3), (0.1, 0.0, 0.0))
    leaning[:3, :3] = total
    assert plumb.turn(leaning, now_ns, 0.02) is not None, "back is always a way"
    assert plumb.problem(now_ns) == ""


def test_levelling_is_not_taken_for_heaving() -> None:
    """Check that {odom}, wrong by some degrees, may turn while feet come down.

    The body does not move.
    """
    plumb, now_ns = alignment_at_rest(np.eye(3))
    T = from_xyz_rpy(np.zeros(3), (0.15, 0.1, 0.0))
    plumb.lifts_body(T, FEET, np.zeros(6, dtype=bool), now_ns)
    for _ in range(300):
        turn = plumb.turn(T, now_ns, 0.02, step=1)
        T = T if turn is None else turn @ T
        assert not plumb.lifts_body(T, FEET, COMING, now_ns).any()
    assert lean(T) < np.radians(3.0)


def test_vertical_gyro_bias_requires_sustained_standstill() -> None:
    plumb, bias = GravityAlignment(), np.array([0.0, 0.0, 0.004])
    for i in range(600):
        plumb.take(Imu(i * 20 * MS, bias, G), i * 20 * MS, still=i % 40 != 0)
    assert plumb._estimator.bias[2] == 0.0
    for i in range(600, 1000):
        plumb.take(Imu(i * 20 * MS, bias, G), i * 20 * MS, still=True)
    assert plumb._estimator.bias[2] == pytest.approx(0.004, abs=1e-4)


def test_walk_waits_for_the_bias_of_a_robot_that_stands() -> None:
    plumb, bias = GravityAlignment(), np.array([0.0, 0.0, 0.004])
    assert plumb.waiting_reason(0) == "", "a robot without a sensor does not wait"
    waits = []
    for i in range(150):
        plumb.take(Imu(i * 20 * MS, bias, G), i * 20 * MS, still=True)
        waits.append(plumb.waiting_reason(i * 20 * MS))
    assert "must stand still for 2 s" in waits[98]
    assert waits[102:] == [""] * 48
    assert plumb._estimator.bias[2] == pytest.approx(0.004, abs=1e-9)


def test_walk_does_not_wait_for_ever_on_ground_that_moves() -> None:
    plumb = GravityAlignment()
    waits = []
    for i in range(300):
        plumb.take(Imu(i * 20 * MS, np.array([0.0, 0.0, 0.1 * (-1) ** i]), G), i * 20 * MS, still=True)
        waits.append(plumb.waiting_reason(i * 20 * MS) != "")
    assert waits[100]
    assert not any(waits[252:])


@pytest.mark.parametrize("gap_ns", [150 * MS, 5_000 * MS, -5_000 * MS])
def test_reading_after_a_gap_gives_no_gyro_bias(gap_ns: int) -> None:
    """Check that one reading after a gap gives no bias.

    A robot that stood before may turn now. A clock that jumps is a gap, too.
    """
    plumb, noisy = GravityAlignment(), np.array([0.015, -0.015, 0.015])
    for i in range(600):
        plumb.take(Imu(i * 20 * MS, np.zeros(3), G), i * 20 * MS, still=True)
    now_ns = 600 * 20 * MS + gap_ns
    for i in range(40):
        plumb.take(Imu(now_ns + i * 20 * MS, noisy, G), now_ns + i * 20 * MS, still=True)
    assert plumb._estimator.bias[2] == 0.0
    assert np.abs(plumb._estimator.bias).max() < 1e-3


@pytest.mark.parametrize(("unit", "believed"), [(1.0, True), (180.0 / np.pi, False)])
def test_gyro_in_degrees_per_second_is_ignored_and_reported(unit: float, believed: bool) -> None:
    """Rock a body by two degrees while it turns slowly."""
    plumb, R, trusted, amplitude, beat = GravityAlignment(), np.eye(3), [], np.radians(2.0), 2.0 * np.pi
    for i in range(1500):
        now_ns, t = i * 10 * MS, i * 0.01
        rate = np.array([amplitude * beat * np.cos(beat * t), 0.0, 0.1])
        R = R @ exp_so3(0.01 * rate) if i else R
        plumb.take(Imu(now_ns, unit * rate, R.T @ G), now_ns)
        trusted.append(plumb.attitude(now_ns) is not None)
        assert believed or i < 800 or "rad/s" in plumb.problem(now_ns)
    assert all(trusted[800:]) if believed else not any(trusted[800:])
    assert not believed or plumb.problem(now_ns) == ""


@pytest.mark.parametrize("length", [150.0, 1e19, 1.2e154, 1e200, 1e308])
@pytest.mark.parametrize("of", ["gyro", "force"])
def test_readings_beyond_sensor_range_are_ignored_and_reported(length: float, of: str) -> None:
    plumb, now_ns = alignment_at_rest(np.eye(3))
    before = plumb.attitude(now_ns)
    gyro, force = (np.full(3, length), G) if of == "gyro" else (np.zeros(3), np.full(3, 20.0 * min(length, 1e306)))
    plumb.take(Imu(now_ns + MS, gyro, force), now_ns + MS)
    assert plumb.attitude(now_ns + MS) is before
    assert "exceed the range of any sensor" in plumb.problem(now_ns + MS)
    later_ns = now_ns + 1001 * MS
    plumb.take(Imu(later_ns, np.zeros(3), G), later_ns)
    assert "exceed the range of any sensor" not in plumb.problem(later_ns + MS)
