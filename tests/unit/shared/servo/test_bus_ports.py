"""Ports of one bus or of several, in one text."""

import pytest

from sextant.shared.servo.bus_ports import all_ports, bus_ports, wrong_ports


@pytest.mark.parametrize(
    ("text", "ports"),
    [
        ("/dev/ttyUSB0", {"": ["/dev/ttyUSB0"]}),
        ("/dev/ttyACM0, /dev/ttyUSB0", {"": ["/dev/ttyACM0", "/dev/ttyUSB0"]}),
        ("left=/dev/ttyUSB0, right = /dev/ttyUSB1", {"left": ["/dev/ttyUSB0"], "right": ["/dev/ttyUSB1"]}),
        ("left=/dev/a,right=/dev/b,left=/dev/c", {"left": ["/dev/a", "/dev/c"], "right": ["/dev/b"]}),
        ("socket://127.0.0.1:5000", {"": ["socket://127.0.0.1:5000"]}),
        (
            "left=socket://h:1,right=rfc2217://h:2?logging=info",
            {"left": ["socket://h:1"], "right": ["rfc2217://h:2?logging=info"]},
        ),
        ("rfc2217://h:2?logging=info", {"": ["rfc2217://h:2?logging=info"]}),
    ],
)
def test_ports_of_buses(text: str, ports: dict[str, list[str]]) -> None:
    assert bus_ports(text) == ports
    assert all_ports(text) == [port for of_bus in ports.values() for port in of_bus]


def test_ports_that_are_not_those_of_the_robot_are_named() -> None:
    assert wrong_ports(bus_ports("/dev/a"), [""]) == ""
    assert wrong_ports(bus_ports("left=/dev/a, right=/dev/b"), ["left", "right"]) == ""
    assert "the robot has one bus" in wrong_ports(bus_ports("left=/dev/a"), [""])
    words = wrong_ports(bus_ports("/dev/ttyUSB0"), ["left", "right"])
    assert words == (
        "a port for each bus of the robot expected, as in 'left=/dev/ttyUSB0, right=/dev/ttyUSB1', found '/dev/ttyUSB0'"
    )
    assert "found 'left=/dev/a, middle=/dev/b'" in wrong_ports(bus_ports("left=/dev/a, middle=/dev/b"), ["left", "right"])
