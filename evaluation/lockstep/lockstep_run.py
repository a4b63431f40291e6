"""Lockstep run: all services in one process on simulated time, at full speed.

The messages are those of a live run. Depth frames that no service uses are not rendered where that changes nothing.
"""

import contextlib
import logging
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

from sextant.evaluation import params
from sextant.evaluation.lockstep.pose_error import MODELS, NoisyPerception
from sextant.evaluation.lockstep.simulated_radio import Radio
from sextant.evaluation.observers.progress import Progress, Silent
from sextant.evaluation.observers.run_observers import RECORDING, RunObservers, about, clear
from sextant.evaluation.report import Report
from sextant.services.actuator.config import Settings as ActuatorSettings
from sextant.services.actuator.estop.config import Settings as StopSettings
from sextant.services.actuator.estop.service import EmergencyStop
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.actuator.safety.walk_authorization import WalkAuthorization
from sextant.services.actuator.service import Actuator
from sextant.services.actuator.servo_bus.servo_interface import read_timeout_ns
from sextant.services.mapper.config import Settings as MapperSettings
from sextant.services.mapper.service import Mapper
from sextant.services.perception.config import Settings as PerceptionSettings
from sextant.services.perception.service import Perception
from sextant.services.planner import warmup
from sextant.services.planner.config import Settings as PlannerSettings
from sextant.services.planner.service import Planner
from sextant.services.simulator.config import Settings as SimulatorSettings
from sextant.services.simulator.service import Simulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.shared.errors import SextantError
from sextant.shared.files import whole_files
from sextant.shared.files.config import ConfigError
from sextant.shared.files.whole_files import WriteError
from sextant.shared.recording.foxglove.translation import Foxglove
from sextant.shared.recording.writer import Recorder
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lockstep import HandOver, Lockstep, Outage, ServiceFailedError
from sextant.shared.runtime.process_priority import keep_memory, spare_collector
from sextant.shared.runtime.service import AnyTopic, Service
from sextant.shared.runtime.stopwatch import stopwatch_ns
from sextant.shared.scenario.scenario import Fault, Scenario
from sextant.shared.wire.messages import Message

CRASH = "crash.txt"  # in a run's folder: the traceback of a service that failed
_LOOK_NS = 250_000_000  # simulated time between two checks whether the run is over

_log = logging.getLogger(__name__)

Tap = Callable[[AnyTopic, bytes, int], object]


@cache
def _rehearse_passage(robot: str) -> bool:
    """Compile the search of gap crossings, so that no planning time includes compilation."""
    warmup.compile_functions(load_profile(robot), PlannerSettings())
    return True


class LockstepRun:
    """The services of a run on simulated time, with its observers."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        profile: RobotProfile,
        tap: Tap = lambda _topic, _frame, _at_ns: None,
        guests: Sequence[Service] = (),
        every_frame: bool = True,
        around: Mapping[str, Callable[[Service], Service]] | None = None,
        stop_port: str = "",
        port: type[MemoryPort] = MemoryPort,
        hand_over: HandOver | None = None,
    ):
        """Assemble all services in this process; the actuator's port is the other end of the simulator's servo bus.

        Args:
            scenario: The course and how to walk it.
            seed: Random seed of the run.
            profile: The robot.
            tap: Receives every frame as it is sent, with the simulated time [ns].
            guests: Further services that take part.
            every_frame: Also render the depth frames that only the tap receives; this costs a tenth of the run.
            around: Service name -> function that wraps the service.
            stop_port: Run the estop process, with the latch of this port; empty: without.
            port: Class of the actuator's end of the bus.
            hand_over: Takes the place of the codec.
        """
        keep_memory()
        if scenario.goal.passage:
            _rehearse_passage(scenario.robot)
        self.scenario = scenario
        self.attendance = RunObservers(profile, scenario, seed)
        tuned = params.of_scenario(scenario)
        self._lockstep: Lockstep | None = None
        self._socket: _Socket | None = None
        self._port = port
        looks = params.settings(
            PerceptionSettings,
            tuned.perception,
            method=scenario.variation.registration,
            registration=scenario.plugins.registration,
            scan_resolution=scenario.map.scan_resolution,
        )
        frames_per_picture = 1
        # Colour needs every frame, and the effect of a fault depends on the frame that it hits.
        if not (every_frame or guests or scenario.faults or profile.camera.color):
            rate_hz = profile.camera.sensor.rate_hz
            frames_per_picture = looks.frames_per_scan(rate_hz)
            looks = replace(looks, scan_rate_hz=rate_hz)  # it uses every rendered frame
        simulator = Simulator(
            profile, SimulatorSettings(seed=seed, bridge=scenario.bridge, frames_per_picture=frames_per_picture), scenario
        )
        makers: dict[str, Callable[[], Service]] = {
            "simulator": lambda: simulator,
            "actuator": self._actuator(profile, scenario, simulator, Latch.of_port(stop_port) if stop_port else None),
            "perception": lambda: _perception(profile, looks, scenario, seed),
            "mapper": lambda: Mapper(profile, _map_settings(scenario, tuned)),
            "planner": lambda: Planner(profile, _planner_settings(scenario, tuned), lambda: _rehearse_passage(scenario.robot)),
        }
        makers = {name: _explained(name, make) for name, make in makers.items()}
        if stop_port:
            makers["stop"] = lambda: EmergencyStop(profile, StopSettings(stop_port))
        for name, service in [*self.attendance.services().items(), *((guest.name, guest) for guest in guests)]:
            makers[name] = lambda service=service: service  # type: ignore[misc]
        for name, wrap in (around or {}).items():
            makers[name] = lambda make=makers[name], wrap=wrap: wrap(make())  # type: ignore[misc]
        spare_collector()
        radio = Radio(scenario.link, seed) if scenario.link.exists else None
        outages = [_outage(fault) for fault in scenario.faults_at(seed) if not fault.of_camera]
        busy_until = {"actuator": self._busy_until}
        self._lockstep = Lockstep(makers, tap, outages=outages, busy_until=busy_until, radio=radio, hand_over=hand_over)

    def now_ns(self) -> int:
        """Return the simulated time [ns]."""
        return 0 if self._lockstep is None else self._lockstep.now_ns

    def run(self, until_ns: int) -> None:
        """Advance simulated time up to and including an instant [ns]."""
        assert self._lockstep is not None
        self._lockstep.run(until_ns)

    def service(self, name: str) -> Service:
        """Return the object that currently runs under a name."""
        assert self._lockstep is not None
        return self._lockstep.service(name)

    def _actuator(
        self, profile: RobotProfile, scenario: Scenario, simulator: Simulator, latch: Latch | None
    ) -> Callable[[], Actuator]:
        tuned = params.of_scenario(scenario).actuator
        settings = params.settings(ActuatorSettings, tuned, arc=scenario.walk.arc, bridge=scenario.bridge)
        authorization = WalkAuthorization()

        def make() -> Actuator:
            self._socket = socket = _Socket(simulator, self.now_ns, read_timeout_ns(settings) * 1e-9, self._port)
            return Actuator(profile, settings, socket.openers, socket.now_ns, latch, authorization)

        return make

    def _busy_until(self) -> int:
        """Return until when [ns] the actuator waits for its bus.

        The wait for the first port is over before time begins.
        """
        return 0 if self._socket is None or self._socket.is_first else self._socket.now_ns()

    def lose(self, outage: Outage) -> None:
        """Add an outage of a service to those of the scenario."""
        assert self._lockstep is not None
        self._lockstep.lose(outage)

    def say(self, message: Message, topic: AnyTopic | None = None) -> None:
        """Send a message now that is from none of the services.

        `topic` is given if the message's role is another than the robot.
        """
        assert self._lockstep is not None
        self._lockstep.say(message, topic)


def run_lockstep(
    scenario: Scenario,
    seed: int,
    out: Path | None = None,
    progress: Progress | None = None,
    taps: Sequence[Tap] = (),
) -> Report:
    """Run a scenario in lockstep to its end.

    Args:
        scenario: The course and how to walk it.
        seed: Random seed of the run; a seed gives the same report each time, except for its timing fields.
        out: Folder for report.json, pictures and recording.mcap; None writes nothing.
        progress: Display of the progress.
        taps: Each receives every frame as it is sent, with the simulated time [ns].
    """
    progress = progress or Silent()
    profile = load_profile(scenario.robot)

    def warn(problem: str) -> None:
        progress.say(f"warning: {problem}")

    with contextlib.ExitStack() as stack:
        # 1. Assemble the services, and a recorder of all messages.
        hear = list(taps)
        recorder: Recorder | None = None
        hand_over = HandOver(
            lambda topic, at_ns: bool(taps) or (recorder is not None and bool(hear) and recorder.takes(topic, at_ns))
        )
        if out is not None:
            clear(out)
            translator = Foxglove(profile, hand_over.decode)
            recorder = stack.enter_context(_recorder(out / RECORDING, about(scenario, seed, "lockstep"), translator, warn))
            hear += [] if recorder is None else [recorder.write]

        def tell(topic: AnyTopic, frame: bytes, at_ns: int) -> None:
            for hears in tuple(hear):
                try:
                    hears(topic, frame, at_ns)
                except WriteError as error:  # ends the recording, not the walk
                    hear.remove(hears)
                    warn(f"a recording ended early: {error}")

        run = LockstepRun(scenario, seed, profile, tell, every_frame=bool(taps), hand_over=hand_over)
        # 2. Advance simulated time until the run is over.
        began_ns = stopwatch_ns()
        ended_by = _run_to_the_end(run, progress, out)
        elapsed = (stopwatch_ns() - began_ns) * 1e-9
    # 3. Evaluate the run and write its files.
    report = run.attendance.judge(run.now_ns() * 1e-9 / elapsed, ended_by)
    if out is not None:
        for problem in run.attendance.leave_behind(report, out):
            warn(problem)
    progress.finish()
    return report


@contextlib.contextmanager
def _recorder(
    path: Path, said: Mapping[str, str], translator: Foxglove, warn: Callable[[str], None]
) -> Iterator[Recorder | None]:
    """Yield a recorder, or None if its file cannot be written.

    A write error at its end only gives a warning.
    """
    try:
        recorder = Recorder(path, said, translator)
    except WriteError as error:
        warn(str(error))
        yield None
        return
    try:
        yield recorder
    finally:
        try:
            recorder.close()
        except WriteError as error:
            warn(f"a recording ended early: {error}")


def _run_to_the_end(run: LockstepRun, progress: Progress, out: Path | None) -> str:
    """Run to the end; return what ended it other than the scorer, or nothing.

    An exception in a service ends this run, as a crash of its process would end a live one. The traceback goes to the run's
    folder, and to the log unless the exception says all.
    """
    # The scorer ends the run at the time limit. Twice that limit covers a robot that never came up.
    limit_ns = round(2e9 * run.scenario.time_limit_s)
    while not run.attendance.over():
        if run.now_ns() >= limit_ns:
            return f"no verdict within {limit_ns * 1e-9:.0f} s of simulated time"
        try:
            run.run(run.now_ns() + _LOOK_NS)
        except ServiceFailedError as error:
            text = "".join(traceback.format_exception(error.__cause__))
            _log.error("%s%s", error, "" if isinstance(error.__cause__, SextantError) else f"\n{text}")
            if out is not None:
                with contextlib.suppress(WriteError):  # in the log already
                    whole_files.write_text(out / CRASH, text)
            return str(error)
        progress.update(run.attendance.monitor.view)
    return ""


def _explained(name: str, make: Callable[[], Service]) -> Callable[[], Service]:
    """Return a maker of a service that reports settings which do not fit each other or the robot."""

    def maker() -> Service:
        try:
            return make()
        except ValueError as error:
            raise ConfigError(f"settings of the {name}", [str(error)]) from error

    return maker


def _perception(profile: RobotProfile, settings: PerceptionSettings, scenario: Scenario, seed: int) -> Service:
    perception = Perception(profile, settings)
    return perception if scenario.pose_error == "none" else NoisyPerception(perception, MODELS[scenario.pose_error], seed)


def _planner_settings(scenario: Scenario, tuned: params.SystemParams) -> PlannerSettings:
    walk = scenario.walk
    return params.settings(
        PlannerSettings,
        tuned.planner,
        blind=walk.blind,
        footholds=walk.footholds,
        step_planner=scenario.plugins.planner,
    )


def _map_settings(scenario: Scenario, tuned: params.SystemParams) -> MapperSettings:
    size = scenario.map
    return params.settings(
        MapperSettings,
        tuned.mapper,
        cells=size.cells,
        cells_y=size.cells_y,
        resolution=size.resolution,
        foothold_rule=scenario.plugins.foothold,
    )


class _Socket:
    """Opens the emulated buses for the actuator, also after a disconnection.

    All of its ports share one clock.
    """

    def __init__(self, simulator: Simulator, clock: Callable[[], int], timeout: float, kind: type[MemoryPort]):
        self._clock, self._timeout, self._kind = clock, timeout, kind
        self._devices = dict(zip(simulator.bus_names, (simulator.device, *simulator.buses[1:]), strict=True))
        self._ports: dict[str, MemoryPort] = {}
        self.is_first = clock() == 0  # whether no port was opened before this one

    @property
    def openers(self) -> dict[str, Callable[[], MemoryPort]]:
        """Open the port of each bus, by its name."""
        return {name: partial(self._open, name) for name in self._devices}

    def now_ns(self) -> int:
        now_ns = self._clock()
        for port in self._ports.values():
            now_ns = max(now_ns, port.last_ns)
        return now_ns

    def _open(self, name: str) -> MemoryPort:
        self.is_first &= name not in self._ports
        clock = self._clock if len(self._devices) == 1 else self.now_ns
        self._ports[name] = self._kind(self._devices[name], clock, self._timeout, start_ns=self.now_ns())
        return self._ports[name]


def _outage(fault: Fault) -> Outage:
    return Outage(fault.service, round(fault.at_s * 1e9), round((fault.at_s + fault.for_s) * 1e9), fault.kind == "kill")
