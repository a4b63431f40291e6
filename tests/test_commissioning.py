"""Run the tutorial of docs/commissioning.md as it is written.

The emulated servos run in a separate process.
"""

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.deploy.terminal.arguments import parse
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.ports import free_port
from tests.test_readme import commands

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "commissioning.md").read_text(encoding="utf-8")
TUTORIAL = TEXT[TEXT.index("## Without hardware") : TEXT.index("## With servos")]


class Emulator:
    """`sextant servos emulate` in a separate process, and its terminal."""

    def __init__(self, words: list[str]) -> None:
        command = [sys.executable, "-m", "sextant.deploy.cli", *words]
        self._process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.told = [self._line(), self._line()]

    def type(self, line: str) -> str:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        return "" if line == "quit" else self._line()

    def quit(self) -> int:
        self.type("quit")
        return self._process.wait(20)

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate()

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()


class Keyboard:
    """Standard input: lines, and what the user does before pressing Enter."""

    def isatty(self) -> bool:
        return False

    def __init__(self, lines: Iterator[str | Callable[[], str]]) -> None:
        self.lines = lines

    def readline(self) -> str:
        line = next(self.lines, "")
        return (line() if callable(line) else line) + "\n"


@pytest.fixture
def emulators() -> Iterator[list[Emulator]]:
    running: list[Emulator] = []
    yield running
    for one in running:
        one.kill()


@pytest.mark.live
def test_commissioning_tutorial_runs_as_written(
    emulators: list[Emulator], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    ports = {"5200": str(free_port()), "5201": str(free_port())}
    todo = [[re.sub("5200|5201", lambda m: ports[m[0]], word) for word in words[1:]] for words in commands(TUTORIAL)]

    def plug() -> str:
        emulators[-1].type("plug")
        return ""

    def run(words: list[str], *typed: str | Callable[[], str]) -> tuple[int, str]:
        monkeypatch.setattr(sys, "stdin", Keyboard(iter(typed)))
        status = cli.main(words)
        return status, capsys.readouterr().out

    box, set_id, again, robot, scan, calibrate, test, doctor = todo
    emulators.append(Emulator(box))
    status, told = run(set_id, plug, plug, "q")
    assert status == 1  # left before its end
    assert "servo 3 (left front femur) is set and verified: AX-12A" in told
    assert "servo 5 (left front tibia) is set" in told
    status, told = run(again, plug, "q")
    assert told.startswith("2 of 18 servos have their ids")
    assert "servo 2 (right front coxa) is set" in told
    assert emulators[-1].type("list").startswith("3 servos are plugged in: 2, 3, 5; 15 not")
    assert emulators[-1].quit() == 0

    emulators.append(Emulator(robot))
    status, told = run(scan)
    assert (status, told.splitlines()[-1]) == (0, "all 18 servos of phantomx_mk2 are in order")
    status, told = run(calibrate, *[""] * 12)
    assert (status, told.splitlines()[-1]) == (0, "6 of 6 legs calibrated; torque is off")
    own = load_profile("my_robot.toml")
    bench = BenchEmulator(load_profile("phantomx_mk2"), np.random.default_rng(3))
    np.testing.assert_allclose(own.trims, bench.robot.trims, atol=np.radians(0.3))
    assert {entry.date for entry in own.calibration} <= {date.today(), date.fromordinal(date.today().toordinal() - 1)}
    status, told = run([*test, "--leg", "left front"], "y", *"yyy", "n")
    assert status == 0, told
    assert told.endswith("torque is off\n3 of 3 joints are in order\n")
    status, told = run(doctor)
    assert "all 18 servos answer" in told
    assert "calibration: 0 days old" in told
    emulators[-1].type("unplug 9")
    status, told = run([*scan, "--ids", "5:12"])
    assert status == 1
    assert "servo 9 (left rear femur) does not answer" in told
    assert told.count("does not answer") == 1, "who was not asked is not missing"


def test_commands_of_commissioning_page_exist() -> None:
    shown = [words for words in commands(TEXT) if words[0] == "sextant"]
    inline = [line.split() for line in re.findall(r"`sextant ([^`]+)`", TEXT)]
    assert len(shown) > 6
    for words in [*(words[1:] for words in shown), *inline]:
        assert parse(cli.sextant, "sextant", words).path.startswith("sextant ")


def test_profile_of_commissioning_page_is_valid(tmp_path: Path) -> None:
    (text,) = re.findall(r"^```toml\n(.*?)^```$", TEXT, re.DOTALL | re.MULTILINE)
    (tmp_path / "own.toml").write_text(text)
    assert load_profile(str(tmp_path / "own.toml")).calibration[0].leg == "left front"
