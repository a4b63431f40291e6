"""Motion prior of the registration, from leg odometry or the camera's velocity."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array, exp_so3, interpolate, log_so3, transform
from sextant.shared.wire.messages import Odometry

_MAX_MESSAGES = 100  # number of stored messages: two seconds at 50 Hz
_MAX_STANDING_MOTION = 1.5e-3  # [m] and [1] change of a pose's elements: three times the effect of the servo resolution
_MAX_EXTRAPOLATION_NS = 100_000_000  # [ns] longest extrapolation; after that the body is assumed to stand still
_OTHER_CLOCK_NS = 1_000_000_000  # [ns] a message may be late by this much; an older one comes from another clock
# Limits of motion between two messages; both a walking and a falling body stay below them.
_MAX_SPEED, _MAX_RATE = 2.0, 6.0  # [m/s] and [rad/s]
_ALLOWED_JUMP, _ALLOWED_JUMP_ANGLE = 0.1, 0.3  # [m] and [rad] added to the limits, for messages at short intervals


@dataclass(frozen=True, slots=True)
class Motion:
    """Odometry pose of the body at one instant, and the distance travelled."""

    T_odom_body: Array  # (4, 4)
    travelled: float  # [m]
    turned: float  # [rad]
    reliable: bool  # False if fewer than three legs carried load, or the odometry is too old
    silence_s: float = 0.0  # [s] since the newest odometry message


class OdometryHistory:
    """Odometry of the last two seconds, looked up by time."""

    def __init__(self) -> None:
        """Create an empty history."""
        self.restarts = 0  # number of times the odometry started again
        self._messages: list[Odometry] = []

    @property
    def newest_ns(self) -> int | None:
        """Stamp [ns] of the newest message, None without one."""
        return self._messages[-1].stamp_ns if self._messages else None

    def add(self, message: Odometry) -> None:
        """Add a message, and restart the history if it does not continue the previous one.

        This is the case if its travelled distance is smaller, its stamp is far older, or its pose is farther away than a body
        can have moved.
        """
        newest = self._messages[-1] if self._messages else None
        since_ns = 1 if newest is None else message.stamp_ns - newest.stamp_ns
        if -_OTHER_CLOCK_NS < since_ns <= 0:
            return  # out of order: keep the newer message
        if newest is not None and (message.path_length < newest.path_length or since_ns < 0 or _jumps(newest, message)):
            self.restarts += 1
            self._messages.clear()
        self._messages.append(message)
        del self._messages[:-_MAX_MESSAGES]

    def settled(self, for_s: float) -> bool:
        """Return whether the body has stood still for the last `for_s` seconds."""
        newest = self._messages[-1] if self._messages else None
        if newest is None or newest.stamp_ns - self._messages[0].stamp_ns < for_s * 1e9:
            return False
        recent = [m.T_odom_body for m in self._messages if newest.stamp_ns - m.stamp_ns <= for_s * 1e9]
        return max(float(np.abs(T - newest.T_odom_body).max()) for T in recent) < _MAX_STANDING_MOTION

    def motion_at(self, stamp_ns: int) -> Motion | None:
        """Return the motion at an instant, or None if unknown.

        It is interpolated, or extrapolated for a short time beyond the newest message.
        """
        messages = self._messages
        if not messages or stamp_ns < messages[0].stamp_ns:
            return None
        after = bisect_right(messages, stamp_ns, key=lambda m: m.stamp_ns)
        a, b = (messages[after - 1], messages[after]) if after < len(messages) else (messages[max(0, after - 2)], messages[-1])
        if a is b:
            recent = stamp_ns <= a.stamp_ns + _MAX_EXTRAPOLATION_NS
            silence_s = max(0, stamp_ns - a.stamp_ns) * 1e-9
            return Motion(np.array(a.T_odom_body), a.path_length, a.total_rotation, a.reliable and recent, silence_s)
        span = b.stamp_ns - a.stamp_ns
        latest_ns = b.stamp_ns + _MAX_EXTRAPOLATION_NS
        s = (min(stamp_ns, latest_ns) - a.stamp_ns) / span
        return Motion(
            interpolate(a.T_odom_body, b.T_odom_body, s),
            a.path_length + s * (b.path_length - a.path_length),
            a.total_rotation + s * (b.total_rotation - a.total_rotation),
            a.reliable and b.reliable and stamp_ns <= latest_ns and span <= 2 * _MAX_EXTRAPOLATION_NS,
            max(0, stamp_ns - b.stamp_ns) * 1e-9,
        )


def _jumps(before: Odometry, after: Odometry) -> bool:
    """Return whether two poses are farther apart than a body can move in that time."""
    since_s = (after.stamp_ns - before.stamp_ns) * 1e-9
    distance = float(np.linalg.norm(after.T_odom_body[:3, 3] - before.T_odom_body[:3, 3]))
    turn = float(np.linalg.norm(log_so3(before.T_odom_body[:3, :3].T @ after.T_odom_body[:3, :3])))
    return distance > _ALLOWED_JUMP + _MAX_SPEED * since_s or turn > _ALLOWED_JUMP_ANGLE + _MAX_RATE * since_s


class VelocityPrior:
    """Motion prior of a camera without legs; an unobserved velocity decays.

    The velocity in a direction is measured between two registered frames that constrain it. It decays in directions that the
    scene does not constrain, and after frames that are not registered. A jump to another place after the camera was lost
    does not count as velocity.
    """

    def __init__(self, decay_s: float, max_speed: float = 3.0, max_rate: float = 6.0):
        """Start at rest.

        Args:
            decay_s: [s] time in which an unobserved velocity falls to 1/e.
            max_speed: [m/s] above which the difference of two poses is not motion.
            max_rate: [rad/s] the same for the rotation.

        Raises:
            ValueError: decay_s is not positive.
        """
        if not decay_s > 0.0:
            raise ValueError(f"a positive time of decay expected, found {decay_s} s")
        self._decay_s = decay_s
        self._limits = np.array([max_speed, max_rate])
        self._velocity: Array = np.zeros(6)  # [m/s] and [rad/s] in world axes
        self._last: tuple[int, Array, bool] | None = None  # stamp [ns], pose (4, 4) and whether the frame was registered
        self.measured = False  # whether two registered frames gave the velocity

    def update(self, stamp_ns: int, T_world_body: Array, registered: bool, unobservable: Array) -> None:
        """Update the velocity with the pose of the newest frame.

        Args:
            stamp_ns: [ns] later than that of the last frame.
            T_world_body: (4, 4) estimated pose.
            registered: Whether the frame was registered; otherwise the pose is that of this prior.
            unobservable: (k, 6) twists in world axes at the body that the frame does not constrain.
        """
        last, self._last = self._last, (stamp_ns, T_world_body, registered)
        if last is None or stamp_ns <= last[0]:
            return
        since_s = (stamp_ns - last[0]) * 1e-9
        kept = float(np.exp(-since_s / self._decay_s)) * self._velocity
        T = last[1]
        measured = np.concatenate([T_world_body[:3, 3] - T[:3, 3], log_so3(T_world_body[:3, :3] @ T[:3, :3].T)]) / since_s
        possible = bool((np.linalg.norm(measured.reshape(2, 3), axis=1) <= self._limits).all())
        self.measured = registered and last[2] and possible
        if self.measured:
            projector = np.linalg.pinv(unobservable) @ unobservable  # onto the unconstrained directions
            self._velocity = measured + projector @ (kept - measured)
        else:
            self._velocity = kept if possible else np.zeros(6)

    def predict(self, since_s: float) -> Array:
        """Return the expected pose (4, 4) a time [s] after the newest frame.

        The translation of the last interval is turned by the predicted rotation. This is exact for a motion along a constant
        screw, if the time equals the last interval.

        Raises:
            ValueError: There was no frame.
        """
        if self._last is None:
            raise ValueError("at least one frame expected before a prediction, found none")
        T = self._last[1]
        turn = exp_so3(since_s * self._velocity[3:])
        return transform(turn @ T[:3, :3], T[:3, 3] + since_s * turn @ self._velocity[:3])
