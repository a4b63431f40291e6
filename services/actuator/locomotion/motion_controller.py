"""Selection of the motion that moves the legs. Pure.

The legs hold their goals, stand up, lie down, or follow the step executor. Legs that resume their motion after they were not
under control do so slowly.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion.joint_goals import JointGoals
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE, LOWERED
from sextant.services.actuator.locomotion.leg_recovery import LegRecovery
from sextant.services.actuator.locomotion.stand_sit import LieDown, StandUp
from sextant.services.actuator.locomotion.step_executor import StepExecutor, Targets
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.robot.profile import RobotProfile

_STANDING_LOAD_SHARE = 0.5  # share of its load from which a leg counts as standing
_ALL = np.ones(6, dtype=np.bool_)


class MotionController:
    """Moves the legs by one motion at a time, and converts its targets to joint goals.

    Call `restart` before the first cycle.
    """

    executor: StepExecutor

    def __init__(self, profile: RobotProfile, settings: Settings, goals: Array):
        """Begin at rest at goals (6, 3) [rad]."""
        self.goals = JointGoals(profile, goals)
        self.is_holding = False  # whether the legs hold their goals
        self._profile, self._settings = profile, settings
        self._posture: StandUp | LieDown | None = None  # motion that moves the legs instead of the walk
        self._recovery = LegRecovery()
        self._slow_legs = _ALL  # (6,) legs whose speed is limited during a whole gentle step
        self._slow_rad_s: float = GENTLE  # [rad/s] their joints' limit

    # ------------------------------------------------------------------------------------------------------- selection

    def restart(self, feet: Array, T_odom_body: Array, ground: Array) -> None:
        """Restart the walk, with feet (6, 3) [m] {body} that stand at heights (6,) [m] {odom}."""
        self.executor = StepExecutor(self._settings, feet, T_odom_body, ground, self._profile.servos.inertia_s)
        self._recovery = LegRecovery()

    def take_over(self, slowly: bool) -> None:
        """Continue from the present joint angles; discard earlier targets."""
        self.goals.begin_motion()
        if slowly:
            self._limit(_ALL, GENTLE)

    def lower(self, lifted: Array) -> None:
        """Lower hanging feet by heights (6,) [m]; a low speed limits the force on an obstacle."""
        self._slow_legs, self._slow_rad_s = _ALL, LOWERED
        self.executor.lower(lifted)

    def torque_off(self) -> None:
        """End all motions, because the servos have no torque."""
        self.goals.limits.forget()
        self._posture, self._recovery = None, LegRecovery()

    def hold(self, goals: Array) -> None:
        """Hold goals (6, 3) [rad] that the servos have just been given."""
        self.torque_off()
        self.is_holding = True
        self.goals.hold(goals)

    def freeze(self) -> None:
        """Hold the present goals."""
        self.goals.limits.forget()
        self._posture, self.is_holding = None, True

    def stand_up(self, goals: Array, relief: Array | None = None) -> None:
        """Begin to stand up from the present goals (6, 3) [rad]; `relief` (6,) [m] is the ground's, see `ground_relief`."""
        self._begin(StandUp(self._profile, body_forward(self._profile, goals), self._settings.stand_s, relief))

    def lie_down(self) -> None:
        """Begin to lower the body to the ground."""
        self._begin(LieDown(self._profile, body_forward(self._profile, self.goals.wanted), self._settings.stand_s))

    def _begin(self, posture: StandUp | LieDown) -> None:
        self.is_holding, self._posture, self._recovery = False, posture, LegRecovery()
        self.goals.begin_motion()

    def end_posture(self) -> bool:
        """Finish standing up or lying down; return whether the robot now stands."""
        stands = isinstance(self._posture, StandUp)
        self._posture, self.is_holding = None, not stands
        return stands

    @property
    def set_down(self) -> NDArray[np.bool_]:
        """Legs (6,) that a walk has set down; some of them may carry little."""
        return ~self.executor.flying & (not self.is_holding and self._posture is None)

    @property
    def changes_posture(self) -> bool:
        """Whether the robot stands up or lies down."""
        return self._posture is not None

    @property
    def posture_is_reached(self) -> bool:
        """Whether standing up or lying down is complete, and `end_posture` is due."""
        return self._posture is not None and self._posture.done

    # ------------------------------------------------------------------------------------------------------ every cycle

    def recover_legs(
        self, torque_disabled: NDArray[np.bool_], unsure: NDArray[np.bool_], feet_odom: Array, goals: Array
    ) -> None:
        """Step legs that were without torque back to their footholds as soon as possible.

        They start from an arbitrary position, so without a step they would scrape or jam.

        Args:
            torque_disabled: (6, 3) joints whose servo has no torque.
            unsure: (6, 3) these joints, and joints that are not yet at their goal after their servo did not respond.
            feet_odom: (6, 3) [m] {odom} measured feet.
            goals: (6, 3) [rad] last goals.
        """
        back = self._recovery.update(torque_disabled, unsure, self.executor.flying)
        if back.any() and self.executor.resting:
            self.executor.put_back(back, feet_odom)
            self._slow_legs, self._slow_rad_s = back, self._recovery.start()
            self.goals.adopt(back, goals)  # these legs had no other target
        if self.executor.gentle:
            self._limit(self._slow_legs, self._slow_rad_s)

    def update(
        self, dt: float, T_odom_body: Array, contact: FootContact | None, goals: Array, without_torque: NDArray[np.bool_]
    ) -> tuple[Array, Targets]:
        """Advance the present motion by one cycle.

        Args:
            dt: [s] since the last cycle.
            T_odom_body: (4, 4) body pose by the measured joints.
            contact: Measured contacts.
            goals: (6, 3) [rad] last goals.
            without_torque: (6,) legs with a servo without torque.

        Returns:
            (6, 3) [rad] next goals, and the targets of the feet.
        """
        if self._posture is not None:
            targets = self._posture.update(dt)
        else:
            targets = self.executor.update(dt, T_odom_body, contact, self.goals.limits.pace)
        # A femur that moves down without its tibia would lift the body, so a hanging leg stays until it is recovered.
        recovery = self._recovery
        holds = np.asarray(recovery.dangling | (recovery.unrecovered & ~without_torque))
        return self.goals.follow(targets, goals, holds, dt), targets

    def resume_joint(self, index: int) -> None:
        """Resume the motion of a joint (0 to 17) slowly; without a motion it holds."""
        if not self.is_holding:
            self.goals.limits.limit_joint(*divmod(index, 3))

    def _limit(self, legs: NDArray[np.bool_], top: float) -> None:
        """Limit the joint speed of legs (6,) to `top` [rad/s] until they have caught up."""
        for leg, joint in np.ndindex(6, 3):
            if legs[leg]:
                self.goals.limits.limit_joint(leg, joint, top)

    # ------------------------------------------------------------------------------------------------------------ state

    def unsure_legs(self, unsure: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(6,) legs with unknown foot position.

        They have joints (6, 3) that are unsure, or they have not been recovered yet.
        """
        unrecovered = self._recovery.unrecovered
        return unsure.any(axis=1) | unrecovered if np.count_nonzero(unsure) else unrecovered.copy()

    def standing(self, unsure: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(6,) legs that stand.

        Legs with joints (6, 3) without torque, or not yet at their goals, do not count, unless fewer than three legs would
        remain.
        """
        walk = self.executor
        standing = (~walk.swing | (walk.load_share > _STANDING_LOAD_SHARE)) & ~walk.searching
        firm = standing & ~self.unsure_legs(unsure)
        return np.asarray(firm if np.count_nonzero(firm) >= 3 else standing)

    @property
    def behind(self) -> NDArray[np.bool_]:
        """(18,) joints that have not resumed their motion yet.

        This includes joints whose legs are being recovered or wait for recovery.
        """
        return np.asarray(self.goals.limits.behind | self._recovery.waiting).ravel()

    @property
    def waiting_reason(self) -> str:
        """Why no plan may be walked yet, or an empty string."""
        walk = self.executor
        if walk.is_searching or walk.is_returning:
            return walk.trouble
        catches_up = walk.gentle or (walk.resting and self.goals.limits.is_limiting)
        return "the joints are catching up with their goals, slowly" if catches_up else ""
