"""The servos around the joint: controller, overload, heat, and battery.

The limits of overload, heat and battery must not be relaxed.
"""

import math
from dataclasses import asdict, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.simulator.servo_bus.motors import AX_12A_MOTOR, MOTOR_AND_SUPPLY, RX_64_MOTOR, RX_64_SUPPLY, Supply
from sextant.services.simulator.servo_bus.servo_bank import ServoBank, ServoCommand, make_servo_bank
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo import models
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.protection import Protection
from sextant.shared.servo.servo_model import Register, ServoError

DT = 0.01
AX_12A, RX_64 = (load_profile(name).servo for name in ("phantomx_mk2", "lotriet_rx64"))
OVERLOAD, HOT = int(ServoError.OVERLOAD), int(ServoError.OVERHEATING)


def write_register(bank: ServoBank, register: Register, value: int, rows: range | None = None) -> None:
    for row in rows or range(len(bank)):
        bank.write(row, register.address, register.encode(value))


def read_register(bank: ServoBank, register: Register, row: int = 0) -> int:
    return int.from_bytes(bank.read(row, register.address, register.size), "little")


def step(bank: ServoBank, q: float = 0.0, torque: float = 0.0, dt: float = DT) -> ServoCommand:
    n = len(bank)
    return bank.step(np.full(n, q), np.zeros(n), np.full(n, torque), dt)


def powered(n: int = 1, **kwargs: object) -> ServoBank:
    bank = ServoBank(range(1, n + 1), **kwargs)  # type: ignore[arg-type]
    write_register(bank, dxl.TORQUE_ENABLE, 1)
    return bank


def run_until(bank: ServoBank, torque: float, error: int, limit_s: float, dt: float = DT) -> float:
    """Return the time [s] of a held torque until the error bit appears."""
    for k in range(1, round(limit_s / dt) + 1):
        step(bank, torque=torque, dt=dt)
        if bank.error(0) & error:
            return k * dt
    return math.inf


# ------------------------------------------------------------------------------------- constants: not to be relaxed


def test_motor_protection_and_battery_constants() -> None:
    assert asdict(AX_12A_MOTOR) == {"stall_torque": 1.5, "stall_current": 1.5, "standby_current": 0.05}
    assert asdict(Protection()) == {
        "stall_duty": 0.95,
        "stall_time": 1.5,
        "mean_duty": 0.8,
        "mean_time": 10.0,
        "ambient": 25.0,
        "cooling_time": 400.0,
        "heating": 1.01,
    }
    assert asdict(Supply()) == {
        "full_voltage": 12.6,
        "empty_voltage": 9.9,
        "capacity_ah": 4.0,
        "resistance": 0.04,
        "computer_current": 1.0,
    }
    bank = ServoBank([1])
    assert bank.protection == Protection()
    assert bank.supply == Supply()
    assert bank.motor == AX_12A_MOTOR
    assert read_register(bank, dxl.TEMPERATURE_LIMIT) == 70
    assert read_register(bank, dxl.SHUTDOWN) == 0x24


@pytest.mark.parametrize(("torque", "seconds"), [(0.9, 150.0), (1.2, 76.0)])
def test_overheating_shutdown_time_at_constant_torque(torque: float, seconds: float) -> None:
    bank = powered()
    assert run_until(bank, torque, HOT, 400.0, dt=0.05) == pytest.approx(seconds, rel=0.02)
    assert Protection().time_to_reach(70.0, torque / AX_12A_MOTOR.stall_torque) == pytest.approx(seconds, rel=0.02)
    assert read_register(bank, dxl.TORQUE_LIMIT) == 0


def test_continuous_torque_limit_is_one_third_of_stall() -> None:
    bank = powered()
    assert run_until(bank, 0.5, HOT, 4000.0, dt=0.5) == math.inf
    assert 69.5 < bank.temperature[0] < 70.0
    assert read_register(bank, dxl.PRESENT_TEMPERATURE) == 70
    assert run_until(powered(), 0.52, HOT, 4000.0, dt=0.5) < 2000.0


def test_heating_follows_rms_torque() -> None:
    steady, pulsed = powered(), powered()
    for k in range(2000):
        step(steady, torque=0.5, dt=0.05)
        step(pulsed, torque=math.sqrt(0.5) if k % 2 else 0.0, dt=0.05)
    assert pulsed.temperature[0] == pytest.approx(steady.temperature[0], abs=0.1)


@pytest.mark.parametrize("dt", [0.001, 0.002, 0.01])
def test_stall_latches_overload_after_1_5_s(dt: float) -> None:
    assert run_until(powered(), 0.95 * 1.5, OVERLOAD, 3.0, dt) == pytest.approx(1.5, abs=1.5 * dt)


def test_interrupted_stall_does_not_latch_overload() -> None:
    bank = powered()
    for _ in range(4):
        assert run_until(bank, 1.45, OVERLOAD, 1.4) == math.inf
        step(bank, torque=0.0, dt=0.6)


@pytest.mark.parametrize("dt", [0.002, 0.01])
def test_mean_duty_over_10_s_latches_overload(dt: float) -> None:
    assert run_until(powered(), 0.9 * 1.5, OVERLOAD, 12.0, dt) == pytest.approx(10.0 * 0.8 / 0.9, abs=0.11)
    assert run_until(powered(), 0.79 * 1.5, OVERLOAD, 30.0, dt) == math.inf


def test_mean_duty_window_is_10_s() -> None:
    bank = powered()
    assert run_until(bank, 0.94 * 1.5, OVERLOAD, 8.0) == math.inf
    assert run_until(bank, 0.0, OVERLOAD, 10.2) == math.inf
    assert run_until(bank, 0.94 * 1.5, OVERLOAD, 10.0) == pytest.approx(8.51, abs=0.12)


def test_battery_current_voltage_and_charge() -> None:
    bank = ServoBank(range(1, 19))
    step(bank, torque=0.0)
    assert bank.current == pytest.approx(1.0 + 18 * 0.05)
    step(bank, torque=-0.75)
    assert bank.current == pytest.approx(1.0 + 18 * (0.05 + 1.5 * 0.5))
    assert bank.voltage == pytest.approx(12.6 - 0.04 * bank.current, abs=1e-3)
    step(bank, torque=0.0, dt=4.0 * 3600 / 1.9 / 2)  # half of 4 A h
    assert bank.voltage == pytest.approx((12.6 + 9.9) / 2 - 0.04 * 1.9, abs=2e-3)
    step(bank, torque=0.0, dt=4.0 * 3600)
    assert bank.charge == 0.0
    assert bank.voltage == pytest.approx(9.9 - 0.04 * 1.9)
    assert read_register(bank, dxl.PRESENT_VOLTAGE, 17) == 98


def test_battery_life_scales_with_capacity_and_converter_never_drains() -> None:
    small, large = (make_servo_bank(AX_12A, range(1, 19), np.zeros(18), ah) for ah in (4.0, 8.0))
    for bank in (small, large):
        step(bank, torque=0.0, dt=4.0 * 3600 / 1.9)
    assert (small.charge, large.charge) == (pytest.approx(0.0), pytest.approx(0.5))
    converter = make_servo_bank(RX_64, range(1, 19), np.zeros(18), 0.1)
    step(converter, torque=0.0, dt=3600.0)
    assert converter.voltage == pytest.approx(14.8, abs=0.1)


def test_low_voltage_sets_error_bit_by_limit_of_each_servo() -> None:
    bank = ServoBank([1, 2], charge=0.0)
    step(bank)
    write_register(bank, dxl.MIN_VOLTAGE, 110, range(1))
    assert bank.error(0) == ServoError.INPUT_VOLTAGE
    assert bank.error(1) == 0


# ----------------------------------------------------------------------------------------------------- shutdown


def test_shutdown_disables_torque_until_torque_limit_is_written() -> None:
    bank = powered(2)
    write_register(bank, dxl.GOAL_POSITION, 600)
    assert step(bank).torque_limit.tolist() == [1.5, 1.5]
    for _ in range(160):
        bank.step(np.zeros(2), np.zeros(2), np.array([1.5, 0.1]), DT)
    assert [bank.error(0), bank.error(1)] == [OVERLOAD, 0]
    assert [read_register(bank, dxl.TORQUE_LIMIT, row) for row in (0, 1)] == [0, 1023]
    assert step(bank).torque_limit.tolist() == [0.0, 1.5]
    write_register(bank, dxl.GOAL_POSITION, 300)
    write_register(bank, dxl.TORQUE_ENABLE, 1)
    assert step(bank).torque_limit.tolist() == [0.0, 1.5]
    assert bank.error(0) == OVERLOAD
    write_register(bank, dxl.TORQUE_LIMIT, 1023)
    assert step(bank).torque_limit.tolist() == [1.5, 1.5]
    assert bank.error(0) == 0


def test_writing_torque_limit_does_not_reset_overheated_servo() -> None:
    bank = powered(temperature=75.0)
    assert step(bank).torque_limit[0] == 0.0
    assert bank.error(0) == HOT
    write_register(bank, dxl.TORQUE_LIMIT, 1023)
    assert step(bank).torque_limit[0] == 0.0  # not for one step
    assert bank.error(0) == HOT


def test_shutdown_register_selects_shutdown_causes() -> None:
    bank = powered(temperature=75.0)
    write_register(bank, dxl.SHUTDOWN, OVERLOAD)
    assert step(bank).torque_limit[0] == 1.5
    assert bank.error(0) == HOT


# --------------------------------------------------------------------------------------------------- the controller


@pytest.mark.parametrize(("slope", "stiffness"), [(32, 9.2), (16, 18.3), (128, 2.29), (63, 9.2), (2, 147.0), (1, 147.0)])
def test_stiffness_follows_compliance_slope(slope: int, stiffness: float) -> None:
    bank = powered()
    write_register(bank, dxl.CW_COMPLIANCE_SLOPE, slope)
    write_register(bank, dxl.CCW_COMPLIANCE_SLOPE, slope)
    assert step(bank).stiffness[0] == pytest.approx(stiffness, rel=0.01)


def test_rx_64_stiffness_and_supply_match_14_8_v() -> None:
    bank = powered(3, model=models.RX_64, motor=RX_64_MOTOR, supply=RX_64_SUPPLY)
    command = step(bank)
    stall_torque = 5.3 * 14.8 / 18.5
    np.testing.assert_allclose(command.stiffness, stall_torque / (32 * dxl.TICK_RAD), rtol=1e-3)
    np.testing.assert_allclose(command.torque_limit, stall_torque)
    for torque in (0.0, 4.0):  # the voltage is within the servo's own limits under load too
        step(bank, torque=torque)
        assert bank.error(0) == 0


@pytest.mark.parametrize("name", profile_names())
def test_profile_matches_servo_model_and_supply(name: str) -> None:
    """Match the voltage under load with the profile.

    With a mismatch, the voltage falls below the profile's limit for an empty battery. The robot then lies down while it stands
    up.
    """
    profile = load_profile(name)
    bank = make_servo_bank(profile.servo, tuple(profile.servo_ids.ravel().tolist()), np.zeros(18))
    assert bank.motor.stall_torque == pytest.approx(profile.servo.stall_torque)
    write_register(bank, dxl.TORQUE_ENABLE, 1)
    assert step(bank).stiffness[0] == pytest.approx(profile.servo.stiffness, rel=0.01)
    step(bank, torque=profile.servo.stall_torque / 3.0)  # of all servos at once: more than a walk takes
    assert bank.voltage > profile.battery.warn_voltage
    step(bank, torque=0.6 * profile.servo.stall_torque)
    assert bank.voltage > profile.battery.empty_voltage
    assert bank.error(0) == 0


@pytest.mark.parametrize(("torque", "stiffness"), [(3.4, 18.0), (5.3, 32.0), (1.2, 9.0)])
def test_simulated_servos_have_torque_and_stiffness_of_profile(torque: float, stiffness: float) -> None:
    """Simulate the servos at the voltage of the robot, not of the data sheet.

    The actuator converts loads with the profile's stall torque. If the simulator has another one, swinging feet seem to touch.
    """
    servo = replace(RX_64, stall_torque=torque, stiffness=stiffness)
    bank = make_servo_bank(servo, [1, 2], np.zeros(2))
    for row in range(2):
        bank.write(row, dxl.TORQUE_ENABLE.address, b"\x01")
    command = step(bank)
    np.testing.assert_allclose(command.stiffness, stiffness)
    np.testing.assert_allclose(command.torque_limit, torque)
    step(bank, torque=0.5)
    assert read_register(bank, dxl.PRESENT_LOAD) * dxl.LOAD_UNIT * servo.stall_torque == pytest.approx(0.5, abs=0.005)
    resting = bank.current
    step(bank, torque=0.0)
    assert resting - bank.current == pytest.approx(2 * 0.5 * RX_64_MOTOR.stall_current / RX_64_MOTOR.stall_torque)


def test_every_servo_model_is_emulated() -> None:
    assert set(MOTOR_AND_SUPPLY) == set(MODEL_NAMED)


def test_rx_64_shuts_down_at_same_duty_as_ax_12a() -> None:
    """Shut down by duty: the limit is the same share of 4.24 N m and of 1.5 N m.

    Heat trips later, since its limit is 80 deg C.
    """
    bank = powered(model=models.RX_64, motor=RX_64_MOTOR, supply=RX_64_SUPPLY)
    assert run_until(bank, 4.24, ServoError.OVERLOAD, 3.0) == pytest.approx(1.5, abs=2 * DT)
    lasting = {
        name: run_until(powered(model=model, motor=motor), 0.6 * motor.stall_torque, ServoError.OVERHEATING, 300.0, 0.05)
        for name, model, motor in (("AX-12A", models.AX_12A, AX_12A_MOTOR), ("RX-64", models.RX_64, RX_64_MOTOR))
    }
    assert 140.0 < lasting["AX-12A"] < lasting["RX-64"] < 300.0


def test_each_direction_has_its_own_compliance() -> None:
    bank = powered()
    write_register(bank, dxl.CCW_COMPLIANCE_SLOPE, 16)
    write_register(bank, dxl.CCW_COMPLIANCE_MARGIN, 4)
    write_register(bank, dxl.GOAL_POSITION, 612)
    up = step(bank)
    assert up.stiffness[0] == pytest.approx(18.3, rel=0.01)
    assert up.setpoint[0] == pytest.approx(96 * dxl.TICK_RAD)
    write_register(bank, dxl.GOAL_POSITION, 412)
    down = step(bank)
    assert down.stiffness[0] == pytest.approx(9.2, rel=0.01)
    assert down.setpoint[0] == pytest.approx(-99 * dxl.TICK_RAD)


@pytest.mark.parametrize("margin", [0, 1, 5])
def test_no_torque_inside_the_margin_and_no_jump_at_its_edge(margin: int) -> None:
    bank = powered()
    write_register(bank, dxl.CW_COMPLIANCE_MARGIN, margin)
    write_register(bank, dxl.CCW_COMPLIANCE_MARGIN, margin)
    q = np.linspace(-10, 10, 201) * dxl.TICK_RAD
    torque = []
    for angle in q:
        out = step(bank, q=float(angle))
        torque.append(float(out.stiffness[0] * (out.setpoint[0] - angle)))
    inside = np.abs(q) <= margin * dxl.TICK_RAD
    assert np.allclose(np.array(torque)[inside], 0.0, atol=1e-12)
    assert np.max(np.abs(np.diff(torque))) <= 9.2 * 0.1 * dxl.TICK_RAD
    assert np.all(np.array(torque)[~inside] * q[~inside] < 0.0)


def test_torque_limit_is_the_lesser_of_both_registers() -> None:
    bank = powered()
    write_register(bank, dxl.TORQUE_LIMIT, 512)
    assert step(bank).torque_limit[0] == pytest.approx(1.5 * 512 / 1023)
    write_register(bank, dxl.MAX_TORQUE, 256)
    assert step(bank).torque_limit[0] == pytest.approx(1.5 * 256 / 1023)
    write_register(bank, dxl.TORQUE_ENABLE, 0)
    assert step(bank).torque_limit[0] == 0.0


def test_goal_write_does_not_enable_torque() -> None:
    bank = ServoBank([1])
    write_register(bank, dxl.GOAL_POSITION, 700)
    assert step(bank).torque_limit[0] == 0.0
    assert read_register(bank, dxl.TORQUE_ENABLE) == 0


@pytest.mark.parametrize("q", [-1.0, 0.3])
def test_torque_enable_sets_goal_to_present_position(q: float) -> None:
    bank = ServoBank([1])
    write_register(bank, dxl.GOAL_POSITION, 900)
    step(bank, q=q)
    write_register(bank, dxl.TORQUE_ENABLE, 1)
    assert read_register(bank, dxl.GOAL_POSITION) == dxl.ticks_from_angle(q)
    assert step(bank, q=q).setpoint[0] == pytest.approx(q, abs=dxl.TICK_RAD)


def test_torque_can_be_enabled_before_first_step() -> None:
    bank = ServoBank([1], q=np.array([0.5]))
    write_register(bank, dxl.TORQUE_ENABLE, 1)
    assert step(bank, q=0.5).setpoint[0] == pytest.approx(0.5, abs=dxl.TICK_RAD)


def test_moving_speed_ramps_the_setpoint() -> None:
    bank = powered()
    write_register(bank, dxl.CW_COMPLIANCE_MARGIN, 0)
    write_register(bank, dxl.CCW_COMPLIANCE_MARGIN, 0)
    write_register(bank, dxl.MOVING_SPEED, 100)
    write_register(bank, dxl.GOAL_POSITION, 612)
    speed = 100 * 0.111 * 2 * math.pi / 60
    setpoints = [step(bank).setpoint[0] for _ in range(100)]
    assert setpoints[9] == pytest.approx(10 * DT * speed)
    assert read_register(bank, dxl.MOVING) == 0  # it arrived long ago
    assert setpoints[-1] == pytest.approx(100 * dxl.TICK_RAD)
    assert np.max(np.diff(setpoints)) <= DT * speed + 1e-12
    write_register(bank, dxl.MOVING_SPEED, 0)
    write_register(bank, dxl.GOAL_POSITION, 412)
    assert step(bank).setpoint[0] == pytest.approx(-100 * dxl.TICK_RAD)


def test_speed_ramp_starts_at_joint_position_after_torque_returns() -> None:
    bank = powered()
    write_register(bank, dxl.MOVING_SPEED, 10)
    write_register(bank, dxl.TORQUE_LIMIT, 0)
    step(bank, q=-0.8)
    write_register(bank, dxl.TORQUE_LIMIT, 1023)
    assert step(bank, q=-0.8).setpoint[0] == pytest.approx(-0.8, abs=0.01)
    assert read_register(bank, dxl.MOVING) == 1


def test_wheel_mode_has_no_torque() -> None:
    bank = powered()
    write_register(bank, dxl.CCW_ANGLE_LIMIT, 0)
    assert step(bank).torque_limit[0] == 0.0


def test_present_registers_show_the_last_step() -> None:
    bank = ServoBank([1, 2])
    q: NDArray[np.float64] = np.array([0.5, -2.7])
    bank.step(q, np.array([1.0, -2.0]), np.array([0.3, -0.6]), DT)
    q[:] = 0.0  # the caller may reuse its arrays
    assert read_register(bank, dxl.PRESENT_POSITION, 0) == dxl.ticks_from_angle(0.5)
    assert read_register(bank, dxl.PRESENT_POSITION, 1) == 0  # beyond the potentiometer
    assert dxl.speed_from_register(read_register(bank, dxl.PRESENT_SPEED, 1)) == pytest.approx(-2.0, abs=0.01)
    assert dxl.load_from_register(read_register(bank, dxl.PRESENT_LOAD, 0)) == pytest.approx(0.2, abs=0.001)
    assert dxl.load_from_register(read_register(bank, dxl.PRESENT_LOAD, 1)) == pytest.approx(-0.4, abs=0.001)
    assert read_register(bank, dxl.PRESENT_VOLTAGE, 0) == read_register(bank, dxl.PRESENT_VOLTAGE, 1) == 125
    assert read_register(bank, dxl.PRESENT_TEMPERATURE, 0) == 25


def test_present_registers_are_extrapolated_between_steps() -> None:
    """Extrapolate a servo that turns at 4 rad/s towards its goal, for 6 ms at most.

    Its torque decreases on the way.
    """
    bank, at_ns, speed = powered(), 1_000_000_000, 4.0
    write_register(bank, dxl.GOAL_POSITION, dxl.ticks_from_angle(0.12))
    spring = step(bank).stiffness[0]
    goal = step(bank).setpoint[0]
    bank.set_joint_state(
        np.zeros(1), np.array([speed]), np.array([spring * goal + 0.1]), at_ns
    )  # the state at the beginning of the step

    def measured(after_ms: float) -> tuple[float, float, float]:
        table = bank.read(0, dxl.PRESENT_POSITION.address, 6, at_ns + round(after_ms * 1e6))
        position, speed, load = (int.from_bytes(table[i : i + 2], "little") for i in (0, 2, 4))
        return dxl.angle_from_ticks(position), dxl.speed_from_register(speed), dxl.load_from_register(load)

    for after_ms in (0.0, -3.0, 2.0, 4.0):
        q, qd, load = measured(after_ms)
        assert q == pytest.approx(speed * after_ms * 1e-3, abs=dxl.TICK_RAD / 2)
        assert qd == pytest.approx(speed, abs=0.01)
        assert load * AX_12A_MOTOR.stall_torque == pytest.approx(spring * (goal - speed * after_ms * 1e-3), abs=0.002)
    assert measured(1000.0) == measured(6.0)
    assert measured(-1000.0) == measured(-6.0)
    assert read_register(bank, dxl.PRESENT_POSITION) == dxl.ticks_from_angle(0.0), "who names no time sees the step"


def test_servo_without_torque_shows_no_load_between_steps() -> None:
    bank = ServoBank([1])
    step(bank)
    bank.set_joint_state(np.zeros(1), np.ones(1), np.zeros(1), 0)
    assert bank.read(0, dxl.PRESENT_LOAD.address, 2, 4_000_000) == bytes(2)


@pytest.mark.parametrize("ids", [[1, 1], [254], [-1]])
def test_ids_must_be_valid_and_different(ids: list[int]) -> None:
    with pytest.raises(ValueError, match="each once"):
        ServoBank(ids)
