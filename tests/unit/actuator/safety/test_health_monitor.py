"""Health monitor: silent servos, resets, and conditions that make the robot sit."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sextant.services.actuator.safety.health_monitor import SILENT, Health, Verdict, Vitals
from sextant.shared.robot.profile import JOINTS, LEGS, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo.servo_model import ServoError
from tests.support.families import robot_with

PROFILE = load_profile("phantomx_mk2")
PERIOD = 0.02
LIMIT = PROFILE.servo.temperature_limit
EMPTY, WARN = PROFILE.battery.empty_voltage, PROFILE.battery.warn_voltage
STALL = PROFILE.servo.stall_torque
WELL = Vitals(
    missed=np.zeros(18, dtype=np.int64),
    newest=0.0,
    load=np.zeros(18),
    voltage=np.full(18, 11.5),
    temperature=np.full(18, 30.0),
    errors=np.zeros(18, dtype=np.uint8),
    strength=np.ones(18),
    torque_disabled=np.zeros(18, dtype=np.bool_),
    behind=np.zeros(18, dtype=np.bool_),
    loss=0.0,
    trouble="",
)
WILD = settings(deadline=None, derandomize=True, max_examples=15)
servos = st.integers(0, 17)


class Patient:
    """Servos with prescribed vitals, cycle after cycle."""

    def __init__(self, profile: RobotProfile = PROFILE) -> None:
        self.health, self.now, self.verdict = Health(profile, PERIOD), 100.0, Verdict()

    def cycle(self, vitals: Vitals = WELL, torque: bool = True, dt: float = PERIOD) -> Verdict:
        self.now += dt
        self.verdict = self.health.update(self.now, dt, vitals, torque)
        return self.verdict

    def live(self, seconds: float, vitals: Vitals = WELL, torque: bool = True) -> list[Verdict]:
        return [self.cycle(vitals, torque) for _ in range(round(seconds / PERIOD))]


def one(servo: int, **changes: Any) -> Vitals:
    """Return vitals that are normal except for the given fields of one servo."""
    made = {}
    for name, value in changes.items():
        made[name] = getattr(WELL, name).copy()
        made[name][servo] = value
    return replace(WELL, **made)


def name(servo: int) -> str:
    leg, joint = divmod(servo, 3)
    return f"the {JOINTS[joint]} servo of the {LEGS[leg]} leg (id {PROFILE.servo_ids[leg, joint]})"


def test_healthy_servos_give_empty_verdict() -> None:
    patient = Patient()
    assert set(patient.live(2.0)) == {Verdict()}
    assert set(patient.live(2.0, torque=False)) == {Verdict()}


def test_missing_readings_give_empty_verdict() -> None:
    unknown = replace(WELL, voltage=np.full(18, np.nan), temperature=np.full(18, np.nan))
    patient = Patient()
    assert set(patient.live(1.0, unknown)) == {Verdict()}
    assert patient.cycle() == Verdict()
    some = one(4, voltage=np.nan, temperature=np.nan)
    assert patient.cycle(some) == Verdict()


@pytest.mark.parametrize("servo", range(18))
def test_reduced_torque_limit_is_fault_only_with_torque_on(servo: int) -> None:
    words = f"{name(servo)} has only 30% of its torque; order `ready` to restore it"
    verdict = Patient().cycle(one(servo, strength=0.3))
    assert (verdict.broken, verdict.warnings) == (words, (words,))
    torque_disabled = Patient().cycle(one(servo, strength=0.3), torque=False)
    assert (torque_disabled.broken, torque_disabled.warnings) == ("", (words,))


# ------------------------------------------------------------------------------------------------------------- silence


@pytest.mark.parametrize("servo", range(18))
def test_a_silent_servo_is_named_by_leg_joint_and_id(servo: int) -> None:
    patient = Patient()
    assert patient.cycle(one(servo, missed=SILENT - 1)).broken == ""
    broken = patient.cycle(one(servo, missed=SILENT)).broken
    assert broken == f"{name(servo)} does not answer; check its cable and the cables before it"
    assert patient.cycle().broken == ""


def test_fault_names_first_silent_servo_and_counts_others() -> None:
    missed = WELL.missed.copy()
    missed[[3, 7, 8]] = SILENT
    assert f"{name(3)}, with 2 more, does not answer" in Patient().cycle(replace(WELL, missed=missed)).broken


def test_silent_bus_is_reported_after_timeout_of_all_servos() -> None:
    silent = replace(WELL, missed=np.full(18, SILENT), newest=0.15)
    assert Patient().cycle(silent).broken == "no servo answers; check the power of the bus, its cable and the adapter"
    assert Patient().cycle(replace(silent, newest=np.inf)).broken.startswith("no servo answers")
    assert "with 17 more" in Patient().cycle(replace(silent, newest=0.10)).broken
    assert Patient().cycle(replace(WELL, newest=np.inf)).broken == "", "no servo has enough requests"


def test_packet_loss_above_30_percent_is_a_fault() -> None:
    assert Patient().cycle(replace(WELL, loss=0.30)).broken == ""
    words = "more than 30% of the servos' answers are lost or broken; check cables, plugs and the bus voltage"
    assert Patient().cycle(replace(WELL, loss=0.31)).broken == words


def test_port_trouble_takes_precedence_over_silent_servos() -> None:
    gone = replace(WELL, trouble="the port is gone", missed=np.full(18, SILENT), newest=np.inf)
    assert Patient().cycle(gone).broken == "the port is gone"


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 8)), min_size=1, max_size=12))
@WILD
def test_five_consecutive_late_cycles_are_a_fault(runs: list[tuple[bool, int]]) -> None:
    patient, row = Patient(), 0
    for slow in (slow for slow, cycles in runs for _ in range(cycles)):
        row = row + 1 if slow else 0
        broken = patient.cycle(dt=1.6 * PERIOD if slow else 1.5 * PERIOD).broken
        assert (broken != "") == (row >= 5)
        assert broken == "" or broken == f"the computer is too slow: {row} cycles in a row took more than 30 ms"


@pytest.mark.parametrize("gap_s", [0.21, 3.5])
def test_process_pause_above_200_ms_is_a_fault(gap_s: float) -> None:
    assert Patient().cycle(dt=0.2).broken == ""
    patient = Patient()
    assert patient.cycle(dt=gap_s).broken == f"the actuator process did not run for {gap_s:.1f} s"
    assert patient.cycle().broken == ""


@pytest.mark.parametrize("servo", [0, 4, 17])
def test_servo_catching_up_is_a_fault(servo: int) -> None:
    assert Patient().cycle(one(servo, behind=True)).broken == f"{name(servo)} is catching up with its goal, slowly"


@pytest.mark.parametrize("servo", [0, 4, 17])
def test_lost_torque_is_a_fault_only_if_torque_is_ordered_on(servo: int) -> None:
    torque_disabled = one(servo, torque_disabled=True)
    assert Patient().cycle(torque_disabled).broken == f"{name(servo)} has lost its torque; order `ready` to turn it on again"
    assert Patient().cycle(torque_disabled, torque=False).broken == ""


def test_servo_errors_are_named_except_input_voltage() -> None:
    odd = one(5, errors=int(ServoError.ANGLE_LIMIT | ServoError.INPUT_VOLTAGE))
    assert Patient().cycle(odd).broken == f"{name(5)} reports: goal outside the angle limits"
    assert Patient().cycle(one(5, errors=int(ServoError.INPUT_VOLTAGE))) == Verdict()
    broken = Patient().cycle(one(5, errors=int(ServoError.HARDWARE))).broken
    assert broken == f"{name(5)} reports: fault of its sensor or electronics"


# ------------------------------------------------------------------------------------------------------------ overload


class Overloaded(Patient):
    """One servo that shuts down on command; a reset ends the shutdown."""

    def __init__(self, servo: int) -> None:
        super().__init__()
        self.servo, self.resets = servo, list[float]()

    def shut_down(self, seconds: float = 1.5) -> Verdict:
        """Shut down until a reset or for a while; return the last verdict."""
        until = self.now + seconds
        while self.now < until:
            verdict = self.cycle(one(self.servo, errors=int(ServoError.OVERLOAD)))
            assert verdict.broken == f"{name(self.servo)} has shut down because of overload"
            if verdict.restore_torque:
                assert verdict.restore_torque == (self.servo,)
                self.resets.append(self.now)
                break
        return verdict


@pytest.mark.slow
@given(servos, st.lists(st.floats(0.5, 200.0), min_size=4, max_size=10))
@example(servo=0, pauses=[1.0, 1.0, 93.5, 199.5, 1.0])  # the first reset is five minutes old during the fourth shutdown
@WILD
def test_overload_is_reset_at_most_3_times_in_5_minutes_then_robot_sits(servo: int, pauses: list[float]) -> None:
    patient = Overloaded(servo)
    for pause in pauses:
        before = patient.now
        verdict = patient.shut_down()
        if verdict.restore_torque:
            assert patient.now - before == pytest.approx(1.0, abs=2.5 * PERIOD), "it rests first"
            assert verdict.sit == ""
        else:
            rested = before + 1.0 + 2.5 * PERIOD
            assert sum(rested - then < 300.0 + 5.0 * PERIOD for then in patient.resets) >= 3
            assert verdict.sit == f"{name(servo)} has shut down because of overload 4 times in 5 minutes"
        assert patient.cycle().broken == ""
        assert patient.verdict.sit == ""
        patient.now += pause
    for then in patient.resets:
        assert sum(then <= other < then + 300.0 for other in patient.resets) <= 3


@pytest.mark.parametrize(("after", "counts"), [(299.0, True), (300.5, False)])
def test_overload_reset_counts_for_5_minutes(after: float, counts: bool) -> None:
    patient = Overloaded(4)
    for _ in range(3):
        patient.shut_down()
        patient.cycle()
    patient.now = patient.resets[0] + after - 1.0  # the servo rests for a second before its reset
    assert bool(patient.shut_down(1.1).restore_torque) != counts


def test_reason_names_first_servo_without_resets_left() -> None:
    errors = WELL.errors.copy()
    errors[[2, 9]] = int(ServoError.OVERLOAD)
    patient = Patient()
    while not patient.cycle(replace(WELL, errors=errors)).sit:
        pass
    assert patient.verdict.sit == f"{name(2)} has shut down because of overload 4 times in 5 minutes"


def test_overload_resets_are_counted_per_servo() -> None:
    errors = WELL.errors.copy()
    errors[[2, 9]] = int(ServoError.OVERLOAD)
    patient = Patient()
    revived = [verdict.restore_torque for verdict in patient.live(1.1, replace(WELL, errors=errors)) if verdict.restore_torque]
    assert revived == [(2, 9)]
    assert patient.verdict.broken == f"{name(2)} has shut down because of overload"


def test_servos_are_not_reset_with_torque_off() -> None:
    patient = Patient()
    assert set(patient.live(3.0, one(2, errors=int(ServoError.OVERLOAD)), torque=False)) == {Verdict()}


@pytest.mark.parametrize("torque", [True, False])
def test_overheated_servo_is_never_reset(torque: bool) -> None:
    patient = Patient()
    hot = one(2, errors=int(ServoError.OVERHEATING | ServoError.OVERLOAD))
    words = f"{name(2)} has shut down because of overheating"
    assert {(v.broken, v.sit, v.restore_torque) for v in patient.live(0.4, hot, torque)} == {(words, "", ())}
    patient.live(0.2, hot, torque)
    assert {(v.broken, v.sit, v.restore_torque) for v in patient.live(3.0, hot, torque)} == {(words, words, ())}
    assert {v.sit for v in patient.live(0.4)} == {""}
    assert {v.sit for v in patient.live(0.4, hot, torque)} == {""}, "it is counted from its beginning"


# ------------------------------------------------------------------------------------------------------- heat and load


_SETTLES_S = 16.0  # [s] after which a temperature far above all limits is accepted


@pytest.mark.slow
@given(servos, st.floats(20.0, 90.0), st.floats(0.0, 10.0))
@WILD
def test_pace_falls_with_temperature_and_robot_sits_5_k_below_limit(servo: int, temperature: float, more: float) -> None:
    cool = Patient().live(_SETTLES_S, one(servo, temperature=temperature))[-1]
    warm = Patient().live(_SETTLES_S, one(servo, temperature=temperature + more))[-1]
    assert 0.4 <= warm.pace <= cool.pace <= 1.0
    below = LIMIT - temperature
    assert (cool.pace == 1.0) == (below >= 12.0) or below == pytest.approx(12.0)
    assert (cool.sit != "") == (below <= 5.0)
    assert (cool.warnings != ()) == (below < 12.0)
    for words in (*cool.warnings, cool.sit):
        assert words == "" or words.startswith(f"{name(servo)} is {temperature:.0f} deg C hot") or temperature < 30.0
    assert cool.broken == ""


@pytest.mark.parametrize(("below", "pace", "sits"), [(12.0, 1.0, False), (8.5, 0.7, False), (5.0, 0.4, True), (0.0, 0.4, True)])
def test_pace_is_proportional_from_12_to_5_k_below_limit(below: float, pace: float, sits: bool) -> None:
    words = f"{name(7)} is {LIMIT - below:.0f} deg C hot"
    verdict = Patient().live(_SETTLES_S, one(7, temperature=LIMIT - below))[-1]
    assert verdict.pace == pytest.approx(pace)
    assert verdict.sit == (words if sits else "")
    assert verdict.warnings == ((f"{words}; walking slower",) if below < 12.0 else ())


def test_slow_heating_makes_robot_sit_before_shutdown() -> None:
    patient, temperature = Patient(), 30.0
    while not patient.cycle(one(7, temperature=temperature)).sit:
        temperature += 1.0 * PERIOD
    assert temperature < LIMIT - 4.9
    assert patient.verdict.pace == pytest.approx(0.4, abs=0.01)


@given(servos, st.floats(20.0, LIMIT - 13.0), st.floats(0.02, 1.0), st.floats(60.0, 255.0))
@WILD
def test_transient_false_temperature_does_not_make_robot_sit(servo: int, before: float, lasts: float, wrong: float) -> None:
    patient = Patient()
    patient.live(1.0, one(servo, temperature=before))
    for _ in range(5):
        assert {v.sit for v in patient.live(lasts, one(servo, temperature=wrong))} == {""}
        assert set(patient.live(0.02, one(servo, temperature=before))) == {Verdict()}


def test_false_first_temperature_does_not_make_robot_sit() -> None:
    assert {v.sit for v in Patient().live(0.25, one(7, temperature=LIMIT + 15.0))} == {""}


@pytest.mark.slow
@given(servos, st.floats(LIMIT - 20.0, LIMIT - 13.0), st.floats(0.3, 2.9))
@WILD
def test_rising_temperature_is_detected_without_delay(servo: int, temperature: float, rate: float) -> None:
    patient = Patient()
    while not patient.cycle(one(servo, temperature=temperature)).sit:
        temperature += rate * PERIOD
    assert temperature <= LIMIT - 5.0 + rate * PERIOD


@pytest.mark.slow
@given(st.floats(0.0, 1.0), st.floats(-1.0, 1.0))
@WILD
def test_sustained_load_reduces_pace_until_rest(share: float, sign: float) -> None:
    patient = Patient()
    load = np.zeros(18)
    load[3] = np.copysign(share * STALL, sign)
    for _ in range(200):
        verdict = patient.cycle(replace(WELL, load=load), dt=1.0)
    if share < 0.35:
        assert verdict.pace == 1.0
    elif share > 0.51:
        assert verdict.pace == 0.4
    assert patient.verdict.sit == ""
    for _ in range(200):
        rested = patient.cycle(dt=1.0)
    assert rested.pace == 1.0


@pytest.mark.parametrize("seconds", [5.0, 15.0, 30.0])
def test_pace_follows_rms_load_with_30_s_time_constant(seconds: float) -> None:
    patient, load = Patient(), replace(WELL, load=np.full(18, 0.55 * STALL))
    verdict = patient.live(seconds, load)[-1]
    rms = 0.55 * np.sqrt(1.0 - np.exp(-seconds / 30.0))
    assert verdict.pace == pytest.approx(np.clip(1.0 - 0.6 * (rms - 0.36) / 0.14, 0.4, 1.0))


def test_short_high_load_does_not_reduce_pace() -> None:
    patient = Patient()
    assert {verdict.pace for verdict in patient.live(1.0, replace(WELL, load=np.full(18, 0.8 * STALL)))} == {1.0}


# ------------------------------------------------------------------------------------------------------------- battery


@given(st.floats(0.0, EMPTY), st.floats(PERIOD, 0.97))
@WILD
def test_voltage_sag_below_1_s_does_not_make_robot_sit(voltage: float, seconds: float) -> None:
    patient = Patient()
    patient.live(1.0)
    verdicts = [*patient.live(seconds, replace(WELL, voltage=np.full(18, voltage))), *patient.live(3.0)]
    assert {verdict.sit for verdict in verdicts} == {""}


@given(st.floats(0.03, 2.0), servos)
@WILD
def test_empty_battery_makes_robot_sit_before_servo_cutoff(rate: float, servo: int) -> None:
    """Check any rate [V/s] at which a battery falls without a short circuit."""
    patient, voltage = Patient(), EMPTY + 0.5
    warned = False
    while not patient.cycle(one(servo, voltage=voltage)).sit:
        warned |= patient.verdict.warnings != ()
        voltage -= rate * PERIOD
    assert warned or EMPTY + 0.5 < WARN
    assert patient.verdict.sit.startswith("the battery is low: ")
    assert voltage > EMPTY - 1.6 * rate - 0.05, "a second, and what smoothing takes"


def test_low_battery_gives_warning_without_sitting() -> None:
    patient = Patient()
    low = replace(WELL, voltage=np.full(18, (EMPTY + WARN) / 2))
    verdict = patient.live(5.0, low)[-1]
    assert verdict.warnings == (f"the battery is low: {(EMPTY + WARN) / 2:.1f} V",)
    assert verdict.sit == ""


@pytest.mark.parametrize("seconds", [0.3, 0.6, 3.0])
def test_reported_voltage_is_filtered_with_0_3_s_time_constant(seconds: float) -> None:
    patient = Patient()
    patient.live(1.0)
    verdict = patient.live(seconds, replace(WELL, voltage=np.full(18, EMPTY - 2.0)))[-1]
    told = EMPTY - 2.0 + (11.5 - EMPTY + 2.0) * np.exp(-seconds / 0.3)
    assert verdict.warnings == ((f"the battery is low: {told:.1f} V",) if told < WARN else ())


def test_repeated_voltage_sags_do_not_accumulate() -> None:
    patient = Patient()
    for _ in range(10):
        verdicts = [*patient.live(0.4, replace(WELL, voltage=np.full(18, 8.0))), *patient.live(1.0)]
        assert {verdict.sit for verdict in verdicts} == {""}


def test_fault_and_low_battery_are_reported_together() -> None:
    patient = Patient()
    verdict = patient.live(2.0, replace(one(4, missed=SILENT), voltage=np.full(18, EMPTY - 1.0)))[-1]
    assert name(4) in verdict.broken
    assert "battery" in verdict.sit
    hot = one(4, errors=int(ServoError.OVERHEATING), temperature=LIMIT)
    assert "shut down because of overheating" in Patient().live(1.0, hot)[-1].sit, "the worst comes first"


def with_silent_servos(vitals: Vitals, servos: slice, questions: int = SILENT) -> Vitals:
    """Return the vitals with the given servos silent: their last readings stay."""
    missed = WELL.missed.copy()
    missed[servos] = questions
    return replace(vitals, missed=missed)


@pytest.mark.parametrize(("low", "quiet"), [(slice(None), 0.2), (slice(7, 8), 0.0)])
def test_brown_out_with_silent_servos_is_not_taken_for_empty_battery(low: slice, quiet: float) -> None:
    """Check a brown-out: the last reading is low, but the voltage is normal again."""
    voltage = WELL.voltage.copy()
    voltage[low] = EMPTY - 1.0
    patient, sagging = Patient(), replace(WELL, voltage=voltage)
    patient.live(1.0)
    found = patient.live(0.3, sagging) + patient.live(3.0, replace(with_silent_servos(sagging, low), newest=quiet))
    assert not any(verdict.sit for verdict in found)
    assert not any(verdict.sit for verdict in patient.live(2.0))


def test_low_voltage_after_silence_counts_as_empty_battery() -> None:
    empty = replace(WELL, voltage=np.full(18, EMPTY - 0.5))
    patient = Patient()
    patient.live(1.0)
    patient.live(2.0, replace(with_silent_servos(empty, slice(None)), newest=0.2))
    assert patient.live(2.5, empty)[-1].sit


@pytest.mark.parametrize("quiet", [0.0, 0.2])
def test_silent_overloaded_servo_is_reset_only_after_it_responds(quiet: float) -> None:
    shut = one(7, errors=int(ServoError.OVERLOAD))
    patient = Patient()
    patient.live(0.5, shut)
    away = replace(with_silent_servos(shut, slice(7, 8)), newest=quiet)
    for verdict in patient.live(10.0, away):
        assert not verdict.restore_torque
        assert not verdict.sit
    assert any(verdict.restore_torque == (7,) for verdict in patient.live(1.5, shut)), "it is reset once it answers again"


def test_servo_that_must_reboot_waits_for_an_operators_order() -> None:
    patient = Patient(robot_with("XL430-W250"))
    verdicts = patient.live(20.0, one(5, errors=int(ServoError.OVERLOAD)))
    assert {verdict.broken for verdict in verdicts} == {
        f"{name(5)} has shut down because of overload; order `ready` to reboot it"
    }
    assert not any(verdict.sit or verdict.restore_torque for verdict in verdicts)
    assert patient.cycle() == Verdict()


def test_resets_of_permanently_shut_down_servo_expire_after_5_minutes() -> None:
    shut, patient = one(7, errors=int(ServoError.OVERLOAD)), Patient()
    for _ in range(3):
        assert any(verdict.restore_torque for verdict in patient.live(1.2, shut))
        patient.live(0.5)
    assert patient.live(1.2, shut)[-1].sit
    patient.live(2.0, shut, torque=False)
    assert patient.live(1.2, shut)[-1].sit, "a moment later it is no better"
    for _ in range(320):
        patient.cycle(shut, torque=False, dt=1.0)
    found = patient.live(1.2, shut)
    assert any(verdict.restore_torque == (7,) for verdict in found)
    assert not any(verdict.sit for verdict in found)


def test_voltage_sags_separated_by_silence_are_not_joined() -> None:
    sagging = replace(WELL, voltage=np.full(18, EMPTY - 1.5))
    patient = Patient()
    patient.live(1.0)
    silent = replace(with_silent_servos(sagging, slice(None)), newest=0.2)
    found = patient.live(0.5, sagging) + patient.live(2.0, silent) + patient.live(0.5, sagging)
    assert not any(verdict.sit for verdict in found)
    assert patient.live(1.0, sagging)[-1].sit
