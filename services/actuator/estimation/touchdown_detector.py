"""Touchdown detection: femur servo load less the torque that moves the leg."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.free_motion import FreeMotion
from sextant.services.actuator.estimation.params import TouchdownParams
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import link_torques
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.servo import Servo
from sextant.shared.servo.servo_model import Feedback

FEMUR = 1  # the joint that bears the ground's push; the tibia's lever arm over the foot is short
_REFERENCE_MASS_KG = 2.5  # [kg] mass of the robot to which the limits of the parameters refer
_MAX_READING_GAP = 2.5  # [periods] maximum time between two readings from which the acceleration of the leg is computed
_BALANCE = 0.4  # [periods] time after goals are sent to which loads are converted, because the torque balance holds then
_EARLY = 0.6  # [periods] time after goals below which a reading's acceleration is that of the earlier goals, too
_TRANSMISSION_NS = 5_000_000  # [ns] time after goals are sent within which a servo may not have received them yet
_MIN_TORQUE_CHANGE_NM = 0.1  # [N m] least torque difference of two goals that a reading tells apart; ticks cause half of it
_LATE = 1.5  # [periods] maximum age of a recent reading
_SILENT_NS = 300_000_000  # [ns] without an answer of a servo after which the contact of its leg is unknown
_NONE = np.zeros(6, dtype=np.bool_)
_ALL = np.ones(6, dtype=np.bool_)


@dataclass(frozen=True, slots=True)
class FootContact:
    """Measured contacts of one cycle."""

    touches: NDArray[np.bool_]  # (6,) feet that have met something while they moved
    bears: NDArray[np.bool_]  # (6,) feet that stand on something
    feet: Array  # (6, 3) [m] {odom} measured foot centres
    pushes: NDArray[np.bool_] = field(default_factory=lambda: _NONE)  # (6,) legs that push the ground; valid at low speed
    stands: NDArray[np.bool_] = field(default_factory=lambda: _NONE)  # (6,) legs that push by femur and tibia, at rest
    lifts_body: NDArray[np.bool_] = field(default_factory=lambda: _NONE)  # (6,) feet that seem to lift the body
    may_bear: NDArray[np.bool_] = field(default_factory=lambda: _NONE)  # (6,) feet that bear if the next reading confirms it
    known: NDArray[np.bool_] = field(default_factory=lambda: _ALL)  # (6,) feet with known position
    heard: NDArray[np.bool_] = field(default_factory=lambda: _ALL)  # (6,) legs with recent readings
    goals: Array | None = None  # (6, 3) [m] {odom} foot centres by the servo goals; None: as planned


class FemurReading(NamedTuple):
    """Reading of a femur servo, in the direction of growing angles."""

    angle: float  # [rad]
    speed: float  # [rad/s]
    load: float  # [N m] of its motor
    stamp_ns: int  # when it was requested
    told_ns: int  # when goals were last sent


class TouchdownDetector:
    """Upward ground force on each foot, from readings of its femur servo.

    The load of a servo is its motor torque. It overcomes the damping of the gear, holds the links and accelerates them; the
    rest balances the ground. Load and speed come in one reading, acceleration from two, so a leg is read in every cycle while
    its contact matters. Goals are steps, and the load of a turning leg falls from one goal to the next. Therefore readings are
    converted to a fixed time after the goals were sent.

    Where servos measure no speed, a tick of their positions from one cycle to the next is too coarse for an acceleration. The
    push is then what keeps the femur from the angles that it would have in the air, see `FreeMotion`: between those with the
    least and with the greatest inertia that it may have.

    Tests verify that free swings stay below the limits, and that a stopped foot exceeds them within three readings, with
    armatures known to within a factor of 1.6.
    """

    def __init__(self, profile: RobotProfile, params: TouchdownParams | None = None):
        """Begin without a reading."""
        self._profile, self._params = profile, params or TouchdownParams()
        self.period_ns = 20_000_000  # [ns] from the last control cycle, in which goals were sent, to this one
        self.bridged = False  # whether readings come from a microcontroller, which reads in step with its goals
        self._servos = tuple(profile.servos.each[FEMUR::3])  # of the femurs
        self._inertia = _leg_inertias(profile)
        measures = Feedback.SPEED in profile.servo_model.feedback
        ratio = self._params.inertia_ratio
        inertias = ([inertia * k for inertia in self._inertia] for k in (1.0 / ratio, ratio))
        self._free = () if measures else tuple(FreeMotion(self._servos, one) for one in inertias)
        ticks = (servo.stiffness * servo.servo_model.units.tick_rad for servo in self._servos)  # [N m]
        self._unfelt = [servo.friction + tick / 2 for servo, tick in zip(self._servos, ticks, strict=True)]  # [N m]
        self._mass_ratio = profile.body.total_mass / _REFERENCE_MASS_KG
        # All of them are lists, one number for each leg: readings come leg by leg.
        self._speed = [0.0] * 6  # [rad/s] of the femurs, by the newest readings
        self._arm = [self._params.min_arm_m] * 6  # [m] horizontal lever arms of the feet over their femur axes
        self._goal, self._goal_change = [0.0] * 6, [0.0] * 6  # [rad] goals of the femurs, and their last change
        self._goal_change_difference = [0.0] * 6  # [rad] absolute difference between the last two goal changes
        self._stamp_ns = [-round(_MAX_READING_GAP * self.period_ns) - 1] * 6  # [ns] of the newest readings
        self._push, self._push_before = [0.0] * 6, [0.0] * 6  # [N] upward ground force by the last two readings
        self._valid = [False] * 6  # whether the last two readings of a leg are close enough in time
        self._holding_torque = [0.0] * 6  # [N m] femur torques that hold the links against gravity

    def begin_cycle(self, q: Array, q_goal: Array) -> None:
        """Set joint angles and goals (6, 3) [rad]; call it once per cycle, before `add_reading`."""
        self._holding_torque = link_torques(self._profile, q)[:, FEMUR].tolist()
        links, shortest = self._profile.links, self._params.min_arm_m
        self._arm = [
            max(links.femur * math.cos(femur) + links.tibia * math.cos(femur + tibia), shortest)
            for _, femur, tibia in q.tolist()
        ]
        goals = q_goal[:, FEMUR].tolist()
        changes = [goal - before for goal, before in zip(goals, self._goal, strict=True)]
        self._goal_change_difference = [abs(change - before) for change, before in zip(changes, self._goal_change, strict=True)]
        self._goal_change, self._goal = changes, goals
        for free in self._free:
            free.follow(goals, q[:, FEMUR].tolist(), self._holding_torque, self.period_ns * 1e-9)

    def add_reading(self, leg: int, femur: FemurReading) -> None:
        """Compute the ground force on a foot from a reading of its femur."""
        speed, since_ns = femur.speed, femur.stamp_ns - self._stamp_ns[leg]
        speed_change, self._speed[leg], self._stamp_ns[leg] = speed - self._speed[leg], speed, femur.stamp_ns
        self._push_before[leg] = self._push[leg]
        if self._free:
            self._valid[leg] = True  # one reading is enough
            self._push_before[leg] *= 0 < since_ns <= _MAX_READING_GAP * self.period_ns
            self._push[leg] = self._push_beyond_free(leg, femur)
            return
        self._valid[leg] = 0 < since_ns <= _MAX_READING_GAP * self.period_ns
        if not self._valid[leg]:
            self._push[leg] = self._push_before[leg] = 0.0  # acceleration is unknown
            return
        servo = self._servos[leg]
        acceleration_torque = self._inertia[leg] * speed_change / (since_ns * 1e-9)
        friction = math.copysign(self._friction(leg), speed) if speed else 0.0
        motion_torque = servo.damping * speed + friction + acceleration_torque
        uncertainty = self._params.doubt_share * (
            abs(acceleration_torque) + servo.stiffness * self._goal_change_difference[leg]
        )
        push = (motion_torque + self._holding_torque[leg] - self._load_at_balance(leg, femur)) / self._arm[leg]
        free = abs(speed) > self._params.free_speed_share * servo.no_load_speed
        self._push[leg] = 0.0 if free else math.copysign(max(abs(push) - uncertainty / self._arm[leg], 0.0), push)

    def _push_beyond_free(self, leg: int, femur: FemurReading) -> float:
        """Return the ground force [N] on a foot that keeps its femur from all angles that it may have in the air."""
        servo, arm = self._servos[leg], self._arm[leg]
        after_ns = min(max(femur.stamp_ns - femur.told_ns, 0), 2 * self.period_ns)
        angles = [free.at(leg, after_ns * 1e-9) for free in self._free]
        push = servo.stiffness * (femur.angle - min(max(femur.angle, min(angles)), max(angles)))
        return math.copysign(max(abs(push) - self._unfelt[leg], 0.0), push) / arm

    def _friction(self, leg: int) -> float:
        """Return the torque [N m] to allow for dry friction: beyond the friction itself, it hides only a share of a touch."""
        params, friction = self._params, self._servos[leg].friction
        most = params.friction_share * params.touch_n * self._mass_ratio * self._arm[leg]
        return friction * min(params.friction_ratio, 1.0) + min(max(params.friction_ratio - 1.0, 0.0) * friction, most)

    def _load_at_balance(self, leg: int, femur: FemurReading) -> float:
        """Return a femur's motor torque [N m] when the torque balance holds.

        A servo read right after new goals may not have received them yet; its spring torque shows which goal it follows. A
        reading of a microcontroller in the first half of a period, or before new goals, is converted to the mean goal since the
        reading before.
        """
        servo, goal = self._servos[leg], self._goal[leg]
        since_ns = min(max(femur.stamp_ns - femur.told_ns, 0), self.period_ns)
        before = goal - self._goal_change[leg]
        new, old = (_spring_torque(servo, aim, femur.angle) for aim in (goal, before))
        if (
            since_ns < _TRANSMISSION_NS
            and abs(new - old) > _MIN_TORQUE_CHANGE_NM
            and abs(femur.load - old) < abs(femur.load - new)
        ):
            since_ns, goal, new = since_ns + self.period_ns, before, old
        delay_ns = since_ns - _BALANCE * self.period_ns
        if self.bridged and not _EARLY * self.period_ns <= since_ns <= self.period_ns:
            share = min(since_ns / self.period_ns, 1.0)
            goal, delay_ns = before + (goal - before) * share, 0.5 * self.period_ns
        then = _spring_torque(servo, goal, femur.angle - femur.speed * delay_ns * 1e-9)
        return femur.load + then - new

    def forget(self, legs: NDArray[np.bool_]) -> None:
        """Discard the earlier readings of legs (6,)."""
        for leg, forgets in enumerate(legs.tolist()):
            if forgets:
                self._push[leg] = self._push_before[leg] = 0.0

    @property
    def push(self) -> Array:
        """(6,) [N] upward ground force on each foot, by the newest readings."""
        return np.array(self._push)

    @property
    def touches(self) -> NDArray[np.bool_]:
        """(6,) feet that have met something while they moved."""
        return self._above(self._params.touch_n, self._params.hard_touch_n)

    @property
    def bears(self) -> NDArray[np.bool_]:
        """(6,) feet that stand; with six standing feet the load of one may be small."""
        return self._above(self._params.bears_n, self._params.hard_bears_n)

    @property
    def may_bear(self) -> NDArray[np.bool_]:
        """(6,) feet that stand by their newest reading; the next one has to confirm."""
        least = self._params.bears_n * self._mass_ratio
        return np.array([push > least for push in self._push])

    def _above(self, twice: float, once: float) -> NDArray[np.bool_]:
        """Return feet (6,) whose push exceeds `twice` [N] twice or `once` [N] once."""
        twice, once = twice * self._mass_ratio, once * self._mass_ratio
        pushes = zip(self._push, self._push_before, strict=True)
        return np.array([(push > twice and before > twice) or push > once for push, before in pushes])

    def heard(self, now_ns: int) -> NDArray[np.bool_]:
        """(6,) legs with valid recent readings."""
        oldest = now_ns - _LATE * self.period_ns
        return np.array([valid and stamp >= oldest for valid, stamp in zip(self._valid, self._stamp_ns, strict=True)])

    def silent(self, now_ns: int) -> NDArray[np.bool_]:
        """(6,) legs whose servo has not answered for a while; their contact is unknown."""
        oldest = now_ns - _SILENT_NS
        return np.array([stamp < oldest for stamp in self._stamp_ns])


def _spring_torque(servo: Servo, goal: float, angle: float) -> float:
    """Return the torque [N m] of a servo with a goal and an angle [rad]."""
    return min(max(servo.stiffness * (goal - angle), -servo.stall_torque), servo.stall_torque)


def _leg_inertias(profile: RobotProfile) -> list[float]:
    """Return the inertia [kg m^2] about each femur axis, with the knee at 90 deg.

    It is the sum of motor armature and links.
    """
    _, femur, tibia = profile.body.leg_link_masses
    arm = profile.links.femur**2 + (profile.links.tibia / 2) ** 2
    armatures = profile.servos.armature[:, FEMUR].tolist()
    return [armature + femur * (profile.links.femur / 2) ** 2 + tibia * arm for armature in armatures]
