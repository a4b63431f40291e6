"""Guard and modes: turning torque on, the effect of each order, and tipping."""

import pytest

from sextant.services.actuator.safety.guard import Act, Guard
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.shared.wire.messages import Mode, ModeCommand
from tests.support.guarded import BROKEN, EPOCH, PROFILE, SPENT, in_mode, rested

MODES = list(Mode)

# ------------------------------------------------------------------------------------------------------------- torque


@pytest.mark.parametrize("torque", [True, False])
def test_initial_mode_and_reason_follow_servo_torque(torque: bool) -> None:
    guard = Guard(PROFILE, 0.6, EPOCH, torque)
    assert guard.mode is (Mode.HOLD if torque else Mode.OFF)
    assert guard.reason == ("torque was on at the start" if torque else "torque is off; order `stand` to begin")
    assert (guard.refused, guard.refused_ns, guard.objection, guard.tipped) == ("", -1, "", "")
    assert guard.epoch == EPOCH
    assert guard.lease(0) == ""


def test_robot_that_does_not_know_its_pose_is_laid_down_and_made_ready_before_it_stands() -> None:
    robot = in_mode(Mode.OFF)
    robot.guard = Guard(PROFILE, 0.6, EPOCH, torque=False, knows_pose=False)
    assert "lay the robot on its belly" in robot.guard.reason
    now_ns = robot.now + 1
    assert robot.guard.handle_order(ModeCommand(now_ns, "stand", now_ns), now_ns) == ()
    assert robot.mode is Mode.OFF
    assert "lay the robot on its belly" in robot.guard.objection
    assert robot.guard.handle_order(ModeCommand(now_ns, "ready", now_ns + 1), now_ns + 1) == (Act.TORQUE_ON,)
    assert robot.guard.handle_order(ModeCommand(now_ns, "stand", now_ns + 2), now_ns + 2) == (Act.RISE,)


@pytest.mark.parametrize("torque", [True, False])
def test_plan_without_any_order_is_refused(torque: bool) -> None:
    robot = in_mode(Mode.HOLD if torque else Mode.OFF)
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused == f"plan of step 1 refused: the mode is {robot.mode}, not ordered to walk"


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("holder", ["a", "b"])
def test_any_client_turns_torque_off_in_each_mode(mode: Mode, holder: str) -> None:
    robot = in_mode(mode)
    assert robot.order("off", holder) == (Act.TORQUE_OFF,)
    assert robot.mode is Mode.OFF
    assert robot.guard.reason == "ordered off"
    assert not robot.torque
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused.endswith("refused: the mode is off, not ordered to walk")


def test_torque_off_is_latched_against_orders_and_events() -> None:
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


def test_ready_and_stand_orders_turn_torque_on_after_off() -> None:
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
def test_torque_on_order_during_fault_is_refused_and_not_kept(mode: str, verdict: Verdict) -> None:
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
def test_ready_order_restores_torque_of_servos(mode: Mode) -> None:
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
def test_reaction_to_each_order_in_each_mode(mode: Mode, order: str, acts: tuple[Act, ...], then: Mode) -> None:
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
def test_refused_order_states_its_reason(mode: Mode, order: str, words: str) -> None:
    robot = in_mode(mode)
    robot.order(order)
    assert robot.guard.objection == words


def test_mode_changes_after_stand_up_and_sit_down_finish() -> None:
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


def test_sit_order_while_walking_waits_for_feet_set_down() -> None:
    robot = in_mode(Mode.WALK)
    assert robot.order("sit") == (Act.SET_DOWN,)
    assert not robot.accept_plan(robot.renewal())
    assert robot.guard.refused == "plan of step 1 refused: ordered to sit"
    assert robot.cycle() == ()
    assert robot.cycle(ends=True) == (Act.LIE_DOWN,)
    assert robot.mode is Mode.SIT


@pytest.mark.parametrize(("order", "then"), [("stop", Mode.HOLD), ("stand", Mode.HOLD), ("walk", Mode.WALK)])
def test_newest_order_applies_while_feet_are_set_down(order: str, then: Mode) -> None:
    robot = in_mode(Mode.WALK)
    robot.order("sit")
    robot.order(order)
    assert robot.accept_plan(robot.renewal()) == (order == "walk")
    robot.cycle()
    assert Act.LIE_DOWN not in robot.cycle(ends=order != "walk")
    assert robot.mode is then


@pytest.mark.parametrize("mode", [Mode.STAND, Mode.HOLD, Mode.WALK])
@pytest.mark.parametrize("order", ["stop", "ready", "stand", "sit", "off"])
def test_each_order_except_walk_ends_the_walk(mode: Mode, order: str) -> None:
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


def test_walk_order_during_stand_up_applies_after_standing() -> None:
    robot = in_mode(Mode.STAND)
    robot.order("walk")
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused == "plan of step 1 refused: the mode is stand, not ordered to walk"
    robot.cycle(ends=True)
    assert robot.accept_plan(robot.plan())


# ----------------------------------------------------------------------------------------------------------- tipping


def test_tipping_stops_walk_until_new_order() -> None:
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
def test_stand_order_clears_tipping(way: tuple[str, ...]) -> None:
    robot = in_mode(Mode.HOLD)
    robot.guard.tip("it leans")
    for order in way:
        robot.order(order)
    assert robot.guard.tipped == ""
    robot.cycle(ends=True)
    assert not robot.accept_plan(robot.plan())
    robot.order("walk")
    assert robot.accept_plan(robot.plan())


def test_off_order_clears_tipping() -> None:
    robot = in_mode(Mode.HOLD)
    robot.guard.tip("it leans")
    robot.order("off")
    assert robot.guard.tipped == ""


@pytest.mark.parametrize("mode", MODES)
def test_stop_with_takeover_takes_lease_without_motion(mode: Mode) -> None:
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


def test_plan_is_refused_while_walk_is_stopping() -> None:
    robot = in_mode(Mode.WALK)
    robot.order("stop")
    assert robot.mode is Mode.WALK
    assert not robot.accept_plan(robot.plan())
    assert robot.guard.refused.endswith("refused: the walk was ordered to stop; its last step is being finished")


def test_stopped_walk_ends_with_reason_ordered_to_stop() -> None:
    robot = in_mode(Mode.WALK)
    robot.order("stop", "b")
    rested(robot)
    assert (robot.mode, robot.guard.reason) == (Mode.HOLD, "ordered to stop")
