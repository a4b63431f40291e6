"""Commanded body pose: a cubic from pose to pose, in a frame that follows the measured pose. Pure."""

import math
from collections.abc import Iterator

import numpy as np

from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation, yaw_of

LEVEL = np.array([1.0, 1.0, 0.0])  # mask of x, y, z, or of roll, pitch, yaw
_FOLLOW_GAIN = 2.0  # [1/s] gain with which {cmd} follows {odom}
# Squared weights of x, y, z and roll, pitch, yaw in the length of a body path: 1 rad counts as 0.14 m.
_PATH_WEIGHTS = np.array([1.0, 1.0, 1.0, 0.02, 0.02, 0.02])
_AT_REST = 1e-9  # [m/s, rad/s] below which a braking body rests
_STOP_POSES = 11  # number of candidate rest poses of a stopping body, from the earliest possible one to its goal


class BodyTrajectory:
    """Commanded body pose in {cmd}, the frame in which standing feet are fixed.

    {cmd} follows {odom} slowly in x, y and yaw, because feet roll and slip, so that the commanded and the measured pose stay
    together.
    """

    def __init__(self, T_odom_body: Array):
        """Begin at rest, with {cmd} at {odom}."""
        self.T_odom_cmd: Array = np.eye(4)
        self._place(xyz_rpy_from(T_odom_body), np.zeros(6))
        self.begin(0.0, 1.0)

    def _place(self, xyz_rpy: Array, velocity: Array) -> None:
        """Set pose (6,) [m, rad] {cmd} and velocity (6,) [m/s, rad/s] of the body."""
        self.xyz_rpy, self._velocity = xyz_rpy, velocity
        self._T_cmd_body = pose(xyz_rpy)
        self._T_body_cmd = inverse(self._T_cmd_body)
        self._T_odom_body = self.T_odom_cmd @ self._T_cmd_body

    def begin(self, now_s: float, end_s: float, velocity_scale: float = 1.0) -> None:
        """Begin a path at the present pose.

        Args:
            now_s: [s] present time of the step.
            end_s: [s] time of the step at the end of the path.
            velocity_scale: Factor on the present velocity, because the time of the step now runs at another speed.
        """
        self._start, self._start_velocity = self.xyz_rpy.copy(), self._velocity * velocity_scale
        self._start_s, self._end_s = now_s, end_s

    @property
    def T_odom_body(self) -> Array:
        """(4, 4) {odom} commanded body pose now."""
        return self._T_odom_body.copy()

    @property
    def T_cmd_start(self) -> Array:
        """(4, 4) {cmd} body pose at the start of the path."""
        return pose(self._start)

    def to_cmd(self, points: Array) -> Array:
        """Return points (n, 3) [m] {odom} in {cmd}."""
        return apply(inverse(self.T_odom_cmd), points)

    def to_odom(self, points: Array) -> Array:
        """Return points (n, 3) [m] {cmd} in {odom}."""
        return apply(self.T_odom_cmd, points)

    def to_body(self, points: Array) -> Array:
        """Return points (n, 3) [m] {cmd} in the commanded body frame."""
        return apply(self._T_body_cmd, points)

    def goal(self, T_world_odom: Array, T_world_body: Array) -> Array:
        """Return a body goal as coordinates (6,) {cmd}, with angles unwrapped."""
        x, y, z, *angles = xyz_rpy_from(inverse(T_world_odom @ self.T_odom_cmd) @ T_world_body).tolist()
        starts = self._start[3:].tolist()
        return np.array([x, y, z, *(start + wrapped(angle - start) for angle, start in zip(angles, starts, strict=True))])

    def advance(self, elapsed_s: float, goal: Array, stop: bool) -> None:
        """Move along the path.

        Args:
            elapsed_s: [s] time of the step.
            goal: (6,) [m, rad] {cmd} end of the path, from `goal`.
            stop: Whether the body rests at the goal.
        """
        duration_s = self._end_s - self._start_s
        end_velocity = np.zeros(6) if stop else (goal - self._start) / duration_s
        t = min(elapsed_s - self._start_s, duration_s)
        self._place(*hermite(self._start, self._start_velocity, goal, end_velocity, duration_s, t))

    def pause(self) -> None:
        """Stay at the present pose in this cycle."""
        self._velocity = np.zeros(6)

    def brake(self, dt: float, brake_s: float) -> None:
        """Come to rest without a goal, with a time constant [s]."""
        if self._velocity.any():
            velocity = self._velocity * math.exp(-dt / brake_s)
            velocity[np.abs(velocity) < _AT_REST] = 0.0
            self._place(self.xyz_rpy + velocity * dt, velocity)

    def rest_poses(self, goal: Array, braking_s: float, velocity_scale: float) -> Iterator[Array]:
        """Yield poses (4, 4) {cmd} at which the body could rest, from the earliest possible one to its goal.

        Args:
            goal: (6,) [m, rad] {cmd} end of the path.
            braking_s: [s] time until the body rests.
            velocity_scale: Present speed of the step relative to its plan.
        """
        velocity = velocity_scale * self._velocity
        earliest = self.xyz_rpy + braking_s / 3.0 * velocity  # brakes with a deceleration that decreases linearly to zero
        if (goal - self.xyz_rpy) @ (_PATH_WEIGHTS * velocity) > 0.0 > (goal - earliest) @ (_PATH_WEIGHTS * velocity):
            earliest = goal
        for share in np.linspace(0.0, 1.0, _STOP_POSES):
            yield pose(earliest + share * (goal - earliest))

    def follow(self, dt: float, T_odom_body: Array) -> None:
        """Move {cmd} in {odom} so that commanded and measured x, y and yaw converge."""
        ref, gain = self._T_odom_body, _FOLLOW_GAIN * dt
        turn = gain * math.remainder(yaw_of(T_odom_body) - yaw_of(ref), math.tau)
        (x, y), (x_measured, y_measured) = ref[:2, 3].tolist(), T_odom_body[:2, 3].tolist()
        c, s = math.cos(turn), math.sin(turn)
        # First turn about the body, then translate.
        x_step, y_step = x - (c * x - s * y) + gain * (x_measured - x), y - (s * x + c * y) + gain * (y_measured - y)
        step = np.array([[c, -s, 0.0, x_step], [s, c, 0.0, y_step], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
        self.T_odom_cmd = step @ self.T_odom_cmd
        self._T_odom_body = self.T_odom_cmd @ self._T_cmd_body

    def level_error(self, T_odom_body: Array) -> tuple[float, float, float]:
        """Return commanded minus measured height [m], roll and pitch [rad] of the body at a measured pose (4, 4).

        {cmd} and {odom} differ only by x, y and yaw, so these three are the same in both.
        """
        (_, _, z), (roll, pitch, _) = T_odom_body[:3, 3].tolist(), rpy_from_rotation(T_odom_body[:3, :3]).tolist()
        _, _, z_wanted, roll_wanted, pitch_wanted, _ = self.xyz_rpy.tolist()
        return z_wanted - z, math.remainder(roll_wanted - roll, math.tau), math.remainder(pitch_wanted - pitch, math.tau)


def xyz_rpy_from(T: Array) -> Array:
    """Return position [m] and roll, pitch, yaw [rad] (6,) of a pose (4, 4).

    The body never pitches far enough for a singularity.
    """
    return np.concatenate([T[:3, 3], rpy_from_rotation(T[:3, :3])])


def pose(xyz_rpy: Array) -> Array:
    """Return the pose (4, 4) with coordinates (6,) [m, rad]."""
    return from_xyz_rpy(xyz_rpy[:3], xyz_rpy[3:])


def wrapped(angle: float) -> float:
    """Return an angle [rad] wrapped to half a turn around zero."""
    return (angle + math.pi) % math.tau - math.pi


def hermite(p0: Array, v0: Array, p1: Array, v1: Array, duration: float, t: float) -> tuple[Array, Array]:
    """Return position (6,) and velocity (6,) [per s] at t [s] of a cubic.

    It starts at p0 with velocity v0 and ends at p1 with velocity v1. If both equal the mean velocity, it is a straight line.
    """
    s = t / duration
    rise, slope = s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s) / duration
    shares = [
        [1.0 - rise, duration * s * (1.0 - s) * (1.0 - s), rise, -duration * s * s * (1.0 - s)],
        [-slope, (3.0 * s - 1.0) * (s - 1.0), slope, s * (3.0 * s - 2.0)],
    ]
    position, velocity = np.array(shares) @ np.array([p0, v0, p1, v1])
    return position, velocity
