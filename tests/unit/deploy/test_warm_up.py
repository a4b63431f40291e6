"""Compilation before a first run: once, on a suitable number of cores."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sextant.deploy import warm_up
from sextant.services.planner.gap_crossing import roadmap_search


@pytest.mark.parametrize(("compiled", "cores", "jobs"), [(False, 1, 1), (False, 2, 2), (False, 16, 2), (True, 16, 1)])
def test_first_compilation_runs_on_at_most_two_cores(
    compiled: bool, cores: int, jobs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[list[tuple[Any, ...]], int]] = []

    def share_out(_work: Any, tasks: list[tuple[Any, ...]], jobs: int, **_: Any) -> Iterator[None]:
        asked.append((tasks, jobs))
        yield from ()

    monkeypatch.setattr(warm_up, "share_out", share_out)
    monkeypatch.setattr(warm_up, "_compiled_before", lambda: compiled)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(sys, "argv", ["warm_up"])
    assert warm_up.main() == 0
    ((tasks, found),) = asked
    assert found == jobs
    rehearsed = [rehearsal for (share,) in tasks for rehearsal in share]
    assert sorted(rehearsal.__name__ for rehearsal in rehearsed) == ["_mapper", "_perception", "_planner", "_simulator"]


def test_numba_cache_files_are_detected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: Any = roadmap_search.grow
    assert Path(compiled.stats.cache_path).is_dir()
    monkeypatch.setattr(roadmap_search, "grow", SimpleNamespace(stats=SimpleNamespace(cache_path=str(tmp_path))))
    (tmp_path / "roadmap.other-1.py311.nbi").touch()
    assert not warm_up._compiled_before()
    (tmp_path / "search.grow-1132.py311.nbi").touch()
    assert warm_up._compiled_before()
