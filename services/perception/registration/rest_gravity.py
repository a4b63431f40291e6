"""Direction of gravity by an inertial sensor, while the body rests: {world} begins level even on a slope."""

from collections import deque

import numpy as np

from sextant.shared.geometry import Array, exp_so3
from sextant.shared.robot.profile import GRAVITY
from sextant.shared.wire.messages import Imu

_SPAN_NS = 300_000_000  # [ns] of readings that are averaged
_LONGEST_NS = 1_000_000_000  # [ns] between the oldest and the newest reading that are kept
_MOST = 400  # readings that are kept
_REST_RAD_S, _REST_M_S2 = 0.1, 0.5  # rate, and difference of the force from g, up to which the body rests
_LEVEL_RAD = np.radians(1.0)  # [rad] up to which the feet's plane counts as level: the sensor is no better


class RestGravity:
    """Averages the readings of a body that rests."""

    def __init__(self) -> None:
        """Begin without a reading."""
        self._readings: deque[Imu] = deque(maxlen=_MOST)

    def add(self, reading: Imu) -> None:
        """Add a reading; one that is out of order, or long after the others, begins again."""
        if self._readings and not 0 < reading.stamp_ns - self._readings[-1].stamp_ns <= _SPAN_NS:
            self._readings.clear()
        self._readings.append(reading)
        while reading.stamp_ns - self._readings[0].stamp_ns > _LONGEST_NS:
            self._readings.popleft()

    @property
    def begins(self) -> bool:
        """Whether there are readings, but not enough yet."""
        return bool(self._readings) and self._readings[-1].stamp_ns - self._readings[0].stamp_ns < _SPAN_NS

    def up(self) -> Array | None:
        """Return up (3,) {body}; None without a sensor, or if the body does not rest."""
        if not self._readings or self.begins:
            return None
        newest_ns = self._readings[-1].stamp_ns
        recent = [one for one in self._readings if newest_ns - one.stamp_ns <= _SPAN_NS]
        force, rate = (np.mean([getattr(one, name) for one in recent], axis=0) for name in ("specific_force", "gyro"))
        length = float(np.linalg.norm(force))
        if np.abs(rate).max() > _REST_RAD_S or abs(length - GRAVITY) > _REST_M_S2:
            return None
        return np.asarray(force / length)


def levelling(up: Array) -> Array:
    """Return the rotation (3, 3) that makes a direction up (3,) vertical, without a turn about it.

    It is the identity for a direction that is nearly vertical.
    """
    lean = float(np.arccos(np.clip(up[2], -1.0, 1.0)))
    if lean <= _LEVEL_RAD:
        return np.eye(3)
    return exp_so3(lean / float(np.hypot(up[0], up[1])) * np.array([up[1], -up[0], 0.0]))
