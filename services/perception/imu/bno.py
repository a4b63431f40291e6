"""Bosch BNO055 and Hillcrest BNO085 through Adafruit's libraries, on an I2C bus or a serial port of Linux."""

import contextlib
import errno
import importlib
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from sextant.services.perception.imu.reading import ImuError
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import Imu

MODELS = ("bno055", "bno085")
_ADDRESSES = {"bno055": 0x28, "bno085": 0x4A}  # of the sensors as delivered
_BAUD = {"bno055": 115_200, "bno085": 3_000_000}
_INTERVAL_US = 10_000  # [us] between two reports of a BNO085; a BNO055 measures 100 times a second by itself
_TIMEOUT_S = 0.5  # [s] of a serial port
_GROUP = "join the group that owns the port, i2c or dialout"
_I2C = re.compile(r"/dev/i2c-(\d+)")
_INSTALL = "pip install 'sextant[imu]', in a checkout '.[imu]'"


class Bno:
    """Open sensor; the code that creates it also closes it."""

    def __init__(self, imu: Imu, port: str = ""):
        """Open the sensor, reset it, and start gyroscope and accelerometer; this takes one to three seconds.

        Args:
            imu: IMU of the robot's profile.
            port: Port in place of the profile's.

        Raises:
            ImuError: The library, the port or the sensor is missing; the error gives the cause.
        """
        self._port = port or imu.port
        self.description = f"{imu.device} on {self._port}"
        self._closing = contextlib.ExitStack()
        try:
            self._sensor = self._opened(imu)
        except ImportError as error:
            raise ImuError(f"{imu.device}: its library cannot be imported ({error})", _INSTALL) from error
        except Exception as error:  # for a silent sensor the libraries raise errors of many kinds
            self.close()
            raise ImuError(f"{self.description}: {_words(error)}", self._advice(imu, error)) from error

    def read(self) -> tuple[Array, Array]:
        """Return the newest angular rate (3,) [rad/s] and specific force (3,) [m/s^2], in the axes of the sensor.

        Raises:
            ImuError: The sensor does not answer, or has left its measuring mode.
        """
        try:
            rate, force = self._sensor.gyro, self._sensor.acceleration
        except Exception as error:  # for broken packets the libraries raise errors of many kinds
            raise ImuError(f"{self.description}: {_words(error)}", "check its cable and supply") from error
        if None in (*rate, *force):
            raise ImuError(f"{self.description}: it has left its measuring mode", "check its cable and supply")
        if not any(force):  # before the first measurement
            raise ImuError(f"{self.description}: its accelerometer measures nothing", "check its cable and supply")
        return np.array(rate, dtype=np.float64), np.array(force, dtype=np.float64)

    def close(self) -> None:
        """Release the port; safe to call twice."""
        with contextlib.suppress(OSError):
            self._closing.close()

    def _opened(self, imu: Imu) -> Any:
        bus = _I2C.fullmatch(self._port)
        address = imu.address or _ADDRESSES[imu.device]
        if imu.device == "bno055":
            import adafruit_bno055 as bno055

            port = self._bus(int(bus[1])) if bus else self._serial(imu)
            sensor = bno055.BNO055_I2C(port, address) if bus else bno055.BNO055_UART(port)
            sensor.mode = bno055.IMUPLUS_MODE  # gyroscope and accelerometer, calibrated by the sensor; no magnetometer
            return sensor
        import adafruit_bno08x as bno08x
        from adafruit_bno08x.i2c import BNO08X_I2C
        from adafruit_bno08x.uart import BNO08X_UART

        port = self._bus(int(bus[1])) if bus else self._serial(imu)
        sensor = BNO08X_I2C(port, address=address) if bus else BNO08X_UART(port)
        for report in (bno08x.BNO_REPORT_GYROSCOPE, bno08x.BNO_REPORT_ACCELEROMETER):
            sensor.enable_feature(report, _INTERVAL_US)
        return sensor

    def _bus(self, number: int) -> Any:
        from adafruit_extended_bus import ExtendedI2C

        bus = ExtendedI2C(number)
        self._closing.callback(bus.deinit)
        return bus

    def _serial(self, imu: Imu) -> Any:
        import serial

        class Port(serial.Serial):
            """Serial port whose silence is an error: Adafruit's library would wait for ever."""

            def read(self, size: int = 1) -> Any:
                found = super().read(size)
                if size and not found:
                    raise TimeoutError(f"no answer within {_TIMEOUT_S:g} s")
                return found

        return self._closing.enter_context(Port(self._port, _BAUD[imu.device], timeout=_TIMEOUT_S))

    def _advice(self, imu: Imu, error: Exception) -> str:
        if isinstance(error, OSError) and error.errno == errno.EACCES:
            return _GROUP
        if _I2C.fullmatch(self._port):
            look = f"i2cdetect -y {self._port.removeprefix('/dev/i2c-')}"
            address = f"{imu.address or _ADDRESSES[imu.device]:02x}"
            return f"check cable and supply; `{look}` should list {address}, or set address in the profile's [imu]"
        return "check cable, supply, the pins that select its serial protocol, and the port in the profile's [imu]"


def check_port(imu: Imu) -> str:
    """Return the name of a sensor whose library is installed and whose port exists; the sensor is not touched.

    Raises:
        ImuError: One of them is missing, or the port may not be opened.
    """
    description = f"{imu.device} on {imu.port}"
    try:
        importlib.import_module("adafruit_bno055" if imu.device == "bno055" else "adafruit_bno08x")
    except ImportError as error:
        raise ImuError(f"{imu.device}: its library cannot be imported ({error})", _INSTALL) from error
    if not Path(imu.port).exists():
        raise ImuError(f"{description}: the port does not exist", "plug the sensor in, enable I2C, or correct port in [imu]")
    if not os.access(imu.port, os.R_OK | os.W_OK):
        raise ImuError(f"{description}: the port may not be opened", _GROUP)
    return description


def _words(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if isinstance(error, LookupError) or not str(error) else str(error)
