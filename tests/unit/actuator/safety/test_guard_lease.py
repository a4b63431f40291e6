"""Guard and lease: holder, duration, orders that count, and clients that may stop."""

from dataclasses import replace

import pytest

from sextant.services.actuator.safety.command_arbiter import AWAY_NS, LEASE_NS
from sextant.services.actuator.safety.command_ordering import ORDER_AGE_NS
from sextant.services.actuator.safety.guard import Act
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.shared.wire.messages import Mode, ModeCommand, StopOrder
from tests.support.guarded import BROKEN, CYCLE, ORDERS, in_mode

MODES = list(Mode)

# ------------------------------------------------------------------------------------------------- orders and the lease


def test_a_lease_lasts_three_seconds_from_the_last_order_be_it_repeated() -> None:
    robot = in_mode(Mode.HOLD)
    begin = robot.now
    robot.order("walk")
    again = ModeCommand(begin + 1_500_000_000, "walk", robot.number, "a")
    assert robot.guard.lease(begin + LEASE_NS) == "a"
    assert robot.guard.lease(begin + LEASE_NS + 1) == ""
    robot.now = begin + 2_000_000_000
    robot.handle_order(again)
    assert robot.guard.lease(robot.now + LEASE_NS) == "a"
    robot.now = begin + 4_000_000_000
    robot.order("stop")
    assert robot.guard.lease(robot.now + LEASE_NS) == "a"
    assert LEASE_NS == 3_000_000_000


@pytest.mark.parametrize("mode", [mode for mode in ORDERS if mode not in ("off", "stop")])
def test_one_leads_and_others_are_told_who(mode: str) -> None:
    robot = in_mode(Mode.WALK)
    assert robot.order(mode, "b") == ()
    assert robot.guard.objection == f"`{mode}` of b refused: a holds the lease; take it over, or wait until it expires"
    assert robot.guard.lease(robot.now) == "a"
    assert robot.mode is Mode.WALK
    assert robot.accept_plan(robot.renewal())
    assert robot.cycle() == ()


def test_who_takes_over_leads_and_the_other_one_does_not_by_repeating() -> None:
    robot = in_mode(Mode.WALK)
    before = ModeCommand(robot.now, "walk", robot.number, "a")
    robot.order("walk", "b", take=True)
    assert robot.guard.objection == ""
    robot.now += CYCLE
    robot.handle_order(before)
    assert robot.guard.lease(robot.now - CYCLE + LEASE_NS) == "b"
    assert robot.guard.lease(robot.now + LEASE_NS) == ""
    robot.now += LEASE_NS
    robot.handle_order(replace(before, stamp_ns=robot.now))
    assert robot.guard.lease(robot.now) == ""
    robot.order("stop", "a")
    assert robot.guard.lease(robot.now) == ""
    robot.order("walk", "a")
    assert robot.guard.lease(robot.now) == "a"


@pytest.mark.parametrize("take", [True, False])
def test_the_walk_does_not_pass_on_with_the_lease(take: bool) -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    robot.now += 0 if take else LEASE_NS + 1
    robot.verdict = BROKEN
    robot.cycle()
    robot.order("walk", "b", take)
    assert robot.guard.lease(robot.now) == "b"
    robot.verdict = Verdict()
    robot.cycle()
    assert not robot.accept_plan(robot.plan())
    assert "not ordered to walk" in robot.guard.refused


def test_who_leads_goes_on_leading_by_new_orders() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    robot.verdict = BROKEN
    robot.cycle()
    robot.order("walk")
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.accept_plan(robot.plan())


@pytest.mark.parametrize("mode", ORDERS)
def test_an_order_counts_once_and_an_older_one_that_moves_the_legs_not_at_all(mode: str) -> None:
    robot = in_mode(Mode.HOLD)
    older = ModeCommand(robot.now, "sit", 0, "a")
    robot.order(mode)
    again = ModeCommand(robot.now, mode, robot.number, "a")  # type: ignore[arg-type]
    robot.order("stand", "a", take=True)
    if mode == "off":
        assert robot.torque
    assert robot.handle_order(again) == robot.handle_order(older) == ()
    assert robot.guard.objection == "`sit` of a refused: it is older than the newest order of this client"
    assert robot.mode is Mode.STAND
    assert robot.handle_order(ModeCommand(robot.now, "off", robot.number, "a")) == ()


def test_an_order_to_stop_that_comes_after_a_newer_one_to_walk_is_obeyed_once() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    late = [ModeCommand(robot.now, "off", robot.number - k, "a") for k in (1, 2, 3)]
    assert robot.handle_order(late[1]) == (Act.TORQUE_OFF,)
    assert robot.handle_order(replace(late[1], stamp_ns=robot.now - ORDER_AGE_NS - 1)) == ()
    robot.order("stand")
    for again in (late[1], late[2]):
        assert robot.handle_order(again) == ()
        assert robot.guard.objection == "`off` of a refused: it is older than the newest order of this client"
    assert robot.guard.handle_stop(StopOrder(robot.now, "off", late[1].sequence, "a"), robot.now) == (), "heard already"
    assert robot.torque
    assert robot.handle_order(late[0]) == (Act.TORQUE_OFF,), "no newer stop is known"


@pytest.mark.parametrize("mode", ["off", "stop"])
def test_an_older_stop_that_was_recorded_and_is_put_again_is_refused(mode: str) -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    assert robot.accept_plan(robot.plan())
    assert robot.handle_order(ModeCommand(robot.now - ORDER_AGE_NS - 1, mode, robot.number - 1, "a")) == ()  # type: ignore[arg-type]
    assert robot.guard.objection == f"`{mode}` of a refused: it is older than the newest order of this client"
    assert robot.mode is Mode.WALK


def test_of_a_repetition_that_is_not_of_now_it_says_so_where_it_would_move_the_legs() -> None:
    for mode, objection in (("stop", ""), ("walk", "`walk` of a refused: it is 3.0 s old, at most 2 s allowed")):
        robot = in_mode(Mode.HOLD)
        robot.order(mode)
        assert robot.handle_order(ModeCommand(robot.now - 3_000_000_000, mode, robot.number, "a")) == ()  # type: ignore[arg-type]
        assert robot.guard.objection.split(";")[0] == objection


def test_a_stop_of_now_that_is_older_gives_nobody_the_lease() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk", "b")
    robot.order("walk", "a", take=True)
    assert robot.handle_order(ModeCommand(robot.now, "stop", 1, "b", take=True)) == ()
    assert robot.guard.lease(robot.now) == "a"
    assert not robot.accept_plan(robot.plan())
    assert "not ordered to walk" in robot.guard.refused


def test_a_repetition_says_nothing_and_a_new_order_that_is_obeyed_clears_the_objection() -> None:
    robot = in_mode(Mode.OFF)
    robot.order("walk")
    words = robot.guard.objection
    assert words == "`walk` refused: the mode is off, order `stand` first"
    robot.handle_order(ModeCommand(robot.now, "walk", robot.number, "a"))
    assert robot.guard.objection == words
    robot.order("stop", "b")
    assert robot.guard.objection == ""


def test_more_than_sixteen_are_remembered_by_none_but_may_stop() -> None:
    robot = in_mode(Mode.HOLD)
    robot.now += AWAY_NS
    for k in range(16):
        robot.order("stop", f"holder {k}")
    for _ in range(2):
        assert robot.order("stand", "holder 16", take=True) == ()
        assert robot.guard.objection == "`stand` of holder 16 refused: 16 other clients gave orders within 30 s"
    assert robot.order("stand", "holder 15") == (Act.RISE,)
    assert robot.guard.objection == ""
    robot.order("walk", "holder 16")
    assert robot.order("stop", "holder 16", take=True) == (Act.FREEZE,)
    assert robot.guard.objection == ""


def test_who_has_ordered_nothing_for_long_makes_room_for_others_and_moves_nothing_by_what_was_forgotten() -> None:
    robot = in_mode(Mode.HOLD)
    for k in range(16):
        robot.order("stop", f"holder {k}")
    forgotten = robot.number - 15
    robot.now = forgotten + AWAY_NS
    robot.order("walk", "holder 16", take=True)
    assert "16 other clients gave orders within 30 s" in robot.guard.objection
    robot.now += 1
    robot.order("walk", "holder 16", take=True)
    assert robot.guard.objection == ""
    assert robot.guard.lease(robot.now) == "holder 16"
    for mode in ("ready", "stand", "walk", "sit"):
        assert robot.handle_order(ModeCommand(robot.now, mode, forgotten, "holder 0", take=True)) == ()  # type: ignore[arg-type]
        assert robot.guard.lease(robot.now) == "holder 16"
    assert robot.order("stop", "holder 0") == ()
    assert robot.order("off", "holder 16") == (Act.TORQUE_OFF,)


def test_of_those_who_let_go_without_leading_the_last_sixteen_are_remembered() -> None:
    robot = in_mode(Mode.HOLD)
    words = [StopOrder(robot.now, "off", 1, f"onlooker {k}") for k in range(17)]
    for order in words[:16]:
        assert robot.guard.handle_stop(order, robot.now) == (Act.TORQUE_OFF,)
    assert robot.guard.handle_stop(words[0], robot.now) == (), "a repetition is nothing new"
    assert robot.guard.handle_stop(words[16], robot.now) == (Act.TORQUE_OFF,)
    assert robot.guard.handle_stop(words[0], robot.now) == (), "a message has arrived since"
    assert robot.guard.handle_stop(words[1], robot.now) == (Act.TORQUE_OFF,), "forgotten: in doubt it is obeyed"


# ---------------------------------------------------------------------------------------------- clients that may only stop


@pytest.mark.parametrize("mode", MODES)
def test_who_may_only_stop_does_so_from_anywhere_and_takes_nothing(mode: Mode) -> None:
    robot = in_mode(mode)
    lease, leading = robot.guard.lease(robot.now), in_mode(mode)
    leading.order("stop", "viewer")
    robot.guard.handle_stop(StopOrder(0, "stop", 5, "viewer"), robot.now)
    assert robot.guard.lease(robot.now) == lease
    assert robot.mode is leading.mode, "as anybody's stop"
    assert robot.guard.handle_stop(StopOrder(0, "off", 6, "viewer"), robot.now) == (Act.TORQUE_OFF,)
    assert robot.mode is Mode.OFF


def test_an_order_to_stop_counts_once_and_does_not_shut_out_who_leads() -> None:
    robot = in_mode(Mode.WALK)
    for k in range(1000):
        robot.guard.handle_stop(StopOrder(0, "stop", k, f"stranger {k}"), robot.now)
    old = StopOrder(0, "stop", 999, "stranger 999")
    robot = in_mode(Mode.HOLD)
    robot.guard.handle_stop(old, robot.now)
    robot.order("walk")
    assert robot.guard.handle_stop(old, robot.now) == ()
    assert robot.guard.objection == ""
    assert robot.accept_plan(robot.plan()), robot.guard.refused
    assert robot.guard.handle_stop(StopOrder(0, "stop", 1, "stranger 999"), robot.now) == (Act.SET_DOWN,), (
        "whose machine has restarted"
    )
