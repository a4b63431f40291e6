"""Latches the order to let go: an actuator that is hung, dead or without its bus obeys it first of all, once it is back."""

from collections.abc import Iterator

from services.actuator.latch import Latch
from services.actuator.stop.config import Settings
from shared import topics
from shared.messages import Message, ModeCommand, StopOrder, Tick
from shared.robot import RobotProfile
from shared.service import AnyTopic, Every, Inbox, Stages

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
        self._newest: dict[str, int] = {}
        self._stops: dict[str, int] = {}

    def doing(self) -> str:
        """Whether the latch is closed."""
        if self._problem:
            return self._problem
        return "torque is latched off" if self._latch.closed else "listening for the order to let go"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Hear what was ordered."""
        newest = {order.holder: order for order in sorted(inbox.drain(topics.MODE), key=lambda order: order.sequence)}
        for order in newest.values():  # an order to let go that was taken back before it was heard here is none
            known = self._newest.get(order.holder)
            if known is None or order.sequence > known:
                self._hear(self._newest, order, min(order.sequence, tick.stamp_ns))
        for stop in inbox.drain(topics.STOP):
            if stop.sequence != self._stops.get(stop.holder):
                self._hear(self._stops, stop, tick.stamp_ns)
        yield from ()

    def _hear(self, newest: dict[str, int], order: ModeCommand | StopOrder, given_ns: int) -> None:
        newest.pop(order.holder, None)
        newest[order.holder] = order.sequence
        if len(newest) > _HOLDERS:
            del newest[next(iter(newest))]
        if order.mode != "off":
            return
        self._problem = ""
        try:
            self._latch.close(given_ns)
        except OSError as error:  # the actuator hears the order, too
            self._problem = f"an order to let go cannot be latched: {error}"
