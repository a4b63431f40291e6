"""Live run over Zenoh in real time: services as processes, observers here."""

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

from sextant.deploy.launch import process_table
from sextant.deploy.launch.launcher import Launcher, host_router
from sextant.deploy.launch.process_age import process_age_s
from sextant.deploy.launch.process_table import ENVIRONMENT, Command, Process
from sextant.deploy.live.page import Page
from sextant.deploy.terminal.interrupts import Interrupts
from sextant.evaluation.observers.progress import Progress
from sextant.evaluation.observers.run_observers import RECORDING, RunObservers, about, clear
from sextant.evaluation.report import Report
from sextant.shared.files.whole_files import WriteError
from sextant.shared.recording.foxglove.translation import Foxglove
from sextant.shared.recording.live import LiveRecorder, Sink
from sextant.shared.recording.writer import Recorder, Unwritable
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime import warm_up_mark
from sextant.shared.runtime.clock import going_by, now_ns
from sextant.shared.runtime.compile_progress import CompiledFunctions
from sextant.shared.runtime.service import Service
from sextant.shared.runtime.simulated_time import SERVO_BUS, SimulatedTime
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.scenario.scenario import Fault, Scenario
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, ZenohLink

_LOG = "services.log"
_LOOK_S = 0.1  # [s] interval of polling the run
_SHOW_S = 0.25  # [s] interval of showing progress
_START_S = 180.0  # [s] within which the robot must come up
_COMPILING = ("perception", "mapper", "planner")  # services that compile at the first start before they are ready
_STAND_UP_NS = 3_000_000_000  # [ns] that the robot takes to stand up, meanwhile
_SPEED_OVER_NS = 3_000_000_000  # the current speed of simulated time is the mean over this window
_NAMED = 2  # most services that the slow-down message names
_REAL_TIME = 0.95  # [1] share of real time from which simulated time counts as real time
# [1] share of real time. Passing the servo bus's bytes between processes takes time on a fast computer, too: `sextant demo` on
# two idle cores runs at about 0.85. A computer counts as too slow below this, or where simulated time waited for a service.
_TOO_SLOW = 0.75
_WARM_S = 5.0  # [s] the warm-up takes less when everything is compiled already
_WARM_UP = ("-m", "sextant.deploy.launch.warm_up", "--progress")


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a live run."""

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
    page: Page | None = None,
    viewer: bool = False,
) -> Outcome:
    """Run a scenario over Zenoh to its end.

    Write report.json, pictures, recording.mcap and services.log to `out`.

    Args:
        scenario: The course and how to walk it.
        source: Name or path from which the simulator loads the scenario.
        seed: Random seed of the simulator.
        out: Output folder, made if it is missing.
        progress: Display of the progress.
        interrupts: The operator's interrupts; entered by the caller, in the main thread.
        attach: Endpoints of services that already run; None starts them.
        started: Receives the launcher once all processes run, for tests that inject faults.
        slow_down: Let simulated time wait also for services that are late on this computer, not only for the simulator.
        page: Page to serve during the run, of services that this function starts; None serves none.
        viewer: Open MuJoCo's viewer.

    Raises:
        ValueError: `slow_down` with services that already run.
    """
    if attach and slow_down:
        raise ValueError("services started elsewhere use their own time")
    clear(out)
    attendance = RunObservers(load_profile(scenario.robot), scenario, seed, live=True, linked=attach is not None)
    with contextlib.ExitStack() as stack:
        # 1. Host the router and start the services, each in its own process.
        log = stack.enter_context(contextlib.closing(ServiceLog(Path(os.devnull) if attach else out / _LOG)))
        endpoints = attach or stack.enter_context(host_router())
        chosen = replace(process_table.choices(scenario, source, seed, free_port()), viewer=viewer)
        rows = () if attach else process_table.rows("all", simulated=True)
        if page and not attach:
            chosen = replace(chosen, console_port=page.port)
            rows = process_table.rearranged(rows, ["console"], [], "all")
        simulated_time = None if attach else stack.enter_context(_shared_time(rows, slow_down))
        time_file = simulated_time.path if simulated_time else None
        # 2. Record, command, score and monitor from this process, each over its own link. They connect before the services
        # start, so that the recording has every message.
        profile = load_profile(scenario.robot)
        sink = _sink(out / RECORDING, about(scenario, seed, "live"), profile)
        recording = stack.enter_context(_recording(sink, endpoints))
        attendants = stack.enter_context(ObserverThread(attendance.services(), endpoints))
        process_table.new_robot(chosen)
        compiled = CompiledFunctions()

        def hear(name: str, line: str) -> None:
            if not compiled.hear(name, line):
                log.hear(name, line)

        launcher = Launcher(process_table.commands(rows, chosen, endpoints, simulated_time=time_file), hear=hear)
        stack.callback(lambda: launcher.stop(interrupts.insisted))
        launcher.__enter__()
        started(launcher)
        # 3. Watch until the run ends, and inject the scenario's faults.
        speed = Speed()
        faults = Faults(scenario.faults_at(seed))
        show = page.show if page else lambda: None
        ended_by = _watch(attendance, attendants, launcher, faults, progress, interrupts, speed, show, compiled)
        slowed_down = speed.words(simulated_time.waited_s() if simulated_time else {})
        if not slow_down and attendance.monitor.lateness.words:
            slowed_down = ""  # the late inputs say more
        # 4. Stop everything.
        for name in launcher.stop(interrupts.insisted):
            progress.say(f"{name} did not end on request and was killed")
    # 5. Evaluate the run and write its files.
    report = attendance.judge(speed.mean() * attendance.kept_up(), ended_by, interrupts.asked(), slowed_down)
    unwritten = attendance.leave_behind(report, out, picture=not interrupts.asked())
    for problem in filter(None, (recording.problem, _loss(recording.dropped), log.problem, *unwritten)):
        progress.say(f"warning: {problem}")
    progress.finish()
    return Outcome(report, interrupts.asked())


def warm_up(progress: Progress, interrupts: Interrupts, whole: bool = True) -> str:
    """Compile what is compiled at first use, in a separate process, unless all of it is compiled.

    Args:
        progress: Display of the progress.
        interrupts: The operator's interrupts.
        whole: Compile everything. Otherwise the services compile what few walks need: colour when they start, and gap
            crossings while the robot walks.

    Returns:
        The error as text, or an empty string.
    """
    if warm_up_mark.is_complete(whole):
        return ""
    began, found, told = time.monotonic(), CompiledFunctions(), None
    command = Command("warm-up", _WARM_UP if whole else (*_WARM_UP, "--least"), ENVIRONMENT)
    with Launcher([command], hear=found.hear) as launcher:
        while not interrupts.asked():
            ended = launcher.wait(_LOOK_S)
            if ended:
                return "" if ended[0].how == "exit status 0" else str(ended[0])
            if time.monotonic() - began > _WARM_S and found.count() != told:
                told = found.count()
                progress.compiled(*told)
        launcher.stop(interrupts.insisted)
    return ""


class ObserverThread:
    """Services that run in threads of this process, each over its own link.

    A context manager. `check` raises an exception of a service in the caller's thread.
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
        """Raise the first exception of a service."""
        if self._errors:
            raise self._errors[0]

    def _run(self, service: Service) -> None:
        try:
            with ZenohLink(self._endpoints) as link:
                self._ready.release()
                run_live(service, link, self._stop)
        except Exception as error:  # noqa: BLE001 - `check` raises it again, in the watching thread
            self._errors.append(error)
            self._ready.release()


class Faults:
    """Injects a scenario's process faults when due, and continues frozen processes."""

    def __init__(self, faults: tuple[Fault, ...]):
        self._due: list[tuple[float, str, str]] = []  # time [s], act, service
        for fault in faults:
            if fault.of_camera:
                continue  # the simulator injects it
            if fault.kind == "kill":
                self._due.append((fault.at_s, "kill", fault.service))
            else:
                self._due += [(fault.at_s, "freeze", fault.service), (fault.at_s + fault.for_s, "thaw", fault.service)]
        self._due.sort()

    def act(self, time_s: float, launcher: Launcher) -> list[str]:
        """Inject the faults that are due at a time [s]; return a log line for each."""
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
    attendance: RunObservers,
    attendants: ObserverThread,
    launcher: Launcher,
    faults: Faults,
    progress: Progress,
    interrupts: Interrupts,
    speed: "Speed",
    show_page: Callable[[], None],
    compiled: CompiledFunctions,
) -> str:
    """Watch a run; return what ended it from outside, or an empty string."""
    began = shown = time.monotonic()
    walks, count = False, (0, 0)
    while not attendance.over():
        for ended in launcher.wait(_LOOK_S):
            progress.say(str(ended))
            if not ended.restarted:
                return str(ended)
        attendants.check()
        show_page()
        view = attendance.monitor.view
        if view.walks:
            speed.update()
        if view.walks and not walks:
            walks = True
            progress.say(f"first step {process_age_s():.0f} s after the start")
        if interrupts.asked():
            return "stopped by the operator"
        if not view.up and time.monotonic() - began > _START_S:
            return f"the robot did not start within {_START_S:.0f} s; received so far: {_heard(view.doing)}"
        for done in faults.act(view.time_s if view.up else -1.0, launcher):
            progress.say(done)
        if time.monotonic() - shown >= _SHOW_S:
            shown = time.monotonic()
            if not view.up and compiled.count() != count:
                count = compiled.count()
                progress.compiled(*count)
            elif view.up or not count[1]:
                progress.update(replace(view, of_real_time=speed.newest()))
    return ""


class Speed:
    """Speed of the services' time relative to real time."""

    def __init__(self, clock: Callable[[], int] = now_ns, machine: Callable[[], int] = time.monotonic_ns):
        """Initialise without a measurement.

        Args:
            clock: [ns] time of the services.
            machine: [ns] real time.
        """
        self._clock, self._machine = clock, machine
        self._looks: deque[tuple[int, int]] = deque()  # real and shared time [ns]; the first one stays
        self._first: tuple[int, int] | None = None

    def update(self) -> None:
        """Read both clocks."""
        look = self._machine(), self._clock()
        self._first = self._first or look
        self._looks.append(look)
        while look[0] - self._looks[0][0] > _SPEED_OVER_NS:
            self._looks.popleft()

    def mean(self) -> float:
        """Return the mean share [1] of real time; 1 before there are two readings."""
        return _rate(self._first, self._looks[-1]) if self._first else 1.0

    def newest(self) -> float:
        """Return the share [1] of real time over the newest window."""
        return _rate(self._looks[0], self._looks[-1]) if self._looks else 1.0

    def words(self, waited_s: Mapping[str, float]) -> str:
        """Describe how far time ran slower than real time; empty if the computer keeps up.

        Args:
            waited_s: Service -> real time [s] that simulated time waited for its inputs or cycles.
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
def _shared_time(rows: Sequence[Process], slow_down: bool) -> Iterator[SimulatedTime]:
    """Create a simulated time that this process and its children share.

    It waits for late answers of the emulated servos, and is slow until all services are ready. With `slow_down` it also waits
    for services of the rows whose inputs or cycles are late, and the robot stands up while other services compile.
    """
    with tempfile.TemporaryDirectory(prefix="sextant-") as folder:
        path = Path(folder) / "simulated_time"
        names = [SERVO_BUS, *(p.name for p in rows if slow_down and p.side not in ("simulation", "page"))]
        starting = [p.name for p in rows if p.name in _COMPILING]
        before_ready_ns = _STAND_UP_NS if slow_down else 0
        simulated_time = SimulatedTime.create(path, names, starting=starting, before_ready_ns=before_ready_ns)
        with going_by(simulated_time):
            yield simulated_time


def _sink(path: Path, said: Mapping[str, str], profile: RobotProfile) -> Sink:
    """Return a recorder; an unwritable file ends the recording, not the run."""
    try:
        return Recorder(path, said, Foxglove(profile))
    except WriteError as error:
        return Unwritable(path, error)


class ServiceLog:
    """Writes the output lines of services to a file, from any thread.

    Lines that cannot be written are dropped.
    """

    def __init__(self, path: Path):
        self.problem = ""  # why lines are missing, as a sentence
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
        """Close the file; later lines are dropped."""
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
    return "; ".join(f"{name}: {what}" for name, what in doing.items()) or "nothing"


def _loss(dropped: int) -> str:
    return f"the recording lacks {dropped} messages: the disk was too slow" if dropped else ""
