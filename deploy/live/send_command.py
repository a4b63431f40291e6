"""One order to the legs as an operator gives it, and its result."""

from collections.abc import Iterator
from typing import Literal, TypeAlias

from sextant.shared.runtime.robot_clock import RobotClockEstimate
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.access import ROUTER_OF, refusal_here
from sextant.shared.wire.messages import ActuatorState, Message, Mode, ModeCommand, StopOrder, Tick

What: TypeAlias = Literal["off", "stop", "ready", "stand", "walk", "sit"]
_ON_THE_WAY = "each router on the way needs keys of a role that may send operator/mode (docs/access.md)"
_REPEAT_NS = 500_000_000  # [ns] between two messages of the order
_UNHEARD_NS = 5_000_000_000  # [ns] patience for the first message of the actuator
_PATIENCE_NS = 15_000_000_000  # [ns] patience for the order to be executed
REFUSED_NS = 1_000_000_000  # [ns] after an order, before a refusal that was already reported counts as its result
LEASE_ENDS_NS = 3_500_000_000  # [ns] within which the lease of a client that repeats no order has ended
STOPS: tuple[What, ...] = ("off", "stop")  # any client may send these
SETTLED: dict[What, tuple[Mode, ...]] = {  # modes in which an order is executed
    "off": (Mode.OFF,),
    "stop": (Mode.OFF, Mode.READY, Mode.HOLD, Mode.FAULT),
    "ready": (Mode.READY, Mode.HOLD),
    "stand": (Mode.HOLD,),
    "walk": (Mode.HOLD, Mode.WALK),
    "sit": (Mode.READY, Mode.OFF),
}
_DURING: dict[What, Mode] = {"stand": Mode.STAND, "sit": Mode.SIT}  # mode while the ordered motion lasts


class OrderedMotion:
    """Motion of an order to stand or sit, which a fault or another order may end early. The actuator does not resume it."""

    def __init__(self, what: What) -> None:
        """Wait until the motion begins."""
        self._what, self._during = what, _DURING.get(what)
        self._has_begun = False

    def interruption(self, state: ActuatorState) -> str:
        """Return by the newest state since the order why the motion has ended early, or an empty text."""
        self._has_begun |= state.mode is self._during
        if not self._has_begun or state.mode is self._during or state.mode in SETTLED[self._what]:
            return ""
        return f"`{self._what}` was interrupted: {state.reason}" + ("; then order it again" if state.mode is Mode.FAULT else "")


class Order:
    """Sends an order until the actuator has executed or refused it.

    `walk` is sent until it is withdrawn. An order to move is stamped by the robot's clock, on any machine, so it waits
    for the actuator's first message. A stop is sent at once.
    """

    name = "order"
    subscribes: tuple[AnyTopic, ...] = (topics.ACTUATOR_STATE, *topics.HEALTH_OF.values())
    publishes: tuple[AnyTopic, ...] = (topics.MODE, topics.STOP)

    def __init__(self, what: What, holder: str, take: bool = False, leads: bool = True):
        """Prepare an order.

        Args:
            what: The order.
            holder: Holder of the lease.
            take: Take the lease from another holder.
            leads: Whether this machine may send orders to move; else it may only stop.
        """
        self.trigger = Every.hz(20.0)
        self.stages = Stages()
        self.finished = False
        self.failed = ""  # why it failed, as text
        self.words = "waiting for the actuator"
        self._what, self._holder, self._take, self._leads = what, holder, take, leads
        self._begun_ns = -1
        self._first_ns = -1  # first time at which another client of the same name held the lease
        self._changed = False  # whether the robot has said anything else since the order, also if it says the same again later
        self._number = -1  # of the order: a time of the robot's clock, so that it is larger than those of other machines
        self._robot = RobotClockEstimate()
        self._due_ns = 0
        self._heard: ActuatorState | None = None  # last state before the order
        self._motion = OrderedMotion(what)
        self._clear_ns = 0  # last time at which the robot's time was not in doubt

    def status(self) -> str:
        """Return the progress of the order as text."""
        return self.failed or self.words

    def withdraw(self) -> tuple[Message, ...]:
        """Return the messages that end an order to walk; none for another one, or if it was never sent."""
        if self._number < 0 or self._what != "walk":
            return ()
        now_ns = self._robot()
        return (
            ModeCommand(now_ns, "stop", self._number + 1, self._holder),
            StopOrder(now_ns, "stop", self._number + 1, self._holder),
        )

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Send the order again when it is due, and check its result."""
        if self.finished:
            return
        now = tick.stamp_ns
        self._begun_ns = now if self._begun_ns < 0 else self._begun_ns
        state = inbox.latest(topics.ACTUATOR_STATE)
        if self._is_name_taken(state, now):
            return
        obeyed = self._what in STOPS or (state is not None and state.lease == self._holder)
        if (why := router_refusal(inbox)) and not obeyed:
            self._end(why)
        self._heard = self._heard or state
        if void := self._robot.see(now, None if state is None else state.stamp_ns):
            self._end(void)
            return
        if now >= self._due_ns and (self._robot.known or self._what in STOPS):
            self._due_ns = now + _REPEAT_NS
            yield from self._words_of_it(self._robot())
        if not self._robot.in_doubt:
            self._clear_ns = now
            self._see(state, now - self._begun_ns, inbox.refusal_of(topics.ACTUATOR_STATE))
        elif now - self._clear_ns > _PATIENCE_NS:
            self._end(f"the robot's messages of the last {_PATIENCE_NS * 1e-9:.0f} s have times that do not agree")

    def _is_name_taken(self, state: ActuatorState | None, now_ns: int) -> bool:
        """Return whether another client leads under the name of this order; end the order if that lasts.

        The lease of an earlier order ends by itself. Two clients of one name would supersede each other's orders.
        """
        if self._what in STOPS or self._number >= 0 or state is None or state.lease != self._holder:
            return False
        self._first_ns = now_ns if self._first_ns < 0 else self._first_ns
        if now_ns - self._first_ns > LEASE_ENDS_NS:
            self._end(
                f"another client named {self._holder!r} leads it; end that one, or give this one another name with --holder"
            )
        self._begun_ns, self.words = now_ns, f"waiting for the lease of an earlier order of {self._holder} to end"
        return True

    def _words_of_it(self, stamp_ns: int) -> Iterator[Message]:
        """Yield the order under each key that may carry it."""
        if self._leads and self._robot.known:
            self._number = stamp_ns if self._number < 0 else self._number
            yield ModeCommand(stamp_ns, self._what, self._number, self._holder, self._take)
        if self._what in STOPS:  # also where this machine's router is chained to one that only lets it stop
            yield StopOrder(stamp_ns, "off" if self._what == "off" else "stop", self._begun_ns + 1, self._holder)

    def _see(self, state: ActuatorState | None, since_ns: int, unreadable: str) -> None:
        if self._heard is None or state is None:
            if since_ns > _UNHEARD_NS:
                why = f": {unreadable}" if unreadable else "; is it up, with this endpoint and namespace?"
                self._end(f"no word from the actuator within {_UNHEARD_NS * 1e-9:.0f} s{why}")
            return
        self.words = f"{state.mode}: {state.reason}"
        refused = refusal(self._what, self._holder, state)
        if refused and (refused not in self._heard.warnings or 0 <= self._number < state.stamp_ns - REFUSED_NS):
            led = self._what not in STOPS and state.lease not in ("", self._holder)
            self._end(f"{refused}; --take takes it over" if led else refused)
        elif self._done(state):
            self.finished = self._what != "walk"
        elif state.lease == self._holder and (interruption := self._motion.interruption(state)):
            self._end(interruption)
        elif since_ns > _PATIENCE_NS:
            unanswered = self._what not in STOPS and state.lease != self._holder
            hint = f"; the order may not have arrived: {_ON_THE_WAY}" if unanswered else ""
            self._end(f"{_PATIENCE_NS * 1e-9:.0f} s after the order the mode is {state.mode}: {state.reason}{hint}")

    def _done(self, state: ActuatorState) -> bool:
        """Return whether a state since the order shows that it was executed."""
        assert self._heard is not None
        news = state.stamp_ns > self._heard.stamp_ns and (self._what in ("off", "stop") or state.lease == self._holder)
        self._changed |= state.reason != self._heard.reason
        return news and (self._changed or self._what not in ("stand", "sit")) and state.mode in SETTLED[self._what]

    def _end(self, why: str) -> None:
        self.finished, self.failed = True, why


def router_refusal(inbox: Inbox) -> str:
    """Return why this machine's router refuses commands to move, or an empty text.

    Its health message states its role, and is trusted only under the key of that role.
    """
    roles = (
        role
        for role, topic in topics.HEALTH_OF.items()
        if any(health.service == f"{ROUTER_OF}{role}" for health in inbox.drain(topic))
    )
    return refusal_here(roles, [topics.MODE])


def refusal(what: What, holder: str, state: ActuatorState) -> str:
    """Return why the actuator refuses an order of a holder, or an empty text."""
    starts = (f"`{what}` refused", f"`{what}` of {holder} refused", "torque stays off")
    return next((warning for warning in state.warnings if warning.startswith(starts)), "")
