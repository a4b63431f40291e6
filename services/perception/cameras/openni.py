"""PrimeSense Carmine, Asus Xtion and similar cameras through OpenNI2.

The Python binding is `openni` 2.3. OpenNI2 itself is a system library, libopenni2-dev in Debian and Ubuntu.
"""

import math
import os
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.cameras.camera import Camera, CameraError, DeviceClock, Frame, check_intrinsics
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.robot.profile import Camera as CameraProfile

_NAME = "OpenNI2"
_PLUG = "plug the camera into a USB 2 port with enough power, check `lsusb`, and that this user may write to its device"
_NOMINAL = 0.04  # [1] OpenNI2 reports the nominal field of view, not that of the individual device
_PAIRED_US = 20_000  # [us] largest difference between the stamps of a depth and a colour image that belong together


class OpenNI(Camera):
    """First OpenNI2 device found.

    If the profile has colour, the device aligns depth to its colour lens.
    """

    recorded = False

    def __init__(self, expected: CameraProfile, clock: Callable[[], int], delay_s: float = 0.0):
        """Start the streams.

        Args:
            expected: Camera of the robot's profile; with colour, the intrinsics are those of the colour lens.
            clock: [ns] clock that stamps the images.
            delay_s: [s] minimum time from exposure to arrival.

        Raises:
            CameraError: The library or the device is missing, or the device does not match the profile.
        """
        self._ni, self._errors = _library()
        self._clock = clock
        self._stamps = DeviceClock(delay_ns=round(delay_s * 1e9))
        self._device: Any = None
        self._depth: Any = None
        self._color: Any = None
        self._rgb: tuple[int, NDArray[np.uint8]] | None = None  # newest colour image and its stamp [us]
        self.description = _NAME
        try:
            self._start(expected)
        except self._errors as error:
            self.close()
            raise CameraError(f"{self.description}: {_words(error)}", _PLUG) from error
        except CameraError:
            self.close()
            raise

    def close(self) -> None:
        """Stop the streams and close the device.

        The library stays initialised, because it detects a device that is plugged in.
        """
        handles = [handle for handle in (self._color, self._depth, self._device) if handle is not None]
        self._color = self._depth = self._device = None
        for handle in handles:
            try:
                handle.close()
            except self._errors:
                continue  # already disconnected

    def read(self, color: bool) -> Frame | None:
        """Return the newest image, with colour if taken at the same time, or None."""
        try:
            if color and self._color is not None and self._ni.wait_for_any_stream([self._color], 0) is not None:
                self._read_color()
            if self._ni.wait_for_any_stream([self._depth], 0) is None:
                return None
            with self._depth.read_frame() as frame:
                arrived_ns, taken_us = self._clock(), int(frame.timestamp)
                depth = np.array(frame.get_buffer_as_uint16(), dtype=np.uint16)
                shape = (int(frame.height), int(frame.width))
        except self._errors as error:
            raise CameraError(f"{self.description}: {_words(error)}", _PLUG) from error
        if depth.size != shape[0] * shape[1]:
            raise CameraError(f"{self.description}: an image of {shape} expected, found {depth.size} pixels", _PLUG)
        rgb = self._rgb[1] if color and self._rgb is not None and abs(self._rgb[0] - taken_us) <= _PAIRED_US else None
        return Frame(self._stamps.host_ns(taken_us * 1000, arrived_ns), depth.reshape(shape), rgb)

    def _read_color(self) -> None:
        with self._color.read_frame() as frame:
            pixels = np.array(frame.get_buffer_as_uint8(), dtype=np.uint8)
            shape = (int(frame.height), int(frame.width), 3)
            self._rgb = (int(frame.timestamp), pixels.reshape(shape)) if pixels.size == math.prod(shape) else None

    def _start(self, expected: CameraProfile) -> None:
        ni, i, rate = self._ni, expected.intrinsics, round(expected.sensor.rate_hz)
        formats = {1000.0: ni.PIXEL_FORMAT_DEPTH_1_MM, 10000.0: ni.PIXEL_FORMAT_DEPTH_100_UM}
        if expected.sensor.depth_scale not in formats:
            raise CameraError(
                f"{_NAME}: a depth_scale of 1000 or 10000 units per metre expected, "
                f"found {expected.sensor.depth_scale:g} in the robot's profile",
                "set depth_scale = 1000.0 in [camera.sensor] of the profile",
            )
        self._device = device = ni.Device.open_any()
        self.description = _about(device.get_device_info())
        self._depth = depth = device.create_depth_stream()
        if depth is None:
            raise CameraError(f"{self.description}: a device with a depth camera expected, found one without", _PLUG)
        depth.configure_mode(i.width, i.height, rate, formats[expected.sensor.depth_scale])
        depth.set_mirroring_enabled(False)  # the drivers mirror by default
        if expected.color:
            self._color = self._start_color(device, i, rate)
        lens = self._color or depth  # lens whose view the images have
        fx = i.width / 2 / math.tan(lens.get_horizontal_fov() / 2)
        fy = i.height / 2 / math.tan(lens.get_vertical_fov() / 2)
        found = Intrinsics(i.width, i.height, fx, fy, (i.width - 1) / 2, (i.height - 1) / 2)
        check_intrinsics(self.description, i, found, _NOMINAL)
        depth.start()
        if self._color is not None:
            self._color.start()
            self.description += ", with colour"

    def _start_color(self, device: Any, i: Intrinsics, rate: int) -> Any:
        """Start the colour stream and align depth to it."""
        ni = self._ni
        color, mode = device.create_color_stream(), ni.IMAGE_REGISTRATION_DEPTH_TO_COLOR
        if color is None or not device.is_image_registration_mode_supported(mode):
            raise CameraError(
                f"{self.description}: colour expected by the robot's profile, found a device without",
                "set color = false in [camera] of the profile, and its intrinsics to those of the depth lens",
            )
        color.configure_mode(i.width, i.height, rate, ni.PIXEL_FORMAT_RGB888)
        color.set_mirroring_enabled(False)
        device.set_image_registration_mode(mode)
        device.set_depth_color_sync_enabled(True)
        return color


def find() -> list[str]:
    """List the OpenNI2 devices that are plugged in, as text.

    Raises:
        CameraError: The binding or the library is missing.
    """
    ni, errors = _library()
    try:
        return [uri.decode(errors="replace") if isinstance(uri, bytes) else str(uri) for uri in ni.Device.enumerate_uris()]
    except errors as error:
        raise CameraError(f"{_NAME}: {_words(error)}", _PLUG) from error


def _library() -> tuple[Any, tuple[type[Exception], ...]]:
    """Return the binding with the system library loaded, and its exception types."""
    try:
        from openni import openni2
        from openni.utils import ClosedHandleError, InitializationError, OpenNIError
    except ImportError as error:
        raise CameraError(f"{_NAME}: the openni binding cannot be imported ({error})", "pip install -e '.[openni]'") from error
    # Search the folders of the binding's environment variables, then the system's.
    named = [os.environ[key] for key in ("OPENNI2_REDIST64", "OPENNI2_REDIST") if os.environ.get(key)]
    folders = [*named, f"/usr/lib/{sysconfig.get_config_var('MULTIARCH')}", "/usr/lib", "/usr/local/lib", "/usr/lib64"]
    try:
        openni2.initialize(folders)
    except InitializationError as error:
        there = [folder for folder in folders if Path(folder, "libOpenNI2.so").exists()]
        cause = f"libOpenNI2.so in {there[0]} does not start" if there else f"libOpenNI2.so not found in {', '.join(folders)}"
        remedy = (
            "check that its drivers are in the same folder, and built for this machine"
            if there
            else "install OpenNI2 (Debian, Ubuntu: `sudo apt install libopenni2-dev`), or set OPENNI2_REDIST to its folder"
        )
        raise CameraError(f"{_NAME}: {cause} ({_words(error)})", remedy) from error
    return openni2, (OpenNIError, ClosedHandleError, OSError, AssertionError)  # the binding asserts valid handles


def _words(error: Exception) -> str:
    """Return the message of an OpenNI2 error, its second argument, as text."""
    said = error.args[1] if len(error.args) > 1 else str(error)
    return (said.decode(errors="replace") if isinstance(said, bytes) else str(said)).strip() or type(error).__name__


def _about(info: Any) -> str:
    """Return vendor and name of a device."""
    words = (part.decode(errors="replace") if isinstance(part, bytes) else str(part) for part in (info.vendor, info.name))
    return " ".join(" ".join(words).split()) or _NAME
