"""The faults of robots with different servos, and their limits."""

from math import inf

import pytest

from benchmarks.faults.batch import inject
from benchmarks.faults.cases import BY_NAME, CASES, Limits
from benchmarks.faults.robot_cases import of_robot
from benchmarks.faults.table import row
from sextant.shared.robot.profiles import load_profile

HOBBY = load_profile("printed_ds3218")


def limits(robot: str, name: str) -> Limits:
    (case,) = of_robot([BY_NAME[name]], load_profile(robot))
    return case.limits


def test_the_table_is_that_of_the_default_robot() -> None:
    assert of_robot(CASES, load_profile("phantomx_mk2")) == list(CASES)


def test_goals_are_at_most_as_fast_as_the_servos() -> None:
    assert limits("printed_sts3215", "fuzzed-plans").goal_dps == 270.0
    assert limits("jethexa_hx35h", "fuzzed-plans").goal_dps == 668.0  # in two cycles
    assert limits("printed_sts3215", "planner-killed").goal_dps == inf


def test_constant_supply_does_not_run_empty() -> None:
    assert not of_robot([BY_NAME["drain"], BY_NAME["off-drain"]], load_profile("lotriet_rx64"))


def test_nearly_empty_battery_carries_the_walk_of_a_robot_that_takes_more_current() -> None:
    charges = [of_robot([BY_NAME["drain"]], load_profile(robot))[0].charge for robot in ("phantomx_mk2", "jethexa_hx35h")]
    assert charges == [BY_NAME["drain"].charge, 2.0 * BY_NAME["drain"].charge]


def test_heavy_rotors_are_set_down_more_slowly() -> None:
    light, heavy = (limits(robot, "planner-killed").rest_s for robot in ("lotriet_rx64", "printed_sts3215"))
    assert light == 0.7
    assert heavy == pytest.approx(0.7 * 0.496 / 0.33, rel=0.01)


def test_rotors_on_soft_springs_may_overshoot_a_speed() -> None:
    ax, rx, sts = (limits(robot, "overload").lunge_dps for robot in ("phantomx_mk2", "lotriet_rx64", "printed_sts3215"))
    assert ax == rx == 30.0, "an RX-64 is damped more"
    assert sts == pytest.approx(30.0 * 30.3 / 25.9, rel=0.01)


def test_servos_with_commands_are_noticed_later_and_report_no_shutdown() -> None:
    assert limits("jethexa_hx35h", "servo-silent").decided_s == pytest.approx(0.65)
    assert limits("jethexa_hx35h", "bus-silent").decided_s == 0.25
    assert limits("jethexa_hx35h", "actuator-killed").decided_s == pytest.approx(2.3)
    assert not of_robot([BY_NAME["overload"], BY_NAME["off-overload"]], load_profile("jethexa_hx35h"))


def test_hobby_servos_have_no_fault_of_what_they_do_not_report() -> None:
    names = {case.name for case in of_robot(CASES, HOBBY)}
    assert names >= {"planner-killed", "bus-gone", "bytes-wrong", "packets-noisy", "servo-silent", "servo-slipped", "off"}
    assert not names & {"overload", "heat", "hot-reading", "drain", "sag", "servo-wrong", "servo-garbage", "off-servo-bit"}


def test_fault_of_a_hobby_servo_is_not_noticed_but_must_cause_no_fall() -> None:
    found = limits("printed_ds3218", "servo-silent")
    assert (found.decided_s, found.again_s, found.named) == (inf, inf, "")
    assert found.torque_stays


def test_hobby_servos_may_walk_on_without_some_answers_and_rest_later() -> None:
    found = limits("printed_ds3218", "lost-40")
    assert (found.decided_s, found.again_s, found.named) == (inf, inf, "")
    assert limits("printed_ds3218", "planner-killed").rest_s == pytest.approx(0.76)


def test_faults_of_the_board_keep_their_limits() -> None:
    gone, stuck = limits("printed_ds3218", "bus-gone"), limits("printed_ds3218", "bus-stuck")
    assert (gone.decided_s, gone.again_s) == (0.25, 3.0)
    assert (stuck.decided_s, stuck.again_s) == (0.25, inf)  # it may look like the restart of the board
    assert "board" in gone.named
    assert "board" not in limits("printed_ds3218", "planner-killed").named


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "robot", "number"),
    [
        ("actuator-stopped", "printed_sts3215", 0),  # all servos are read at once: hanging feet are lowered gently
        ("planner-killed", "printed_sts3215", 2),  # heavy rotors
        ("sag", "jethexa_hx35h", 16),  # its voltage is seldom read, and that of the sag must not last
        ("bus-garbage", "jethexa_hx35h", 4),  # the first answer after a silence gives the other servos a turn
        ("bus-stuck", "printed_ds3218", 0),
    ],
)
def test_robot_keeps_the_limits_of_a_fault(name: str, robot: str, number: int) -> None:
    (case,) = of_robot([BY_NAME[name]], load_profile(robot))
    assert row(case, [one.outcome for one in inject(name, (number,), robot)]).missed == ()
