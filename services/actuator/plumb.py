"""The plumb line of {odom}, which by legs alone is as level as the ground under the feet was believed to be.

The legs see every motion at once, and nothing of where down is; an inertial sensor sees that, to within what it is off itself.
So {odom} turns slowly about the body, as far as the sensor is sure, and what is held level in it is held level against gravity.
Its heading follows the gyro's: feet that slip turn the body unseen by the legs.
"""

import math

import numpy as np
from numpy.typing import NDArray

from services.actuator.attitude import Attitude, AttitudeEstimator
from shared.geometry import Array, exp_so3, transform, yaw_of
from shared.messages import Imu

_HEAVED, _HEAVES_FROM = np.radians(2.0), 0.05  # of lean, and [m] of a foot on the side that rises, to be what lifts it
TIPPED = np.radians(20.0)  # of the body against what is commanded, from which a robot must not go on
_GAP_NS = 100_000_000  # [ns] without a reading from which nothing is known of how the body turned meanwhile
_OTHER_CLOCK_NS = 1_000_000_000  # [ns] by which a reading may be late; further back it is of another clock
_CALM_NS = 1_000_000_000  # [ns] for which a robot must stand until nothing of its body moves any more
_SURE = np.radians(3.0)  # of doubt up to which a sensor has a say
_RATE, _FASTEST = 0.5, np.radians(3.0)  # [1/s] at which {odom} turns, and [rad/s] at most
_HEADING_RATE = 2.0  # [1/s] at which its heading follows the gyro's
_RESTART = 0.2  # [rad] of the legs' heading in a cycle that is none: they count anew


class Plumb:
    """Follows an inertial sensor's readings, and says by how much {odom} leans."""

    def __init__(self) -> None:
        """Begin without a reading."""
        self._estimator = AttitudeEstimator()
        self._attitude: Attitude | None = None
        self._stamp_ns = -1  # of the newest reading
        self._heard_ns = -1  # when it came
        self._moved_ns = -1  # stamp of the last reading of a robot that did not stand
        self._heading: tuple[float, float] | None = None  # [rad] by the legs and by the gyro, when last asked
        self._behind = 0.0  # [rad] by which the legs' heading is behind the gyro's
        self._calm: Array | None = None  # (3,) {odom} up before feet came down

    def take(self, reading: Imu, now_ns: int, still: bool = False) -> None:
        """Take in a reading [ns] when it comes, of a robot that may be known to stand still.

        One that was overtaken says nothing, and after a gap all begins anew.
        """
        since_ns = reading.stamp_ns - self._stamp_ns if self._attitude is not None else 1
        if -_OTHER_CLOCK_NS < since_ns <= 0:
            return
        if not still or self._attitude is None:
            self._moved_ns = reading.stamp_ns
        still = reading.stamp_ns - self._moved_ns > _CALM_NS
        if not 0 < since_ns <= _GAP_NS:
            self._estimator, self._heading = AttitudeEstimator(self._estimator.bias), None
        self._stamp_ns, self._heard_ns = reading.stamp_ns, now_ns
        self._attitude = self._estimator.update(reading.gyro, reading.specific_force, max(since_ns, 1) * 1e-9, still)

    def attitude(self, now_ns: int) -> Attitude | None:
        """How the body lies; None while no reading comes, or none that can be relied upon."""
        found = self._attitude
        return None if found is None or found.doubt > _SURE or now_ns - self._heard_ns > _GAP_NS else found

    def problem(self, now_ns: int) -> str:
        """Why a sensor that was heard is not heeded, in words, or nothing."""
        if self._attitude is None or self.attitude(now_ns) is not None:
            return ""
        silence_s = (now_ns - self._heard_ns) * 1e-9
        if silence_s > _GAP_NS * 1e-9:
            return f"no word from the IMU for {silence_s:.1f} s; level is what the feet say"
        return f"the IMU's up is sure to {math.degrees(self._attitude.doubt):.0f} deg only; level is what the feet say"

    def turn(self, T_odom_body: Array, now_ns: int, dt: float) -> Array | None:
        """The turn (4, 4) of {odom} about the body towards what the sensor says, or None where there is nothing to do.

        It makes {odom} more level, and takes out what feet that slipped have made of the heading.

        Args:
            T_odom_body: (4, 4) where the body is by the legs.
            now_ns: [ns] the time.
            dt: [s] since this was last asked.
        """
        found = self.attitude(now_ns)
        if found is None:
            self._heading = None
            return None
        yaw = self._yaw_to_make_up(yaw_of(T_odom_body), found.turned, dt)
        x, y, z = (T_odom_body[:3, :3] @ found.up).tolist()  # up as {odom} has it
        sine = math.hypot(x, y)
        lean = math.atan2(sine, z)
        beyond = lean - found.doubt
        if beyond <= 0.0 and yaw == 0.0:
            return None
        angle = dt * min(_RATE * max(beyond, 0.0), _FASTEST) / max(sine, 1e-9)
        R = exp_so3(np.array([y * angle, -x * angle, yaw]))
        place = T_odom_body[:3, 3]
        self._heading = (yaw_of(R @ T_odom_body[:3, :3]), found.turned)
        return transform(R, place - R @ place)

    def _yaw_to_make_up(self, legs: float, gyro: float, dt: float) -> float:
        """How far [rad] to turn now, by the headings [rad] of legs and gyro."""
        before, self._heading = self._heading, (legs, gyro)
        stepped = 0.0 if before is None else math.remainder(legs - before[0], math.tau)
        if before is None or abs(stepped) > _RESTART:
            self._behind = 0.0
            return 0.0
        self._behind += gyro - before[1] - stepped
        yaw = min(_HEADING_RATE * dt, 1.0) * self._behind
        self._behind -= yaw
        return yaw

    def heaves(self, T_odom_body: Array, feet: Array, coming: NDArray[np.bool_], now_ns: int) -> NDArray[np.bool_]:
        """The foot (6,) that lifts the body instead of standing: one that comes down where the body rises unseen by the legs.

        A foot whose servo did not feel the ground goes on down, and the others lose theirs.

        Args:
            T_odom_body: (4, 4) where the body is by the legs.
            feet: (6, 3) [m] {body}
            coming: (6,) legs that come down; while there are none is the time to compare with.
            now_ns: [ns] the time.
        """
        found, flags = self.attitude(now_ns), np.zeros(6, dtype=np.bool_)
        up = None if found is None else T_odom_body[:3, :3] @ found.up
        if up is None or self._calm is None or not coming.any():
            self._calm = up
            return flags
        rising = (T_odom_body[:3, :3].T @ (up - self._calm))[:2]  # up leans in the body to the side that rises
        size = math.hypot(*rising.tolist())
        if size > _HEAVED:
            arms = np.where(coming, feet[:, :2] @ (rising / size), 0.0)
            flags[arms.argmax()] = arms.max() > _HEAVES_FROM
        return flags

    def tipped(self, T_odom_commanded: Array, now_ns: int) -> str:
        """That the body leans too far against a commanded pose (4, 4), in words, or nothing."""
        found = self.attitude(now_ns)
        if found is None:
            return ""
        off = math.acos(min(max(float(found.up @ T_odom_commanded[2, :3]), -1.0), 1.0))
        if off - found.doubt <= TIPPED:
            return ""
        most = f"at most {math.degrees(TIPPED):.0f} deg allowed"
        return f"the body leans {math.degrees(off):.0f} deg off what is commanded, by the IMU; {most}"
