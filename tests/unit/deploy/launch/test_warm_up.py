"""Compilation before a first run: once, on a suitable number of cores."""

import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sextant.deploy.launch import warm_up
from sextant.deploy.live.live_run import CompiledFunctions
from sextant.services.mapper.elevation import fusion
from sextant.services.planner.roadmap import roadmap_search
from sextant.shared.runtime import warm_up_mark


@pytest.fixture(autouse=True)
def _keep_mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the machine's own mark, which tells what is compiled."""
    monkeypatch.setattr(warm_up_mark, "MARK", tmp_path / "warm_up.txt")


@pytest.mark.parametrize(
    ("compiled", "cores", "options", "services", "jobs"),
    [
        (False, 1, [], ["mapper", "perception", "planner", "simulator"], 1),
        (False, 2, [], ["mapper", "perception", "planner", "simulator"], 4),
        (False, 2, ["--least"], ["mapper", "perception", "planner.locomotion", "simulator"], 4),
        (True, 16, [], ["mapper", "perception", "planner", "simulator"], 1),
    ],
)
def test_first_compilation_runs_in_a_process_per_service(
    compiled: bool, cores: int, options: list[str], services: list[str], jobs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[list[tuple[Any, ...]], int]] = []

    def share_out(_work: Any, tasks: list[tuple[Any, ...]], jobs: int, **_: Any) -> Iterator[None]:
        asked.append((tasks, jobs))
        yield from ()

    monkeypatch.setattr(warm_up, "share_out", share_out)
    monkeypatch.setattr(warm_up, "has_compiled", lambda: compiled)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(sys, "argv", ["warm_up", *options])
    assert warm_up.main() == 0
    ((tasks, found),) = asked
    assert found == jobs
    assert sorted(service for service, _, _ in tasks) == services


def test_numba_cache_files_are_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: Any = fusion._measure
    assert Path(compiled.stats.cache_path).is_dir()
    monkeypatch.setattr(fusion, "_measure", SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path))))
    (tmp_path / "fusion.other-1.py311.nbi").touch()
    assert not warm_up.has_compiled()
    (tmp_path / "fusion._measure-240.py311.nbi").touch()
    assert warm_up.has_compiled()


def test_compiled_functions_are_counted_over_processes() -> None:
    found = CompiledFunctions()
    for line in (
        f"{warm_up.COMPILED} 11 3 30",
        f"{warm_up.COMPILED} 12 20 24",
        "a warning",
        f"{warm_up.COMPILED} 11 x 30",
        f"{warm_up.COMPILED} 11 11 30",
    ):
        found.hear("warm-up", line)
    assert found.count() == (31, 54)


def test_progress_of_compilation_is_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    printed = threading.Event()
    no = {"py_func": SimpleNamespace(__module__="a"), "stats": SimpleNamespace(cache_hits={})}
    counts = iter([[SimpleNamespace(overloads=(), **no), SimpleNamespace(overloads=("f",), **no)]])
    monkeypatch.setattr(warm_up, "_REPORT_EVERY_S", 0.001)
    monkeypatch.setattr(warm_up, "_compiled_functions", lambda: next(counts, None) or printed.set() or [])
    with warm_up._reported():
        assert printed.wait(60.0)
    assert capsys.readouterr().out.splitlines()[0] == f"{warm_up.COMPILED} {os.getpid()} 1 2"


def test_functions_of_a_file_are_ready_once_one_is_loaded() -> None:
    def function(file: str, hits: int, overloads: int) -> Any:
        stats = SimpleNamespace(cache_hits={"f": hits} if hits else {})
        return SimpleNamespace(py_func=SimpleNamespace(__module__=file), stats=stats, overloads="f" * overloads)

    known = [function("a", 1, 1), function("a", 0, 0), function("b", 0, 1), function("b", 0, 0)]
    assert warm_up._ready(known) == known[:3]


def test_inlined_functions_are_not_counted() -> None:
    assert roadmap_search.grow
    names = {one.py_func.__name__ for one in warm_up._compiled_functions()}
    assert "grow" in names
