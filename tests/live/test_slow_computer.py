"""A computer that is too slow, simulated by pausing processes.

A run names its late inputs, and simulated time waits where it may.
"""

import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.support.commands import Command, Ear, write_course

pytestmark = pytest.mark.live


@contextmanager
def paused(command: Command, service: str, stands_s: float, runs_s: float) -> Iterator[None]:
    """Pause a service of a command repeatedly."""
    over = threading.Event()

    def send(number: signal.Signals) -> None:
        process = command.service(service)
        if process is not None:
            with suppress(ProcessLookupError):
                os.kill(process.pid, number)

    def pause() -> None:
        while not over.wait(runs_s):
            send(signal.SIGSTOP)
            over.wait(stands_s)
            send(signal.SIGCONT)

    thread = threading.Thread(target=pause)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def said(command: Command, *words: str) -> Callable[[], bool]:
    """Return a condition: one line of the command's output has all these words."""
    return lambda: any(all(word in line for word in words) for line in command.said)


def test_slow_computer_run_reports_late_inputs_and_ends_with_its_simulator(tmp_path: Path) -> None:
    course, out = write_course(tmp_path, "long", 8.0), tmp_path / "out"
    with Command("run", str(course), "--seed", "1000", "--out", str(out), cwd=tmp_path) as command:
        with Ear.at(command.endpoints()) as ear:
            command.wait_for(lambda: ear.walked(1), "the walk")
        with paused(command, "mapper", stands_s=1.5, runs_s=0.3):
            sentence = said(command, "warning: this computer is too slow: ", "allowed", "use --lockstep or close programs")
            command.wait_for(sentence, "the sentence")
        victim = command.service("simulator")
        assert victim is not None
        os.kill(victim.pid, signal.SIGKILL)
        assert command.status() == 1
        command.gone()
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["too_slow"].startswith("this computer is too slow: ")
    assert report["late_s"] > 0.0
    assert report["input_ages_s"].keys() >= {"planner mapper/terrain", "mapper perception/scan", "actuator beat"}
    assert report["success"] is False
    assert "simulator ended (killed by SIGKILL)" in report["reason"]
    assert "stuck" not in report["reason"]


@pytest.mark.rare
def test_simulated_time_waits_for_a_service_that_is_late(tmp_path: Path) -> None:
    course, out = write_course(tmp_path, "short", 0.3), tmp_path / "out"
    words = ("run", str(course), "--slow-down", "--seed", "1000", "--out", str(out))
    with Command(*words, cwd=tmp_path) as command, paused(command, "perception", stands_s=0.4, runs_s=0.1):
        assert command.status() == 0, command.text()
        command.gone()
        assert "success: goal reached" in command.text()
        assert said(command, "simulated time ran at 0.", "of real time, held for", ": this computer is too slow")()
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["real_time_factor"] < 0.9
    assert report["too_slow"].startswith("simulated time ran at 0.")
    assert report["input_ages_s"]["planner perception/pose"]["late"] < 0.1
