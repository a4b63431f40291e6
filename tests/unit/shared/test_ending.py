"""How a process ends, whatever its main thread is caught in."""

import os
import signal
import subprocess
import sys
import threading
from typing import Any

import pytest

from shared.ending import ToldToEnd

PATIENCE_S = 60.0  # for a process of its own on a busy machine

_BEGINS = """
import ctypes, os, signal, sys, threading
from shared import ending
ending._END_S = 0.5
with ending.ToldToEnd() as told:
    told.open()
    print("ready", flush=True)
"""
_ENDS = (
    _BEGINS
    + """
    told.event.wait()
    print("told", flush=True)
ending.leave(3)
"""
)
_CAUGHT_IN_A_LIBRARY = (
    _BEGINS
    + """
    libc = ctypes.CDLL(None)
    while True:
        libc.sleep(1000)  # a handler of Python's runs between two calls, each of them as long as it likes
"""
)
_HANGS_WHILE_IT_CLOSES = (
    _BEGINS
    + """
    told.event.wait()
    print("told", flush=True)
    threading.Event().wait()
"""
)
_LEFT_BEHIND = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]])
print(child.pid, flush=True)
sys.stdin.read()
"""


def begun(source: str, *arguments: str) -> "subprocess.Popen[str]":
    words = [sys.executable, "-c", source, *arguments]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline(), "it is ready"
    return process


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_who_is_told_closes_and_leaves_with_its_status(number: signal.Signals) -> None:
    with begun(_ENDS) as process:
        process.send_signal(number)
        said, complained = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, said, complained) == (3, "told\n", "")


@pytest.mark.parametrize("source", [_CAUGHT_IN_A_LIBRARY, _HANGS_WHILE_IT_CLOSES])
def test_who_is_told_and_hangs_is_ended_and_says_where_it_was(source: str) -> None:
    with begun(source) as process:
        process.send_signal(signal.SIGTERM)
        _, complained = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "Timeout (0:00:00.500000)!" in complained
    assert 'File "<string>", line' in complained


def test_nobody_who_hangs_outlives_the_one_that_started_it() -> None:
    child = _CAUGHT_IN_A_LIBRARY.replace("with ending", "ending.end_with(os.getppid())\nwith ending")
    with begun(_LEFT_BEHIND, child) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "ready\n"
        parent.kill()
        said, complained = parent.communicate(timeout=PATIENCE_S)  # until the child has closed them, too
    assert said == ""
    assert "Timeout" in complained


def test_the_block_leaves_signals_as_they_were() -> None:
    heard: list[int] = []
    before: Any = signal.signal(signal.SIGTERM, lambda number, _: heard.append(number))
    try:
        with ToldToEnd() as told:
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
