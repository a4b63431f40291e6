"""Estimate of the robot: the actuator's state together with perception's pose."""

from dataclasses import dataclass

from sextant.shared.geometry import Array, apply
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode


@dataclass(frozen=True, slots=True, eq=False)
class WorldStance:
    """Robot as it is, or as it will be when the running step is over."""

    body: Array  # (4, 4) {world}
    feet: Array  # (6, 3) [m] {world} foot centres


@dataclass(frozen=True, slots=True, eq=False)
class RobotEstimate:
    """The newest state of the actuator, and the pose that places it in {world}."""

    state: ActuatorState
    pose: BodyPose

    @property
    def now_ns(self) -> int:
        """Return the time [ns] of the estimate, the stamp of the actuator's state."""
        return self.state.stamp_ns

    @property
    def T_world_odom(self) -> Array:
        """Return the correction (4, 4) from {odom} to {world}."""
        return self.pose.T_world_odom

    def feet_in_world(self) -> Array:
        """Return measured foot centres (6, 3) [m] {world}."""
        return apply(self.T_world_odom @ self.state.T_odom_body, self.state.feet)


def is_resting(state: ActuatorState) -> bool:
    """Return whether all legs stand: none swings, none searches for ground."""
    return state.phase >= 1.0 and state.mode is not Mode.WALK
