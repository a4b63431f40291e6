"""What a leg that moves feels of the ground: its femur servo's load, less what turning the leg takes of it."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.locomotion.feedforward import link_torques
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile, Servo

FEMUR = 1  # the joint that bears the ground's push; over the foot the tibia's arm is short
# Of a robot of 2.5 kg; the pushes of one that is heavier, and what its legs make up themselves, are as much greater.
_OF_KG = 2.5  # [kg]
_TOUCH_N = 2.0  # [N] two readings in a row of as much are a touch: one is noise, or a foot that hops
_HARD_N = 4.5  # [N] one of as much is a touch
_BEARS_N = 1.0  # [N] what a foot that stands pushes at least; twice in a row, or
_BEARS_HARD_N = 3.0  # [N] once
_NEAR_NS = 50_000_000  # [ns] between two readings that tell how the leg gathers speed
_SINCE_NS = 8_000_000  # [ns] after goals were told for which the balance of a leg's torques holds
_STEP_NS = 20_000_000  # [ns] from goals to goals
_HEARD_NS = 5_000_000  # [ns] after they were told in which it is to be seen whether a servo has heard them
_TELLS = 0.1  # [N m] by which its pull must change with them to tell; ticks and the compliance margin are half of it
_FRICTION = 2.5  # times the dry friction: goals come in steps, so at a reading the leg is always losing speed
_DOUBT = 0.4  # of what speeds the leg up, for an armature is known no better, and of a jerk that the goal makes
_LATE_NS = 30_000_000  # [ns] after a reading at which the next has been missed
_SILENT_NS = 300_000_000  # [ns] without an answer of a servo, after which nobody knows what its leg feels
_FREE = 0.75  # of the no-load speed: a femur that turns faster has met nothing, whatever is left of its full torque
_NEAREST_ARM = 0.06  # [m] of a foot beside its femur's axis: nearer ones have too little leverage to tell a push from noise
_NONE = np.zeros(6, dtype=np.bool_)
_ALL = np.ones(6, dtype=np.bool_)


@dataclass(frozen=True, slots=True)
class Felt:
    """What the legs feel in this cycle."""

    touches: NDArray[np.bool_]  # (6,) feet that have met something while they moved
    bears: NDArray[np.bool_]  # (6,) feet that stand on something
    feet: Array  # (6, 3) [m] {odom} measured foot centres
    pushes: NDArray[np.bool_] = field(default_factory=lambda: _NONE)  # (6,) legs that push the ground, if they hardly move
    heaves: NDArray[np.bool_] = field(default_factory=lambda: _NONE)  # (6,) feet that seem to lift the body
    leans: NDArray[np.bool_] = field(default_factory=lambda: _NONE)  # (6,) feet that bear if the next reading is like the last
    known: NDArray[np.bool_] = field(default_factory=lambda: _ALL)  # (6,) feet of which it is known where they are
    heard: NDArray[np.bool_] = field(default_factory=lambda: _ALL)  # (6,) legs that have told of late what they feel
    goals: Array | None = None  # (6, 3) [m] {odom} foot centres by the goals of the servos; None: where the plan has them


class FemurReading(NamedTuple):
    """What a femur says of itself, in the direction of growing angles."""

    angle: float  # [rad]
    speed: float  # [rad/s]
    load: float  # [N m] of its motor
    stamp_ns: int  # when it was asked
    told_ns: int  # when goals had been sent last


class Feeler:
    """The ground's upward push on each foot, by readings of its femur servo.

    A servo's load is what its motor gives. That turns the gear against its damping, holds the links up and speeds them up;
    the rest holds against the ground. Load and speed come in one reading, how the speed changes from the reading before, so
    a leg is read in every cycle while it matters. Goals are steps, and the load of a leg that turns falls from one to the next:
    readings are brought to one moment after the goals were told, whenever in the cycle that was.

    Tests hold it to what it is for: free swings stay below the limits, and a foot that is stopped exceeds them within three
    readings, with armatures known to within a factor of 1.6.
    """

    def __init__(self, profile: RobotProfile):
        """Begin without a reading."""
        self._profile = profile
        self._inertia = _leg_inertia(profile)
        self._heavier = profile.body.total_mass / _OF_KG
        self._speed = np.zeros(6)
        self._goal, self._told = np.zeros(6), np.zeros(6)  # [rad] what the femurs were told, and its last change
        self._jerk = np.zeros(6)  # [rad] by how much that was another change than the one before
        self._stamp_ns = np.full(6, -_NEAR_NS - 1, dtype=np.int64)
        self._push = np.zeros((2, 6))  # [N] by the newest reading and the one before
        self._tells = np.zeros(6, dtype=np.bool_)  # by the newest reading and the one before
        self._links = np.zeros((6, 3))  # [N m] that hold the links up, as the legs were in the last cycle

    def see(self, q: Array, q_goal: Array) -> None:
        """Take in where the joints are and what they are told (6, 3) [rad], once a cycle, before its readings."""
        self._links = link_torques(self._profile, q)
        links, shank = self._profile.links, q[:, 1] + q[:, 2]
        self._arm = np.maximum(links.femur * np.cos(q[:, 1]) + links.tibia * np.cos(shank), _NEAREST_ARM)
        told = q_goal[:, FEMUR] - self._goal
        self._jerk, self._told, self._goal = np.abs(told - self._told), told, q_goal[:, FEMUR].copy()

    def read(self, leg: int, femur: FemurReading) -> None:
        """Take in a reading of a leg's femur."""
        speed, since_ns = femur.speed, femur.stamp_ns - int(self._stamp_ns[leg])
        gathered, self._speed[leg], self._stamp_ns[leg] = speed - self._speed[leg], speed, femur.stamp_ns
        self._push[1, leg] = self._push[0, leg]
        self._tells[leg] = 0 < since_ns <= _NEAR_NS
        if not self._tells[leg]:
            self._push[:, leg] = 0.0  # how it gathers speed is not known
            return
        servo = self._profile.servo
        speeding_up = self._inertia * gathered / (since_ns * 1e-9)
        turning = servo.damping * speed + _FRICTION * servo.friction * np.sign(speed) + speeding_up
        doubt = _DOUBT * (abs(speeding_up) + servo.stiffness * float(self._jerk[leg]))
        push = (turning + self._links[leg, FEMUR] - self._load_at_one_moment(leg, femur)) / self._arm[leg]
        free = abs(speed) > _FREE * servo.no_load_speed
        self._push[0, leg] = 0.0 if free else np.sign(push) * max(abs(push) - doubt / self._arm[leg], 0.0)

    def _load_at_one_moment(self, leg: int, femur: FemurReading) -> float:
        """Motor torque [N m] of a femur that goes on as it does, so long after goals were told as the balance holds for.

        One that was asked right after goals has perhaps not heard them yet: its spring tells to which it pulls.
        """
        servo, goal = self._profile.servo, float(self._goal[leg])
        since_ns = min(max(femur.stamp_ns - femur.told_ns, 0), _STEP_NS)
        before = goal - float(self._told[leg])
        new, old = (_pull(servo, aim, femur.angle) for aim in (goal, before))
        if since_ns < _HEARD_NS and abs(new - old) > _TELLS and abs(femur.load - old) < abs(femur.load - new):
            since_ns, goal, new = since_ns + _STEP_NS, before, old
        then = _pull(servo, goal, femur.angle + femur.speed * (_SINCE_NS - since_ns) * 1e-9)
        return femur.load + then - new

    def forget(self, legs: NDArray[np.bool_]) -> None:
        """Begin anew with legs (6,): what they felt is over."""
        self._push[:, legs] = 0.0

    @property
    def push(self) -> Array:
        """(6,) [N] of the ground on each foot, upward, by the newest readings."""
        return np.array(self._push[0])

    @property
    def touches(self) -> NDArray[np.bool_]:
        """(6,) feet that have met something while they moved."""
        return self._above(_TOUCH_N, _HARD_N)

    @property
    def bears(self) -> NDArray[np.bool_]:
        """(6,) feet that stand on something: those that share their load with five others may bear little of it."""
        return self._above(_BEARS_N, _BEARS_HARD_N)

    @property
    def leans(self) -> NDArray[np.bool_]:
        """(6,) feet that push as one that stands by their newest reading, which one more has yet to bear out."""
        return np.asarray(self._push[0] / self._heavier > _BEARS_N)

    def _above(self, twice: float, once: float) -> NDArray[np.bool_]:
        """Feet (6,) whose push is above one limit [N] in two readings, or above another in one."""
        push = self._push / self._heavier
        return np.asarray((push > twice).all(axis=0) | (push[0] > once))

    def heard(self, now_ns: int) -> NDArray[np.bool_]:
        """(6,) legs whose newest readings tell what they feel: none of them was asked in vain."""
        return np.asarray(self._tells & (now_ns - self._stamp_ns <= _LATE_NS))

    def silent(self, now_ns: int) -> NDArray[np.bool_]:
        """(6,) legs whose servo has not answered for a while: of them nothing is known."""
        return np.asarray(now_ns - self._stamp_ns > _SILENT_NS)


def _pull(servo: Servo, goal: float, angle: float) -> float:
    """Torque [N m] of a servo that is told a goal and is at an angle [rad]."""
    return min(max(servo.stiffness * (goal - angle), -servo.stall_torque), servo.stall_torque)


def _leg_inertia(profile: RobotProfile) -> float:
    """Inertia [kg m^2] about a femur's axis: the motor's, and the links with the knee bent square."""
    _, femur, tibia = profile.body.leg_link_masses
    arm = profile.links.femur**2 + (profile.links.tibia / 2) ** 2
    return profile.servo.armature + femur * (profile.links.femur / 2) ** 2 + tibia * arm
