"""Check that each servo follows its goals, by the spring law of its position controller.

The controller exerts a torque in proportion to the distance between goal and position, and the load register shows that
torque. So goal, position and load of one reading contradict each other if a register lies: a bit of the goal is stuck, the
position register is off, or the load has the wrong sign. Speed, sag and the motion of the leg do not matter. A servo that shows
its full torque and stays far behind its goal is too weak, or something holds it.

The load of a servo that does not measure it is estimated by the same law, so it never contradicts its goal: of such a servo
only a great distance to the goal shows.
"""

import math

from sextant.shared.robot.profile import RobotProfile

# [rad] of contradiction that counts. In walks of 45 s, a single reading reached 0.6 deg on robots that match their profile
# (44 000 readings), 1.6 deg with `usual` deviations (73 000) and 1.9 deg with `harsh` ones (15 000): play and stiffness.
_CONTRADICTION_RAD = math.radians(3.0)
_READINGS = 3  # contradictions in a row from which a servo lies; each servo is read about every 60 ms
_HONEST_READINGS = 30  # readings in a row without contradiction from which it does not lie any more
_SIGN_RAD = math.radians(1.5)  # [rad] contradiction that may remain when the sign of the load is changed
_SATURATED = 0.9  # [1] share of the stall torque from which the torque is not proportional
_BEHIND_READINGS = 5  # readings in a row with full torque, far behind the goal, from which a servo is weak
_GOALS = 3  # newest goals that a servo may follow: one is on its way, and a bridge is a cycle late


class GoalCheck:
    """Compares goal, position and load of each servo at its readings. All numbers are plain, for 18 servos (0 to 17)."""

    def __init__(self, profile: RobotProfile):
        """Begin without a reading."""
        self._servos = profile.servos.each
        self._goals: list[list[float]] = []  # [rad] newest first
        self.forget()

    def forget(self) -> None:
        """Discard all readings."""
        self.found: tuple[int, str] | None = None  # servo (0 to 17) that lies, and how, as the end of a sentence
        self._honest = 0  # its readings in a row without contradiction
        self._count = [0] * 18  # contradictions in a row, of the same sign
        self._signs = [0] * 18  # how many of them the wrong sign of the load explains
        self._off = [0.0] * 18  # [rad] the smallest of them
        self._behind = [0] * 18  # readings in a row with full torque, far behind the goal
        self._weak: list[int] = []  # servos for which such a row has become long

    def note_goals(self, goals: list[float]) -> None:
        """Set the goals (18,) [rad] that the servos have, once per cycle before `add_reading`."""
        self._goals = [goals, *self._goals[: _GOALS - 1]]

    def add_reading(self, index: int, angle: float, load: float) -> None:
        """Take in one reading: angle [rad] and motor torque [N m], both in joint direction."""
        servo = self._servos[index]
        spring = load / servo.stiffness
        ahead = [goals[index] - angle for goals in self._goals]  # of the position
        if abs(load) > _SATURATED * servo.stall_torque:
            far = min(one if load > 0.0 else -one for one in ahead) - abs(spring) > _CONTRADICTION_RAD
            self._behind[index] = self._behind[index] + 1 if far else 0
            if self._behind[index] == _BEHIND_READINGS:
                self._weak.append(index)
            return
        self._behind[index] = 0
        off = min((one - spring for one in ahead), key=abs)
        if abs(off) < _CONTRADICTION_RAD:
            self._count[index] = 0
            shows = self._signs[index] < _READINGS or abs(spring) > _SIGN_RAD  # a wrong sign shows only under load
            if self.found is not None and self.found[0] == index and shows:
                self._honest += 1
                self.found = None if self._honest >= _HONEST_READINGS else self.found
            return
        if not self._count[index] or off * self._off[index] < 0.0:
            self._count[index], self._off[index], self._signs[index] = 0, off, 0
        self._count[index] += 1
        self._off[index] = min(off, self._off[index], key=abs)
        self._signs[index] += min(abs(one + spring) for one in ahead) < _SIGN_RAD
        if self._count[index] >= _READINGS:
            self._honest = 0
            self.found = self.found or (index, self._lie(index))

    def skip(self, index: int) -> None:
        """Discard the row of a servo that cannot follow its goals now."""
        self._count[index] = self._behind[index] = 0

    def take_weak(self) -> list[int]:
        """Return the servos (0 to 17) that have shown their full torque far behind their goals, and forget them."""
        weak, self._weak = self._weak, []
        return weak

    def _lie(self, index: int) -> str:
        if self._signs[index] >= _READINGS:
            return "reports its load with the wrong sign"
        off = abs(math.degrees(self._off[index]))
        return f"is {off:.0f} deg off its goal although its load is too small for that: a register lies"
