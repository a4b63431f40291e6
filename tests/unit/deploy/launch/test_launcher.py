import os
import queue
import re
import select
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from sextant.deploy.launch import launcher as launcher_module
from sextant.deploy.launch import process_table
from sextant.deploy.launch.launcher import Ended, Launcher, how_it_ended, last_words
from sextant.deploy.launch.process_table import Command
from sextant.shared.wire.ports import free_port, port_taken
from sextant.shared.wire.transport import Endpoints, ZenohLink

STAND_IN = str(Path(__file__).parents[3] / "support" / "stand_in.py")
PATIENCE_S = 20.0  # for a busy machine; a test that passes does not wait that long


class OutputCollector:
    """A collector of the children's output lines; a test may wait for one."""

    def __init__(self) -> None:
        self.lines: dict[str, queue.Queue[str]] = defaultdict(queue.Queue)

    def __call__(self, name: str, line: str) -> None:
        self.lines[name].put(line)

    def wait_for(self, name: str, start: str) -> str:
        until = time.monotonic() + PATIENCE_S
        while True:
            line = self.lines[name].get(timeout=max(0.01, until - time.monotonic()))
            if line.startswith(start):
                return line.removeprefix(start).strip()


def command(
    name: str, *words: str, restarts: int = 0, after: tuple[str, ...] = (), ready_port: int = 0, watchdog_s: float = 0.0
) -> Command:
    return Command(name, (STAND_IN, *words), {"SEXTANT_TEST": "1"}, restarts, after, ready_port, watchdog_s)


def process_ended(pid_fd: int, timeout_s: float = PATIENCE_S) -> bool:
    """Return whether the process behind a pidfd ends within a time [s]."""
    return bool(select.select([pid_fd], [], [], timeout_s)[0])


@pytest.fixture
def output_collector() -> OutputCollector:
    return OutputCollector()


@pytest.fixture
def pid_fds() -> Iterator[list[int]]:
    fds: list[int] = []
    yield fds
    for fd in fds:
        os.close(fd)


def test_stop_ends_all_started_processes(output_collector: OutputCollector, pid_fds: list[int]) -> None:
    with Launcher([command("a", "obedient"), command("b", "obedient")], output_collector, grace_s=PATIENCE_S) as launcher:
        for name in ("a", "b"):
            assert int(output_collector.wait_for(name, "ready")) == launcher.pid(name)
            pid_fds.append(os.pidfd_open(launcher.pid(name)))
            assert os.getpgid(launcher.pid(name)) == launcher.pid(name), "the terminal's Ctrl-C must not reach a child"
        assert launcher.poll() == []
        assert launcher.stop() == []
    assert all(process_ended(fd, 0) for fd in pid_fds)


def test_crashed_child_is_reported_and_restarted_up_to_limit(output_collector: OutputCollector) -> None:
    with Launcher(
        [command("a", "crash", "no more ground", restarts=1), command("b", "obedient")], output_collector
    ) as launcher:
        endings = []
        for _ in range(2):
            os.kill(int(output_collector.wait_for("a", "ready")), signal.SIGUSR1)
            endings += launcher.wait(PATIENCE_S)
        assert endings == [
            Ended("a", "exit status 1", "RuntimeError: no more ground", restarted=True),
            Ended("a", "exit status 1", "RuntimeError: no more ground", restarted=False),
        ]
        assert str(endings[0]) == "a ended (exit status 1); last output: RuntimeError: no more ground; started again"
        assert launcher.poll() == [], "an end is reported once"


def test_restart_count_resets_after_stable_uptime(output_collector: OutputCollector, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launcher_module, "STAYED_UP_S", 0.0)
    with Launcher([command("a", "crash", "no more ground", restarts=1)], output_collector) as launcher:
        for _ in range(3):
            os.kill(int(output_collector.wait_for("a", "ready")), signal.SIGUSR1)
            (ended,) = launcher.wait(PATIENCE_S)
            assert ended.restarted


def test_wait_for_start_waits_for_dependencies(output_collector: OutputCollector) -> None:
    with Launcher([command("a", "obedient"), command("b", "obedient", after=("a",))], output_collector) as launcher:
        assert launcher.wait_for_start(PATIENCE_S)
        assert launcher.names() == ("a", "b")
    with Launcher(
        [command("a", "obedient", ready_port=1), command("b", "obedient", after=("a",))], output_collector
    ) as launcher:
        assert not launcher.wait_for_start(0.1)


def test_usage_error_exit_is_not_restarted(output_collector: OutputCollector) -> None:
    with Launcher([command("a", "refuse", "no port given", restarts=5)], output_collector) as launcher:
        assert launcher.wait(PATIENCE_S) == [Ended("a", "exit status 2", "no port given", restarted=False)]


def test_killed_child_is_reported_with_signal_and_restarted(output_collector: OutputCollector) -> None:
    with Launcher([command("a", "obedient", restarts=1)], output_collector) as launcher:
        first = int(output_collector.wait_for("a", "ready"))
        launcher.kill("a")
        (ended,) = launcher.wait(PATIENCE_S)
        assert ended.how == "killed by SIGKILL"
        assert ended.restarted
        assert int(output_collector.wait_for("a", "ready")) == launcher.pid("a") != first


def test_child_ignoring_sigterm_is_killed_after_grace_time(output_collector: OutputCollector, pid_fds: list[int]) -> None:
    with Launcher([command("a", "stubborn"), command("b", "obedient")], output_collector, grace_s=0.1) as launcher:
        output_collector.wait_for("a", "ready")
        pid_fds += [os.pidfd_open(launcher.pid(name)) for name in ("a", "b")]
        assert "a" in launcher.stop()
        assert all(process_ended(fd, 0) for fd in pid_fds)


def test_dependent_process_ends_before_its_dependency(
    output_collector: OutputCollector, pid_fds: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    port = free_port()
    with Launcher(
        [command("bus", "listen", str(port), ready_port=port), command("user", "obedient", after=("bus",))],
        output_collector,
        grace_s=2 * PATIENCE_S,
    ) as launcher:
        os.kill(int(output_collector.wait_for("bus", "ready")), signal.SIGUSR1)
        until = time.monotonic() + PATIENCE_S
        while "user" not in launcher.names() and time.monotonic() < until:
            launcher.wait(0.05)
        output_collector.wait_for("user", "ready")
        user = os.pidfd_open(launcher.pid("user"))
        pid_fds.append(user)
        before: list[bool] = []

        def ask(child: launcher_module._Child, number: signal.Signals) -> None:
            if child.command.name == "bus" and number == signal.SIGTERM:
                before.append(process_ended(user, 0))
            send(child, number)

        send = launcher_module._signal
        monkeypatch.setattr(launcher_module, "_signal", ask)
        launcher.stop()
        assert before == [True]


def test_child_receives_sigterm_only_once(output_collector: OutputCollector) -> None:
    """Send SIGTERM to a child only once.

    A launcher takes a second signal as the operator's insistence, and kills its children.
    """
    with Launcher(
        [command("a", "counting"), command("b", "counting", after=("a",))], output_collector, grace_s=PATIENCE_S
    ) as launcher:
        for name in ("a", "b"):
            output_collector.wait_for(name, "ready")
        assert launcher.stop() == []
    assert [output_collector.wait_for(name, "asked") for name in ("a", "b")] == ["1", "1"]


def test_insisted_stop_kills_immediately(output_collector: OutputCollector, pid_fds: list[int]) -> None:
    with Launcher([command("a", "stubborn")], output_collector, grace_s=1e6) as launcher:
        output_collector.wait_for("a", "ready")
        pid_fds.append(os.pidfd_open(launcher.pid("a")))
        assert launcher.stop(insisted=lambda: True) == ["a"]
        assert process_ended(pid_fds[0], 0)


def test_frozen_child_ends_on_stop(output_collector: OutputCollector, pid_fds: list[int]) -> None:
    with Launcher([command("a", "obedient")], output_collector, grace_s=PATIENCE_S) as launcher:
        output_collector.wait_for("a", "ready")
        pid_fds.append(os.pidfd_open(launcher.pid("a")))
        launcher.freeze("a")
        assert launcher.poll() == [], "frozen is not dead"
        assert launcher.stop() == [], "it was thawed to hear that it shall end"
        assert process_ended(pid_fds[0], 0)


def test_hung_child_is_restarted_and_child_without_pulse_is_kept(output_collector: OutputCollector) -> None:
    commands = [
        command("a", "beating", restarts=1, watchdog_s=1.0),
        command("silent", "obedient", restarts=1, watchdog_s=0.01),
        command("lively", "beating", restarts=1, watchdog_s=1.0),
    ]
    with Launcher(commands, output_collector) as launcher:
        first = int(output_collector.wait_for("a", "ready"))
        output_collector.wait_for("lively", "ready")
        launcher.freeze("a")
        (ended,) = launcher.wait(PATIENCE_S)
        assert (ended.name, ended.restarted) == ("a", True)
        assert re.fullmatch(r"hung: no sign of life for \d\.\d s", ended.how)
        assert str(ended).startswith("a ended (hung: no sign of life for")
        assert int(output_collector.wait_for("a", "ready")) == launcher.pid("a") != first
        assert launcher.poll() == []
        launcher.freeze("a")
        (ended,) = launcher.wait(PATIENCE_S)
        assert (ended.how[:5], ended.restarted) == ("hung:", False), "the usual restarts, no more"
        assert launcher.poll() == [], "the others are none the worse"


def test_hung_child_reports_current_function(output_collector: OutputCollector) -> None:
    with Launcher([command("a", "hanging", watchdog_s=0.5)], output_collector) as launcher:
        output_collector.wait_for("a", "ready")
        (ended,) = launcher.wait(PATIENCE_S)
    assert ended.how.startswith("hung: no sign of life for")
    where = r"stopped in round_in_circles \(stand_in\.py:\d+\), called by hanging \(stand_in\.py:\d+\), called by main .*"
    assert re.fullmatch(where, ended.last_words)


def test_grandchild_ends_with_child(output_collector: OutputCollector, pid_fds: list[int]) -> None:
    with Launcher([command("a", "family")], output_collector) as launcher:
        pid_fds.append(os.pidfd_open(int(output_collector.wait_for("a", "child"))))
        output_collector.wait_for("a", "ready")
        launcher.stop()
        assert process_ended(pid_fds[0])


def test_process_starts_after_dependency_port_is_open(output_collector: OutputCollector) -> None:
    port = free_port()
    commands = [command("first", "listen", str(port), ready_port=port), command("second", "obedient", after=("first",))]
    with Launcher(commands, output_collector) as launcher:
        pid = int(output_collector.wait_for("first", "ready"))
        assert launcher.poll() == []
        assert launcher.names() == ("first",)
        os.kill(pid, signal.SIGUSR1)
        until = time.monotonic() + PATIENCE_S
        while launcher.names() == ("first",) and time.monotonic() < until:
            launcher.wait(0.05)
        output_collector.wait_for("second", "ready")
        assert port_taken(port)


def test_stop_during_start_leaves_waiting_process_unstarted(output_collector: OutputCollector) -> None:
    port = free_port()
    with Launcher(
        [command("first", "obedient", ready_port=port), command("second", "obedient", after=("first",))], output_collector
    ) as launcher:
        output_collector.wait_for("first", "ready")
        launcher.stop()
        assert launcher.poll() == []
        assert launcher.names() == ()


DRIVER = """
import os
import sys
from sextant.deploy.terminal.interrupts import Interrupts
from sextant.deploy.launch.launcher import Launcher
from sextant.deploy.launch.process_table import Command
from sextant.shared.wire.transport import Endpoints, ZenohLink

def hear(name, line):
    sys.stdout.write(line + "\\n")
    sys.stdout.flush()

with Interrupts() as interrupts:
    with Launcher([Command("a", tuple(sys.argv[1:]), {})], hear, grace_s=600.0) as launcher:
        while not interrupts.asked():
            launcher.wait(0.02)
        launcher.stop(interrupts.insisted)
    os._exit(130)  # here, because outside of Interrupts a further signal changes the exit status
"""


def start_launcher(*words: str) -> tuple[subprocess.Popen[str], int]:
    """Start a launcher with one stand-in in a separate process.

    Returns:
        The launcher's process, and the stand-in's pidfd.
    """
    root = Path(launcher_module.__file__).parents[3]
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER, STAND_IN, *words],
        stdout=subprocess.PIPE,
        text=True,
        cwd=root,
    )
    assert driver.stdout is not None
    return driver, os.pidfd_open(int(driver.stdout.readline().split()[1]))


def test_killed_launcher_leaves_no_orphan(pid_fds: list[int]) -> None:
    driver, child = start_launcher("obedient")
    pid_fds.append(child)
    driver.kill()
    driver.communicate(timeout=PATIENCE_S)
    assert process_ended(child)


def test_killed_launcher_leaves_no_frozen_orphan(pid_fds: list[int]) -> None:
    driver, child = start_launcher("obedient")
    pid_fds.append(child)
    frozen = int(Path(f"/proc/self/fdinfo/{child}").read_text().split("Pid:")[1].split()[0])
    os.kill(frozen, signal.SIGSTOP)
    until = time.monotonic() + PATIENCE_S
    while Path(f"/proc/{frozen}/stat").read_text().rpartition(")")[2].split()[0] != "T" and time.monotonic() < until:
        assert not process_ended(child, 0.01)
    driver.kill()
    driver.communicate(timeout=PATIENCE_S)
    assert process_ended(child)


@pytest.mark.slow
@pytest.mark.parametrize("behaviour", ["obedient", "stubborn"])
def test_second_ctrl_c_kills_children_immediately(behaviour: str, pid_fds: list[int]) -> None:
    driver, child = start_launcher(behaviour)
    pid_fds.append(child)
    began = time.monotonic()
    while True:  # two signals that are pending at the same time count as one
        driver.send_signal(signal.SIGINT)
        try:
            driver.communicate(timeout=0.2)
            break
        except subprocess.TimeoutExpired:
            assert time.monotonic() - began < PATIENCE_S
    assert driver.returncode == 130
    assert process_ended(child, 0)
    assert time.monotonic() - began < PATIENCE_S


def test_last_output_of_traceback_is_exception_message() -> None:
    lines = [
        "planner: up",
        "Traceback (most recent call last):",
        '  File "planner.py", line 3, in step',
        "    raise ValueError(x)",
        "ValueError: two things:",
        "  - the first",
        "  - the second",
    ]
    assert last_words(lines) == "ValueError: two things: - the first - the second"
    assert last_words(["one", "two", "", "three", "four"]) == "two / three / four"
    assert last_words([]) == ""
    assert last_words(lines[:4]) == "raise ValueError(x)", "cut off in the middle"


def test_exit_status_description() -> None:
    assert how_it_ended(3) == "exit status 3"
    assert how_it_ended(-signal.SIGSEGV) == "killed by SIGSEGV"
    assert how_it_ended(-63) == "killed by signal 63"


def test_router_process_is_ready_with_its_port_and_ends_on_sigterm(output_collector: OutputCollector) -> None:
    port = free_port()
    made = process_table.router_command(f"tcp/127.0.0.1:{port}")
    with Launcher([made, command("user", "obedient", after=("router",))], output_collector) as launcher:
        until = time.monotonic() + PATIENCE_S
        while "user" not in launcher.names() and time.monotonic() < until:
            assert launcher.wait(0.05) == []
        with ZenohLink(Endpoints((f"tcp/127.0.0.1:{port}",))):
            pass
        router = os.pidfd_open(launcher.pid("router"))
        os.kill(launcher.pid("router"), signal.SIGTERM)
        assert process_ended(router)
        os.close(router)
        (ended,) = launcher.wait(PATIENCE_S)
        assert (ended.how, ended.restarted) == ("exit status 0", True)
