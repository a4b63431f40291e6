"""`sextant servos` and `doctor` for a robot with two buses."""

import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.deploy.commands import servo_port, servos, servos_off
from sextant.deploy.doctor import rehearsal, servo_checks
from sextant.services.actuator.commissioning import joint_test
from sextant.services.actuator.servo_bus import bus_driver
from sextant.services.actuator.servo_bus.serial_port import REPLY_TIMEOUT_NS, Port
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profile_text import write_new_profile
from tests.support.families import command_robot, two_bus_robot

PROFILE, COMMANDS = two_bus_robot(), command_robot()
PORTS = "left=socket://127.0.0.1:1, right=socket://127.0.0.1:2"
EXCHANGED = "left=socket://127.0.0.1:2, right=socket://127.0.0.1:1"


class Line:
    """Ports in memory to two emulated buses; their virtual time is the clock of the command."""

    def __init__(self, profile: RobotProfile) -> None:
        self.benches = [BenchEmulator(profile, np.random.default_rng(1), bus=bus) for bus in (0, 1)]
        self._ports: dict[str, MemoryPort] = {}

    def monotonic_ns(self) -> int:
        return max((0, *(port.last_ns for port in self._ports.values())))

    def open(self, url: str, baud_rate: int = 1_000_000, timeout_ns: int = REPLY_TIMEOUT_NS) -> Port:
        bench = self.benches[int(url[-1]) - 1]
        start_ns, seconds = self.monotonic_ns(), timeout_ns * 1e-9
        self._ports[url] = MemoryPort(bench, self.monotonic_ns, timeout=seconds, start_ns=start_ns)
        return self._ports[url]


@pytest.fixture(params=[PROFILE, COMMANDS], ids=["registers", "commands"])
def robot(request: pytest.FixtureRequest) -> RobotProfile:
    """Return the robot of tests that take each of the two."""
    found: RobotProfile = request.param
    return found


@pytest.fixture
def line(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Line:
    profile = request.getfixturevalue("robot") if "robot" in request.fixturenames else PROFILE
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", StringIO(""))
    write_new_profile(Path("robot.toml"), profile)
    found = Line(profile)
    monkeypatch.setattr(bus_driver, "open_port", found.open)
    monkeypatch.setattr(servos, "time", found)
    monkeypatch.setattr(servo_port, "time", found)
    return found


def run(*words: str, ports: str = PORTS) -> int:
    return cli.main(["servos", *words, "--robot", "robot.toml", "--port", ports])


def test_scan_names_the_bus_of_each_servo(line: Line, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("scan", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["problems"] == []
    on_bus = {row["id"]: row["bus"] for row in found["servos"]}
    assert [on_bus[i] for i in PROFILE.servo_ids[:, 0]] == ["left", "right", "right", "right", "left", "left"]
    assert {row["model"] for row in found["servos"] if row["bus"] == "right"} == {"STS3215"}
    assert run("scan") == 0
    told = capsys.readouterr().out
    assert "all 9 servos of two_buses on bus left are in order" in told
    assert "all 9 servos of two_buses on bus right are in order" in told


def test_scan_of_one_bus_names_its_missing_servo(line: Line, capsys: pytest.CaptureFixture[str]) -> None:
    line.benches[1].unplug([4])
    assert run("scan", "--ids", "1:19", ports="right=socket://127.0.0.1:2") == 1
    told = capsys.readouterr().out
    assert "servo 8 (right middle femur) does not answer" in told
    assert "left" not in told


def test_servo_on_the_wrong_bus_is_named(line: Line, capsys: pytest.CaptureFixture[str]) -> None:
    table = line.benches[0]._servos.table
    line.benches[0]._servos.write(8, table.id.address, b"\x04")  # that of the right front coxa
    line.benches[0]._find_listeners()
    assert run("scan", "--ids", "1:19") == 1
    assert "servo 4 (right front coxa, of bus right) is on this bus" in capsys.readouterr().out


@pytest.mark.parametrize("ports", ["/dev/ttyUSB0", "left=/dev/ttyUSB0, middle=/dev/ttyUSB1"])
@pytest.mark.parametrize("command", ["scan", "off", "set-id", "test"])
def test_ports_without_their_buses_are_refused(
    command: str, ports: str, line: Line, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(command, ports=ports) == 2
    assert "--port: a port for each bus of the robot expected, as in 'left=/dev/ttyUSB0" in capsys.readouterr().err


def test_off_turns_the_torque_of_both_buses_off(
    robot: RobotProfile, line: Line, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(servos_off, "_latch", lambda port: "")
    for bench in line.benches:
        table = bench._servos.table
        for row in range(9):
            bench._servos.write(row, table.torque_enable.address, b"\x01")
    assert run("off") == 0
    assert "confirmed by 18 of 18 servos" in capsys.readouterr().out
    assert not any(bench._servos.column(bench._servos.table.torque_enable).any() for bench in line.benches)


def test_off_turns_the_torque_off_at_exchanged_ports(
    robot: RobotProfile, line: Line, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(servos_off, "_latch", lambda port: "")
    for bench in line.benches:
        for row in range(9):
            bench._servos.write(row, bench._tables[row].torque_enable.address, b"\x01")
    assert run("off", ports=EXCHANGED) == 0
    told = capsys.readouterr().out
    assert ", of bus right) is on this bus\n  -> exchange the ports in --port, connect the servo to its own bus, or" in told
    assert ", of bus left) is on this bus" in told
    assert "confirmed by 18 of 18 servos" in told
    for bench in line.benches:
        bench.receive(b"", line.monotonic_ns() + 100_000_000)
        assert not any(bench._value(row, bench._tables[row].torque_enable) for row in range(9))


def test_scan_of_exchanged_ports_finds_the_servos_of_the_other_bus(
    robot: RobotProfile, line: Line, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("scan", "--ids", "1:19", ports=EXCHANGED) == 1
    told = capsys.readouterr().out
    assert "no servo answers" not in told
    assert ", of bus right) is on this bus" in told
    assert ", of bus left) is on this bus" in told


@pytest.mark.parametrize(("servo_id", "ports"), [(1, PORTS), (4, PORTS), (4, "right=socket://127.0.0.1:2")])
def test_find_turns_a_servo_on_its_bus(servo_id: int, ports: str, line: Line, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("find", f"{servo_id}", "--yes", ports=ports) == 0
    assert capsys.readouterr().out.endswith("torque is off\n")


@pytest.mark.parametrize(("servo_id", "ports"), [(1, "right=socket://127.0.0.1:2"), (99, PORTS)])
def test_find_needs_the_port_of_the_bus(servo_id: int, ports: str, line: Line, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("find", f"{servo_id}", "--yes", ports=ports) == 2
    assert f"--port: the port of the bus with servo {servo_id} expected, found '{ports}'" in capsys.readouterr().err


def test_test_moves_joints_of_both_buses(
    robot: RobotProfile, line: Line, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(joint_test, "_WAY_NS", 300_000_000)
    assert run("test", "--yes", "--leg", "left front", "--leg", "right front") == 0
    assert "6 of 6 joints turn and return" in capsys.readouterr().out


def test_set_id_finds_all_servos_of_both_buses_set(robot: RobotProfile, line: Line, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("set-id") == 0
    assert capsys.readouterr().out.count("all 9 servos have their ids") == 2


@pytest.fixture
def urls() -> Iterator[str]:
    with ExitStack() as stack:
        servers = [
            stack.enter_context(TcpBusServer(BenchEmulator(PROFILE, np.random.default_rng(1), bus=bus), rejects_others=True))
            for bus in (0, 1)
        ]
        yield f"left={servers[0].url}, right={servers[1].url}"


def test_doctor_checks_both_buses(urls: str, tmp_path: Path) -> None:
    robot = tmp_path / "robot.toml"
    write_new_profile(robot, PROFILE)
    words = [check.found for check in servo_checks.examine(urls, str(robot)) if check.name.startswith("servo port")]
    assert words == ["all 9 servos answer"] * 2
    (check,) = servo_checks.examine("socket://127.0.0.1:9", str(robot))
    assert "a port for each bus of the robot expected" in check.found


def test_doctor_times_an_actuator_on_both_buses(tmp_path: Path) -> None:
    robot = tmp_path / "robot.toml"
    write_new_profile(robot, PROFILE)
    with rehearsal.bench_actuator(str(robot)) as tick:
        for _ in range(3):
            tick()


def test_emulate_needs_the_name_of_a_bus(line: Line, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", "emulate", "--robot", "robot.toml"]) == 2
    assert "--bus: one of left, right expected, found none" in capsys.readouterr().err
    assert cli.main(["servos", "emulate", "--bus", "left"]) == 2
    assert "--bus: none expected, because the robot has one bus" in capsys.readouterr().err
