"""Command arbiter: one client at a time moves the legs, any client stops them, and no old order counts."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.actuator.safety.command_arbiter import AWAY_NS, LEASE_NS, CommandArbiter, Ruling
from sextant.services.actuator.safety.command_ordering import AHEAD_NS, ORDER_AGE_NS, WalkOrder
from sextant.shared.wire.messages import ModeCommand, StopOrder

START = 100_000_000_000
SECOND = 1_000_000_000
OBEYED = Ruling(True, "")


def order(mode: str, now_ns: int, holder: str = "a", take: bool = False) -> ModeCommand:
    return ModeCommand(now_ns, mode, now_ns, holder, take)  # type: ignore[arg-type]


def rule(arbiter: CommandArbiter, order: ModeCommand, now_ns: int | None = None, torque_is_off: bool = False) -> Ruling:
    return arbiter.rule(order, order.stamp_ns if now_ns is None else now_ns, torque_is_off)


def test_an_order_to_move_takes_a_free_lease() -> None:
    arbiter = CommandArbiter(START)
    assert arbiter.lease(START) == ""
    assert rule(arbiter, order("stand", START)) == OBEYED
    assert arbiter.lease(START + LEASE_NS) == "a"
    assert arbiter.lease(START + LEASE_NS + 1) == ""


@pytest.mark.parametrize("mode", ["ready", "stand", "walk", "sit"])
def test_another_client_moves_the_legs_only_by_taking_the_lease(mode: str) -> None:
    arbiter = CommandArbiter(START)
    rule(arbiter, order("stand", START))
    ruling = rule(arbiter, order(mode, START + 1, "b"))
    assert not ruling.is_obeyed
    assert "a holds the lease" in (ruling.objection or "")
    assert rule(arbiter, order(mode, START + 2, "b", take=True)) == OBEYED
    assert arbiter.lease(START + 2) == "b"


def test_taking_the_lease_ends_the_walk_of_its_holder() -> None:
    arbiter = CommandArbiter(START)
    rule(arbiter, order("walk", START))
    arbiter.begin_walk()
    assert arbiter.walk_order(START) == WalkOrder("a", START)
    rule(arbiter, order("stop", START + 1, "b", take=True))
    assert not arbiter.may_walk
    assert arbiter.walk_order(START + 1) is None


@pytest.mark.parametrize("mode", ["off", "stop"])
def test_any_client_stops_without_taking_the_lease(mode: str) -> None:
    arbiter = CommandArbiter(START)
    rule(arbiter, order("stand", START))
    assert rule(arbiter, order(mode, START + 1, "b")).is_obeyed
    assert arbiter.lease(START + 1) == "a"


@given(late_ns=st.integers(-10 * SECOND, 10 * SECOND))
def test_an_order_to_move_needs_a_current_stamp(late_ns: int) -> None:
    ruling = rule(CommandArbiter(START), order("stand", START + SECOND), START + SECOND + late_ns)
    assert ruling.is_obeyed == (-AHEAD_NS <= late_ns <= ORDER_AGE_NS)
    assert bool(ruling.objection) != ruling.is_obeyed, "a refusal carries its reason"


@given(late_ns=st.integers(-10 * SECOND, 10 * SECOND))
def test_a_stop_of_an_unknown_client_is_obeyed_with_any_stamp(late_ns: int) -> None:
    assert rule(CommandArbiter(START), order("off", START + SECOND), START + SECOND + late_ns).is_obeyed


def test_a_replayed_stop_older_than_a_known_order_is_refused() -> None:
    arbiter, old = CommandArbiter(START), order("off", START)
    rule(arbiter, order("stand", START + 10 * SECOND))
    ruling = rule(arbiter, old, START + 11 * SECOND)
    assert not ruling.is_obeyed
    assert "each client needs its own name" in (ruling.objection or "")


def test_a_repeated_order_keeps_the_lease_and_nothing_else() -> None:
    arbiter, stand = CommandArbiter(START), order("stand", START)
    rule(arbiter, stand)
    later = START + LEASE_NS + SECOND
    assert rule(arbiter, replace(stand, stamp_ns=later)) == Ruling(False, None)
    assert arbiter.lease(later + LEASE_NS) == "a"


def test_a_repeated_order_after_long_silence_restores_the_lease_but_not_the_walk() -> None:
    arbiter, walk = CommandArbiter(START), order("walk", START)
    rule(arbiter, walk)
    arbiter.begin_walk()
    later = START + AWAY_NS + SECOND
    ruling = rule(arbiter, replace(walk, stamp_ns=later))
    assert "no order was received for 31 s" in (ruling.objection or "")
    assert not arbiter.may_walk
    assert arbiter.lease(later) == "a"


def test_orders_from_before_torque_went_off_do_not_turn_it_on() -> None:
    arbiter = CommandArbiter(START)
    arbiter.turn_off(START + SECOND)
    late = order("stand", START + SECOND // 2)
    assert not rule(arbiter, late, START + SECOND, torque_is_off=True).is_obeyed
    assert rule(arbiter, order("stand", START + SECOND, "b"), torque_is_off=True) == OBEYED


def test_a_torque_off_order_with_a_wrong_clock_still_outlasts_the_order_before() -> None:
    arbiter = CommandArbiter(START)
    rule(arbiter, order("stand", START + 10))
    rule(arbiter, ModeCommand(START + 20, "off", START - 5 * SECOND, "b"))
    assert arbiter.off_ns == START + 11


def test_only_the_walk_order_in_force_outlives_a_restart() -> None:
    kept = WalkOrder("a", START - SECOND)
    for sequence, resumes in ((START - SECOND, True), (START - SECOND + 1, False)):
        arbiter = CommandArbiter(START, walk=kept)
        assert rule(arbiter, ModeCommand(START, "walk", sequence, "a")).is_obeyed == resumes
    assert CommandArbiter(START, walk=kept).walk_order(START + AWAY_NS) == kept
    assert CommandArbiter(START, walk=kept).walk_order(START + AWAY_NS + 1) is None


def test_a_suspended_computer_forgets_the_lease_and_all_orders_before() -> None:
    arbiter = CommandArbiter(START)
    rule(arbiter, order("stand", START))
    arbiter.resume_from_suspend(START + SECOND)
    assert arbiter.lease(START + SECOND) == ""
    ruling = rule(arbiter, order("stand", START + SECOND // 2), START + SECOND)
    assert "before the computer was suspended" in (ruling.objection or "")


def test_a_stop_order_counts_once() -> None:
    arbiter, stop = CommandArbiter(START), StopOrder(START, "off", START, "stop path")
    assert arbiter.rule_stop(stop, START)
    assert not arbiter.rule_stop(stop, START + 1)
    assert arbiter.off_ns == START


def test_a_flood_of_clients_fills_no_memory_and_their_stops_still_count() -> None:
    arbiter = CommandArbiter(START)
    rule(arbiter, order("stand", START))
    refused = [rule(arbiter, order("stand", START + n, f"client {n}", take=True)) for n in range(1, 100)]
    assert "other clients gave orders" in (refused[-1].objection or "")
    assert all(rule(arbiter, order("stop", START + n, f"client {n}")).is_obeyed for n in range(200, 300))
    assert len(arbiter._sequences) <= 16
    assert len(arbiter._stops) <= 16
