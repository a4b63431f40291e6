"""Stall detection: progress of the robot on its path, so that every attempt ends.

Progress means that less of the path is left than ever before, or that the heading error is smaller than ever since then. A new
path or a new place to look at resets what was reached, because a detour is no stall. The number of such resets is limited until
the robot is nearer to its goal than ever before. So the robot cannot alternate between two paths forever.
"""

from dataclasses import dataclass, field
from math import hypot, inf, pi, radians

import numpy as np

from sextant.services.planner.navigation.params import StallParams
from sextant.shared.geometry import Array


@dataclass(slots=True, eq=False)
class StallDetector:
    """Progress on a path and on the paths that replace it."""

    params: StallParams = field(default_factory=StallParams)
    nearest: float = inf  # [m] shortest remaining path ever
    left: float = inf  # [m] shortest remaining path since the last reset
    error: float = inf  # [rad] smallest heading error since the last progress
    place: Array = field(default_factory=lambda: np.full(3, inf))  # (3,) [m, m, rad] {world} pose of the last motion
    still_s: float = 0.0  # [s] without motion
    no_progress_s: float = 0.0  # [s] without progress
    changed: bool = False  # whether path or place to look at has changed since the last progress
    resets: int = 0  # number of resets
    now_ns: int | None = None  # time of the last update, None after a pause

    def update(self, now_ns: int, place: Array, left: float, error: float, speed: float) -> str:
        """Return why the robot makes no progress, as text, or "".

        Args:
            now_ns: [ns] current time.
            place: (3,) [m, m, rad] {world} current pose.
            left: [m] remaining path.
            error: [rad] absolute heading error.
            speed: [m/s] commanded speed.
        """
        params = self.params
        min_turn = radians(params.min_turn_deg)
        passed = 0.0 if self.now_ns is None else min((now_ns - self.now_ns) * 1e-9, params.pause_s)
        self.now_ns, self.still_s, self.no_progress_s = now_ns, self.still_s + passed, self.no_progress_s + passed
        off = place - self.place
        if not (hypot(off[0], off[1]) <= params.min_progress_m and abs((off[2] + pi) % (2.0 * pi) - pi) <= min_turn):
            self.place, self.still_s = place, 0.0
        if left < self.nearest - params.min_progress_m:
            self.nearest, self.resets = left, 0
        if left < self.left - params.min_progress_m:
            self._begin(left, error)
        elif error < self.error - min_turn:
            self._begin(self.left, error)
        slowly = max(1.0, 2.0 * params.min_progress_m / (speed * params.still_s))
        if self.still_s >= slowly * params.still_s:
            return f"no motion for {self.still_s:.0f} s"
        if self.no_progress_s < slowly * params.no_progress_s:
            return ""
        if self.changed and self.resets < params.max_resets:
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
