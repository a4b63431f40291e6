"""Whether a robot that is led gets on, so that whatever it tries has an end.

It gets on where less of its way is left than ever, and where since then it faces nearer to where it should than ever. What is
new to it (a longer way, another place to look at) may undo that, for no detour is a standstill, but only so often until it is
nearer to the end than ever: of two ways by turns none leads there.
"""

from dataclasses import dataclass, field
from math import hypot, inf, pi, radians

import numpy as np

from sextant.shared.geometry import Array

_STILL_S = 4.0  # [s] in which it does not move, from which it does not get on, and
_ASTRAY_S = 16.0  # [s] in which it does move, as where it steps back to look, but comes no nearer
_GOT_ON = 0.05  # [m], or
_TURNED = radians(8.0)  # by which it must move or come nearer
_ANEW = 4  # times that what is new may undo what it had reached
_PAUSE_S = 2.5  # [s] between two updates, at most, that count: for longer it was not led


@dataclass(slots=True, eq=False)
class Progress:
    """Of one way, and those that take its place."""

    nearest: float = inf  # [m] the least that was ever left
    left: float = inf  # [m] likewise since it last began anew
    error: float = inf  # [rad] likewise off where it should face, since then
    place: Array = field(default_factory=lambda: np.full(3, inf))  # (3,) [m, m, rad] {world} where it last began to stand
    still_s: float = 0.0  # [s] for which it has not moved
    astray_s: float = 0.0  # [s] for which it has come no nearer
    changed: bool = False  # whether its way or what it looks at has, since it last came nearer
    undone: int = 0  # times
    now_ns: int | None = None

    def update(self, now_ns: int, place: Array, left: float, error: float, speed: float) -> str:
        """Why it does not get on, in words, or nothing.

        Args:
            now_ns: [ns]
            place: (3,) [m, m, rad] {world} where it is.
            left: [m] of its way.
            error: [rad] off where it should face, 0 and more.
            speed: [m/s] at which it is to walk.
        """
        passed = 0.0 if self.now_ns is None else min((now_ns - self.now_ns) * 1e-9, _PAUSE_S)
        self.now_ns, self.still_s, self.astray_s = now_ns, self.still_s + passed, self.astray_s + passed
        off = place - self.place
        if not (hypot(off[0], off[1]) <= _GOT_ON and abs((off[2] + pi) % (2.0 * pi) - pi) <= _TURNED):
            self.place, self.still_s = place, 0.0
        if left < self.nearest - _GOT_ON:
            self.nearest, self.undone = left, 0
        if left < self.left - _GOT_ON:
            self._begin(left, error)
        elif error < self.error - _TURNED:
            self._begin(self.left, error)
        slowly = max(1.0, 2.0 * _GOT_ON / (speed * _STILL_S))
        if self.still_s >= slowly * _STILL_S:
            return f"in {self.still_s:.0f} s it did not move"
        if self.astray_s < slowly * _ASTRAY_S:
            return ""
        if self.changed and self.undone < _ANEW:
            self.undone += 1
            self._begin(left, error)
            return ""
        return f"in {self.astray_s:.0f} s it came no nearer"

    def pause(self) -> None:
        """Leave out the time until the next update: without fresh data, or plans in time, a robot stands on any ground."""
        self.now_ns = None

    def _begin(self, left: float, error: float) -> None:
        self.left, self.error, self.astray_s, self.changed = left, error, 0.0, False
