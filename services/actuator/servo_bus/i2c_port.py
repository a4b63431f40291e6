"""Port for I2C transfers of a Linux I2C bus, with the interface of a serial port.

Written bytes are encoded transfers (`sextant.shared.servo.pca9685.frame`), read bytes their answers. It needs no library: the
kernel's interface is one system call.
"""

import ctypes
import errno
import fcntl
import os
from collections.abc import Callable

from sextant.shared.servo import pca9685
from sextant.shared.servo.pca9685 import FrameParser, Transfer

PREFIX = "/dev/i2c-"
_I2C_RDWR = 0x0707  # request of linux/i2c-dev.h
_READ = 0x0001  # flag of a message
# Errors of a bus on which no board has acknowledged, or on which one has kept the clock low.
_NO_ANSWER = (errno.ENXIO, errno.EREMOTEIO, errno.EIO, errno.ETIMEDOUT, errno.EAGAIN)


class _Message(ctypes.Structure):
    """`struct i2c_msg` of linux/i2c.h."""

    _fields_ = (
        ("address", ctypes.c_uint16),
        ("flags", ctypes.c_uint16),
        ("size", ctypes.c_uint16),
        ("data", ctypes.POINTER(ctypes.c_uint8)),
    )


class _Messages(ctypes.Structure):
    """`struct i2c_rdwr_ioctl_data` of linux/i2c-dev.h."""

    _fields_ = (("messages", ctypes.POINTER(_Message)), ("count", ctypes.c_uint32))


Call = Callable[[int, int, ctypes.Structure], object]  # of a file descriptor, a request and its data, as fcntl.ioctl


class I2cPort:
    """Open I2C bus."""

    def __init__(self, path: str, call: Call = fcntl.ioctl) -> None:
        """Open the bus; raises OSError if that fails."""
        self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        self._call = call
        self._parser = FrameParser()
        self._answers = bytearray()

    def write(self, data: bytes) -> int:
        """Execute encoded transfers; raises OSError if the bus is gone."""
        if self._file < 0:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        for transfer in self._parser.feed(data):
            self._answers += pca9685.answer(self._transfer(transfer)).ljust(1 + transfer.size, b"\x00")
        return len(data)

    def read(self, size: int = 1) -> bytes:
        """Return at most `size` bytes of answers, which are there when `write` returns."""
        found = bytes(self._answers[:size])
        del self._answers[:size]
        return found

    def reset_input_buffer(self) -> None:
        """Discard the answers."""
        self._answers.clear()

    def close(self) -> None:
        """Close the bus; later use raises OSError."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _transfer(self, transfer: Transfer) -> bytes | None:
        """Return the bytes read, None if no board has acknowledged."""
        sent = (ctypes.c_uint8 * len(transfer.data))(*transfer.data)
        found = (ctypes.c_uint8 * transfer.size)()
        parts = [_Message(transfer.address, 0, len(sent), ctypes.cast(sent, ctypes.POINTER(ctypes.c_uint8)))]
        if transfer.size:
            parts.append(_Message(transfer.address, _READ, len(found), ctypes.cast(found, ctypes.POINTER(ctypes.c_uint8))))
        messages = (_Message * len(parts))(*parts)
        try:
            self._call(self._file, _I2C_RDWR, _Messages(messages, len(parts)))
        except OSError as error:
            if error.errno in _NO_ANSWER:
                return None
            raise
        return bytes(found)
