"""Load test of this computer: a walking robot from depth frame to actuator cycle.

The real services run in lockstep with a simulated robot, as fast as the computer allows. Each stage is timed at the current
load.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace

import numpy as np

from sextant.shared.runtime.service import Stages

SECONDS = 2.0  # [s] of real time for which the stages are timed
_WALKS_AFTER_NS = (
    8_000_000_000  # [ns] of simulated time in which the robot stands up, maps the ground and takes its first steps
)
_LONGEST_NS = 20_000_000_000  # [ns] most simulated time that is timed: the course is no longer
_LOOK_NS = 100_000_000  # [ns] of simulated time between two checks of the clock
# Service -> its task, and its time limit [ms] at real time.
STAGES: Mapping[str, tuple[str, float]] = {
    "perception": ("frame to pose and scan", 1e3 / 15.0),
    "mapper": ("scan to map", 1e3 / 15.0),
    "planner": ("map to plan", 1e3 / 25.0),
    "actuator": ("actuator cycle", 1e3 / 50.0),
    "simulator": ("simulation", 40.0),  # beyond that its servos stop responding
}


@dataclass(frozen=True, slots=True)
class StageLoad:
    """Computing time of one stage."""

    service: str
    usual_ms: float  # [ms] median of its steps
    takes_ms: float  # [ms] 99th percentile of its steps
    within_ms: float  # [ms] time limit at real time
    cores: float  # [1] cores that it needs at real time

    @property
    def words(self) -> str:
        """Needed and available time as text."""
        return f"{STAGES[self.service][0]} takes {self.usual_ms:.1f} (p99 {self.takes_ms:.1f}) of {self.within_ms:.0f} ms"


class AllDurations(Stages):
    """Stages that keep every duration [ms]."""

    def __init__(self) -> None:
        super().__init__()
        self.durations: dict[str, list[float]] = {}

    def add(self, name: str, duration_ms: float) -> None:
        """Store one duration [ms] of a stage."""
        self.durations.setdefault(name, []).append(duration_ms)


def rehearse(
    robot: str = "phantomx_mk2", seconds: float = SECONDS, machine: Callable[[], float] = time.monotonic
) -> list[StageLoad]:
    """Walk on level ground and time each stage.

    Args:
        robot: Profile by name, or path of a TOML file.
        seconds: [s] of real time for which the walk is timed.
        machine: [s] real time.
    """
    from sextant.evaluation.lockstep.lockstep_run import LockstepRun
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.scenario.loading import load_scenario

    profile = load_profile(robot)
    run = LockstepRun(replace(load_scenario("flat"), robot=robot), 0, profile)
    run.run(_WALKS_AFTER_NS)
    timed = {name: AllDurations() for name in STAGES}
    for name, stages in timed.items():
        run.service(name).stages = stages
    until_s, begun_ns = machine() + seconds, run.now_ns()
    while machine() < until_s and run.now_ns() - begun_ns < _LONGEST_NS:
        run.run(run.now_ns() + _LOOK_NS)
    return loads({name: stages.durations.get(name, []) for name, stages in timed.items()}, (run.now_ns() - begun_ns) * 1e-9)


def loads(durations: Mapping[str, list[float]], simulated_s: float) -> list[StageLoad]:
    """Compute the load of each stage.

    Args:
        durations: Service -> time [ms] of each of its steps.
        simulated_s: [s] in which they ran.
    """
    return [
        StageLoad(name, float(usual), float(slowest), STAGES[name][1], 1e-3 * sum(times) / simulated_s)
        for name, times in durations.items()
        if times
        for usual, slowest in [np.percentile(times, (50.0, 99.0))]
    ]


@contextmanager
def bench_actuator(robot: str) -> Iterator[Callable[[], None]]:
    """Yield the cycle of a real actuator on the emulated servo buses, or the emulated pulse board, of a robot.

    The robot is on a stand, and is ordered to stand up.
    """
    from sextant.services.actuator.config import Settings
    from sextant.services.actuator.service import Actuator
    from sextant.services.actuator.servo_bus.servo_interface import port_openers
    from sextant.services.simulator.servo_bus.bench_emulator import make_bench
    from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.runtime.clock import now_ns
    from sextant.shared.runtime.service import ServiceRunner
    from sextant.shared.wire import codec, topics
    from sextant.shared.wire.messages import ModeCommand

    profile = load_profile(robot)
    with ExitStack() as stack:
        ports = []
        for k, bus in enumerate(profile.servos.buses):
            server = stack.enter_context(TcpBusServer(make_bench(profile, np.random.default_rng(0), bus=k)))
            ports.append(f"{bus.name}={server.url}" if bus.name else server.url)
        settings = Settings(port=", ".join(ports))
        actuator = stack.enter_context(Actuator(profile, settings, port_openers(profile, settings), now_ns))
        worker = ServiceRunner(actuator, lambda *_: None, now_ns)
        order = ModeCommand(now_ns(), "stand", now_ns(), holder="doctor")
        worker.inbox.receive(topics.MODE, codec.encode(order), now_ns())
        yield worker.tick
