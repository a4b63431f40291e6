"""The guard and its orders: what turns torque on, who leads, what each order does in each mode."""

from dataclasses import replace

import pytest

from services.actuator.guard import AWAY_NS, LEASE_NS, ORDER_AGE_NS, Act, Guard
from services.actuator.health import Verdict
from services.actuator.latch import AHEAD_NS
from shared.messages import Mode, ModeCommand, StopOrder
from tests.support.guarded import BROKEN, CYCLE, EPOCH, ORDERS, PROFILE, SPENT, in_mode, rested

MODES = list(Mode)

# ------------------------------------------------------------------------------------------------------------- torque


@pytest.mark.parametrize("torque", [True, False])
def test_it_begins_as_the_servos_stand_and_says_so(torque: bool) -> None:
    guard = Guard(PROFILE, 0.6, EPOCH, torque)
    assert guard.mode is (Mode.HOLD if torque else Mode.OFF)
    assert guard.reason == ("torque was on at the start" if torque else "torque is off; order `stand` to begin")
    assert (guard.refused, guard.refused_ns, guard.objection, guard.tipped) == ("", -1, "", "")
    assert guard.epoch == EPOCH
    assert guard.lease(0) == ""


@pytest.mark.parametrize("torque", [True, False])
def test_it_walks_by_nobodys_order(torque: bool) -> None:
    robot = in_mode(Mode.HOLD if torque else Mode.OFF)
    assert not robot.consider(robot.plan())
    assert robot.guard.refused == f"plan of step 1 refused: the mode is {robot.mode}, not ordered to walk"


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("holder", ["a", "b"])
def test_anybody_lets_go_from_anywhere_in_one_order(mode: Mode, holder: str) -> None:
    robot = in_mode(mode)
    assert robot.order("off", holder) == (Act.LET_GO,)
    assert robot.mode is Mode.OFF
    assert robot.guard.reason == "ordered off"
    assert not robot.torque
    assert not robot.consider(robot.plan())
    assert robot.guard.refused.endswith("refused: the mode is off, not ordered to walk")


def test_off_is_latched() -> None:
    robot = in_mode(Mode.WALK)
    robot.order("off")
    for mode in ("off", "stop", "walk", "sit"):
        robot.order(mode)
        assert robot.cycle() == ()
        assert robot.mode is Mode.OFF
    robot.guard.risen()
    assert robot.guard.seated(robot.now) == ()
    assert robot.guard.tip("it leans") == ()
    assert not robot.consider(robot.plan())
    robot.verdict = SPENT
    assert robot.cycle() == ()
    assert robot.mode is Mode.OFF


def test_an_order_turns_torque_on_and_leads_out() -> None:
    robot = in_mode(Mode.OFF)
    assert robot.order("ready") == (Act.GRIP,)
    assert robot.mode is Mode.READY
    assert robot.guard.reason == "torque is on; order `stand` to rise"
    assert robot.order("stand") == (Act.RISE,)
    assert robot.mode is Mode.STAND
    robot.order("off")
    assert robot.order("stand") == (Act.GRIP, Act.RISE)
    assert robot.guard.reason == "standing up"


@pytest.mark.parametrize("verdict", [BROKEN, SPENT])
@pytest.mark.parametrize("mode", ["ready", "stand"])
def test_torque_stays_off_while_something_is_wrong_and_the_order_is_not_kept_for_later(mode: str, verdict: Verdict) -> None:
    robot = in_mode(Mode.OFF)
    robot.verdict = verdict
    robot.cycle()
    assert robot.order(mode) == ()
    why = verdict.broken or verdict.sit
    assert robot.guard.objection == (f"torque stays off: {why}" if mode == "ready" else f"`stand` refused: {why}")
    robot.verdict = Verdict()
    again = ModeCommand(robot.now, mode, robot.number, "a")  # type: ignore[arg-type]
    assert robot.cycle() == robot.hear(again) == ()
    assert robot.mode is Mode.OFF


@pytest.mark.parametrize("mode", [Mode.READY, Mode.FAULT])
def test_ready_takes_up_servos_that_have_lost_their_torque(mode: Mode) -> None:
    robot = in_mode(mode)
    assert robot.order("ready") == (Act.GRIP,)
    assert robot.mode is Mode.READY
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.mode is Mode.READY


# ------------------------------------------------------------------------------------------------- orders and the lease


def test_a_lease_lasts_three_seconds_from_the_last_order_be_it_repeated() -> None:
    robot = in_mode(Mode.HOLD)
    robot.now = 0
    robot.order("walk")
    again = ModeCommand(1_500_000_000, "walk", robot.number, "a")
    assert robot.guard.lease(LEASE_NS) == "a"
    assert robot.guard.lease(LEASE_NS + 1) == ""
    robot.now = 2_000_000_000
    robot.hear(again)
    assert robot.guard.lease(2_000_000_000 + LEASE_NS) == "a"
    robot.now = 4_000_000_000
    robot.order("stop")
    assert robot.guard.lease(4_000_000_000 + LEASE_NS) == "a"
    assert LEASE_NS == 3_000_000_000


@pytest.mark.parametrize("mode", [mode for mode in ORDERS if mode not in ("off", "stop")])
def test_one_leads_and_others_are_told_who(mode: str) -> None:
    robot = in_mode(Mode.WALK)
    assert robot.order(mode, "b") == ()
    assert robot.guard.objection == f"`{mode}` of b refused: a holds the lease; take it over, or wait for its end"
    assert robot.guard.lease(robot.now) == "a"
    assert robot.mode is Mode.WALK
    assert robot.consider(robot.renewal())
    assert robot.cycle() == ()


def test_who_takes_over_leads_and_the_other_one_does_not_by_repeating() -> None:
    robot = in_mode(Mode.WALK)
    before = ModeCommand(robot.now, "walk", robot.number, "a")
    robot.order("walk", "b", take=True)
    assert robot.guard.objection == ""
    robot.now += CYCLE
    robot.hear(before)
    assert robot.guard.lease(robot.now - CYCLE + LEASE_NS) == "b"
    assert robot.guard.lease(robot.now + LEASE_NS) == ""
    robot.now += LEASE_NS
    robot.hear(replace(before, stamp_ns=robot.now))
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
    assert not robot.consider(robot.plan())
    assert "not ordered to walk" in robot.guard.refused


def test_who_leads_goes_on_leading_by_new_orders() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    robot.verdict = BROKEN
    robot.cycle()
    robot.order("walk")
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.consider(robot.plan())


@pytest.mark.parametrize("mode", ORDERS)
def test_an_order_counts_once_and_an_older_one_not_at_all(mode: str) -> None:
    robot = in_mode(Mode.HOLD)
    older = ModeCommand(robot.now, "off", 0, "a")
    robot.order(mode)
    again = ModeCommand(robot.now, mode, robot.number, "a")  # type: ignore[arg-type]
    robot.order("stand", "a", take=True)
    if mode == "off":
        assert robot.torque
    assert robot.hear(again) == robot.hear(older) == ()
    assert robot.guard.objection == "`off` of a refused: it is older than their newest order"
    assert robot.mode is Mode.STAND
    assert robot.hear(ModeCommand(robot.now, "off", robot.number, "a")) == ()


MOVES = [mode for mode in ORDERS if mode not in ("off", "stop")]
ALLOWED = "at most 2 s allowed; orders are stamped by the robot's clock"


@pytest.mark.parametrize("mode", MOVES)
@pytest.mark.parametrize("take", [True, False])
@pytest.mark.parametrize(
    ("off_ns", "words"),
    [(-ORDER_AGE_NS - 1, "2.0 s old"), (-60_000_000_000, "60.0 s old"), (ORDER_AGE_NS + 1, "stamped 2.0 s ahead of now")],
)
def test_an_order_to_move_that_is_not_of_now_counts_for_nothing(mode: str, take: bool, off_ns: int, words: str) -> None:
    robot = in_mode(Mode.HOLD)
    robot.now += LEASE_NS + 1  # nobody leads
    put_again = ModeCommand(robot.now + off_ns, mode, robot.now, "b", take)  # type: ignore[arg-type]
    assert robot.hear(put_again) == ()
    assert robot.guard.objection == f"`{mode}` of b refused: it is {words}, {ALLOWED}"
    assert robot.mode is Mode.HOLD
    assert robot.guard.lease(robot.now) == ""
    robot.hear(replace(put_again, stamp_ns=robot.now))  # its number is not used up
    assert robot.guard.objection == ""
    assert robot.guard.lease(robot.now) == "b"


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.HOLD])
@pytest.mark.parametrize("order", ["ready", "stand", "sit"])
def test_what_was_ordered_a_while_ago_and_is_heard_for_the_first_time_moves_nothing(mode: Mode, order: str) -> None:
    """It is repeated by who has ordered it, and this process, or the link, began anew since."""
    robot = in_mode(mode)
    robot.now += LEASE_NS + 1
    given = ModeCommand(robot.now, order, robot.now - ORDER_AGE_NS - 1, "b")  # type: ignore[arg-type]
    assert robot.hear(given) == ()
    words = (
        f"`{order}` of b refused: by its sequence, the time [ns] of the robot's clock, it was given 2.0 s ago; order it anew"
    )
    assert robot.guard.objection == words
    assert robot.guard.lease(robot.now) == ""
    assert robot.cycle() == ()
    assert robot.mode is mode
    again = replace(given, stamp_ns=robot.now, sequence=robot.now - ORDER_AGE_NS)
    robot.hear(again)
    assert robot.guard.objection == ("`sit` refused: torque is off" if (mode, order) == (Mode.OFF, "sit") else "")


def test_who_led_a_walk_goes_on_leading_it_where_the_guard_begins_anew_and_else_orders_it_anew() -> None:
    for begun_s, given_s, walks in ((1, 3600, True), (30, 3600, True), (31, 3600, False), (31, 31, False), (31, 29, True)):
        robot = in_mode(Mode.HOLD)
        robot.guard = Guard(PROFILE, 0.6, EPOCH, torque=True)
        robot.now = EPOCH + begun_s * 1_000_000_000
        robot.hear(ModeCommand(robot.now, "walk", robot.now - given_s * 1_000_000_000, "b"))
        assert robot.guard.lease(robot.now) == ("b" if walks else "")
        assert robot.consider(robot.plan(epoch=EPOCH)) == walks, (begun_s, given_s)
        assert (robot.guard.objection == "") == walks


def test_no_order_of_before_torque_was_ordered_off_turns_it_on() -> None:
    robot = in_mode(Mode.HOLD)
    off_ns = robot.now + 500_000_000
    robot.now = off_ns + 100_000_000
    robot.hear(ModeCommand(robot.now, "off", off_ns, "a"))
    assert robot.hear(ModeCommand(robot.now, "stand", off_ns - 1, "b", take=True)) == ()
    assert robot.guard.objection.endswith("it was given before torque was ordered off; order it anew")
    assert not robot.torque
    assert robot.hear(ModeCommand(robot.now, "stand", off_ns, "b", take=True)) == (Act.GRIP, Act.RISE)
    assert robot.guard.given_ns == off_ns
    robot.now += CYCLE
    robot.perform(robot.guard.hear_stop(StopOrder(0, "off", 1, "viewer"), robot.now))
    assert robot.hear(ModeCommand(robot.now, "ready", robot.now - 1, "b", take=True)) == ()
    assert robot.hear(ModeCommand(robot.now, "ready", robot.now, "b", take=True)) == (Act.GRIP,)


def test_torque_comes_on_for_an_order_of_before_somebody_stopped() -> None:
    for stops_only in (False, True):
        robot = in_mode(Mode.OFF)
        robot.now += LEASE_NS
        if stops_only:
            robot.guard.hear_stop(StopOrder(0, "stop", 1, "b"), robot.now)
        else:
            robot.order("stop", "b")
        assert robot.hear(ModeCommand(robot.now, "stand", robot.now - 1, "a")) == (Act.GRIP, Act.RISE)


def test_a_stop_whose_number_is_no_time_is_obeyed_and_bars_no_later_ones_way() -> None:
    robot = in_mode(Mode.HOLD)
    for number in (10**18, robot.now, robot.now + AHEAD_NS + 1):
        assert robot.hear(ModeCommand(robot.now, "off", number, "b")) == (Act.LET_GO,)


def test_a_robot_that_has_let_go_by_itself_rises_for_no_order_of_before() -> None:
    robot = in_mode(Mode.HOLD)
    robot.verdict = SPENT
    while robot.mode is not Mode.OFF:
        robot.cycle(ends=True)
    robot.verdict = Verdict()
    robot.cycle()
    robot.hear(ModeCommand(robot.now, "stand", robot.guard.off_ns - 1, "b"))
    assert not robot.torque
    robot.hear(ModeCommand(robot.now, "stand", robot.guard.off_ns, "b"))
    assert robot.torque


def test_a_leader_who_was_unheard_for_long_and_had_ordered_no_walk_is_told_nothing() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("stop", take=True)
    robot.now += AWAY_NS + 1
    robot.hear(ModeCommand(robot.now, "stop", robot.number, "a"))
    assert robot.guard.lease(robot.now) == "a"
    assert robot.guard.objection == ""


def test_an_order_to_let_go_that_comes_by_a_late_clock_takes_back_what_was_ordered_before_it() -> None:
    robot = in_mode(Mode.OFF)
    robot.order("stand")
    given_ns = robot.number
    robot.now += 200_000_000
    robot.hear(ModeCommand(robot.now, "off", given_ns - 50_000_000, "b"))
    assert robot.guard.off_ns > given_ns
    robot.guard = Guard(PROFILE, 0.6, EPOCH, torque=False, off_ns=robot.guard.off_ns)
    robot.hear(ModeCommand(robot.now, "stand", given_ns, "a"))
    assert not robot.torque


def test_a_latch_that_was_closed_counts_for_a_guard_that_begins_anew() -> None:
    robot = in_mode(Mode.OFF)
    robot.guard = Guard(PROFILE, 0.6, EPOCH, torque=False, off_ns=robot.now)
    assert robot.hear(ModeCommand(robot.now, "stand", robot.now - 1, "a")) == ()
    assert robot.hear(ModeCommand(robot.now, "stand", robot.now, "a")) == (Act.GRIP, Act.RISE)


def test_a_leader_who_was_unheard_for_long_leads_again_but_does_not_walk_on() -> None:
    for away_ns, walks in ((AWAY_NS, True), (AWAY_NS + 1, False)):
        robot = in_mode(Mode.HOLD)
        robot.order("walk")
        robot.now += away_ns
        robot.hear(ModeCommand(robot.now, "walk", robot.number, "a"))
        assert robot.guard.lease(robot.now) == "a"
        assert robot.consider(robot.plan()) == walks
        assert robot.guard.objection == (
            "" if walks else "`walk` of a refused: nothing was heard of it for 30 s; order it anew"
        )
    assert robot.order("walk") == ()
    assert robot.consider(robot.plan())


def test_an_order_given_ahead_of_now_is_refused() -> None:
    robot = in_mode(Mode.HOLD)
    ahead = robot.now + AHEAD_NS
    robot.hear(ModeCommand(robot.now, "sit", ahead + 1, "b"))
    assert robot.guard.objection == "`sit` of b refused: its sequence, when it was given [ns], is ahead of now"
    robot.hear(ModeCommand(robot.now, "sit", ahead, "b", take=True))
    assert robot.guard.objection == ""


@pytest.mark.parametrize("off_ns", [-ORDER_AGE_NS, ORDER_AGE_NS])
def test_an_order_may_be_two_seconds_under_way(off_ns: int) -> None:
    robot = in_mode(Mode.HOLD)
    robot.hear(ModeCommand(robot.now + off_ns, "sit", robot.now + min(off_ns, 0), "b"))
    assert robot.guard.objection == ""
    assert robot.cycle() == (Act.LIE_DOWN,)


def test_a_repetition_that_was_recorded_keeps_no_lease() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    recorded = ModeCommand(robot.now, "walk", robot.number, "a")
    given_ns = robot.now
    robot.now += ORDER_AGE_NS + 1
    robot.hear(recorded)
    assert robot.guard.lease(given_ns + LEASE_NS + 1) == ""


def test_a_stop_that_was_recorded_and_is_put_again_keeps_no_lease() -> None:
    robot = in_mode(Mode.HOLD)
    robot.order("walk")
    robot.order("stop")
    recorded, given_ns = ModeCommand(robot.now, "stop", robot.number, "a"), robot.now
    robot.now += ORDER_AGE_NS + 1
    assert robot.hear(recorded) == ()
    assert robot.guard.lease(given_ns + LEASE_NS) == "a"
    assert robot.guard.lease(given_ns + LEASE_NS + 1) == ""


@pytest.mark.parametrize("mode", ["off", "stop"])
def test_a_stop_that_is_not_of_now_is_obeyed_but_takes_and_keeps_no_lease(mode: str) -> None:
    robot = in_mode(Mode.WALK)
    robot.order("walk")
    given_ns, later = robot.now, robot.now + 1
    robot.now += ORDER_AGE_NS + 1
    old_ns = robot.now - ORDER_AGE_NS - 1
    acts = robot.hear(ModeCommand(old_ns, mode, 1, "b", take=True))  # type: ignore[arg-type]
    assert acts == ((Act.LET_GO,) if mode == "off" else (Act.SET_DOWN,))
    assert robot.guard.lease(robot.now) == "a"
    robot.hear(ModeCommand(old_ns, mode, later, "a"))  # type: ignore[arg-type]
    robot.hear(ModeCommand(old_ns, mode, later, "a"))  # type: ignore[arg-type]
    assert robot.guard.lease(given_ns + LEASE_NS) == "a"
    assert robot.guard.lease(given_ns + LEASE_NS + 1) == ""


@pytest.mark.parametrize("off_ns", [-10 * ORDER_AGE_NS, 10 * ORDER_AGE_NS])
def test_a_stop_that_is_not_of_now_locks_nobody_out(off_ns: int) -> None:
    robot = in_mode(Mode.HOLD)
    robot.hear(ModeCommand(robot.now + off_ns, "stop", 10**18, "b", take=True))
    assert robot.guard.lease(robot.now) == ""
    robot.hear(ModeCommand(robot.now, "stop", 7, "b", take=True))
    assert (robot.guard.objection, robot.guard.lease(robot.now)) == ("", "b"), "its numbers count from those of now"
    robot.hear(ModeCommand(robot.now, "walk", 8, "b"))
    assert robot.guard.objection == ""
    assert robot.consider(robot.plan())
    robot.hear(ModeCommand(robot.now + off_ns, "stop", 5, "b"))
    assert robot.guard.objection == "`stop` of b refused: it is older than their newest order"
    assert robot.mode is Mode.WALK


def test_a_repetition_says_nothing_and_a_new_order_that_is_obeyed_clears_the_objection() -> None:
    robot = in_mode(Mode.OFF)
    robot.order("walk")
    words = robot.guard.objection
    assert words == "`walk` refused: the mode is off, order `stand` first"
    robot.hear(ModeCommand(robot.now, "walk", robot.number, "a"))
    assert robot.guard.objection == words
    robot.order("stop", "b")
    assert robot.guard.objection == ""


def test_more_than_sixteen_are_remembered_by_none_but_may_stop() -> None:
    robot = in_mode(Mode.HOLD)
    for k in range(16):
        robot.order("stop", f"holder {k}")
    for _ in range(2):
        assert robot.order("stand", "holder 16", take=True) == ()
        assert robot.guard.objection == "`stand` of holder 16 refused: 16 others have given orders"
    assert robot.order("stand", "holder 15") == (Act.RISE,)
    assert robot.guard.objection == ""
    robot.order("walk", "holder 16")
    assert robot.order("stop", "holder 16", take=True) == (Act.FREEZE,)
    assert robot.guard.objection == ""
    assert robot.order("stop", "holder 0") == ()
    assert robot.order("off", "holder 16") == (Act.LET_GO,)


def test_of_those_who_let_go_without_leading_the_last_sixteen_are_remembered() -> None:
    robot = in_mode(Mode.HOLD)
    words = [StopOrder(robot.now, "off", 1, f"onlooker {k}") for k in range(17)]
    for order in words[:16]:
        assert robot.guard.hear_stop(order, robot.now) == (Act.LET_GO,)
    assert robot.guard.hear_stop(words[0], robot.now) == (), "a repetition is nothing new"
    assert robot.guard.hear_stop(words[16], robot.now) == (Act.LET_GO,)
    assert robot.guard.hear_stop(words[0], robot.now) == (), "it was heard since"
    assert robot.guard.hear_stop(words[1], robot.now) == (Act.LET_GO,), "forgotten: in doubt it is obeyed"


# ---------------------------------------------------------------------------------------------------------------- modes

REACTIONS: list[tuple[Mode, str, tuple[Act, ...], Mode]] = [
    (Mode.OFF, "stop", (), Mode.OFF),
    (Mode.OFF, "walk", (), Mode.OFF),
    (Mode.OFF, "sit", (), Mode.OFF),
    (Mode.READY, "stop", (), Mode.READY),
    (Mode.READY, "stand", (Act.RISE,), Mode.STAND),
    (Mode.READY, "walk", (), Mode.READY),
    (Mode.READY, "sit", (Act.LIE_DOWN,), Mode.SIT),
    (Mode.STAND, "stop", (Act.FREEZE,), Mode.READY),
    (Mode.STAND, "ready", (Act.FREEZE,), Mode.READY),
    (Mode.STAND, "stand", (Act.RISE,), Mode.STAND),
    (Mode.STAND, "walk", (), Mode.STAND),
    (Mode.STAND, "sit", (Act.LIE_DOWN,), Mode.SIT),
    (Mode.HOLD, "stop", (), Mode.HOLD),
    (Mode.HOLD, "ready", (), Mode.HOLD),
    (Mode.HOLD, "stand", (Act.RISE,), Mode.STAND),
    (Mode.HOLD, "walk", (), Mode.HOLD),
    (Mode.HOLD, "sit", (Act.LIE_DOWN,), Mode.SIT),
    (Mode.WALK, "stop", (Act.SET_DOWN,), Mode.WALK),
    (Mode.WALK, "ready", (Act.SET_DOWN,), Mode.WALK),
    (Mode.WALK, "stand", (Act.SET_DOWN,), Mode.WALK),
    (Mode.WALK, "walk", (), Mode.WALK),
    (Mode.WALK, "sit", (Act.SET_DOWN,), Mode.WALK),
    (Mode.SIT, "stop", (Act.FREEZE,), Mode.READY),
    (Mode.SIT, "ready", (Act.FREEZE,), Mode.READY),
    (Mode.SIT, "stand", (Act.RISE,), Mode.STAND),
    (Mode.SIT, "walk", (), Mode.SIT),
    (Mode.SIT, "sit", (), Mode.SIT),
    (Mode.FAULT, "stop", (), Mode.FAULT),
    (Mode.FAULT, "stand", (), Mode.FAULT),
    (Mode.FAULT, "walk", (), Mode.FAULT),
    (Mode.FAULT, "sit", (Act.LIE_DOWN,), Mode.SIT),
]


@pytest.mark.parametrize(("mode", "order", "acts", "then"), REACTIONS)
def test_what_an_order_does_in_each_mode(mode: Mode, order: str, acts: tuple[Act, ...], then: Mode) -> None:
    robot = in_mode(mode)
    assert (*robot.order(order), *robot.cycle()) == acts
    assert robot.mode is then
    done = acts or (then is mode and order in ("stop", "ready")) or (mode, order) == (Mode.SIT, "sit")
    walks = order == "walk" and mode in (Mode.HOLD, Mode.STAND, Mode.WALK)
    assert (robot.guard.objection == "") == bool(done or walks), "whatever is refused is refused in words"


@pytest.mark.parametrize(
    ("mode", "order", "words"),
    [
        (Mode.OFF, "sit", "`sit` refused: torque is off"),
        (Mode.SIT, "walk", "`walk` refused: the mode is sit, order `stand` first"),
        (Mode.FAULT, "walk", "`walk` refused: a servo is silent"),
        (Mode.FAULT, "stand", "`stand` refused: a servo is silent"),
    ],
)
def test_what_is_refused_is_refused_in_words(mode: Mode, order: str, words: str) -> None:
    robot = in_mode(mode)
    robot.order(order)
    assert robot.guard.objection == words


def test_it_stands_and_sits_when_that_is_done() -> None:
    robot = in_mode(Mode.STAND)
    robot.cycle(ends=True)
    assert (robot.mode, robot.guard.reason) == (Mode.HOLD, "standing")
    robot.order("sit")
    robot.cycle()
    assert (robot.mode, robot.guard.reason) == (Mode.SIT, "ordered to sit")
    robot.cycle(ends=True)
    assert (robot.mode, robot.guard.reason) == (Mode.READY, "sitting; order `stand` to rise, or `off`")
    assert robot.torque
    robot.order("stand")
    robot.order("stop")
    assert robot.guard.reason == "stopped on its way; order `stand` or `sit`"
    robot.guard.risen()
    assert robot.guard.seated(robot.now) == ()
    assert robot.mode is Mode.READY


def test_it_sits_down_from_a_walk_when_its_feet_are_down() -> None:
    robot = in_mode(Mode.WALK)
    assert robot.order("sit") == (Act.SET_DOWN,)
    assert not robot.consider(robot.renewal())
    assert robot.guard.refused == "plan of step 1 refused: ordered to sit"
    assert robot.cycle() == ()
    assert robot.cycle(ends=True) == (Act.LIE_DOWN,)
    assert robot.mode is Mode.SIT


@pytest.mark.parametrize(("order", "then"), [("stop", Mode.HOLD), ("stand", Mode.HOLD), ("walk", Mode.WALK)])
def test_the_newest_order_counts_while_the_feet_come_down(order: str, then: Mode) -> None:
    robot = in_mode(Mode.WALK)
    robot.order("sit")
    robot.order(order)
    assert robot.consider(robot.renewal()) == (order == "walk")
    robot.cycle()
    assert Act.LIE_DOWN not in robot.cycle(ends=order != "walk")
    assert robot.mode is then


@pytest.mark.parametrize("mode", [Mode.STAND, Mode.HOLD, Mode.WALK])
@pytest.mark.parametrize("order", ["stop", "ready", "stand", "sit", "off"])
def test_every_other_order_ends_the_walk(mode: Mode, order: str) -> None:
    robot = in_mode(mode)
    robot.order("walk")
    robot.order(order)
    rested(robot)
    if robot.mode is not Mode.HOLD:
        robot.order("stand")
        rested(robot)
    assert robot.mode is Mode.HOLD
    assert not robot.consider(robot.plan())
    assert robot.guard.refused.endswith("refused: the mode is hold, not ordered to walk")


def test_a_robot_that_was_ordered_to_walk_while_it_rises_walks_when_it_stands() -> None:
    robot = in_mode(Mode.STAND)
    robot.order("walk")
    assert not robot.consider(robot.plan())
    assert robot.guard.refused == "plan of step 1 refused: the mode is stand, not ordered to walk"
    robot.cycle(ends=True)
    assert robot.consider(robot.plan())


# ----------------------------------------------------------------------------------------------------------- tipping


def test_a_body_that_tips_stops_until_a_new_order() -> None:
    robot = in_mode(Mode.WALK)
    assert robot.guard.tip("it leans") == (Act.SET_DOWN,)
    assert not robot.consider(robot.renewal())
    assert robot.guard.refused == "plan of step 1 refused: it leans; order `walk` anew"
    robot.cycle()
    assert robot.guard.reason == "it leans"
    robot.cycle(ends=True)
    assert (robot.mode, robot.guard.reason) == (Mode.HOLD, "it leans")
    assert robot.guard.tip("it leans") == ()
    robot.hear(ModeCommand(robot.now, "walk", robot.number, "a"))
    assert not robot.consider(robot.plan())
    robot.order("walk")
    assert robot.guard.tipped == ""
    assert robot.consider(robot.plan())


@pytest.mark.parametrize("way", [("stand",), ("off", "stand")])
def test_who_stands_up_has_not_tipped(way: tuple[str, ...]) -> None:
    robot = in_mode(Mode.HOLD)
    robot.guard.tip("it leans")
    for order in way:
        robot.order(order)
    assert robot.guard.tipped == ""
    robot.cycle(ends=True)
    assert not robot.consider(robot.plan())
    robot.order("walk")
    assert robot.consider(robot.plan())


def test_off_forgets_that_it_tipped() -> None:
    robot = in_mode(Mode.HOLD)
    robot.guard.tip("it leans")
    robot.order("off")
    assert robot.guard.tipped == ""


@pytest.mark.parametrize("mode", MODES)
def test_a_stop_that_takes_over_leads_and_moves_nothing(mode: Mode) -> None:
    robot = in_mode(mode)
    robot.order("stop", "b")
    before = robot.guard.lease(robot.now)
    assert before != "b", "a stop alone leads nobody"
    acts = robot.order("stop", "b", take=True)
    assert set(acts) <= {Act.SET_DOWN, Act.FREEZE}
    assert robot.guard.lease(robot.now) == "b"
    assert robot.guard.objection == ""
    robot.order("walk", "a")
    assert "b holds the lease" in robot.guard.objection


def test_a_plan_for_a_walk_that_is_being_stopped_is_refused_as_such() -> None:
    robot = in_mode(Mode.WALK)
    robot.order("stop")
    assert robot.mode is Mode.WALK
    assert not robot.consider(robot.plan())
    assert robot.guard.refused.endswith("refused: the walk is ordered to stop, and comes to its end")


def test_a_walk_that_is_ordered_to_stop_says_so_when_it_stands() -> None:
    robot = in_mode(Mode.WALK)
    robot.order("stop", "b")
    rested(robot)
    assert (robot.mode, robot.guard.reason) == (Mode.HOLD, "ordered to stop")


# ------------------------------------------------------------------------------------------------- those who may only stop


@pytest.mark.parametrize("mode", MODES)
def test_who_may_only_stop_does_so_from_anywhere_and_takes_nothing(mode: Mode) -> None:
    robot = in_mode(mode)
    lease, leading = robot.guard.lease(robot.now), in_mode(mode)
    leading.order("stop", "viewer")
    robot.guard.hear_stop(StopOrder(0, "stop", 5, "viewer"), robot.now)
    assert robot.guard.lease(robot.now) == lease
    assert robot.mode is leading.mode, "as anybody's stop"
    assert robot.guard.hear_stop(StopOrder(0, "off", 6, "viewer"), robot.now) == (Act.LET_GO,)
    assert robot.mode is Mode.OFF


def test_an_order_to_stop_counts_once_and_does_not_shut_out_who_leads() -> None:
    robot = in_mode(Mode.WALK)
    for k in range(1000):
        robot.guard.hear_stop(StopOrder(0, "stop", k, f"stranger {k}"), robot.now)
    old = StopOrder(0, "stop", 999, "stranger 999")
    robot = in_mode(Mode.HOLD)
    robot.guard.hear_stop(old, robot.now)
    robot.order("walk")
    assert robot.guard.hear_stop(old, robot.now) == ()
    assert robot.guard.objection == ""
    assert robot.consider(robot.plan()), robot.guard.refused
    assert robot.guard.hear_stop(StopOrder(0, "stop", 1, "stranger 999"), robot.now) == (Act.SET_DOWN,), (
        "whose machine began anew"
    )


@pytest.mark.parametrize("begun_anew", [False, True])
def test_what_was_recorded_and_is_put_again_moves_nothing(begun_anew: bool) -> None:
    robot = in_mode(Mode.OFF)
    said: list[ModeCommand] = []
    for mode in ("stand", "walk", "sit", "stand", "walk", "off"):
        robot.number += 1
        said.append(ModeCommand(robot.now, mode, robot.number, "a"))  # type: ignore[arg-type]
        robot.hear(said[-1])
        robot.cycle()
    assert robot.mode is Mode.OFF
    robot.now += 10 * LEASE_NS  # nobody leads by now
    if begun_anew:  # it remembers nobody's orders
        robot.guard = Guard(PROFILE, 0.6, EPOCH, torque=False)
    refused = 0
    for again in said[:-1] * 200:
        assert robot.hear(again) == ()
        refused += robot.guard.objection.endswith(ALLOWED)
    assert refused == 1000
    assert robot.mode is Mode.OFF
    assert robot.guard.lease(robot.now) == ""


def test_plans_that_were_recorded_and_are_put_again_are_refused() -> None:
    robot = in_mode(Mode.WALK)
    old = [robot.plan(step=step, stamp_ns=robot.now) for step in range(1, 201)]
    robot.now += 10 * LEASE_NS
    robot.order("walk")
    refused = 0
    for plan in old:
        assert not robot.consider(plan)
        refused += "old" in robot.guard.refused
    assert refused == 200
