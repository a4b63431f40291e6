"""Guard and modes: turning torque on, the effect of each order, and tipping."""

import pytest

from sextant.services.actuator.safety.guard import Act, Guard
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.shared.wire.messages import Mode, ModeCommand
from tests.support.guarded import BROKEN, EPOCH, PROFILE, SPENT, in_mode, rested

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
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused == f"plan of step 1 refused: the mode is {robot.mode}, not ordered to walk"


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("holder", ["a", "b"])
def test_anybody_lets_go_from_anywhere_in_one_order(mode: Mode, holder: str) -> None:
    robot = in_mode(mode)
    assert robot.order("off", holder) == (Act.TORQUE_OFF,)
    assert robot.mode is Mode.OFF
    assert robot.guard.reason == "ordered off"
    assert not robot.torque
    assert not robot.accept_plan(robot.plan())
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
    assert not robot.accept_plan(robot.plan())
    robot.verdict = SPENT
    assert robot.cycle() == ()
    assert robot.mode is Mode.OFF


def test_an_order_turns_torque_on_and_leads_out() -> None:
    robot = in_mode(Mode.OFF)
    assert robot.order("ready") == (Act.TORQUE_ON,)
    assert robot.mode is Mode.READY
    assert robot.guard.reason == "torque is on; order `stand` to rise"
    assert robot.order("stand") == (Act.RISE,)
    assert robot.mode is Mode.STAND
    robot.order("off")
    assert robot.order("stand") == (Act.TORQUE_ON, Act.RISE)
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
    assert robot.cycle() == robot.handle_order(again) == ()
    assert robot.mode is Mode.OFF


@pytest.mark.parametrize("mode", [Mode.READY, Mode.FAULT])
def test_ready_takes_up_servos_that_have_lost_their_torque(mode: Mode) -> None:
    robot = in_mode(mode)
    assert robot.order("ready") == (Act.TORQUE_ON,)
    assert robot.mode is Mode.READY
    robot.verdict = Verdict()
    robot.cycle()
    assert robot.mode is Mode.READY


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
    assert (robot.guard.objection == "") == bool(done or walks), "every refusal has a reason"


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
    assert robot.guard.reason == "stopped while rising or sitting down; order `stand` or `sit`"
    robot.guard.risen()
    assert robot.guard.seated(robot.now) == ()
    assert robot.mode is Mode.READY


def test_it_sits_down_from_a_walk_when_its_feet_are_down() -> None:
    robot = in_mode(Mode.WALK)
    assert robot.order("sit") == (Act.SET_DOWN,)
    assert not robot.accept_plan(robot.renewal())
    assert robot.guard.refused == "plan of step 1 refused: ordered to sit"
    assert robot.cycle() == ()
    assert robot.cycle(ends=True) == (Act.LIE_DOWN,)
    assert robot.mode is Mode.SIT


@pytest.mark.parametrize(("order", "then"), [("stop", Mode.HOLD), ("stand", Mode.HOLD), ("walk", Mode.WALK)])
def test_the_newest_order_counts_while_the_feet_come_down(order: str, then: Mode) -> None:
    robot = in_mode(Mode.WALK)
    robot.order("sit")
    robot.order(order)
    assert robot.accept_plan(robot.renewal()) == (order == "walk")
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
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused.endswith("refused: the mode is hold, not ordered to walk")


def test_a_robot_that_was_ordered_to_walk_while_it_rises_walks_when_it_stands() -> None:
    robot = in_mode(Mode.STAND)
    robot.order("walk")
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused == "plan of step 1 refused: the mode is stand, not ordered to walk"
    robot.cycle(ends=True)
    assert robot.accept_plan(robot.plan())


# ----------------------------------------------------------------------------------------------------------- tipping


def test_a_body_that_tips_stops_until_a_new_order() -> None:
    robot = in_mode(Mode.WALK)
    assert robot.guard.tip("it leans") == (Act.SET_DOWN,)
    assert not robot.accept_plan(robot.renewal())
    assert robot.guard.refused == "plan of step 1 refused: it leans; order `walk` again"
    robot.cycle()
    assert robot.guard.reason == "it leans"
    robot.cycle(ends=True)
    assert (robot.mode, robot.guard.reason) == (Mode.HOLD, "it leans")
    assert robot.guard.tip("it leans") == ()
    robot.handle_order(ModeCommand(robot.now, "walk", robot.number, "a"))
    assert not robot.accept_plan(robot.plan())
    robot.order("walk")
    assert robot.guard.tipped == ""
    assert robot.accept_plan(robot.plan())


@pytest.mark.parametrize("way", [("stand",), ("off", "stand")])
def test_who_stands_up_has_not_tipped(way: tuple[str, ...]) -> None:
    robot = in_mode(Mode.HOLD)
    robot.guard.tip("it leans")
    for order in way:
        robot.order(order)
    assert robot.guard.tipped == ""
    robot.cycle(ends=True)
    assert not robot.accept_plan(robot.plan())
    robot.order("walk")
    assert robot.accept_plan(robot.plan())


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
    assert before != "b", "a stop alone takes no lease"
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
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused.endswith("refused: the walk was ordered to stop; its last step is being finished")


def test_a_walk_that_is_ordered_to_stop_says_so_when_it_stands() -> None:
    robot = in_mode(Mode.WALK)
    robot.order("stop", "b")
    rested(robot)
    assert (robot.mode, robot.guard.reason) == (Mode.HOLD, "ordered to stop")
