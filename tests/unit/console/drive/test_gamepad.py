"""Gamepad against a FIFO in place of the device: its events, its absence, and what is no gamepad."""

import fcntl
import os
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.console.drive.gamepad import DEAD_ZONE, Gamepad, GamepadError, events_of

AXIS, BUTTON, FIRST = 2, 1, 0x80
L1, A = 4, 0
LEFT_X, LEFT_Y, RIGHT_X = 0, 1, 3


def event(kind: int, number: int, value: int) -> bytes:
    return struct.pack("<IhBB", 1234, value, kind, number)


class Device:
    """A FIFO that plays a joystick of the kernel."""

    def __init__(self, path: Path):
        os.mkfifo(path)
        self.path = str(path)
        self.pad = Gamepad(self.path)
        self.file = os.open(path, os.O_WRONLY)
        self.send(*(event(AXIS | FIRST, n, 0) for n in range(6)), *(event(BUTTON | FIRST, n, 0) for n in range(11)))

    def send(self, *events: bytes) -> bool:
        os.write(self.file, b"".join(events))
        return self.pad.read()

    def hold(self, on: bool = True) -> None:
        self.send(event(BUTTON, L1, int(on)))

    def stick(self, number: int, value: float) -> None:
        self.send(event(AXIS, number, round(32767 * value)))

    def unplug(self) -> None:
        if self.file >= 0:
            os.close(self.file)
            self.file = -1


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    made = Device(tmp_path / "js0")
    yield made
    made.unplug()
    made.pad.close()
    made.pad.close()


def test_sticks_move_only_while_the_shoulder_button_is_held(device: Device) -> None:
    device.stick(LEFT_Y, -1.0)
    assert device.pad.wish() is None
    device.stick(LEFT_Y, 0.0)
    device.hold()
    assert device.pad.wish() is None, "centred sticks do not walk"
    device.stick(LEFT_Y, -1.0)
    device.stick(LEFT_X, -0.5)
    assert device.pad.wish() == pytest.approx((1.0, 0.5, 0.0), abs=1e-3)
    device.stick(RIGHT_X, 0.75)
    assert device.pad.wish() == pytest.approx((1.0, 0.5, -0.75), abs=1e-3)
    device.hold(False)
    assert device.pad.wish() is None


def test_stick_that_is_deflected_at_the_press_has_to_be_centred_first(device: Device) -> None:
    device.stick(RIGHT_X, -1.0)  # as a trigger that rests at the end of its range
    device.hold()
    device.stick(LEFT_Y, -1.0)
    assert device.pad.wish() is None
    device.stick(RIGHT_X, 0.0)
    assert device.pad.wish() is None
    device.stick(LEFT_Y, 0.0)
    assert device.pad.wish() is None
    device.stick(LEFT_Y, -1.0)
    assert device.pad.wish() is not None
    device.send(event(BUTTON, L1, 0), event(BUTTON, L1, 1))  # in one reading
    assert device.pad.wish() is None


@given(st.integers(-32768, 32767))
def test_small_deflections_are_none_and_large_ones_stay_in_range(value: int) -> None:
    pad = Gamepad.__new__(Gamepad)
    pad._axes, pad._buttons, pad._centred = {LEFT_Y: max(-1.0, value / 32767)}, {L1: True}, True
    pad._numbers = (LEFT_Y, LEFT_X, RIGHT_X, L1)  # type: ignore[assignment]
    pad._numbers = type("N", (tuple,), {"enable": L1})((LEFT_Y, LEFT_X, RIGHT_X, L1))
    wish = pad.wish()
    assert (wish is None) == (abs(value / 32767) <= DEAD_ZONE)
    assert wish is None or (DEAD_ZONE < abs(wish[0]) <= 1.0 and wish[1:] == (0.0, 0.0))


def test_any_other_button_is_reported_once(device: Device) -> None:
    assert device.send(event(BUTTON, A, 1)) is True
    assert device.pad.read() is False
    assert device.send(event(BUTTON, A, 0)) is False
    assert device.send(event(BUTTON, L1, 1)) is False


def test_unplugged_gamepad_is_reported_and_closed(device: Device) -> None:
    device.hold()
    device.stick(LEFT_Y, -1.0)
    device.unplug()
    with pytest.raises(GamepadError, match=r"js0: unplugged; plug the gamepad in"):
        device.pad.read()
    device.pad.close()


def test_absent_device_is_reported_with_remedy(tmp_path: Path) -> None:
    for path in (str(tmp_path / "js9"), "no\0path"):
        with pytest.raises(GamepadError, match=r"cannot be opened: .*group `input`"):
            Gamepad(path)


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (b"hello", "events of 8 bytes expected, found 5 bytes"),
        (bytes(16), "found type 0 and value 0"),
        (event(BUTTON, L1, 7), "found type 1 and value 7"),
        (event(AXIS, 9, 5), "the state of each button and axis expected first, found a change of number 9"),
    ],
)
def test_what_is_no_gamepad_is_refused(device: Device, sent: bytes, reason: str) -> None:
    with pytest.raises(GamepadError, match=reason):
        device.send(sent)


def test_file_that_is_no_device_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_bytes(b"notes on paper, .")
    with pytest.raises(GamepadError, match="name a device"):
        Gamepad(str(tmp_path / "notes.txt")).read()
    (tmp_path / "few").write_bytes(event(BUTTON | FIRST, 0, 0))
    with pytest.raises(GamepadError, match="left shoulder button expected"):
        Gamepad(str(tmp_path / "few")).read()


@given(st.binary(max_size=64))
def test_any_bytes_are_events_or_refused(data: bytes) -> None:
    try:
        found = list(events_of(data))
    except GamepadError:
        return
    assert len(found) == len(data) / 8
    assert all(one.is_axis or one.value in (0, 1) for one in found)


def test_numbers_of_sticks_follow_the_codes_that_the_kernel_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An older pad: x, y, z, rz as axes; its shoulder button is number 6."""
    axes = bytes([0, 1, 2, 5]).ljust(64, b"\0")
    buttons = struct.pack("<512H", *[0x130, 0x131, 0x132, 0x133, 0x134, 0x135, 0x136], *[0] * 505)
    answers = {0x80406A32: axes, 0x84006A34: buttons}
    monkeypatch.setattr(fcntl, "ioctl", lambda _, request, __: answers[request])
    os.mkfifo(tmp_path / "js0")
    pad = Gamepad(str(tmp_path / "js0"))
    pad.close()
    assert pad._numbers == (1, 0, 2, 6)
