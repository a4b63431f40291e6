"""Camera of another program, which publishes its depth frames on `external/depth`."""

from collections import deque
from collections.abc import Callable

from sextant.services.perception.cameras.camera import (
    Camera,
    CameraError,
    Frame,
    check_depth_scale,
    check_intrinsics,
    intrinsics_of,
)
from sextant.shared.robot.profile import Camera as CameraProfile
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ExternalDepth

_AHEAD_S = 0.05  # [s] of a stamp ahead of the robot's clock, at most
_OLD_S = 1.0  # [s] of a stamp behind it, at most
_STAMP = "stamp frames with the time of their exposure on the robot's clock, which is the monotonic clock of its computer"


class ExternalCamera(Camera):
    """Depth frames of another program, compared with the robot's profile."""

    recorded = False

    def __init__(self, expected: CameraProfile, frames: deque[ExternalDepth], clock: Callable[[], int]):
        """Begin to read.

        Args:
            expected: Camera of the robot's profile.
            frames: Received frames; another thread may add to them.
            clock: [ns] the robot's clock.
        """
        self.description = f"camera of another program on {topics.EXTERNAL_DEPTH.key}"
        self._expected, self._frames, self._clock = expected, frames, clock
        frames.clear()  # they may have waited

    def close(self) -> None:
        """Do nothing, because the other program has the device."""

    def read(self, color: bool) -> Frame | None:
        """Return the newest frame; it has no colour."""
        try:
            found = self._frames.pop()
        except IndexError:
            return None
        late_s = (self._clock() - found.stamp_ns) * 1e-9
        if not -_AHEAD_S <= late_s <= _OLD_S:
            when = f"{late_s:.2f} s old" if late_s > 0 else f"stamped {-late_s:.2f} s in the future"
            raise CameraError(f"{self.description}: a frame of now expected, found one that is {when}", _STAMP)
        height, width = found.depth.shape
        lens = intrinsics_of(self.description, width, height, found.fx, found.fy, found.cx, found.cy)
        check_intrinsics(self.description, self._expected.intrinsics, lens)
        check_depth_scale(self.description, self._expected.sensor.depth_scale, found.depth_scale)
        return Frame(found.stamp_ns, found.depth, None)
