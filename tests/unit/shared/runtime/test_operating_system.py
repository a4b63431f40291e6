"""Systems that lack what Linux has: a guard each, and a walk without any of it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sextant.shared.runtime.operating_system import usable_cores
from sextant.shared.runtime.process_priority import go_first

# A child whose system reports no end of a parent; it says when it is told.
CHILD = """
import os, signal, threading
from types import SimpleNamespace
from sextant.shared.runtime import operating_system
operating_system.ctypes = SimpleNamespace(CDLL=lambda _: SimpleNamespace())
signal.signal(signal.SIGTERM, lambda *_: (print("told", flush=True), os._exit(0)))
assert operating_system.signal_at_end_of(os.getppid(), signal.SIGTERM)
print("ready", flush=True)
threading.Event().wait(60)
print("never told", flush=True)
"""
PARENT = """
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", sys.argv[1]])
sys.stdin.readline()
"""

LACKING = """
import os, socket, sys, time, ctypes
for module, names in ((os, ("sched_getaffinity", "sched_setscheduler", "sched_param", "SCHED_RR")),
                      (socket, ("SO_PASSCRED", "SCM_CREDENTIALS")), (time, ("CLOCK_BOOTTIME",))):
    for name in names:
        delattr(module, name)
class Library:
    def __init__(self, name):
        pass
real = ctypes.CDLL
ctypes.CDLL = lambda name=None, *rest, **more: Library(name) if name is None else real(name, *rest, **more)
from sextant.deploy import cli
sys.exit(cli.main(sys.argv[1:]))
"""
SHORT = 'name = "short"\n[goal]\ndistance = 0.3\n[[terrain]]\nkind = "plane"\n'


def test_cores_are_counted_without_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    assert usable_cores() == len(os.sched_getaffinity(0))
    monkeypatch.delattr(os, "sched_getaffinity")
    assert usable_cores() == os.cpu_count()


def test_missing_real_time_priority_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setscheduler")
    assert go_first().startswith("this system has no real-time priority")


def test_child_is_told_when_its_parent_ends_without_prctl() -> None:
    words = [sys.executable, "-c", PARENT, CHILD]
    parent = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert parent.stdin is not None
    assert parent.stdout is not None
    assert parent.stdout.readline() == "ready\n"
    parent.kill()
    parent.wait()
    assert parent.stdout.read() == "told\n", "the pipe ends with the child"
    parent.stdin.close()
    parent.stdout.close()


def test_parent_that_has_ended_is_reported() -> None:
    code = "import os, signal; from sextant.shared.runtime.operating_system import signal_at_end_of as at_end;"
    code += "print(at_end(os.getppid() + 1, signal.SIGTERM), at_end(os.getppid(), signal.SIGTERM))"
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert made.stdout == "False True\n"


@pytest.mark.slow
def test_walk_without_what_only_linux_has(tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(SHORT)
    words = ["run", str(tmp_path / "short.toml"), "--lockstep", "--seed", "1", "--out", str(tmp_path / "run")]
    made = subprocess.run([sys.executable, "-c", LACKING, *words], capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    assert "success: goal reached" in made.stdout
