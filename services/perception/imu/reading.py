"""Readings of an inertial sensor: their checks, and their mean as messages in the body frame."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.wire.messages import Imu

_MAX_RATE_RAD_S, _MAX_FORCE_M_S2 = 40.0, 160.0  # [rad/s] 2000 deg/s and [m/s^2] 16 g, the largest ranges of such sensors
_PERIOD_NS = 8_000_000  # [ns] shortest interval between messages: at 100, 200 and 400 Hz there are 100 messages a second
_FROZEN_NS = 1_000_000_000  # [ns] of equal readings after which a sensor is frozen: its noise exceeds its resolution


class ImuError(Exception):
    """Failure to open an IMU, or its loss, with cause and remedy as text."""

    def __init__(self, cause: str, remedy: str):
        self.cause, self.remedy = cause, remedy
        super().__init__(f"{cause}; {remedy}")


@dataclass(frozen=True, slots=True, eq=False)
class ImuReading:
    """One reading, in the axes of the sensor."""

    stamp_ns: int  # [ns] on the robot's clock
    gyro: NDArray[np.float64]  # (3,) [rad/s]
    specific_force: NDArray[np.float64]  # (3,) [m/s^2], +g up at rest


class BodyImu:
    """Checks readings, turns them into the body frame, and averages them to messages of about 100 Hz."""

    def __init__(self, R_body_imu: Array):
        """Create it without readings; `R_body_imu` (3, 3) turns vectors of the sensor into {body}."""
        self._R_body_imu = R_body_imu
        self.problem = ""  # why the newest readings are not used, or an empty string
        self.messages = 0  # number of messages so far
        self._newest_ns = -1
        self._sent_ns = -_PERIOD_NS
        self._last: Array | None = None  # (6,) newest reading
        self._changed_ns = 0  # stamp of the first reading with these values
        self._sum: Array = np.zeros(6)
        self._count = 0

    def update(self, readings: Iterable[ImuReading]) -> Iterator[Imu]:
        """Yield the messages that are complete with these readings.

        A message has the mean of its readings and the stamp of the newest. Readings that are out of order, not finite, beyond
        the range of any sensor, or frozen are left out.
        """
        for reading in readings:
            if reading.stamp_ns <= self._newest_ns:
                continue
            self._newest_ns = reading.stamp_ns
            values = np.concatenate([reading.gyro, reading.specific_force])
            self.problem = self._fault(values, reading.stamp_ns)
            if self.problem:
                self._sum, self._count = np.zeros(6), 0
                continue
            self._sum, self._count = self._sum + values, self._count + 1
            if reading.stamp_ns - self._sent_ns >= _PERIOD_NS:
                gyro, force = (self._R_body_imu @ part for part in (self._sum / self._count).reshape(2, 3))
                self._sum, self._count, self._sent_ns = np.zeros(6), 0, reading.stamp_ns
                self.messages += 1
                yield Imu(reading.stamp_ns, gyro=gyro, specific_force=force)

    def _fault(self, values: Array, stamp_ns: int) -> str:
        """Return why a reading (6,) is not used, or an empty string."""
        rate, force = np.abs(values).reshape(2, 3).max(axis=1)
        if not (rate <= _MAX_RATE_RAD_S and force <= _MAX_FORCE_M_S2):  # NaN, too
            shown = ", ".join(f"{value:g}" for value in values)
            return (
                f"the IMU sends garbage: at most {_MAX_RATE_RAD_S:g} rad/s and {_MAX_FORCE_M_S2:g} m/s^2 expected, "
                f"found ({shown}); check its cable and supply"
            )
        if self._last is None or not np.array_equal(values, self._last):
            self._last, self._changed_ns = values, stamp_ns
        same_ns = stamp_ns - self._changed_ns
        if same_ns > _FROZEN_NS:
            return f"the IMU is frozen: it has sent the same reading for {same_ns * 1e-9:.1f} s; switch its supply off and on"
        return ""
