"""Fault injection into a walk of processes over Zenoh in real time.

Each fault is injected at a different phase of the step.
"""

import contextlib
import secrets
import shutil
import tempfile
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from math import inf, nan
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from benchmarks.faults import bus_sniffer, cpu_load, instrumented_robot
from benchmarks.faults.bus_log import Role
from benchmarks.faults.cases import Away, Case, Deed, Hogs, Off, OnBus
from benchmarks.faults.fault_run import LEAST_WATCH_S, FaultRun, Observed
from benchmarks.faults.instrumented_robot import Page, Places
from sextant.deploy.launch.launcher import Launcher
from sextant.deploy.launch.process_table import ENVIRONMENT, Command
from sextant.deploy.security.router_security import Gate
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.recording.reader import files_of, newest_ns
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Message, Mode, ModeCommand, RecordCommand
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import ZenohLink

_GROUND = "flat"  # the simulator's scenario: level ground
_LOOK_S = 0.02
_SETTLE_S = 0.5  # [s] minimum observation after a fault's end
_AGAIN_S = 0.3  # [s] between two crashes
_BACK_S = 15.0  # [s] timeout for the restart of a killed process
_KILLING_S = 0.05  # [s] in which a killed process may still write; its successor's file begins later
_RECORD_S = 0.5  # [s] between two record commands, until recording starts
_WORDS = 40  # number of log lines kept from the processes


class LiveWalk(FaultRun):
    """Processes that walk a robot, with a bus sniffer and faults; a context manager."""

    start_s = 60.0

    def __init__(self, case: Case, seed: int):
        """Prepare the processes.

        Args:
            case: The fault to inject.
            seed: Random seed of the simulator.
        """
        super().__init__(case)
        self._said: deque[str] = deque(maxlen=_WORDS)
        self._signs: dict[str, float] = {}  # newest sign of life [s] of each process
        self._ended: dict[str, float] = {}  # time [s] at which the end of each process was last detected
        self._acts: list[tuple[float, Callable[[], object]]] = []  # scheduled actions and their times [s]
        broken = {deed.service for deed in case.deeds if isinstance(deed, Away)}
        self._places = Places.free("faults", base=case.halves, world="router" in broken)
        self._page = bool(broken & {"console", "recorder"})
        self._recording, self._record_due = False, 0.0
        # created by the recorder, if there is one
        self._recordings = Path(tempfile.gettempdir()) / f"sextant-faults-{secrets.token_hex(8)}"
        self.port = self._places.servos
        self._latch = Latch.of_port(self.port)
        page = Page(free_port(), str(self._recordings)) if self._page else None
        self.commands = commands(self._places, seed, page=page)
        self.names = tuple(one.name for one in self.commands)
        self._launcher = Launcher(self.commands, hear=self.hear_line)

    @property
    def now_s(self) -> float:
        """Monotonic time [s] of the machine."""
        return time.monotonic_ns() * 1e-9

    def __enter__(self) -> Self:
        self._latch.open()
        with contextlib.ExitStack() as stack:
            stack.callback(shutil.rmtree, self._recordings, ignore_errors=True)
            stack.callback(self._latch.open)  # remove the latch
            stack.callback(self._launcher.stop)
            self._launcher.__enter__()
            self._link = stack.enter_context(ZenohLink(self._places.robot))
            for topic in (topics.ACTUATOR_STATE, topics.HEALTH, topics.HEALTH_OF["base"], topics.RECORDER_STATE):
                self._link.subscribe(topic, self.hear)
            away = self._places.world
            world = self._link if away is None else stack.enter_context(ZenohLink(away))
            world.subscribe(topics.TRUTH, self.hear)
            for ours in (topics.MODE, topics.FAULT):
                self._link.wanted(ours)  # announced now, so that the first command is not lost
            if self._places.base is not None:
                base = stack.enter_context(ZenohLink(self._places.base))
                base.subscribe(topics.ACTUATOR_STATE, lambda *_: self._sign(instrumented_robot.BASE_ROUTER, self.now_s))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop all processes."""
        self._stack.close()

    def walk_for(self, length_s: float) -> None:
        """Walk as in the base class, after the robot stands up if torque was off."""
        if self.state is not None and self.state.mode is Mode.OFF:
            self._launcher.kill("operator")  # its successor orders the robot to stand up
        super().walk_for(length_s)

    def last_words(self) -> str:
        """Return the last log lines of the processes."""
        return f"; the processes' last output: {' / '.join(list(self._said)[-5:])}"

    @property
    def walks(self) -> bool:
        """Whether the robot walks, and the recorder, if there is one, records."""
        return super().walks and (self._recording or not self._page)

    def look(self, until_s: float = inf) -> None:
        """Wait for at most one interval.

        Restart ended processes, and start the recording if possible.
        """
        if self._page and not self._recording and self.now_s >= self._record_due:
            self._record_due = self.now_s + _RECORD_S
            self._say(RecordCommand(time.monotonic_ns(), True, time.monotonic_ns()))
        for ended in self._launcher.wait(min(_LOOK_S, max(until_s - self.now_s, 0.0))):
            self.note_end(ended.name, self.now_s)
            self._said.append(str(ended))

    def break_and_watch(self, begin: float, rng: np.random.Generator) -> Observed:
        """Inject the faults of the case, and observe the robot."""
        self._servo = int(rng.choice(self.profile.servo_ids.ravel()))
        self._ordered, ends = nan, [self._begin(deed, begin, rng) for deed in self._case.deeds]
        try:
            while True:
                self.look(min((at for at, _ in self._acts), default=inf))
                now, end = self.now_s, max(over() for over in ends)
                for at, act in sorted(self._acts, key=lambda planned: planned[0]):
                    if at <= now:
                        self._acts.remove((at, act))
                        act()
                if np.isnan(end):
                    if now > begin + _BACK_S:
                        break
                    continue
                if now > end + self._case.watch_s:
                    break
                over = now > max(end + _SETTLE_S, begin + LEAST_WATCH_S)
                if over and (self.walks or (self._case.lets_go and self.state is not None and self.state.mode is Mode.OFF)):
                    break
        finally:
            for _, act in self._acts:  # end all faults
                act()
            self._acts.clear()
        end = max(over() for over in ends)
        away = any(isinstance(deed, Away) and deed.service == "actuator" for deed in self._case.deeds)
        returned = (end if away else begin) if self._case.lets_go else nan
        return Observed(
            self.now_s if np.isnan(end) else end,
            self.pulls(),
            servo=self._servo if self._case.concerns_one else -1,
            ordered_s=self._ordered,
            returned_s=returned,
            lost_s=begin - self._recorded_until(begin) if Away("recorder", True, 0.0) in self._case.deeds else nan,
        )

    def _recorded_until(self, killed_s: float) -> float:
        """Return the time [s] of the last message stored before a kill at `killed_s`."""
        ends = (newest_ns(file) * 1e-9 for folder in self._recordings.iterdir() for file in files_of(folder))
        return max((end for end in ends if end <= killed_s + _KILLING_S), default=-inf)

    def _begin(self, deed: Deed, begin: float, rng: np.random.Generator) -> Callable[[], float]:
        """Start a fault; return a function for its end time [s], NaN if still unknown."""
        match deed:
            case Away(service, kill=True, for_s=for_s):
                self._launcher.kill(service)
                self._acts += [
                    (begin + at, lambda: self._launcher.kill(service)) for at in np.arange(_AGAIN_S, for_s, _AGAIN_S)
                ]
                return lambda: self.returned(service, begin)
            case Away(service, kill=False, for_s=for_s):
                self._launcher.freeze(service)
                self._acts.append((begin + for_s, lambda: self._launcher.thaw(service)))
                # It ends earlier if the launcher detects the hang and replaces the process.
                return lambda: float(np.fmin(begin + for_s, self.returned(service, begin)))
            case OnBus(fault, any_servo):
                self._say(replace(fault, servo=self._servo if any_servo else fault.servo).command(time.monotonic_ns()))
                return lambda: begin + deed.for_s
            case Hogs(for_s):
                hogs = Launcher(cpu_load.commands()).__enter__()
                self._acts.append((begin + for_s, hogs.stop))
                return lambda: begin + for_s
            case Off(from_s, until_s):
                self._acts.append((begin + rng.uniform(from_s, until_s), self._order_off))
                return lambda: begin
        raise ValueError(f"a live fault expected, found {deed}; run it in lockstep")

    def note_end(self, name: str, at_s: float) -> None:
        """Record that a process was found to have ended at a time [s]."""
        self._ended[name] = at_s
        self._recording &= name != "recorder"

    def returned(self, name: str, since_s: float) -> float:
        """Return the time [s] of the first sign of life of a process's successor, or NaN."""
        ended, sign = self._ended.get(name, -inf), self._signs.get(name, -inf)
        return sign if since_s < ended < sign else nan

    def _order_off(self) -> None:
        now_ns = time.monotonic_ns()
        self._ordered = now_ns * 1e-9
        self._say(ModeCommand(now_ns, "off", now_ns, "bench"))

    def _say(self, message: Message) -> None:
        self._link.send(topics.OF_TYPE[type(message)], codec.encode(message, codec.Timing(message.stamp_ns, message.stamp_ns)))

    def pulls(self) -> NDArray[np.bool_]:
        """Return the servos (18,) with torque on, by the commands on the bus.

        Initially all are on.
        """
        on = dict.fromkeys(self.profile.servo_ids.ravel().tolist(), True)
        for switch in self.recorder.switches:
            if switch.heard and switch.role is Role.TORQUE:
                on |= {servo: bool(value) for servo, value in switch.values.items()}
        return np.array(list(on.values()))

    def hear(self, topic: AnyTopic, frame: bytes) -> None:
        """Process a received frame; called from Zenoh's threads."""
        if topic is topics.ACTUATOR_STATE:
            self.hear_state(frame)
            self._sign("router", self.now_s)
        elif topic is topics.TRUTH:
            self.hear_truth(frame)
        elif topic is topics.RECORDER_STATE:
            self._recording = codec.decode(frame, topics.RECORDER_STATE.type)[0].recording
        else:
            health = codec.decode(frame, topics.HEALTH.type)[0]
            if health.service != "actuator":  # the bus sniffer reports signs of the actuator
                self._sign(health.service, health.stamp_ns * 1e-9)

    def hear_line(self, name: str, line: str) -> None:
        """Process an output line of a process; called from the launcher's threads.

        Lines of the bus sniffer go to the recorder.
        """
        if name != "tap" or not line.startswith(("open ", "sent ")):  # the sniffer also logs why it ends
            self._said.append(line)
            return
        match bus_sniffer.understood(line):
            case bus_sniffer.Opened(at_ns):
                self._sign("actuator", at_ns * 1e-9)
            case bus_sniffer.Sent(at_ns, data):
                self.recorder.sent(data, at_ns)
                self.recorder.heard(data, at_ns)

    def _sign(self, name: str, at_s: float) -> None:
        """Store a sign of life, but only the first since the end of a process."""
        known = self._signs.get(name, -inf)
        if known <= self._ended.get(name, inf):
            self._signs[name] = at_s


def commands(places: Places, seed: int, gate: Gate | None = None, page: Page | None = None) -> list[Command]:
    """Return all processes of a robot on level ground, with bus sniffer and operator.

    Args:
        places: Endpoints; if the base station has its own router, the operator uses it, as do mapper, planner and page.
        seed: Seed of the simulator.
        gate: Access policy of the router, if other machines may connect.
        page: None for no page and no recorder.
    """
    robot = instrumented_robot.commands(places, seed, _GROUND, page, gate=gate)
    met = places.base or places.robot
    meeting = ("--robot", load_scenario(_GROUND).robot, "--connect", met.connect[0], "--namespace", met.namespace)
    words = ("-m", "benchmarks.faults.scripted_console", *meeting, *(() if places.base is None else ("--elsewhere",)))
    after = ("router",) if places.base is None else (instrumented_robot.BASE_ROUTER,)
    return [*robot, Command("operator", words, ENVIRONMENT, restarts=instrumented_robot.RESTARTS, after=after)]
