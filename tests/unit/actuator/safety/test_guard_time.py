"""Guard and time of orders: late, recorded and replayed orders, and torque off."""

from dataclasses import replace

import pytest

from sextant.services.actuator.safety.command_arbiter import AWAY_NS, LEASE_NS
from sextant.services.actuator.safety.command_ordering import AHEAD_NS, ORDER_AGE_NS, WalkOrder
from sextant.services.actuator.safety.guard import Act, Guard
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.shared.wire.messages import Mode, ModeCommand, StopOrder
from tests.support.guarded import CYCLE, EPOCH, ORDERS, PROFILE, SPENT, in_mode

MOVES = [mode for mode in ORDERS if mode not in ("off", "stop")]
ALLOWED = "at most 2 s allowed; stamp orders by the robot's clock"


@pytest.mark.parametrize("mode", MOVES)
@pytest.mark.parametrize("take", [True, False])
@pytest.mark.parametrize(
    ("off_ns", "words"),
    [(-ORDER_AGE_NS - 1, "2.0 s old"), (-60_000_000_000, "60.0 s old"), (ORDER_AGE_NS + 1, "stamped 2.0 s in the future")],
)
def test_motion_order_with_stale_or_future_stamp_is_refused(mode: str, take: bool, off_ns: int, words: str) -> None:
    robot = in_mode(Mode.HOLD)
    robot.now += LEASE_NS + 1  # no client holds the lease
    put_again = ModeCommand(robot.now + off_ns, mode, robot.now, "b", take)  # type: ignore[arg-type]
    assert robot.handle_order(put_again) == ()
    assert robot.guard.objection == f"`{mode}` of b refused: it is {words}, {ALLOWED}"
    assert robot.mode is Mode.HOLD
    assert robot.guard.lease(robot.now) == ""
    robot.handle_order(replace(put_again, stamp_ns=robot.now))  # its sequence number is still unused
    assert robot.guard.objection == ""
    assert robot.guard.lease(robot.now) == "b"


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.HOLD])
@pytest.mark.parametrize("order", ["ready", "stand", "sit"])
def test_old_order_received_for_the_first_time_is_refused(mode: Mode, order: str) -> None:
    """Check that an old order is refused that the client repeats after a restart.

    The actuator, or the link, has restarted since.
    """
    robot = in_mode(mode)
    robot.now += LEASE_NS + 1
    given = ModeCommand(robot.now, order, robot.now - ORDER_AGE_NS - 1, "b")  # type: ignore[arg-type]
    assert robot.handle_order(given) == ()
    words = f"`{order}` of b refused: by its sequence number, the robot's time [ns], it was given 2.0 s ago; order it again"
    assert robot.guard.objection == words
    assert robot.guard.lease(robot.now) == ""
    assert robot.cycle() == ()
    assert robot.mode is mode
    again = replace(given, stamp_ns=robot.now, sequence=robot.now - ORDER_AGE_NS)
    robot.handle_order(again)
    assert robot.guard.objection == ("`sit` refused: torque is off" if (mode, order) == (Mode.OFF, "sit") else "")


@pytest.mark.parametrize(
    ("begun_s", "given_s", "in_force", "walks"),
    [
        (1, 3600, True, True),
        (30, 3600, True, True),
        (31, 3600, True, False),
        (1, 3600, False, False),
        (10, 15, False, False),
        (31, 31, False, False),
        (31, 29, False, True),  # received late, over a link that was cut
    ],
)
def test_restarted_guard_resumes_only_authorized_walk_order(begun_s: int, given_s: int, in_force: bool, walks: bool) -> None:
    robot = in_mode(Mode.HOLD)
    robot.now = EPOCH + begun_s * 1_000_000_000
    given_ns = robot.now - given_s * 1_000_000_000
    robot.guard = Guard(PROFILE, 0.6, EPOCH, torque=True, walk=WalkOrder("b", given_ns) if in_force else None)
    robot.handle_order(ModeCommand(robot.now, "walk", given_ns, "b"))
    assert robot.guard.lease(robot.now) == ("b" if walks else "")
    assert robot.accept_plan(robot.plan(epoch=EPOCH)) == walks
    assert (robot.guard.objection == "") == walks
    assert (robot.guard.walk_order(robot.now) == WalkOrder("b", given_ns)) == walks


@pytest.mark.parametrize(
    "ending", ["stop", "viewer stops", "sit", "stand", "off", "ready", "tips", "spent", "taken over", "away"]
)
def test_ended_walk_order_is_not_resumed_after_restart(ending: str) -> None:
    for heard in (True, False):  # by a guard that received the order, and by one that has restarted and has not received it yet
        robot = in_mode(Mode.HOLD)
        robot.order("walk", take=True)
        order = robot.guard.walk_order(robot.now)
        assert order == WalkOrder("a", robot.number)
        if not heard:
            robot.guard = Guard(PROFILE, 0.6, robot.now + 1, torque=True, walk=order)
            robot.now += 1
            assert robot.guard.walk_order(robot.now) == order
        if ending == "viewer stops":
            robot.perform(robot.guard.handle_stop(StopOrder(robot.now, "stop", 1, "viewer"), robot.now))
        elif ending == "tips":
            robot.perform(robot.guard.tip("it leans"))
        elif ending == "spent":
            robot.verdict = SPENT
            robot.cycle()
        elif ending == "taken over":
            robot.order("stop", "b", take=True)
        elif ending == "away":
            robot.now += AWAY_NS + 1
        else:
            robot.order(ending, "a" if heard else "b", take=ending != "off")
        assert robot.guard.walk_order(robot.now) is None
        robot.now += CYCLE
        robot.guard = Guard(PROFILE, 0.6, robot.now, robot.torque, walk=robot.guard.walk_order(robot.now))
        robot.handle_order(ModeCommand(robot.now, "walk", order.sequence, order.holder))
        words = "it was given before this actuator started, and was not in force at that time; order it again"
        assert robot.guard.objection == f"`walk` of a refused: by its sequence number, the robot's time [ns], {words}"
        assert robot.guard.lease(robot.now) == ""
        assert not robot.accept_plan(robot.plan(epoch=robot.now))


def test_stand_order_given_just_before_restart_is_obeyed() -> None:
    robot = in_mode(Mode.HOLD)
    robot.guard = Guard(PROFILE, 0.6, robot.now, torque=True)
    robot.now += CYCLE
    assert robot.handle_order(ModeCommand(robot.now, "stand", robot.now - ORDER_AGE_NS, "b")) == (Act.RISE,)


def test_ready_order_in_fault_ends_walk_order() -> None:
    robot = in_mode(Mode.WALK)
    robot.verdict = Verdict(broken="the bus is silent")
    robot.cycle()
    assert robot.mode is Mode.FAULT
    assert robot.guard.walk_order(robot.now) is not None, "it goes on once that is whole"
    robot.order("ready")
    assert robot.guard.walk_order(robot.now) is None


def test_order_older_than_torque_off_does_not_turn_torque_on() -> None:
    robot = in_mode(Mode.HOLD)
    off_ns = robot.now + 500_000_000
    robot.now = off_ns + 100_000_000
    robot.handle_order(ModeCommand(robot.now, "off", off_ns, "a"))
    assert robot.handle_order(ModeCommand(robot.now, "stand", off_ns - 1, "b", take_over=True)) == ()
    assert robot.guard.objection.endswith("it was given before torque went off; order it again")
    assert not robot.torque
    assert robot.handle_order(ModeCommand(robot.now, "stand", off_ns, "b", take_over=True)) == (Act.TORQUE_ON, Act.RISE)
    assert robot.guard.given_ns == off_ns
    robot.now += CYCLE
    robot.perform(robot.guard.handle_stop(StopOrder(0, "off", 1, "viewer"), robot.now))
    assert robot.handle_order(ModeCommand(robot.now, "ready", robot.now - 1, "b", take_over=True)) == ()
    assert robot.handle_order(ModeCommand(robot.now, "ready", robot.now, "b", take_over=True)) == (Act.TORQUE_ON,)


def test_stop_order_does_not_block_older_stand_order() -> None:
    for stops_only in (False, True):
        robot = in_mode(Mode.OFF)
        robot.now += LEASE_NS
        if stops_only:
            robot.guard.handle_stop(StopOrder(0, "stop", 1, "b"), robot.now)
        else:
            robot.order("stop", "b")
        assert robot.handle_order(ModeCommand(robot.now, "stand", robot.now - 1, "a")) == (Act.TORQUE_ON, Act.RISE)


def test_stop_with_implausible_sequence_does_not_block_later_stops() -> None:
    robot = in_mode(Mode.HOLD)
    for number in (10**18, robot.now, robot.now + AHEAD_NS + 1):
        assert robot.handle_order(ModeCommand(robot.now, "off", number, "b")) == (Act.TORQUE_OFF,)


def test_orders_older_than_automatic_torque_off_are_refused() -> None:
    robot = in_mode(Mode.HOLD)
    robot.verdict = SPENT
    while robot.mode is not Mode.OFF:
        robot.cycle(ends=True)
    robot.verdict = Verdict()
    robot.cycle()
    robot.handle_order(ModeCommand(robot.now, "stand", robot.guard.off_ns - 1, "b"))
    assert not robot.torque
    robot.handle_order(ModeCommand(robot.now, "stand", robot.guard.off_ns, "b"))
    assert robot.torque


def test_returning_lease_holder_without_walk_order_gets_no_objection() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("stop", take=True)
    robot.now += AWAY_NS + 1
    robot.handle_order(ModeCommand(robot.now, "stop", robot.number, "a"))
    assert robot.guard.lease(robot.now) == "a"
    assert robot.guard.objection == ""


def test_torque_off_with_slow_clock_cancels_earlier_orders() -> None:
    robot = in_mode(Mode.OFF)
    robot.order("stand")
    given_ns = robot.number
    robot.now += 200_000_000
    robot.handle_order(ModeCommand(robot.now, "off", given_ns - 50_000_000, "b"))
    assert robot.guard.off_ns > given_ns
    robot.guard = Guard(PROFILE, 0.6, EPOCH, torque=False, off_ns=robot.guard.off_ns)
    robot.handle_order(ModeCommand(robot.now, "stand", given_ns, "a"))
    assert not robot.torque


def test_restarted_guard_refuses_orders_older_than_latch() -> None:
    robot = in_mode(Mode.OFF)
    robot.guard = Guard(PROFILE, 0.6, EPOCH, torque=False, off_ns=robot.now)
    assert robot.handle_order(ModeCommand(robot.now, "stand", robot.now - 1, "a")) == ()
    assert robot.handle_order(ModeCommand(robot.now, "stand", robot.now, "a")) == (Act.TORQUE_ON, Act.RISE)


def test_returning_lease_holder_must_order_walk_again_after_30_s() -> None:
    for away_ns, walks in ((AWAY_NS, True), (AWAY_NS + 1, False)):
        robot = in_mode(Mode.HOLD)
        robot.order("walk")
        robot.now += away_ns
        robot.handle_order(ModeCommand(robot.now, "walk", robot.number, "a"))
        assert robot.guard.lease(robot.now) == "a"
        assert robot.accept_plan(robot.plan()) == walks
        assert robot.guard.objection == ("" if walks else "`walk` of a refused: no order was received for 30 s; order it again")
    assert robot.order("walk") == ()
    assert robot.accept_plan(robot.plan())


def test_order_with_sequence_in_the_future_is_refused() -> None:
    robot = in_mode(Mode.HOLD)
    ahead = robot.now + AHEAD_NS
    robot.handle_order(ModeCommand(robot.now, "sit", ahead + 1, "b"))
    assert robot.guard.objection == "`sit` of b refused: its sequence number, the time of the order [ns], lies in the future"
    robot.handle_order(ModeCommand(robot.now, "sit", ahead, "b", take_over=True))
    assert robot.guard.objection == ""


@pytest.mark.parametrize("off_ns", [-ORDER_AGE_NS, ORDER_AGE_NS])
def test_order_with_2_s_delay_is_accepted(off_ns: int) -> None:
    robot = in_mode(Mode.HOLD)
    robot.handle_order(ModeCommand(robot.now + off_ns, "sit", robot.now + min(off_ns, 0), "b"))
    assert robot.guard.objection == ""
    assert robot.cycle() == (Act.LIE_DOWN,)


def test_replayed_walk_order_does_not_extend_lease() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    recorded = ModeCommand(robot.now, "walk", robot.number, "a")
    given_ns = robot.now
    robot.now += ORDER_AGE_NS + 1
    robot.handle_order(recorded)
    assert robot.guard.lease(given_ns + LEASE_NS + 1) == ""


def test_replayed_stop_order_does_not_extend_lease() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    robot.order("stop")
    recorded, given_ns = ModeCommand(robot.now, "stop", robot.number, "a"), robot.now
    robot.now += ORDER_AGE_NS + 1
    assert robot.handle_order(recorded) == ()
    assert robot.guard.lease(given_ns + LEASE_NS) == "a"
    assert robot.guard.lease(given_ns + LEASE_NS + 1) == ""


@pytest.mark.parametrize("mode", ["off", "stop"])
def test_stale_stop_is_obeyed_without_taking_or_extending_lease(mode: str) -> None:
    robot = in_mode(Mode.WALK)
    robot.order("walk")
    given_ns, later = robot.now, robot.now + 1
    robot.now += ORDER_AGE_NS + 1
    old_ns = robot.now - ORDER_AGE_NS - 1
    acts = robot.handle_order(ModeCommand(old_ns, mode, 1, "b", take_over=True))  # type: ignore[arg-type]
    assert acts == ((Act.TORQUE_OFF,) if mode == "off" else (Act.SET_DOWN,))
    assert robot.guard.lease(robot.now) == "a"
    robot.handle_order(ModeCommand(old_ns, mode, later, "a"))  # type: ignore[arg-type]
    robot.handle_order(ModeCommand(old_ns, mode, later, "a"))  # type: ignore[arg-type]
    assert robot.guard.lease(given_ns + LEASE_NS) == "a"
    assert robot.guard.lease(given_ns + LEASE_NS + 1) == ""


@pytest.mark.parametrize("off_ns", [-10 * ORDER_AGE_NS, 10 * ORDER_AGE_NS])
def test_stop_with_wrong_stamp_does_not_block_its_client(off_ns: int) -> None:
    robot = in_mode(Mode.HOLD)
    robot.handle_order(ModeCommand(robot.now + off_ns, "stop", 10**18, "b", take_over=True))
    assert robot.guard.lease(robot.now) == ""
    robot.handle_order(ModeCommand(robot.now, "stop", 7, "b", take_over=True))
    assert (robot.guard.objection, robot.guard.lease(robot.now)) == ("", "b"), "its numbers count from those of now"
    robot.handle_order(ModeCommand(robot.now, "walk", 8, "b"))
    assert robot.guard.objection == ""
    assert robot.accept_plan(robot.plan())
    robot.handle_order(ModeCommand(robot.now + off_ns, "stop", 5, "b"))
    assert robot.guard.objection.startswith("`stop` of b refused: a newer order was given under this name")
    assert robot.mode is Mode.WALK


@pytest.mark.parametrize("begun_anew", [False, True])
def test_replayed_orders_move_nothing(begun_anew: bool) -> None:
    robot = in_mode(Mode.OFF)
    said: list[ModeCommand] = []
    for mode in ("stand", "walk", "sit", "stand", "walk", "off"):
        robot.number += 1
        said.append(ModeCommand(robot.now, mode, robot.number, "a"))  # type: ignore[arg-type]
        robot.handle_order(said[-1])
        robot.cycle()
    assert robot.mode is Mode.OFF
    robot.now += 10 * LEASE_NS  # no client holds the lease any more
    if begun_anew:  # the new guard remembers no orders
        robot.guard = Guard(PROFILE, 0.6, EPOCH, torque=False)
    refused = 0
    for again in said[:-1] * 200:
        assert robot.handle_order(again) == ()
        refused += robot.guard.objection.endswith(ALLOWED)
    assert refused == 1000
    assert robot.mode is Mode.OFF
    assert robot.guard.lease(robot.now) == ""


def test_replayed_plans_are_refused() -> None:
    robot = in_mode(Mode.WALK)
    old = [robot.plan(step=step, stamp_ns=robot.now) for step in range(1, 201)]
    robot.now += 10 * LEASE_NS
    robot.order("walk")
    refused = 0
    for plan in old:
        assert not robot.accept_plan(plan)
        refused += "old" in robot.guard.refused
    assert refused == 200


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.READY, Mode.STAND, Mode.HOLD, Mode.WALK, Mode.SIT])
def test_suspend_cancels_all_earlier_orders(mode: Mode) -> None:
    robot = in_mode(mode)
    before = robot.number
    acts = robot.guard.resume_from_suspend(3600.0, robot.now)
    assert acts == {Mode.WALK: (Act.SET_DOWN,), Mode.STAND: (Act.FREEZE,), Mode.SIT: (Act.FREEZE,)}.get(mode, ())
    robot.perform(acts)
    assert robot.guard.objection == "all orders are cancelled: the computer was suspended for 3600 s; order again"
    assert robot.guard.lease(robot.now) == ""
    assert robot.guard.walk_order(robot.now) is None
    assert robot.mode is {Mode.STAND: Mode.READY, Mode.SIT: Mode.READY}.get(mode, mode)
    assert not robot.accept_plan(robot.plan())
    for order in MOVES:
        for sequence in (before, robot.now):
            assert robot.handle_order(ModeCommand(robot.now, order, sequence, "b")) == ()  # type: ignore[arg-type]
    if mode is Mode.HOLD:
        words = "it was given before the computer was suspended; order it again"
        put = ModeCommand(robot.now, "sit", robot.now, "c")
        robot.handle_order(put)
        assert robot.guard.objection == f"`sit` of c refused: by its sequence number, the robot's time [ns], {words}"
    assert robot.guard.lease(robot.now) == ""
    robot.cycle(ends=True)
    assert robot.mode is {Mode.STAND: Mode.READY, Mode.SIT: Mode.READY, Mode.WALK: Mode.HOLD}.get(mode, mode)
    robot.handle_order(ModeCommand(robot.now, "ready", robot.now + 1, "b"))
    assert robot.guard.lease(robot.now) == "b"
