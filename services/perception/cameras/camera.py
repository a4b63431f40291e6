"""What every depth camera looks like from here: opened by being made, asked for its newest picture, closed."""

from collections import deque
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sextant.shared.robot.camera import Intrinsics

FOCAL_TOLERANCE = 0.02  # [1] by which a device's focal lengths may differ from the profile's
CENTRE_TOLERANCE = 0.02  # [1] of the picture's size, by which its principal point may


class CameraError(Exception):
    """A camera that cannot be opened, or has gone: what happened, and what to do about it, in words."""

    def __init__(self, cause: str, remedy: str):
        self.cause, self.remedy = cause, remedy
        super().__init__(f"{cause}; {remedy}")


class RecordingOverError(CameraError):
    """The last picture of a recorded sequence has been handed out; there is nothing to try again."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture."""

    stamp_ns: int  # [ns] when it was taken, on the clock that the camera was given
    depth: NDArray[np.uint16]  # (h, w) raw units, 0 for no return
    rgb: NDArray[np.uint8] | None  # (h, w, 3), pixel for pixel over the depth; None where there is none, or none was wanted


class Camera(Protocol):
    """A camera that is open; a context manager. Whoever made it closes it."""

    about: str  # what it is, in words
    recorded: bool  # no device: to open it anew begins it anew, and mends nothing

    def read(self, color: bool) -> Frame | None:
        """The newest picture that has not been handed out, or None while there is none; never waits.

        Args:
            color: Whether a colour picture is wanted beside the depth, where there is one.

        Raises:
            CameraError: The device is gone.
        """
        ...

    def close(self) -> None:
        """Let the device go; safe to call twice."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...


class DeviceClock:
    """Turns the stamps that a device counts by itself into times of this machine's clock.

    Pictures come late by a varying delay. The one that came with the least of it among the newest is taken to have come at
    once; the others lie as far behind or before it as the device says.
    """

    def __init__(self, window: int = 300, delay_ns: int = 0):
        """Begin.

        Args:
            window: Pictures among which the least delay is looked for; short enough that the clocks do not drift apart.
            delay_ns: [ns] from exposure to arrival at the least.
        """
        self._offsets: deque[int] = deque(maxlen=window)
        self._delay_ns = delay_ns
        self._last_ns = 0

    def host_ns(self, device_ns: int, arrived_ns: int) -> int:
        """When a picture was taken [ns], by the device's stamp [ns] and when it came [ns]."""
        if device_ns < self._last_ns:  # it counts from zero again
            self._offsets.clear()
        self._last_ns = device_ns
        self._offsets.append(arrived_ns - device_ns)
        return device_ns + min(self._offsets) - self._delay_ns


def check_intrinsics(device: str, expected: Intrinsics, found: Intrinsics, tolerance: float = FOCAL_TOLERANCE) -> None:
    """Compare what a device says of its lens with the robot's profile.

    Raises:
        CameraError: They are so far apart that the map would be bent.
    """
    size_fits = (found.width, found.height) == (expected.width, expected.height)
    focal = max(abs(found.fx / expected.fx - 1), abs(found.fy / expected.fy - 1))
    centre = max(abs(found.cx - expected.cx) / expected.width, abs(found.cy - expected.cy) / expected.height)
    if size_fits and focal <= tolerance and centre <= CENTRE_TOLERANCE:
        return
    raise CameraError(
        f"{device}: intrinsics {in_words(expected)} expected by the robot's profile, found {in_words(found)}",
        "set [camera.intrinsics] of the profile to what is found, or choose the profile of this camera with --robot",
    )


def check_depth_scale(device: str, expected: float, found: float) -> None:
    """Compare a device's raw units per metre with the robot's profile.

    Raises:
        CameraError: They differ.
    """
    if abs(found / expected - 1) > 1e-3:
        raise CameraError(
            f"{device}: a depth_scale of {expected:g} units per metre expected by the robot's profile, found {found:g}",
            f"set depth_scale = {found:g} in [camera.sensor] of the profile",
        )


def in_words(i: Intrinsics) -> str:
    """Intrinsics for a reader."""
    return f"{i.width}x{i.height}, fx {i.fx:.1f}, fy {i.fy:.1f}, cx {i.cx:.1f}, cy {i.cy:.1f}"
