"""Femurs as they would follow their goals in the air, for servos that measure their position only."""

import math
from collections.abc import Sequence

from sextant.shared.robot.servo import Servo

_STEP_S = 0.0025  # [s] of the integration, far below the period of a leg on the spring of its servo
_SLOW_RAD_S = 0.05  # [rad/s] below which dry friction is only a part of itself


class FreeMotion:
    """Six femurs without ground: damped inertias on the springs of their position controllers, under the weight of their links.

    The state is that at which goals were last sent, because a servo that is read has followed them since.
    """

    def __init__(self, servos: Sequence[Servo], inertias: Sequence[float]) -> None:
        """Begin without a state.

        Args:
            servos: Those of the six femurs.
            inertias: (6,) [kg m^2] of motor and leg about each femur axis.
        """
        self._servos, self._inertias = tuple(servos), tuple(inertias)
        self._goals: list[float] = []  # [rad] that were last sent
        self._angles, self._speeds = [0.0] * 6, [0.0] * 6  # [rad] and [rad/s] when they were sent
        self._holding = [0.0] * 6  # [N m] femur torques that hold the links

    def follow(self, goals: list[float], angles: list[float], holding: list[float], period_s: float) -> None:
        """Take the goals [rad] that were sent in the last cycle, `period_s` [s] after those before.

        Args:
            goals: Goals of the six femurs.
            angles: [rad] their measured angles, at which they begin.
            holding: [N m] torques that hold their links.
            period_s: Duration of a cycle.
        """
        self._holding = holding
        if not self._goals:
            self._angles = list(angles)
        else:
            for leg in range(6):
                self._angles[leg], self._speeds[leg] = self._moved(leg, period_s)
        self._goals = list(goals)

    def at(self, leg: int, after_s: float) -> float:
        """Return the angle [rad] of a femur at a time [s] after its goal was sent."""
        return self._moved(leg, after_s)[0]

    def _moved(self, leg: int, seconds: float) -> tuple[float, float]:
        """Return angle and speed of a femur after some time with its present goal."""
        angle, speed = self._angles[leg], self._speeds[leg]
        steps = max(math.ceil(seconds / _STEP_S), 1)
        for _ in range(steps):
            speed += self._torque(leg, angle, speed) / self._inertias[leg] * seconds / steps
            angle += speed * seconds / steps
        return angle, speed

    def _torque(self, leg: int, angle: float, speed: float) -> float:
        """Return the torque [N m] that accelerates a femur."""
        servo = self._servos[leg]
        spring = min(max(servo.stiffness * (self._goals[leg] - angle), -servo.stall_torque), servo.stall_torque)
        friction = servo.friction * min(max(speed / _SLOW_RAD_S, -1.0), 1.0)
        return spring - servo.damping * speed - self._holding[leg] - friction
