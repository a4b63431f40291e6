"""Calibration motion: the robot stands, moves its body through postures, and measures floor and joints meanwhile."""

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from sextant.services.perception.calibration.floor_view import block_centres
from sextant.services.perception.calibration.imu_mount import ImuTrack
from sextant.services.perception.calibration.kinematic_calibration import JointTrack, Recording
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.robot_clock import RobotClockEstimate
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, FloorView, Imu, Message, Mode, ModeCommand, PostureCommand, Tick

# Postures, as numbers of a Halton sequence: of its first 400 numbers, those that determine the camera of a PhantomX best, most
# of all its pitch (exchange algorithm, Fedorov 1972), in the order of the shortest way.
_CHOSEN = (
    *(62, 48, 321, 21, 252, 197, 56, 344, 125, 251, 41, 272, 147, 7, 217, 282, 361, 151),
    *(31, 327, 383, 313, 47, 397, 396, 32, 285, 340, 132, 13, 248, 117, 40, 355, 124, 334),
)
POSTURES = len(_CHOSEN)
_LARGEST = np.array([0.055, 0.055, 0.05, *np.radians([18.0, 18.0, 22.0])])  # [m] and [rad] of a posture
_INSIDE = 0.85  # share of the reach that a posture may use
_SETTLE_NS = 400_000_000  # [ns] at rest before the next posture
_BEAT_HZ = 30.0
_ORDER_NS = 500_000_000  # [ns] interval of repeated orders
_NEEDED: dict[str, AnyTopic] = {
    "view of the floor": topics.FLOOR,
    "pose from perception": topics.BODY_POSE,
    "message of the planner": topics.PLANNER_STATUS,
}
_STANDING_NS = 1_500_000_000  # [ns] of standing before the first posture; the order to stand has then been executed
_READ_NS = 4_000_000  # [ns] mean time from the reading of a joint to the stamp of its state: servos are read one by one
_PATIENCE_NS = 15_000_000_000  # [ns] for one posture
_RISE_NS = 30_000_000_000  # [ns] for standing up, and until perception has a pose


def postures(profile: RobotProfile) -> Array:
    """Return the postures (POSTURES, 6) [m] and [rad] of a calibration: place, roll, pitch and yaw from the rest pose.

    They spread over all six directions, as far as the legs reach.
    """
    spread = 2.0 * np.stack([_halton(_CHOSEN[:POSTURES], base) for base in (2, 3, 5, 7, 11, 13)], axis=1) - 1.0
    spread /= np.abs(spread).max(axis=1, keepdims=True)  # on the faces of the cube
    return np.array([_INSIDE * _within_reach(profile, _LARGEST * direction) for direction in spread])


def _within_reach(profile: RobotProfile, posture: Array) -> Array:
    """Return the largest share of a posture that all legs reach."""
    rest = profile.rest_feet()
    for share in np.arange(1.0, 0.0, -0.05):
        T_rest_body = from_xyz_rpy(share * posture[:3], share * posture[3:])
        if within_limits(profile, body_inverse(profile, apply(inverse(T_rest_body), rest))).all():
            return np.asarray(share * posture)
    return np.zeros(6)


def _halton(which: Sequence[int], base: int) -> Array:
    """Return some numbers of the Halton sequence of a base; the first one is number 0."""
    numbers = np.zeros(len(which))
    for i, number in enumerate(which):
        index, share = number + 1, 1.0 / base
        while index > 0:
            numbers[i] += share * (index % base)
            index, share = index // base, share / base
    return numbers


class Survey:
    """Operator that leads a robot through the postures of a calibration, and records what it measures."""

    name = "operator"
    subscribes = (topics.FLOOR, topics.ACTUATOR_STATE, topics.PLANNER_STATUS, topics.BODY_POSE, topics.IMU)
    publishes = (topics.POSTURE, topics.MODE)

    def __init__(self, profile: RobotProfile, holder: str = "operator"):
        """Prepare the motion.

        Args:
            profile: The robot.
            holder: Name under which this operator leads.
        """
        self.trigger = Every.hz(_BEAT_HZ)
        self.stages = Stages()
        self.finished = False
        self.reason = ""  # why it is finished, as text
        self.reached = 0  # postures that the robot had
        self.refusal = ""  # why the last posture that it did not have was refused
        self._holder, self._blocks = holder, len(block_centres(profile.camera.intrinsics)[0])
        self._robot = RobotClockEstimate()
        self._postures = [*postures(profile), np.zeros(6)]  # the robot ends in its rest pose
        self._number = -1  # of the current posture; -1: standing up
        self._order: Literal["stand", "walk"] = "stand"
        self._given_ns, self._order_due_ns = -1, 0
        self._began_ns = self._settled_ns = -1  # when the posture was commanded, and since when the body rests
        self._epoch, self._standing_ns = -1, 0  # of {odom} during the motion, and since when the robot stands by this order
        self._views: list[FloorView] = []
        self._numbers: list[int] = []
        self._states: list[ActuatorState] = []
        self._imu: list[Imu] = []

    def status(self) -> str:
        """Return the progress as text."""
        if self.reason:
            return self.reason
        return "standing up" if self._number < 0 else f"posture {self._number + 1} of {len(self._postures)}"

    @property
    def progress(self) -> tuple[int, int]:
        """Return the number of the current posture, 0 before the first one, and that of all postures."""
        return min(self._number + 1, len(self._postures)), len(self._postures)

    @property
    def is_complete(self) -> bool:
        """Return whether the robot had, or could not have, all postures."""
        return self._number == len(self._postures)

    def recording(self) -> Recording | None:
        """Return the measurements; None if the motion ended before the last posture, or no image came."""
        if not self.is_complete or not self._views:
            return None
        stamps, q, contact = zip(*((state.stamp_ns, state.q, state.contact) for state in self._states), strict=True)
        return Recording(
            self._views, np.array(self._numbers), JointTrack(np.array(stamps) - _READ_NS, np.array(q), np.array(contact))
        )

    def imu(self) -> ImuTrack | None:
        """Return the readings of the IMU during the motion; None without one."""
        if not self._imu:
            return None
        stamps, gyro, force = zip(*((one.stamp_ns, one.gyro, one.specific_force) for one in self._imu), strict=True)
        return ImuTrack(np.array(stamps), np.array(gyro), np.array(force))

    def withdraw(self) -> tuple[Message, ...]:
        """Return the message that stops the robot before the end; none if it was never ordered to move."""
        return () if self._given_ns < 0 else (ModeCommand(self._robot(), "stop", self._robot(), self._holder),)

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Note the measurements, and command the next posture."""
        now, state = tick.stamp_ns, inbox.latest(topics.ACTUATOR_STATE)
        self._robot.see(now, None if state is None else state.stamp_ns)
        newest_ns = self._imu[-1].stamp_ns if self._imu else -1
        self._imu += [one for one in inbox.drain(topics.IMU) if one.stamp_ns > newest_ns]
        if self._began_ns < 0:
            self._began_ns = now
        if not self.finished:
            self._advance(now, state, inbox)
        if state is None or not self._robot.known:
            return
        if self._number >= 0 and not self.finished:
            self._note(state, inbox)
            posture = self._postures[self._number]
            yield PostureCommand(self._robot(), posture[:3], posture[3:])
        if now >= self._order_due_ns:
            self._given_ns = self._robot() if self._given_ns < 0 else self._given_ns
            self._order_due_ns = now + _ORDER_NS
            yield ModeCommand(self._robot(), self._order, self._given_ns, self._holder)

    def _advance(self, now: int, state: ActuatorState | None, inbox: Inbox) -> None:
        """Go on to the next posture once the body rests in this one, or cannot reach it."""
        if self._order == "stand":
            if state is None or state.lease != self._holder or state.mode is not Mode.HOLD or state.epoch != self._epoch:
                self._epoch, self._standing_ns = -1 if state is None else state.epoch, now
            missing = [name for name, topic in _NEEDED.items() if inbox.latest(topic) is None]
            if now - self._standing_ns >= _STANDING_NS and not missing:
                self._order, self._given_ns, self._order_due_ns = "walk", -1, 0
                self._number, self._began_ns = 0, now
            elif now - self._began_ns > _RISE_NS:
                lacks = f"no {' and no '.join(missing)} arrives here" if missing else self._obstacle(state)
                if inbox.latest(topics.PLANNER_STATUS) is None:
                    lacks += "; of two machines, calibrate on the one with the planner"
                self._finish(f"the robot is not ready: {lacks}")
            return
        stopped = self._number > 0 and "not ordered to walk" in (state.plan_refusal if state is not None else "")
        if state is None or state.epoch != self._epoch or state.lease not in ("", self._holder) or stopped:
            self._finish(f"the robot was interrupted: {self._obstacle(state)}")
            return
        status = inbox.fresh(topics.PLANNER_STATUS)
        ended = status is not None and status.state in ("arrived", "blocked") and now - self._began_ns > _SETTLE_NS
        if not ended:
            self._settled_ns = -1
            if now - self._began_ns > _PATIENCE_NS:
                self._finish(f"posture {self._number + 1} is not reached: {'no planner' if status is None else status.reason}")
            return
        assert status is not None
        if self._settled_ns < 0:
            self._settled_ns = now
        if now - self._settled_ns < _SETTLE_NS:
            return
        if status.state == "arrived":
            self.reached += 1
        else:
            self.refusal = status.reason
        self._number, self._began_ns, self._settled_ns = self._number + 1, now, -1
        if self.is_complete:
            self._finish("all postures measured")

    def _obstacle(self, state: ActuatorState | None) -> str:
        """Return what the actuator says about a robot that does not move as commanded."""
        if state is None:
            return "the actuator is silent"
        if state.lease not in ("", self._holder):
            return f"{state.lease} leads it; `sextant order stop` ends that"
        return state.plan_refusal or f"the actuator is in mode {state.mode}: {state.reason}"

    def _finish(self, reason: str) -> None:
        self.finished, self.reason = True, reason

    def _note(self, state: ActuatorState, inbox: Inbox) -> None:
        """Keep the newest joint angles and the newest view of the floor."""
        if not self._states or state.stamp_ns > self._states[-1].stamp_ns:
            self._states.append(state)
        view = inbox.latest(topics.FLOOR)
        if view is None or (self._views and view.stamp_ns <= self._views[-1].stamp_ns):
            return
        if (count := len(view.inverse_depth)) != self._blocks:
            self._finish(f"{self._blocks} blocks of an image expected, found {count}: perception runs with another profile")
            return
        self._views.append(view)
        self._numbers.append(self._number)
