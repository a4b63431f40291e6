"""Compilation before a first run: once, on a suitable number of cores."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sextant.deploy.launch import warm_up
from sextant.services.mapper.elevation import fusion
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
