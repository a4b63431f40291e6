"""The doctor's checks of a servo port.

They cover rights, latency, servos, voltage, temperature, calibration, and a missing port.
"""

import os
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy.doctor import servo_checks
from sextant.deploy.doctor.check import Check, Level
from sextant.services.actuator.servo_bus import usb_adapter
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.host_link import HostLink
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.robot.profile import LEGS, Calibration, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.servo_model import ServoError
from sextant.shared.wire.ports import free_port
from tests.support.families import FAMILIES, mixed_robot, robot_with
from tests.support.port_in_memory import Line

PROFILE = load_profile("phantomx_mk2")
TODAY = date(2026, 7, 30)


@pytest.fixture
def bench() -> BenchEmulator:
    return BenchEmulator(PROFILE, np.random.default_rng(1))


def run_checks(bench: BenchEmulator) -> dict[str, Check]:
    with TcpBusServer(bench) as server:
        checks = list(servo_checks.examine(server.url, "phantomx_mk2"))
    assert all(check.advice for check in checks if check.level is not Level.OK)
    return {check.name.split(" socket")[0]: check for check in checks}


def test_no_servo_port_is_ok(tmp_path: Path) -> None:
    (check,) = servo_checks.examine(None, "phantomx_mk2", tmp_path)
    assert (check.level, check.found, check.advice) == (Level.OK, "none found; a base station needs none", "")
    (tmp_path / "ttyUSB3").touch()
    (check,) = servo_checks.examine(None, "phantomx_mk2", tmp_path)
    assert check.level is Level.OK
    assert f"--port {tmp_path}/ttyUSB3 to check it" in check.found


def test_missing_port_fails(tmp_path: Path) -> None:
    (check,) = servo_checks.examine(str(tmp_path / "ttyUSB0"), "phantomx_mk2")
    assert check.level is Level.FAIL
    assert "is the adapter plugged in?" in check.advice


def test_port_without_permission_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()
    monkeypatch.setattr(os, "access", lambda *_: False)
    (check,) = servo_checks.examine(str(port), "phantomx_mk2")
    assert check.level is Level.FAIL
    assert "usermod" in check.advice


def test_closed_network_port_fails() -> None:
    check, *_ = servo_checks.examine(f"socket://127.0.0.1:{free_port()}", "phantomx_mk2")
    assert check.level is Level.FAIL
    assert "give another port" in check.advice


def test_healthy_robot_only_lacks_calibration(bench: BenchEmulator) -> None:
    checks = run_checks(bench)
    assert checks["servo port"].found == "all 18 servos answer"
    assert checks["servo voltage"].found == "12.5 V"
    assert checks["servo temperature"].found == "25 deg C"
    assert checks["latency timer"].found == "none"
    assert {name for name, check in checks.items() if check.level is not Level.OK} == {"calibration"}


def test_missing_servo_is_named_and_others_are_checked(bench: BenchEmulator) -> None:
    bench.unplug(bench._with_id(9))
    checks = run_checks(bench)
    assert checks["servo port"].level is Level.FAIL
    assert checks["servo port"].found == "servo 9 (left rear femur) does not answer, but the servo behind it does"
    assert checks["servo voltage"].level is Level.OK


def test_no_answering_servos_is_reported_once(bench: BenchEmulator) -> None:
    bench.unplug(range(18))
    checks = run_checks(bench)
    assert checks["servo port"].found == "none of 18 servos answers"
    assert "servo voltage" not in checks


@pytest.mark.parametrize("name", FAMILIES)
def test_echoing_adapter_warns_and_servos_are_still_checked(name: str) -> None:
    profile = robot_with(name)
    with TcpBusServer(BenchEmulator(profile, np.random.default_rng(1), echo=True)) as server:
        first, second, *_ = servo_checks.servos(server.url, profile)
    assert (first.level, first.found) == (Level.WARN, "the adapter returns every byte that is sent")
    assert "--set actuator.echo=true" in first.advice
    assert second.found == "all 18 servos answer"


def at_bridge(board: HostLink, profile: RobotProfile, monkeypatch: pytest.MonkeyPatch) -> list[Check]:
    line = Line(board, monkeypatch)
    monkeypatch.setattr(servo_checks, "time", line)
    checks = list(servo_checks.at_bridge(line.URL, profile))
    assert all(check.advice for check in checks if check.level is not Level.OK)
    return checks


@pytest.mark.parametrize("name", FAMILIES)
def test_servos_behind_a_bridge_are_checked_as_on_a_bus(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    profile = robot_with(name)
    emulated = BenchEmulator(profile, np.random.default_rng(1))
    torque = emulated._servos.column(emulated._servos.table.torque_enable)
    torque[:] = 1
    emulated.unplug(emulated._with_id(9))
    missing, voltage, *_ = at_bridge(Board(emulated, model=profile.servo_model), profile, monkeypatch)
    assert (missing.level, voltage.level) == (Level.FAIL, Level.OK)
    assert missing.found == "servo 9 (right middle tibia) does not answer"
    assert torque.all(), "nothing is written"


def test_hobby_servos_behind_a_bridge_are_not_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    profile = load_profile("printed_ds3218")
    pulses = profile.servo.pulses
    assert pulses is not None
    bank = make_servo_bank(profile.servo, list(profile.servo_names), np.zeros(18))
    board = Board(make_board(bank, pulses, on_uart=True), model=bank.model, pulses=pulses)
    found, feedback = at_bridge(board, profile, monkeypatch)
    assert (found.level, found.found) == (Level.OK, "the board answers; it sends pulses on 0 of 18 channels")
    assert feedback.level is Level.WARN


def test_missing_and_other_bridges_are_reported(bench: BenchEmulator, monkeypatch: pytest.MonkeyPatch) -> None:
    (silent,) = at_bridge(bench, PROFILE, monkeypatch)
    assert "no bridge answers on the port" in silent.found
    (other,) = at_bridge(Board(bench), load_profile("printed_sts3215"), monkeypatch)
    assert "the bridge drives servos AX-12A, the profile has STS3215" in other.found
    assert "cable" in silent.advice
    assert "cable" not in other.advice
    (several,) = at_bridge(Board(bench), mixed_robot("AX-12A", "MX-28", "AX-12A"), monkeypatch)
    assert "one servo model and one bus behind a bridge expected" in several.found


def test_low_voltage_high_temperature_and_overload_are_reported(bench: BenchEmulator) -> None:
    bench._servos.charge = 0.1
    bench._servos.temperature[bench._with_id(6)] = 66.0
    bench._servos._latched_errors[bench._with_id(17)] = ServoError.OVERLOAD
    checks = run_checks(bench)
    assert checks["servo voltage"].level is Level.WARN
    assert "at least 10.5 V" in checks["servo voltage"].advice
    assert checks["servo temperature"].found == "25 to 66 deg C; near their limit: servo 6 (right front tibia)"
    assert checks["servo errors"].level is Level.FAIL
    assert checks["servo errors"].found == "servo 17 (left middle tibia) reports overload"


def test_slow_latency_timer_warns_with_fix_command(tmp_path: Path) -> None:
    timer = tmp_path / "ttyUSB0" / "latency_timer"
    timer.parent.mkdir()
    timer.write_text("16\n")
    check = servo_checks.latency("/dev/ttyUSB0", tmp_path)
    assert (check.level, check.found) == (Level.WARN, "16 ms")
    assert "sudo tee" in check.advice
    timer.write_text("1\n")
    assert servo_checks.latency("/dev/ttyUSB0", tmp_path) == Check("latency timer", Level.OK, "1 ms")


def test_adapter_is_named_with_its_latency_timer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(usb_adapter, "name_of", lambda url: "FT232R USB UART (0403:6001)")
    check = servo_checks.latency("/dev/ttyUSB0", tmp_path)
    assert check == Check("latency timer", Level.OK, "none; the adapter is FT232R USB UART (0403:6001)")


def test_port_of_a_bus_that_the_robot_does_not_have_fails(bench: BenchEmulator) -> None:
    with TcpBusServer(bench) as server:
        (check,) = servo_checks.examine(f"left={server.url}", "phantomx_mk2")
    assert check.level is Level.FAIL
    assert check.found == "a port without the name of a bus expected, found left=...: the robot has one bus"
    assert check.advice == "give the port alone with --port"


@pytest.mark.parametrize(("days", "level"), [(0, Level.OK), (180, Level.OK), (181, Level.WARN)])
def test_calibration_age_is_that_of_oldest_leg(days: int, level: Level) -> None:
    entries = [Calibration(leg, TODAY, (0.0, 0.0, 0.0)) for leg in LEGS[1:]]
    old = Calibration(LEGS[0], TODAY - timedelta(days), (0.0, 0.0, 0.0))
    check = servo_checks.calibration(replace(PROFILE, calibration=(*entries, old)), TODAY)
    assert (check.level, check.found) == (level, f"{days} days old")


def test_uncalibrated_legs_are_named() -> None:
    check = servo_checks.calibration(PROFILE, TODAY)
    assert check.level is Level.WARN
    assert "none in the profile phantomx_mk2" in check.found
    robot = replace(PROFILE, calibration=(Calibration(LEGS[0], TODAY, (0.0, 0.0, 0.0)),))
    check = servo_checks.calibration(robot, TODAY)
    assert check.level is Level.WARN
    assert check.found == f"0 days old; missing: {', '.join(LEGS[1:])}"


def test_enabled_torque_is_reported_as_ok(bench: BenchEmulator) -> None:
    bench._servos.tables[:, dxl.TORQUE_ENABLE.address] = 1
    check = run_checks(bench)["servo port"]
    assert (check.level, check.found) == (Level.OK, "all 18 servos answer; torque is on at 18 of them")


def test_what_all_servos_have_in_common_is_reported_once(bench: BenchEmulator) -> None:
    bench._servos._latched_errors[:] = ServoError.OVERLOAD
    for row in range(18):
        bench._servos.write(row, dxl.SHUTDOWN.address, b"\x04")
    checks = run_checks(bench)
    assert checks["servo errors"].found.startswith("each of the 18 servos reports overload")
    assert checks["servo settings"].found == "each of the 18 servos does not shut down for overload"


def test_changed_shutdown_settings_warn(bench: BenchEmulator) -> None:
    bench._servos.write(bench._with_id(6)[0], dxl.SHUTDOWN.address, b"\0")
    checks = run_checks(bench)
    assert checks["servo port"].level is Level.OK
    assert checks["servo settings"].level is Level.WARN
    assert checks["servo settings"].found == "servo 6 (right front tibia) does not shut down for overheating, overload"
