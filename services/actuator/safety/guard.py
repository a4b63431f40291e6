"""Authorization of mode orders and step plans. Pure: time and data are inputs.

    OFF ── ready ──► READY ── stand ──► STAND ──► HOLD ◄──► WALK        FAULT: as HOLD, while a fault is present
     ▲ off, always     ▲───────────────── SIT ◄── sit, from any mode but OFF

Only an operator's order turns torque on. Off is latched: only a new order leaves it. `CommandArbiter` decides which orders are
obeyed. A fault stops the walk while it is present. A condition that the robot cannot sustain makes it lie down and turns torque
off.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.safety.command_arbiter import LEASE_NS, CommandArbiter
from sextant.services.actuator.safety.command_ordering import WalkOrder
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.services.actuator.safety.plan_validation import PlanCheck, out_of_order
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import Mode, ModeCommand, StepPlan, StopOrder

DEADLINE_NS = 180_000_000  # [ns] that a walk continues without a new plan
OBJECTION_NS = 5_000_000_000  # [ns] for which the refusal of an order is reported
LIE_DOWN_FIRST = "lay the robot on its belly, with its legs as it sits; then order `ready`: the legs jump one after another"
PLAN_REFUSAL_NS = 1_000_000_000  # [ns] for which the refusal of a plan is reported if no newer plan arrives


class Act(StrEnum):
    """Action that the actuator executes at once."""

    TORQUE_OFF = "torque off"
    TORQUE_ON = "torque on, where the joints are"
    RISE = "stand up"
    LIE_DOWN = "lower the body to the ground"
    SET_DOWN = "bring feet that are in the air to the ground, and stand"
    FREEZE = "stay as it is"


class Walk(NamedTuple):
    """State of the walk."""

    step: int  # the running step, or the last one
    resting: bool  # no step is running
    planned: bool  # a step of a plan is running, not one that the actuator generated
    trouble: str  # problem of the last step, or an empty string
    waiting_reason: str  # why no plan may be walked yet, or an empty string
    swing: NDArray[np.bool_]  # (6,) legs that swing in the running step
    clearance: Array  # (6,) [m] clearance with which its feet were lifted; infinite while it can still be raised


@dataclass(frozen=True, slots=True, eq=False)
class Stance:
    """The legs when a plan takes effect."""

    body: Array  # (4, 4) {odom} commanded body pose
    feet: Array  # (6, 3) [m] {odom} commanded feet
    air_s: Array  # (6,) [s] for which swinging feet are still in the air; infinite for the others


class Guard:
    """Authorizes modes, orders and plans."""

    def __init__(
        self,
        profile: RobotProfile,
        plan_age_s: float,
        epoch: int,
        torque: bool,
        handover_s: float = 0.0,
        off_ns: int = -1,
        walk: WalkOrder | None = None,
        knows_pose: bool = True,
    ):
        """Start in the present torque state; torque that is on stays on.

        Args:
            profile: The robot.
            plan_age_s: [s] older plans are refused.
            epoch: [ns] of {odom}, which begins now.
            torque: Whether torque is on.
            handover_s: [s] of a step in which its swinging feet are still or again on the ground.
            off_ns: [ns] time of the torque-off order that is still in force; -1 without one.
            walk: The walk order that was in force when the previous process ended.
            knows_pose: Whether the joints are measured. If not, they jump to the sit pose when torque is turned on.
        """
        self.mode = Mode.HOLD if torque else Mode.OFF
        begin = "order `stand` to begin" if knows_pose else LIE_DOWN_FIRST
        self.reason = "torque was on at the start" if torque else f"torque is off; {begin}"
        self._knows_pose = knows_pose
        self.refused = ""  # why the newest plan was refused
        self._refused_at_ns = 0  # [ns] when that was
        self._late_since_ns: int | None = None  # [ns] since when only revisions of ended steps have arrived
        self.refused_ns = -1  # [ns] stamp of the newest plan that was refused for its demands on the legs
        self.objection = ""  # why the newest order was not obeyed, for a few seconds
        self._objected_ns = 0  # [ns] when that was
        self._check = PlanCheck(profile, plan_age_s, epoch, handover_s)
        self._arbiter = CommandArbiter(epoch, off_ns, walk)
        self._accepted_ns = 0  # when the newest plan was accepted
        self._late = False  # whether this walk has continued too long without a new plan
        self._halted = False  # whether this walk was ordered to stop
        self._sit_reason = ""  # why the robot will lie down as soon as it can, or an empty string
        self._off_when_down = False  # whether torque then goes off; the robot then lies down in spite of faults
        self.tipped = ""  # message that the body leaned too far, until an order to walk or stand
        self._midway = False  # whether a fault has stopped it while it stood up or lay down
        self._verdict = Verdict()

    @property
    def epoch(self) -> int:
        """Epoch of {odom}; plans of another epoch are refused."""
        return self._check.epoch

    @property
    def off_ns(self) -> int:
        """When torque last went off [ns], by an order or automatically; -1 before."""
        return self._arbiter.off_ns

    @property
    def given_ns(self) -> int:
        """When the newest valid and permitted order was given [ns]; -1 before."""
        return self._arbiter.given_ns

    def lease(self, now_ns: int) -> str:
        """Return the holder of the lease, or an empty string."""
        return self._arbiter.lease(now_ns)

    def walk_order(self, now_ns: int) -> WalkOrder | None:
        """Return the walk order that a restarted actuator may resume, or None."""
        return self._arbiter.walk_order(now_ns)

    def set_epoch(self, epoch: int) -> None:
        """Start a new epoch of {odom}."""
        self._check.epoch = epoch

    # ---------------------------------------------------------------------------------------------------------- orders

    def handle_order(self, order: ModeCommand, now_ns: int) -> tuple[Act, ...]:
        """Obey an order, or set `objection` to the reason for refusal."""
        ruling = self._arbiter.rule(order, now_ns, torque_is_off=self.mode is Mode.OFF)
        if ruling.objection is not None:
            self.objection, self._objected_ns = ruling.objection, now_ns
        return self._obey(order.mode) if ruling.is_obeyed else ()

    def handle_stop(self, order: StopOrder, now_ns: int) -> tuple[Act, ...]:
        """Obey a stop or torque-off order of any client."""
        return self._obey(order.mode) if self._arbiter.rule_stop(order, now_ns) else ()

    def _obey(self, mode: str) -> tuple[Act, ...]:
        """Execute an accepted order."""
        match mode:
            case "off":
                return self._turn_off("ordered off")
            case "stop":
                return self._stop()
            case "ready":
                return self._ready()
            case "stand":
                return self._stand()
            case "walk":
                return self._walk()
        return self._sit()

    def _turn_off(self, reason: str) -> tuple[Act, ...]:
        self._enter(Mode.OFF, reason)
        self._arbiter.end_walk()
        self.tipped, self._sit_reason, self._off_when_down, self._midway = "", "", False, False
        return (Act.TORQUE_OFF,)

    def _stop(self) -> tuple[Act, ...]:
        self._arbiter.end_walk()
        if not self._verdict.sit:
            self._sit_reason, self._off_when_down = "", False
        if self.mode is Mode.WALK:
            self._halted = True
            return (Act.SET_DOWN,)
        if self.mode in (Mode.STAND, Mode.SIT):
            self._enter(Mode.READY, "stopped while rising or sitting down; order `stand` or `sit`")
            return (Act.FREEZE,)
        return ()

    def _ready(self) -> tuple[Act, ...]:
        if self.mode not in (Mode.OFF, Mode.READY, Mode.FAULT):
            return self._stop()
        why = self._torque_refusal
        if why and self.mode is Mode.OFF:
            self.objection = f"torque stays off: {why}"
            return ()
        self._enter(Mode.READY, "torque is on; order `stand` to rise")
        self._arbiter.end_walk()
        self._sit_reason, self._off_when_down, self._midway = "", False, False
        return (Act.TORQUE_ON,)

    def _stand(self) -> tuple[Act, ...]:
        if self.mode is Mode.WALK:
            return self._stop()
        why = self._torque_refusal
        if not self._knows_pose and self.mode is Mode.OFF:
            why = why or f"the pose of the legs is unknown; {LIE_DOWN_FIRST}"
        if why or self.mode is Mode.FAULT:
            self.objection = f"`stand` refused: {why or 'feet are being set down'}"
            return ()
        torque_on = (Act.TORQUE_ON,) if self.mode is Mode.OFF else ()
        self._enter(Mode.STAND, "standing up")
        self._arbiter.end_walk()
        self.tipped, self._sit_reason, self._off_when_down = "", "", False
        return (*torque_on, Act.RISE)

    @property
    def _torque_refusal(self) -> str:
        """Why torque may not be turned on now, or an empty string; a robot with torque may not stand up either."""
        return self._verdict.broken or self._verdict.sit

    def _walk(self) -> tuple[Act, ...]:
        if self.mode not in (Mode.HOLD, Mode.STAND, Mode.WALK):
            why = self.reason if self.mode is Mode.FAULT else f"the mode is {self.mode}, order `stand` first"
            self.objection = f"`walk` refused: {why}"
        elif self._verdict.sit:
            self.objection = f"`walk` refused: {self._verdict.sit}"
        else:
            self._arbiter.begin_walk()
            self.tipped, self._sit_reason, self._off_when_down = "", "", False
        return ()

    def _sit(self) -> tuple[Act, ...]:
        if self.mode is Mode.OFF:
            self.objection = "`sit` refused: torque is off"
        elif self.mode is not Mode.SIT:
            self._arbiter.end_walk()
            self._sit_reason = self._sit_reason or "ordered to sit"
            self._off_when_down |= self.mode is Mode.FAULT  # in a fault the resting pose with torque on is unknown
        return (Act.SET_DOWN,) if self.mode is Mode.WALK else ()

    def _enter(self, mode: Mode, reason: str) -> None:
        self.mode, self.reason, self._late, self._halted = mode, reason, False, False

    # ----------------------------------------------------------------------------------------------------------- plans

    def accept_plan(self, plan: StepPlan, now_ns: int, walk: Walk, stance: Callable[[bool], Stance]) -> bool:
        """Return whether a plan may be walked; if not, set `refused` to the reason.

        Args:
            plan: The plan.
            now_ns: [ns] the time.
            walk: State of the walk.
            stance: Returns the legs now for a revision of the running step, else those at the end of that step.
        """
        closed = self._plan_refusal(now_ns, walk)
        self.refused = f"plan of step {plan.step} refused: {closed}" if closed else ""
        resting = not walk.planned
        self.refused = self.refused or self._check.untimely(plan, now_ns, walk.step, resting, walk.swing, walk.clearance)
        self._refused_at_ns = now_ns
        if not (self.refused and plan.step <= walk.step and self.refused == out_of_order(plan, walk.step, resting)):
            self._late_since_ns = None
        elif self._late_since_ns is None:
            self._late_since_ns = now_ns
        if self.refused:
            return False
        revises = plan.step == walk.step
        if not (revises and self._check.renew(plan)):
            legs = stance(revises)
            self.refused = self._check.unwalkable(plan, legs.body, legs.feet, revises, legs.air_s)
        if self.refused:
            self.refused_ns = plan.stamp_ns
            return False
        self._accepted_ns = now_ns
        self._enter(Mode.WALK, "walking")
        return True

    def plan_refusal(self, now_ns: int) -> str:
        """Return why the newest plan was refused, or an empty string.

        It is empty for a revision that arrives after the end of its step, as happens in every walk, unless a planner sends
        nothing else for `DEADLINE_NS`. It is also empty once no plan has arrived for `PLAN_REFUSAL_NS`.
        """
        late = self._late_since_ns is not None and self._refused_at_ns - self._late_since_ns <= DEADLINE_NS
        return "" if late or now_ns - self._refused_at_ns > PLAN_REFUSAL_NS else self.refused

    def _plan_refusal(self, now_ns: int, walk: Walk) -> str:
        """Return why no plan is accepted now, or an empty string."""
        if self.tipped:
            return f"{self.tipped}; order `walk` again"
        if self.mode is Mode.FAULT:
            return self.reason
        if self._sit_reason:
            return self._sit_reason
        if not self._arbiter.may_walk and self.mode is Mode.WALK:
            return "the walk was ordered to stop; its last step is being finished"
        if not self._arbiter.may_walk or self.mode not in (Mode.HOLD, Mode.WALK):
            return f"the mode is {self.mode}, not ordered to walk"
        if not self.lease(now_ns):
            return f"no order from {self._arbiter.holder} for {LEASE_NS * 1e-9:.0f} s, the lease has expired"
        if walk.waiting_reason:
            return walk.waiting_reason
        if self._late:
            return f"no new plan received for {DEADLINE_NS * 1e-9:.2f} s, the feet are set down first"
        return ""

    # ----------------------------------------------------------------------------------------------------- what happens

    def tip(self, words: str) -> tuple[Act, ...]:
        """Stop because the body leans too far, until an order to walk or stand."""
        self.tipped = words
        self._arbiter.end_walk()
        return (Act.SET_DOWN,) if self.mode is Mode.WALK else ()

    def resume_from_suspend(self, slept_s: float, now_ns: int) -> tuple[Act, ...]:
        """Cancel all orders after the computer was suspended for `slept_s` [s].

        Clocks stood still meanwhile, and the present state of the robot is unknown.
        """
        acts = self._stop()
        self._arbiter.resume_from_suspend(now_ns)
        self.objection = f"all orders are cancelled: the computer was suspended for {slept_s:.0f} s; order again"
        self._objected_ns = now_ns
        return acts

    def risen(self) -> None:
        """Enter HOLD when the robot has stood up."""
        if self.mode is Mode.STAND:
            self._enter(Mode.HOLD, "standing")

    def seated(self, now_ns: int) -> tuple[Act, ...]:
        """Finish lying down: enter READY, or turn torque off."""
        if self.mode is not Mode.SIT:
            return ()
        if self._off_when_down:
            self._arbiter.turn_off(now_ns)
            return self._turn_off(self.reason)
        self._enter(Mode.READY, "sitting; order `stand` to rise, or `off`")
        return ()

    def watch(self, now_ns: int, walk: Walk, verdict: Verdict) -> tuple[Act, ...]:
        """Update the mode from this cycle's walk and health."""
        self._verdict = verdict
        if now_ns - self._objected_ns > OBJECTION_NS:
            self.objection = ""
        if self.mode is Mode.OFF:
            return ()
        still = self.mode in (Mode.READY, Mode.STAND) or self._midway  # an interrupted motion stays where it is
        rests = walk.resting or still
        acts = (*self._check_faults(rests, verdict), *self._check_walk(now_ns, walk))
        if verdict.sit and not self._off_when_down:
            acts = (*acts, *self._fall_back(verdict.sit))
        if self.mode is Mode.READY and not verdict.sit:
            self._off_when_down = False  # the robot was stopped while it lay down
        waits = self.mode is Mode.FAULT and not self._off_when_down  # lying down would be stopped at once by the fault
        if self._sit_reason and rests and not waits:
            self._enter(Mode.SIT, self._sit_reason)
            self._sit_reason, self._midway = "", False
            acts = (*acts, Act.LIE_DOWN)
        return acts

    def _fall_back(self, why: str) -> tuple[Act, ...]:
        """Lie down because of an unsustainable condition, then turn torque off."""
        self._off_when_down = True
        self._arbiter.end_walk()
        if self.mode is Mode.SIT:
            self.reason = why
        else:
            self._sit_reason = why
        return (Act.SET_DOWN,) if self.mode is Mode.WALK else ()

    def _check_faults(self, rests: bool, verdict: Verdict) -> tuple[Act, ...]:
        """Stop on a fault, and resume once it has cleared."""
        sits_anyway = self.mode is Mode.SIT and self._off_when_down
        if verdict.broken and self.mode is not Mode.READY and not sits_anyway:
            acts = {Mode.WALK: (Act.SET_DOWN,), Mode.STAND: (Act.FREEZE,), Mode.SIT: (Act.FREEZE,)}.get(self.mode, ())
            self._midway |= Act.FREEZE in acts
            self._enter(Mode.FAULT, verdict.broken)
            return acts
        if self.mode is Mode.FAULT and not verdict.broken and rests:
            midway, self._midway = self._midway, False
            if midway:
                self._enter(Mode.READY, "the fault has cleared; order `stand` or `sit`")
            else:
                self._enter(Mode.HOLD, "the fault has cleared")
        return ()

    def _check_walk(self, now_ns: int, walk: Walk) -> tuple[Act, ...]:
        """End the walk after its last step, or when no plan has arrived for too long."""
        if self.mode is not Mode.WALK:
            return ()
        late = f"no new plan received for {DEADLINE_NS * 1e-9:.2f} s" if self._late else ""
        ended = "ordered to stop" if self._halted else late
        why = self.tipped or "; ".join(words for words in (ended, walk.trouble) if words)
        if walk.resting:
            self._enter(Mode.HOLD, why or "the last accepted step is finished; no new plan received")
            return ()
        self.reason = why or "walking"
        if walk.planned and not (self._late or self._halted) and now_ns - self._accepted_ns > DEADLINE_NS:
            self._late = True
            return (Act.SET_DOWN,)
        return ()
