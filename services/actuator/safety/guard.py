"""Authorization of mode orders and step plans. Pure: time and data are inputs.

    OFF ── ready ──► READY ── stand ──► STAND ──► HOLD ◄──► WALK        FAULT: as HOLD, while a fault is present
     ▲ off, always     ▲───────────────── SIT ◄── sit, from any mode but OFF

Only an operator's order turns torque on. Off is latched: only a new order leaves it. One holder of the lease at a time may
move the legs; any client may order `stop` or `off`. A fault stops the walk while it is present. A condition that the robot
cannot sustain makes it lie down and turns torque off.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.safety.command_ordering import ORDER_AGE_NS, WalkOrder, is_no_time, is_of_now
from sextant.services.actuator.safety.health_monitor import Verdict
from sextant.services.actuator.safety.plan_validation import PlanCheck
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import Mode, ModeCommand, StepPlan, StopOrder

DEADLINE_NS = 180_000_000  # [ns] that a walk continues without a new plan
LEASE_NS = 3_000_000_000  # [ns] that a lease lasts without an order; repeated orders extend it
AWAY_NS = 30_000_000_000  # [ns] of silence after which the lease holder needs a new order to walk
_HOLDERS = 16  # number of clients whose orders are remembered; orders of further clients are refused, except stops
_STOPS = ("off", "stop")  # orders that any client may give


class Act(StrEnum):
    """Action that the actuator executes at once."""

    TORQUE_OFF = "torque off"
    TORQUE_ON = "torque on, where the joints are"
    RISE = "stand up"
    LIE_DOWN = "lower the body to the ground"
    SET_DOWN = "bring feet that are in the air to the ground, and stand"
    FREEZE = "stay as it is"


@dataclass(frozen=True, slots=True, eq=False)
class Legs:
    """State of the walk."""

    step: int  # the running step, or the last one
    resting: bool  # no step is running
    planned: bool  # a step of a plan is running, not one that the actuator generated
    swing: NDArray[np.bool_]  # (6,) legs that the running step swings
    clearance: Array  # (6,) [m] clearance with which its feet were lifted; infinite while it can still be raised
    body: Array  # (4, 4) {odom} when a plan takes effect: for the next step, at the end of this one
    feet: Array  # (6, 3) [m] {odom} at the same time
    body_now: Array  # (4, 4) {odom} commanded body pose now
    feet_now: Array  # (6, 3) [m] {odom} commanded feet now
    air_s: Array  # (6,) [s] for which feet of the running step are still in the air; infinite for the others
    trouble: str  # problem of the last step, or an empty string
    waits: str  # why no plan may be walked yet, or an empty string


class Guard:
    """Gatekeeper for modes, orders and plans."""

    def __init__(
        self,
        profile: RobotProfile,
        plan_age_s: float,
        epoch: int,
        torque: bool,
        handover_s: float = 0.0,
        off_ns: int = -1,
        walk: WalkOrder | None = None,
    ):
        """Start in the present torque state; torque that is on stays on.

        Args:
            profile: The robot.
            plan_age_s: [s] older plans are refused.
            epoch: [ns] of {odom}, which begins now.
            torque: Whether torque is on.
            handover_s: [s] of a step in which the feet of its legs are not in the air.
            off_ns: [ns] time of the torque-off order that is still in force; -1 without one.
            walk: The walk order that was in force when the previous process ended.
        """
        self.mode = Mode.HOLD if torque else Mode.OFF
        self.reason = "torque was on at the start" if torque else "torque is off; order `stand` to begin"
        self.refused = ""  # why the newest plan was refused
        self.refused_ns = -1  # [ns] stamp of the newest plan that was refused for its demands on the legs
        self.objection = ""  # why the newest order was not obeyed
        self._check = PlanCheck(profile, plan_age_s, epoch, handover_s)
        self._sequences: dict[str, int] = {}  # newest order of each holder
        self._stops: dict[str, int] = {}  # newest stop of each client, which need not hold the lease
        self._holder, self._heard_ns, self._begun_ns = "", 0, epoch
        self.off_ns = off_ns  # when torque last went off, by an order or automatically; older orders do not turn it on
        self.given_ns = -1  # when the newest valid and permitted order was given
        self._woke_ns = -1  # when the computer last resumed from suspend
        self._may_walk = False
        self._authorization = walk  # the walk order in force; after a start its holder may not have repeated it yet
        self._accepted_ns = 0  # when the newest plan was accepted
        self._late = False  # whether this walk has continued too long without a new plan
        self._halted = False  # whether this walk was ordered to stop
        self._seat = ""  # why the robot will lie down as soon as it can, or an empty string
        self._lets_go = False  # whether torque then goes off; the robot then lies down in spite of faults
        self.tipped = ""  # message that the body leaned too far, until an order to walk or stand
        self._midway = False  # whether a fault has stopped it while it stood up or lay down
        self._verdict = Verdict()

    @property
    def epoch(self) -> int:
        """Epoch of {odom}; plans of another epoch are refused."""
        return self._check.epoch

    def lease(self, now_ns: int) -> str:
        """Return the holder of the lease, or an empty string."""
        return self._holder if now_ns - self._heard_ns <= LEASE_NS else ""

    def walk_order(self, now_ns: int) -> WalkOrder | None:
        """Return the walk order that a restarted actuator may resume, or None.

        There is none once the order has ended for any reason.
        """
        heard_ns = self._heard_ns if self._may_walk else self._begun_ns
        return self._authorization if now_ns - heard_ns <= AWAY_NS else None

    def set_epoch(self, epoch: int) -> None:
        """Start a new epoch of {odom}."""
        self._check.epoch = epoch

    # ---------------------------------------------------------------------------------------------------------- orders

    def handle_order(self, order: ModeCommand, now_ns: int) -> tuple[Act, ...]:
        """Obey an order, or set `objection` to the reason for refusal.

        The rules are:

        * A repeated order only keeps the lease.
        * Any client may stop. A stop with `take` also transfers the lease to its sender.
        * An order needs a current stamp. A replayed recording neither moves the legs nor keeps a lease, even after this process
          has restarted and remembers no orders.
        * A stop without a current stamp is obeyed unless a newer order of its holder is known. A stop with a current stamp is
          obeyed unless a newer stop of its holder is known.
        * A stop with invalid or outdated numbers has no other effect than to stop.
        * An order first received long after its sequence, as after a link outage, only lets a standing robot resume its walk.
        * A walk order from before the start of this process is resumed only if it was in force when the previous process ended.
        """
        if order.sequence == self._sequences.get(order.holder):
            self._handle_repeated(order, now_ns)
            return ()
        odd, stops = self._invalid_reason(order, now_ns), order.mode in _STOPS
        if odd and stops:
            return self._handle_invalid_stop(order, now_ns)
        if odd:
            self.objection = odd
            return ()
        stranger = order.holder not in self._sequences and not self._has_room(now_ns)
        if not stranger:
            self._sequences[order.holder] = order.sequence
        refused = "" if stops else self._late_order(order, now_ns)
        if not refused and (order.take or not stops):
            refused = self._claim(order, now_ns, stranger)
        self.objection = "" if stops else refused
        if self.objection:
            return ()
        if order.holder == self._holder:
            self._heard_ns = now_ns
        if order.mode == "off":
            self.off_ns = max(self.off_ns, min(max(order.sequence, self.given_ns + 1), now_ns))  # robust to wrong clocks
        if stops:
            self._is_new(order)
        self.given_ns = order.sequence
        return self._obey(order.mode)

    def handle_stop(self, order: StopOrder, now_ns: int) -> tuple[Act, ...]:
        """Obey a stop or torque-off order of any client.

        It takes no lease, and it does not extend how long its sender is remembered.
        """
        if not self._is_new(order):
            return ()
        if order.mode == "off":
            self.off_ns = max(self.off_ns, now_ns)
        return self._obey(order.mode)

    def _is_new(self, stop: ModeCommand | StopOrder) -> bool:
        """Return whether a stop differs from its holder's last one, and remember it.

        The holder that was silent longest is forgotten.
        """
        known = self._stops.pop(stop.holder, None)
        self._stops[stop.holder] = stop.sequence
        if len(self._stops) > _HOLDERS:
            del self._stops[next(iter(self._stops))]
        return stop.sequence != known

    def _invalid_reason(self, order: ModeCommand, now_ns: int) -> str:
        """Return why the times of an order are not current, or an empty string."""
        if not is_of_now(order, now_ns):
            return _untimely(order, now_ns)
        if order.sequence < self._sequences.get(order.holder, order.sequence):
            return _older(order)
        if is_no_time(order, now_ns):
            return (
                f"`{order.mode}` of {order.holder} refused: its sequence number, the time of the order [ns], lies in the future"
            )
        return ""

    def _handle_invalid_stop(self, order: ModeCommand, now_ns: int) -> tuple[Act, ...]:
        """Obey a stop with invalid times, unless it is known or may be a replay."""
        older = order.sequence < self._sequences.get(order.holder, order.sequence)
        if older and (not is_of_now(order, now_ns) or order.sequence <= self._stops.get(order.holder, -1)):
            self.objection = _older(order)
            return ()
        return self.handle_stop(StopOrder(order.stamp_ns, order.mode, order.sequence, order.holder), now_ns)  # type: ignore[arg-type]

    def _has_room(self, now_ns: int) -> bool:
        """Return whether one more holder can be remembered.

        If necessary, forget a holder with an expired order.
        """
        if len(self._sequences) < _HOLDERS:
            return True
        oldest = min((holder for holder in self._sequences if holder != self._holder), key=self._sequences.__getitem__)
        if now_ns - self._sequences[oldest] <= AWAY_NS:
            return False
        del self._sequences[oldest]
        return True

    def _handle_repeated(self, order: ModeCommand, now_ns: int) -> None:
        """Process a repeated order.

        The holder's order keeps the lease. After a long silence it restores the lease, but not the walk.
        """
        if not is_of_now(order, now_ns):
            if order.mode not in _STOPS:
                self.objection = _untimely(order, now_ns)
            return
        if order.holder != self._holder:
            return
        silent_ns = now_ns - self._heard_ns
        if self._may_walk and silent_ns > AWAY_NS:
            self._end_walk_order()
            self.objection = (
                f"`walk` of {self._holder} refused: no order was received for {silent_ns * 1e-9:.0f} s; order it again"
            )
        self._heard_ns = now_ns

    def _late_order(self, order: ModeCommand, now_ns: int) -> str:
        """Return why a newly received motion order is too old, or an empty string."""
        age_ns = now_ns - order.sequence
        gone = f"`{order.mode}` of {order.holder} refused: by its sequence number, the robot's time [ns], it was given"
        if self.mode is Mode.OFF and order.sequence < self.off_ns:
            return f"{gone} before torque was ordered off; order it again"
        if order.mode == "walk" and order.sequence < self._begun_ns:
            resumes = self.walk_order(now_ns) == WalkOrder(order.holder, order.sequence)
            return "" if resumes else f"{gone} before this actuator started, and was not in force at that time; order it again"
        if order.sequence <= self._woke_ns:
            return f"{gone} before the computer was suspended; order it again"
        lasting = AWAY_NS if order.mode == "walk" else ORDER_AGE_NS
        return f"{gone} {age_ns * 1e-9:.1f} s ago; order it again" if age_ns > lasting else ""

    def _claim(self, order: ModeCommand, now_ns: int, stranger: bool) -> str:
        """Give the lease to the sender of an order; return why not, or an empty string."""
        holder, refused = self.lease(now_ns), f"`{order.mode}` of {order.holder} refused"
        if stranger:
            return f"{refused}: {_HOLDERS} other clients gave orders within {AWAY_NS * 1e-9:.0f} s"
        if holder and holder != order.holder and not order.take:
            return f"{refused}: {holder} holds the lease; take it over, or wait until it expires"
        if order.holder != self._holder:
            self._end_walk_order()
        self._holder, self._heard_ns = order.holder, now_ns
        return ""

    def _obey(self, mode: str) -> tuple[Act, ...]:
        """Execute an accepted order."""
        match mode:
            case "off":
                return self._let_go("ordered off")
            case "stop":
                return self._stop()
            case "ready":
                return self._ready()
            case "stand":
                return self._stand()
            case "walk":
                return self._walk()
        return self._sit()

    def _let_go(self, reason: str) -> tuple[Act, ...]:
        self._enter(Mode.OFF, reason)
        self._end_walk_order()
        self.tipped, self._seat, self._lets_go, self._midway = "", "", False, False
        return (Act.TORQUE_OFF,)

    def _stop(self) -> tuple[Act, ...]:
        self._end_walk_order()
        if not self._verdict.sit:
            self._seat, self._lets_go = "", False
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
        why = self._verdict.broken or self._verdict.sit
        if why and self.mode is Mode.OFF:
            self.objection = f"torque stays off: {why}"
            return ()
        self._enter(Mode.READY, "torque is on; order `stand` to rise")
        self._end_walk_order()
        self._seat, self._lets_go, self._midway = "", False, False
        return (Act.TORQUE_ON,)

    def _stand(self) -> tuple[Act, ...]:
        if self.mode is Mode.WALK:
            return self._stop()
        why = self._verdict.broken or self._verdict.sit
        if why or self.mode is Mode.FAULT:
            self.objection = f"`stand` refused: {why or 'feet are being set down'}"
            return ()
        torque_on = (Act.TORQUE_ON,) if self.mode is Mode.OFF else ()
        self._enter(Mode.STAND, "standing up")
        self._end_walk_order()
        self.tipped, self._seat, self._lets_go = "", "", False
        return (*torque_on, Act.RISE)

    def _walk(self) -> tuple[Act, ...]:
        if self.mode not in (Mode.HOLD, Mode.STAND, Mode.WALK):
            why = self.reason if self.mode is Mode.FAULT else f"the mode is {self.mode}, order `stand` first"
            self.objection = f"`walk` refused: {why}"
        elif self._verdict.sit:
            self.objection = f"`walk` refused: {self._verdict.sit}"
        else:
            self._may_walk, self._authorization = True, WalkOrder(self._holder, self.given_ns)
            self.tipped, self._seat, self._lets_go = "", "", False
        return ()

    def _sit(self) -> tuple[Act, ...]:
        if self.mode is Mode.OFF:
            self.objection = "`sit` refused: torque is off"
        elif self.mode is not Mode.SIT:
            self._end_walk_order()
            self._seat = self._seat or "ordered to sit"
            self._lets_go |= self.mode is Mode.FAULT  # in a fault the resting pose with torque on is unknown
        return (Act.SET_DOWN,) if self.mode is Mode.WALK else ()

    def _end_walk_order(self) -> None:
        """End the walk order, also for a restarted process."""
        self._may_walk, self._authorization = False, None

    def _enter(self, mode: Mode, reason: str) -> None:
        self.mode, self.reason, self._late, self._halted = mode, reason, False, False

    # ----------------------------------------------------------------------------------------------------------- plans

    def accept_plan(self, plan: StepPlan, now_ns: int, legs: Legs) -> bool:
        """Return whether a plan may be walked; if not, set `refused` to the reason."""
        closed = self._closed(now_ns, legs)
        self.refused = f"plan of step {plan.step} refused: {closed}" if closed else ""
        resting = not legs.planned
        self.refused = self.refused or self._check.untimely(plan, now_ns, legs.step, resting, legs.swing, legs.clearance)
        if self.refused:
            return False
        revises = plan.step == legs.step
        self.refused = self._check.unwalkable(
            plan, legs.body_now if revises else legs.body, legs.feet_now if revises else legs.feet, revises, legs.air_s
        )
        if self.refused:
            self.refused_ns = plan.stamp_ns
            return False
        self._accepted_ns = now_ns
        self._enter(Mode.WALK, "walking")
        return True

    def _closed(self, now_ns: int, legs: Legs) -> str:
        """Return why no plan is accepted now, or an empty string."""
        if self.tipped:
            return f"{self.tipped}; order `walk` again"
        if self.mode is Mode.FAULT:
            return self.reason
        if self._seat:
            return self._seat
        if not self._may_walk and self.mode is Mode.WALK:
            return "the walk was ordered to stop; its last step is being finished"
        if not self._may_walk or self.mode not in (Mode.HOLD, Mode.WALK):
            return f"the mode is {self.mode}, not ordered to walk"
        if not self.lease(now_ns):
            return f"no order from {self._holder} for {LEASE_NS * 1e-9:.0f} s, the lease has expired"
        if legs.waits:
            return legs.waits
        if self._late:
            return f"no new plan received for {DEADLINE_NS * 1e-9:.2f} s, the feet are set down first"
        return ""

    # ----------------------------------------------------------------------------------------------------- what happens

    def tip(self, words: str) -> tuple[Act, ...]:
        """Stop because the body leans too far, until an order to walk or stand."""
        self.tipped = words
        self._end_walk_order()
        return (Act.SET_DOWN,) if self.mode is Mode.WALK else ()

    def resume_from_suspend(self, slept_s: float, now_ns: int) -> tuple[Act, ...]:
        """Cancel all orders after the computer was suspended for `slept_s` [s].

        Clocks stood still meanwhile, and the present state of the robot is unknown.
        """
        acts = self._stop()
        self._holder, self._woke_ns = "", now_ns
        self.objection = f"all orders are cancelled: the computer was suspended for {slept_s:.0f} s; order again"
        return acts

    def risen(self) -> None:
        """Enter HOLD when the robot has stood up."""
        if self.mode is Mode.STAND:
            self._enter(Mode.HOLD, "standing")

    def seated(self, now_ns: int) -> tuple[Act, ...]:
        """Finish lying down: enter READY, or turn torque off."""
        if self.mode is not Mode.SIT:
            return ()
        if self._lets_go:
            self.off_ns = max(self.off_ns, now_ns)
            return self._let_go(self.reason)
        self._enter(Mode.READY, "sitting; order `stand` to rise, or `off`")
        return ()

    def watch(self, now_ns: int, legs: Legs, verdict: Verdict) -> tuple[Act, ...]:
        """Update the mode from this cycle's legs and health."""
        self._verdict = verdict
        if self.mode is Mode.OFF:
            return ()
        still = self.mode in (Mode.READY, Mode.STAND) or self._midway  # an interrupted motion stays where it is
        rests = legs.resting or still
        acts = (*self._check_faults(rests, verdict), *self._check_walk(now_ns, legs))
        if verdict.sit and not self._lets_go:
            acts = (*acts, *self._fall_back(verdict.sit))
        if self.mode is Mode.READY and not verdict.sit:
            self._lets_go = False  # the robot was stopped while it lay down
        if self._seat and rests:
            self._enter(Mode.SIT, self._seat)
            self._seat, self._midway = "", False
            acts = (*acts, Act.LIE_DOWN)
        return acts

    def _fall_back(self, why: str) -> tuple[Act, ...]:
        """Lie down because of an unsustainable condition, then turn torque off."""
        self._lets_go = True
        self._end_walk_order()
        if self.mode is Mode.SIT:
            self.reason = why
        else:
            self._seat = why
        return (Act.SET_DOWN,) if self.mode is Mode.WALK else ()

    def _check_faults(self, rests: bool, verdict: Verdict) -> tuple[Act, ...]:
        """Stop on a fault, and resume once it has cleared."""
        sits_anyway = self.mode is Mode.SIT and self._lets_go
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

    def _check_walk(self, now_ns: int, legs: Legs) -> tuple[Act, ...]:
        """End the walk after its last step, or when no plan has arrived for too long."""
        if self.mode is not Mode.WALK:
            return ()
        late = f"no new plan received for {DEADLINE_NS * 1e-9:.2f} s" if self._late else ""
        ended = "ordered to stop" if self._halted else late
        why = self.tipped or "; ".join(words for words in (ended, legs.trouble) if words)
        if legs.resting:
            self._enter(Mode.HOLD, why or "the last accepted step is finished; no new plan received")
            return ()
        self.reason = why or "walking"
        if legs.planned and not (self._late or self._halted) and now_ns - self._accepted_ns > DEADLINE_NS:
            self._late = True
            return (Act.SET_DOWN,)
        return ()


def _older(order: ModeCommand) -> str:
    return f"`{order.mode}` of {order.holder} refused: it is older than the newest order of this client"


def _untimely(order: ModeCommand, now_ns: int) -> str:
    """Return the message that an order is not current."""
    age_ns = now_ns - order.stamp_ns
    when = f"{age_ns * 1e-9:.1f} s old" if age_ns > 0 else f"stamped {-age_ns * 1e-9:.1f} s in the future"
    allowed = f"at most {ORDER_AGE_NS * 1e-9:.0f} s allowed; stamp orders by the robot's clock"
    return f"`{order.mode}` of {order.holder} refused: it is {when}, {allowed}"
