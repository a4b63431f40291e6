"""`sextant servos` on the command line: arguments, exits, and calibration files."""

import io
import json
import os
import pty
import shlex
import signal
import socket
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.deploy.commands import servo_port, servos_off, up
from sextant.deploy.commands.servo_port import Bus
from sextant.services.actuator.commissioning import joint_test
from sextant.services.actuator.commissioning.watched_motion import UNWATCHED
from sextant.services.actuator.safety import torque_off_latch as latch_files
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.actuator.servo_bus.bus_scan import ECHO
from sextant.services.actuator.servo_bus.serial_port import BusDisconnectedError, open_port
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.tcp_port import TcpBusServer
from sextant.shared.robot.profile import LEGS
from sextant.shared.robot.profile_text import write_new_profile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.clock import now_ns
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire.ports import free_port
from tests.support.families import FAMILIES, robot_with
from tests.support.port_in_memory import Line

PROFILE = load_profile("phantomx_mk2")


@pytest.fixture
def bench() -> BenchEmulator:
    return BenchEmulator(PROFILE, np.random.default_rng(1))


@pytest.fixture
def url(bench: BenchEmulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    return Line(bench, monkeypatch).URL


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["scan", "--robot", "nobody"], "no profile 'nobody'"),
        (["calibrate", "--robot", "nowhere.toml"], "nowhere.toml: no such file"),
        (["calibrate", "--pose", "0", "0", "90"], "--pose: a pose within the left front leg's limits expected, found tibia 90"),
        (["calibrate", "--pose", "0", "0", "90"], "; --pose 0 0 0 is one"),
        (["calibrate", "--out", "other.toml"], "other.toml is a lotriet_rx64, phantomx_mk2 expected"),
        (["calibrate", "--out", "other"], "--out: a file that ends in .toml expected, found other"),
        (["calibrate", "--out", "nowhere/other.toml"], "--out: an existing, writable folder expected"),
        (["scan", "--ids", "0:300"], "ids of servos expected, 0 to 253, found '0:300'"),
        (["emulate", "--listen", "70000"], "--listen: a whole number of 0 to 65535 expected, found '70000'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_invalid_input_is_refused_before_any_servo_instruction(
    words: list[str], hint: str, bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("other.toml").write_text('extends = "lotriet_rx64"\n')
    assert cli.main(["servos", *words, *(["--port", url] if words[0] != "emulate" else [])]) == 2
    assert hint in capsys.readouterr().err
    assert not bench.counts.instructions


@pytest.mark.parametrize("words", [["scan"], ["set-id"], ["off"], ["test"], ["calibrate"], ["find", "1"]], ids=" ".join)
def test_port_of_a_bus_that_the_robot_does_not_have_is_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", *words, "--port", "left=/dev/ttyUSB0"]) == 2
    expected = "--port: a port without the name of a bus expected, found left=...: the robot has one bus"
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize("port", ["sock://127.0.0.1:5201", "socket://127.0.0.1", "socket://127.0.0.1:x"])
def test_invalid_port_url_error_shows_expected_format(port: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", "scan", "--port", port]) == 1
    assert "socket://HOST:PORT" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["scan", "off", "set-id", "calibrate", "test"])
def test_unreachable_port_is_reported(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", command, "--port", f"socket://127.0.0.1:{free_port()}"]) == 1
    told = capsys.readouterr().err
    assert f"sextant servos {command}: cannot open servo port socket://" in told


@pytest.mark.parametrize("command", ["set-id", "calibrate", "test"])
def test_unanswered_prompt_writes_nothing_to_servos(
    command: str, bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if command == "set-id":
        bench.unplug(bench._with_id(9))  # otherwise there is no question
    assert cli.main(["servos", command, "--port", url]) == 2
    assert "an answer expected, found the end of the input" in capsys.readouterr().err
    assert not bench.counts.instructions[dxl.Instruction.WRITE]


def test_scan_json_and_text_outputs_agree(bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]) -> None:
    bench.unplug(bench._with_id(9))
    words = ["servos", "scan", "--port", url, "--ids", "1:19"]
    assert cli.main([*words, "--json"]) == 1
    heard = capsys.readouterr()
    assert heard.err == "scanning 18 ids at 1000000 baud; unused ids take longer\n"
    table = json.loads(heard.out)
    assert [row["id"] for row in table["servos"]] == [i for i in range(1, 19) if i != 9]
    assert table["servos"][0] == {
        "id": 1, "baud": 1_000_000, "joint": "left front coxa", "model": "AX-12A", "firmware": 24,
        "voltage": table["servos"][0]["voltage"], "temperature": 25.0,
    }  # fmt: skip
    (problem,) = table["problems"]
    assert cli.main(words) == 1
    told = capsys.readouterr().out
    assert told.startswith(heard.err)
    assert f"{problem['words']}\n  -> {problem['advice']}" in told
    assert all(row["joint"] in told for row in table["servos"])


def test_scan_names_one_cable_for_the_servos_behind_it(
    bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for servo_id in (9, 11):
        bench.unplug(bench._with_id(servo_id))
    assert cli.main(["servos", "scan", "--port", url, "--ids", "1:19"]) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[-2:] == [
        "servo 9 (left rear femur) and servo 11 (left rear tibia) do not answer",
        "  -> check the cable between the left rear coxa and the left rear femur, and its plugs",
    ]
    assert sum("->" in line for line in told) == 1


def test_no_answering_servos_is_reported_once(bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]) -> None:
    bench.unplug(range(18))
    words = ["servos", "scan", "--port", url, "--ids", "1:4"]
    assert cli.main(words) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[0] == f"no servo answers on {url} as AX-12A, nor another servo in LewanSoul or Dynamixel Protocol 2.0"
    assert len(told) == 2
    assert cli.main([*words, "--json"]) == 1
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert [one["words"] for one in problems] == [told[0]]
    assert cli.main(["servos", "off", "--port", url]) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[0] == "each of 18 servos does not answer, or refuses the order"
    assert "--bridge" in told[1]
    assert told[2] == "0 of 18 servos confirm torque off"


@pytest.mark.parametrize("name", FAMILIES)
def test_scan_names_an_echo_and_works_with_its_option(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    profile, path = robot_with(name), tmp_path / "robot.toml"
    write_new_profile(path, profile)
    url = Line(BenchEmulator(profile, np.random.default_rng(1), echo=True), monkeypatch).URL
    words = ["servos", "scan", "--robot", str(path), "--port", url, "--ids", "1:19"]
    assert cli.main(words) == 1
    assert capsys.readouterr().out.splitlines() == [ECHO.words, f"  -> {ECHO.advice}"]
    assert cli.main([*words, "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == {"servos": [], "problems": [ECHO._asdict()]}
    assert cli.main([*words, "--echo"]) == 0
    assert f"all 18 servos of {profile.name} are in order" in capsys.readouterr().out


def test_calibration_is_written_to_profile_or_out_file(
    bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["servos", "calibrate", "--port", url, "--yes", "--leg", LEGS[2]]
    Path("deep").mkdir()
    assert cli.main([*words]) == 0
    assert cli.main([*words, "--robot", "my_phantomx_mk2.toml", "--out", "deep/second.toml"]) == 0
    assert cli.main([*words[:-1], LEGS[4], "--robot", "deep/second.toml"]) == 0
    capsys.readouterr()
    assert load_profile("my_phantomx_mk2.toml").calibration[0].leg == LEGS[2]
    second = load_profile("deep/second.toml")
    assert [entry.leg for entry in second.calibration] == [LEGS[2], LEGS[4]]
    np.testing.assert_allclose(second.trims[[2, 4]], bench.robot.trims[[2, 4]], atol=dxl.TICK_RAD)
    assert "../my_phantomx_mk2.toml" in Path("deep/second.toml").read_text()
    assert cli.main([*words[:-1], LEGS[4], "--robot", "deep/second.toml"]) == 0
    again = f"calibrating {LEGS[4]} again into deep/second.toml; already calibrated: {LEGS[2]}\n"
    assert again in capsys.readouterr().out


def test_complete_joint_test_names_the_next_step(
    url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    good = SimpleNamespace(name="", problem="")
    monkeypatch.setattr(joint_test, "run_joint_test", lambda *_, **__: [good] * 18)
    blind = tmp_path / "no camera.toml"
    blind.write_text('extends = "phantomx_mk2"\n[camera]\ndevice = "none"\n', encoding="utf-8")
    for robot, command in (
        ("phantomx_mk2", "camera calibrate --robot phantomx_mk2"),
        (f"{blind}", f"up onboard --robot '{blind}' --set actuator.port={url}"),
    ):
        assert cli.main(["servos", "test", "--port", url, "--robot", robot]) == 0
        last = capsys.readouterr().out.splitlines()[-1]
        assert last == f"18 of 18 joints are in order; next, on a flat floor: `sextant {command}`"


def test_emulator_names_a_command_that_the_shell_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "my robot.toml"
    own.write_text('extends = "phantomx_mk2"\n', encoding="utf-8")
    monkeypatch.setattr("sys.stdin", io.StringIO("quit\n"))
    assert cli.main(["servos", "emulate", "--robot", str(own)]) == 0
    command = capsys.readouterr().out.splitlines()[0].partition("in another terminal: ")[2]
    assert shlex.split(command)[-2:] == ["--robot", str(own)]


@pytest.mark.slow
@pytest.mark.parametrize(("torque", "left"), [("on", 1), ("off", 0), ("", 0)])
def test_torque_after_joint_test_follows_option(
    torque: str, left: int, bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["servos", "test", "--port", url, "--yes", "--leg", LEGS[0], *(["--torque", torque] if torque else [])]
    assert cli.main(words) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"3 of 3 joints turn and return; {UNWATCHED}"
    assert cli.main(["servos", "scan", "--port", url, "--ids", "1:2"]) == 0  # time goes on: the written data arrive
    assert (bench._servos.tables[:, dxl.TORQUE_ENABLE.address] == left).all()


def test_off_closes_latch_when_actuator_holds_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Close the latch even if the router that carries orders is dead."""
    monkeypatch.setattr(latch_files, "FOLDERS", (tmp_path,))
    _, end = pty.openpty()
    port, link = os.ttyname(end), tmp_path / "link"
    link.symlink_to(port)
    with closing(open_port(port)):
        assert cli.main(["servos", "off", "--port", str(link)]) == 1, "torque off is not confirmed"
    told = capsys.readouterr()
    assert f"{link} is in use" in told.err
    assert "torque is latched off: an actuator on this port turns it off at once" in told.out
    assert "if the legs do not give way" in told.err
    for name in (str(link), port):
        latch = Latch.of_port(name)
        assert latch.closed
        assert 0 <= now_ns() - latch.since_ns < 10_000_000_000


def test_off_closes_latch_for_missing_and_free_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Latch torque off with and without an open port.

    An actuator finds the latch when an adapter returns, and turns torque off. An actuator that starts does the same for a servo
    that missed the order.
    """
    monkeypatch.setattr(latch_files, "FOLDERS", (tmp_path, tmp_path / "not there"))
    assert cli.main(["servos", "off", "--port", "/dev/ttyUSB97"]) == 1
    told = capsys.readouterr()
    assert told.out.startswith("torque is latched off: ")
    assert "sextant servos off: cannot open servo port /dev/ttyUSB97" in told.err
    assert Latch.of_port("/dev/ttyUSB97").closed
    assert cli.main(["servos", "off", "--port", url]) == 0
    assert Latch.of_port(url).closed


def test_off_disables_torque_even_if_latch_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(latch_files, "FOLDERS", (tmp_path / "not there",))
    bench._servos.tables[:, dxl.TORQUE_ENABLE.address] = 1
    assert cli.main(["servos", "off", "--port", url]) == 1
    assert not bench._servos.tables[:, dxl.TORQUE_ENABLE.address].any()
    assert "torque is not latched off: [Errno 2]" in capsys.readouterr().err


@pytest.mark.parametrize("deaf", [False, True])
def test_off_disables_torque_directly_on_servo_port(
    deaf: bool, bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Turn torque off for a standing robot whose actuator is gone.

    One of its servos may have lost its cable since.
    """
    torque = bench._servos.tables[:, dxl.TORQUE_ENABLE.address]
    torque[:] = 1
    assert cli.main(["servos", "scan", "--port", url]) == 0
    assert (
        f"torque is on, of servo 1 (left front coxa), and of 17 more; `sextant servos off --port {url}`"
        in capsys.readouterr().out
    )
    if deaf:
        bench.unplug(bench._with_id(9))
    assert cli.main(["servos", "off", "--port", url]) == int(deaf)
    told = capsys.readouterr().out
    assert ("17 of 18 servos confirm torque off" if deaf else "torque is off: confirmed by 18 of 18 servos") in told
    assert ("servo 9 (left rear femur) does not answer, or refuses the order" in told) == deaf
    assert int(torque.sum()) == int(deaf)
    if not deaf:
        assert cli.main(["servos", "scan", "--port", url]) == 0
        assert "torque is on" not in capsys.readouterr().out


def test_off_disables_torque_through_bridge_board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Turn torque off through a board for a standing robot whose actuator is gone.

    No other process uses the board.
    """
    monkeypatch.setattr(latch_files, "FOLDERS", (tmp_path,))
    bench = BenchEmulator(PROFILE, np.random.default_rng(1))
    torque = bench._servos.tables[:, dxl.TORQUE_ENABLE.address]
    torque[:] = 1
    url = Line(Board(bench), monkeypatch).URL
    assert cli.main(["servos", "off", "--port", url]) == 1
    assert torque.all()
    assert cli.main(["servos", "off", "--bridge", "--port", url]) == 0
    assert not torque.any()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
def test_signal_during_move_disables_torque_and_restores_state(
    number: signal.Signals, bench: BenchEmulator, url: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Handle a signal during a move, also twice, as from a hang-up or a second Ctrl-C."""
    receive, sent = bench.receive, []
    seen: list[int] = []
    before = {one: signal.signal(one, lambda number, _: seen.append(number)) for one in (signal.SIGTERM, signal.SIGHUP)}

    def ended(data: bytes, now_ns: int) -> list[Reply]:
        if len(sent) < 3 and (sent or bench._servos.tables[:, dxl.TORQUE_ENABLE.address].any()):
            sent.append(number)
            os.kill(os.getpid(), number)
        return receive(data, now_ns)

    monkeypatch.setattr(bench, "receive", ended)
    try:
        assert cli.main(["servos", "test", "--port", url, "--yes", "--leg", LEGS[0]]) == 130
    finally:
        after = {one: signal.signal(one, handler) for one, handler in before.items()}
    assert len(sent) == 3
    assert not seen
    assert all(handler is not signal.SIG_DFL for handler in after.values())
    assert capsys.readouterr().out.splitlines()[-1] == "torque is off"
    words = bench._servos.tables.view("<u2")
    assert not bench._servos.tables[:, dxl.TORQUE_ENABLE.address].any()
    assert (words[:, dxl.TORQUE_LIMIT.address // 2] == 1023).all()


def test_servos_command_runs_in_non_main_thread(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Run a command in a thread that receives no signals."""
    with ThreadPoolExecutor() as threads:
        assert threads.submit(cli.main, ["servos", "scan", "--port", url, "--ids", "1:3"]).result() == 0


def test_unattended_calibration_skips_leg_outside_pose(
    bench: BenchEmulator, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.bend(LEGS.index("left rear"), np.radians([0.0, 40.0, 0.0]))
    assert cli.main(["servos", "calibrate", "--port", url, "--leg", "left rear", "--yes"]) == 1
    told = capsys.readouterr().out
    assert told.count("the leg is not in the pose") == 1
    assert "the left rear leg is skipped" in told


@pytest.mark.filterwarnings("ignore:.*socket.*:pytest.PytestUnraisableExceptionWarning")  # pyserial drops a closed socket
def test_port_in_use_by_another_program_is_reported(bench: BenchEmulator, capsys: pytest.CaptureFixture[str]) -> None:
    """Report that the port is in use.

    Otherwise the second program would receive nothing and suspect 18 cables.
    """
    with TcpBusServer(bench, rejects_others=True) as server:
        for _ in range(3):
            with socket.create_connection(server.address) as first:
                first.sendall(dxl.ping(1))
                assert first.recv(64)
                assert cli.main(["servos", "scan", "--port", server.url]) == 1
                assert "whether another program uses it" in capsys.readouterr().err
                first.sendall(dxl.ping(2))
                assert first.recv(64)
            assert cli.main(["servos", "scan", "--port", server.url, "--ids", "1:3"]) == 0
            assert "2 of all 18 servos of phantomx_mk2 were scanned and are in order" in capsys.readouterr().out, (
                "next is served"
            )


def test_slow_rates_have_time_for_the_longest_answer() -> None:
    """The RAM of an X430 is read in 94 bytes, which take 16 ms at the 57600 baud of its factory."""
    answer = 94 * 10 / 57_600
    assert servo_port.patience_ns(57_600) * 1e-9 > answer + 0.016 + 0.001
    assert (
        servo_port.patience_ns(9_600)
        > servo_port.patience_ns(57_600)
        > servo_port.patience_ns(1_000_000)
        > servo_port.PATIENCE_NS
    )
    assert servo_port.patience_ns(1_000_000) - servo_port.PATIENCE_NS < 2_000_000


@pytest.mark.parametrize("robot", [[], ["--robot", "phantomx_mk2"], ["--servo", "AX-12A"]])
@pytest.mark.parametrize("command", ["centre", "find"])
def test_one_servo_is_turned_without_a_profile_or_with_one(
    bench: BenchEmulator, url: str, robot: list[str], command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["servos", command, "7", "--yes", "--port", url, *robot]) == 0
    told = capsys.readouterr().out
    assert f"servo 7{' (left rear coxa)' if '--robot' in robot else ''}, AX-12A" in told
    assert told.endswith("torque is off\n")
    assert cli.main(["servos", "scan", "--port", url, "--ids", "1:2"]) == 0  # time goes on: the written data arrive
    assert not bench._servos.tables[:, dxl.TORQUE_ENABLE.address].any()


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["centre", "7", "--servo", "AX-12A", "--robot", "phantomx_mk2"], "one of --robot and --servo expected, found both"),
        (["centre", "7", "--servo", "MG996R"], "hobby servos need --robot, see docs/hobby_servos.md"),
        (["centre", "27", "--robot", "printed_ds3218"], "a channel of printed_ds3218 expected, 0 to 17, found 27"),
        (["find", "254"], "254"),
    ],
)
def test_servo_that_cannot_be_meant_is_refused(
    url: str, words: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["servos", *words, "--port", url]) == 2
    assert hint in capsys.readouterr().err


def test_messages_name_whole_commands(
    bench: BenchEmulator, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Commands in reports, questions and errors have the port and the robot of the command that names them."""
    own = tmp_path / "my robot.toml"
    own.write_text('extends = "phantomx_mk2"\n', encoding="utf-8")
    bench.unplug(range(18))
    whole = f"`sextant servos scan --port {url} --robot '{own}'`"
    for words in (["test", "--yes"], ["calibrate", "--yes"], ["centre", "7", "--yes"]):
        assert cli.main(["servos", *words, "--port", url, "--robot", str(own)]) == 1
        told = capsys.readouterr()
        assert whole in told.out + told.err
    assert cli.main(["doctor", "--port", url, "--robot", str(own)]) == 1
    assert whole in capsys.readouterr().out
    assert Bus("phantomx_mk2", "/dev/ttyUSB0").completed("`sextant servos off`") == "`sextant servos off`"
    with_rates = "`sextant servos set-id --all-rates{}`"
    assert Bus("phantomx_mk2", "/dev/ttyUSB1").completed(with_rates.format("")) == with_rates.format(" --port /dev/ttyUSB1")


@pytest.mark.parametrize(
    ("board", "port", "words"),
    [
        ("maestro", "", "/dev/ttyACM0"),
        ("pca9685", "", "/dev/i2c-1"),
        ("pca9685", "/dev/ttyUSB0", "an I2C bus of a PCA9685, such as /dev/i2c-1, expected, found '/dev/ttyUSB0'"),
        ("maestro", "/dev/i2c-1", "a serial device such as /dev/ttyACM0, or socket://HOST:PORT, expected, found '/dev/i2c-1'"),
    ],
)
def test_port_is_that_of_the_board(
    board: str, port: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(url: str, *_: object, **__: object) -> None:
        raise BusDisconnectedError(f"asked for {url}")

    monkeypatch.setattr("sextant.services.actuator.commissioning.pulse_commissioning.open_port", refuse)
    monkeypatch.setattr(Path, "exists", lambda self: False)
    own = tmp_path / "own.toml"
    own.write_text(f'extends = "printed_ds3218"\n[servo.pulses]\nboard = "{board}"\n', encoding="utf-8")
    robot = ["--robot", str(own)]
    for command in (["scan"], ["test"], ["calibrate"], ["centre", "4"]):
        assert cli.main(["servos", *command, *robot, *(["--port", port] if port else [])]) == (2 if port else 1)
        assert words in capsys.readouterr().err
    assert cli.main(["up", "onboard", "--camera", "none", *robot, *(["--set", f"actuator.port={port}"] if port else [])]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("board", ["maestro", "pca9685"])
@pytest.mark.parametrize("port", ["", "/dev/ttyACM3"])
def test_port_of_a_bridge_to_hobby_servos_is_serial(
    board: str, port: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(url: str, *_: object, **__: object) -> None:
        raise BusDisconnectedError(f"asked for {url}")

    monkeypatch.setattr("sextant.services.actuator.servo_bus.bus_driver.open_port", refuse)
    monkeypatch.setattr(servos_off, "_latch", lambda port: "")
    monkeypatch.setattr(Path, "exists", lambda self: False)
    own = tmp_path / "own.toml"
    own.write_text(f'extends = "printed_ds3218"\n[servo.pulses]\nboard = "{board}"\n', encoding="utf-8")
    robot, expected = ["--robot", str(own)], port or "/dev/ttyACM0"
    assert cli.main(["servos", "off", "--bridge", *robot, *(["--port", port] if port else [])]) == 1
    assert f"asked for {expected}" in capsys.readouterr().err
    settings = ["--set", "actuator.bridge=true", *(["--set", f"actuator.port={port}"] if port else [])]
    assert cli.main(["up", "onboard", "--camera", "none", *robot, *settings]) == 2
    assert f"no servo port {expected};" in capsys.readouterr().err
    found = up._torque_off(["bridge=true", "port=socket://127.0.0.1:1"], str(own))
    assert found == f"`sextant servos off --bridge --port socket://127.0.0.1:1 --robot {shlex.quote(str(own))}`"


def test_centre_states_the_angles_at_which_horns_are_mounted(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["servos", "centre", "7", "--yes", "--port", url, "--robot", "phantomx_mk2"]) == 0
    assert "coxa 0, femur 3.5, tibia -46.3 deg (bent down)" in capsys.readouterr().out
    assert cli.main(["servos", "centre", "7", "--yes", "--port", url]) == 0
    assert "--robot states the angle of each joint" in capsys.readouterr().out
