"""Attack with valid certificates on a live robot.

The robot's processes run behind its secured router. The attacker connects over TLS with a role's certificate.
"""

import contextlib
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import numpy as np

from benchmarks.access.role_attack import (
    OFF_HOLDER,
    PERIOD_S,
    ROLE_NAMES,
    WALKS,
    Attacker,
    Leader,
    Row,
    kinds,
    off_delay_s,
    why_it_stands,
)
from benchmarks.faults import bus_sniffer, instrumented_robot
from benchmarks.faults.bus_log import Recorder
from benchmarks.faults.instrumented_robot import Page, Places
from benchmarks.robot.soak import own_mb
from sextant.deploy.launch.launcher import Launcher
from sextant.deploy.security.authority import Authority
from sextant.deploy.security.router_security import Gate
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.wire import codec, topics
from sextant.shared.wire.access import Keys
from sextant.shared.wire.messages import ActuatorState, GroundTruth, Mode, PlannerStatus, StopOrder
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, ZenohLink

_NAMESPACE = "attacked"
_GROUND = "flat"
_UP_S, _BACK_S = 120.0, 60.0  # [s] timeouts for the first walk, and for one after torque off
_LEARN_S = 3.0  # [s] of walking from which examples are kept
_WALKS_M, _WALKS_S = 0.01, 1.5  # [m] minimum motion of a walking robot in a time [s]
_OFFS = 3  # torque-off orders in each attack
_OFF_PATIENCE_S = 3.0
_LOOK_S = 0.05
_MEMORY_LOOKS = 5


class _Robot:
    """Processes of a robot with page and recorder, its bus, and its true position.

    This is a context manager.
    """

    def __init__(self, folder: Path, seed: int):
        authority = Authority(days=1)
        for role in ROLE_NAMES:
            authority.issue(folder / role, role)
        self._folder, self._secure = folder, f"tls/127.0.0.1:{free_port()}"
        self._places = Places.free(_NAMESPACE)
        self._latch = Latch.of_port(self._places.servos)
        gate = Gate((*self._places.robot.connect, self._secure), _NAMESPACE, folder / "robot")
        page = Page(free_port(), str(folder / "recordings"))
        commands = instrumented_robot.commands(self._places, seed, _GROUND, page, gate=gate)
        self._launcher = Launcher(commands, hear=self._hear_line)
        self.names = [command.name for command in commands]
        profile = load_profile("phantomx_mk2")
        self.recorder = Recorder(profile)
        self.ids = profile.servo_ids.ravel().tolist()
        self.ended: list[str] = []
        self.reasons: Counter[str] = Counter()
        self.looks = self.walked = 0  # checks for walking, and those in which it walked
        self.state: ActuatorState | None = None
        self.planner: PlannerStatus | None = None
        self._track: list[tuple[float, float, float]] = []  # [s, m, m]
        self._over = threading.Event()

    def __enter__(self) -> Self:
        self._latch.open()
        with contextlib.ExitStack() as stack:
            stack.callback(self._latch.open)
            stack.enter_context(self._launcher)
            self._launcher.wait_for_start(_UP_S)
            self.link = stack.enter_context(ZenohLink(self._places.robot))
            self.link.subscribe(topics.TRUTH, self._hear_truth)
            self.link.subscribe(topics.ACTUATOR_STATE, self._hear_state)
            self.link.subscribe(topics.PLANNER_STATUS, self._hear_status)
            leading = threading.Thread(target=run_live, args=(Leader(), self.link, self._over), name="leader")
            leading.start()
            stack.callback(leading.join)
            stack.callback(self._over.set)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def link_of(self, role: str) -> ZenohLink:
        """Open a link with a role's certificate."""
        return ZenohLink(Endpoints((self._secure,), namespace=_NAMESPACE, keys=Keys.load(self._folder / role)))

    def walks(self) -> bool:
        """Return whether it moves, by ground truth."""
        track = self._track[-200:]
        recent = [(x, y) for t, x, y in track if t > time.monotonic() - _WALKS_S]
        return len(recent) > 1 and float(np.hypot(*np.subtract(recent[-1], recent[0]))) > _WALKS_M

    def look(self, seconds: float) -> None:
        """Wait, and record which processes have ended."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.ended += [str(ended)[:200] for ended in self._launcher.wait(_LOOK_S)]
            self.looks, self.walked = self.looks + 1, self.walked + self.walks()

    def until_it_walks(self, within_s: float) -> bool:
        """Return whether it walks within a time."""
        limit = time.monotonic() + within_s
        while not self.walks():
            if time.monotonic() > limit:
                return False
            self.look(_LOOK_S)
        return True

    def memory_mb(self) -> dict[str, float]:
        """Return the memory [MB] of each process: the minimum in one second.

        A recorder's memory varies with the data that it has not written yet.
        """
        looks = []
        for _ in range(_MEMORY_LOOKS):
            looks.append({name: own_mb(self._launcher.pid(name)) for name in self.names if name in self._launcher.names()})
            self.look(1.0 / _MEMORY_LOOKS)
        return {name: min(look.get(name, np.inf) for look in looks) for name in self.names}

    def off(self, bystander: ZenohLink) -> float:
        """Order torque off as a bystander; return the time [ms] until it is off.

        The time is infinite if torque is not off within a few seconds.
        """
        self.recorder.switches.clear()
        now_ns = time.monotonic_ns()
        order = StopOrder(now_ns, "off", now_ns, OFF_HOLDER)
        bystander.send(topics.STOP, codec.encode(order, codec.Timing(now_ns, now_ns)))
        limit = time.monotonic() + _OFF_PATIENCE_S
        while (delay_s := off_delay_s(self.recorder, now_ns * 1e-9, self.ids)) is None and time.monotonic() < limit:
            self.look(_LOOK_S)
        return float("inf") if delay_s is None else round(1e3 * delay_s, 1)

    def _hear_line(self, name: str, line: str) -> None:
        if name == "tap" and line.startswith("sent "):
            match bus_sniffer.understood(line):
                case bus_sniffer.Sent(at_ns, data):
                    self.recorder.heard(data, at_ns)

    def _hear_truth(self, _topic: AnyTopic, frame: bytes) -> None:
        truth, _ = codec.decode(frame, GroundTruth)
        self._track.append((time.monotonic(), float(truth.T_world_body[0, 3]), float(truth.T_world_body[1, 3])))
        del self._track[:-400]

    def _hear_state(self, _topic: AnyTopic, frame: bytes) -> None:
        with contextlib.suppress(codec.DecodeError):
            self.state = state = codec.decode(frame, ActuatorState)[0]
            if state.mode is not Mode.WALK:
                self.reasons[f"{state.mode}: {state.reason}"] += 1

    def _hear_status(self, _topic: AnyTopic, frame: bytes) -> None:
        with contextlib.suppress(codec.DecodeError):
            self.planner = codec.decode(frame, PlannerStatus)[0]


def measure(roles: Sequence[str], messages: int, seed: int, say: Callable[[str], object] = lambda _: None) -> tuple[Row, ...]:
    """Attack with each role in turn, each time on a new robot.

    Raises:
        TimeoutError: A robot does not walk before the attack.
    """
    rows = []
    for role in roles:
        with tempfile.TemporaryDirectory() as name, _Robot(Path(name), seed) as robot:
            rows.append(_attack(robot, role, messages, seed))
        say(f"{role}: {rows[-1].messages} messages, {'pass' if rows[-1].passed else 'FAIL'}")
    return tuple(rows)


def _attack(robot: _Robot, role: str, messages: int, seed: int) -> Row:
    attacker, sent = Attacker(role, seed), [0]
    with robot.link_of(role) as link, robot.link_of("viewer") as bystander:
        # 1. Walk, and keep examples of the messages.
        endings = [robot.link.subscribe(topic, attacker.learn) for topic in attacker.topics]
        if not robot.until_it_walks(_UP_S):
            raise TimeoutError(f"a walk expected before the attack of {role}: {kinds(robot.reasons)}; {robot.ended}")
        robot.look(_LEARN_S)
        for end in endings:
            end()
        robot.ended.clear()
        robot.reasons.clear()
        robot.looks = robot.walked = 0
        before = robot.memory_mb()
        # 2. Attack, with occasional torque-off orders.
        attacking = threading.Thread(target=_send, args=(attacker, link, messages, sent), name="attack")
        attacking.start()
        offs: list[float] = []
        half: dict[str, float] = {}
        while attacking.is_alive():
            robot.look(_LOOK_S)
            if len(offs) < _OFFS and sent[0] >= (len(offs) + 1) * messages // (_OFFS + 1):
                offs.append(robot.off(bystander))
            if not half and sent[0] >= messages // 2:
                half = robot.memory_mb()
        attacking.join()
        offs += [robot.off(bystander) for _ in range(_OFFS - len(offs))]  # for an attack that ended earlier
        # 3. Check the robot afterwards.
        afterwards = WALKS if robot.until_it_walks(_BACK_S) else why_it_stands(robot.state, robot.planner)
        after = robot.memory_mb()
    growth, taken = _more(after, half), _more(after, before)
    walking = round(robot.walked / max(robot.looks, 1), 3)
    return Row(role, sent[0], walking, kinds(robot.reasons), tuple(offs), tuple(robot.ended), growth, taken, afterwards)


def _more(after: dict[str, float], before: dict[str, float]) -> dict[str, float]:
    """Return the additional memory [MB] of each process.

    Processes that have ended or are new are left out.
    """
    return {name: round(mb - before[name], 1) for name, mb in after.items() if np.isfinite(mb - before.get(name, np.nan))}


def _send(attacker: Attacker, link: ZenohLink, messages: int, sent: list[int]) -> None:
    due = time.monotonic()
    for _ in range(messages):
        topic, frame = attacker.next(time.monotonic_ns())
        link.send(topic, frame)
        sent[0] += 1
        due = max(due + PERIOD_S, time.monotonic() - PERIOD_S)
        time.sleep(max(0.0, due - time.monotonic()))
