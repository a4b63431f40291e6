"""The path of a swinging foot as the flow function replaced it: Erasmus' polynomial of sixth order, kept as a reference.

Source: Lotriet 2024, section 5.4.1, eq. (5.21)-(5.22), after Erasmus et al. 2023. Each coordinate is the polynomial in time
that starts and ends at rest, speed and acceleration zero, and is at the midpoint q_m (printed as q_1 in (5.22)) in the middle
of the time. The coefficients are right as printed. With s = t / t_f and D = q_f - q_i they are

    q(s) = q_i + D (10 s^3 - 15 s^4 + 6 s^5) + (q_m - q_i - D/2) 64 s^3 (1 - s)^3

The thesis draws the arc anew from where the foot is when its target moves, and the foot rises a second time (figure 5.12). Here
a target moves a little in every cycle, as the pose estimate does: the arc is drawn anew from where the foot set out, and what
the foot is off that arc fades as the way to the target does. So it arrives without a leap, but keeps to the height over the
higher end that the newest target asks for, and does not rise before a riser.
"""

import numpy as np

from sextant.shared.geometry import Array


def arc_coefficients(q_i: Array, q_m: Array, q_f: Array, t_f: float) -> Array:
    """Coefficients a_0 to a_6 (7, ...) of q(t), as (5.22) prints them.

    Args:
        q_i: (...) [m] at the time 0.
        q_m: (...) [m] in the middle of the time.
        q_f: (...) [m] at the end.
        t_f: [s] the end.
    """
    middle, end = q_m - q_i, q_f - q_i
    a_3 = 2.0 / t_f**3 * (32.0 * middle - 11.0 * end)
    a_4 = -3.0 / t_f**4 * (64.0 * middle - 27.0 * end)
    a_5 = 3.0 / t_f**5 * (64.0 * middle - 30.0 * end)
    a_6 = -32.0 / t_f**6 * (2.0 * middle - end)
    zero = np.zeros_like(middle)
    return np.array([q_i, zero, zero, a_3, a_4, a_5, a_6])


def on_arc(q_i: Array, q_m: Array, q_f: Array, share: float) -> Array:
    """The place (...) [m] on the arc at a share of its time, 0 to 1; arguments as of `arc_coefficients`."""
    return np.asarray(np.polynomial.polynomial.polyval(share, arc_coefficients(q_i, q_m, q_f, 1.0)))


class SixthOrderArc:
    """The feet that are in the air, each on its arc to a target that may move; takes the place of `Swing`."""

    def __init__(self, foot: Array, target: Array, clearance: Array):
        """Begin a swing.

        Args:
            foot: (n, 3) [m] {odom} where the feet are.
            target: (n, 3) [m] {odom} where they shall land.
            clearance: (n,) [m] over the higher end, in the middle of the time.
        """
        self.foot = foot.copy()
        self._start, self._clearance = foot.copy(), clearance.copy()

    def update(self, target: Array, progress: float, step: float) -> Array:
        """Move on by a fraction of the swing's duration.

        Args:
            target: (n, 3) [m] {odom} where they shall land, as known now.
            progress: Share of the swing that is over, 0 to 1.
            step: Share to move on by.

        Returns:
            (n, 3) [m] {odom} the feet.
        """
        begin, end = min(progress, 1.0), min(progress + step, 1.0)
        if end >= 1.0:
            self.foot[:] = target
            return self.foot
        middle = (self._start + target) / 2
        middle[:, 2] = np.maximum(self._start[:, 2], target[:, 2]) + self._clearance
        off = self.foot - on_arc(self._start, middle, target, begin)
        self.foot[:] = on_arc(self._start, middle, target, end) + off * _left(end) / _left(begin)
        return self.foot


def _left(share: float) -> float:
    """Share of the way over the ground that is left at a share of the time."""
    return 1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
