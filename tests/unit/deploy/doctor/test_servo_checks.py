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
from sextant.deploy.launch.launcher import free_port
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.robot.profile import LEGS, Calibration
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl

PROFILE = load_profile("phantomx_mk2")
TODAY = date(2026, 7, 30)


@pytest.fixture
def bench() -> BenchEmulator:
    return BenchEmulator(PROFILE, np.random.default_rng(1))


def examined(bench: BenchEmulator) -> dict[str, Check]:
    with TcpBusServer(bench) as server:
        checks = list(servo_checks.examine(server.url, "phantomx_mk2"))
    assert all(check.advice for check in checks if check.level is not Level.OK)
    return {check.name.split(" socket")[0]: check for check in checks}


def test_without_a_port_one_line_says_so_and_is_green(tmp_path: Path) -> None:
    (check,) = servo_checks.examine(None, "phantomx_mk2", tmp_path)
    assert (check.level, check.found, check.advice) == (Level.OK, "none found; a base station needs none", "")
    (tmp_path / "ttyUSB3").touch()
    (check,) = servo_checks.examine(None, "phantomx_mk2", tmp_path)
    assert check.level is Level.OK
    assert f"--port {tmp_path}/ttyUSB3 to check it" in check.found


def test_a_port_that_is_not_there(tmp_path: Path) -> None:
    (check,) = servo_checks.examine(str(tmp_path / "ttyUSB0"), "phantomx_mk2")
    assert check.level is Level.FAIL
    assert "plug the adapter in" in check.advice


def test_a_port_without_rights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()
    monkeypatch.setattr(os, "access", lambda *_: False)
    (check,) = servo_checks.examine(str(port), "phantomx_mk2")
    assert check.level is Level.FAIL
    assert "usermod" in check.advice


def test_a_network_port_where_nobody_listens() -> None:
    check, *_ = servo_checks.examine(f"socket://127.0.0.1:{free_port()}", "phantomx_mk2")
    assert check.level is Level.FAIL
    assert "give another port" in check.advice


def test_a_robot_in_order_lacks_nothing_but_a_calibration(bench: BenchEmulator) -> None:
    checks = examined(bench)
    assert checks["servo port"].found == "all 18 servos answer"
    assert checks["servo voltage"].found == "12.5 to 12.5 V"
    assert checks["servo temperature"].found == "25 to 25 deg C"
    assert checks["latency timer"].found == "none"
    assert {name for name, check in checks.items() if check.level is not Level.OK} == {"calibration"}


def test_what_is_missing_is_named_and_the_others_are_looked_at(bench: BenchEmulator) -> None:
    bench.unplug(bench._with_id(9))
    checks = examined(bench)
    assert checks["servo port"].level is Level.FAIL
    assert checks["servo port"].found == "servo 9 (left rear femur) does not answer"
    assert checks["servo voltage"].level is Level.OK


def test_nobody_there_is_said_once(bench: BenchEmulator) -> None:
    bench.unplug(range(18))
    checks = examined(bench)
    assert checks["servo port"].found == "none of 18 servos answers"
    assert "servo voltage" not in checks


def test_an_adapter_that_echoes_is_told_and_heard_through() -> None:
    with TcpBusServer(BenchEmulator(PROFILE, np.random.default_rng(1), echo=True)) as server:
        first, second, *_ = servo_checks.examine(server.url, "phantomx_mk2")
    assert (first.level, first.found) == (Level.WARN, "the adapter returns every sent byte")
    assert "--set actuator.echo=true" in first.advice
    assert second.found == "all 18 servos answer"


def test_low_voltage_heat_and_overload_are_named(bench: BenchEmulator) -> None:
    bench._servos.charge = 0.1
    bench._servos.temperature[bench._with_id(6)] = 66.0
    bench._servos._faults[bench._with_id(17)] = dxl.ServoError.OVERLOAD
    checks = examined(bench)
    assert checks["servo voltage"].level is Level.WARN
    assert "at least 10.5 V" in checks["servo voltage"].advice
    assert checks["servo temperature"].found == "25 to 66 deg C; near their limit: servo 6 (right front tibia)"
    assert checks["servo errors"].level is Level.FAIL
    assert checks["servo errors"].found == "servo 17 (left middle tibia) reports overload"


def test_a_slow_latency_timer_is_told_with_the_command(tmp_path: Path) -> None:
    timer = tmp_path / "ttyUSB0" / "latency_timer"
    timer.parent.mkdir()
    timer.write_text("16\n")
    check = servo_checks.latency("/dev/ttyUSB0", tmp_path)
    assert (check.level, check.found) == (Level.WARN, "16 ms")
    assert "sudo tee" in check.advice
    timer.write_text("1\n")
    assert servo_checks.latency("/dev/ttyUSB0", tmp_path) == Check("latency timer", Level.OK, "1 ms")


@pytest.mark.parametrize(("days", "level"), [(0, Level.OK), (180, Level.OK), (181, Level.WARN)])
def test_the_age_of_a_calibration_is_that_of_its_oldest_leg(days: int, level: Level) -> None:
    entries = [Calibration(leg, TODAY, (0.0, 0.0, 0.0)) for leg in LEGS[1:]]
    old = Calibration(LEGS[0], TODAY - timedelta(days), (0.0, 0.0, 0.0))
    check = servo_checks.calibration(replace(PROFILE, calibration=(*entries, old)), TODAY)
    assert (check.level, check.found) == (level, f"{days} days old")


def test_legs_that_were_never_measured_are_named() -> None:
    check = servo_checks.calibration(PROFILE, TODAY)
    assert check.level is Level.WARN
    assert "none in the profile phantomx_mk2" in check.found
    robot = replace(PROFILE, calibration=(Calibration(LEGS[0], TODAY, (0.0, 0.0, 0.0)),))
    check = servo_checks.calibration(robot, TODAY)
    assert check.level is Level.WARN
    assert check.found == f"0 days old; missing: {', '.join(LEGS[1:])}"


def test_torque_that_is_on_is_told_and_is_no_fault(bench: BenchEmulator) -> None:
    bench._servos.tables[:, dxl.TORQUE_ENABLE.address] = 1
    check = examined(bench)["servo port"]
    assert (check.level, check.found) == (Level.OK, "all 18 servos answer; torque is on at 18 of them")


def test_limits_and_protections_that_somebody_changed_are_a_warning(bench: BenchEmulator) -> None:
    bench._servos.write(bench._with_id(6)[0], dxl.SHUTDOWN.address, b"\0")
    checks = examined(bench)
    assert checks["servo port"].level is Level.OK
    assert checks["servo settings"].level is Level.WARN
    assert checks["servo settings"].found == "servo 6 (right front tibia) does not shut down for overheating, overload"
