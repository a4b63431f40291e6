"""`sextant servos` and `sextant doctor` for a robot with hobby servos, on an emulated board at a network port."""

import json
from collections.abc import Iterator

import pytest

from sextant.deploy import cli
from sextant.deploy.doctor import servo_checks
from sextant.deploy.doctor.check import Level
from sextant.services.actuator.servo_bus.pwm_servos import PwmServos
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.pulse_bench import PulseBench
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.robot.profiles import load_profile

ROBOT = ("--robot", "printed_ds3218")
PROFILE = load_profile("printed_ds3218")


@pytest.fixture
def bench() -> PulseBench:
    return PulseBench(PROFILE)


@pytest.fixture
def url(bench: PulseBench) -> Iterator[str]:
    with TcpBusServer(bench) as server:
        yield server.url


def test_scan_lists_channels_and_says_that_nothing_is_measured(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", "scan", "--port", url, *ROBOT]) == 0
    told = capsys.readouterr().out
    assert told.count("no pulses") == 18
    assert "the board answers; no feedback: the angles of the joints are assumed" in told
    assert cli.main(["servos", "scan", "--port", url, *ROBOT, "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert [row["number"] for row in table["channels"]] == list(range(18))


def test_bench_lists_the_pulses_that_the_board_was_sent_last(bench: PulseBench) -> None:
    port = MemoryPort(bench, lambda: 0)
    assert PROFILE.servo.pulses is not None
    servos = PwmServos(port, list(PROFILE.servo_names), port.now_ns, PROFILE.servo.pulses)
    servos.setup()
    for on, listed in ((1, "1 of 18 servos have pulses: right middle coxa"), (0, "0 of 18 servos have pulses: none")):
        servos.write(6, servos.model.table.torque_enable, on)
        assert bench.execute("list") == listed


def test_off_is_confirmed(url: str, bench: PulseBench, capsys: pytest.CaptureFixture[str]) -> None:
    bench._servos.column(bench._servos.table.torque_enable)[:] = 1
    assert cli.main(["servos", "off", "--port", url, *ROBOT]) == 0
    assert "torque is off: confirmed by 18 of 18 servos" in capsys.readouterr().out


def test_set_id_says_that_a_channel_is_the_id(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", "set-id", "--port", url, *ROBOT]) == 1
    assert "hobby servos have no id: connect each to the channel of its joint" in capsys.readouterr().err


def test_calibrate_and_test_ask_before_they_move_anything(
    url: str, monkeypatch: pytest.MonkeyPatch, bench: PulseBench, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sextant.deploy.commands.servos.Terminal.agree", lambda *_: False)
    for command in ("calibrate", "test"):
        assert cli.main(["servos", command, "--port", url, *ROBOT, "--leg", "left front"]) == 1
    assert bench.execute("list") == "0 of 18 servos have pulses: none"


def test_doctor_checks_the_board_and_says_what_it_cannot_check(url: str) -> None:
    found = list(servo_checks.servos(url, PROFILE))
    assert [one.level for one in found] == [Level.OK, Level.WARN]
    assert "it sends pulses on 0 of 18 channels" in found[0].found
    assert "no feedback: the angles of the joints are assumed" in found[1].found
    (gone,) = servo_checks.servos("socket://127.0.0.1:9", PROFILE)
    assert gone.level is Level.FAIL


def test_only_listed_commands_of_the_bench_are_taken(bench: PulseBench) -> None:
    with pytest.raises(ValueError, match="one of list, quit expected, found 'plug'"):
        bench.execute("plug")
    with pytest.raises(ValueError, match="a robot with hobby servos expected"):
        PulseBench(load_profile("phantomx_mk2"))


def test_emulate_makes_no_hobby_servos_without_ids(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", "emulate", "--fresh", *ROBOT]) == 2
    assert "--fresh: hobby servos have no ids" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["centre", "find"])
def test_one_channel_is_sent_to_its_middle_and_has_no_pulses_afterwards(
    url: str, bench: PulseBench, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sextant.deploy.commands.pulse_servos.time.sleep", lambda _: None)
    assert cli.main(["servos", command, "4", "--yes", "--port", url, *ROBOT]) == 0
    told = capsys.readouterr().out
    assert "channel 4 (right front femur) jumps to its middle, at full speed" in told
    assert told.endswith("its pulses have ended\n")
    assert cli.main(["servos", "scan", "--port", url, *ROBOT]) == 0  # time goes on: the written data arrive
    assert bench.execute("list") == "0 of 18 servos have pulses: none"


def test_maestro_is_named_where_a_servo_is_searched(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", "find", "4", "--yes", "--port", url]) == 1
    assert f"a Pololu Maestro answers on {url}; give --robot your_robot.toml" in capsys.readouterr().err
