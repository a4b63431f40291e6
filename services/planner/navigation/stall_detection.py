"""Stall detection: progress of the robot on its path, so that every attempt ends.

Progress means that less of the path is left than ever before, or that the heading error is smaller than ever since then. A new
path or a new place to look at resets what was reached, because a detour is no stall. The number of such resets is limited until
the robot is nearer to its goal than ever before. So the robot cannot alternate between two paths forever.
"""

from dataclasses import dataclass, field
from math import hypot, inf, pi, radians

import numpy as np

from sextant.shared.geometry import Array

_STILL_S = 4.0  # [s] without motion, from which the robot counts as stalled
_NO_PROGRESS_S = 16.0  # [s] with motion but without progress, for example where the robot steps back to look
_MIN_PROGRESS_M = 0.05  # [m] minimum motion or progress
_MIN_TURN_RAD = radians(8.0)  # minimum turn or progress in heading
_MAX_RESETS = 4  # maximum number of resets
_PAUSE_S = 2.5  # [s] maximum time between two updates that counts; longer gaps are pauses


@dataclass(slots=True, eq=False)
class StallDetector:
    """Progress on a path and on the paths that replace it."""

    nearest: float = inf  # [m] shortest remaining path ever
    left: float = inf  # [m] shortest remaining path since the last reset
    error: float = inf  # [rad] smallest heading error since the last progress
    place: Array = field(default_factory=lambda: np.full(3, inf))  # (3,) [m, m, rad] {world} pose of the last motion
    still_s: float = 0.0  # [s] without motion
    no_progress_s: float = 0.0  # [s] without progress
    changed: bool = False  # whether path or place to look at has changed since the last progress
    resets: int = 0  # number of resets
    now_ns: int | None = None

    def update(self, now_ns: int, place: Array, left: float, error: float, speed: float) -> str:
        """Return why the robot makes no progress, as text, or "".

        Args:
            now_ns: [ns] current time.
            place: (3,) [m, m, rad] {world} current pose.
            left: [m] remaining path.
            error: [rad] absolute heading error.
            speed: [m/s] commanded speed.
        """
        passed = 0.0 if self.now_ns is None else min((now_ns - self.now_ns) * 1e-9, _PAUSE_S)
        self.now_ns, self.still_s, self.no_progress_s = now_ns, self.still_s + passed, self.no_progress_s + passed
        off = place - self.place
        if not (hypot(off[0], off[1]) <= _MIN_PROGRESS_M and abs((off[2] + pi) % (2.0 * pi) - pi) <= _MIN_TURN_RAD):
            self.place, self.still_s = place, 0.0
        if left < self.nearest - _MIN_PROGRESS_M:
            self.nearest, self.resets = left, 0
        if left < self.left - _MIN_PROGRESS_M:
            self._begin(left, error)
        elif error < self.error - _MIN_TURN_RAD:
            self._begin(self.left, error)
        slowly = max(1.0, 2.0 * _MIN_PROGRESS_M / (speed * _STILL_S))
        if self.still_s >= slowly * _STILL_S:
            return f"no motion for {self.still_s:.0f} s"
        if self.no_progress_s < slowly * _NO_PROGRESS_S:
            return ""
        if self.changed and self.resets < _MAX_RESETS:
            self.resets += 1
            self._begin(left, error)
            return ""
        return f"no progress for {self.no_progress_s:.0f} s"

    def pause(self) -> None:
        """Exclude the time until the next update.

        Without fresh data or timely plans a robot stands on any ground.
        """
        self.now_ns = None

    def _begin(self, left: float, error: float) -> None:
        self.left, self.error, self.no_progress_s, self.changed = left, error, 0.0, False
