"""Intel RealSense D400 cameras through pyrealsense2 (librealsense 2.5x)."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.cameras.camera import (
    Camera,
    CameraError,
    DeviceClock,
    Frame,
    check_depth_scale,
    check_image,
    check_intrinsics,
    intrinsics_of,
)
from sextant.services.perception.imu.reading import ImuReading
from sextant.shared.robot.profile import Camera as CameraProfile

_NAME = "Intel RealSense"
_MIN_IMU_HZ = 100  # [Hz] smallest suitable rate of the gyroscope and of the accelerometer
_QUEUED = 64  # readings of the IMU that wait to be read
_FORCE_MS = 100.0  # [ms] largest time between an angular rate and the specific force that goes with it
_PLUG = "plug it into a USB 3 port with its own cable, and check that `rs-enumerate-devices` or `lsusb` lists it"


class RealSense(Camera):
    """First RealSense device found, with depth as measured, colour aligned to it, and its IMU.

    The axes of the IMU are those of the depth camera's optical frame (x right, y down, z forward).
    """

    recorded = False

    def __init__(self, expected: CameraProfile, clock: Callable[[], int], delay_s: float = 0.0, imu: bool = False):
        """Start the streams.

        Args:
            expected: Camera of the robot's profile.
            clock: [ns] clock that stamps the images.
            delay_s: [s] minimum time from exposure to arrival.
            imu: Whether to read the camera's IMU, if it has one; without it, depth is read all the same.

        Raises:
            CameraError: The library or the device is missing, or the device does not match the profile.
        """
        rs = _library()
        self._rs, self._clock = rs, clock
        self._stamps = DeviceClock(delay_ns=round(delay_s * 1e9))
        try:
            self._align = rs.align(rs.stream.depth)
            self._pipeline = rs.pipeline()
        except RuntimeError as error:
            raise CameraError(f"{_NAME}: {error}", _PLUG) from error
        self._shape = (expected.intrinsics.height, expected.intrinsics.width)
        self._color = False
        self._number = -1
        self._imu: tuple[Any, Any] | None = None  # sensor and queue of its readings
        self._imu_stamps = DeviceClock()
        self._force: tuple[float, NDArray[np.float64]] | None = None  # [ms] device stamp and value of the newest specific force
        try:
            profile = self._start(expected)
            self.description = _about(rs, profile.get_device()) + (", with colour" if self._color else "")
            self._check(profile, expected)
            if imu:
                self.description += f", {self._start_imu(profile.get_device())}"
        except RuntimeError as error:
            self.close()
            raise CameraError(f"{_NAME}: {error}", _PLUG) from error
        except CameraError:
            self.close()
            raise

    def close(self) -> None:
        """Stop the streams."""
        imu, self._imu = self._imu, None
        try:
            if imu is not None:
                imu[0].stop()
                imu[0].close()
            self._pipeline.stop()
        except RuntimeError:
            return  # already stopped, or unplugged

    def read(self, color: bool) -> Frame | None:
        """Return the newest image, with depth and colour of the same instant, if any."""
        try:
            frames = self._pipeline.poll_for_frames()
            if frames.size() == 0:
                return None
            taken = frames.get_depth_frame()
            if not taken or taken.get_frame_number() == self._number:
                return None
            self._number = taken.get_frame_number()
            at_ms = float(taken.get_timestamp())
            depth = np.array(np.asanyarray(taken.get_data()))  # copied because the library reuses its memory
            check_image(self.description, "depth", depth, np.uint16, self._shape)
            if not math.isfinite(at_ms):
                raise CameraError(f"{self.description}: a finite time stamp expected, found {at_ms}", _PLUG)
            stamp_ns = self._stamps.host_ns(round(at_ms * 1e6), self._clock())
            rgb = None
            if color and self._color:
                aligned = self._align.process(frames).get_color_frame()
                rgb = np.array(np.asanyarray(aligned.get_data())) if aligned else None
            if rgb is not None:
                check_image(self.description, "colour", rgb, np.uint8, (*self._shape, 3))
        except RuntimeError as error:
            raise CameraError(f"{self.description}: {error}", _PLUG) from error
        return Frame(stamp_ns, depth, rgb)

    def read_imu(self) -> Sequence[ImuReading]:
        """Return the new angular rates, each with the newest specific force."""
        readings: list[ImuReading] = []
        if self._imu is None:
            return readings
        try:
            while frame := self._imu[1].poll_for_frame():
                data, at_ms = frame.as_motion_frame().get_motion_data(), frame.get_timestamp()
                vector = np.array([data.x, data.y, data.z], dtype=np.float64)
                if not (math.isfinite(at_ms) and np.isfinite(vector).all()):
                    continue
                if frame.get_profile().stream_type() == self._rs.stream.accel:
                    self._force = at_ms, vector
                elif self._force is not None and abs(at_ms - self._force[0]) < _FORCE_MS:
                    stamp_ns = self._imu_stamps.host_ns(round(at_ms * 1e6), self._clock())
                    readings.append(ImuReading(stamp_ns, vector, self._force[1]))
        except RuntimeError:
            self._imu = None  # the camera is disconnected, which `read` reports
        return readings

    def _start_imu(self, device: Any) -> str:
        """Start gyroscope and accelerometer, if there are any; return the result as text."""
        try:
            sensor = next((sensor for sensor in device.query_sensors() if sensor.is_motion_sensor()), None)
            if sensor is None:
                return "without IMU"
            streams = [_suited(sensor.get_stream_profiles(), kind) for kind in (self._rs.stream.gyro, self._rs.stream.accel)]
            queue = self._rs.frame_queue(_QUEUED)
            sensor.open(streams)
            self._imu = sensor, queue
            sensor.start(queue)
        except (RuntimeError, ValueError) as error:
            self._imu = None
            return f"without IMU, which does not start: {error}"
        return "with IMU"

    def _start(self, expected: CameraProfile) -> Any:
        """Start depth, and colour if requested and available; return the stream profile."""
        rs, size = self._rs, (expected.intrinsics.width, expected.intrinsics.height)
        rate = round(expected.sensor.rate_hz)
        for with_color in (True, False) if expected.color else (False,):
            config = rs.config()
            config.enable_stream(rs.stream.depth, *size, rs.format.z16, rate)
            if with_color:
                config.enable_stream(rs.stream.color, *size, rs.format.rgb8, rate)
                if not config.can_resolve(rs.pipeline_wrapper(self._pipeline)):
                    continue  # a module without a colour sensor, or a slow USB port
            self._color = with_color
            try:
                return self._pipeline.start(config)
            except RuntimeError as error:
                found = _devices(rs)
                if not found:
                    raise CameraError(f"{_NAME}: no device found ({error})", _PLUG) from error
                raise CameraError(
                    f"{_NAME}: depth of {size[0]}x{size[1]} at {rate} Hz expected by the robot's profile, "
                    f"found {', '.join(found)} that refuses: {error}",
                    "end other programs that use it, use a USB 3 port, or change size and rate_hz in the profile",
                ) from error
        raise AssertionError("unreachable: depth alone is always tried")

    def _check(self, profile: Any, expected: CameraProfile) -> None:
        """Compare the started streams with the robot's profile."""
        unit_m = profile.get_device().first_depth_sensor().get_depth_scale()
        check_depth_scale(self.description, expected.sensor.depth_scale, 1.0 / unit_m if unit_m else math.inf)
        i = profile.get_stream(self._rs.stream.depth).as_video_stream_profile().get_intrinsics()
        found = intrinsics_of(self.description, i.width, i.height, i.fx, i.fy, i.ppx, i.ppy)
        check_intrinsics(self.description, expected.intrinsics, found)


def find() -> list[str]:
    """List the RealSense devices that are plugged in, as text.

    Raises:
        CameraError: The library is missing.
    """
    return _devices(_library())


def _suited(profiles: Any, kind: Any) -> Any:
    """Return the slowest stream of a kind that is fast enough, or the fastest; raises ValueError without any."""
    found = [profile for profile in profiles if profile.stream_type() == kind]
    fast = [profile for profile in found if profile.fps() >= _MIN_IMU_HZ]
    if not found:
        raise ValueError(f"a stream of {kind} expected, found none")
    return min(fast, key=lambda profile: profile.fps()) if fast else max(found, key=lambda profile: profile.fps())


def _library() -> Any:
    try:
        import pyrealsense2 as rs
    except (ImportError, OSError) as error:
        raise CameraError(
            f"{_NAME}: pyrealsense2 cannot be imported ({error})",
            "pip install -e '.[realsense]'; there are wheels for x86-64, elsewhere build librealsense with "
            "-DBUILD_PYTHON_BINDINGS=ON",
        ) from error
    return rs


def _devices(rs: Any) -> list[str]:
    try:
        return [_about(rs, device) for device in rs.context().query_devices()]
    except RuntimeError as error:
        raise CameraError(f"{_NAME}: {error}", _PLUG) from error


def _about(rs: Any, device: Any) -> str:
    """Return name, serial number and port type, as far as the device reports them."""
    kinds = ((rs.camera_info.name, ""), (rs.camera_info.serial_number, "no. "), (rs.camera_info.usb_type_descriptor, "USB "))
    return ", ".join(words + device.get_info(kind) for kind, words in kinds if device.supports(kind)) or _NAME
