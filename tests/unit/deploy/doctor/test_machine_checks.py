import importlib
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import ModuleType

import pytest

from sextant.deploy.doctor import machine_checks, rehearsal
from sextant.deploy.doctor.check import Check, Level
from sextant.deploy.doctor.rehearsal import StageLoad
from sextant.shared.runtime import process_priority


def test_each_failed_check_gives_advice() -> None:
    for check in (
        machine_checks.python((3, 10)),
        machine_checks.cores(1),
        machine_checks.disk(Path(), 1000),
        machine_checks.disk(Path(), 1 << 30),
    ):
        assert check.level is not Level.OK
        assert check.advice
    for check in (machine_checks.python((3, 11)), machine_checks.cores(2), machine_checks.disk(Path(), 1 << 40)):
        assert check.level is Level.OK
        assert not check.advice


def test_low_disk_space_warns_and_full_disk_fails() -> None:
    assert machine_checks.disk(Path(), 1 << 30).level is Level.WARN
    assert machine_checks.disk(Path(), 1 << 20).level is Level.FAIL


def test_zenoh_round_trip_through_local_router() -> None:
    check = machine_checks.zenoh_round_trip()
    assert check.level is not Level.FAIL, check.found


def cycle_check(late_ms: Callable[[int], float], work_ms: float = 9.0) -> Check:
    """Return the check of a cycle with late waits and a fixed time of work.

    The kth wait is late by `late_ms(k)`.
    """
    now, waits = 0, 0

    def work() -> None:
        nonlocal now
        now += round(1e6 * work_ms)

    def wait(seconds: float) -> None:
        nonlocal now, waits
        now += round(1e9 * seconds + 1e6 * late_ms(waits))
        waits += 1

    @contextmanager
    def actuator(_robot: str) -> Iterator[Callable[[], None]]:
        yield work

    return machine_checks.cycle("phantomx_mk2", lambda: now, wait, actuator)


@pytest.fixture(params=["", "real-time priority is refused; allow it"])
def priority_error(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(process_priority, "go_first", lambda: request.param)
    return str(request.param)


def test_regular_cycle_passes(priority_error: str) -> None:
    check = cycle_check(lambda _: 0.0)
    assert (check.level, check.advice) == (Level.OK, "")
    without = ", without real-time priority" if priority_error else ""
    assert check.found == (
        "takes 9.0 (p99 9.0) of 20 ms, including emulated servos; period 20.0 ms (p50), 20.0 (p99), 20.0 (max); "
        f"0 of 100 periods above 25{without}"
    )


def test_late_cycles_are_reported_and_frequent_ones_warn(priority_error: str) -> None:
    once = cycle_check(lambda k: 9.0 if k == 50 else 0.0)
    assert once.level is Level.OK
    assert "20.0 ms (p50), 20.0 (p99), 29.0 (max); 1 of 100 periods above 25" in once.found
    often = cycle_check(lambda k: 9.0 if k % 20 == 0 else 0.0)
    assert often.level is Level.WARN
    assert "20.0 ms (p50), 29.0 (p99), 29.0 (max); 5 of 100 periods above 25" in often.found
    assert often.advice == (priority_error or "close other programs, those with real-time priority first")


@pytest.mark.slow
def test_bench_actuator_cycle_runs_on_emulated_bus() -> None:
    with rehearsal.bench_actuator("phantomx_mk2") as tick:
        for _ in range(3):
            tick()


@pytest.mark.parametrize(("broken", "advice"), [(ImportError("no mujoco"), "pip install"), (ValueError("no robot"), "--robot")])
def test_cycle_check_reports_cause_if_not_timed(broken: Exception, advice: str) -> None:
    def actuator(_robot: str) -> AbstractContextManager[Callable[[], None]]:
        raise broken

    check = machine_checks.cycle("phantomx_mk2", actuator=actuator)
    assert (check.level, check.found) == (Level.WARN, f"not timed: {broken}")
    assert advice in check.advice


def load(service: str, takes_ms: float, cores: float = 0.1) -> StageLoad:
    return StageLoad(service, 0.5 * takes_ms, takes_ms, rehearsal.STAGES[service][1], cores)


def test_chain_check_reports_time_of_each_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_checks, "usable_cores", lambda: 2)
    check = machine_checks.chain(
        "phantomx_mk2", lambda _: [load("perception", 12.04), load("mapper", 20.0), load("actuator", 31.0)]
    )
    assert (check.level, check.advice) == (Level.OK, "")
    assert check.found == (
        "frame to pose and scan takes 6.0 (p99 12.0) of 67 ms, scan to map takes 10.0 (p99 20.0) of 67 ms, "
        "actuator cycle takes 15.5 (p99 31.0) of 20 ms; "
        "together 0.3 of 2 cores"
    )


@pytest.mark.parametrize(
    ("stages", "words"),
    [
        (
            [load("perception", 12.0), load("mapper", 160.0)],
            " (scan to map); use --lockstep or close programs",
        ),
        ([load("planner", 12.0, cores=1.6)], "; use --lockstep or close programs"),
    ],
)
def test_chain_check_names_slow_stage(stages: list[StageLoad], words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_checks, "usable_cores", lambda: 2)
    check = machine_checks.chain("phantomx_mk2", lambda _: stages)
    assert check.level is Level.WARN
    assert check.advice == f"at its present load this computer is too slow to walk in real time{words}"


def test_chain_check_reports_cause_if_not_timed() -> None:
    def rehearse(robot: str) -> list[StageLoad]:
        raise ImportError("no mujoco")

    check = machine_checks.chain("phantomx_mk2", rehearse)
    assert (check.level, check.found) == (Level.WARN, "not timed: no mujoco")


def test_chain_check_reports_wrong_profile(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text('extends = "phantomx_mk2"\n[links]\nfemur = -1.0\n', encoding="utf-8")
    check = machine_checks.chain(str(own))
    assert check.level is Level.WARN
    assert "links.femur" in check.found
    assert check.advice == "correct the profile, or give another with --robot"


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["phantomx_mk2", "printed_ds3218"])
def test_rehearsal_runs_all_stages_and_ends_on_time(robot: str) -> None:
    looks = iter(range(100))
    found = {stage.service: stage for stage in rehearsal.rehearse(robot, 4.0, lambda: float(next(looks)))}
    assert found.keys() == rehearsal.STAGES.keys()
    assert all(stage.takes_ms > 0.0 and stage.cores > 0.0 for stage in found.values())
    assert next(looks) <= 7, "it ends when its seconds are over"


def test_stage_load_is_relative_to_simulated_time() -> None:
    (found,) = rehearsal.loads({"mapper": [10.0] * 99 + [50.0], "planner": []}, 4.0)
    assert (found.service, found.takes_ms, found.cores) == ("mapper", pytest.approx(10.4), pytest.approx(0.26))


def test_missing_library_is_reported_with_its_role(monkeypatch: pytest.MonkeyPatch) -> None:
    def importing(name: str) -> ModuleType:
        if name == "mujoco":
            raise ImportError("libEGL.so.1: cannot open shared object file")
        return ModuleType(name)

    monkeypatch.setattr(importlib, "import_module", importing)
    checks = {check.name: check for check in machine_checks.wheels()}
    assert checks["libraries: simulator"].level is Level.WARN
    assert "mujoco (libEGL.so.1" in checks["libraries: simulator"].found
    assert ".[simulator]" in checks["libraries: simulator"].advice
    assert checks["libraries: actuator"].level is Level.OK


def test_doctor_roles_are_extras_of_package() -> None:
    import tomllib

    root = Path(machine_checks.__file__).resolve().parents[2]
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(machine_checks._ROLES) - {"core"} <= set(extras)


def test_unwritable_numba_cache_warns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert machine_checks.numba_cache().level is Level.OK
    monkeypatch.setattr(machine_checks, "_writable", lambda _: False)
    assert machine_checks.numba_cache().level is Level.WARN


def test_missing_camera_warns_and_fails_if_requested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openni", None)
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    check = machine_checks.depth_camera("phantomx_mk2")
    assert (check.level, check.advice) == (Level.WARN, "pip install -e '.[openni]'")
    check = machine_checks.depth_camera("phantomx_mk2", "realsense")
    assert check.level is Level.FAIL
    assert ".[realsense]" in check.advice
    assert machine_checks.depth_camera("phantomx_mk2", str(tmp_path)).level is Level.FAIL
    assert machine_checks.depth_camera("phantomx_mk2_scanner").level is Level.OK
    assert machine_checks.depth_camera("nobody").level is Level.FAIL


def test_missing_library_of_the_imu_warns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "adafruit_bno055", None)
    profile = tmp_path / "mine.toml"
    profile.write_text('extends = "phantomx_mk2"\n[imu]\ndevice = "bno055"\n', encoding="utf-8")
    (check,) = machine_checks.inertial_sensor(str(profile))
    assert check.level is Level.WARN
    assert "sextant[imu]" in check.advice
    assert not machine_checks.inertial_sensor("phantomx_mk2")
    assert not machine_checks.inertial_sensor("nobody")


@pytest.mark.parametrize("plugged", [True, False])
def test_connected_camera_model_is_reported(plugged: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    from sextant.services.perception.cameras import realsense

    monkeypatch.setattr(realsense, "find", lambda: ["Intel RealSense D435I"] * plugged)
    check = machine_checks.depth_camera("phantomx_mk2", "realsense")
    assert (check.level is Level.OK) is plugged
    assert ("D435I" in check.found) is plugged


def test_text_and_json_outputs_agree() -> None:
    checks = [Check("a", Level.OK, "fine"), Check("b", Level.FAIL, "broken", "mend it")]
    assert machine_checks.in_words(checks).splitlines() == ["OK    a: fine", "FAIL  b: broken", "      -> mend it"]
    assert json.loads(machine_checks.to_json(checks))[1] == {
        "name": "b",
        "level": "FAIL",
        "found": "broken",
        "advice": "mend it",
    }
