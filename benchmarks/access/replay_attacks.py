"""Replay attacks: whether replayed or bypassing messages move a robot.

The robot is simulated in real time, with all its processes, behind a secured router. A client with the base station's
certificate records plans, orders and velocities during a walk. Then it replays them many times: while the robot stands and a
client leads it, while no client leads, and after a restart of the actuator, which has no memory of earlier orders. At last, a
peer sends orders whose certificate does not permit leading. It scouts, and listens for direct connections that bypass the
router.
"""

import itertools
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.access.guarded_robot import GuardedRobot
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Mode, ModeCommand
from sextant.shared.wire.transport import ZenohLink

_NAMESPACE = "intruders"
_PATIENCE_S = 90.0
_WALK_S = 12.0  # [s] of recorded traffic
_PERIOD_S = 0.006  # [s] between two replayed frames: slower than the listener's limit for any key
_LEAD_S = 0.5  # [s] between two commands of the leader
_SETTLE_S = 0.5
_RECORDED: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.MODE, topics.VELOCITY)


@dataclass(frozen=True, slots=True)
class Attempt:
    """Results of one attack."""

    what: str  # description of the attack
    tried: int
    obeyed: int  # actuator states with an accepted plan, another leader or another mode
    said: tuple[str, ...]  # reasons for rejections, one of each kind


def measure(messages: int, say: Callable[[str], object] = lambda _: None) -> tuple[Attempt, ...]:
    """Record a walk and replay it, then send orders as a peer, with `messages` each.

    Raises:
        TimeoutError: The robot does not behave as required before the replay.
    """
    with tempfile.TemporaryDirectory() as name, GuardedRobot(Path(name)) as robot, robot.link_of("base") as base:
        kept = _recorded(robot, base)
        say("the walk is recorded")
        robot.leave_alone()
        robot.until(lambda state: state.mode is Mode.HOLD and not state.lease, "a standing robot without a lease holder")
        robot.lead(True)
        done = [_attempt(robot, base, _over_and_over(kept, messages), "replayed walk while a client holds the lease")]
        robot.lead(False)
        done.append(_attempt(robot, base, _over_and_over(kept, messages), "replayed walk while no client holds the lease"))
        robot.restart_clock()
        done.append(_attempt(robot, base, _over_and_over(kept, messages), "replayed walk after a restart of the actuator"))
        with robot.peer_of("viewer") as peer:
            done.append(_attempt(robot, peer, _orders(messages), "orders of a peer that tries to bypass the router"))
    return tuple(done)


def _recorded(robot: GuardedRobot, base: ZenohLink) -> tuple[tuple[AnyTopic, bytes], ...]:
    """Return the messages of a walk, in order."""
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
    """Yield orders with the current time."""
    for _ in range(messages):
        now_ns = time.monotonic_ns()
        yield topics.MODE, codec.encode(ModeCommand(now_ns, "walk", now_ns, "peer", take_over=True))


def _attempt(robot: GuardedRobot, link: ZenohLink, frames: Iterator[tuple[AnyTopic, bytes]], what: str) -> Attempt:
    """Send frames, and evaluate the robot's reaction."""
    before, first, tried = robot.states[-1], len(robot.states), itertools.count()
    putting = threading.Thread(target=_put, args=(link, frames, tried), name="put")
    putting.start()
    while putting.is_alive():
        robot.look(0.1)
    putting.join()
    robot.look(_SETTLE_S)
    seen = robot.states[first:]
    same = [(s.mode, s.lease, s.plan_ns, s.step) == (before.mode, before.lease, before.plan_ns, before.step) for s in seen]
    known = (before.plan_refusal, *before.warnings)
    said = [text.partition(";")[0] for s in seen for text in (s.plan_refusal, *s.warnings) if text and text not in known]
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
    """Return the text of a rejection without its numbers."""
    return "".join(c for c in text if not c.isdigit())
