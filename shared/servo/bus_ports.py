"""Names of the ports of servo buses: "/dev/ttyUSB0", or "left=/dev/ttyUSB0, right=/dev/ttyUSB1" for two buses."""

import re
from collections.abc import Mapping, Sequence

_I2C = "/dev/i2c-"
_OF_BUS = re.compile(r"([A-Za-z_]\w*)\s*=\s*(.+)", re.ASCII)


def bus_ports(text: str) -> dict[str, list[str]]:
    """Return the alternative ports of each bus, by its name; the only bus of a robot has none.

    Ports are separated by commas. Several of one bus are alternative names of its port.
    """
    ports: dict[str, list[str]] = {}
    for one in map(str.strip, text.split(",")):
        of_bus = _OF_BUS.fullmatch(one)
        name, port = (of_bus[1], of_bus[2]) if of_bus else ("", one)
        ports.setdefault(name, []).append(port)
    return ports


def wrong_ports(ports: Mapping[str, Sequence[str]], buses: Sequence[str]) -> str:
    """Return why these are not the ports of a robot's buses, or an empty string."""
    if ports.keys() == set(buses):
        return ""
    if buses == [""]:
        return f"a port without the name of a bus expected, found {', '.join(filter(None, ports))}=...: the robot has one bus"
    expected = ", ".join(f"{bus}=/dev/ttyUSB{number}" for number, bus in enumerate(buses))
    found = ", ".join(f"{name}={port}" if name else port for name, of_bus in ports.items() for port in of_bus)
    return f"a port for each bus of the robot expected, as in '{expected}', found '{found}'"


def wrong_kind(port: str, board: str = "") -> str:
    """Return why servos cannot be at a port, or an empty string.

    Args:
        port: A device, or a network address, at which any servos can be emulated.
        board: Board that sends pulses to the servos, see `sextant.shared.servo.pwm`; "" for servos on a bus.
    """
    if "://" in port:
        return ""
    if board == "pca9685":
        return "" if port.startswith(_I2C) else f"an I2C bus of a PCA9685, such as /dev/i2c-1, expected, found {port!r}"
    usual = "/dev/ttyACM0" if board else "/dev/ttyUSB0"
    if "/" not in port or port.startswith(_I2C):
        return f"a serial device such as {usual}, or socket://HOST:PORT, expected, found {port!r}"
    return ""


def find_port(port: str) -> str:
    """Return how to find the device of a port that does not exist."""
    if port.startswith(_I2C):
        return "enable I2C on this computer; `ls /dev/i2c-*` lists its buses"
    if "/" not in port:
        return f"{wrong_kind(port)}; `ls /dev/ttyUSB* /dev/ttyACM*` lists the ports"
    return "is the adapter plugged in? `ls /dev/ttyUSB* /dev/ttyACM*` lists the ports"


def all_ports(text: str) -> list[str]:
    """Return the ports of all buses, without the names of the buses."""
    return [port for of_bus in bus_ports(text).values() for port in of_bus]
