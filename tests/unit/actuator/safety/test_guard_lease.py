"""Guard and lease: holder, duration, orders that count, and clients that may stop."""

from dataclasses import replace

import pytest

from sextant.services.actuator.safety.command_arbiter import AWAY_NS, LEASE_NS
from sextant.services.actuator.safety.command_ordering import ORDER_AGE_NS
from sextant.services.actuator.safety.guard import OBJECTION_NS, Act
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.shared.wire.messages import Mode, ModeCommand, StopOrder
from tests.support.guarded import BROKEN, CYCLE, ORDERS, in_mode

MODES = list(Mode)

# ------------------------------------------------------------------------------------------------- orders and the lease


def test_lease_lasts_3_s_from_last_new_or_repeated_order() -> None:
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
def test_order_of_other_client_is_refused_naming_lease_holder(mode: str) -> None:
    robot = in_mode(Mode.WALK)
    assert robot.order(mode, "b") == ()
    assert robot.guard.objection == f"`{mode}` of b refused: a holds the lease; take it over, or wait until it expires"
    assert robot.guard.lease(robot.now) == "a"
    assert robot.mode is Mode.WALK
    assert robot.accept_plan(robot.renewal())
    assert robot.cycle() == ()


def test_takeover_moves_lease_and_repeated_old_orders_do_not_regain_it() -> None:
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
def test_walk_order_is_not_inherited_with_the_lease(take: bool) -> None:
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


def test_walk_order_of_lease_holder_during_fault_applies_afterwards() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    robot.verdict = BROKEN
    robot.cycle()
    robot.order("walk")
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.accept_plan(robot.plan())


@pytest.mark.parametrize("mode", ORDERS)
def test_repeated_or_older_order_is_not_obeyed(mode: str) -> None:
    robot = in_mode(Mode.HOLD)
    older = ModeCommand(robot.now, "sit", 0, "a")
    robot.order(mode)
    again = ModeCommand(robot.now, mode, robot.number, "a")  # type: ignore[arg-type]
    robot.order("stand", "a", take=True)
    if mode == "off":
        assert robot.torque
    assert robot.handle_order(again) == robot.handle_order(older) == ()
    assert robot.guard.objection.startswith("`sit` of a refused: a newer order was given under this name")
    assert robot.mode is Mode.STAND
    assert robot.handle_order(ModeCommand(robot.now, "off", robot.number, "a")) == ()


def test_late_torque_off_after_newer_walk_order_is_obeyed_once() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    late = [ModeCommand(robot.now, "off", robot.number - k, "a") for k in (1, 2, 3)]
    assert robot.handle_order(late[1]) == (Act.TORQUE_OFF,)
    assert robot.handle_order(replace(late[1], stamp_ns=robot.now - ORDER_AGE_NS - 1)) == ()
    robot.order("stand")
    for again in (late[1], late[2]):
        assert robot.handle_order(again) == ()
        assert (
            robot.guard.objection
            == "`off` of a refused: a newer order was given under this name; each client needs its own name"
        )
    assert robot.guard.handle_stop(StopOrder(robot.now, "off", late[1].sequence, "a"), robot.now) == (), "heard already"
    assert robot.torque
    assert robot.handle_order(late[0]) == (Act.TORQUE_OFF,), "no newer stop is known"


@pytest.mark.parametrize("mode", ["off", "stop"])
def test_replayed_older_stop_is_refused(mode: str) -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    assert robot.accept_plan(robot.plan())
    assert robot.handle_order(ModeCommand(robot.now - ORDER_AGE_NS - 1, mode, robot.number - 1, "a")) == ()  # type: ignore[arg-type]
    assert (
        robot.guard.objection
        == f"`{mode}` of a refused: a newer order was given under this name; each client needs its own name"
    )
    assert robot.mode is Mode.WALK


def test_stale_repetition_is_reported_only_for_motion_orders() -> None:
    for mode, objection in (("stop", ""), ("walk", "`walk` of a refused: it is 3.0 s old, at most 2 s allowed")):
        robot = in_mode(Mode.HOLD)
        robot.order(mode)
        assert robot.handle_order(ModeCommand(robot.now - 3_000_000_000, mode, robot.number, "a")) == ()  # type: ignore[arg-type]
        assert robot.guard.objection.split(";")[0] == objection


def test_out_of_order_stop_does_not_take_over_the_lease() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk", "b")
    robot.order("walk", "a", take=True)
    assert robot.handle_order(ModeCommand(robot.now, "stop", 1, "b", take_over=True)) == ()
    assert robot.guard.lease(robot.now) == "a"
    assert not robot.accept_plan(robot.plan())
    assert "not ordered to walk" in robot.guard.refused


def test_objection_persists_on_repetition_and_clears_on_obeyed_order() -> None:
    robot = in_mode(Mode.OFF)
    robot.order("walk")
    words = robot.guard.objection
    assert words == "`walk` refused: the mode is off, order `stand` first"
    robot.handle_order(ModeCommand(robot.now, "walk", robot.number, "a"))
    assert robot.guard.objection == words
    robot.order("stop", "b")
    assert robot.guard.objection == ""


def test_17th_client_may_only_stop() -> None:
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


def test_inactive_client_is_forgotten_and_its_old_orders_are_refused() -> None:
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
        assert robot.handle_order(ModeCommand(robot.now, mode, forgotten, "holder 0", take_over=True)) == ()  # type: ignore[arg-type]
        assert robot.guard.lease(robot.now) == "holder 16"
    assert robot.order("stop", "holder 0") == ()
    assert robot.order("off", "holder 16") == (Act.TORQUE_OFF,)


def test_last_16_stop_only_clients_are_remembered() -> None:
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
def test_stop_order_works_in_each_mode_without_taking_the_lease(mode: Mode) -> None:
    robot = in_mode(mode)
    lease, leading = robot.guard.lease(robot.now), in_mode(mode)
    leading.order("stop", "viewer")
    robot.guard.handle_stop(StopOrder(0, "stop", 5, "viewer"), robot.now)
    assert robot.guard.lease(robot.now) == lease
    assert robot.mode is leading.mode, "as anybody's stop"
    assert robot.guard.handle_stop(StopOrder(0, "off", 6, "viewer"), robot.now) == (Act.TORQUE_OFF,)
    assert robot.mode is Mode.OFF


def test_stop_order_counts_once_and_does_not_block_lease_holder() -> None:
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


def test_refusal_of_an_order_is_reported_for_five_seconds_since_the_last_one() -> None:
    robot = in_mode(Mode.READY)
    for _ in range(2):
        robot.order("walk")
        robot.cycle(OBJECTION_NS)
        assert robot.guard.objection == "`walk` refused: the mode is ready, order `stand` first"
    robot.cycle(1)
    assert robot.guard.objection == ""
