"""An attack by meaning: each role sends every message that it may send, well formed, with extreme values, while a robot walks.

A certificate of the role is all that the attacker needs, so the access rules and the schema let everything through. What
counts is what the robot does: it walks on or stops with a reason, no process ends, torque goes off when that is ordered,
nothing grows once each process has taken the memory for what it is asked.
In lockstep the services are one process on simulated time; live they are the robot's processes behind its guarded router.
"""

import json
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from random import Random

import numpy as np

from sextant.deploy.faults.watched import SCENARIO
from sextant.deploy.faults.wire import Recorder
from sextant.deploy.fuzz.worst import worst
from sextant.deploy.runs.lockstep_run import LockstepRun, assemble
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.simulator.service import Simulator
from sextant.shared.recording.foxglove.translation import Foxglove
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lockstep import ServiceFailedError
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire import codec, topics
from sextant.shared.wire.access import ROLE_NAMED, ROLES
from sextant.shared.wire.messages import (
    ActuatorState,
    Message,
    Mode,
    ModeCommand,
    PlannerStatus,
    StopOrder,
    Tick,
    VelocityCommand,
)

OFF_WITHIN_S = 0.06  # from the order to torque off on the servo bus
GROWTH_MB = 20.0  # that a process may grow by in the second half of an attack
TAKEN_MB = 64.0  # that it may take in the whole of it: for maps, plans and records that it is asked for
PERIOD_S = 0.004  # between two messages of an attacker
ROLE_NAMES = tuple(role.name for role in ROLES)
WALKS = "walks"
OFF_HOLDER = "bystander"  # who orders torque off
_OFTEN = 8  # examples kept of a topic
_ENDING_SHARE = 0.01  # of the orders that end a walk rightfully: the rest is left out, or it would never walk
_ENDING = ("off", "stop", "sit", "ready")
_ORDER_NS = 500_000_000  # [ns] between two messages of an order
_AGAIN_NS = 1_000_000_000  # [ns] after which an order that was not obeyed is given anew
_UP_NS, _WARM_NS, _BACK_NS = 40_000_000_000, 2_000_000_000, 15_000_000_000  # [ns] to walk; of walking before; to stand up
_LOOK_NS = 20_000_000
_OFF_EVERY = 500  # messages between two orders to turn torque off, in lockstep


@dataclass(frozen=True, slots=True)
class Row:
    """What came of the attack of one role."""

    role: str
    messages: int
    walking: float  # [1] share of the attack in which the robot walked
    reasons: tuple[str, ...]  # why it did not, one of a kind
    off_ms: tuple[float, ...]  # from each order to torque off on the bus
    ended: tuple[str, ...] = ()  # processes or services that ended, with their last words
    growth_mb: dict[str, float] = field(default_factory=dict)  # by process, in the second half of the attack
    taken_mb: dict[str, float] = field(default_factory=dict)  # likewise, in the whole of it
    afterwards: str = WALKS  # what the robot does after the attack: it walks, or why it does not

    @property
    def passed(self) -> bool:
        """Whether nothing ended or grew, torque went off in time each time, and the robot walks or says why not."""
        in_time = bool(self.off_ms) and all(ms <= 1e3 * OFF_WITHIN_S for ms in self.off_ms)
        bounded = (
            max(self.growth_mb.values(), default=0.0) <= GROWTH_MB and max(self.taken_mb.values(), default=0.0) <= TAKEN_MB
        )
        return not self.ended and in_time and bounded and bool(self.afterwards)


class Leader:
    """An operator who has the robot walk in circles, and takes over again from whoever leads it."""

    name = "leader"
    paced_by = Every.hz(20.0)
    reads: tuple[AnyTopic, ...] = (topics.ACTUATOR_STATE,)
    writes: tuple[AnyTopic, ...] = (topics.MODE, topics.VELOCITY)

    def __init__(self) -> None:
        """Begin with nothing ordered."""
        self.stages = Stages()
        self._order, self._given_ns, self._due_ns = "", 0, 0

    def doing(self) -> str:
        """What was ordered last."""
        return self._order

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Have it stand, then walk."""
        state, now_ns = inbox.latest(topics.ACTUATOR_STATE), tick.stamp_ns
        if state is None:
            return
        order = "walk" if state.mode in (Mode.HOLD, Mode.WALK) else "stand"
        leads = state.lease == self.name
        unheard = (not leads or state.mode in (Mode.OFF, Mode.READY)) and now_ns - self._given_ns > _AGAIN_NS
        if order != self._order or unheard or now_ns >= self._due_ns:
            if order != self._order or unheard:
                self._order, self._given_ns = order, now_ns
            self._due_ns = now_ns + _ORDER_NS
            yield ModeCommand(now_ns, self._order, self._given_ns, self.name, not leads)  # type: ignore[arg-type]
        yield VelocityCommand(now_ns, np.array([0.08, 0.0]), 0.2, 0.11, 0.03)


class Attacker:
    """Makes what a role sends, of examples that were heard on the wire."""

    def __init__(self, role: str, seed: int):
        """Begin without examples."""
        self.topics = tuple(ROLE_NAMED[role].puts)
        self._rng = Random(f"{role} {seed}")
        self._frames: dict[str, deque[bytes]] = defaultdict(lambda: deque(maxlen=_OFTEN))

    def learn(self, topic: AnyTopic, frame: bytes) -> None:
        """Keep a frame as an example."""
        self._frames[topic.type.__name__].append(frame)

    def next(self, now_ns: int) -> tuple[AnyTopic, bytes]:
        """A topic and a frame to send at a time [ns]."""
        while True:
            topic = self._rng.choice(self.topics)
            examples = [codec.decode(frame, topic.type, topic.max_bytes)[0] for frame in self._frames[topic.type.__name__]]
            message = worst(topic, examples, now_ns, self._rng)
            ends = isinstance(message, ModeCommand | StopOrder) and message.mode in _ENDING
            if not ends or self._rng.random() < _ENDING_SHARE:
                return topic, codec.encode(message, codec.Timing(now_ns, now_ns))


def off_delay_s(recorder: Recorder, ordered_s: float, ids: Sequence[int]) -> float | None:
    """Time [s] from an order to torque off at all servos, as the bus heard it; None while it has not been."""
    limp: set[int] = set()
    for switch in recorder.switches:
        if switch.heard and switch.register is dxl.TORQUE_ENABLE and switch.t_s >= ordered_s:
            limp |= {i for i, value in switch.values.items() if not value}
            if limp.issuperset(ids):
                return switch.t_s - ordered_s
    return None


def kinds(reasons: Counter[str]) -> tuple[str, ...]:
    """The most frequent reasons, short enough for a table."""
    return tuple(words[:80] for words, _ in reasons.most_common(5))


# -------------------------------------------------------------------------------------------------------- in lockstep


class _Walk:
    """A walk in lockstep, its bus, and what its own actuator says."""

    def __init__(self, attacker: Attacker, seed: int):
        self.profile = load_profile(SCENARIO.robot)
        self.recorder = Recorder(self.profile)
        self.state: ActuatorState | None = None
        self.blocked = ""  # why its own planner does not go on
        self.states: Counter[str] = Counter()
        self._attacker, self._foreign = attacker, False
        self._translation = Foxglove(self.profile)  # of a recorder
        port = f"role attack {seed}"
        self.latch = Latch.of_port(port)
        self.latch.open()
        self.run: LockstepRun = assemble(SCENARIO, seed, self.profile, self._hear, [Leader()], stop_port=port)
        simulator = self.run.service("simulator")
        assert isinstance(simulator, Simulator)
        simulator.bus.overhear(self.recorder.sent, self.recorder.heard)
        self.ids = self.profile.servo_ids.ravel().tolist()

    def _hear(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        self._translation.translate(topic, frame, at_ns)
        if self._foreign:
            return
        self._attacker.learn(topic, frame)
        if topic is topics.PLANNER_STATUS:
            status = codec.decode(frame, PlannerStatus)[0]
            self.blocked = status.reason if status.state == "blocked" else ""
        if topic is topics.ACTUATOR_STATE:
            self.state = codec.decode(frame, ActuatorState)[0]
            self.states["" if self.state.mode is Mode.WALK else f"{self.state.mode}: {self.state.reason}"] += 1

    def attack(self) -> None:
        """Send one message, and let a moment pass."""
        topic, frame = self._attacker.next(self.run.now_ns())
        message, _ = codec.decode(frame, topic.type, topic.max_bytes)
        self._foreign = True
        self.run.say(message, topic)
        self._foreign = False
        self.run.run(self.run.now_ns() + round(1e9 * PERIOD_S))

    def until(self, holds: Callable[[ActuatorState], bool], within_ns: int) -> bool:
        """Let time pass until a state of the actuator; whether it came in time."""
        limit_ns = self.run.now_ns() + within_ns
        while self.state is None or not holds(self.state):
            if self.run.now_ns() >= limit_ns:
                return False
            self.run.run(self.run.now_ns() + _LOOK_NS)
        return True

    def why_it_stands(self) -> str:
        """The reason of the planner, or of the actuator where the planner has none."""
        return self.blocked or ("" if self.state is None else f"{self.state.mode}: {self.state.reason}")

    def off(self) -> float:
        """Order torque off, as a bystander; time [ms] until it is, infinite where it is not within a second."""
        self.recorder.switches.clear()
        now_ns = self.run.now_ns()
        self.run.say(StopOrder(now_ns, "off", now_ns, OFF_HOLDER), topics.STOP)
        self.run.run(now_ns + _AGAIN_NS)
        delay_s = off_delay_s(self.recorder, now_ns * 1e-9, self.ids)
        return float("inf") if delay_s is None else round(1e3 * delay_s, 1)


def measure(roles: Sequence[str], messages: int, seed: int, say: Callable[[str], object] = lambda _: None) -> tuple[Row, ...]:
    """Attack a walk on simulated time with each role in turn, a walk of its own each time."""
    rows = []
    for role in roles:
        rows.append(in_lockstep(role, messages, seed))
        say(f"{role}: {rows[-1].messages} messages, {'pass' if rows[-1].passed else 'FAIL'}")
    return tuple(rows)


def in_lockstep(role: str, messages: int, seed: int) -> Row:
    """Attack a walk on simulated time.

    Raises:
        TimeoutError: The robot does not walk before it is attacked.
    """
    attacker = Attacker(role, seed)
    walk = _Walk(attacker, seed)
    offs: list[float] = []
    ended: tuple[str, ...] = ()
    sent, back, reason = 0, True, ""
    try:
        if not walk.until(lambda state: state.mode is Mode.WALK, _UP_NS):
            raise TimeoutError(f"a walk expected before the attack, the actuator says {walk.state}")
        walk.run.run(walk.run.now_ns() + _WARM_NS)
        walk.states.clear()
        while sent < messages:
            walk.attack()
            sent += 1
            if sent % _OFF_EVERY == 0 or sent == messages:
                walk.until(lambda state: state.mode is not Mode.OFF, _BACK_NS)
                offs.append(walk.off())
                back = walk.until(lambda state: state.mode is Mode.WALK, _UP_NS)
        reason = WALKS if back else walk.why_it_stands()
    except ServiceFailedError as error:
        ended = (str(error),)
    finally:
        walk.latch.open()
    walking, total = walk.states[""], walk.states.total()
    del walk.states[""]
    return Row(role, sent, round(walking / max(total, 1), 3), kinds(walk.states), tuple(offs), ended, afterwards=reason)


# ------------------------------------------------------------------------------------------------------------- for people


def in_words(rows: Sequence[Row]) -> str:
    """A table."""
    lines = [
        "| role | messages | walking | why not | torque off after, ms | ended | growth, MB | taken, MB | afterwards | |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = (
            f"`{row.role}`",
            f"{row.messages}",
            f"{100 * row.walking:.0f} %",
            _in_a_cell("; ".join(row.reasons[:3])) or "-",
            " / ".join(f"{ms:.0f}" for ms in row.off_ms) or "-",
            "; ".join(row.ended) or "none",
            _most(row.growth_mb),
            _most(row.taken_mb),
            _in_a_cell(row.afterwards) or "stands without a reason",
            "pass" if row.passed else "FAIL",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _in_a_cell(words: str) -> str:
    return words.replace("|", "/").replace("\n", " ")


def _most(memory_mb: dict[str, float]) -> str:
    name, most = max(memory_mb.items(), key=lambda item: item[1], default=("-", 0.0))
    return f"{most:+.1f} ({name})"


def to_json(rows: Sequence[Row]) -> str:
    """The rows as JSON."""
    return json.dumps([asdict(row) | {"passed": row.passed} for row in rows], indent=1)
