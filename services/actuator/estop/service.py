"""Latches the order to let go: an actuator that is hung, dead or without its bus obeys it first of all, once it is back."""

from collections.abc import Iterator

from sextant.services.actuator.estop.config import Settings
from sextant.services.actuator.safety.command_ordering import is_no_time, is_of_now
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Message, ModeCommand, StopOrder, Tick

_BEAT_HZ = 25.0  # between two looks at what was ordered
_HOLDERS = 64  # whose newest orders are remembered


class Stop:
    """Closes the latch at each new order to let go; the actuator alone opens it."""

    name = "stop"
    reads: tuple[AnyTopic, ...] = (topics.MODE, topics.STOP)
    writes: tuple[AnyTopic, ...] = ()

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Watch over the robot behind a port."""
        self.paced_by = Every.hz(_BEAT_HZ)
        self.stages = Stages()
        self._latch = Latch.of_port(settings.port)
        self._problem = ""  # why the newest order to let go is not latched, in words, or nothing
        self._due_ns: int | None = None  # time of the order to let go that is still to be latched
        self._latest_ns = 0  # just after the newest order of anybody: who is heard after it, by whatever clock, came after it
        self._newest: dict[str, int] = {}
        self._stops: dict[str, int] = {}

    def doing(self) -> str:
        """Whether the latch is closed."""
        if self._problem:
            return self._problem
        try:
            closed = self._latch.closed
        except OSError as error:
            return f"whether torque is latched off cannot be seen: {error}"
        return "torque is latched off" if closed else "listening for the order to let go"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Hear what was ordered."""
        for order in inbox.drain(topics.MODE):
            if is_no_time(order, tick.stamp_ns):
                self._hear_stop(order, tick.stamp_ns)
            elif order.sequence > self._newest.get(order.holder, -1):
                self._hear(self._newest, order, max(order.sequence, self._latest_ns))
                self._latest_ns = max(self._latest_ns, order.sequence + 1)
            elif self._is_late(order, tick.stamp_ns):
                self._hear_stop(order, tick.stamp_ns)
        for stop in inbox.drain(topics.STOP):
            said_ns = min(stop.stamp_ns, tick.stamp_ns) if is_of_now(stop, tick.stamp_ns) else tick.stamp_ns
            self._hear_stop(stop, said_ns)  # when it was said, for this process may have been late
        if self._due_ns is not None:
            self._close(self._due_ns)
        yield from ()

    def _is_late(self, order: ModeCommand, now_ns: int) -> bool:
        """Whether an order to let go has come after a newer one of its holder, is of now, and they have given none since."""
        repeated = order.sequence == self._newest.get(order.holder)
        known = repeated or order.sequence <= self._stops.get(order.holder, -1)
        return order.mode == "off" and not known and is_of_now(order, now_ns)

    def _hear_stop(self, order: ModeCommand | StopOrder, now_ns: int) -> None:
        if order.sequence != self._stops.get(order.holder):
            self._hear(self._stops, order, now_ns)

    def _hear(self, newest: dict[str, int], order: ModeCommand | StopOrder, given_ns: int) -> None:
        _remember(newest, order)
        if order.mode == "off":
            _remember(self._stops, order)
            self._due_ns = given_ns if self._due_ns is None else max(self._due_ns, given_ns)

    def _close(self, given_ns: int) -> None:
        """Close the latch, or try again at the next beat."""
        self._problem = ""
        try:
            self._latch.close(given_ns)
            self._due_ns = None
        except OSError as error:  # the actuator hears the order, too
            self._problem = f"an order to let go cannot be latched: {error}"


def _remember(newest: dict[str, int], order: ModeCommand | StopOrder) -> None:
    """Note an order as its holder's newest, and forget who was silent for longest."""
    newest.pop(order.holder, None)
    newest[order.holder] = order.sequence
    if len(newest) > _HOLDERS:
        del newest[next(iter(newest))]
