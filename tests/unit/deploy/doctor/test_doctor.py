"""The whole `sextant doctor`, for every robot that ships and for one of each servo family."""

import json
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.services.simulator.servo_bus.bench_emulator import make_bench
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profile_text import write_new_profile
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.servo.pwm import Pulses
from tests.support.families import FAMILIES, mixed_robot, robot_with, two_bus_robot
from tests.support.quick_doctor import make_doctor_quick


def pca9685_robot() -> RobotProfile:
    """Return the robot with hobby servos at two PCA9685 instead of a Maestro."""
    base = load_profile("printed_ds3218")
    assert base.servo.pulses is not None
    pulses = Pulses(board="pca9685", us_per_rad=base.servo.pulses.us_per_rad)
    return replace(base, name="pca9685", servo=replace(base.servo, pulses=pulses))


ROBOTS = {name: load_profile(name) for name in profile_names()}
ROBOTS |= {f"with {model}": robot_with(model) for model in FAMILIES}
ROBOTS |= {"at PCA9685": pca9685_robot(), "on two buses": two_bus_robot()}
ROBOTS |= {"mixed": mixed_robot("XM430-W350", "XM430-W350", "XL430-W250")}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    make_doctor_quick(monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_doctor_examines_the_machine_and_the_servos(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    profile, robot = ROBOTS[name], name
    if name not in profile_names():
        robot = str(tmp_path / "robot.toml")
        write_new_profile(Path(robot), profile)
    with ExitStack() as stack:
        buses = profile.servos.buses
        benches = [make_bench(profile, np.random.default_rng(1), bus=k) for k in range(len(buses))]
        urls = [stack.enter_context(TcpBusServer(bench)).url for bench in benches]
        ports = [f"{bus.name}={url}" if bus.name else url for bus, url in zip(buses, urls, strict=True)]
        cli.main(["doctor", "--robot", robot, "--port", ", ".join(ports), "--json"])
    checks = json.loads(capsys.readouterr().out)
    found = {check["name"]: check["found"] for check in checks}
    assert found["control cycle"].startswith("takes"), found["control cycle"]
    assert found["walking"].startswith("frame to pose and scan takes"), found["walking"]
    answers = "the board answers" if profile.servo.pulses else f"all {18 // len(buses)} servos answer"
    assert all(found[f"servo port {url}"].startswith(answers) for url in urls), found
    failed = {check["name"] for check in checks if check["level"] == "FAIL"}
    assert not failed - {"disk"}, checks
    assert all(check["advice"] for check in checks if check["level"] != "OK")


@pytest.mark.slow
def test_doctor_without_a_port_times_the_cycle_of_hobby_servos(capsys: pytest.CaptureFixture[str]) -> None:
    cli.main(["doctor", "--robot", "printed_ds3218"])
    told = capsys.readouterr().out
    assert "control cycle: takes" in told
    assert "servo port:" in told
