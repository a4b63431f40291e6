"""Scores of faults, from synthetic timelines."""

from math import isnan, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.faults.bus_log import Goals, Role, Switch
from benchmarks.faults.cases import BY_NAME
from benchmarks.faults.timeline import Status, Timeline
from benchmarks.faults.walk_verdict import cycles, off_time, score
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire.messages import Mode
from tests.support.timelines import BEGIN_S, PERIOD_S, PROFILE, standing, timeline, word

KILLED, SILENT, OFF, HEAT = (BY_NAME[name] for name in ("planner-killed", "servo-silent", "off-bus-gone", "heat"))
LIE = BY_NAME["servo-slipped"]
IDS = PROFILE.servo_ids.ravel().tolist()
NO_PLAN = "no new plan received for 0.18 s"


def torque(after_s: float, on: bool, heard: bool = True, ids: list[int] = IDS) -> Switch:
    return Switch(BEGIN_S + after_s, heard, Role.TORQUE, dict.fromkeys(ids, int(on)))


def goal(after_s: float, ticks: int = 512, speed: int = 0) -> Goals:
    return Goals(BEGIN_S + after_s, np.full(18, ticks), np.full(18, speed))


def test_stop_time_is_first_report_and_ends_with_next_walk() -> None:
    said = (word(0.1, Mode.WALK, "walking"), word(0.22, Mode.WALK, NO_PLAN), word(0.6, Mode.HOLD, NO_PLAN))
    found = score(timeline(*said, word(2.3, Mode.WALK, "walking")), KILLED, PROFILE)
    assert found.decided_s == pytest.approx(0.22)
    assert found.named
    assert found.again_s == pytest.approx(0.3)
    assert (found.stops, found.falls, found.reason) == (1, 0, NO_PLAN)


def test_uninterrupted_walk_has_no_stop_rest_or_restart() -> None:
    found = score(timeline(*(word(t, Mode.WALK, "walking") for t in np.arange(0.1, 2.5, 0.1))), KILLED, PROFILE)
    assert all(isnan(value) for value in (found.decided_s, found.rest_s, found.again_s))
    assert (found.stops, found.jump_deg, found.named) == (0, 0.0, False)


@pytest.mark.parametrize(("gap_s", "again_s"), [(2.3, 0.4), (0.2, nan)])
def test_restart_behind_message_gap_counts_from_first_message(gap_s: float, again_s: float) -> None:
    walking = [word(2.4 - gap_s - before, Mode.WALK, "walking") for before in np.arange(0.0, 2.4 - gap_s, 0.1)[::-1]]
    found = score(timeline(*walking, word(2.4, Mode.WALK, "walking")), KILLED, PROFILE)
    assert found.again_s == pytest.approx(again_s, nan_ok=True)
    assert isnan(found.decided_s), "no stop was received"


def test_stopping_robot_behind_message_gap_has_not_restarted() -> None:
    unheard = BY_NAME["live-router-stopped"]
    again = [score(timeline(word(2.4, Mode.WALK, said)), unheard, PROFILE).again_s for said in ("walking", NO_PLAN)]
    assert again == pytest.approx([0.4, nan], nan_ok=True)


def test_walk_during_fault_is_no_restart() -> None:
    said = (word(0.2, Mode.FAULT), word(1.0, Mode.WALK, "walking"), word(1.5, Mode.FAULT))
    assert isnan(score(timeline(*said), KILLED, PROFILE).again_s)


def test_reason_must_name_faulted_servo() -> None:
    def named(servo: int) -> bool:
        reason = "the femur servo of the right middle leg (id 16) does not answer"
        return score(timeline(word(0.1, Mode.FAULT, reason), servo=servo), SILENT, PROFILE).named

    assert named(16)
    assert not named(6)


@pytest.mark.parametrize(
    ("said", "named"),
    [
        ("the femur servo of the left middle leg (id 15) is 17 deg off its goal", "servo"),
        ("the coxa servo of the left middle leg (id 13): its horn has slipped by about 20 deg", "leg"),
        ("left middle leg: a horn has slipped by about 20 deg", "leg"),
        ("right front or left middle leg: a horn has slipped by about 20 deg", "legs"),
        ("right front or left rear leg: a horn has slipped by about 20 deg", "wrong"),
        ("the femur servo of the right middle leg (id 16) reports its load with the wrong sign", "wrong"),
        ("no ground under the left middle foot at the expected height", ""),
    ],
)
@pytest.mark.parametrize("warned", [False, True])
def test_lie_is_named_by_its_servo_or_by_legs(said: str, named: str, warned: bool) -> None:
    reason, warnings = ("walking", ("slipping: right front", said)) if warned else (said, ())
    found = score(timeline(word(1.0, Mode.WALK, reason)._replace(warnings=warnings), servo=15), LIE, PROFILE)
    assert found.named_as == named
    assert found.named_s == pytest.approx(1.0 if named else nan, nan_ok=True)


def test_margin_of_a_lie_counts_until_it_is_named() -> None:
    truth = standing(8.0)
    truth.body[(truth.t > BEGIN_S + 2.0) & (truth.t < BEGIN_S + 3.0), 0, 3] += 0.1
    said = "left middle leg: a horn has slipped by about 20 deg"
    margins = [
        score(timeline(word(at_s, Mode.FAULT, said), servo=15, truth=truth), LIE, PROFILE).unnamed_margin_m
        for at_s in (1.5, 3.5)
    ]
    assert margins[0] > margins[1] + 0.05


@given(st.floats(0.3, 1.5))
def test_rest_time_is_end_of_last_motion(moves_s: float) -> None:
    truth = standing()
    moving = truth.t < BEGIN_S + moves_s
    truth.body[:, 0, 3] = 0.06 * np.minimum(truth.t - BEGIN_S, moves_s)
    found = score(timeline(word(0.2, Mode.HOLD, NO_PLAN), truth=truth), KILLED, PROFILE)
    assert found.rest_s == pytest.approx(moves_s, abs=2 * PERIOD_S)
    assert moving.any()


def test_raised_foot_prevents_rest_unless_barely_above_ground() -> None:
    truth = standing()
    truth.contact[:, 2] = False
    assert score(timeline(word(0.2, Mode.HOLD, NO_PLAN), truth=truth), KILLED, PROFILE).rest_s == pytest.approx(0.2)
    truth.feet[:, 2, 2] += 0.011
    assert isnan(score(timeline(word(0.2, Mode.HOLD, NO_PLAN), truth=truth), KILLED, PROFILE).rest_s)


def test_margin_is_minimum_within_three_seconds() -> None:
    truth = standing(5.0)
    whole = score(timeline(truth=truth), KILLED, PROFILE).margin_m
    truth.body[truth.t > BEGIN_S + 3.5, 0, 3] += 1.0
    assert score(timeline(truth=truth), KILLED, PROFILE).margin_m == whole > 0.05
    truth.body[100, 0, 3] += 0.03
    assert score(timeline(truth=truth), KILLED, PROFILE).margin_m < whole


def test_tilt_or_uncommanded_descent_is_a_fall() -> None:
    down = standing()
    down.body[100:, 2, 3] = 0.01
    assert score(timeline(truth=down), KILLED, PROFILE).falls == 1
    assert score(timeline(word(0.5, Mode.SIT), word(3.0, Mode.OFF), truth=down), HEAT, PROFILE).falls == 0
    tilted = standing()
    tilted.body[100:, 2, 2] = np.cos(np.radians(40.0))
    assert score(timeline(word(0.5, Mode.SIT), truth=tilted), HEAT, PROFILE).falls == 1


@given(st.integers(1, 400))
def test_jump_is_largest_goal_change_after_fault(ticks: int) -> None:
    goals = (goal(-0.1), goal(0.5, 900), goal(1.0), goal(2.01, 512 + ticks), goal(2.03, 512 + ticks), goal(3.2, 100))
    said = (word(0.2, Mode.HOLD), word(3.0, Mode.WALK, "walking"))
    found = score(timeline(*said, goals=goals), KILLED, PROFILE)
    assert found.jump_deg == pytest.approx(np.degrees(dxl.TICK_RAD) * ticks)


@pytest.mark.parametrize(("before_s", "counts"), [(0.018, False), (0.022, True)])
def test_first_goals_of_next_step_are_no_jump(before_s: float, counts: bool) -> None:
    goals = (goal(0.5), goal(3.0 - before_s, 600))
    said = (word(0.2, Mode.HOLD), word(3.0, Mode.WALK, "walking"))
    assert (score(timeline(*said, goals=goals), KILLED, PROFILE).jump_deg > 0.0) == counts


def test_goal_with_limited_speed_is_no_jump() -> None:
    goals = (goal(0.5), goal(2.01, 600, dxl.moving_speed_from(np.radians(25.0))))
    said = (word(0.2, Mode.HOLD), word(3.0, Mode.WALK, "walking"))
    assert score(timeline(*said, goals=goals), KILLED, PROFILE).jump_deg == pytest.approx(0.5, rel=0.02)


def test_lunge_is_measured_only_for_reset_joint() -> None:
    truth = standing()
    after = truth.t > BEGIN_S + 1.0
    truth.q[after, 3, 1] = np.radians(20.0) * (truth.t[after] - BEGIN_S - 1.0)
    reset = Switch(BEGIN_S + 0.9, True, Role.RESET, {16: 1023})
    said = (word(0.1, Mode.FAULT), word(3.9, Mode.WALK, "walking"))
    case = BY_NAME["overload"]
    of_it = score(timeline(*said, truth=truth, switches=(reset,), servo=int(PROFILE.servo_ids[3, 1])), case, PROFILE)
    assert of_it.lunge_dps == pytest.approx(20.0, rel=1e-3)
    assert score(timeline(*said, truth=truth, switches=(reset,), servo=1), case, PROFILE).lunge_dps == 0.0
    assert score(timeline(*said, truth=truth), case, PROFILE).lunge_dps == 0.0


def ordered(*switches: Switch, **changes: object) -> Timeline:
    pulls = np.zeros(18, dtype=np.bool_)
    return timeline(ordered_s=BEGIN_S + 0.3, switches=switches, **({"pulls": pulls} | changes))


def test_torque_off_time_needs_all_servos() -> None:
    some = torque(0.31, on=False, ids=IDS[:17])
    assert off_time(ordered(some, torque(0.34, on=False), torque(0.36, on=False)))[0] == pytest.approx(0.04)
    assert isnan(off_time(ordered(some, torque(0.32, on=False, heard=False)))[0])
    assert isnan(off_time(ordered(torque(0.32, on=True)))[0])
    assert isnan(off_time(timeline(switches=(torque(0.32, on=False),)))[0])


def test_torque_off_time_counts_from_actuator_return() -> None:
    sent, heard = torque(2.05, on=False, heard=False), torque(2.05, on=False)
    back = BEGIN_S + 2.0
    assert off_time(ordered(sent, heard, returned_s=back)) == (pytest.approx(0.05), 0)
    late = ordered(sent, heard, returned_s=back, goals=(goal(0.5), goal(2.02), goal(2.1)))
    assert off_time(late) == (pytest.approx(0.05), 1)
    assert off_time(ordered(heard, sent, returned_s=BEGIN_S)) == (pytest.approx(1.75), 0)


def test_goals_of_the_cycle_in_which_torque_off_is_ordered_do_not_count() -> None:
    sent, heard, back = torque(0.33, on=False, heard=False), torque(0.33, on=False), BEGIN_S + 0.305
    for at, count in ((0.302, 0), (0.31, 0), (0.319, 0), (0.325, 1)):  # [s]; torque off was ordered at 0.3
        assert off_time(ordered(sent, heard, returned_s=back, goals=(goal(at),)))[1] == count


def test_torque_enabled_at_end_is_reported() -> None:
    said = word(0.35, Mode.OFF)
    assert not score(ordered(torque(0.34, on=False), end_s=BEGIN_S), OFF, PROFILE).on_again
    pulls = np.zeros(18, dtype=np.bool_)
    pulls[7] = True
    switches = (torque(0.34, on=False, heard=False), torque(0.34, on=False))
    found = score(timeline(said, ordered_s=BEGIN_S + 0.3, switches=switches, pulls=pulls), OFF, PROFILE)
    assert found.on_again
    assert (found.switched, found.misheard) == (True, False)


def test_torque_switch_without_sent_command_is_misheard() -> None:
    """Report separately that torque was switched by a command that no process sent.

    A broken byte in 256 passes a servo's checksum; no process is responsible for such a command.
    """
    found = score(timeline(switches=(torque(0.34, on=False),)), OFF, PROFILE)
    assert (found.switched, found.misheard) == (False, True)
    found = score(timeline(), OFF, PROFILE)
    assert (found.switched, found.misheard) == (False, False)


def test_sitting_before_servo_shutdown_is_in_time() -> None:
    hot = standing(5.0)
    hot.shutdown[200:, 3, 1] = True
    for off_s, cut_off in ((3.0, False), (4.5, True)):
        found = score(timeline(word(0.5, Mode.SIT), word(off_s, Mode.OFF), truth=hot), HEAT, PROFILE)
        assert found.seated_s == pytest.approx(off_s)
        assert found.cut_off is cut_off
    assert score(timeline(truth=hot), HEAT, PROFILE).cut_off
    assert score(timeline(word(3.0, Mode.OFF), empty_s=BEGIN_S + 2.0), HEAT, PROFILE).cut_off


@given(st.lists(st.sampled_from([0.02, 0.0295, 0.0305, 0.05]), min_size=1, max_size=30))
def test_cycle_times_are_goal_intervals_during_fault(spans: list[float]) -> None:
    times = np.cumsum([0.1, *spans])
    line = timeline(goals=tuple(goal(t) for t in (-0.5, *times, 9.0)), end_s=BEGIN_S + 5.0)
    p99, missed = cycles(line)
    assert p99 == pytest.approx(max(spans))
    assert missed == max(len(run) for run in "".join("x" if span > 0.03 else " " for span in spans).split(" "))


def test_cycle_time_needs_two_goals() -> None:
    assert isnan(cycles(timeline(goals=(goal(0.1),)))[0])


@given(st.lists(st.integers(0, 40), min_size=1, max_size=20), st.floats(-0.004, 0.004))
def test_goal_speed_excludes_rounding_tick(ways: list[int], early_s: float) -> None:
    """Compute goal speeds for packets at any time in their cycle.

    Repeated goals in one cycle count once, and goals after the end do not count.
    """
    ticks = np.cumsum([100, *ways])
    sent = [goal(0.1 + PERIOD_S * k + (early_s if k % 2 else 0.0), int(at)) for k, at in enumerate(ticks)]
    twice = [Goals(one.t_s + 0.001, one.ticks, one.speeds) for one in sent]
    line = timeline(goals=(*(one for pair in zip(sent, twice, strict=True) for one in pair), goal(2.5, 1000)))
    tick_dps = np.degrees(dxl.TICK_RAD) / PERIOD_S
    assert score(line, KILLED, PROFILE).goal_dps == pytest.approx(max(max(ways) - 1, 0) * tick_dps)


def test_goal_speed_needs_two_goals() -> None:
    assert isnan(score(timeline(goals=(goal(0.1),)), KILLED, PROFILE).goal_dps)


def test_stand_is_judged_by_its_longest_reason() -> None:
    case = BY_NAME["camera-frozen-steps"]
    said = (("waiting", "no fresh terrain map"), *(("waiting", f"frozen for {k} s") for k in range(3)), ("stepping", "walks"))
    statuses = tuple(Status(BEGIN_S + 1.0 + 0.5 * k, *words) for k, words in enumerate(said))
    held = (word(0.9, Mode.HOLD), word(3.5, Mode.WALK, "walking"))
    found = score(timeline(*held, statuses=statuses, ended="walks", place_m=0.02), case, PROFILE)
    assert (found.stood, found.unnamed, found.ended, found.place_m) == (("frozen for 2 s",), "", "walks", 0.02)
    for some, reason in ((statuses[:1], "no fresh terrain map"), ((), "nothing was said")):
        assert score(timeline(*held, statuses=some, ended="walks"), case, PROFILE).unnamed == reason
    assert not score(timeline(word(0.9, Mode.HOLD), word(1.5, Mode.WALK, "walking")), case, PROFILE).stood
    arrived = timeline(word(0.9, Mode.HOLD), word(3.5, Mode.HOLD), ended="arrived")
    assert not score(arrived, case, PROFILE).stood
