"""Actuator service: step plans in, servo goals and leg measurements out, at 50 Hz."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from sextant.services.actuator.config import Settings
from sextant.services.actuator.control_rate import ControlRate
from sextant.services.actuator.cycle_clock import CycleClock
from sextant.services.actuator.estimation.horn_correction import HornCorrection
from sextant.services.actuator.estimation.leg_monitor import LegMonitor
from sextant.services.actuator.estimation.state_estimator import StateEstimator
from sextant.services.actuator.estimation.touchdown_detector import FEMUR, FemurReading
from sextant.services.actuator.locomotion.motion_controller import MotionController
from sextant.services.actuator.locomotion.stand_sit import ground_relief
from sextant.services.actuator.safety.command_ordering import in_turn
from sextant.services.actuator.safety.guard import Act, Guard, Stance, Walk
from sextant.services.actuator.safety.health_monitor import GAP_S, Health, Verdict
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.actuator.safety.torque_off_state import TorqueOffState
from sextant.services.actuator.safety.walk_authorization import WalkAuthorization
from sextant.services.actuator.servo_bus.bus_driver import ServoReading
from sextant.services.actuator.servo_bus.joints import Joints
from sextant.services.actuator.servo_bus.servo_interface import Opener, Openers
from sextant.services.actuator.state_report import StateReport
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import reaches
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.lateness import BEAT
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.servo.servo_model import Feedback
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Message, Mode, ModeCommand, StopOrder, Tick

_LYING = (Mode.OFF, Mode.READY, Mode.SIT)  # modes in which the body may rest on the ground, so that feet move over it
_MAX_LOSS = 0.05  # [1] of the answers of the bus; beyond it, corrupted goals may move legs, which is no lie of theirs
_BALANCED = (Mode.HOLD, Mode.WALK)  # modes in which the legs follow an inertial sensor
_ON_FEET = (*_BALANCED, Mode.FAULT)  # modes in which goal, position and load of servos are compared


class Actuator:
    """Control loop that owns the servos.

    Each cycle reads the servos, estimates the body pose, passes plans through the guard, advances the step and writes goals.
    Its rate falls while the computer is too slow, and the robot then walks slower.
    """

    name = "actuator"
    subscribes: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.MODE, topics.STOP, topics.IMU)
    publishes: tuple[AnyTopic, ...] = (topics.ODOMETRY, topics.ACTUATOR_STATE, topics.HORN_ERRORS)

    def __init__(
        self,
        profile: RobotProfile,
        settings: Settings,
        opener: Opener | Openers | None,
        clock: Callable[[], int],
        latch: Latch | None = None,
        authorization: WalkAuthorization | None = None,
        suspended_ns: Callable[[], int] = lambda: 0,
    ):
        """Open the bus and take over the servos in their present torque state.

        Torque that is on stays on, and torque that is off stays off.

        Args:
            profile: The robot.
            settings: Settings of this service.
            opener: Opens the port, or that of each bus by its name, instead of what the settings name; called again after
                it was lost.
            clock: [ns] clock for the timing of the port.
            latch: Torque-off latch. Default: the latch of the port, unless `opener` is given.
            authorization: Walk authorization. Default: that of the port, unless `opener` is given.
            suspended_ns: [ns] that this machine has spent suspended since it booted; 0 on simulated time.

        Raises:
            BusSetupError: Servos are missing or wrong; the message names all of them.
            BusDisconnectedError: The port cannot be opened.
        """
        self._rate = ControlRate(settings.rate_hz)
        self.trigger = Every(self._rate.period_ns)
        self.max_age_s = {BEAT: GAP_S, topics.STEP_PLAN.key: settings.plan_age_s}
        self.stages = Stages()
        self._profile = profile
        self._clock = CycleClock(clock, suspended_ns, self.trigger.period_ns)
        self._off = TorqueOffState(latch or (None if opener else Latch.of_port(settings.port)))
        self._joints = Joints(profile, settings, opener, clock, lambda: self._off.holds)
        if self._off.holds:
            self._joints.torque_off()
        torque = bool(self._joints.torque.any())  # the health monitor then reports each servo without torque as a fault
        off_ns = self._off.since_ns(clock()) if self._off.holds else -1
        self._authorization = authorization or (WalkAuthorization() if opener else WalkAuthorization.of_port(settings.port))
        handover_s = settings.unload_s + settings.load_s
        knows_pose = not self._joints.assumption
        walk = self._authorization.order
        self._guard = Guard(profile, settings.plan_age_s, clock(), torque, handover_s, off_ns, walk, knows_pose)
        self._health = Health(profile, 1.0 / settings.rate_hz)
        self._verdict = Verdict()
        self._legs = LegMonitor(profile)
        self._has_touch = Feedback.POSITION in profile.servo_model.feedback  # else feet follow their plans
        self._horns = HornCorrection(settings.correct_horns)
        self._estimator = StateEstimator(profile, settings.contact, settings.touchdown)
        self._estimator.touchdown.bridged = settings.bridge
        self._motion = MotionController(profile, settings, self._joints.goals)
        self._report = StateReport(profile.foot.radius, self._has_touch)
        self._follow_rate()
        self._was_away = False  # whether the servo states were unknown in the last cycle
        self._take_over(torque, self._joints.read_loads())
        if self._motion.executor.gentle:
            self._guard.reason = "torque was on at the start; lowering the feet that are in the air"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the port. The servos keep torque and goals, so the robot stays standing."""
        self._joints.close()

    def status(self) -> str:
        """Return the mode and its reason as status text."""
        refusal = self._guard.plan_refusal(self._clock.now_ns())
        return f"{self._guard.mode}: {self._guard.reason}{f'; refused: {refusal}' if refusal else ''}"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Run one control cycle."""
        now_ns, guard, estimator, motion, joints = tick.stamp_ns, self._guard, self._estimator, self._motion, self._joints
        elapsed, dt = self._clock.begin(now_ns)
        estimator.touchdown.period_ns = max(self._rate.period_ns, round(dt * 1e9))
        began_ns = self._clock.now_ns()
        suspended_s = self._clock.suspended_s()
        # 1. Measure joints, contact and body pose.
        with self.stages("bus read"):
            self._read(dt)
        read_ns = self._clock.now_ns()
        estimator.update(self._measured(), joints.load, motion.standing(joints.unsure), motion.executor.ground, dt)
        # 2. Obey orders: torque off first.
        self._obey_latch(now_ns)
        if suspended_s:
            self._perform(guard.resume_from_suspend(suspended_s, now_ns))
        self._obey(inbox.drain(topics.MODE), inbox.drain(topics.STOP), now_ns)
        self._level(dt, now_ns, inbox)
        # 3. Pass plans through the guard.
        for plan in inbox.drain(topics.STEP_PLAN):
            if guard.accept_plan(plan, now_ns, self._walk(now_ns), self._stance):
                motion.executor.accept(plan)
                self._report.T_world_odom = plan.T_world_odom
        # 4. Move the legs.
        self._check_gaps(elapsed + suspended_s)
        if guard.mode is not Mode.OFF:
            self._move(dt, now_ns)
            self._report.note_contacts(motion.executor.take_findings(), read_ns)
            self._watch_legs(dt)
        # 5. React to faults, and report.
        self._check_health(now_ns, elapsed)
        self._authorization.keep(guard.walk_order(now_ns))
        if self._rate.note(elapsed, (self._clock.now_ns() - began_ns) * 1e-9):
            self._follow_rate()
        yield self._report.odometry(read_ns, estimator, motion, joints)
        if self._report.is_due(guard, motion):
            pace, warnings = float(self._verdict.pace * self._rate.share), self._warnings(now_ns)
            yield self._report.state(read_ns, guard, estimator, motion, joints, pace, warnings)
        if (horns := self._horns.news(read_ns, self._legs.offsets)) is not None:
            yield horns

    def _follow_rate(self) -> None:
        """Run by the present rate of the control cycle."""
        period_ns = self._rate.period_ns
        self.trigger = Every(period_ns)
        self._clock.period_ns = period_ns
        self._health.follow_rate(period_ns * 1e-9)

    # ---------------------------------------------------------------------------------------------------- measurements

    def _read(self, dt: float) -> None:
        """Read legs that may meet ground, then the next servos of the rotation."""
        awaiting, touchdown = self._motion.executor.awaiting, self._estimator.touchdown
        touchdown.forget(~awaiting)
        touchdown.begin_cycle(self._measured(), self._joints.goals)
        urgent = [3 * leg + FEMUR for leg, waits in enumerate(awaiting.tolist()) if waits]
        joints, check = self._joints, self._legs.goals
        check.note_goals(joints.goals.ravel().tolist())
        readings = joints.read(urgent)
        if joints.assumption:
            joints.assume(self._motion.goals.wanted, dt)
            self._motion.goals.mark_all_read()
        lies_down = self._guard.mode not in _ON_FEET  # joints may be at their stops
        odd = (joints.unsure.ravel() | (joints.strength < 1.0) | lies_down).tolist()
        for reading in readings:
            leg, joint = divmod(reading.index, 3)
            if odd[reading.index]:
                check.skip(reading.index)
            else:
                check.add_reading(reading.index, float(joints.q[leg, joint]), float(joints.load[leg, joint]))
            self._motion.goals.mark_read(leg, joint)
            if joint == FEMUR:
                touchdown.add_reading(leg, self._femur_reading(leg, reading))

    def _femur_reading(self, leg: int, reading: ServoReading) -> FemurReading:
        """Return a reading of a leg's femur servo in joint direction."""
        sign = self._profile.servo_signs[leg, FEMUR]
        angle, load = float(self._joints.q[leg, FEMUR]), float(self._joints.load[leg, FEMUR])
        return FemurReading(angle, float(sign) * reading.speed, load, reading.stamp_ns, reading.told_ns)

    def _measured(self) -> Array:
        """Estimate the present joint angles (6, 3) [rad]."""
        return self._motion.goals.measured(self._joints.q, self._joints.legs_without_torque)

    def _level(self, dt: float, now_ns: int, inbox: Inbox) -> None:
        """Align {odom} with gravity by the inertial sensor; stop when the body tips over.

        After tipping, the robot stays stopped until a new order.
        """
        mode, gravity, walk = self._guard.mode, self._estimator.gravity, self._motion.executor
        for reading in inbox.drain(topics.IMU):
            gravity.take(reading, now_ns, mode is Mode.READY or (mode is Mode.HOLD and walk.resting))
        if mode in _BALANCED and not self._guard.tipped:
            leans = gravity.tipped(walk.body_ref, now_ns)
            if leans:
                self._perform(self._guard.tip(leans))
        if mode not in _BALANCED or self._guard.tipped:
            gravity.restart()
            return
        turn = self._estimator.turn(dt, now_ns, walk.step if mode is Mode.WALK else None)
        if turn is not None:
            walk.turn(turn)

    # ---------------------------------------------------------------------------------------------------------- orders

    def _obey_latch(self, now_ns: int) -> None:
        """Turn torque off if latched, and latch it when torque must be off.

        Another process may have closed the latch.
        """
        if self._guard.mode is not Mode.OFF:
            self._off.drop_old(self._clock.now_ns())
            if self._off.holds:
                stop = StopOrder(now_ns, "off", now_ns, "stop path")
                self._perform(self._guard.handle_stop(stop, self._off.since_ns(now_ns)))
        if self._off.unkept:
            self._off.keep(self._guard.off_ns)

    def _obey(self, orders: Sequence[ModeCommand], stops: Sequence[StopOrder], now_ns: int) -> None:
        """Execute the orders received since the last cycle."""
        for order in in_turn(orders, stops):
            if isinstance(order, StopOrder):
                self._perform(self._guard.handle_stop(order, now_ns))
            else:
                self._perform(self._guard.handle_order(order, now_ns))

    def _perform(self, acts: tuple[Act, ...]) -> None:
        """Execute the acts that the guard has decided."""
        for act in acts:
            match act:
                case Act.TORQUE_OFF:
                    self._joints.torque_off()
                    self._off.keep(self._guard.off_ns)
                    self._motion.torque_off()
                case Act.TORQUE_ON:
                    if self._off.take_back(self._guard.given_ns, self._clock.now_ns()):
                        self._joints.torque_on()
                    self._motion.hold(self._joints.goals)
                case Act.RISE:
                    feet, carrying = self._estimator.odometry.feet, self._estimator.contact.legs
                    self._motion.stand_up(self._joints.goals, ground_relief(feet, carrying, self._motion.set_down))
                case Act.LIE_DOWN:
                    self._motion.lie_down()
                case Act.SET_DOWN:
                    self._motion.executor.set_down(lambda feet: bool(reaches(self._profile, feet).all()))
                case Act.FREEZE:
                    self._motion.freeze()

    # ---------------------------------------------------------------------------------------------------------- motion

    def _take_over(self, torque: bool, load: Array) -> None:
        """Start at the present pose, and lower feet that were left in the air.

        Args:
            torque: Whether torque is on.
            load: (6, 3) [N m] motor torques.
        """
        q = self._joints.q
        self._motion.take_over(slowly=torque)
        hanging = self._estimator.lifted(q, load)
        lifted = hanging if torque else np.zeros(6)
        feet = self._estimator.restart(q, standing=lifted == 0.0)
        self._restart_walk(feet)
        if lifted.any():
            self._motion.lower(lifted)

    def _restart_walk(self, feet: Array) -> None:
        """Restart the walk in a new {odom}, at commanded feet (6, 3) [m] {body}."""
        odometry = self._estimator.odometry
        self._motion.restart(feet, odometry.T_odom_body, odometry.anchors[:, 2])
        self._guard.set_epoch(self._clock.now_ns())

    def _move(self, dt: float, now_ns: int) -> None:
        """Advance the present motion and send its goals."""
        joints, motion, estimator = self._joints, self._motion, self._estimator
        if motion.is_holding or joints.not_responding:  # do not advance legs that do not follow
            self._send(joints.goals)
            return
        contact = None
        if not motion.changes_posture:
            motion.recover_legs(joints.torque_disabled, joints.unsure, estimator.feet_odom, joints.goals)
            awaiting, known, bus_ns = motion.executor.awaiting, ~motion.unsure_legs(joints.unsure), self._clock.now_ns()
            if self._has_touch:
                contact = estimator.foot_contact(awaiting, joints.legs_without_torque, known, joints.goals, now_ns, bus_ns)
        goals, targets = motion.update(dt, estimator.odometry.T_odom_body, contact, joints.goals, joints.legs_without_torque)
        self._send(goals)
        if not motion.posture_is_reached:
            return
        if motion.end_posture():
            estimator.restart(self._measured())
            self._restart_walk(targets.feet)
            motion.executor.seek_ground(~estimator.contact.legs)  # on uneven ground, or with legs that differ, some feet hang
            self._guard.risen()
        else:
            self._perform(self._guard.seated(now_ns))

    def _watch_legs(self, dt: float) -> None:
        """Compare the legs with their goals and with each other, and correct their horns."""
        legs, walk = self._legs, self._motion.executor
        if not self._has_touch:
            return
        legs.check_goals()
        if self._guard.mode is not Mode.WALK or not walk.planned or self._joints.not_responding:
            legs.pause()
            return
        lands = bool(walk.load_share[walk.swing].any())
        legs.watch(walk.step, walk.swing.tolist(), walk.flying.tolist(), lands, self._measured() - self._horns.offsets)
        if self._horns.follow(legs.sure_offsets, walk.flying & ~walk.awaiting, dt):
            self._joints.correct(self._horns.offsets)

    def _send(self, goals: Array) -> None:
        """Send goals, unless torque must be off or the goals are too old."""
        if not self._off.holds and self._clock.is_current:
            self._joints.write(goals)

    def _walk(self, now_ns: int) -> Walk:
        """Return the state of the walk."""
        walk, begins = self._motion.executor, self._guard.mode is Mode.HOLD
        return Walk(
            step=walk.step,
            resting=walk.resting,
            planned=walk.planned,
            trouble=walk.trouble,
            waiting_reason=self._motion.waiting_reason or (self._estimator.gravity.waiting_reason(now_ns) if begins else ""),
            swing=walk.swing,
            clearance=walk.clearance,
        )

    def _stance(self, now: bool) -> Stance:
        """Return the legs now, or at the end of the running step."""
        walk = self._motion.executor
        body, feet = (walk.body_ref, walk.feet_odom) if now else walk.stance_at_end
        return Stance(body, feet, walk.air_s)

    # ---------------------------------------------------------------------------------------------------------- faults

    def _check_gaps(self, elapsed: float) -> None:
        """Restart gently after an interruption of the bus or of this process."""
        was_away, self._was_away = self._was_away, self._joints.all_behind
        returned, motion = was_away and not self._was_away, self._motion
        if elapsed > GAP_S and self._guard.mode is not Mode.OFF:
            self._joints.mark_stale()
            self._was_away = True  # servos that are all read at once may have caught up by the next cycle
        elif returned and not motion.is_holding and not motion.changes_posture:
            self._take_over(self._guard.mode is not Mode.OFF, self._joints.load)

    def _check_health(self, now_ns: int, elapsed: float) -> None:
        """React to the state of the servos, the battery and the cycle timing."""
        torque = self._guard.mode is not Mode.OFF
        vitals, behind = self._joints.vitals, self._motion.behind
        if any(behind.tolist()):
            vitals = replace(vitals, behind=vitals.behind | behind)
        verdict, legs = self._health.update(now_ns * 1e-9, elapsed, vitals, torque), self._legs
        if vitals.loss > _MAX_LOSS:
            legs.pause()
        if not torque:
            legs.forget()
        elif legs.stop or legs.warning:
            pace, warnings = min(verdict.pace, legs.pace), (*verdict.warnings, legs.warning)
            verdict = replace(verdict, broken=verdict.broken or legs.stop, pace=pace, warnings=warnings)
        self._verdict = verdict
        self._perform(self._guard.watch(now_ns, self._walk(now_ns), self._verdict))
        for index in self._verdict.restore_torque:
            if self._off.holds:  # torque off has not been executed yet
                break
            self._joints.restore_torque(index)
            self._motion.resume_joint(index)

    def _warnings(self, now_ns: int) -> tuple[str, ...]:
        """Return the texts of all warnings; some are empty."""
        guard = self._guard
        return (
            self._joints.assumption,
            self._motion.goals.warning,
            "" if guard.mode in _LYING else self._estimator.slip_warning,
            guard.tipped,
            self._estimator.gravity.problem(now_ns),
            guard.objection,
            self._off.unkept,
            self._off.stuck,
            self._off.unseen,
            self._authorization.trouble,
            self._rate.warning,
            self._verdict.broken if guard.mode in (Mode.OFF, Mode.READY) else "",  # in other modes this is the reason
            *self._verdict.warnings,
            self._legs.deviation,
        )
