"""The path of a swinging foot: Lotriet's flow function, which at any moment says which way the foot must move.

Source: Lotriet 2024, section 5.4.2. A foot at the horizontal distance x before its target and the height y over it moves along
the gradient of the parabola through both points, eq. (5.23) with f_b = y/x - f_a x (the printed (5.25) lost the x):

    dy/ds = -y/x + (|v_h/x| + |S|) x = -y/x + v_h + |S| x,      s = progress towards the target

Without S its solution is y = v_h x ln(L/x): it peaks at v_h L / e, where x = L/e, and comes down vertically. So v_h, the
thesis' step height parameter, follows from a clearance h as e h / L. S goes from about -1 to 0 where y passes the level q
(5.26); its constants shape a sigmoid only, the two lengths that make it one are chosen here. The level is that of the higher
end of the step, so a foot rises beside a riser before it goes over it, and leaves an edge before it goes down behind it; in
the last quarter of the way S fades, so that the foot does not hover and then plunge.
"""

import math

import numpy as np

from shared.geometry import Array

_SIGMOID_UNIT = 0.0005  # [m] over which S turns
_RISE_SLOPE = 6.0  # slope of the initial rise, however short the way
_LEVEL_SHARE = 0.5  # of the clearance, over the higher end: from there on the foot arcs
_ARC_SHARE = 0.9  # of the clearance at which the arc would peak; the tail of S adds the rest
_FADE = (0.25, 0.50)  # shares of the way left between which S fades
_ARC_POINTS = np.linspace(0.0, 1.0, 9)[:, None]
_SUBSTEPS = 4  # per cycle: the field turns within a centimetre
_NEWTON_STEPS = 8
_NEAR = 1e-3  # [m] horizontally at the target: straight down


def flow_slope(x: Array, y: Array, v_h: Array, level: Array, rise: Array | float = 1.0) -> Array:
    """Slope dy/ds of the foot's path: how fast it rises per way towards the target.

    Args:
        x: (n,) [m] horizontal distance to the target, positive.
        y: (n,) [m] height over the target.
        v_h: (n,) step height parameter, see `clearance_parameter`.
        level: (n,) [m] height over the target from which the foot arcs rather than rises (the thesis' q).
        rise: (n,) weight of the initial rise S, 1 at first, 0 towards the end.

    Source: Lotriet 2024, eq. (5.23)-(5.26), the latter read as 0.515 (y - q) / (1 + |y - q|) - 0.505.
    """
    above = (y - level) / _SIGMOID_UNIT
    sigmoid = 0.515 * above / (1.0 + np.abs(above)) - 0.505
    return np.asarray(-y / x + v_h + rise * np.abs(np.minimum(sigmoid, 0.0)) * _RISE_SLOPE)


def clearance_parameter(top: Array, x: Array, y: Array) -> Array:
    """The step height parameter v_h whose arc from (n,) x and y [m] peaks at (n,) top [m] over the target.

    From there the flow's solution is u s ln(1/s) + y s with u = v_h x and s the share of x that is left. Its peak,
    u exp(y/u - 1), is the top where w = y/u solves w - ln w = 1 + ln(top/y); Newton's iteration rises to it from below.
    """
    y = np.maximum(y, 1e-4)
    right = 1.0 + np.log(np.maximum(top / y, 1.0))
    w = np.exp(-right)
    for _ in range(_NEWTON_STEPS):
        w = np.minimum(w + (w - np.log(w) - right) * w / (1.0 - w + 1e-9), 1.0)
    return np.asarray(y / (w * x))


def remaining_length(x: Array, y: Array, v_h: Array, level: Array, rise: Array | float = 1.0) -> Array:
    """About how far (n,) [m] a foot still travels: up to the level, then along the arc; exact when it comes down."""
    up = np.maximum(0.0, level - y) * (x > _NEAR) * rise
    top = y + up
    safe_x = np.maximum(x, _NEAR)
    with np.errstate(divide="ignore", invalid="ignore"):
        arc = np.where(_ARC_POINTS > 0, safe_x * _ARC_POINTS * (top / safe_x - v_h * np.log(_ARC_POINTS)), 0.0)
    arc = np.where(x > _NEAR, arc, top * _ARC_POINTS)
    return np.asarray(up + np.hypot(np.diff(x * _ARC_POINTS, axis=0), np.diff(arc, axis=0)).sum(axis=0))


class Swing:
    """The feet that are in the air, each on its way to a target that may move.

    Feet travel the flow's path at a speed that ramps up and down and brings them to the target when the time is over,
    wherever the target has gone meanwhile.
    """

    def __init__(self, foot: Array, target: Array, clearance: Array):
        """Begin a swing.

        Args:
            foot: (n, 3) [m] {odom} where the feet are.
            target: (n, 3) [m] {odom} where they shall land.
            clearance: (n,) [m] over the higher end.
        """
        self.foot = foot.copy()
        self._start_z = foot[:, 2].copy()
        self._clearance = clearance
        self._length = np.maximum(np.hypot(*(target - foot)[:, :2].T), 0.02)
        higher = np.maximum(self._start_z - target[:, 2], 0.0)
        self._v_h = clearance_parameter(higher + _ARC_SHARE * clearance, 0.85 * self._length, higher + _LEVEL_SHARE * clearance)

    def update(self, target: Array, progress: float, step: float) -> Array:
        """Move on by a fraction of the swing's duration.

        Args:
            target: (n, 3) [m] {odom} where they shall land, as known now.
            progress: Share of the swing that is over, 0 to 1.
            step: Share to move on by.

        Returns:
            (n, 3) [m] {odom} the feet.
        """
        progress, end = min(progress, 1.0), min(progress + step, 1.0)
        level = np.maximum(self._start_z - target[:, 2], 0.0) + _LEVEL_SHARE * self._clearance
        advance: Array | None = None
        for _ in range(_SUBSTEPS):
            way = target[:, :2] - self.foot[:, :2]
            x = np.hypot(way[:, 0], way[:, 1])
            y = self.foot[:, 2] - target[:, 2]
            rise = np.clip((x / self._length - _FADE[0]) / (_FADE[1] - _FADE[0]), 0.0, 1.0)
            if advance is None:
                advance = remaining_length(x, y, self._v_h, level, rise) * _travelled(end, progress) / _SUBSTEPS
            far = x > _NEAR
            safe_x = np.where(far, x, 1.0)
            slope = flow_slope(safe_x, y, self._v_h, level, rise)
            horizontal = np.where(far, 1.0 / np.hypot(1.0, slope), 0.0)
            ahead = np.minimum(advance * horizontal, x)
            self.foot[:, :2] += way * (ahead / safe_x)[:, None]
            self.foot[:, 2] += np.where(far, advance * slope * horizontal, -np.clip(y, -advance, advance))
        if end >= 1.0:
            self.foot[:] = target
        return self.foot


def _travelled(end: float, begin: float) -> float:
    """Share of what is left at `begin` that is travelled until `end`, for a speed that ramps up and down smoothly."""
    if end >= 1.0:
        return 1.0

    def covered(u: float) -> float:  # integral of sin^2 blended with a constant: softer than a trapezoid, flatter than sin^2
        return 0.5 * u + 0.5 * (u - math.sin(2 * math.pi * u) / (2 * math.pi))

    return (covered(end) - covered(begin)) / (1.0 - covered(begin))
