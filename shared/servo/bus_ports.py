"""Names of the ports of servo buses: "/dev/ttyUSB0", or "left=/dev/ttyUSB0, right=/dev/ttyUSB1" for two buses."""

import re
from collections.abc import Mapping, Sequence

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


def all_ports(text: str) -> list[str]:
    """Return the ports of all buses, without the names of the buses."""
    return [port for of_bus in bus_ports(text).values() for port in of_bus]
