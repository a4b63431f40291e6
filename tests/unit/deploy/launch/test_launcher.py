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
from sextant.deploy.launch.launcher import Ended, Launcher, free_port, how_it_ended, last_words, port_taken
from sextant.deploy.launch.process_table import Command
from sextant.shared.wire.transport import Endpoints, ZenohLink

STAND_IN = str(Path(__file__).parents[3] / "support" / "stand_in.py")
PATIENCE_S = 20.0  # for a busy machine; a test that passes does not wait that long


class Ear:
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


def gone(pid_fd: int, timeout_s: float = PATIENCE_S) -> bool:
    """Return whether the process behind a pidfd ends within a time [s]."""
    return bool(select.select([pid_fd], [], [], timeout_s)[0])


@pytest.fixture
def ear() -> Ear:
    return Ear()


@pytest.fixture
def watched() -> Iterator[list[int]]:
    fds: list[int] = []
    yield fds
    for fd in fds:
        os.close(fd)


def test_all_start_and_all_are_gone_after_the_stop(ear: Ear, watched: list[int]) -> None:
    with Launcher([command("a", "obedient"), command("b", "obedient")], ear, grace_s=PATIENCE_S) as launcher:
        for name in ("a", "b"):
            assert int(ear.wait_for(name, "ready")) == launcher.pid(name)
            watched.append(os.pidfd_open(launcher.pid(name)))
            assert os.getpgid(launcher.pid(name)) == launcher.pid(name), "the terminal's Ctrl-C must not reach a child"
        assert launcher.poll() == []
        assert launcher.stop() == []
    assert all(gone(fd, 0) for fd in watched)


def test_a_dead_child_is_named_with_its_last_words_and_started_again_as_often_as_the_table_says(ear: Ear) -> None:
    with Launcher([command("a", "crash", "no more ground", restarts=1), command("b", "obedient")], ear) as launcher:
        endings = []
        for _ in range(2):
            os.kill(int(ear.wait_for("a", "ready")), signal.SIGUSR1)
            endings += launcher.wait(PATIENCE_S)
        assert endings == [
            Ended("a", "exit status 1", "RuntimeError: no more ground", restarted=True),
            Ended("a", "exit status 1", "RuntimeError: no more ground", restarted=False),
        ]
        assert str(endings[0]) == "a ended (exit status 1); last output: RuntimeError: no more ground; started again"
        assert launcher.poll() == [], "an end is reported once"


def test_a_process_that_stayed_up_has_all_of_its_restarts_again(ear: Ear, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launcher_module, "STAYED_UP_S", 0.0)
    with Launcher([command("a", "crash", "no more ground", restarts=1)], ear) as launcher:
        for _ in range(3):
            os.kill(int(ear.wait_for("a", "ready")), signal.SIGUSR1)
            (ended,) = launcher.wait(PATIENCE_S)
            assert ended.restarted


def test_it_waits_until_what_others_need_is_ready(ear: Ear) -> None:
    with Launcher([command("a", "obedient"), command("b", "obedient", after=("a",))], ear) as launcher:
        assert launcher.wait_for_start(PATIENCE_S)
        assert launcher.names() == ("a", "b")
    with Launcher([command("a", "obedient", ready_port=1), command("b", "obedient", after=("a",))], ear) as launcher:
        assert not launcher.wait_for_start(0.1)


def test_what_was_started_wrongly_is_not_started_again(ear: Ear) -> None:
    with Launcher([command("a", "refuse", "no port given", restarts=5)], ear) as launcher:
        assert launcher.wait(PATIENCE_S) == [Ended("a", "exit status 2", "no port given", restarted=False)]


def test_a_kill_is_told_by_its_signal_and_the_process_comes_back(ear: Ear) -> None:
    with Launcher([command("a", "obedient", restarts=1)], ear) as launcher:
        first = int(ear.wait_for("a", "ready"))
        launcher.kill("a")
        (ended,) = launcher.wait(PATIENCE_S)
        assert ended.how == "killed by SIGKILL"
        assert ended.restarted
        assert int(ear.wait_for("a", "ready")) == launcher.pid("a") != first


def test_who_does_not_listen_is_killed_in_bounded_time(ear: Ear, watched: list[int]) -> None:
    with Launcher([command("a", "stubborn"), command("b", "obedient")], ear, grace_s=0.1) as launcher:
        ear.wait_for("a", "ready")
        watched += [os.pidfd_open(launcher.pid(name)) for name in ("a", "b")]
        assert "a" in launcher.stop()
        assert all(gone(fd, 0) for fd in watched)


def test_who_needs_another_ends_before_it(ear: Ear, watched: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    with Launcher(
        [command("bus", "listen", str(port), ready_port=port), command("user", "obedient", after=("bus",))],
        ear,
        grace_s=2 * PATIENCE_S,
    ) as launcher:
        os.kill(int(ear.wait_for("bus", "ready")), signal.SIGUSR1)
        until = time.monotonic() + PATIENCE_S
        while "user" not in launcher.names() and time.monotonic() < until:
            launcher.wait(0.05)
        ear.wait_for("user", "ready")
        user = os.pidfd_open(launcher.pid("user"))
        watched.append(user)
        before: list[bool] = []

        def ask(child: launcher_module._Child, number: signal.Signals) -> None:
            if child.command.name == "bus" and number == signal.SIGTERM:
                before.append(gone(user, 0))
            send(child, number)

        send = launcher_module._signal
        monkeypatch.setattr(launcher_module, "_signal", ask)
        launcher.stop()
        assert before == [True]


def test_no_port_is_given_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Never return one port twice, although nothing listens on it yet."""
    monkeypatch.setattr(launcher_module, "_PORTS", range(20_000, 20_040))
    monkeypatch.setattr(launcher_module, "port_taken", lambda _: False)
    given = [free_port() for _ in range(20)]
    assert len(set(given)) == len(given)


def test_nobody_is_asked_twice(ear: Ear) -> None:
    """Send SIGTERM to a child only once.

    A launcher takes a second signal as the operator's insistence, and kills its children.
    """
    with Launcher([command("a", "counting"), command("b", "counting", after=("a",))], ear, grace_s=PATIENCE_S) as launcher:
        for name in ("a", "b"):
            ear.wait_for(name, "ready")
        assert launcher.stop() == []
    assert [ear.wait_for(name, "asked") for name in ("a", "b")] == ["1", "1"]


def test_asking_twice_kills_at_once(ear: Ear, watched: list[int]) -> None:
    with Launcher([command("a", "stubborn")], ear, grace_s=1e6) as launcher:
        ear.wait_for("a", "ready")
        watched.append(os.pidfd_open(launcher.pid("a")))
        assert launcher.stop(insisted=lambda: True) == ["a"]
        assert gone(watched[0], 0)


def test_a_frozen_child_ends_with_the_others(ear: Ear, watched: list[int]) -> None:
    with Launcher([command("a", "obedient")], ear, grace_s=PATIENCE_S) as launcher:
        ear.wait_for("a", "ready")
        watched.append(os.pidfd_open(launcher.pid("a")))
        launcher.freeze("a")
        assert launcher.poll() == [], "frozen is not dead"
        assert launcher.stop() == [], "it was thawed to hear that it shall end"
        assert gone(watched[0], 0)


def test_a_child_that_hangs_is_killed_and_started_again_and_one_that_never_beat_is_left_alone(ear: Ear) -> None:
    commands = [
        command("a", "beating", restarts=1, watchdog_s=1.0),
        command("silent", "obedient", restarts=1, watchdog_s=0.01),
        command("lively", "beating", restarts=1, watchdog_s=1.0),
    ]
    with Launcher(commands, ear) as launcher:
        first = int(ear.wait_for("a", "ready"))
        ear.wait_for("lively", "ready")
        launcher.freeze("a")
        (ended,) = launcher.wait(PATIENCE_S)
        assert (ended.name, ended.restarted) == ("a", True)
        assert re.fullmatch(r"hung: no sign of life for \d\.\d s", ended.how)
        assert str(ended).startswith("a ended (hung: no sign of life for")
        assert int(ear.wait_for("a", "ready")) == launcher.pid("a") != first
        assert launcher.poll() == []
        launcher.freeze("a")
        (ended,) = launcher.wait(PATIENCE_S)
        assert (ended.how[:5], ended.restarted) == ("hung:", False), "the usual restarts, no more"
        assert launcher.poll() == [], "the others are none the worse"


def test_a_child_that_hangs_tells_in_which_function_it_was(ear: Ear) -> None:
    with Launcher([command("a", "hanging", watchdog_s=0.5)], ear) as launcher:
        ear.wait_for("a", "ready")
        (ended,) = launcher.wait(PATIENCE_S)
    assert ended.how.startswith("hung: no sign of life for")
    where = r"stopped in round_in_circles \(stand_in\.py:\d+\), called by hanging \(stand_in\.py:\d+\), called by main .*"
    assert re.fullmatch(where, ended.last_words)


def test_what_a_child_has_started_goes_with_it(ear: Ear, watched: list[int]) -> None:
    with Launcher([command("a", "family")], ear) as launcher:
        watched.append(os.pidfd_open(int(ear.wait_for("a", "child"))))
        ear.wait_for("a", "ready")
        launcher.stop()
        assert gone(watched[0])


def test_a_process_waits_for_what_it_needs_to_be_ready(ear: Ear) -> None:
    port = free_port()
    commands = [command("first", "listen", str(port), ready_port=port), command("second", "obedient", after=("first",))]
    with Launcher(commands, ear) as launcher:
        pid = int(ear.wait_for("first", "ready"))
        assert launcher.poll() == []
        assert launcher.names() == ("first",)
        os.kill(pid, signal.SIGUSR1)
        until = time.monotonic() + PATIENCE_S
        while launcher.names() == ("first",) and time.monotonic() < until:
            launcher.wait(0.05)
        ear.wait_for("second", "ready")
        assert port_taken(port)


def test_a_stop_in_between_leaves_what_waits_unstarted(ear: Ear) -> None:
    port = free_port()
    with Launcher(
        [command("first", "obedient", ready_port=port), command("second", "obedient", after=("first",))], ear
    ) as launcher:
        ear.wait_for("first", "ready")
        launcher.stop()
        assert launcher.poll() == []
        assert launcher.names() == ()


DRIVER = """
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
sys.exit(130)
"""


def drive(*words: str) -> tuple[subprocess.Popen[str], int]:
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


def test_no_orphan_when_the_launcher_is_killed(watched: list[int]) -> None:
    driver, child = drive("obedient")
    watched.append(child)
    driver.kill()
    driver.communicate(timeout=PATIENCE_S)
    assert gone(child)


def test_a_frozen_child_is_no_orphan_either(watched: list[int]) -> None:
    driver, child = drive("obedient")
    watched.append(child)
    frozen = int(Path(f"/proc/self/fdinfo/{child}").read_text().split("Pid:")[1].split()[0])
    os.kill(frozen, signal.SIGSTOP)
    until = time.monotonic() + PATIENCE_S
    while Path(f"/proc/{frozen}/stat").read_text().rpartition(")")[2].split()[0] != "T" and time.monotonic() < until:
        assert not gone(child, 0.01)
    driver.kill()
    driver.communicate(timeout=PATIENCE_S)
    assert gone(child)


@pytest.mark.parametrize("behaviour", ["obedient", "stubborn"])
def test_ctrl_c_twice_ends_everything_without_waiting(behaviour: str, watched: list[int]) -> None:
    driver, child = drive(behaviour)
    watched.append(child)
    began = time.monotonic()
    while True:  # two signals that are pending at the same time count as one
        driver.send_signal(signal.SIGINT)
        try:
            driver.communicate(timeout=0.2)
            break
        except subprocess.TimeoutExpired:
            assert time.monotonic() - began < PATIENCE_S
    assert driver.returncode == 130
    assert gone(child, 0)
    assert time.monotonic() - began < PATIENCE_S


def test_last_words_of_a_traceback_are_its_message() -> None:
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


def test_an_exit_status_in_words() -> None:
    assert how_it_ended(3) == "exit status 3"
    assert how_it_ended(-signal.SIGSEGV) == "killed by SIGSEGV"
    assert how_it_ended(-63) == "killed by signal 63"


def test_free_ports_are_free() -> None:
    assert not port_taken(free_port())


def test_the_router_as_a_process_is_ready_when_its_port_is_taken_and_ends_when_asked(ear: Ear) -> None:
    port = free_port()
    made = process_table.router_command(f"tcp/127.0.0.1:{port}")
    with Launcher([made, command("user", "obedient", after=("router",))], ear) as launcher:
        until = time.monotonic() + PATIENCE_S
        while "user" not in launcher.names() and time.monotonic() < until:
            assert launcher.wait(0.05) == []
        with ZenohLink(Endpoints((f"tcp/127.0.0.1:{port}",))):
            pass
        router = os.pidfd_open(launcher.pid("router"))
        os.kill(launcher.pid("router"), signal.SIGTERM)
        assert gone(router)
        os.close(router)
        (ended,) = launcher.wait(PATIENCE_S)
        assert (ended.how, ended.restarted) == ("exit status 0", True)
