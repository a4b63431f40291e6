"""`sextant servos` and `doctor` on ports where another device sends text, by itself or in answer to each request."""

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.deploy.doctor import servo_checks
from sextant.deploy.doctor.check import Level
from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS, Bridge
from sextant.services.actuator.servo_bus.other_device import PingResponses, refuse_another_device
from sextant.services.actuator.servo_bus.triage import Opener, examine, usual_rates
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.models import AX_12A
from tests.support.desk import Desk
from tests.support.port_in_memory import Line, OtherDevice

SHELL = b"ERROR: unknown command\r\n"
GPS = b"$GPGGA,120000.00,4717.11,N\r\n"
COMMANDS = (
    ("scan",),
    ("scan", "--ids", "1:19"),
    ("set-id",),
    ("find", "1", "--yes"),
    ("test", "--yes"),
    ("calibrate", "--yes"),
)


@pytest.mark.parametrize("robot", ["phantomx_mk2", "printed_sts3215", "jethexa_hx35h"])
@pytest.mark.parametrize("text", [SHELL, b"ok\n", b"error:2\r\n"])
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_device_that_answers_each_request_is_shown_by_its_text(
    words: tuple[str, ...], text: bytes, robot: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = Line(OtherDevice(text, answers=True), monkeypatch)
    assert cli.main(["servos", *words, "--port", line.URL, "--robot", robot]) == 1
    told = capsys.readouterr()
    letters = text.decode().replace("\r", ".").replace("\n", ".")
    assert f"no servo bus: another device sends '{letters}' in answer to each request" in told.err
    assert "servo 1" not in told.out
    assert line.monotonic_ns() < 6e9, "within seconds"


@pytest.mark.parametrize("rate", [9_600, 57_600, 115_200])
@pytest.mark.parametrize("answers", [False, True])
def test_text_of_another_rate_is_read(
    answers: bool, rate: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    line = Line(OtherDevice(GPS, answers=answers, rate=rate), monkeypatch)
    assert cli.main(["servos", "scan", "--port", line.URL]) == 1
    told = capsys.readouterr().err
    assert "another device sends '$GPGGA,120000.00,4717.11,N.." in told
    assert f"' at {rate} baud {'in answer to each request' if answers else 'without a request'}" in told


def test_bytes_that_are_text_at_no_rate_are_shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    line = Line(OtherDevice(GPS, rate=4_800), monkeypatch)
    assert cli.main(["servos", "scan", "--port", line.URL]) == 1
    assert "another device sends the bytes e0 80 f8 e0 80 f8 e0 80 ... without a request" in capsys.readouterr().err


@pytest.mark.parametrize("answers", [False, True])
def test_doctor_shows_the_text_of_another_device(answers: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line(OtherDevice(GPS, answers=answers, rate=9_600), monkeypatch)
    monkeypatch.setattr(servo_checks, "time", line)
    (check,) = servo_checks.servos(line.URL, load_profile("phantomx_mk2"))
    assert check.level is Level.FAIL
    assert "another device sends '$GPGGA" in check.found
    assert check.advice == "give another port with --port"


def test_bridge_with_a_session_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    profile = load_profile("phantomx_mk2")
    line = Line(Board(BenchEmulator(profile, np.random.default_rng(1000))), monkeypatch)
    monkeypatch.setattr(servo_checks, "time", line)
    board = Bridge(line.open(line.URL, timeout_ns=READ_NS), list(profile.servo_names), line.monotonic_ns)
    board.open_session()
    board.close()
    assert cli.main(["servos", "scan", "--port", line.URL]) == 1
    assert "a microcontroller with the firmware of a bridge sends on the port" in capsys.readouterr().err
    (check,) = servo_checks.servos(line.URL, profile)
    assert "a microcontroller with the firmware of a bridge sends on the port" in check.found
    assert check.advice == "add --bridge"


def test_servos_that_all_share_ids_are_no_other_device() -> None:
    desk = Desk()
    for servo_id in range(10, 19):
        desk.change(servo_id, dxl.ID, servo_id - 9)
    opener = Opener(lambda rate, model: desk.bus(), "/dev/ttyUSB0", has_rates=True)
    assert examine(opener, AX_12A, range(1, 10), usual_rates(AX_12A)) is None
    refuse_another_device(desk.bus())


class _Quiet:
    """A line with noise, but no answers."""

    def __init__(self, *answers: bytes) -> None:
        self.answers = list(answers)

    def unrequested_bytes(self) -> bytes:
        return b"\x00" * 15

    def change_rate(self, rate: int) -> bool:
        return True

    def ping_responses(self, servo_id: int) -> PingResponses:
        return PingResponses(0, self.answers.pop(0))


@pytest.mark.parametrize("answers", [(b"", b""), (b"\x00", b""), (b"", b"\x00")])
def test_noise_on_an_open_line_is_no_other_device(answers: tuple[bytes, ...]) -> None:
    refuse_another_device(_Quiet(*answers))
