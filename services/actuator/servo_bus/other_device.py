"""Another device than servos on a port: what it sends, by itself or in answer to each request, and at which rate."""

from typing import NamedTuple, Protocol

from sextant.services.actuator.servo_bus import usb_adapter
from sextant.services.actuator.servo_bus.serial_port import BusDisconnectedError
from sextant.shared.servo import bridge_protocol

_STRANGE_BYTES = 16  # unrequested bytes from which another device sends: fewer are noise on an open line
_UNUSED_IDS = (251, 252)  # of all protocols, and of no robot
_TEXT_RATES = (9_600, 57_600, 115_200)  # [1/s] at which devices send text
_SHOWN_BYTES = 60  # [bytes] of a text
_READABLE = 0.9  # [1] least share of letters in a text


class PingResponses(NamedTuple):
    """Responses to one ping."""

    answers: int  # intact ones
    garbage: bytes  # all that was received, if some of it is no answer

    @property
    def silent(self) -> bool:
        """Whether nothing was received."""
        return not self.answers and not self.garbage


class Bus(Protocol):
    """Part of `ServoBus` that is used here."""

    def ping_responses(self, servo_id: int) -> PingResponses:
        """Return all responses to one ping."""

    def unrequested_bytes(self) -> bytes:
        """Return the first bytes that arrive within a second without a request."""

    def change_rate(self, rate: int) -> bool:
        """Change the baud rate [1/s] of the host; return whether the port has one."""


class NotAServoBusError(BusDisconnectedError):
    """Another device sends on the port."""

    def __init__(self, heard: bytes, when: str, rate: int | None = None):
        """Report its bytes, when and at which baud rate [1/s] they came, and the serial ports of this machine.

        Without a rate they came at that of the servos.
        """
        self.is_bridge = bool(bridge_protocol.Receiver(bridge_protocol.TO_HOST).feed(heard))
        if self.is_bridge:
            super().__init__("no servo bus: a microcontroller with the firmware of a bridge sends on the port")
            return
        letters = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in heard[:_SHOWN_BYTES])
        text = repr(letters) if _is_text(heard) else f"the bytes {heard[:8].hex(' ')} ..."
        at = f" at {rate} baud" if rate else ""
        others = ", ".join(usb_adapter.devices()) or "none"
        super().__init__(f"no servo bus: another device sends {text}{at} {when}; serial ports of this computer: {others}")


def refuse_another_device(bus: Bus) -> None:
    """Raise NotAServoBusError if bytes arrive without a request, or in answer to requests to servos that do not exist."""
    heard = bus.unrequested_bytes()
    asked = len(heard) < _STRANGE_BYTES
    heard = _answer(bus) if asked else heard
    if not heard:
        return
    rate = None
    for other in () if _is_text(heard) else _TEXT_RATES:
        if bus.change_rate(other) and _is_text(found := _answer(bus) if asked else bus.unrequested_bytes()):
            heard, rate = found, other
            break
    raise NotAServoBusError(heard, "in answer to each request" if asked else "without a request", rate)


def _answer(bus: Bus) -> bytes:
    """Return the bytes that answer requests to servos that do not exist, if they are no answers of servos."""
    first, second = map(bus.ping_responses, _UNUSED_IDS)
    return b"" if first.answers or second.answers or not second.garbage else first.garbage


def _is_text(heard: bytes) -> bool:
    """Return whether bytes can be read."""
    readable = sum(0x20 <= byte < 0x7F or byte in b"\t\r\n" for byte in heard)
    return readable > 0 and readable >= _READABLE * len(heard)
