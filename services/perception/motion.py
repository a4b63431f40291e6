"""What the legs say about the motion between two frames: the prior of the registration."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from shared.geometry import Array, interpolate, inverse
from shared.messages import Odometry

_KEPT = 100  # messages, two seconds
_STILL = 1.5e-3  # [m] and [rad], three times what the servos' resolution makes of a standing robot
_MAX_EXTRAPOLATION_NS = 100_000_000  # [ns] beyond the newest message the body is taken to stand still
_OTHER_CLOCK_NS = 1_000_000_000  # [ns] by which a message may be late; further back it is of another clock


@dataclass(frozen=True, slots=True)
class Motion:
    """Where the body is by the legs at one instant, and how far it has come."""

    T_odom_body: Array  # (4, 4)
    travelled: float  # [m]
    turned: float  # [rad]
    reliable: bool  # False where fewer than three legs carried, or nothing has been heard for long
    silence_s: float = 0.0  # [s] for which nothing had been heard


class OdometryHistory:
    """The last two seconds of odometry, looked up by time."""

    def __init__(self) -> None:
        """Begin empty."""
        self.restarts = 0  # how often the odometry has begun anew
        self._messages: list[Odometry] = []

    def add(self, message: Odometry) -> None:
        """Take in a message; one that has travelled less, or is far older, than its predecessor belongs to a new beginning."""
        newest = self._messages[-1] if self._messages else None
        since_ns = 1 if newest is None else message.stamp_ns - newest.stamp_ns
        if -_OTHER_CLOCK_NS < since_ns <= 0:
            return  # out of order: what came later stands
        if newest is not None and (message.travelled < newest.travelled or since_ns < 0):
            self.restarts += 1
            self._messages.clear()
        self._messages.append(message)
        del self._messages[:-_KEPT]

    def settled(self, for_s: float) -> bool:
        """Whether the body has stood still for a time, as far as the newest messages tell."""
        newest = self._messages[-1] if self._messages else None
        if newest is None or newest.stamp_ns - self._messages[0].stamp_ns < for_s * 1e9:
            return False
        recent = [m.T_odom_body for m in self._messages if newest.stamp_ns - m.stamp_ns <= for_s * 1e9]
        return max(float(np.abs(T - newest.T_odom_body).max()) for T in recent) < _STILL

    def at(self, stamp_ns: int) -> Motion | None:
        """Motion at an instant, interpolated, or carried on for a little beyond the newest message; None where unknown."""
        messages = self._messages
        if not messages or stamp_ns < messages[0].stamp_ns:
            return None
        after = bisect_right(messages, stamp_ns, key=lambda m: m.stamp_ns)
        a, b = (messages[after - 1], messages[after]) if after < len(messages) else (messages[max(0, after - 2)], messages[-1])
        if a is b:
            recent = stamp_ns <= a.stamp_ns + _MAX_EXTRAPOLATION_NS
            silence_s = max(0, stamp_ns - a.stamp_ns) * 1e-9
            return Motion(np.array(a.T_odom_body), a.travelled, a.turned, a.reliable and recent, silence_s)
        span = b.stamp_ns - a.stamp_ns
        latest_ns = b.stamp_ns + _MAX_EXTRAPOLATION_NS
        s = (min(stamp_ns, latest_ns) - a.stamp_ns) / span
        return Motion(
            interpolate(a.T_odom_body, b.T_odom_body, s),
            a.travelled + s * (b.travelled - a.travelled),
            a.turned + s * (b.turned - a.turned),
            a.reliable and b.reliable and stamp_ns <= latest_ns and span <= 2 * _MAX_EXTRAPOLATION_NS,
            max(0, stamp_ns - b.stamp_ns) * 1e-9,
        )


def constant_velocity(T_before: Array, T_last: Array, span_ns: int, since_ns: int) -> Array:
    """The pose that follows two others (4, 4) when the motion between them goes on.

    Args:
        T_before: The earlier pose.
        T_last: The later pose.
        span_ns: [ns] between the two.
        since_ns: [ns] from the later one on.
    """
    s = since_ns / span_ns if span_ns > 0 else 0.0
    return np.asarray(T_last @ interpolate(np.eye(4), inverse(T_before) @ T_last, s))
