"""What the legs say about the motion between two frames: the prior of the registration."""

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array, exp_so3, interpolate, log_so3, transform
from sextant.shared.wire.messages import Odometry

_KEPT = 100  # messages, two seconds
_STILL = 1.5e-3  # [m] and [rad], three times what the servos' resolution makes of a standing robot
_MAX_EXTRAPOLATION_NS = 100_000_000  # [ns] beyond the newest message the body is taken to stand still
_OTHER_CLOCK_NS = 1_000_000_000  # [ns] by which a message may be late; further back it is of another clock
# Limits of motion between two messages; a walking body and a falling one stay below them.
_FASTEST, _FASTEST_TURN = 2.0, 6.0  # [m/s] and [rad/s]
_JUMP, _JUMP_TURN = 0.1, 0.3  # [m] and [rad] beyond that, for messages that come close together


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
        """Add a message; it restarts the history where it does not continue the previous one.

        That is where it has travelled less, is far older, or lies farther away than a body can have moved.
        """
        newest = self._messages[-1] if self._messages else None
        since_ns = 1 if newest is None else message.stamp_ns - newest.stamp_ns
        if -_OTHER_CLOCK_NS < since_ns <= 0:
            return  # out of order: what came later stands
        if newest is not None and (message.travelled < newest.travelled or since_ns < 0 or _jumps(newest, message)):
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


def _jumps(before: Odometry, after: Odometry) -> bool:
    """Whether two poses are farther apart than a body moves in the time between them."""
    since_s = (after.stamp_ns - before.stamp_ns) * 1e-9
    way = float(np.linalg.norm(after.T_odom_body[:3, 3] - before.T_odom_body[:3, 3]))
    turn = float(np.linalg.norm(log_so3(before.T_odom_body[:3, :3].T @ after.T_odom_body[:3, :3])))
    return way > _JUMP + _FASTEST * since_s or turn > _JUMP_TURN + _FASTEST_TURN * since_s


class VelocityPrior:
    """The prior of a camera without legs: it goes on as it moved, and comes to rest where its motion is not observed.

    The velocity of a direction is that between two registered frames that show it. Where the scene does not show a direction,
    or a frame does not register, the velocity decays. A frame that is found elsewhere after the camera was lost shows none.
    """

    def __init__(self, decay_s: float, max_speed: float = 3.0, max_rate: float = 6.0):
        """Begin at rest.

        Args:
            decay_s: [s] after which an unobserved velocity has fallen to 1/e.
            max_speed: [m/s] above which two poses are no motion.
            max_rate: [rad/s] above which they are none.

        Raises:
            ValueError: It is not positive.
        """
        if not decay_s > 0.0:
            raise ValueError(f"a positive time of decay expected, found {decay_s} s")
        self._decay_s = decay_s
        self._limits = np.array([max_speed, max_rate])
        self._velocity: Array = np.zeros(6)  # [m/s] and [rad/s] in world axes
        self._last: tuple[int, Array, bool] | None = None  # stamp [ns], pose (4, 4) and whether it registered
        self.measured = False  # whether two registered frames have shown the velocity

    def update(self, stamp_ns: int, T_world_body: Array, registered: bool, unobservable: Array) -> None:
        """Measure the velocity with the pose of the newest frame.

        Args:
            stamp_ns: Later than that of the last frame.
            T_world_body: (4, 4) estimated pose.
            registered: Whether the frame registered; otherwise the pose is that of this prior.
            unobservable: (k, 6) twists in world axes at the body that the frame does not show.
        """
        last, self._last = self._last, (stamp_ns, T_world_body, registered)
        if last is None or stamp_ns <= last[0]:
            return
        since_s = (stamp_ns - last[0]) * 1e-9
        kept = float(np.exp(-since_s / self._decay_s)) * self._velocity
        T = last[1]
        shown = np.concatenate([T_world_body[:3, 3] - T[:3, 3], log_so3(T_world_body[:3, :3] @ T[:3, :3].T)]) / since_s
        possible = bool((np.linalg.norm(shown.reshape(2, 3), axis=1) <= self._limits).all())
        self.measured = registered and last[2] and possible
        if self.measured:
            projector = np.linalg.pinv(unobservable) @ unobservable  # on what the frame does not show
            self._velocity = shown + projector @ (kept - shown)
        else:
            self._velocity = kept if possible else np.zeros(6)

    def predict(self, since_s: float) -> Array:
        """Expected pose (4, 4) some time [s] after the newest frame, along the screw of the velocity.

        Raises:
            ValueError: There was no frame.
        """
        if self._last is None:
            raise ValueError("at least one frame expected before a prediction, found none")
        T = self._last[1]
        turn = exp_so3(since_s * self._velocity[3:])
        return transform(turn @ T[:3, :3], T[:3, 3] + since_s * turn @ self._velocity[:3])
