"""Requests of a process to its operating system."""

import gc
import os
import resource
import sys
import weakref
from collections.abc import Iterator

import pytest

from sextant.services.actuator.servo_bus.serial_port import REPLY_TIMEOUT_NS
from sextant.shared.runtime.process_priority import allow_many_files, go_first, go_last, spare_collector, switch_often


@pytest.fixture(autouse=True)
def collector_as_before() -> Iterator[None]:
    before = gc.get_threshold()
    yield
    gc.set_threshold(*before)
    gc.unfreeze()


class Run:
    """An object that refers to itself, as runs do."""

    def __init__(self) -> None:
        self.itself = self


@pytest.mark.slow
def test_garbage_of_earlier_run_is_collected_at_next_start() -> None:
    run = Run()
    left = weakref.ref(run)
    spare_collector()
    del run
    assert left() is not None
    spare_collector()
    assert left() is None


def test_real_time_priority_is_set_or_refused_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int, int]] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda pid, policy, way: asked.append((pid, policy, way.sched_priority)))
    assert go_first() == ""
    assert asked == [(0, os.SCHED_RR, 10)]

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert "ulimit -r" in go_first()


def test_background_work_runs_only_on_idle_cores_or_with_low_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda _pid, policy, _way: asked.append(policy))
    monkeypatch.setattr(os, "nice", asked.append)
    go_last()
    assert asked == [os.SCHED_IDLE]
    monkeypatch.delattr(os, "SCHED_IDLE")
    go_last()
    assert asked[1:] == [19]


def test_thread_switch_interval_suits_servo_timeout() -> None:
    """Switch threads often enough that a servo's answer is read in time.

    A thread reads the answer while another one computes. With Python's usual 5 ms, some answers came too late in measurements.
    """
    usual_s = sys.getswitchinterval()
    try:
        switch_often()
        assert 10 * sys.getswitchinterval() < REPLY_TIMEOUT_NS * 1e-9 < 2 * usual_s
    finally:
        sys.setswitchinterval(usual_s)


def test_open_file_limit_is_raised_to_user_limit() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (256, before[1]))
        allow_many_files()
        assert 256 < resource.getrlimit(resource.RLIMIT_NOFILE)[0] <= before[1]
        raised = resource.getrlimit(resource.RLIMIT_NOFILE)
        allow_many_files()
        assert resource.getrlimit(resource.RLIMIT_NOFILE) == raised
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
