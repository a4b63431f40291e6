"""Work in several processes."""

import multiprocessing
import os
import time
from collections.abc import Callable

import pytest

from sextant.shared.runtime.workers import in_copy, share_out

TASKS = [(7, 2), (9, 4), (5, 5), (8, 3)]


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_are_in_task_order(jobs: int) -> None:
    assert list(share_out(divmod, TASKS, jobs)) == [divmod(*task) for task in TASKS]


def test_unordered_results_are_complete() -> None:
    assert sorted(share_out(divmod, TASKS, 2, in_order=False)) == sorted(divmod(*task) for task in TASKS)


def test_worker_process_uses_one_compute_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    names = [("OMP_NUM_THREADS",), ("NUMBA_NUM_THREADS",)]
    assert list(share_out(os.getenv, names, 2)) == ["1", "1"]
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "NUMBA_NUM_THREADS" not in os.environ


def test_failed_task_terminates_remaining_workers() -> None:
    with pytest.raises(ZeroDivisionError):
        list(share_out(_divide_or_sleep, [(1, 0), *8 * [(1, 600)]], 2))
    assert not multiprocessing.active_children()


def test_closed_results_generator_terminates_workers() -> None:
    results = share_out(_divide_or_sleep, [(4, 2), (1, 600), (1, 600)], 2)
    assert next(results) == 2.0
    results.close()  # type: ignore[attr-defined]
    assert not multiprocessing.active_children()


def test_in_copy_does_not_modify_parent_process() -> None:
    here = [1]

    def work() -> tuple[int, list[int]]:
        here.append(2)
        return os.getpid(), here

    process, there = in_copy(work)
    assert process != os.getpid()
    assert (here, there) == ([1], [1, 2])
    assert not multiprocessing.active_children()


@pytest.mark.parametrize(("end", "code"), [(lambda: os._exit(3), 3), (lambda: 1 // 0, 1)])
def test_in_copy_raises_if_child_exits_early(end: Callable[[], object], code: int) -> None:
    with pytest.raises(RuntimeError, match=f"ended with exit code {code}"):
        in_copy(end)


def _divide_or_sleep(a: int, b: int) -> float:
    if b == 600:
        time.sleep(b)  # until the process is terminated
    return a / b
