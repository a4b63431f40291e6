"""The USB adapter's latency timer: how long an FTDI chip keeps bytes back; its 16 ms are 16 ms for every question."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from serial.tools.list_ports import comports

DEVICES = Path("/sys/bus/usb-serial/devices")  # each with its latency timer, where the driver has one
WANTED_MS = 1
_RULE = 'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'


def identity(url: str, ports: Callable[[], Iterable[Any]] = comports) -> tuple[int, int, str] | None:
    """Maker, product and serial number of the adapter behind a serial device, None where it has none."""
    device = str(Path(url).resolve())
    for port in ports():
        if port.device == device and port.vid is not None and port.serial_number:
            return port.vid, port.pid, port.serial_number
    return None


def devices(ports: Callable[[], Iterable[Any]] = comports) -> list[str]:
    """The serial devices of this machine that something is plugged into."""
    return sorted(port.device for port in ports() if port.vid is not None)


def named_anew(who: tuple[int, int, str] | None, ports: Callable[[], Iterable[Any]] = comports) -> list[str]:
    """Devices that an adapter answers to now: one that was unplugged and is back may have another name."""
    return [port.device for port in ports() if who is not None and (port.vid, port.pid, port.serial_number) == who]


def latency_ms(url: str, devices: Path = DEVICES) -> int | None:
    """Latency timer [ms] of a serial device, None where there is none: no FTDI chip, or a network port."""
    try:
        return int(_timer(url, devices).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def quicken(url: str, port: Any, devices: Path = DEVICES) -> str:
    """Set the latency timer of an open port to 1 ms, where there is one and rights allow.

    The driver takes the low latency flag from anybody who has the port open; its file belongs to root.

    Args:
        url: What was opened, links as in /dev/serial/by-id included.
        port: A pyserial port.
        devices: Folder of the system's USB serial devices.

    Returns:
        What to do where it could not be set; nothing where all is well.
    """
    found = latency_ms(url, devices)
    if found is None or found <= WANTED_MS:
        return ""
    if hasattr(port, "set_low_latency_mode"):
        with suppress(OSError, ValueError):  # pyserial raises ValueError where the driver refuses
            port.set_low_latency_mode(True)
    if (latency_ms(url, devices) or 0) > WANTED_MS:
        with suppress(OSError):
            _timer(url, devices).write_text(f"{WANTED_MS}\n", encoding="ascii")
    return advice(url, devices)


def advice(url: str, devices: Path = DEVICES) -> str:
    """What is wrong with the latency timer and how to set it, once and for good; nothing where all is well."""
    found = latency_ms(url, devices)
    if found is None or found <= WANTED_MS:
        return ""
    return (
        f"the latency timer of {url} is {found} ms, {WANTED_MS} expected: every question to a servo takes as long; "
        f"`echo {WANTED_MS} | sudo tee {_timer(url, devices)}` sets it until it is unplugged, for good: "
        f"`echo '{_RULE}' | sudo tee /etc/udev/rules.d/99-sextant.rules` and plug it in again"
    )


def _timer(url: str, devices: Path) -> Path:
    return devices / Path(url).resolve().name / "latency_timer"
