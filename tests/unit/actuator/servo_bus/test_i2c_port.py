"""I2C bus of Linux as a port, with the kernel's call replaced by an emulated board."""

import ctypes
import errno
from pathlib import Path

import pytest

from sextant.services.actuator.servo_bus.i2c_port import I2cPort
from sextant.services.simulator.servo_bus.pca9685_chip import Pca9685Chip
from sextant.shared.servo import pca9685


class Kernel:
    """Board at address 0x40, at the system call of the kernel."""

    def __init__(self) -> None:
        self.chip = Pca9685Chip(25e6)
        self.error = 0

    def ioctl(self, file: int, request: int, data: ctypes.Structure) -> int:
        assert request == 0x0707
        if self.error:
            raise OSError(self.error, "error")
        written, answer = data.messages[0], data.messages[data.count - 1]
        assert (written.flags, data.count) in ((0, 1), (0, 2))
        if written.address != 0x40:
            raise OSError(errno.EREMOTEIO, "no acknowledgement")
        size = answer.size if data.count == 2 else 0
        found = self.chip.transfer(bytes(written.data[: written.size]), size)
        for k, byte in enumerate(found):
            answer.data[k] = byte
        return data.count


@pytest.fixture
def kernel() -> Kernel:
    return Kernel()


@pytest.fixture
def port(kernel: Kernel, tmp_path: Path) -> I2cPort:
    path = tmp_path / "i2c-1"
    path.touch()
    return I2cPort(str(path), kernel.ioctl)


def test_registers_are_written_and_read(port: I2cPort, kernel: Kernel) -> None:
    port.write(pca9685.frame(pca9685.write(0x40, pca9685.MODE1, (pca9685.AUTO_INCREMENT | pca9685.SLEEP,))))
    assert port.read(1) == b"\x01"
    port.write(pca9685.frame(pca9685.read(0x40, pca9685.MODE1, 2)))
    assert port.read(10) == bytes((1, 0x30, pca9685.MODE2_RESET))
    assert kernel.chip.registers[pca9685.MODE1] == 0x30


def test_an_address_without_a_board_is_not_acknowledged(port: I2cPort) -> None:
    port.write(pca9685.frame(pca9685.read(0x41, pca9685.MODE1, 2)))
    assert port.read(10) == bytes(3)


def test_a_bus_that_is_gone_is_raised(port: I2cPort, kernel: Kernel) -> None:
    kernel.error = errno.ENODEV
    with pytest.raises(OSError, match="error"):
        port.write(pca9685.frame(pca9685.read(0x40, pca9685.MODE1, 1)))


def test_a_closed_port_raises(tmp_path: Path) -> None:
    path = tmp_path / "i2c-1"
    path.touch()
    port = I2cPort(str(path))
    port.close()
    port.close()
    with pytest.raises(OSError, match="file descriptor"):
        port.write(pca9685.frame(pca9685.read(0x40, pca9685.MODE1, 1)))
