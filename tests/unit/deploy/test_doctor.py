import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from deploy import doctor
from deploy.checks import Check, Level
from shared import host


def test_every_complaint_says_what_to_do() -> None:
    for check in (doctor.python((3, 10)), doctor.cores(1), doctor.disk(Path(), 1000), doctor.disk(Path(), 1 << 30)):
        assert check.level is not Level.OK
        assert check.advice
    for check in (doctor.python((3, 11)), doctor.cores(2), doctor.disk(Path(), 1 << 40)):
        assert check.level is Level.OK
        assert not check.advice


def test_too_little_is_told_from_nothing() -> None:
    assert doctor.disk(Path(), 1 << 30).level is Level.WARN
    assert doctor.disk(Path(), 1 << 20).level is Level.FAIL


def test_frames_get_round_through_a_router_here() -> None:
    check = doctor.zenoh_round_trip()
    assert check.level is not Level.FAIL, check.found


def clocked(late_ms: Callable[[int], float]) -> Check:
    """The check of the cycle where the kth wait lasts longer by some time."""
    now, waits = 0, 0

    def wait(seconds: float) -> None:
        nonlocal now, waits
        now += round(1e9 * seconds + 1e6 * late_ms(waits))
        waits += 1

    return doctor.cycle(lambda: now, wait)


@pytest.fixture(params=["", "real-time priority is refused; allow it"])
def refused(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(host, "go_first", lambda: request.param)
    return str(request.param)


def test_a_machine_that_keeps_time_is_in_order(refused: str) -> None:
    check = clocked(lambda _: 0.0)
    assert (check.level, check.advice) == (Level.OK, "")
    without = ", without real-time priority" if refused else ""
    assert check.found == f"of 20 ms takes 20.0 ms (p50), 20.0 (p99), 20.0 at most; 0 of 200 took more than 25{without}"


def test_a_cycle_that_is_late_now_and_then_is_told_and_no_failure(refused: str) -> None:
    once = clocked(lambda k: 9.0 if k == 50 else 0.0)
    assert once.level is Level.OK
    assert once.found.startswith("of 20 ms takes 20.0 ms (p50), 20.0 (p99), 29.0 at most; 1 of 200 took more than 25")
    often = clocked(lambda k: 9.0 if k % 20 == 0 else 0.0)
    assert often.level is Level.WARN
    assert "20.0 ms (p50), 29.0 (p99), 29.0 at most; 10 of 200 took more than 25" in often.found
    assert often.advice == (refused or "end other programs, those of real-time priority first")


def test_a_missing_wheel_is_named_with_the_role_that_lacks_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def importing(name: str) -> ModuleType:
        if name == "mujoco":
            raise ImportError("libEGL.so.1: cannot open shared object file")
        return ModuleType(name)

    monkeypatch.setattr(importlib, "import_module", importing)
    checks = {check.name: check for check in doctor.wheels()}
    assert checks["libraries: simulator"].level is Level.WARN
    assert "mujoco (libEGL.so.1" in checks["libraries: simulator"].found
    assert ".[simulator]" in checks["libraries: simulator"].advice
    assert checks["libraries: actuator"].level is Level.OK


def test_the_roles_are_those_of_the_package() -> None:
    import tomllib

    root = Path(doctor.__file__).parents[1]
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(doctor._ROLES) - {"core"} <= set(extras)


def test_a_cache_that_cannot_be_written_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert doctor.numba_cache().level is Level.OK
    monkeypatch.setattr(doctor, "_writable", lambda _: False)
    assert doctor.numba_cache().level is Level.WARN


def test_a_camera_that_is_absent_is_a_warning_unless_it_was_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openni", None)
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    check = doctor.depth_camera("phantomx_mk2")
    assert (check.level, check.advice) == (Level.WARN, "pip install -e '.[openni]'")
    check = doctor.depth_camera("phantomx_mk2", "realsense")
    assert check.level is Level.FAIL
    assert ".[realsense]" in check.advice
    assert doctor.depth_camera("phantomx_mk2", str(tmp_path)).level is Level.FAIL
    assert doctor.depth_camera("phantomx_mk2_scanner").level is Level.OK
    assert doctor.depth_camera("nobody").level is Level.FAIL


@pytest.mark.parametrize("plugged", [True, False])
def test_a_camera_that_is_there_is_named(plugged: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    from services.perception.cameras import realsense

    monkeypatch.setattr(realsense, "find", lambda: ["Intel RealSense D435I"] * plugged)
    check = doctor.depth_camera("phantomx_mk2", "realsense")
    assert (check.level is Level.OK) is plugged
    assert ("D435I" in check.found) is plugged


def test_words_and_json_say_the_same() -> None:
    checks = [Check("a", Level.OK, "fine"), Check("b", Level.FAIL, "broken", "mend it")]
    assert doctor.in_words(checks).splitlines() == ["OK    a: fine", "FAIL  b: broken", "      -> mend it"]
    assert json.loads(doctor.to_json(checks))[1] == {"name": "b", "level": "FAIL", "found": "broken", "advice": "mend it"}
