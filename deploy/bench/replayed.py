"""A walk's traffic, recorded by somebody who may put such, and put again: whether any of it moves the robot.

The robot is simulated, live, with all its processes, behind a guarded router. The base's certificate hears its plans and
orders while it walks. Then nobody leads it, and all is put again, many times over: while the actuator remembers whose orders
it has heard, and once more after it was killed and another has begun, which remembers nobody's.
"""

import contextlib
import itertools
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from deploy.faults.live import commands
from deploy.launch.launcher import Launcher, free_port
from deploy.network.authority import Authority
from deploy.network.gate import Gate
from deploy.runs import tapped_robot
from services.actuator.latch import Latch
from shared import codec, topics
from shared.access import ROLES, Keys
from shared.messages import ActuatorState, Mode
from shared.service import AnyTopic
from shared.transport import Endpoints, ZenohLink

_NAMESPACE = "replayed"
_PATIENCE_S = 90.0
_WALK_S = 12.0  # of which the traffic is recorded
_PERIOD_S = 0.002  # between two frames that are put again: slower than the listener's limits
_SETTLE_S = 0.5
_RECORDED: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.MODE, topics.VELOCITY)


@dataclass(frozen=True, slots=True)
class Replay:
    """What came of it."""

    when: str  # it was put again
    tried: int
    obeyed: int  # states of the actuator in which a plan had been taken, somebody led, or the mode was another than before
    said: tuple[str, ...]  # why not, one of a kind


class _Robot:
    """Processes of a robot behind a guarded router, and who of its own machine hears the actuator; a context manager."""

    def __init__(self, folder: Path):
        authority = Authority(days=1)
        for role in ROLES:
            authority.issue(folder / role.name, role.name)
        plain, self._secure = f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"
        self._folder, self._own = folder, Endpoints((plain,), namespace=_NAMESPACE)
        bus, listen = free_port(), free_port()
        self._latch = Latch.of_port(tapped_robot.port(listen))
        gate = Gate((plain, self._secure), _NAMESPACE, folder / "robot")
        self._launcher = Launcher(commands(self._own, bus, listen, 1, gate))
        self.states: list[ActuatorState] = []

    def __enter__(self) -> "_Robot":
        self._latch.open()
        with contextlib.ExitStack() as stack:
            stack.callback(self._latch.open)
            stack.enter_context(self._launcher)
            link = stack.enter_context(ZenohLink(self._own))
            link.subscribe(topics.ACTUATOR_STATE, self._hear)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def base(self) -> ZenohLink:
        """A link of who holds the base's certificate."""
        return ZenohLink(Endpoints((self._secure,), namespace=_NAMESPACE, keys=Keys.load(self._folder / "base")))

    def until(self, holds: Callable[[ActuatorState], bool], what: str) -> None:
        """Wait for a state of the actuator that comes from now on.

        Raises:
            TimeoutError: There is none.
        """
        begun, limit = len(self.states), time.monotonic() + _PATIENCE_S
        while not any(holds(state) for state in self.states[begun:]):
            if time.monotonic() > limit:
                last = f"{self.states[-1].mode}: {self.states[-1].reason}" if self.states else "nothing"
                raise TimeoutError(f"{what} expected within {_PATIENCE_S:.0f} s, the actuator says {last}")
            self.look(0.02)

    def look(self, seconds: float) -> None:
        """Let time pass; what has ended is started again."""
        self._launcher.wait(seconds)

    def leave_alone(self) -> None:
        """Nobody leads from now on: the operator's process stands still, and what it would say is not said."""
        self._launcher.freeze("operator")

    def begin_anew(self) -> None:
        """Kill the actuator, and wait for the next one."""
        epoch = self.states[-1].epoch
        self._launcher.kill("actuator")
        self.until(lambda state: state.epoch != epoch and state.mode is Mode.HOLD, "another actuator, which holds")

    def _hear(self, _topic: AnyTopic, frame: bytes) -> None:
        self.states.append(codec.decode(frame, topics.ACTUATOR_STATE.type)[0])


def measure(messages: int, say: Callable[[str], object] = lambda _: None) -> tuple[Replay, ...]:
    """Record a walk, and put it again, so many messages each time.

    Raises:
        TimeoutError: The robot does not do what it is to do before anything is put again.
    """
    with tempfile.TemporaryDirectory() as name, _Robot(Path(name)) as robot, robot.base() as base:
        frames: list[tuple[AnyTopic, bytes]] = []
        for topic in _RECORDED:
            base.subscribe(topic, lambda topic, frame: frames.append((topic, frame)))
        robot.until(lambda state: state.mode is Mode.WALK, "a walk")
        say("replay: the robot walks, and is recorded")
        until = time.monotonic() + _WALK_S
        while time.monotonic() < until:
            robot.look(0.1)
        robot.leave_alone()
        robot.until(lambda state: state.mode is Mode.HOLD and not state.lease, "a robot that stands and that nobody leads")
        kept = tuple(frames)
        done = [_put_again(robot, base, kept, messages, "while it stands, and nobody leads")]
        robot.begin_anew()
        done.append(_put_again(robot, base, kept, messages, "after another actuator has begun"))
    return tuple(done)


def _put_again(robot: _Robot, base: ZenohLink, frames: Sequence[tuple[AnyTopic, bytes]], messages: int, when: str) -> Replay:
    """Put the frames in their order, over and over."""
    before, first = robot.states[-1], len(robot.states)
    putting = threading.Thread(target=_put, args=(base, itertools.islice(itertools.cycle(frames), messages)), name="put again")
    putting.start()
    while putting.is_alive():
        robot.look(0.1)
    putting.join()
    robot.look(_SETTLE_S)
    seen = robot.states[first:]
    obeyed = [s for s in seen if s.mode is not before.mode or s.lease or s.plan_ns != before.plan_ns or s.step != before.step]
    said = [text.partition(";")[0] for s in seen for text in (s.refused, *s.warnings) if " refused: " in text]
    words = {_kind(text): text for text in said}
    return Replay(when, messages, len(obeyed), tuple(sorted(words.values())))


def _put(link: ZenohLink, frames: Iterator[tuple[AnyTopic, bytes]]) -> None:
    due = time.monotonic()
    for topic, frame in frames:
        link.send(topic, frame)
        due += _PERIOD_S
        time.sleep(max(0.0, due - time.monotonic()))


def _kind(text: str) -> str:
    """Of a refusal: its words without their numbers."""
    return "".join(c for c in text if not c.isdigit())
