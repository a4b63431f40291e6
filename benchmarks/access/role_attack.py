"""Attack with valid certificates while a robot walks.

Each role sends every message that it may send, well formed, with extreme values. The attacker needs only a certificate of the
role, so the access rules and the schema accept everything. The robot's reaction is evaluated. It must walk on or stop with a
reason. No process may end. Torque must go off when ordered. Memory must stay bounded once each process has allocated what its
requests need.
In lockstep, the services are one process on simulated time. In live mode, they are the robot's processes behind its secured
router.
"""

import json
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from random import Random

import numpy as np

from benchmarks.access.extreme_values import worst
from benchmarks.faults.bus_log import Recorder, Role
from benchmarks.faults.fault_run import SCENARIO
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.simulator.service import Simulator
from sextant.shared.recording.foxglove.translation import Foxglove
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lockstep import ServiceFailedError
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
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

OFF_WITHIN_S = 0.06  # [s] from the order to torque off on the servo bus
GROWTH_MB = 20.0  # maximum growth of a process in the second half of an attack
TAKEN_MB = 64.0  # maximum growth in the whole attack: for requested maps, plans and recordings
PERIOD_S = 0.004  # [s] between two messages of an attacker
ROLE_NAMES = tuple(role.name for role in ROLES)
WALKS = "walks"
OFF_HOLDER = "bystander"  # holder of the torque-off orders
_OFTEN = 8  # examples kept per topic
_ENDING_SHARE = 0.01  # share kept of the orders that validly end a walk: with all of them, the robot would never walk
_ENDING = ("off", "stop", "sit", "ready")
_ORDER_NS = 500_000_000  # [ns] between two messages of an order
_AGAIN_NS = 1_000_000_000  # [ns] after which an ignored order is repeated as a new one
# [ns] timeout for walking; walking before the attack; timeout for standing up
_UP_NS, _WARM_NS, _BACK_NS = 40_000_000_000, 2_000_000_000, 15_000_000_000
_LOOK_NS = 20_000_000
_OFF_EVERY = 500  # messages between two torque-off orders, in lockstep


@dataclass(frozen=True, slots=True)
class Row:
    """Results of the attack by one role."""

    role: str
    messages: int
    walking: float  # [1] share of the attack in which the robot walked
    reasons: tuple[str, ...]  # reasons for not walking, one of each kind
    off_ms: tuple[float, ...]  # time from each order to torque off on the bus
    ended: tuple[str, ...] = ()  # ended processes or services, with their last output
    growth_mb: dict[str, float] = field(default_factory=dict)  # by process, in the second half of the attack
    taken_mb: dict[str, float] = field(default_factory=dict)  # by process, in the whole attack
    afterwards: str = WALKS  # state after the attack: the robot walks, or the reason why it does not

    @property
    def passed(self) -> bool:
        """Whether the attack had no effect.

        No process ended or grew, torque went off in time, and the robot walks or reports why not.
        """
        in_time = bool(self.off_ms) and all(ms <= 1e3 * OFF_WITHIN_S for ms in self.off_ms)
        bounded = (
            max(self.growth_mb.values(), default=0.0) <= GROWTH_MB and max(self.taken_mb.values(), default=0.0) <= TAKEN_MB
        )
        return not self.ended and in_time and bounded and bool(self.afterwards)


class Leader:
    """Operator that walks the robot in circles, and always takes over control again."""

    name = "leader"
    trigger = Every.hz(20.0)
    subscribes: tuple[AnyTopic, ...] = (topics.ACTUATOR_STATE,)
    publishes: tuple[AnyTopic, ...] = (topics.MODE, topics.VELOCITY)

    def __init__(self) -> None:
        """Start without an order."""
        self.stages = Stages()
        self._order, self._given_ns, self._due_ns = "", 0, 0

    def status(self) -> str:
        """Return the last order."""
        return self._order

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Order the robot to stand, then to walk."""
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
    """Generates a role's messages from examples received on the network."""

    def __init__(self, role: str, seed: int):
        """Start without examples."""
        self.topics = tuple(ROLE_NAMED[role].publishes)
        self._rng = Random(f"{role} {seed}")
        self._frames: dict[str, deque[bytes]] = defaultdict(lambda: deque(maxlen=_OFTEN))

    def learn(self, topic: AnyTopic, frame: bytes) -> None:
        """Keep a frame as an example."""
        self._frames[topic.type.__name__].append(frame)

    def next(self, now_ns: int) -> tuple[AnyTopic, bytes]:
        """Return a topic and a frame to send at a time [ns]."""
        while True:
            topic = self._rng.choice(self.topics)
            examples = [codec.decode(frame, topic.type, topic.max_bytes)[0] for frame in self._frames[topic.type.__name__]]
            message = worst(topic, examples, now_ns, self._rng)
            ends = isinstance(message, ModeCommand | StopOrder) and message.mode in _ENDING
            if not ends or self._rng.random() < _ENDING_SHARE:
                return topic, codec.encode(message, codec.Timing(now_ns, now_ns))


def off_delay_s(recorder: Recorder, ordered_s: float, ids: Sequence[int]) -> float | None:
    """Return the time [s] from an order to torque off at all servos.

    It is measured on the bus. Return None while some servos are still enabled.
    """
    limp: set[int] = set()
    for switch in recorder.switches:
        if switch.heard and switch.role is Role.TORQUE and switch.t_s >= ordered_s:
            limp |= {i for i, value in switch.values.items() if not value}
            if limp.issuperset(ids):
                return switch.t_s - ordered_s
    return None


def kinds(reasons: Counter[str]) -> tuple[str, ...]:
    """Return the most frequent reasons, shortened for a table."""
    return tuple(words[:80] for words, _ in reasons.most_common(5))


# -------------------------------------------------------------------------------------------------------- in lockstep


class _Walk:
    """A walk in lockstep, its bus, and the messages of its own services."""

    def __init__(self, attacker: Attacker, seed: int):
        self.profile = load_profile(SCENARIO.robot)
        self.recorder = Recorder(self.profile)
        self.state: ActuatorState | None = None
        self.planner: PlannerStatus | None = None  # of its own planner
        self.states: Counter[str] = Counter()
        self._attacker, self._foreign = attacker, False
        self._translation = Foxglove(self.profile)  # as in a recorder
        port = f"role attack {seed}"
        self.latch = Latch.of_port(port)
        self.latch.open()
        self.run = LockstepRun(SCENARIO, seed, self.profile, self._hear, [Leader()], stop_port=port)
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
            self.planner = codec.decode(frame, PlannerStatus)[0]
        if topic is topics.ACTUATOR_STATE:
            self.state = codec.decode(frame, ActuatorState)[0]
            self.states["" if self.state.mode is Mode.WALK else f"{self.state.mode}: {self.state.reason}"] += 1

    def attack(self) -> None:
        """Send one message, and run for one period."""
        topic, frame = self._attacker.next(self.run.now_ns())
        message, _ = codec.decode(frame, topic.type, topic.max_bytes)
        self._foreign = True
        self.run.say(message, topic)
        self._foreign = False
        self.run.run(self.run.now_ns() + round(1e9 * PERIOD_S))

    def until(self, holds: Callable[[ActuatorState], bool], within_ns: int) -> bool:
        """Run until the actuator's state fulfils a condition.

        Return whether it did so in time.
        """
        limit_ns = self.run.now_ns() + within_ns
        while self.state is None or not holds(self.state):
            if self.run.now_ns() >= limit_ns:
                return False
            self.run.run(self.run.now_ns() + _LOOK_NS)
        return True

    def off(self) -> float:
        """Order torque off as a bystander; return the time [ms] until it is off.

        The time is infinite if torque is not off within a second.
        """
        self.recorder.switches.clear()
        now_ns = self.run.now_ns()
        self.run.say(StopOrder(now_ns, "off", now_ns, OFF_HOLDER), topics.STOP)
        self.run.run(now_ns + _AGAIN_NS)
        delay_s = off_delay_s(self.recorder, now_ns * 1e-9, self.ids)
        return float("inf") if delay_s is None else round(1e3 * delay_s, 1)


def why_it_stands(state: ActuatorState | None, planner: PlannerStatus | None) -> str:
    """Return the robot's own reason for not walking, or an empty text.

    A robot that holds or walks in place without a reason of the planner reports none.
    """
    if planner is not None and planner.state in ("blocked", "waiting"):
        return planner.reason
    if state is not None and state.mode in (Mode.OFF, Mode.READY, Mode.FAULT):
        return f"{state.mode}: {state.reason}"
    return ""


def measure(roles: Sequence[str], messages: int, seed: int, say: Callable[[str], object] = lambda _: None) -> tuple[Row, ...]:
    """Attack in simulated time with each role in turn, each time in a new walk."""
    rows = []
    for role in roles:
        rows.append(in_lockstep(role, messages, seed))
        say(f"{role}: {rows[-1].messages} messages, {'pass' if rows[-1].passed else 'FAIL'}")
    return tuple(rows)


def in_lockstep(role: str, messages: int, seed: int) -> Row:
    """Attack a walk in simulated time.

    Raises:
        TimeoutError: The robot does not walk before the attack.
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
        reason = WALKS if back else why_it_stands(walk.state, walk.planner)
    except ServiceFailedError as error:
        ended = (str(error),)
    finally:
        walk.latch.open()
    walking, total = walk.states[""], walk.states.total()
    del walk.states[""]
    return Row(role, sent, round(walking / max(total, 1), 3), kinds(walk.states), tuple(offs), ended, afterwards=reason)


# ------------------------------------------------------------------------------------------------------------- output


def in_words(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table."""
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
    """Return the rows as JSON."""
    return json.dumps([asdict(row) | {"passed": row.passed} for row in rows], indent=1)
