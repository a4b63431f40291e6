"""Orbbec cameras (Gemini 2, Gemini 330, Femto, Astra 2) through pyorbbecsdk 2."""

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np

from sextant.services.perception.cameras.camera import (
    Camera,
    CameraError,
    DeviceClock,
    Frame,
    check_depth_scale,
    check_intrinsics,
    intrinsics_of,
)
from sextant.shared.robot.profile import Camera as CameraProfile

_NAME = "Orbbec"
_PLUG = "plug it into a USB 3 port with its own cable, and install Orbbec's udev rules (99-obsensor-libusb.rules)"
_WAIT_MS = 1  # of one reading
_MOST_WAITING = 16  # images that wait in the library


class Orbbec(Camera):
    """First Orbbec camera found, with depth as measured, and colour aligned to it."""

    recorded = False

    def __init__(self, expected: CameraProfile, clock: Callable[[], int], delay_s: float = 0.0):
        """Start the streams.

        Args:
            expected: Camera of the robot's profile.
            clock: [ns] clock that stamps the images.
            delay_s: [s] minimum time from exposure to arrival.

        Raises:
            CameraError: The library or the device is missing, or the device does not match the profile.
        """
        self._ob = ob = _library()
        self._errors = (ob.OBError, RuntimeError)
        self._expected, self._clock = expected, clock
        self._stamps = DeviceClock(delay_ns=round(delay_s * 1e9))
        self._pipeline: Any = None
        self._color = False
        self.description = _NAME
        try:
            self._pipeline = ob.Pipeline()
            self.description = _about(self._pipeline.get_device().get_device_info())
            self._align = ob.AlignFilter(align_to_stream=ob.OBStreamType.DEPTH_STREAM)
            self._start()
        except self._errors as error:
            self.close()
            raise CameraError(f"{self.description}: {error}", _PLUG) from error
        except CameraError:
            self.close()
            raise

    def close(self) -> None:
        """Stop the streams."""
        pipeline, self._pipeline = self._pipeline, None
        with contextlib.suppress(*self._errors):  # it may be unplugged
            if pipeline is not None:
                pipeline.stop()

    def read(self, color: bool) -> Frame | None:
        """Return the newest image, with depth and colour of the same instant, if any."""
        newest = None
        try:
            for _ in range(_MOST_WAITING):
                if (frames := self._pipeline.wait_for_frames(_WAIT_MS)) is None:
                    break
                newest = frames
            depth = None if newest is None else newest.get_depth_frame()
            if depth is None:
                return None
            stamp_ns = self._stamps.host_ns(depth.get_timestamp_us() * 1000, self._clock())
            unit_mm = depth.get_depth_scale()
            check_depth_scale(self.description, self._expected.sensor.depth_scale, 1000.0 / unit_mm if unit_mm > 0 else 0.0)
            shape = (depth.get_height(), depth.get_width())
            raw = np.array(depth.get_data(), dtype=np.uint8)  # copied because the library reuses its memory
            rgb = self._rgb(newest, shape) if color and self._color else None
        except self._errors as error:
            raise CameraError(f"{self.description}: {error}", _PLUG) from error
        if raw.size != 2 * shape[0] * shape[1]:
            raise CameraError(f"{self.description}: depth {shape} of 16 bits expected, found {raw.size} bytes", _PLUG)
        return Frame(stamp_ns, raw.view("<u2").reshape(shape).astype(np.uint16), rgb)

    def _rgb(self, frames: Any, shape: tuple[int, int]) -> Any:
        """Return the colour image (h, w, 3) aligned to the depth; None if there is none of that size."""
        aligned = self._align.process(frames)
        found = None if aligned is None else aligned.as_frame_set().get_color_frame()
        if found is None:
            return None
        pixels = np.array(found.get_data(), dtype=np.uint8)
        return pixels.reshape(*shape, 3) if pixels.size == 3 * shape[0] * shape[1] else None

    def _start(self) -> None:
        """Start depth, and colour if requested and available."""
        ob, i, rate = self._ob, self._expected.intrinsics, round(self._expected.sensor.rate_hz)
        config = ob.Config()
        try:
            profiles = self._pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR)
            profile = profiles.get_video_stream_profile(i.width, i.height, ob.OBFormat.Y16, rate)
        except self._errors as error:
            raise CameraError(
                f"{self.description}: depth of {i.width}x{i.height} at {rate} Hz in 16 bits expected by the robot's profile, "
                f"found a camera that refuses: {error}",
                "change size and rate_hz in the profile, or end other programs that use the camera",
            ) from error
        lens = profile.get_intrinsic()
        found = intrinsics_of(self.description, profile.get_width(), profile.get_height(), lens.fx, lens.fy, lens.cx, lens.cy)
        check_intrinsics(self.description, i, found)
        config.enable_stream(profile)
        if self._expected.color:
            self._enable_color(config, rate)
        self._pipeline.start(config)

    def _enable_color(self, config: Any, rate: int) -> None:
        ob = self._ob
        try:
            profiles = self._pipeline.get_stream_profile_list(ob.OBSensorType.COLOR_SENSOR)
            config.enable_stream(profiles.get_video_stream_profile(0, 0, ob.OBFormat.RGB, rate))
            config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
        except self._errors:
            return  # a camera without colour in this format and rate
        self._color = True
        self.description += ", with colour"


def find() -> list[str]:
    """List the Orbbec cameras that are plugged in, as text.

    Raises:
        CameraError: The library is missing, or the search failed.
    """
    ob = _library()
    try:
        devices = ob.Context().query_devices()
        numbers = range(devices.get_count())
        return [f"{devices.get_device_name_by_index(n)}, no. {devices.get_device_serial_number_by_index(n)}" for n in numbers]
    except (ob.OBError, RuntimeError) as error:
        raise CameraError(f"{_NAME}: {error}", _PLUG) from error


def _library() -> Any:
    try:
        import pyorbbecsdk
    except (ImportError, OSError) as error:
        raise CameraError(
            f"{_NAME}: pyorbbecsdk cannot be imported ({error})",
            "pip install --no-deps 'pyorbbecsdk2>=2.1,<3'; without --no-deps it brings viewers, which Sextant does not need",
        ) from error
    return pyorbbecsdk


def _about(info: Any) -> str:
    """Return name, serial number and port type."""
    return f"{info.get_name()}, no. {info.get_serial_number()}, {info.get_connection_type()}"
