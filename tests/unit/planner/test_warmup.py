"""Warm-up: afterwards the planning of a gap crossing compiles nothing."""

import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.peers.passage_strips import BEYOND, NEAR, START, heights, thesis_blocks
from sextant.evaluation.scoring.passage_truth import stance_at
from sextant.evaluation.whole_maps.strip import strip_of
from sextant.services.planner import warmup
from sextant.services.planner.config import Settings
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import Roadmap
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.services.planner.warmup import SearchCompilation, compile_functions
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire import codec
from sextant.shared.wire.messages import PassageMap

PROFILE = load_profile("phantomx_mk2")


def compiled() -> int:
    """Count the signatures of the planner's functions that are compiled or loaded."""
    modules = [module for name, module in sys.modules.items() if name.startswith("sextant.services.planner.")]
    found = {id(f): f for module in modules for f in vars(module).values() if hasattr(f, "signatures")}
    return sum(len(f.signatures) for f in found.values())


def received_strip(field: StripMap) -> StripMap:
    """Return the same ground as the planner receives it, from a message."""
    shape, origin = field.elevation.shape, np.array(field.first_cell)
    nothing, none = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.bool_)
    normals = np.zeros((*shape, 3), dtype=np.int16)
    layers = (field.elevation, normals, nothing, none, field.evaluation)
    told = PassageMap(0, field.resolution, origin, 0.0, *layers, 0.0, "", np.eye(4), none)
    return StripMap.of(codec.decode(codec.encode(told), PassageMap)[0])


def test_gap_crossing_planning_compiles_nothing_after_warmup() -> None:
    compile_functions(PROFILE, Settings())
    before = compiled()
    assert before > 0
    field = received_strip(strip_of(heights(thesis_blocks(3, 0.8, 0.15, 0.16, 0.03, 0.26), 0.8), 0.105))
    roadmap = Roadmap(PROFILE, PassageSettings(body_height=0.105))
    roadmap.begin(field, stance_at(PROFILE, START, 0.105), NEAR + 0.8 + BEYOND, seed=1)
    assert roadmap.grow(30_000) is not None
    assert compiled() == before


def test_received_strip_equals_sent_ground() -> None:
    field = strip_of(heights(thesis_blocks(2, 0.8, 0.15, 0.16, 0.03, 0.26), 0.8), 0.105)
    told = received_strip(field)
    np.testing.assert_array_equal(told.elevation, field.elevation)
    np.testing.assert_array_equal(told.evaluation, field.evaluation)
    np.testing.assert_allclose(told.T_world_strip, field.T_world_strip, atol=1e-12)
    assert not told.elevation.flags.writeable


def test_cached_search_is_ready_at_once() -> None:
    compile_functions(PROFILE, Settings())
    compilation = SearchCompilation()
    compilation.start(PROFILE, Settings())
    assert compilation.is_ready()


def test_another_process_compiles_search_while_planner_works(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled, loaded = threading.Event(), threading.Event()

    def run(command: list[str], **_: object) -> SimpleNamespace:
        assert command == [sys.executable, "-m", "sextant.services.planner.warmup"]
        assert compiled.wait(60.0)
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(warmup, "is_compiled", lambda: False)
    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(warmup, "compile_functions", lambda *_: loaded.set())
    compilation = SearchCompilation()
    compilation.start(PROFILE, Settings())
    assert not compilation.is_ready()
    assert not loaded.is_set()
    compiled.set()
    assert compilation._ready.wait(60.0)
    assert loaded.is_set()


def test_planner_ends_if_search_cannot_be_compiled(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    left: list[int] = []

    def leave(status: int) -> None:
        left.append(status)
        raise SystemExit(status)

    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=-9))
    monkeypatch.setattr(warmup, "leave", leave)
    monkeypatch.setattr(warmup, "_LATE_S", 0.0)
    compilation = SearchCompilation()
    with pytest.raises(SystemExit):
        compilation._compile(PROFILE, Settings())
    assert left == [1]
    assert "failed (exit status -9)" in caplog.text
    assert not compilation.is_ready()


def test_cache_of_the_search_is_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    search = warmup.roadmap_search.grow
    line = search.py_func.__code__.co_firstlineno  # type: ignore[attr-defined]
    fake = SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path)), py_func=search.py_func)  # type: ignore[attr-defined]
    monkeypatch.setattr(warmup.roadmap_search, "grow", fake)
    (tmp_path / f"roadmap_search.grow-{line + 1}.py311.nbi").touch()
    assert not warmup.is_compiled()
    (tmp_path / f"roadmap_search.grow-{line}.py311.nbi").touch()
    assert warmup.is_compiled()
