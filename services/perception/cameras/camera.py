"""Interface of all depth cameras: constructed open, polled for the newest image."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.imu.reading import ImuReading
from sextant.shared.robot.camera import Intrinsics

FOCAL_TOLERANCE = 0.02  # [1] relative tolerance between the device's focal lengths and the profile's
CENTRE_TOLERANCE = 0.02  # [1] tolerance of the principal point, relative to the image size


class CameraError(Exception):
    """Failure to open a camera, or its loss, with cause and remedy as text."""

    def __init__(self, cause: str, remedy: str):
        self.cause, self.remedy = cause, remedy
        super().__init__(f"{cause}; {remedy}")


class RecordingOverError(CameraError):
    """End of a recorded sequence; a retry cannot help."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One depth image, with colour if requested."""

    stamp_ns: int  # [ns] exposure time, on the clock given to the camera
    depth: NDArray[np.uint16]  # (h, w) raw units, 0 = no return
    rgb: NDArray[np.uint8] | None  # (h, w, 3) aligned to the depth pixel by pixel; None if absent or not requested


class Camera(Protocol):
    """Open camera, a context manager; the code that creates it also closes it."""

    description: str  # description for the operator
    recorded: bool  # True for a recording: reopening starts it from the beginning and repairs nothing

    def read(self, color: bool) -> Frame | None:
        """Return the newest unread image, or None if there is none; never waits.

        Args:
            color: Whether to return a colour image with the depth, if available.

        Raises:
            CameraError: The device was disconnected.
        """
        ...

    def read_imu(self) -> Sequence[ImuReading]:
        """Return the new readings of the camera's IMU {optical frame}, oldest first; none without one."""
        return ()

    def close(self) -> None:
        """Release the device; safe to call twice."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class DeviceClock:
    """Conversion of device timestamps to this machine's clock.

    Images arrive with a varying delay. Among the newest images, the one with the smallest delay is assumed to arrive
    immediately. The others are placed relative to it by their device stamps.
    """

    def __init__(self, window: int = 300, delay_ns: int = 0):
        """Create an empty conversion.

        Args:
            window: Number of images searched for the smallest delay; short enough that clock drift is negligible.
            delay_ns: [ns] minimum time from exposure to arrival.
        """
        self._offsets: deque[int] = deque(maxlen=window)
        self._delay_ns = delay_ns
        self._last_ns = 0

    def host_ns(self, device_ns: int, arrived_ns: int) -> int:
        """Return the exposure time [ns] for a device stamp [ns] and arrival time [ns]."""
        if device_ns < self._last_ns:  # the device counts from zero again
            self._offsets.clear()
        self._last_ns = device_ns
        self._offsets.append(arrived_ns - device_ns)
        return device_ns + min(self._offsets) - self._delay_ns


def intrinsics_of(device: str, width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Intrinsics:
    """Return the intrinsics that a device reports.

    Raises:
        CameraError: They are those of no lens.
    """
    try:
        return Intrinsics(width, height, fx, fy, cx, cy)
    except ValueError as error:
        raise CameraError(f"{device} reports invalid intrinsics: {error}", "plug it in again, or calibrate it") from error


def check_intrinsics(device: str, expected: Intrinsics, found: Intrinsics, tolerance: float = FOCAL_TOLERANCE) -> None:
    """Compare the intrinsics reported by a device with the robot's profile.

    Raises:
        CameraError: They differ so much that the map would be distorted.
    """
    size_fits = (found.width, found.height) == (expected.width, expected.height)
    focal = max(abs(found.fx / expected.fx - 1), abs(found.fy / expected.fy - 1))
    centre = max(abs(found.cx - expected.cx) / expected.width, abs(found.cy - expected.cy) / expected.height)
    if size_fits and focal <= tolerance and centre <= CENTRE_TOLERANCE:
        return
    raise CameraError(
        f"{device}: intrinsics {format_intrinsics(expected)} expected by the robot's profile, found {format_intrinsics(found)}",
        "set [camera.intrinsics] of the profile to the values found, or choose the profile of this camera with --robot",
    )


def check_depth_scale(device: str, expected: float, found: float) -> None:
    """Compare a device's raw units per metre with the robot's profile.

    Raises:
        CameraError: They differ.
    """
    if not abs(found / expected - 1) <= 1e-3:  # or NaN
        raise CameraError(
            f"{device}: a depth_scale of {expected:g} units per metre expected by the robot's profile, found {found:g}",
            f"set depth_scale = {found:g} in [camera.sensor] of the profile",
        )


def check_image(device: str, what: str, pixels: NDArray[Any], dtype: type[np.generic], shape: tuple[int, ...]) -> None:
    """Check the type and the shape of an image; `what` names it.

    Raises:
        CameraError: They differ from the expected ones.
    """
    if pixels.dtype != dtype or pixels.shape != shape:
        raise CameraError(
            f"{device}: {what} of {np.dtype(dtype)} {shape} expected, found {pixels.dtype} {pixels.shape}",
            "plug it in again, and end other programs that use it",
        )


def format_intrinsics(i: Intrinsics) -> str:
    """Format intrinsics for display."""
    return f"{i.width}x{i.height}, fx {i.fx:.1f}, fy {i.fy:.1f}, cx {i.cx:.1f}, cy {i.cy:.1f}"
