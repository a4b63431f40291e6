"""A whole run over Zenoh at real time: the services in processes of their own, the attendants in this one."""

import contextlib
import os
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from io import FileIO
from pathlib import Path
from typing import Self

from sextant.deploy import process_table
from sextant.deploy.interrupts import Interrupts
from sextant.deploy.judging.report import Report
from sextant.deploy.launch.launcher import Launcher, free_port, host_router
from sextant.deploy.process_table import ENVIRONMENT, Command, Process
from sextant.deploy.progress import Progress
from sextant.deploy.runs.attendance import RECORDING, Attendance, about, clear
from sextant.shared.files.whole_files import WriteError
from sextant.shared.recording.foxglove.translation import Foxglove
from sextant.shared.recording.live import LiveRecorder, Sink
from sextant.shared.recording.writer import Recorder, Unwritable
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.clock import going_by, now_ns
from sextant.shared.runtime.service import Service
from sextant.shared.runtime.simulated_time import SERVO_BUS, SimulatedTime
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.scenario.scenario import Fault, Scenario
from sextant.shared.wire.transport import Endpoints, ZenohLink

_LOG = "services.log"
_LOOK_S = 0.1  # between two looks at the run
_SHOW_S = 0.25  # between two views of it
_START_S = 180.0  # within which the robot must have come up
_SPEED_OVER_NS = 3_000_000_000  # the newest speed of simulated time is the mean over these seconds
_NAMED = 2  # services that simulated time waited for, in the sentence about it
_REAL_TIME = 0.95  # [1] of real time, from which simulated time counts as real time
# [1] of real time. Passing the bytes of the servo bus between processes takes time on a fast computer, too: `sextant demo` on
# two idle cores runs at some 0.85. A computer is called too slow below this, or where a service was waited for.
_TOO_SLOW = 0.75
_WARM_S = 10.0  # the warm-up takes less when everything is compiled already
_WARM_UP = Command("warm-up", ("-m", "sextant.deploy.warm_up"), ENVIRONMENT)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a live run came to."""

    report: Report
    interrupted: bool  # the operator ended it


def run_live_scenario(
    scenario: Scenario,
    source: str,
    seed: int,
    out: Path,
    progress: Progress,
    interrupts: Interrupts,
    attach: Endpoints | None = None,
    started: Callable[[Launcher], None] = lambda _: None,
    slow_down: bool = False,
) -> Outcome:
    """Run a scenario over Zenoh to its end, leaving report.json, pictures, recording.mcap and services.log in `out`.

    Args:
        scenario: The course and the way to walk it.
        source: Its name or path, for the simulator.
        seed: Of the simulator's randomness.
        out: Folder, made where it is missing.
        progress: Where to show it.
        interrupts: The operator's wish to end it; entered by the caller, in the main thread.
        attach: Where services that somebody else started are met; None starts them.
        started: Is given the launcher once all runs, for tests that break something.
        slow_down: Let simulated time wait for services that this computer runs too late, in place of real time.

    Raises:
        ValueError: `slow_down` of services that somebody else started.
    """
    if attach and slow_down:
        raise ValueError("services that somebody else started go by their own time")
    clear(out)
    attendance = Attendance(load_profile(scenario.robot), scenario, seed, live=True, linked=attach is not None)
    with contextlib.ExitStack() as stack:
        # 1. Host the router and start the services, each in its own process.
        log = stack.enter_context(contextlib.closing(ServiceLog(Path(os.devnull) if attach else out / _LOG)))
        endpoints = attach or stack.enter_context(host_router())
        chosen = process_table.choices(scenario, source, seed, free_port())
        rows = () if attach else process_table.rows("all", simulated=True)
        simulated_time = stack.enter_context(_shared_time(rows)) if slow_down else None
        time_file = simulated_time.path if simulated_time else None
        # 2. Record, command, judge and watch from this process, each over a link of its own. They connect before the
        #    services start, so that the recording has the first word.
        profile = load_profile(scenario.robot)
        sink = _sink(out / RECORDING, about(scenario, seed, "live"), profile)
        recording = stack.enter_context(_recording(sink, endpoints))
        attendants = stack.enter_context(Attendants(attendance.services(), endpoints))
        process_table.new_robot(chosen)
        launcher = Launcher(process_table.commands(rows, chosen, endpoints, simulated_time=time_file), hear=log.hear)
        stack.callback(lambda: launcher.stop(interrupts.insisted))
        launcher.__enter__()
        started(launcher)
        # 3. Watch until something ends it, breaking what the scenario wants broken.
        speed = Speed()
        ended_by = _watch(attendance, attendants, launcher, Faults(scenario.faults_at(seed)), progress, interrupts, speed)
        slowed_down = speed.words(simulated_time.waited_s() if simulated_time else {})
        # 4. Stop everything.
        for name in launcher.stop(interrupts.insisted):
            progress.say(f"{name} did not end when asked and was killed")
    # 5. Judge it and write what it leaves behind.
    report = attendance.judge(speed.mean() * attendance.kept_up(), ended_by, interrupts.asked(), slowed_down)
    unwritten = attendance.leave_behind(report, out, picture=not interrupts.asked())
    for problem in filter(None, (recording.problem, _loss(recording.dropped), log.problem, *unwritten)):
        progress.say(f"warning: {problem}")
    progress.finish()
    return Outcome(report, interrupts.asked())


def warm_up(progress: Progress, interrupts: Interrupts) -> str:
    """Compile what is compiled at first use, in a process of its own; returns what went wrong, in words, or nothing."""
    began = time.monotonic()
    with Launcher([_WARM_UP]) as launcher:
        told = False
        while not interrupts.asked():
            ended = launcher.wait(_LOOK_S)
            if ended:
                return "" if ended[0].how == "exit status 0" else str(ended[0])
            if not told and time.monotonic() - began > _WARM_S:
                told = True
                progress.say("warming up: compiling the inner loops takes about a minute, the first time only")
        launcher.stop(interrupts.insisted)
    return ""


class Attendants:
    """Services that run in threads of this process, each over its own link; a context manager.

    An exception in one of them comes out of `check`, in the thread that asks.
    """

    def __init__(self, services: Mapping[str, Service], endpoints: Endpoints):
        self._services = services
        self._endpoints = endpoints
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._errors: list[Exception] = []
        self._ready = threading.Semaphore(0)

    def __enter__(self) -> Self:
        for name, service in self._services.items():
            thread = threading.Thread(target=self._run, args=(service,), name=name, daemon=True)
            thread.start()
            self._threads.append(thread)
        for _ in self._threads:
            self._ready.acquire()
        if self._errors:
            self.__exit__()
            raise self._errors[0]
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(2.0)

    def check(self) -> None:
        """Raise what has gone wrong in one of them."""
        if self._errors:
            raise self._errors[0]

    def _run(self, service: Service) -> None:
        try:
            with ZenohLink(self._endpoints) as link:
                self._ready.release()
                run_live(service, link, self._stop)
        except Exception as error:  # noqa: BLE001 - it is raised again by check, in the thread that watches
            self._errors.append(error)
            self._ready.release()


class Faults:
    """Breaks running processes when their time has come, and mends those that hang."""

    def __init__(self, faults: tuple[Fault, ...]):
        self._due: list[tuple[float, str, str]] = []  # time [s], act, service
        for fault in faults:
            if fault.of_camera:
                continue  # the simulator's own
            if fault.kind == "kill":
                self._due.append((fault.at_s, "kill", fault.service))
            else:
                self._due += [(fault.at_s, "freeze", fault.service), (fault.at_s + fault.for_s, "thaw", fault.service)]
        self._due.sort()

    def act(self, time_s: float, launcher: Launcher) -> list[str]:
        """Do what is due at a time [s]; says what it did."""
        done: list[str] = []
        while self._due and self._due[0][0] <= time_s:
            _, act, service = self._due.pop(0)
            {"kill": launcher.kill, "freeze": launcher.freeze, "thaw": launcher.thaw}[act](service)
            done.append(f"{time_s:6.1f} s  the scenario's fault: {act} {service}")
        return done


@contextlib.contextmanager
def _recording(sink: Sink, endpoints: Endpoints) -> Iterator[LiveRecorder]:
    with LiveRecorder(sink) as recording, ZenohLink(endpoints) as link:
        recording.listen(link, now_ns)
        yield recording


def _watch(
    attendance: Attendance,
    attendants: Attendants,
    launcher: Launcher,
    faults: Faults,
    progress: Progress,
    interrupts: Interrupts,
    speed: "Speed",
) -> str:
    """Watch a run; returns what ended it from outside, in words, or nothing."""
    began = shown = time.monotonic()
    while not attendance.over():
        for ended in launcher.wait(_LOOK_S):
            progress.say(str(ended))
            if not ended.restarted:
                return str(ended)
        attendants.check()
        view = attendance.monitor.view
        if view.up:
            speed.update()
        if interrupts.asked():
            return "stopped by the operator"
        if not view.up and time.monotonic() - began > _START_S:
            return f"the robot did not come up within {_START_S:.0f} s; heard so far: {_heard(view.doing)}"
        for done in faults.act(view.time_s if view.up else -1.0, launcher):
            progress.say(done)
        if time.monotonic() - shown >= _SHOW_S:
            shown = time.monotonic()
            progress.update(replace(view, of_real_time=speed.newest()))
    return ""


class Speed:
    """How fast the time that services go by runs against real time."""

    def __init__(self, clock: Callable[[], int] = now_ns, machine: Callable[[], int] = time.monotonic_ns):
        """Measure nothing yet.

        Args:
            clock: [ns] that services go by.
            machine: [ns] of real time.
        """
        self._clock, self._machine = clock, machine
        self._looks: deque[tuple[int, int]] = deque()  # real and shared time [ns]; the first one stays
        self._first: tuple[int, int] | None = None

    def update(self) -> None:
        """Take a look at both clocks."""
        look = self._machine(), self._clock()
        self._first = self._first or look
        self._looks.append(look)
        while look[0] - self._looks[0][0] > _SPEED_OVER_NS:
            self._looks.popleft()

    def mean(self) -> float:
        """Share [1] of real time since the first look; 1 before there are two."""
        return _rate(self._first, self._looks[-1]) if self._first else 1.0

    def newest(self) -> float:
        """The same over the newest seconds."""
        return _rate(self._looks[0], self._looks[-1]) if self._looks else 1.0

    def words(self, waited_s: Mapping[str, float]) -> str:
        """State that time ran slower than real time since the computer is too slow; empty where it is not.

        Args:
            waited_s: Service -> real time [s] for which it has waited lest inputs or cycles of that one come late.
        """
        mean = self.mean()
        if mean >= _REAL_TIME:
            return ""
        longest = sorted(((s, name) for name, s in waited_s.items() if s >= 0.5), reverse=True)[:_NAMED]
        if mean >= _TOO_SLOW and not longest:
            return ""
        waits = f", held for inputs or cycles of {', '.join(f'{name} ({s:.0f} s)' for s, name in longest)}" if longest else ""
        return f"simulated time ran at {mean:.2f} of real time{waits}: this computer is too slow"


def _rate(a: tuple[int, int], b: tuple[int, int]) -> float:
    return (b[1] - a[1]) / (b[0] - a[0]) if b[0] > a[0] else 1.0


@contextlib.contextmanager
def _shared_time(rows: Sequence[Process]) -> Iterator[SimulatedTime]:
    """A simulated time that this process and the ones it starts go by."""
    with tempfile.TemporaryDirectory(prefix="sextant-") as folder:
        path = Path(folder) / "simulated_time"
        names = [SERVO_BUS, *(p.name for p in rows if p.side != "simulation")]
        simulated_time = SimulatedTime.create(path, names)
        with going_by(simulated_time):
            yield simulated_time


def _sink(path: Path, said: Mapping[str, str], profile: RobotProfile) -> Sink:
    """A recorder; what its file cannot hold ends the recording, not the run."""
    try:
        return Recorder(path, said, Foxglove(profile))
    except WriteError as error:
        return Unwritable(path, error)


class ServiceLog:
    """Writes the lines that services print into a file, from any thread; lines that cannot be written are dropped."""

    def __init__(self, path: Path):
        self.problem = ""  # why lines are missing, in a sentence
        self._path, self._lock = path, threading.Lock()
        self._file: FileIO | None = None
        try:
            self._file = path.open("wb", buffering=0)
        except OSError as error:
            self._fail(error)

    def hear(self, _name: str, line: str) -> None:
        """Write a line of a service."""
        with self._lock:
            if self._file is not None:
                try:
                    self._file.write(f"{line}\n".encode())
                except OSError as error:
                    self._fail(error)

    def close(self) -> None:
        """Close the file; lines that come later are dropped."""
        with self._lock:
            if self._file is not None:
                self._file.close()
                self._file = None

    def _fail(self, error: OSError) -> None:
        self.problem = str(WriteError(self._path, error))
        if self._file is not None:
            self._file.close()
            self._file = None


def _heard(doing: Mapping[str, str]) -> str:
    return "; ".join(f"{name}: {what}" for name, what in doing.items()) or "nobody"


def _loss(dropped: int) -> str:
    return f"the recording lacks {dropped} messages: the disk was too slow" if dropped else ""
