"""Gait and speed of requests that leave them to the planner: what it observes, and what it chose last."""

import math
from collections import deque

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.gait import Pace
from sextant.services.planner.locomotion.gait_choice import GaitChoice, GaitChooser, Situation
from sextant.services.planner.locomotion.ground_ahead import look_ahead
from sextant.services.planner.robot_estimate import RobotEstimate
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.wire.messages import ActuatorState, VelocityCommand

_LOAD_TIME_CONSTANT_S = 30.0  # [s] of the measured root mean square torque; the actuator's
_LONGEST_PAUSE_S = 1.0  # [s] between two states, above which the time between them does not count
_SLIP_M = 0.01  # [m] displacement of a standing foot from which it has slipped; the actuator's


class AutoGait:
    """Keeps failures and servo loads of the last seconds, and chooses gait and speed of the next step."""

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Start without failures."""
        self._profile, self._params = profile, settings.gait_choice
        self._chooser = GaitChooser(profile, settings.step, settings.gait_choice)
        self._failures: deque[tuple[int, str]] = deque(maxlen=100)  # [ns] time, and what failed
        self._square: Array = np.zeros((6, 3))  # mean square torque, of the stall torque
        self._state_ns = self._missing = 0
        self._temperature = 0.0
        self.choice: GaitChoice | None = None  # for the newest request; None if it leaves nothing to the planner
        self.pace: Pace | None = None  # of the next step; None: that of the profile

    def update(self, state: ActuatorState, missing: int) -> None:
        """Note loads and failures.

        Args:
            state: The newest state of the actuator.
            missing: Number of times that a foot found no ground.
        """
        dt = (state.stamp_ns - self._state_ns) * 1e-9
        if 0.0 < dt < _LONGEST_PAUSE_S:
            share = state.load_nm / self._profile.servos.stall_torque
            self._square += (1.0 - math.exp(-dt / _LOAD_TIME_CONSTANT_S)) * (share * share - self._square)
        self._state_ns, self._temperature = state.stamp_ns, state.temperature
        if missing > self._missing:
            self.note_failure(state.stamp_ns, "a foot found no ground")
        self._missing = missing
        if state.slip > _SLIP_M:
            self.note_failure(state.stamp_ns, "a foot slipped")

    def note_failure(self, now_ns: int, what: str) -> None:
        """Note a failure, unless an equal one was noted within `event_s`."""
        since_ns = now_ns - round(self._params.event_s * 1e9)
        if not any(then_ns > since_ns and what == known for then_ns, known in self._failures):
            self._failures.append((now_ns, what))

    def forget_choice(self) -> None:
        """Forget the choice: the next step is of another kind."""
        self.choice = self.pace = None

    def resolve(
        self, commands: tuple[VelocityCommand, ...], robot: RobotEstimate, terrain: Terrain, T_world_body: Array
    ) -> tuple[VelocityCommand, ...]:
        """Return the commands with the present choice in place of `auto`.

        Args:
            commands: At least one command, the preferred one first.
            robot: The robot.
            terrain: The map.
            T_world_body: (4, 4) body pose at the start of the next step.
        """
        first = commands[0]
        self.forget_choice()
        if first.gait != "auto" and not first.auto_speed:
            return commands
        ahead = math.atan2(first.velocity[1], first.velocity[0]) if first.velocity.any() else 0.0
        ground = look_ahead(terrain, T_world_body, yaw_of(T_world_body) + ahead, self._params)
        fault = "" if robot.pose.ok else robot.pose.reason
        since_ns = robot.now_ns - round(self._params.memory_s * 1e9)
        failures = tuple(what for then_ns, what in self._failures if then_ns > since_ns)
        at = Situation(ground, fault, failures, self._temperature, math.sqrt(float(self._square.max())))
        self.choice = self._chooser.choose(robot.now_ns, at, first)
        self.pace = self.choice.walk.pace if self.choice.sets_speed else None
        max_speed = self._profile.stance.max_speed
        return tuple(self.choice.apply_to(command, max_speed) for command in commands)
