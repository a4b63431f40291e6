"""Messages of the actuator: odometry, and its state."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.state_estimator import StateEstimator
from sextant.services.actuator.locomotion.ground_contacts import Finding
from sextant.services.actuator.locomotion.motion_controller import MotionController
from sextant.services.actuator.safety.guard import Guard
from sextant.services.actuator.servo_bus.joints import Joints
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import ActuatorState, Mode, Odometry

ON_FEET = (Mode.HOLD, Mode.WALK, Mode.FAULT)  # modes in which the legs carry the body


class StateReport:
    """Composes the messages; keeps what lasts from one state message to the next."""

    def __init__(self, foot_radius: float, has_touch: bool = True):
        """Begin without contacts.

        Args:
            foot_radius: [m] from a foot's centre to the ground.
            has_touch: Whether servos measure anything that shows contact; otherwise legs are assumed to stand as planned.
        """
        self.T_world_odom: Array = np.eye(4)  # by the newest accepted plan
        self._foot_radius, self._has_touch = foot_radius, has_touch
        self._touch_ns = np.full(6, -1, dtype=np.int64)  # contacts that feet have found, see ActuatorState
        self._touch = np.zeros((6, 3))
        self._touch_carries = np.zeros(6, dtype=np.bool_)
        self._sent: tuple[Mode, str, str, int] | None = None  # contents of the last state message
        self._paused = False  # whether the last cycle sent no state message

    def note_contacts(self, findings: Sequence[Finding], now_ns: int) -> None:
        """Store the contacts that feet have found until the next state message."""
        for found in findings:
            self._touch_ns[found.leg], self._touch_carries[found.leg] = now_ns, found.carries
            self._touch[found.leg] = found.p_odom - [0.0, 0.0, self._foot_radius]

    def is_due(self, guard: Guard, motion: MotionController) -> bool:
        """Return whether to send the state: every other cycle, and at once after a change."""
        contents = (guard.mode, guard.reason, guard.refused, motion.executor.plan_ns)
        due = contents != self._sent or self._paused
        self._paused = not due
        if due:
            self._sent = contents
        return due

    def _assumed_contact(self, guard: Guard, motion: MotionController, joints: Joints) -> NDArray[np.bool_]:
        """Return the legs (6,) that stand as planned; none unless the robot is on its feet."""
        return motion.standing(joints.unsure) & (guard.mode in ON_FEET)

    def odometry(self, stamp_ns: int, estimator: StateEstimator, motion: MotionController, joints: Joints) -> Odometry:
        """Return the odometry message."""
        odometry = estimator.odometry
        return Odometry(
            stamp_ns=stamp_ns,
            T_odom_body=odometry.T_odom_body.copy(),
            path_length=odometry.travelled,
            total_rotation=odometry.turned,
            stance=motion.standing(joints.unsure),
            reliable=odometry.reliable,
        )

    def state(
        self,
        stamp_ns: int,
        guard: Guard,
        estimator: StateEstimator,
        motion: MotionController,
        joints: Joints,
        pace: float,
        warnings: Sequence[str],
    ) -> ActuatorState:
        """Return the state message; empty warnings are left out."""
        walk, odometry = motion.executor, estimator.odometry
        return ActuatorState(
            stamp_ns=stamp_ns,
            mode=guard.mode,
            reason=guard.reason,
            lease=guard.lease(stamp_ns),
            epoch=guard.epoch,
            speed_scale=pace,
            plan_refusal=guard.plan_refusal(stamp_ns),
            refused_plan_ns=guard.refused_ns,
            plan_ns=walk.plan_ns,
            step=walk.step,
            phase=float(walk.phase),
            swing=walk.swing.copy(),
            contact=(estimator.contact.legs if self._has_touch else self._assumed_contact(guard, motion, joints))
            & ~walk.flying,
            q=odometry.q - joints.offsets,
            load_nm=joints.load.copy(),
            feet=odometry.feet.copy(),
            T_odom_body=odometry.T_odom_body.copy(),
            body_ref=walk.body_ref,
            T_world_odom=self.T_world_odom.copy(),
            voltage=_known(np.fmin.reduce(joints.voltage)),
            temperature=_known(np.fmax.reduce(joints.temperature)),
            warnings=tuple(w for w in warnings if w),
            touchdown_ns=self._touch_ns.copy(),
            touchdown_point=self._touch.copy(),
            touchdown_contact=self._touch_carries.copy(),
            slip=float(odometry.slip.max()),
        )


def _known(value: float) -> float:
    """Return a number, or zero if it is NaN."""
    return 0.0 if np.isnan(value) else float(value)
