"""Ports of one bus or of several, in one text."""

import pytest

from sextant.shared.servo.bus_ports import all_ports, bus_ports, find_port, wrong_kind, wrong_ports


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


@pytest.mark.parametrize("board", ["", "maestro", "pca9685"])
def test_each_board_has_its_kind_of_port(board: str) -> None:
    serial, i2c = wrong_kind("/dev/ttyUSB1", board), wrong_kind("/dev/i2c-3", board)
    assert bool(serial) == (board == "pca9685")
    assert bool(i2c) == (board != "pca9685")
    assert wrong_kind("socket://127.0.0.1:5000", board) == ""
    for word in ("COM3", "ttyUSB0"):
        assert f"expected, found {word!r}" in wrong_kind(word, board)


def test_a_port_that_does_not_exist_is_found_by_its_kind() -> None:
    assert "is the adapter plugged in?" in find_port("/dev/ttyUSB7")
    assert "enable I2C" in find_port("/dev/i2c-7")
    assert "a serial device such as /dev/ttyUSB0, or socket://HOST:PORT, expected, found 'ttyUSB0'" in find_port("ttyUSB0")
