"""Drivers of BNO055 and BNO085 against substitutes of Adafruit's libraries, with their calls and errors."""

import sys
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sextant.services.perception.imu.bno import Bno, check_port
from sextant.services.perception.imu.reading import ImuError
from sextant.shared.robot.profile import Imu


@dataclass
class Sensor:
    """A BNO055 or BNO085 on a bus."""

    gyro: tuple[Any, ...] = (0.1, 0.2, 0.3)
    acceleration: tuple[Any, ...] = (0.0, 0.0, 9.8)
    mode: int = 12
    features: list[tuple[int, int]] = field(default_factory=list)

    def enable_feature(self, report: int, interval_us: int) -> None:
        self.features.append((report, interval_us))


class Broken:
    """A sensor whose library fails while it reads."""

    def __init__(self, error: Exception):
        self.error = error

    @property
    def gyro(self) -> Any:
        raise self.error


class Library:
    """The parts of the libraries that the driver uses, and the ports that they open."""

    def __init__(self) -> None:
        self.sensor: Any = Sensor()
        self.opened: list[tuple[Any, ...]] = []
        self.closed = 0
        self.error: Exception | None = None
        self.bytes = b"x"

    def make(self, kind: str, *words: Any) -> Any:
        if self.error is not None:
            raise self.error
        self.opened.append((kind, *words))
        return self.sensor

    def close(self) -> None:
        self.closed += 1

    def bus(self, number: int) -> Any:
        if number > 3:
            raise ValueError(f"No device found for /dev/i2c-{number}")
        return SimpleNamespace(number=number, deinit=self.close)


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Library:
    made = Library()

    class Serial:
        def __init__(self, port: str, baud: int, timeout: float):
            self.port, self.baud = port, baud

        def read(self, size: int = 1) -> bytes:
            return made.bytes[:size]

        def __enter__(self) -> "Serial":
            return self

        def __exit__(self, *_: object) -> None:
            made.close()

    def add(name: str, **content: Any) -> None:
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)

    add(
        "adafruit_bno055",
        IMUPLUS_MODE=8,
        BNO055_I2C=lambda bus, address: made.make("bno055", bus.number, address),
        BNO055_UART=lambda port: made.make("bno055", port.port, port.baud),
    )
    add("adafruit_bno08x", BNO_REPORT_GYROSCOPE=2, BNO_REPORT_ACCELEROMETER=1)
    add("adafruit_bno08x.i2c", BNO08X_I2C=lambda bus, address: made.make("bno085", bus.number, address))

    def over_uart(port: Any) -> Any:
        port.read(1)
        return made.make("bno085", port.port, port.baud)

    add("adafruit_bno08x.uart", BNO08X_UART=over_uart)
    add("adafruit_extended_bus", ExtendedI2C=made.bus)
    add("serial", Serial=Serial)
    return made


@pytest.mark.parametrize(
    ("imu", "opened"),
    [
        (Imu("bno055"), ("bno055", 1, 0x28)),
        (Imu("bno055", "/dev/i2c-3", 0x29), ("bno055", 3, 0x29)),
        (Imu("bno055", "/dev/ttyUSB0"), ("bno055", "/dev/ttyUSB0", 115_200)),
        (Imu("bno085"), ("bno085", 1, 0x4A)),
        (Imu("bno085", "/dev/ttyUSB0"), ("bno085", "/dev/ttyUSB0", 3_000_000)),
    ],
)
def test_sensor_is_opened_read_and_closed(library: Library, imu: Imu, opened: tuple[Any, ...]) -> None:
    sensor = Bno(imu)
    assert library.opened == [opened]
    assert sensor.description == f"{imu.device} on {imu.port}"
    if imu.device == "bno055":
        assert library.sensor.mode == 8, "gyroscope and accelerometer"
    else:
        assert library.sensor.features == [(2, 10_000), (1, 10_000)]
    rate, force = sensor.read()
    np.testing.assert_array_equal(rate, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(force, [0.0, 0.0, 9.8])
    sensor.close()
    sensor.close()
    assert library.closed == 1


def test_port_of_the_settings_replaces_that_of_the_profile(library: Library) -> None:
    assert Bno(Imu("bno055"), "/dev/i2c-2").description == "bno055 on /dev/i2c-2"
    assert library.opened == [("bno055", 2, 0x28)]


@pytest.mark.parametrize("device", ["bno055", "bno085"])
def test_missing_library_names_the_extra(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("adafruit_bno055", "adafruit_bno08x"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImuError, match=rf"{device}: its library cannot be imported .*sextant\[imu\]"):
        Bno(Imu(device))


@pytest.mark.parametrize(
    ("port", "error", "words"),
    [
        (
            "/dev/i2c-1",
            ValueError("No I2C device at address: 0x28"),
            "No I2C device.*`i2cdetect -y 1` should list 28",
        ),
        ("/dev/i2c-1", RuntimeError("bad chip id (0x0 != 0xa0)"), "bad chip id.*check cable and supply"),
        ("/dev/i2c-1", KeyError(223), "KeyError: 223"),
        ("/dev/i2c-1", PermissionError(13, "Permission denied"), "Permission denied.*join the group that owns the port"),
        ("/dev/i2c-7", None, "No device found for /dev/i2c-7"),
        ("/dev/ttyUSB0", OSError("UART access error."), "UART access error.*pins that select its serial protocol"),
    ],
)
def test_absent_sensor_is_reported_and_its_port_released(
    library: Library, port: str, error: Exception | None, words: str
) -> None:
    library.error = error
    with pytest.raises(ImuError, match=words):
        Bno(Imu("bno055", port))
    assert library.closed == (port != "/dev/i2c-7")


def test_silent_serial_port_is_an_error_and_no_endless_wait(library: Library) -> None:
    library.bytes = b""
    with pytest.raises(ImuError, match=r"bno085 on /dev/ttyUSB0: no answer within 0\.5 s"):
        Bno(Imu("bno085", "/dev/ttyUSB0"))
    assert library.closed == 1


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        (Broken(OSError(121, "Remote I/O error")), "Remote I/O error; check its cable and supply"),
        (Broken(IndexError("index out of range")), "IndexError: index out of range"),
        (Sensor(gyro=(None, None, None)), "it has left its measuring mode"),
        (Sensor(acceleration=(0.0, 0.0, 0.0)), "its accelerometer measures nothing"),
    ],
)
def test_failed_reading_is_reported(library: Library, sensor: Any, words: str) -> None:
    opened = Bno(Imu("bno055"))
    opened._sensor = sensor
    with pytest.raises(ImuError, match=words):
        opened.read()


def test_check_names_missing_library_and_port_without_opening_the_sensor(
    library: Library, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert check_port(Imu("bno055", "/dev/null")) == "bno055 on /dev/null"
    with pytest.raises(ImuError, match="bno055 on /dev/i2c-99: the port does not exist"):
        check_port(Imu("bno055", "/dev/i2c-99"))
    assert not library.opened
    monkeypatch.setitem(sys.modules, "adafruit_bno055", None)
    with pytest.raises(ImuError, match=r"sextant\[imu\]"):
        check_port(Imu("bno055", "/dev/null"))


def test_profile_refuses_impossible_ports_and_addresses() -> None:
    for wrong in ({"port": "i2c-1"}, {"address": 0x80}, {"yaw_deg": 200.0}):
        with pytest.raises(ValueError, match="expected"):
            Imu("bno055", **wrong)  # type: ignore[arg-type]
