"""Latches torque-off orders, also while the actuator hangs, is down or has no bus.

The actuator executes the order as soon as it is back.
"""

from collections.abc import Iterator

from sextant.services.actuator.estop.config import Settings
from sextant.services.actuator.safety.command_ordering import is_no_time, is_of_now
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Message, ModeCommand, StopOrder, Tick

_BEAT_HZ = 25.0  # rate at which orders are processed
_HOLDERS = 64  # clients whose newest orders are remembered


class EmergencyStop:
    """Closes the latch at each new torque-off order; only the actuator opens it."""

    name = "stop"
    subscribes: tuple[AnyTopic, ...] = (topics.MODE, topics.STOP)
    publishes: tuple[AnyTopic, ...] = ()

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Watch the robot behind a port."""
        self.trigger = Every.hz(_BEAT_HZ)
        self.stages = Stages()
        self._latch = Latch.of_port(settings.port)
        self._problem = ""  # why the newest torque-off order is not latched, or an empty string
        self._due_ns: int | None = None  # time of the torque-off order that still has to be latched
        self._latest_ns = 0  # just after the newest order of all clients; later received orders count as later
        self._newest: dict[str, int] = {}
        self._stops: dict[str, int] = {}

    def status(self) -> str:
        """Return whether the latch is closed."""
        if self._problem:
            return self._problem
        try:
            closed = self._latch.closed
        except OSError as error:
            return f"cannot read the torque-off latch: {error}"
        return "torque is latched off" if closed else "waiting for a torque-off order"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Process the received orders."""
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
            self._hear_stop(stop, said_ns)  # when it was sent, because this process may have been late
        if self._due_ns is not None:
            self._close(self._due_ns)
        yield from ()

    def _is_late(self, order: ModeCommand, now_ns: int) -> bool:
        """Return whether a current, unknown `off` came after its holder's newer order."""
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
        """Close the latch; after a failure it is tried again in the next cycle."""
        self._problem = ""
        try:
            self._latch.close(given_ns)
            self._due_ns = None
        except OSError as error:  # the actuator receives the order, too
            self._problem = f"cannot latch a torque-off order: {error}"


def _remember(newest: dict[str, int], order: ModeCommand | StopOrder) -> None:
    """Store an order as its holder's newest; forget the holder silent longest."""
    newest.pop(order.holder, None)
    newest[order.holder] = order.sequence
    if len(newest) > _HOLDERS:
        del newest[next(iter(newest))]
