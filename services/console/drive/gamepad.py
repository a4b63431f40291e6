"""Gamepad through Linux' joystick interface (`/dev/input/js*`).

The kernel sends the state of each axis and button when the device is opened, and then each change. A message has 8 bytes: time
[ms], value, type and number. Source: Documentation/input/joydev/joystick-api.rst of Linux.
"""

import errno
import fcntl
import os
import struct
from collections.abc import Iterator
from typing import NamedTuple

from sextant.services.console.drive.keyboard import Wish

DEAD_ZONE = 0.25  # of an axis, as a share of its range; the same as that of the page
_EVENT = struct.Struct("<IhBB")
_READ = 64 * _EVENT.size  # [B] of one reading
_MOST_READINGS = 8  # in one call
_BUTTON, _AXIS, _FIRST = 0x01, 0x02, 0x80  # types of an event; _FIRST marks a state at the beginning
_FULL = 32767.0  # value of a full deflection
_GET_AXIS_CODES, _AXIS_CODES = 0x80406A32, 64  # JSIOCGAXMAP, and the size of its answer [B]
_GET_BUTTON_CODES, _BUTTON_CODES = 0x84006A34, 512  # JSIOCGBTNMAP, and the number of 16-bit codes in its answer
_LEFT_X, _LEFT_Y, _Z, _RIGHT_X, _SHOULDER = 0x00, 0x01, 0x02, 0x03, 0x136  # ABS_X, ABS_Y, ABS_Z, ABS_RX, BTN_TL
_REMEDY = "plug the gamepad in, and check that `ls /dev/input` lists it and that this user may read it (group `input`)"


class GamepadError(Exception):
    """A gamepad cannot be opened or read; the text gives cause and remedy."""


class Event(NamedTuple):
    """A state of an axis or button."""

    is_first: bool  # state at the opening of the device
    is_axis: bool
    number: int
    value: int  # -32767 to 32767 of an axis, 0 or 1 of a button


class _Numbers(NamedTuple):
    """Numbers of the axes and the button that drive."""

    forward: int
    left: int
    turn: int
    enable: int


_USUAL = _Numbers(forward=1, left=0, turn=3, enable=4)  # of a device that does not state codes


def events_of(data: bytes) -> Iterator[Event]:
    """Yield the events of a reading.

    Raises:
        GamepadError: The bytes are no events of a joystick.
    """
    if len(data) % _EVENT.size:
        raise GamepadError(f"events of {_EVENT.size} bytes expected, found {len(data)} bytes; name a device /dev/input/js*")
    for _, value, kind, number in _EVENT.iter_unpack(data):
        is_axis = kind & ~_FIRST == _AXIS
        if not is_axis and (kind & ~_FIRST != _BUTTON or value not in (0, 1)):
            raise GamepadError(
                f"a button or an axis expected, found type {kind} and value {value}; name a device /dev/input/js*"
            )
        yield Event(bool(kind & _FIRST), is_axis, number, value)


class Gamepad:
    """An open gamepad.

    The sticks move the robot only while the left shoulder button is held. They have to be centred when it is pressed; an axis
    that never rests in the middle moves nothing.
    """

    def __init__(self, path: str):
        """Open a device.

        Raises:
            GamepadError: It cannot be opened.
        """
        self.path = path
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except (OSError, ValueError) as error:
            words = error.strerror if isinstance(error, OSError) else str(error)
            raise GamepadError(f"{path} cannot be opened: {words}; {_REMEDY}") from None
        self._numbers = _numbers(self._file)
        self._axes: dict[int, float] = {}
        self._buttons: dict[int, bool] = {}
        self._centred = False  # whether the sticks were centred while the shoulder button has been held

    def close(self) -> None:
        """Close the device; safe to call twice."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def read(self) -> bool:
        """Read what has changed; return whether any button except the shoulder button was pressed.

        Raises:
            GamepadError: The device is unplugged, or is no gamepad. It is then closed.
        """
        pressed = False
        try:
            for _ in range(_MOST_READINGS):
                if not (data := self._read()):
                    break
                for event in events_of(data):
                    pressed |= self._take(event)
                if self._numbers.enable not in self._buttons:
                    raise GamepadError("a gamepad with a left shoulder button expected, found none; use another gamepad")
        except GamepadError as error:
            self.close()
            raise GamepadError(f"{self.path}: {error}") from None
        return pressed

    def wish(self) -> Wish | None:
        """Return the motion of the sticks; None while they move nothing."""
        axes = [self._axes.get(number, 0.0) for number in self._numbers[:3]]
        forward, left, turn = (-axis if abs(axis) > DEAD_ZONE else 0.0 for axis in axes)
        centred = not (forward or left or turn)
        self._centred = self._buttons.get(self._numbers.enable, False) and (self._centred or centred)
        return (forward, left, turn) if self._centred and not centred else None

    def _read(self) -> bytes:
        """Return the waiting bytes; none if nothing has changed."""
        try:
            data = os.read(self._file, _READ)
        except BlockingIOError:
            return b""
        except OSError as error:
            gone = error.errno == errno.ENODEV
            raise GamepadError(f"{'unplugged' if gone else error.strerror}; {_REMEDY}") from None
        if not data:
            raise GamepadError(f"unplugged; {_REMEDY}")
        return data

    def _take(self, event: Event) -> bool:
        """Process an event; return whether it is the press of a button that stops the robot."""
        states: dict[int, float] | dict[int, bool] = self._axes if event.is_axis else self._buttons
        if event.number not in states and not event.is_first:
            raise GamepadError(f"the state of each button and axis expected first, found a change of number {event.number}")
        if event.is_axis:
            self._axes[event.number] = max(-1.0, event.value / _FULL)
            return False
        self._buttons[event.number] = bool(event.value)
        self.wish()  # sticks that are not centred at the press of the shoulder button move nothing
        return bool(event.value) and not event.is_first and event.number != self._numbers.enable


def _numbers(file: int) -> _Numbers:
    """Return the numbers of sticks and shoulder button, by the codes that the device states."""
    try:
        axes = fcntl.ioctl(file, _GET_AXIS_CODES, bytes(_AXIS_CODES))
        buttons = struct.unpack(f"<{_BUTTON_CODES}H", fcntl.ioctl(file, _GET_BUTTON_CODES, bytes(2 * _BUTTON_CODES)))
    except OSError:
        return _USUAL
    turn = axes.find(_RIGHT_X if _RIGHT_X in axes else _Z)
    enable = buttons.index(_SHOULDER) if _SHOULDER in buttons else _USUAL.enable
    return _Numbers(axes.find(_LEFT_Y), axes.find(_LEFT_X), turn, enable)
