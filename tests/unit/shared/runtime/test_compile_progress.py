"""Progress of a first compilation, as lines of the processes that compile."""

import os
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from sextant.services.planner.roadmap import roadmap_search
from sextant.shared.runtime import compile_progress
from sextant.shared.runtime.compile_progress import CompiledFunctions


def test_compiled_functions_are_counted_over_processes() -> None:
    found = CompiledFunctions()
    for line in (
        f"{compile_progress.COMPILED} 11 3 30",
        f"{compile_progress.COMPILED} 12 20 24",
        "a warning",
        f"{compile_progress.COMPILED} 11 x 30",
        f"{compile_progress.COMPILED} 11 11 30",
    ):
        assert found.hear("warm-up", line) == (line.startswith("compiled") and "x" not in line)
    assert found.count() == (31, 54)


def test_progress_of_compilation_is_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    printed = threading.Event()
    no = {"py_func": SimpleNamespace(__module__="a"), "stats": SimpleNamespace(cache_hits={})}
    counts = iter([[SimpleNamespace(overloads=(), **no), SimpleNamespace(overloads=("f",), **no)]])
    monkeypatch.setattr(compile_progress, "_REPORT_EVERY_S", 0.001)
    monkeypatch.setattr(compile_progress, "_compiled_functions", lambda: next(counts, None) or printed.set() or [])
    with compile_progress.reported():
        assert printed.wait(60.0)
    assert capsys.readouterr().out.splitlines()[0] == f"{compile_progress.COMPILED} {os.getpid()} 1 2"


def test_functions_of_a_file_are_ready_once_one_is_loaded() -> None:
    def function(file: str, hits: int, overloads: int) -> Any:
        stats = SimpleNamespace(cache_hits={"f": hits} if hits else {})
        return SimpleNamespace(py_func=SimpleNamespace(__module__=file), stats=stats, overloads="f" * overloads)

    known = [function("a", 1, 1), function("a", 0, 0), function("b", 0, 1), function("b", 0, 0)]
    assert compile_progress._ready(known) == known[:3]


def test_inlined_functions_are_not_counted() -> None:
    assert roadmap_search.grow
    names = {one.py_func.__name__ for one in compile_progress._compiled_functions()}
    assert "grow" in names
