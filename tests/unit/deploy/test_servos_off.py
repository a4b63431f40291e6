"""`sextant servos off` where the servos are not as the profile states them, or another device is on the port."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.deploy.commands import servos_off
from sextant.services.actuator.servo_bus.bus_scan import ECHO
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.pulse_bench import PulseBench
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profile_text import write_new_profile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import pwm
from tests.support.families import FAMILIES, robot_with
from tests.support.port_in_memory import Line, OtherDevice

GPS = b"$GPGGA,120000.00,4717.11,N\r\n"
PAIRS = [(there, expected) for there in FAMILIES for expected in ("AX-12A", "STS3215", "XL430-W250", "LX-16A")]


@pytest.fixture(autouse=True)
def no_latch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(servos_off, "_latch", lambda port: "")


def standing(name: str, *, echo: bool = False) -> BenchEmulator:
    """Return the servos of a robot of a model, with torque."""
    bench = BenchEmulator(robot_with(name), np.random.default_rng(1000), echo=echo)
    table = bench._servos.table
    for row in range(18):
        bench._servos.write(row, table.torque_enable.address, b"\x01")
    return bench


def pulling(bench: BenchEmulator) -> int:
    """Return the number of servos with torque."""
    return int(np.count_nonzero(bench._servos.column(bench._servos.table.torque_enable)))


def off(line: Line, *words: str) -> int:
    """Run the command, then let the written data arrive."""
    status = cli.main(["servos", "off", "--port", line.URL, *words])
    bench = line._device
    if isinstance(bench, BenchEmulator):
        bench.receive(b"", line.monotonic_ns() + 100_000_000)
    return status


@pytest.mark.parametrize(("there", "expected"), PAIRS)
def test_torque_off_reaches_servos_of_any_family_under_any_profile(
    there: str, expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench, robot = standing(there), tmp_path / "robot.toml"
    write_new_profile(robot, robot_with(expected))
    assert pulling(bench) == 18
    assert off(Line(bench, monkeypatch), "--robot", str(robot)) == 0
    assert pulling(bench) == 0
    assert "torque is off: confirmed by 18 of 18 servos" in capsys.readouterr().out


def test_family_is_named_with_what_to_do(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert off(Line(standing("LX-16A"), monkeypatch)) == 0
    assert capsys.readouterr().out.splitlines() == [
        "servo 1 is LX-16A or HX-35H (LewanSoul) at 115200 baud, AX-12A expected",
        "  -> give --robot your_robot.toml, a profile with these servos; `sextant robot new` makes one",
        "torque is off: confirmed by 18 of 18 servos",
    ]


def test_servo_of_another_family_that_does_not_answer_is_counted(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = standing("LX-16A")
    bench.unplug(bench._with_id(9))
    assert off(Line(bench, monkeypatch)) == 1
    told = capsys.readouterr().out
    assert "servo 9 (left rear femur) does not answer" in told
    assert told.endswith("17 of 18 servos confirm torque off\n")
    assert pulling(bench) == 1


@pytest.mark.parametrize("name", ["XL430-W250", "LX-16A"])
def test_echo_is_reported_and_torque_turned_off_nevertheless(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = standing(name, echo=True)
    assert off(Line(bench, monkeypatch)) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"{ECHO.words}\n  -> {ECHO.advice}\n")
    assert "torque is off: confirmed by 18 of 18 servos" in told
    assert pulling(bench) == 0


@pytest.mark.parametrize("words", [(), ("--robot", "printed_ds3218"), ("--robot", "jethexa_hx35h")])
def test_another_device_is_named(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert off(Line(OtherDevice(GPS), monkeypatch), *words) == 1
    told = capsys.readouterr().err
    assert told.startswith("torque off is not confirmed")
    assert "another device sends '$GPGGA,120000.00" in told
    assert "Maestro" not in told


def test_bus_servos_under_a_profile_of_hobby_servos(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = standing("AX-12A")
    assert off(Line(bench, monkeypatch), "--robot", "printed_ds3218") == 1, "those of the profile are elsewhere"
    told = capsys.readouterr()
    assert "servo 1 is AX-12A (Dynamixel Protocol 1.0) at 1000000 baud, hobby servos expected" in told.out
    assert "18 of 18 servos that answer on" in told.out
    assert "no Maestro answers" in told.err
    assert pulling(bench) == 0


def test_servos_without_the_bridge_of_the_option(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    bench = standing("AX-12A")
    assert off(Line(bench, monkeypatch), "--bridge") == 0
    told = capsys.readouterr()
    assert "no bridge answers on the port" in told.err
    assert "torque is off: confirmed by 18 of 18 servos" in told.out
    assert pulling(bench) == 0


def test_servos_with_commands_behind_a_bridge(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = standing("HX-35H")
    line = Line(Board(bench, model=bench._servos.model), monkeypatch)
    assert off(line, "--bridge", "--robot", "jethexa_hx35h") == 0
    bench.receive(b"", line.monotonic_ns() + 100_000_000)
    assert pulling(bench) == 0


@pytest.mark.parametrize("name", ["pca9685", "maestro"])
def test_hobby_servos_behind_a_bridge(
    name: pwm.Board, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    profile = load_profile("printed_ds3218")
    assert profile.servo.pulses is not None
    pulses = replace(profile.servo.pulses, board=name)
    own = replace(profile, servo=replace(profile.servo, pulses=pulses))
    write_new_profile(tmp_path / "own.toml", own)
    bank = make_servo_bank(own.servo, list(own.servo_names), np.zeros(18))
    torque = bank.column(bank.table.torque_enable)
    torque[:] = 1
    board = Board(make_board(bank, pulses, on_uart=True), model=bank.model, pulses=pulses)
    line = Line(board, monkeypatch)
    assert off(line, "--bridge", "--robot", str(tmp_path / "own.toml")) == 0
    board.advance(line.monotonic_ns() + 40_000_000)
    assert not torque.any()
    assert "torque is off: confirmed by 18 of 18 servos" in capsys.readouterr().out


def test_missing_bridge_is_reported(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    bench = standing("AX-12A")
    bench.unplug(range(18))
    assert off(Line(bench, monkeypatch), "--bridge") == 1
    told = capsys.readouterr().err
    assert "torque off is not confirmed" in told
    assert "no bridge answers on the port" in told


@pytest.mark.parametrize("words", [("find", "1", "--yes"), ("find", "1", "--yes", "--robot", "printed_ds3218")])
def test_find_names_another_device(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = Line(OtherDevice(GPS), monkeypatch)
    assert cli.main(["servos", *words, "--port", line.URL]) == 1
    assert "another device sends '$GPGGA" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["scan", "test", "centre"])
def test_bus_servos_in_place_of_a_maestro_are_named(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = Line(standing("STS3215"), monkeypatch)
    words = ["4"] if command == "centre" else []
    assert cli.main(["servos", command, *words, "--port", line.URL, "--robot", "printed_ds3218"]) == 1
    told = capsys.readouterr().err
    assert "servo 1 is STS3215 (Feetech STS) at 1000000 baud, hobby servos expected" in told
    assert "Maestro" not in told


@pytest.mark.parametrize("robot", ["phantomx_mk2", "printed_sts3215", "jethexa_hx35h"])
def test_hobby_servos_under_a_profile_of_bus_servos(
    robot: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = PulseBench(load_profile("printed_ds3218"))
    bench._servos.column(bench._servos.table.torque_enable)[:] = 1
    line = Line(bench, monkeypatch)
    assert off(line, "--robot", robot) == 1, "what the profile states is elsewhere"
    told = capsys.readouterr().err
    assert f"a Pololu Maestro answers, {load_profile(robot).servo_model.name} expected: its pulses have ended" in told
    assert "a profile with hobby servos" in told
    bench.receive(b"", line.monotonic_ns() + 100_000_000)
    assert bench.execute("list") == "0 of 18 servos have pulses: none"
    assert cli.main(["servos", "scan", "--port", line.URL, "--robot", robot]) == 1
    assert "a Pololu Maestro answers" in capsys.readouterr().out


def test_servo_packets_are_not_sent_to_an_i2c_board(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    profile = load_profile("printed_ds3218")
    assert profile.servo.pulses is not None
    own = replace(profile, servo=replace(profile.servo, pulses=replace(profile.servo.pulses, board="pca9685")))
    write_new_profile(tmp_path / "own.toml", own)
    bench = standing("AX-12A")
    assert off(Line(bench, monkeypatch), "--robot", str(tmp_path / "own.toml")) == 1
    assert not bench.counts.instructions
