"""The end of a process, even while its main thread is blocked."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from sextant.shared.runtime import shutdown
from sextant.shared.runtime.shutdown import ShutdownRequested

pytestmark = pytest.mark.slow  # each test starts a process

PATIENCE_S = 180.0  # for a separate process on a busy machine

_BEGINS = """
import ctypes, os, signal, sys, threading
from sextant.shared.runtime import shutdown
shutdown._END_S = float(sys.argv[1])
with shutdown.ShutdownRequested() as told:
    told.open()
    print("ready", os.getpid(), flush=True)
"""
_ENDS = f"""{_BEGINS}
    told.event.wait()
    print("told", flush=True)
    shutdown.leave(3)
"""
_CAUGHT_IN_A_LIBRARY = f"""{_BEGINS}
    while True:
        ctypes.CDLL(None).sleep(1000)  # a handler of Python's runs between two calls, each of them as long as it likes
"""
_HANGS_WHILE_IT_CLOSES = f"""{_BEGINS}
    told.event.wait()
    threading.Event().wait()
"""
_FAILS = """
from sextant.shared.runtime import shutdown
shutdown.leave_at_errors()
raise RuntimeError("no more ground")
"""
_FAILS_IN_A_THREAD = """
import threading
from sextant.shared.runtime import shutdown
def fail():
    raise RuntimeError("no more ground")
shutdown.leave_at_errors_of_threads()
threading.Thread(target=fail).start()
threading.Event().wait()
"""
_STARTS_ONE = """
import subprocess, sys
subprocess.Popen([sys.executable, "-c", *sys.argv[1:]])
sys.stdin.read()
"""


@contextlib.contextmanager
def begun(source: str, *words: str) -> Iterator["subprocess.Popen[str]"]:
    """Start a process; kill it and its children at the end."""
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", source, *words]
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, process_group=0)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def is_ready(process: "subprocess.Popen[str]") -> bool:
    assert process.stdout is not None
    return process.stdout.readline().startswith("ready")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signaled_process_closes_and_exits_with_its_status(number: signal.Signals) -> None:
    with begun(_ENDS, str(PATIENCE_S)) as process:
        assert is_ready(process)
        process.send_signal(number)
        said, complained = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, said, complained) == (3, "told\n", "")


@pytest.mark.parametrize("source", [_CAUGHT_IN_A_LIBRARY, _HANGS_WHILE_IT_CLOSES])
def test_hung_process_is_ended_after_signal_with_traceback(source: str) -> None:
    with begun(source, "0.5") as process:
        assert is_ready(process)
        process.send_signal(signal.SIGTERM)
        _, complained = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "Timeout (0:00:00.500000)!" in complained
    assert 'File "<string>", line' in complained


def test_hung_process_ends_with_its_parent() -> None:
    child = _CAUGHT_IN_A_LIBRARY.replace("with shutdown", "shutdown.end_with(os.getppid())\nwith shutdown")
    with begun(_STARTS_ONE, child, "0.5") as parent:
        assert is_ready(parent)
        parent.kill()
        said, complained = parent.communicate(timeout=PATIENCE_S)  # until the child has also closed them
    assert said == ""
    assert "Timeout" in complained


def test_exception_during_shutdown_exits_with_status_1() -> None:
    with begun(_FAILS) as process:
        _, complained = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert complained.endswith("RuntimeError: no more ground\n")


def test_signal_handlers_are_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutdown, "_END_S", PATIENCE_S)  # otherwise the process of all tests would end
    heard: list[int] = []
    before: Any = signal.signal(signal.SIGTERM, lambda number, _: heard.append(number))
    try:
        with ShutdownRequested() as told:
            told.open()
            os.kill(os.getpid(), signal.SIGTERM)
            assert told.event.wait(PATIENCE_S)
        assert heard == []
        os.kill(os.getpid(), signal.SIGTERM)
        assert heard == [signal.SIGTERM]
        assert signal.set_wakeup_fd(-1) == -1
        assert not any(thread.name == "told to end" for thread in threading.enumerate())
    finally:
        signal.signal(signal.SIGTERM, before)


def test_failed_thread_ends_process_with_traceback() -> None:
    with begun(_FAILS_IN_A_THREAD) as process:
        _, said = process.communicate(timeout=60.0)
        assert process.returncode == 1
        assert "RuntimeError: no more ground" in said
