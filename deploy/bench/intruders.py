"""Whether what was recorded, or is put around the router, moves a robot: put again, and put by a peer that scouts.

The robot is simulated, live, with all its processes, behind a guarded router. The base's certificate hears its plans, orders
and velocities while it walks. Then all is put again, many times over: while the robot stands and somebody leads it, while
nobody does, and after the actuator was killed and another has begun, which remembers nobody's orders. At last a peer with a
certificate that may not lead scouts and listens beside the router, so that the processes might meet it there, and orders.
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
from deploy.launch.tapped_robot import Places
from deploy.network.authority import Authority
from deploy.network.gate import Gate
from services.actuator.latch import Latch
from shared import codec, topics
from shared.access import ROLES, Keys
from shared.messages import ActuatorState, Mode, ModeCommand
from shared.service import AnyTopic
from shared.transport import Endpoints, ZenohLink

_NAMESPACE = "intruders"
_PATIENCE_S = 90.0
_WALK_S = 12.0  # of which the traffic is recorded
_PERIOD_S = 0.006  # between two frames that are put: slower than the listener's limit of any key
_LEAD_S = 0.5  # between two orders of who leads
_SETTLE_S = 0.5
_RECORDED: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.MODE, topics.VELOCITY)


@dataclass(frozen=True, slots=True)
class Attempt:
    """What came of it."""

    what: str  # was put
    tried: int
    obeyed: int  # states of the actuator in which a plan had been taken, another led, or the mode was another than before
    said: tuple[str, ...]  # why not, one of a kind


class _Robot:
    """Processes of a robot behind a guarded router, and who of its own machine hears the actuator; a context manager."""

    def __init__(self, folder: Path):
        authority = Authority(days=1)
        for role in ROLES:
            authority.issue(folder / role.name, role.name)
        self._folder, self._secure = folder, f"tls/127.0.0.1:{free_port()}"
        self._places = Places.free(_NAMESPACE)
        self._latch = Latch.of_port(self._places.servos)
        gate = Gate((*self._places.robot.connect, self._secure), _NAMESPACE, folder / "robot")
        self._launcher = Launcher(commands(self._places, 1, gate))
        self.states: list[ActuatorState] = []
        self._leads, self._number, self._due_s = False, 0, 0.0

    def __enter__(self) -> "_Robot":
        self._latch.open()
        with contextlib.ExitStack() as stack:
            stack.callback(self._latch.open)
            stack.enter_context(self._launcher)
            self._link = stack.enter_context(ZenohLink(self._places.robot))
            self._link.subscribe(topics.ACTUATOR_STATE, self._hear)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def link_of(self, role: str) -> ZenohLink:
        """A link of who holds the certificate of a role."""
        return ZenohLink(Endpoints((self._secure,), namespace=_NAMESPACE, keys=self._keys(role)))

    def peer_of(self, role: str) -> ZenohLink:
        """A link of who holds it likewise, and scouts and listens for others beside the router."""
        return ZenohLink(Endpoints((self._secure,), True, _NAMESPACE, self._keys(role), loopback=True))

    def _keys(self, role: str) -> Keys:
        return Keys.load(self._folder / role)

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
        """Let time pass; what has ended is started again, and the robot is led, if it is."""
        if self._leads and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + _LEAD_S
            now_ns = time.monotonic_ns()
            self._link.send(topics.MODE, codec.encode(ModeCommand(now_ns, "walk", self._number, "bench")))
        self._launcher.wait(seconds)

    def lead(self, leads: bool) -> None:
        """Lead it from now on, or no longer: it may walk, and is not told where to."""
        self._leads, self._number = leads, time.monotonic_ns()
        self.until(
            lambda s: s.mode is Mode.HOLD and (s.lease == "bench") == leads,
            "a robot that is led" if leads else "one that is not",
        )

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


def measure(messages: int, say: Callable[[str], object] = lambda _: None) -> tuple[Attempt, ...]:
    """Record a walk and put it again, then order as a peer, so many messages each time.

    Raises:
        TimeoutError: The robot does not do what it is to do before anything is put again.
    """
    with tempfile.TemporaryDirectory() as name, _Robot(Path(name)) as robot, robot.link_of("base") as base:
        kept = _recorded(robot, base)
        say("the walk is recorded")
        robot.leave_alone()
        robot.until(lambda state: state.mode is Mode.HOLD and not state.lease, "a robot that stands and that nobody leads")
        robot.lead(True)
        done = [_attempt(robot, base, _over_and_over(kept, messages), "a recorded walk, put again while somebody leads")]
        robot.lead(False)
        done.append(_attempt(robot, base, _over_and_over(kept, messages), "likewise, while nobody does"))
        robot.begin_anew()
        done.append(_attempt(robot, base, _over_and_over(kept, messages), "likewise, after another actuator has begun"))
        with robot.peer_of("viewer") as peer:
            done.append(_attempt(robot, peer, _orders(messages), "orders of a peer that looks for ways around the router"))
    return tuple(done)


def _recorded(robot: _Robot, base: ZenohLink) -> tuple[tuple[AnyTopic, bytes], ...]:
    """What is said on a walk, in its order."""
    frames: list[tuple[AnyTopic, bytes]] = []
    ends = [base.subscribe(topic, lambda topic, frame: frames.append((topic, frame))) for topic in _RECORDED]
    robot.until(lambda state: state.mode is Mode.WALK, "a walk")
    until = time.monotonic() + _WALK_S
    while time.monotonic() < until:
        robot.look(0.1)
    for end in ends:
        end()
    return tuple(frames)


def _over_and_over(frames: Sequence[tuple[AnyTopic, bytes]], messages: int) -> Iterator[tuple[AnyTopic, bytes]]:
    return itertools.islice(itertools.cycle(frames), messages)


def _orders(messages: int) -> Iterator[tuple[AnyTopic, bytes]]:
    """Orders of now."""
    for _ in range(messages):
        now_ns = time.monotonic_ns()
        yield topics.MODE, codec.encode(ModeCommand(now_ns, "walk", now_ns, "peer", take=True))


def _attempt(robot: _Robot, link: ZenohLink, frames: Iterator[tuple[AnyTopic, bytes]], what: str) -> Attempt:
    """Put frames, and see what the robot makes of them."""
    before, first, tried = robot.states[-1], len(robot.states), itertools.count()
    putting = threading.Thread(target=_put, args=(link, frames, tried), name="put")
    putting.start()
    while putting.is_alive():
        robot.look(0.1)
    putting.join()
    robot.look(_SETTLE_S)
    seen = robot.states[first:]
    same = [(s.mode, s.lease, s.plan_ns, s.step) == (before.mode, before.lease, before.plan_ns, before.step) for s in seen]
    known = (before.refused, *before.warnings)
    said = [text.partition(";")[0] for s in seen for text in (s.refused, *s.warnings) if text and text not in known]
    words = {_kind(text): text for text in said}
    return Attempt(what, next(tried), len(seen) - sum(same), tuple(sorted(words.values())))


def _put(link: ZenohLink, frames: Iterator[tuple[AnyTopic, bytes]], tried: Iterator[int]) -> None:
    due = time.monotonic()
    for topic, frame in frames:
        link.send(topic, frame)
        next(tried)
        due += _PERIOD_S
        time.sleep(max(0.0, due - time.monotonic()))


def _kind(text: str) -> str:
    """Of a refusal: its words without their numbers."""
    return "".join(c for c in text if not c.isdigit())
