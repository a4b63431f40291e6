"""Recorded folder in the TUM RGB-D layout as a camera.

It contains depth.txt, camera.toml and, with colour, rgb.txt.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from sextant.services.perception import tum
from sextant.services.perception.cameras.camera import (
    Camera,
    CameraError,
    Frame,
    RecordingOverError,
    check_depth_scale,
    check_intrinsics,
)
from sextant.shared.robot.profile import Camera as CameraProfile

_REMEDY = "give a folder with depth.txt and camera.toml, as `sextant run --lockstep --record-depth` writes it"


class FolderCamera(Camera):
    """Camera that replays a recording in real time; unreadable images are skipped."""

    recorded = True

    def __init__(self, folder: Path, expected: CameraProfile, clock: Callable[[], int], loop: bool = True):
        """Open a recording.

        Args:
            folder: Folder of the recording.
            expected: Camera of the robot's profile.
            clock: [ns] clock that stamps the images.
            loop: Whether to restart at the end.

        Raises:
            CameraError: The recording cannot be read, or is from another camera.
        """
        name = f"recording {folder}"
        try:
            self._recording = tum.read_recording(folder)
        except (OSError, ValueError) as error:
            raise CameraError(f"{name} cannot be read: {error}", _REMEDY) from error
        check_intrinsics(name, expected.intrinsics, self._recording.camera.intrinsics)
        check_depth_scale(name, expected.sensor.depth_scale, self._recording.camera.depth_scale)
        colored = "" if self._recording.colors is None else ", with colour"
        self._whole = self.description = f"{name}: {len(self._recording)} images{colored}"
        self._clock, self._loop = clock, loop
        self._folder, self._unreadable = folder, 0
        self._next = 0
        self._round_ns: int | None = None  # time at which the first image of this round is due

    def close(self) -> None:
        """Do nothing, because no file stays open."""

    def read(self, color: bool) -> Frame | None:
        """Return the image that is due; skip earlier ones, as a device would drop them."""
        stamps = self._recording.stamps_ns - self._recording.stamps_ns[0]
        now_ns = self._clock()
        if self._round_ns is None:
            self._round_ns = now_ns
        if self._next == len(stamps):
            if not self._loop:
                raise RecordingOverError(f"{self.description}: the recording has ended", "set loop=true to repeat it")
            period_ns = round(1e9 / self._recording.camera.rate_hz)
            self._next, self._round_ns = 0, max(self._round_ns + int(stamps[-1]) + period_ns, now_ns - period_ns)
        due = int(np.searchsorted(stamps, now_ns - self._round_ns, side="right"))
        if due <= self._next:
            return None
        self._next = due
        return self._frame(due - 1, self._round_ns + int(stamps[due - 1]), color)

    def _frame(self, index: int, stamp_ns: int, color: bool) -> Frame | None:
        try:
            depth = self._recording.depth(index)
            rgb = self._recording.color(index) if color else None
        except (OSError, ValueError) as error:
            if not self._folder.is_dir():
                raise CameraError(f"{self._whole}: the folder is gone", _REMEDY) from error
            self._unreadable += 1
            self.description = f"{self._whole}; {self._unreadable} images could not be read: {error}"
            return None
        return Frame(stamp_ns, depth, rgb)
