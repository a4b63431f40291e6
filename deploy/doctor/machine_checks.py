"""Checks that this machine meets the requirements of the services, with advice."""

import importlib
import json
import os
import shutil
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path

from sextant.deploy.doctor import rehearsal, servo_checks
from sextant.deploy.doctor.check import Check, Level
from sextant.shared.files.config import ConfigError
from sextant.shared.runtime.operating_system import usable_cores

_ROLES: dict[str, tuple[str, ...]] = {  # extras of pyproject.toml -> the modules they install
    "core": ("msgpack", "numpy", "zenoh", "zstandard"),
    "actuator": ("serial",),
    "perception": ("cv2", *(("kiss_icp",) if sys.version_info < (3, 14) else ()), "numba"),  # it has no wheel for 3.14
    "mapper": ("cv2", "numba"),
    "simulator": ("cv2", "mujoco", "numba"),
    "recording": ("cv2", "matplotlib", "mcap", "foxglove_schemas_protobuf"),
}
_PYTHON = (3, 11)
_CORES = 2
_DISK_WARN, _DISK_FAIL = 2 << 30, 200 << 20  # [bytes]
_ROUND_TRIPS = 50
_CYCLE_HZ, _CYCLES, _MISSED_MS = 50.0, 100, 25.0  # of the actuator
_FULL = 0.75  # [1] share of the cores that a walk may use; other programs and Zenoh need the rest
_SLOW_MS = 5.0  # a loopback round trip normally takes well under a millisecond


def examine(port: str | None = None, robot: str = "phantomx_mk2", camera: str = "", *, bridge: bool = False) -> list[Check]:
    """Run all checks.

    The servo port is checked only if one is given; with `bridge` a microcontroller is at it. The camera is `camera`, or that of
    the robot's profile.
    """
    checks = [python(), *wheels(), zenoh_round_trip(), numba_cache(), cores(), cycle(robot), chain(robot), disk(Path())]
    checks += [depth_camera(robot, camera), *inertial_sensor(robot)]
    return [*checks, *servo_checks.examine(port, robot, bridge=bridge)]


def python(version: tuple[int, int] | None = None) -> Check:
    """Check the version of the Python interpreter."""
    found = version or (sys.version_info.major, sys.version_info.minor)
    words = f"Python {found[0]}.{found[1]}, {sys.executable}"
    if found < _PYTHON:
        return Check(
            "python", Level.FAIL, words, f"install Python {_PYTHON[0]}.{_PYTHON[1]} or newer and create the environment again"
        )
    return Check("python", Level.OK, words)


def wheels() -> Iterator[Check]:
    """Check that the libraries of each role can be imported."""
    problems: dict[str, str] = {}
    for module in sorted({module for modules in _ROLES.values() for module in modules}):
        try:
            importlib.import_module(module)
        except (ImportError, OSError) as error:  # OSError: a wheel whose shared library does not load
            problems[module] = str(error).split("\n")[0]
    for role, modules in _ROLES.items():
        missing = [f"{module} ({problems[module]})" for module in modules if module in problems]
        if missing:
            extra = "." if role == "core" else f".[{role}]"
            level = Level.FAIL if role == "core" else Level.WARN
            yield Check(
                f"libraries: {role}",
                level,
                f"cannot import {', '.join(missing)}",
                f"pip install -e '{extra}' to run this role here",
            )
        else:
            yield Check(f"libraries: {role}", Level.OK, ", ".join(modules))


def zenoh_round_trip() -> Check:
    """Check that frames pass through a local router and back, and measure how fast."""
    from sextant.deploy.launch.launcher import host_router
    from sextant.shared.runtime.service import AnyTopic
    from sextant.shared.wire import topics
    from sextant.shared.wire.ports import NoFreePortError
    from sextant.shared.wire.transport import TransportError, ZenohLink

    name = "zenoh on loopback"
    back = threading.Semaphore(0)
    times_ms: list[float] = []
    try:
        with host_router() as endpoints, ZenohLink(endpoints) as near, ZenohLink(endpoints) as far:

            def echo(_: AnyTopic, frame: bytes) -> None:
                far.send(topics.VELOCITY, frame)

            far.subscribe(topics.MODE, echo)
            near.subscribe(topics.VELOCITY, lambda _topic, _frame: back.release())
            for turn in range(_ROUND_TRIPS):
                began = time.perf_counter()
                near.send(topics.MODE, b"round trip")
                if back.acquire(timeout=1.0 if turn else 0.2):
                    times_ms.append((time.perf_counter() - began) * 1e3)
    except (TransportError, NoFreePortError) as error:
        return Check(name, Level.FAIL, str(error), "check that 127.0.0.1 is up and no firewall blocks its ports")
    if len(times_ms) < _ROUND_TRIPS // 2:
        found = f"{len(times_ms)} of {_ROUND_TRIPS} round trips completed"
        return Check(name, Level.FAIL, found, "check that 127.0.0.1 is up and no firewall blocks its ports")
    median = statistics.median(times_ms)
    if median > _SLOW_MS:
        return Check(name, Level.WARN, f"round trip {median:.1f} ms", "the machine is busy; close other programs first")
    return Check(name, Level.OK, f"round trip {median:.2f} ms")


def numba_cache() -> Check:
    """Check that compiled loops can be cached.

    Without a cache every start compiles for a minute.
    """
    from sextant import shared

    name = "cache of compiled loops"
    places = [Path(os.environ["NUMBA_CACHE_DIR"])] if os.environ.get("NUMBA_CACHE_DIR") else []
    places += [Path(shared.__file__).parent.parent / "services", Path.home() / ".cache"]
    for place in places:
        if place.is_dir() and _writable(place):
            return Check(name, Level.OK, f"writable: {place}")
    return Check(
        name,
        Level.WARN,
        f"not writable: {', '.join(map(str, places))}",
        "set NUMBA_CACHE_DIR to a writable folder; without it every start compiles for a minute",
    )


def cores(count: int | None = None) -> Check:
    """Check the number of cores that this process may use."""
    found = usable_cores() if count is None else count
    if found < _CORES:
        advice = "`sextant run --lockstep` needs one core; walking in real time needs two"
        return Check("cores", Level.WARN, f"{found} usable", advice)
    return Check("cores", Level.OK, f"{found} usable")


def cycle(
    robot: str = "phantomx_mk2",
    clock: Callable[[], int] = time.monotonic_ns,
    wait: Callable[[float], object] = time.sleep,
    actuator: Callable[[str], AbstractContextManager[Callable[[], object]]] = rehearsal.bench_actuator,
) -> Check:
    """Check that this machine keeps the control period at its current load.

    The actuator runs on the emulated servos of the robot.
    """
    from sextant.shared.runtime.process_priority import go_first
    from sextant.shared.runtime.service import Every
    from sextant.shared.runtime.zenoh_runner import Beats

    def beat() -> tuple[str, list[float], list[float]]:
        refused, every, work = go_first(), list[float](), list[float]()
        with actuator(robot) as tick:
            beats = Beats(Every.hz(_CYCLE_HZ), clock)
            for _ in range(_CYCLES):
                every.append(1e-6 * beats.next(wait))
                began_ns = clock()
                tick()
                work.append(1e-6 * (clock() - began_ns))
        return refused, sorted(every), sorted(work)

    name = "control cycle"
    try:
        with ThreadPoolExecutor(1) as apart:  # a separate thread, because priority is set per thread
            refused, every, work = apart.submit(beat).result()
    except ImportError as error:
        return Check(name, Level.WARN, f"not timed: {error}", "for emulated servos: pip install -e '.[simulator]'")
    except (ValueError, OSError) as error:
        return _untimed(name, error)
    p50, p99 = round(0.50 * (_CYCLES - 1)), round(0.99 * (_CYCLES - 1))
    missed = sum(ms > _MISSED_MS for ms in every)
    words = f"takes {work[p50]:.1f} (p99 {work[p99]:.1f}) of {1e3 / _CYCLE_HZ:g} ms, including emulated servos; period "
    words += f"{every[p50]:.1f} ms (p50), {every[p99]:.1f} (p99), {every[-1]:.1f} (max)"
    words += f"; {missed} of {_CYCLES} periods above {_MISSED_MS:g}" + (", without real-time priority" if refused else "")
    if every[p99] <= _MISSED_MS:
        return Check(name, Level.OK, words)
    return Check(name, Level.WARN, words, refused or "close other programs, those with real-time priority first")


def chain(robot: str, rehearse: Callable[[str], list[rehearsal.StageLoad]] = rehearsal.rehearse) -> Check:
    """Check that this machine keeps up with a walk of a robot at its current load.

    The check covers all stages from the depth frame to the actuator's cycle.
    """
    name = "walking"
    try:
        stages = rehearse(robot)
    except ImportError as error:
        return Check(
            name, Level.WARN, f"not timed: {error}", "for the timed services: pip install -e '.[simulator,perception,mapper]'"
        )
    except (ValueError, OSError) as error:
        return _untimed(name, error)
    cores_needed, usable = sum(stage.cores for stage in stages), usable_cores()
    words = f"{', '.join(stage.words for stage in stages)}; together {cores_needed:.1f} of {usable} cores"
    # This process lacks the actuator's priority, so `cycle` checks the actuator's cycle separately.
    slow = [stage for stage in stages if stage.takes_ms > stage.within_ms and stage.service != "actuator"]
    late = [rehearsal.STAGES[stage.service][0] for stage in slow]
    if not late and cores_needed <= _FULL * usable:
        return Check(name, Level.OK, words)
    what = f" ({', '.join(late)})" if late else ""
    advice = f"at its present load this computer is too slow to walk in real time{what}; use --lockstep or close programs"
    return Check(name, Level.WARN, words, advice)


def _untimed(name: str, error: Exception) -> Check:
    return Check(name, Level.WARN, f"not timed: {error}", "correct the profile, or give another with --robot")


def disk(folder: Path, free: int | None = None) -> Check:
    """Check the disk space for recordings."""
    found = shutil.disk_usage(folder).free if free is None else free
    words = f"{found / (1 << 30):.1f} GiB free in {folder.resolve()}"
    advice = "free some space, or record to another disk with --out"
    level = Level.FAIL if found < _DISK_FAIL else Level.WARN if found < _DISK_WARN else Level.OK
    return Check("disk", level, words, "" if level is Level.OK else advice)


def depth_camera(robot: str, device: str = "") -> Check:
    """Check that the robot's depth camera, or `device`, is connected.

    A missing camera is an error for `device` and a warning for the robot's.
    """
    level = Level.FAIL if device else Level.WARN
    try:
        from sextant.services.perception.cameras.camera import CameraError
        from sextant.services.perception.cameras.devices import find
        from sextant.shared.robot.profiles import load_profile
    except ImportError as error:
        return Check("camera", level, str(error), "pip install -e '.[perception]'")
    try:
        profile = load_profile(robot)
    except ConfigError as error:
        return Check("camera", Level.FAIL, str(error), "correct the profile, or give another with --robot")
    device = device or profile.camera.device
    if device == "none":
        return Check("camera", Level.OK, f"the profile {robot} has none")
    try:
        found = find(device, profile)
    except CameraError as error:
        return Check("camera", level, error.cause, error.remedy)
    if not found:
        advice = "to walk with a camera, plug it in and check again; simulation and replay need none"
        return Check("camera", level, f"no {device} device found", advice)
    return Check("camera", Level.OK, f"{device}: {', '.join(found)}")


def inertial_sensor(robot: str) -> list[Check]:
    """Check library and port of the robot's IMU, if it has one besides the camera's."""
    try:
        from sextant.services.perception.imu.bno import MODELS, check_port
        from sextant.services.perception.imu.reading import ImuError
        from sextant.shared.robot.profiles import load_profile

        imu = load_profile(robot).imu
    except (ImportError, ConfigError):
        return []  # which the check of the camera reports
    if imu.device not in MODELS:
        return []
    try:
        return [Check("imu", Level.OK, check_port(imu))]
    except ImuError as error:
        return [Check("imu", Level.WARN, error.cause, error.remedy)]


def in_words(checks: list[Check]) -> str:
    """Format the checks as text: one line per check, and below it the advice."""
    lines = []
    for check in checks:
        lines.append(f"{check.level:<4}  {check.name}: {check.found}")
        if check.advice:
            lines.append(f"      -> {check.advice}")
    return "\n".join(lines)


def to_json(checks: list[Check]) -> str:
    """Format the checks as a JSON list."""
    return json.dumps([asdict(check) for check in checks], indent=1)


def _writable(folder: Path) -> bool:
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
