"""Path of a swinging foot by Lotriet's flow function.

The flow gives the direction of the foot's motion at any moment.

Source: Lotriet 2024, section 5.4.2. A foot at the horizontal distance x before its target and the height y over it moves along
the gradient of the parabola through both points, eq. (5.23) with f_b = y/x - f_a x (the printed (5.25) lost the x):

    dy/ds = -y/x + (|v_h/x| + |S|) x = -y/x + v_h + |S| x,      s = progress towards the target

Without S its solution is y = v_h x ln(L/x): it peaks at v_h L / e, where x = L/e, and comes down vertically. So v_h, the
thesis' step height parameter, follows from a clearance h as e h / L. In the thesis, S goes from -1 to 0 where y passes the
level q (5.26). Its constants only shape a sigmoid, so that the foot would turn from rising to arcing within a millimetre,
which at full speed demands the maximum of the servos. Here S changes gradually from the height of the higher end up to the
level, which lies over it. Thus a foot rises next to a riser before it crosses it, and passes an edge before it descends
behind it. In the last third of the path S fades, so that the foot does not hover and then plunge.
"""

import math
from itertools import pairwise

from sextant.shared.geometry import Array

_RISE_SLOPE, _RISE_WAY = 4.5, 0.25  # slope of the initial rise, and its largest share of the path
_LEVEL_SHARE = 0.8  # of the clearance, over the higher end: above it the foot arcs; obstacles may be close to the foot
_ARC_SHARE = 0.97  # of the clearance at which the arc would peak; the tail of S adds the rest
_FADE_SHARES = (0.15, 0.35)  # shares of the remaining path between which S fades
_ARC_SHARES = [i / 8 for i in range(9)]  # of the remaining path, at which the arc is measured
_ARC_LOGS = [s * math.log(s) if s else 0.0 for s in _ARC_SHARES]
_HEIGHT_COST = 2.0  # [1] time for height relative to horizontal distance, because height is slow for the servos
_START, _END, _END_SPEED = 0.08, 0.18, 0.35  # shares of the time for acceleration and deceleration, and the final speed share
_SUBSTEPS = 4  # per cycle, because the field turns within a centimetre
_NEWTON_STEPS = 8
_AT_TARGET_M = 1e-3  # [m] horizontal distance from the target, below which the foot moves straight down
_MIN_RISE_M = 1e-3  # [m] minimum rise over the higher end if the clearance is zero


def flow_slope(x: float, y: float, v_h: float, level: float, over: float, rise: float) -> float:
    """Return the slope dy/ds of a foot's path: rise per distance towards the target.

    Args:
        x: [m] horizontal distance to the target, positive.
        y: [m] height over the target.
        v_h: Step height parameter, see `clearance_parameter`.
        level: [m] height over the target from which the foot arcs rather than rises (the thesis' q).
        over: [m] height of the level over the higher end, over which the foot turns.
        rise: Slope of the initial rise S, 0 towards the end.

    Source: Lotriet 2024, eq. (5.23)-(5.26), with S instead of the latter's sigmoid.
    """
    below = min(max((level - y) / over, 0.0), 1.0)
    return -y / x + v_h + rise * _smooth(below)


def clearance_parameter(top: float, x: float, y: float) -> float:
    """Return the v_h whose arc from x and y [m] peaks at `top` [m] over the target.

    v_h is the step height parameter. From there the flow's solution is u s ln(1/s) + y s with u = v_h x and s the remaining
    share of x. Its peak, u exp(y/u - 1), is the top where w = y/u solves w - ln w = 1 + ln(top/y). Newton's iteration
    approaches w from below.
    """
    y = max(y, 1e-4)
    right = 1.0 + math.log(max(top / y, 1.0))
    w = math.exp(-right)
    for _ in range(_NEWTON_STEPS):
        w = min(w + (w - math.log(w) - right) * w / (1.0 - w + 1e-9), 1.0)
    return y / (w * x)


def remaining_length(x: float, y: float, v_h: float, level: float, rise: float = 1.0) -> float:
    """Return the approximate remaining path [m], with weighted height.

    The path goes up to the level, then along the arc.
    """
    if x <= _AT_TARGET_M:
        return math.hypot(x, _HEIGHT_COST * y)
    up = max(0.0, level - y) * rise
    top, u, along = y + up, v_h * x, x / (len(_ARC_SHARES) - 1)
    arc = [_HEIGHT_COST * (s * top - u * s_log) for s, s_log in zip(_ARC_SHARES, _ARC_LOGS, strict=True)]
    return _HEIGHT_COST * up + sum(math.hypot(along, b - a) for a, b in pairwise(arc))


class Swing:
    """Feet in the air, each on its path to a target that may move.

    Feet follow the flow with a speed profile that ramps up and down. They reach their targets when the time is over, even if
    the targets move: in each cycle they travel a share of the remaining path.
    """

    def __init__(self, foot: Array, target: Array, clearance: Array):
        """Begin a swing.

        Args:
            foot: (n, 3) [m] {odom} present feet.
            target: (n, 3) [m] {odom} footholds.
            clearance: (n,) [m] over the higher end.
        """
        self.foot = foot.copy()
        self._flights = [_Flight(*ends) for ends in zip(foot.tolist(), target.tolist(), clearance.tolist(), strict=True)]

    def update(self, target: Array, progress: float, step: float) -> Array:
        """Advance by a fraction of the swing's duration.

        Args:
            target: (n, 3) [m] {odom} present footholds.
            progress: Finished share of the swing, 0 to 1.
            step: Share to advance by.

        Returns:
            (n, 3) [m] {odom} the feet.
        """
        progress, end = min(progress, 1.0), min(progress + step, 1.0)
        if end >= 1.0:
            self.foot[:] = target
            return self.foot
        share = _travelled(end, progress)
        for foot, flight, aim in zip(self.foot, self._flights, target.tolist(), strict=True):
            foot[:] = flight.moved(foot.tolist(), aim, share)
        return self.foot


class _Flight:
    """Path of one foot, in Python floats, which are faster than arrays of three."""

    def __init__(self, foot: list[float], target: list[float], clearance: float):
        self._start_z = foot[2]
        self._rise_by = max(_LEVEL_SHARE * clearance, _MIN_RISE_M)  # [m] over the higher end
        self._length = max(math.hypot(target[0] - foot[0], target[1] - foot[1]), 0.02)
        higher = max(foot[2] - target[2], 0.0)
        rise = self._rise_by + max(target[2] - foot[2], 0.0)
        self._slope = max(_RISE_SLOPE, rise / (_RISE_WAY * self._length))
        self._v_h = clearance_parameter(higher + _ARC_SHARE * clearance, 0.85 * self._length, higher + self._rise_by)

    def moved(self, foot: list[float], target: list[float], share: float) -> tuple[float, float, float]:
        """Return the foot [m] after a share of the remaining path."""
        (x_foot, y_foot, z_foot), (x_target, y_target, z_target) = foot, target
        level = max(self._start_z - z_target, 0.0) + self._rise_by
        advance = -1.0
        for _ in range(_SUBSTEPS):
            x_way, y_way = x_target - x_foot, y_target - y_foot
            x, y = math.hypot(x_way, y_way), z_foot - z_target
            rise = min(max((x / self._length - _FADE_SHARES[0]) / (_FADE_SHARES[1] - _FADE_SHARES[0]), 0.0), 1.0)
            if advance < 0.0:
                advance = remaining_length(x, y, self._v_h, level, rise) * share / _SUBSTEPS
            if x > _AT_TARGET_M:
                slope = flow_slope(x, y, self._v_h, level, self._rise_by, rise * self._slope)
                horizontal = advance / math.hypot(1.0, _HEIGHT_COST * slope)
                ahead = min(horizontal, x) / x
                x_foot, y_foot, z_foot = x_foot + x_way * ahead, y_foot + y_way * ahead, z_foot + slope * horizontal
            else:
                down = advance / _HEIGHT_COST
                z_foot -= min(max(y, -down), down)
        return x_foot, y_foot, z_foot


def _travelled(end: float, begin: float) -> float:
    """Return the share of the path remaining at `begin` that is travelled until `end`.

    The speed ramps up and down smoothly.
    """
    return 1.0 if end >= 1.0 else (_covered(end) - _covered(begin)) / (_covered(1.0) - _covered(begin))


def _covered(u: float) -> float:
    """Return the path until a share of the time, relative to cruising speed.

    It is the time less the loss in the ramps.
    """
    start, end = min(u / _START, 1.0), max(0.0, (u - 1.0) / _END + 1.0)
    gathering = _START * (start - _smooth_integral(start))
    return u - gathering - (1.0 - _END_SPEED) * _END * _smooth_integral(end)


def _smooth(s: float) -> float:
    """Return a smooth step from 0 to 1, with zero slope at both ends."""
    return s * s * (3.0 - 2.0 * s)


def _smooth_integral(s: float) -> float:
    return s**3 * (1.0 - s / 2.0)
