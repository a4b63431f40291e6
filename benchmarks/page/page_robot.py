"""Simulated robot that serves its page in real time, with a sniffer on its bus."""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Self

import numpy as np
from numpy.typing import NDArray

from benchmarks.faults import bus_sniffer, instrumented_robot
from benchmarks.faults.bus_log import Recorder, Role
from benchmarks.faults.instrumented_robot import Page, Places
from sextant.deploy.launch.launcher import Launcher
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, BodyPose, Health, Mode, ModeCommand
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import ZenohLink

_STILL_TICKS = 1  # change of goals per cycle that is ignored for a standing robot
_STILL_S = 0.25
_STILL_M_S = 0.015  # below this speed over the next cycles, a body is standing: one tick is a millimetre of one foot
_WINDOW = 5  # cycles
_AGAIN_S = 5.0  # [s] between two orders to stand
_PATIENCE_S = 180.0  # [s] timeout on a busy machine


class PageRobot:
    """Processes of a robot with a page; a context manager."""

    def __init__(
        self, scenario: str = "flat", seed: int = 1, recordings: str = "recordings", scan_rate_hz: float | None = None
    ):
        """Prepare the processes.

        Args:
            scenario: Scenario of the simulator.
            seed: Seed of the simulator.
            recordings: Folder for recordings.
            scan_rate_hz: Scan rate of perception; None for the default.
        """
        self.profile = load_profile("phantomx_mk2")
        self.recorder = Recorder(self.profile)
        self.state: ActuatorState | None = None
        self.pose: BodyPose | None = None
        self._up: dict[str, str] = {}  # services that were received, and their status
        self._rising = False  # it has risen since `stand` began, and torque was not off since then
        self._stops_s: list[float] = []  # times [s] of stop orders
        self.said: deque[str] = deque(maxlen=200)
        self.ended: list[str] = []  # descriptions of ended processes
        self.page_port = free_port()
        places = Places.free("page")
        self.endpoints = places.robot
        self._latch = Latch.of_port(places.servos)
        made = instrumented_robot.commands(places, seed, scenario, Page(self.page_port, recordings), scan_rate_hz)
        self._launcher = Launcher(made, hear=self._hear_line)

    @property
    def url(self) -> str:
        """URL of the page."""
        return f"http://127.0.0.1:{self.page_port}/"

    def __enter__(self) -> Self:
        self._latch.open()
        with contextlib.ExitStack() as stack:
            stack.callback(self._latch.open)
            stack.callback(self._launcher.stop)
            self._launcher.__enter__()
            self._link = stack.enter_context(ZenohLink(self.endpoints))
            for topic in (topics.ACTUATOR_STATE, topics.BODY_POSE, topics.HEALTH, topics.MODE):
                self._link.subscribe(topic, self._hear)
            self.until(lambda: "console" in self._up, what="the console")
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def until(self, holds: Callable[[], object], within_s: float = _PATIENCE_S, what: str = "") -> None:
        """Wait for a condition; handle process ends meanwhile.

        Raises:
            TimeoutError: It did not become true.
        """
        limit = time.monotonic() + within_s
        while not holds():
            if time.monotonic() > limit:
                state = "" if self.state is None else f"{self.state.mode}: {self.state.reason}"
                place = "" if self.pose is None else f" at x {self.pose.T_world_body[0, 3]:.2f} m"
                doing = "; ".join(f"{name}: {words}" for name, words in sorted(self._up.items()))
                said = " / ".join(list(self.said)[-6:])
                missed = f"not within {within_s:g} s: {what or 'the expected state'}"
                raise TimeoutError(f"{missed}; the robot{place}: {state}; {doing}; {said}")
            for ended in self._launcher.wait(0.02):
                self.said.append(str(ended))
                self.ended.append(str(ended))

    def pass_time(self, length_s: float) -> None:
        """Wait for some time."""
        end = time.monotonic() + length_s
        self.until(lambda: time.monotonic() >= end, length_s + _PATIENCE_S)

    def is_in(self, *modes: Mode) -> bool:
        """Return whether the actuator is in one of the modes."""
        return self.state is not None and self.state.mode in modes

    def swinging(self) -> NDArray[np.bool_]:
        """Return the legs (6,) in swing, by the newest actuator state."""
        return np.zeros(6, dtype=np.bool_) if self.state is None else self.state.swing

    def moves(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the times [s] of goals on the bus, and their largest changes [ticks].

        There is one change for each set of goals: that of the servo with the largest one.
        """
        goals = list(self.recorder.goals)
        ticks = np.array([g.ticks for g in goals]).reshape(-1, 18)
        return np.array([g.t_s for g in goals])[1:], np.abs(np.diff(ticks, axis=0)).max(axis=1, initial=0)

    def goal_times(self) -> NDArray[np.float64]:
        """Return the times [s] of goals on the bus."""
        return np.array([goal.t_s for goal in list(self.recorder.goals)])

    def still_after(self, since_s: float) -> float:
        """Return how long [s] after a time the goals kept changing.

        The result is infinite if they still change.
        """
        t, change = self.moves()
        return _last(t[change > _STILL_TICKS], t, since_s)

    def stands_after(self, since_s: float, swing: NDArray[np.bool_]) -> float:
        """Return how long [s] after a time the goals kept moving the body.

        The body moves over the legs that stood then, as given by `swing` (6,).
        """
        goals = list(self.recorder.goals)
        t = np.array([g.t_s for g in goals])
        servos = self.profile.servos
        servo = servos.tick_rad * (np.array([g.ticks for g in goals]).reshape(-1, 6, 3) - servos.centre)
        feet = body_forward(self.profile, np.array([self.profile.joint_angles(q) for q in servo]))[:, ~swing]
        body = feet.mean(axis=1)[:, :2]
        way = np.linalg.norm(body[_WINDOW:] - body[:-_WINDOW], axis=-1)
        return _last(t[:-_WINDOW][way > _STILL_M_S * (t[_WINDOW:] - t[:-_WINDOW])], t, since_s)

    def stop_ordered_after(self, since_s: float) -> float:
        """Return how long [s] after a time the console ordered a stop; infinite if never."""
        return next((at_s - since_s for at_s in list(self._stops_s) if at_s >= since_s), np.inf)

    def torque_off_after(self, since_s: float) -> float:
        """Return how long [s] after a time torque off was on the bus; NaN if never."""
        for switch in list(self.recorder.switches):
            off = switch.role is Role.TORQUE and not any(switch.values.values())
            if off and switch.t_s >= since_s:
                return switch.t_s - since_s
        return np.nan

    def stand(self, order: Callable[[], object]) -> None:
        """Order the robot to rise, once its pose is known.

        The order is repeated if the robot does not rise, or switches torque off. On a busy machine, the simulated servos may
        reply late, and a robot with unknown leg positions does not rise.
        """
        self.until(lambda: self.pose is not None, what="a pose")
        self._rising = False
        due_s = 0.0

        def stands() -> bool:
            nonlocal due_s
            if self.is_in(Mode.HOLD, Mode.OFF, Mode.READY) and not self._rising and time.monotonic() >= due_s:
                due_s = time.monotonic() + _AGAIN_S
                order()
            self._rising = self._rising and not self.is_in(Mode.OFF, Mode.READY)
            return self._rising and self.is_in(Mode.HOLD)

        self.until(stands, what="standing")

    @contextlib.contextmanager
    def stopped(self) -> Iterator[None]:
        """Pause all processes but the page's for the duration of the block."""
        names = [name for name in self._launcher.names() if name not in ("router", "console")]
        for name in names:
            self._launcher.freeze(name)
        try:
            yield
        finally:
            for name in names:
                self._launcher.thaw(name)

    def kill(self, name: str) -> None:
        """Kill a process; it is restarted."""
        self._launcher.kill(name)

    def names(self) -> tuple[str, ...]:
        """Names of all processes."""
        return self._launcher.names()

    def pid(self, name: str) -> int:
        """Return a process id."""
        return self._launcher.pid(name)

    def _hear(self, topic: AnyTopic, frame: bytes) -> None:
        message = codec.decode(frame, topic.type)[0]
        if isinstance(message, ActuatorState):
            self.state = message
            self._rising = self._rising or message.mode is Mode.STAND
        elif isinstance(message, BodyPose):
            self.pose = message
        elif isinstance(message, Health):
            self._up[message.service] = message.status
        elif isinstance(message, ModeCommand) and message.mode == "stop":
            self._stops_s.append(time.monotonic())

    def _hear_line(self, name: str, line: str) -> None:
        if name != "tap" or not line.startswith(("open ", "sent ")):
            self.said.append(f"{name}: {line}")
            return
        word = bus_sniffer.understood(line)
        if isinstance(word, bus_sniffer.Sent):
            self.recorder.sent(word.data, word.at_ns)
            self.recorder.heard(word.data, word.at_ns)


def _last(moving: NDArray[np.float64], t: NDArray[np.float64], since_s: float) -> float:
    """Return how long [s] after a time the last of some times [s] was.

    The result is infinite if that is just now.
    """
    after = moving[moving > since_s]
    last = float(after[-1]) if len(after) else since_s
    return last - since_s if len(t) and t[-1] - last > _STILL_S else np.inf
