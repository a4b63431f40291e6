"""The USB adapter of a port: its name, and its latency timer, by which an FTDI chip delays answers by 16 ms."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from serial.tools.list_ports import comports

DEVICES = Path("/sys/bus/usb-serial/devices")  # serial devices, each with its latency timer if the driver has one
WANTED_MS = 1
_RULE = 'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"'


def identity(url: str, ports: Callable[[], Iterable[Any]] = comports) -> tuple[int, int, str] | None:
    """Return vendor id, product id and serial number of an adapter, or None."""
    device = str(Path(url).resolve())
    for port in ports():
        if port.device == device and port.vid is not None and port.serial_number:
            return port.vid, port.pid, port.serial_number
    return None


def name_of(url: str, ports: Callable[[], Iterable[Any]] | None = None) -> str:
    """Return product, vendor id and product id of an adapter, as "FT232R USB UART (0403:6001)"; "" if the system has none."""
    device = str(Path(url).resolve())
    for port in (ports or comports)():
        if port.device == device and port.vid is not None:
            return f"{port.product or 'USB device'} ({port.vid:04x}:{port.pid:04x})"
    return ""


def devices(ports: Callable[[], Iterable[Any]] = comports) -> list[str]:
    """Return the USB serial devices that are plugged in."""
    return sorted(port.device for port in ports() if port.vid is not None)


def renamed_devices(who: tuple[int, int, str] | None, ports: Callable[[], Iterable[Any]] = comports) -> list[str]:
    """Return the present device names of an adapter, also after replugging."""
    return [port.device for port in ports() if who is not None and (port.vid, port.pid, port.serial_number) == who]


def latency_ms(url: str, devices: Path = DEVICES) -> int | None:
    """Return the latency timer [ms] of a device; None without FTDI chip."""
    try:
        return int(_timer(url, devices).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def lower_latency(url: str, port: Any, devices: Path = DEVICES) -> str:
    """Set the latency timer of an open port to 1 ms, if permissions allow.

    The driver accepts the low-latency flag from any process that has the port open; its sysfs file belongs to root.

    Args:
        url: The opened URL or device, also a link as in /dev/serial/by-id.
        port: A pyserial port.
        devices: Folder of the system's USB serial devices.

    Returns:
        What to do if it could not be set, otherwise an empty string.
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
    """Return what is wrong with the latency timer and its remedy, or ""."""
    found = latency_ms(url, devices)
    if found is None or found <= WANTED_MS:
        return ""
    return (
        f"the latency timer of {url} is {found} ms, {WANTED_MS} expected: every request to a servo takes that long; "
        f"`echo {WANTED_MS} | sudo tee {_timer(url, devices)}` sets it until the adapter is unplugged; to set it permanently: "
        f"`echo '{_RULE}' | sudo tee /etc/udev/rules.d/99-sextant.rules` and plug the adapter in again"
    )


def _timer(url: str, devices: Path) -> Path:
    return devices / Path(url).resolve().name / "latency_timer"
