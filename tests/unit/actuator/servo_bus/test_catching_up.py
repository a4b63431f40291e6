"""Servos that catch up, and the check of their torque."""

import numpy as np

from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE, LOWERED
from sextant.services.actuator.servo_bus.catching_up import CatchingUp
from sextant.services.actuator.servo_bus.torque_loss_check import TorqueLossCheck

MS, SECOND = 1_000_000, 1_000_000_000
FIRST = np.arange(18) == 0
NONE, ALL = np.zeros(18, dtype=np.bool_), np.ones(18, dtype=np.bool_)
FAR, FAST = np.radians(20.0), np.radians(100.0)


def test_only_servos_that_missed_goals_are_slow() -> None:
    servos = CatchingUp()
    servos.leave_behind(FIRST, LOWERED)
    assert servos.speed_limits.tolist() == [LOWERED, *[0.0] * 17]
    servos.leave_behind(FIRST, GENTLE)
    servos.leave_behind(FIRST, LOWERED)
    assert servos.speed_limits[0] == GENTLE, "the lowest limit counts"


def test_a_servo_has_caught_up_near_its_goal_or_once_it_no_longer_moves() -> None:
    for off, speed, stamps_ms, behind in (
        (np.radians(4.0), FAST, [0], False),
        (FAR, FAST, [0, 200], True),
        (FAR, 0.0, [0, 90], True),
        (FAR, 0.0, [0, 110], False),
    ):
        servos = CatchingUp()
        servos.leave_behind(FIRST, GENTLE)
        assert not servos.answering.any()
        for stamp_ms in stamps_ms:
            servos.note_reading(0, SECOND + stamp_ms * MS, off, speed)
        assert servos.behind[0] == servos.answering[0] == behind


def test_touch_is_regained_when_all_have_caught_up_or_a_second_after_the_first_answer() -> None:
    servos = CatchingUp()
    servos.leave_all_behind()
    servos.update_all_behind(SECOND)
    assert servos.all_behind
    for index in range(17):
        servos.note_reading(index, SECOND, 0.0, 0.0)
    servos.update_all_behind(2 * SECOND)
    assert servos.all_behind, "one servo is silent"
    servos.update_all_behind(2 * SECOND + 1)
    assert not servos.all_behind
    servos.leave_all_behind()
    for index in range(18):
        servos.note_reading(index, 3 * SECOND, 0.0, 0.0)
    servos.update_all_behind(3 * SECOND)
    assert not servos.all_behind


def test_touch_is_not_regained_while_a_joint_moves() -> None:
    servos = CatchingUp()
    servos.leave_all_behind()
    for index in range(18):
        servos.note_reading(index, SECOND, np.radians(4.0), FAST if index == 0 else 0.0)
    assert not servos.behind.any()
    servos.update_all_behind(SECOND)
    assert servos.all_behind
    servos.note_reading(0, SECOND, np.radians(4.0), 0.0)
    servos.update_all_behind(SECOND)
    assert not servos.all_behind


def test_with_goals_of_the_servos_only_joints_on_their_way_stay_slow() -> None:
    servos = CatchingUp()
    servos.leave_all_behind()
    servos.readopt(np.where(FIRST, np.radians(8.0), np.radians(2.0)), SECOND)
    assert servos.behind.tolist() == FIRST.tolist()
    servos.readopt(np.full(18, np.radians(8.0)), SECOND)
    assert servos.behind.tolist() == FIRST.tolist(), "it leaves no servo behind"


def test_a_servo_that_falls_silent_after_its_port_has_returned_stops_the_others_for_a_second_only() -> None:
    servos = CatchingUp()
    servos.leave_all_behind()
    servos.readopt(np.zeros(18), SECOND)
    servos.update_all_behind(2 * SECOND + 1)
    assert not servos.all_behind, "each was at its goal"
    servos.leave_all_behind()
    servos.readopt(np.where(FIRST, np.radians(8.0), 0.0), SECOND)
    assert servos.answering.tolist() == FIRST.tolist(), "its state was read"
    servos.update_all_behind(2 * SECOND)
    assert servos.all_behind
    servos.update_all_behind(2 * SECOND + 1)
    assert not servos.all_behind
    assert servos.behind.tolist() == FIRST.tolist(), "it stays slow"


def test_every_servo_becomes_doubtful_within_two_seconds() -> None:
    check, checked = TorqueLossCheck(), set[int]()
    for _ in range(90):
        check.end_cycle(NONE)
        for index in check.due(range(18), ALL):
            checked.add(index)
            check.confirm(index)
    assert checked == set(range(18))


def test_a_silent_servo_is_checked_once_it_answers_and_until_it_is_confirmed() -> None:
    check = TorqueLossCheck()
    check.end_cycle(FIRST)
    assert check.due([3, 4], ALL) == []
    assert check.due([3, 0], ALL) == [0]
    assert check.due([3, 0], ~FIRST) == [], "it has no torque to lose"
    assert check.due([0], ALL) == [0]
    check.confirm(0)
    assert check.due([0], ALL) == []


def test_few_servos_are_checked_in_one_cycle() -> None:
    check = TorqueLossCheck()
    check.doubt_all()
    assert check.due(range(18), ALL) == [0, 1, 2]
