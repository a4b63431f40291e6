"""Latches the order to let go: an actuator that is hung, dead or without its bus obeys it first of all, once it is back."""

from collections.abc import Iterator

from services.actuator.latch import Latch
from services.actuator.stop.config import Settings
from shared import topics
from shared.messages import Message, ModeCommand
from shared.robot import RobotProfile
from shared.service import AnyTopic, Inbox, Stages

_HOLDERS = 64  # whose newest orders are remembered


class Stop:
    """Closes the latch at each new order to let go; the actuator alone opens it."""

    name = "stop"
    paced_by: AnyTopic = topics.MODE
    reads: tuple[AnyTopic, ...] = ()
    writes: tuple[AnyTopic, ...] = ()

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Watch over the robot behind a port."""
        self.stages = Stages()
        self._latch = Latch.of_port(settings.port)
        self._newest: dict[str, int] = {}

    def doing(self) -> str:
        """Whether the latch is closed."""
        return "torque is latched off" if self._latch.closed else "listening for the order to let go"

    def step(self, order: ModeCommand, inbox: Inbox) -> Iterator[Message]:
        """Hear one order."""
        newest = self._newest.get(order.holder)
        if newest is None or order.sequence > newest:
            self._newest.pop(order.holder, None)
            self._newest[order.holder] = order.sequence
            if len(self._newest) > _HOLDERS:
                del self._newest[next(iter(self._newest))]
            if order.mode == "off":
                self._latch.close()
        yield from ()
