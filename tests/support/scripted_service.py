"""A service with scripted behaviour, and messages for it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.wire.messages import Message, ModeCommand, PlannerStatus, VelocityCommand


def velocity(stamp_ns: int = 0, forward: float = 0.1) -> VelocityCommand:
    return VelocityCommand(stamp_ns, np.array([forward, 0.0]), 0.0, 0.1, 0.04)


def order(sequence: int) -> ModeCommand:
    return ModeCommand(0, "walk", sequence)


def status(step: int) -> PlannerStatus:
    return PlannerStatus(0, "stepping", "", step, 0, -1)


@dataclass
class Scripted:
    """A service whose behaviour the test defines."""

    name: str
    trigger: Any
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = ()
    act: Callable[[Any, Inbox], Iterable[Message]] = lambda _message, _inbox: ()
    stages: Stages = field(default_factory=Stages)
    seen: list[Any] = field(default_factory=list)

    def step(self, message: Any, inbox: Inbox) -> Iterable[Message]:
        self.seen.append((inbox.now_ns, message))
        return self.act(message, inbox)

    def status(self) -> str:
        return "what it is told"


class Kept:
    """Frames that wait to be fetched."""

    def __init__(self, *frames: bytes) -> None:
        self.frames = list(frames)

    def take(self) -> list[bytes]:
        taken, self.frames = self.frames, []
        return taken
