"""The plumb line of {odom}, which by legs alone is as level as the ground under the feet was believed to be.

The legs see every motion at once, and nothing of where down is; an inertial sensor sees that, to within what it is off itself.
So {odom} turns slowly about the body, as far as the sensor is sure, and what is held level in it is held level against gravity.
In a walk its heading follows the gyro's: feet that slip turn the body unseen by the legs. Neither goes far in one step: legs
that hang in the air turn without the sensor.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.attitude import Attitude, AttitudeEstimator
from sextant.shared.geometry import Array, exp_so3, transform, yaw_of
from sextant.shared.wire.messages import Imu

_HEAVED, _HEAVES_FROM = np.radians(2.0), 0.05  # of lean, and [m] of a foot on the side that rises, to be what lifts it
TIPPED = np.radians(20.0)  # of the body against what is commanded, from which a robot must not go on
_MOST_TURN, _MOST_FORCE = 100.0, 2000.0  # [rad/s] and [m/s^2] that an inertial sensor can measure
_ODD_NS = 1_000_000_000  # [ns] for which it is told that one has said more
_GAP_NS = 100_000_000  # [ns] without a reading from which nothing is known of how the body turned meanwhile
_OTHER_CLOCK_NS = 1_000_000_000  # [ns] by which a reading may be late; further back it is of another clock
_CALM_NS = 1_000_000_000  # [ns] for which a robot must stand until nothing of its body moves any more
_SURE = np.radians(3.0)  # of doubt up to which a sensor has a say
_RATE, _FASTEST = 0.5, np.radians(3.0)  # [1/s] at which {odom} turns, and [rad/s] at most, in lean as in heading
_HEADING_RATE = 2.0  # [1/s] at which its heading follows the gyro's
_MOST_LEAN, _MOST_YAW = np.radians(12.0), np.radians(5.0)  # by which it turns in one step, or one rest


class Plumb:
    """Follows an inertial sensor's readings, and says by how much {odom} leans."""

    def __init__(self) -> None:
        """Begin without a reading."""
        self._estimator = AttitudeEstimator()
        self._attitude: Attitude | None = None
        self._stamp_ns = -1  # of the newest reading
        self._heard_ns = -1  # when it came
        self._odd_ns = -_ODD_NS - 1  # when a reading came that no sensor can have made
        self._moved_ns = -1  # stamp of the last reading of a robot that did not stand
        self.restart()

    def restart(self) -> None:
        """Begin a new {odom}; what the sensor has said stays."""
        self._heading: tuple[float, float] | None = None  # [rad] by the legs and by the gyro, when last asked
        self._behind = 0.0  # [rad] by which the legs' heading is behind the gyro's
        self._calm: Array | None = None  # (3,) {odom} up before feet came down
        self._begin(None)

    def _begin(self, step: int | None) -> None:
        self._step = step  # that is walked; None: a rest
        self._R_levelled: Array = np.eye(3)  # by how much {odom} has turned in it
        self._made_up = 0.0  # [rad] of heading in it
        self._steep = self._astray = False  # whether in it lean, or heading, is further off than can be made up

    def take(self, reading: Imu, now_ns: int, still: bool = False) -> None:
        """Take in a reading [ns] when it comes, of a robot that may be known to stand still.

        One that was overtaken says nothing, nor does one of more than a sensor can measure; after a gap all begins anew.
        """
        if np.abs(reading.gyro).max() > _MOST_TURN or np.abs(reading.specific_force).max() > _MOST_FORCE:
            self._odd_ns = now_ns
            return
        since_ns = reading.stamp_ns - self._stamp_ns if self._attitude is not None else 1
        if -_OTHER_CLOCK_NS < since_ns <= 0:
            return
        gap = not 0 < since_ns <= _GAP_NS
        if gap:
            self._estimator, self._heading = AttitudeEstimator(self._estimator.bias), None
        if gap or not still or self._attitude is None:
            self._moved_ns = reading.stamp_ns
        still = reading.stamp_ns - self._moved_ns > _CALM_NS
        self._stamp_ns, self._heard_ns = reading.stamp_ns, now_ns
        self._attitude = self._estimator.update(reading.gyro, reading.specific_force, max(since_ns, 1) * 1e-9, still)

    def attitude(self, now_ns: int) -> Attitude | None:
        """How the body lies; None while no reading comes, or none that can be relied upon."""
        found = self._attitude
        return None if found is None or found.doubt > _SURE or now_ns - self._heard_ns > _GAP_NS else found

    def problem(self, now_ns: int) -> str:
        """Why a sensor that was heard is not heeded, in words, or nothing."""
        if now_ns - self._odd_ns < _ODD_NS:
            return "the IMU says more than a sensor can measure (rad/s and m/s^2 expected); such readings are left out"
        if self._attitude is None:
            return ""
        if self.attitude(now_ns) is not None:
            return self._unfollowed()
        silence_s = (now_ns - self._heard_ns) * 1e-9
        if silence_s > _GAP_NS * 1e-9:
            return f"no word from the IMU for {silence_s:.1f} s; level is what the feet say"
        if self._attitude.contradictory:
            return "the IMU's gyro and force tell of different motions (rad/s and m/s^2 expected); level is what the feet say"
        return f"the IMU's up is sure to {math.degrees(self._attitude.doubt):.0f} deg only; level is what the feet say"

    def _unfollowed(self) -> str:
        if self._steep:
            return f"the body leans more than the {math.degrees(_MOST_LEAN):.0f} deg that its legs make up for, by the IMU"
        if self._astray:
            most = f"{math.degrees(_MOST_YAW):.0f} deg"
            return f"gyro and legs are over {most} of heading apart in one step; heading is what the feet say"
        return ""

    def turn(self, T_odom_body: Array, now_ns: int, dt: float, step: int | None = None) -> Array | None:
        """The turn (4, 4) of {odom} about the body towards what the sensor says, or None where there is nothing to do.

        It makes {odom} more level, and takes out what feet that slipped in a step have made of the heading.

        Args:
            T_odom_body: (4, 4) where the body is by the legs.
            now_ns: [ns] the time.
            dt: [s] since this was last asked.
            step: Number of the step that is walked; None for a robot that stands.
        """
        if step != self._step:
            self._begin(step)
        found = self.attitude(now_ns)
        if found is None:
            self._heading = None
            return None
        yaw = self._yaw_to_make_up(yaw_of(T_odom_body), found.turned, dt)
        x, y = self._lean_to_make_up(T_odom_body[:3, :3] @ found.up, found.doubt, dt)
        if x == y == yaw == 0.0:
            return None
        R, place = exp_so3(np.array([x, y, yaw])), T_odom_body[:3, 3]
        self._heading = (yaw_of(R @ T_odom_body[:3, :3]), found.turned)
        self._R_levelled = R @ self._R_levelled
        self._calm = None if self._calm is None else R @ self._calm
        return transform(R, place - R @ place)

    def _lean_to_make_up(self, up: Array, doubt: float, dt: float) -> tuple[float, float]:
        """How far [rad] to turn now about x and y, by up (3,) as {odom} has it."""
        x, y, z = up.tolist()
        sine = math.hypot(x, y)
        beyond = max(math.atan2(sine, z) - doubt, 0.0)
        angle = dt * min(_RATE * beyond, _FASTEST) / max(sine, 1e-9)
        after = exp_so3(np.array([y * angle, -x * angle, 0.0])) @ self._R_levelled
        self._steep = bool(after[2, 2] < min(self._R_levelled[2, 2], math.cos(_MOST_LEAN)))
        return (0.0, 0.0) if self._steep else (y * angle, -x * angle)

    def _yaw_to_make_up(self, legs: float, gyro: float, dt: float) -> float:
        """How far [rad] to turn now, by the headings [rad] of legs and gyro."""
        before, self._heading = self._heading, (legs, gyro)
        if before is None or self._step is None:
            self._behind = 0.0
            return 0.0
        self._behind += gyro - before[1] - math.remainder(legs - before[0], math.tau)
        self._astray = self._astray or abs(self._made_up + self._behind) > _MOST_YAW
        if self._astray:
            self._behind = 0.0
        most = _FASTEST * dt
        yaw = float(min(max(min(_HEADING_RATE * dt, 1.0) * self._behind, -most), most))
        self._behind -= yaw
        self._made_up += yaw
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
        return f"the body leaned {math.degrees(off):.0f} deg off what is commanded, by the IMU; {most}"
