"""The path of a builder with each servo family, by commands alone: from measures and a box of servos to a robot that walks.

A profile from measures, its check, ids, scan, calibration, joint test and doctor; then a walk on level ground. The servos are
emulated in memory, and their virtual time is the clock of the commands.
"""

import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.deploy.commands import pulse_servos, servo_port, servos
from sextant.deploy.doctor import servo_checks
from sextant.evaluation.robot_check import robot_check
from sextant.services.actuator.commissioning import pulse_commissioning
from sextant.services.actuator.servo_bus import bus_driver
from sextant.services.actuator.servo_bus.serial_port import REPLY_TIMEOUT_NS, Port
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator, make_bench
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.pulse_bench import PulseBench
from sextant.shared.robot.profiles import load_profile
from tests.support.commands import write_course
from tests.support.families import FAMILIES
from tests.support.quick_doctor import make_doctor_quick

MEASURES = {"coxa": 0.05, "femur": 0.07, "tibia": 0.12, "front": 0.11, "side": 0.06, "middle": 0.09}  # [m]
MASSES = {"SCS0009": 0.5, "XL-320": 0.9, "LX-16A": 2.0}  # [kg] that the servos can carry, 2.2 by default
PORT = ("--port", "socket://127.0.0.1:1")
PCA9685 = """
[servo]
model = "PWM"
stall_torque = 2.11
no_load_speed = 7.48
stiffness = 20.0
armature = 0.012
friction = 0.06
[servo.pulses]
board = "pca9685"
us_per_rad = 424.4
[battery]
warn_voltage = 6.4
empty_voltage = 6.2
"""
SERVOS = (*FAMILIES, "printed_ds3218", "pca9685.toml")


class Workshop:
    """The builder's bench, keyboard and clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self.bench: BenchEmulator | PulseBench | None = None
        self._capsys, self._port, self._slept_ns = capsys, None, 0
        self._port: MemoryPort | None
        self._answers: Iterator[str | Callable[[], str]] = iter(())
        for module in (servos, servo_port, servo_checks, pulse_servos):
            monkeypatch.setattr(module, "time", self)
        for module in (bus_driver, pulse_commissioning):
            monkeypatch.setattr(module, "open_port", self.open)
        monkeypatch.setattr(sys, "stdin", self)

    def run(self, *words: str, answers: tuple[str | Callable[[], str], ...] = (), status: int = 0) -> str:
        """Run a command, and return what it prints."""
        self._answers = iter(answers)
        found = cli.main(list(words))
        printed = self._capsys.readouterr()
        assert found == status, f"{' '.join(words)}: {printed.out[-2000:]}{printed.err[-2000:]}"
        return printed.out

    def isatty(self) -> bool:
        return False

    def readline(self) -> str:
        line = next(self._answers, "q")
        return (line() if callable(line) else line) + "\n"

    def monotonic_ns(self) -> int:
        return (0 if self._port is None else self._port.now_ns()) + self._slept_ns

    def sleep(self, seconds: float) -> None:
        self._slept_ns += round(seconds * 1e9)

    def open(self, url: str, baud_rate: int = 1_000_000, timeout_ns: int = REPLY_TIMEOUT_NS) -> Port:
        assert (url, self.bench is None) == (PORT[1], False)
        self._port = MemoryPort(self.bench, lambda: 0, timeout=timeout_ns * 1e-9, start_ns=self.monotonic_ns())
        self._slept_ns = 0
        return self._port


@pytest.fixture
def workshop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Workshop:
    monkeypatch.chdir(tmp_path)
    make_doctor_quick(monkeypatch)
    Path("pca9685.toml").write_text(PCA9685, encoding="utf-8")
    return Workshop(monkeypatch, capsys)


def build(workshop: Workshop, servo: str) -> None:
    """Make `robot.toml`, and commission its servos as `mine.toml`."""
    mass = MASSES.get(servo, 2.2)
    measures = [word for name, value in (MEASURES | {"mass": mass}).items() for word in (f"--{name}", str(value))]
    assert "robot.toml: passes the check" in workshop.run("robot", "new", "--out", "robot.toml", "--servo", servo, *measures)
    assert workshop.run("robot", "check", "robot.toml").startswith("robot: passes\n")
    profile, rng, robot = load_profile("robot.toml"), np.random.default_rng(3), ("--robot", "robot.toml", *PORT)

    workshop.bench = box = make_bench(profile, rng, fresh=True)
    if isinstance(box, BenchEmulator):

        def plug() -> str:
            box.plug(box.unplugged[:1])
            return ""

        told = workshop.run("servos", "set-id", *robot, answers=(plug,) * 18)
        assert told.count("is set and verified") == 18, told
    else:
        workshop.run("servos", "set-id", *robot, status=1)
        workshop.run("servos", "centre", "4", *robot, answers=("y", ""))

    told = workshop.run("servos", "scan", *robot)
    assert re.search("all 18 servos of robot are in order|the board answers", told), told

    workshop.bench = make_bench(profile, rng)  # assembled, with horns that are some degrees off
    answers = ("",) * 12 if isinstance(box, BenchEmulator) else ("y", "1", "", "", "") * 6
    told = workshop.run("servos", "calibrate", *robot, "--out", "mine.toml", answers=answers)
    assert told.endswith("6 of 6 legs calibrated; torque is off\n"), told
    mine = load_profile("mine.toml")
    if isinstance(workshop.bench, BenchEmulator):
        np.testing.assert_allclose(mine.trims, workshop.bench.robot.trims, atol=np.radians(0.5))
    mine_at = ("--robot", "mine.toml", *PORT)
    assert re.search(
        r"3 of 3 joints turn and return|torque is off\na wrong direction or a wrong id shows only without --yes",
        workshop.run("servos", "test", *mine_at, "--leg", "left front", "--yes"),
    )

    checks = {check["name"]: check for check in json.loads(workshop.run("doctor", *mine_at, "--json"))}
    assert re.match("all 18 servos answer|the board answers", checks[f"servo port {PORT[1]}"]["found"])
    assert "servo settings" not in checks, checks["servo settings"]
    assert checks["calibration"]["found"] == "0 days old"
    assert checks["control cycle"]["found"].startswith("takes")


@pytest.mark.slow
@pytest.mark.parametrize("servo", SERVOS)
def test_servos_are_commissioned(servo: str, workshop: Workshop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_check, "_ground", lambda *_: ())  # which does not depend on the servos
    build(workshop, servo)


@pytest.mark.rare
@pytest.mark.parametrize("servo", SERVOS)
def test_commissioned_robot_walks(servo: str, workshop: Workshop, tmp_path: Path) -> None:
    build(workshop, servo)
    course = str(write_course(tmp_path, "level", 0.4))
    told = workshop.run("run", course, "--lockstep", "--seed", "1000", "--robot", "mine.toml", "--json", "--out", "run")
    assert json.loads(told)["success"] is True
