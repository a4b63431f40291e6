"""Actuator service: step plans in, servo goals and leg measurements out, at 50 Hz."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.estimation.contact import ContactEstimate
from sextant.services.actuator.estimation.gravity_alignment import GravityAlignment
from sextant.services.actuator.estimation.leg_odometry import LegOdometry
from sextant.services.actuator.estimation.touchdown_detector import FEMUR, FemurReading, FootContact, TouchdownDetector
from sextant.services.actuator.locomotion.feedforward import lag_feed_forward, sag_feed_forward
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE, LOWERED, JointRateLimits
from sextant.services.actuator.locomotion.leg_recovery import LegRecovery
from sextant.services.actuator.locomotion.stand_sit import LieDown, StandUp
from sextant.services.actuator.locomotion.step_executor import StepExecutor, Targets
from sextant.services.actuator.safety.command_ordering import in_turn
from sextant.services.actuator.safety.guard import Act, Guard, Legs
from sextant.services.actuator.safety.health_monitor import GAP_S, Health, Verdict
from sextant.services.actuator.safety.plan_validation import reaches
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.actuator.safety.torque_off_state import TorqueOffState
from sextant.services.actuator.safety.walk_authorization import WalkAuthorization
from sextant.services.actuator.servo_bus.dynamixel_bus import Port
from sextant.services.actuator.servo_bus.joints import Joints
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.kinematics import body_forward, body_inverse, nearest_reachable
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.runtime.lateness import BEAT
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, Message, Mode, ModeCommand, Odometry, StopOrder, Tick

_STANDS = 0.5  # share of its load from which a leg counts as standing
_SLIPS = 0.01  # [m] motion against the other standing feet that counts as slip; rolling and play reach a few millimetres
_ALL = np.ones(6, dtype=np.bool_)
_BALANCED = (Mode.HOLD, Mode.WALK)  # modes in which the legs follow an inertial sensor


class Actuator:
    """Control loop that owns the servos.

    Each cycle reads the servos, estimates the body pose, passes plans through the guard, advances the step and writes goals.
    """

    name = "actuator"
    subscribes: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.MODE, topics.STOP, topics.IMU)
    publishes: tuple[AnyTopic, ...] = (topics.ODOMETRY, topics.ACTUATOR_STATE)

    def __init__(
        self,
        profile: RobotProfile,
        settings: Settings,
        opener: Callable[[], Port] | None,
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
            opener: Opens the port instead of the one that the settings name; called again after the port was lost.
            clock: [ns] clock for the timing of the port.
            latch: Torque-off latch. Default: the latch of the port, unless `opener` is given.
            permit: Walk authorization. Default: that of the port, unless `opener` is given.
            suspended_ns: [ns] that this machine has spent suspended since it booted; 0 on simulated time.

        Raises:
            BusSetupError: Servos are missing or wrong; the message names all of them.
            BusDisconnectedError: The port cannot be opened.
        """
        self.trigger = Every.hz(settings.rate_hz)
        self.max_age_s = {BEAT: GAP_S, topics.STEP_PLAN.key: settings.plan_age_s}
        self.stages = Stages()
        self._profile = profile
        self._settings = settings
        self._clock, self._read_suspended_ns = clock, suspended_ns
        self._off = TorqueOffState(latch or (None if opener else Latch.of_port(settings.port)))
        self._joints = Joints(profile, settings, opener, clock, lambda: self._off.holds)
        if self._off.holds:
            self._joints.torque_off()
        torque = bool(self._joints.torque.any())  # the health monitor then reports each servo without torque as a fault
        off_ns = self._off.since_ns(clock()) if self._off.holds else -1
        self._authorization = authorization or (WalkAuthorization() if opener else WalkAuthorization.of_port(settings.port))
        handover_s = settings.unload_s + settings.load_s
        self._guard = Guard(profile, settings.plan_age_s, clock(), torque, handover_s, off_ns, self._authorization.order)
        self._health = Health(profile, 1.0 / settings.rate_hz)
        self._verdict = Verdict()
        self._limits = JointRateLimits(profile)
        self._contact = ContactEstimate(profile)
        self._feeler = TouchdownDetector(profile)
        self._gravity = GravityAlignment()
        self._imu_problem = ""
        self._q_wanted = self._joints.goals.copy()  # goals without feed-forward: where the joints should come to rest
        self._q_wanted_when_read = self._q_wanted.copy()
        self._q_last: Array | None = None  # joint targets of the last cycle of the same motion, to compute joint speeds
        self._touch_ns = np.full(6, -1, dtype=np.int64)  # contacts that feet have found, see ActuatorState
        self._touch = np.zeros((6, 3))
        self._touch_carries = np.zeros(6, dtype=np.bool_)
        self._last_ns = -1
        self._suspended_ns = suspended_ns()
        self._warning = ""
        self._told: tuple[Mode, str, str, int] | None = None  # contents of the last state message
        self._silent = False  # whether the last cycle sent no state message
        self._posing: StandUp | LieDown | None = None  # motion that moves the legs instead of the walk
        self._still = False  # whether the legs hold their goals
        self._away = False  # whether the servo states were unknown in the last cycle
        self._eased, self._top = _ALL, GENTLE  # legs whose speed is limited during a whole gentle step, and the limit [rad/s]
        self._hung = LegRecovery()
        self._T_world_odom: Array = np.eye(4)
        self._take_over(torque, self._joints.read_loads())
        if self._executor.gentle:
            self._guard.reason = "torque was on at the start; lowering the feet that are in the air"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the port. The servos keep torque and goals, so the robot stays standing."""
        self._joints.close()

    def doing(self) -> str:
        """Return the mode and its reason as status text."""
        refused = f"; refused: {self._guard.refused}" if self._guard.refused else ""
        return f"{self._guard.mode}: {self._guard.reason}{refused}"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Run one control cycle."""
        elapsed, dt = self._cycle_time(tick.stamp_ns)
        slept_s = self._slept_s()
        with self.stages("bus read"):
            self._read()
        now_ns = self._clock()
        self._contact.update(self._measured(), self._joints.load, dt)
        self._odometry.update(self._measured(), self._standing(), self._executor.ground)
        self._obey_latch(tick.stamp_ns)
        if slept_s:
            self._perform(self._guard.resume_from_suspend(slept_s, tick.stamp_ns))
        self._obey(inbox.drain(topics.MODE), inbox.drain(topics.STOP), tick.stamp_ns)
        self._level(dt, tick.stamp_ns, inbox)
        for plan in inbox.drain(topics.STEP_PLAN):
            if self._guard.accept_plan(plan, tick.stamp_ns, self._legs()):
                self._executor.accept(plan)
                self._T_world_odom = plan.T_world_odom
        self._check_gaps(elapsed + slept_s)
        if self._guard.mode is not Mode.OFF:
            self._move(dt, self._odometry.T_odom_body, tick.stamp_ns)
            self._note_findings(now_ns)
        self._check_health(tick.stamp_ns, elapsed)
        self._authorization.keep(self._guard.walk_order(tick.stamp_ns))
        yield self._odometry_message(now_ns)
        news = (self._guard.mode, self._guard.reason, self._guard.refused, self._executor.plan_ns)
        if news != self._told or self._silent:  # every other cycle, and at once after a change
            self._told, self._silent = news, False
            yield self._state_message(now_ns)
        else:
            self._silent = True

    # ---------------------------------------------------------------------------------------------------------- inputs

    def _obey_latch(self, now_ns: int) -> None:
        """Turn torque off if latched, and latch it when torque must be off.

        Another process may have closed the latch.
        """
        if self._guard.mode is not Mode.OFF:
            self._off.drop_old(self._clock())
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

    def _slept_s(self) -> float:
        """Return the time [s] suspended since the last cycle; 0 for a short time."""
        before, self._suspended_ns = self._suspended_ns, self._read_suspended_ns()
        slept_s = (self._suspended_ns - before) * 1e-9
        return slept_s if slept_s > GAP_S else 0.0

    def _cycle_time(self, stamp_ns: int) -> tuple[float, float]:
        """Return the time [s] since the last cycle, and the share of it for leg motion."""
        period = self.trigger.period_ns
        elapsed = period if self._last_ns < 0 else stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        return elapsed * 1e-9, min(elapsed, 2 * period) * 1e-9

    def _read(self) -> None:
        """Read legs that may meet ground, then the next servos of the rotation."""
        awaiting = self._executor.awaiting
        self._feeler.forget(~awaiting)
        self._feeler.see(self._measured(), self._joints.goals)
        urgent = [3 * leg + FEMUR for leg in np.flatnonzero(awaiting).tolist()]
        for reading in self._joints.read(urgent):
            leg, joint = divmod(reading.index, 3)
            self._q_wanted_when_read[leg, joint] = self._q_wanted[leg, joint]
            if joint == FEMUR:
                sign = self._profile.servo_signs[leg, joint]
                angle, load = float(self._joints.q[leg, joint]), float(self._joints.load[leg, joint])
                femur = FemurReading(angle, sign * reading.speed, load, reading.stamp_ns, reading.told_ns)
                self._feeler.read(leg, femur)

    def _level(self, dt: float, now_ns: int, inbox: Inbox) -> None:
        """Align {odom} with gravity by the inertial sensor; stop when the body tips over.

        After tipping, the robot stays stopped until a new order.
        """
        mode = self._guard.mode
        for reading in inbox.drain(topics.IMU):
            self._gravity.take(reading, now_ns, mode is Mode.HOLD and self._executor.resting)
        if mode in _BALANCED and not self._guard.tipped:
            leans = self._gravity.tipped(self._executor.body_ref, now_ns)
            if leans:
                self._perform(self._guard.tip(leans))
        if mode in _BALANCED and not self._guard.tipped:
            self._turn(dt, now_ns)
        else:
            self._gravity.restart()
        self._imu_problem = self._gravity.problem(now_ns)

    def _turn(self, dt: float, now_ns: int) -> None:
        step = self._executor.step if self._guard.mode is Mode.WALK else None
        turn = self._gravity.turn(self._odometry.T_odom_body, now_ns, dt, step)
        if turn is not None:
            self._odometry.turn(turn)
            self._executor.turn(turn)

    def _measured(self) -> Array:
        """Estimate the present joint angles (6, 3) [rad].

        These are the last readings, plus the commanded motion since then of joints with torque.
        """
        moved = np.where(self._limp_legs()[:, None], 0.0, self._q_wanted - self._q_wanted_when_read)
        return np.asarray(self._joints.q + moved)

    def _standing(self) -> NDArray[np.bool_]:
        """(6,) legs that stand.

        Legs without torque, or not yet at their goals, do not count, unless fewer than three legs would remain.
        """
        walker = self._executor
        standing = (~walker.swing | (walker.load_share > _STANDS)) & ~walker.searching
        firm = standing & ~self._unsure()
        return np.asarray(firm if firm.sum() >= 3 else standing)

    def _limp_legs(self) -> NDArray[np.bool_]:
        """(6,) legs with at least one servo without torque."""
        return np.asarray(self._joints.torque_disabled.any(axis=1))

    def _unsure(self) -> NDArray[np.bool_]:
        """(6,) legs with unknown foot position.

        Torque is off, or they have not yet returned to their goals.
        """
        return np.asarray(self._joints.unsure.any(axis=1) | self._hung.hung)

    def _check_health(self, now_ns: int, elapsed: float) -> None:
        """React to the state of the servos, the battery and the cycle timing."""
        torque = self._guard.mode is not Mode.OFF
        vitals = self._joints.vitals
        vitals = replace(vitals, behind=vitals.behind | self._behind())
        self._verdict = self._health.update(now_ns * 1e-9, elapsed, vitals, torque)
        self._perform(self._guard.watch(now_ns, self._legs(), self._verdict))
        for index in self._verdict.restore_torque:
            if self._off.holds:  # torque off has not been executed yet
                break
            self._joints.restore_torque(index)
            if not self._still:  # otherwise there is no motion to resume
                self._limits.limit_joint(*divmod(index, 3))

    def _behind(self) -> NDArray[np.bool_]:
        """(18,) joints that have not resumed their motion yet.

        This includes joints whose legs are being recovered or wait for recovery.
        """
        return np.asarray(self._limits.behind | self._hung.waiting).ravel()

    def _check_gaps(self, elapsed: float) -> None:
        """Restart gently after an interruption of the bus or of this process."""
        away, self._away = self._away, self._joints.out_of_touch
        if elapsed > GAP_S and self._guard.mode is not Mode.OFF:
            self._joints.mark_stale()
        elif away and not self._away and not self._still and self._posing is None:
            self._take_over(self._guard.mode is not Mode.OFF, self._joints.load)

    def _ease(self, legs: NDArray[np.bool_], top: float = GENTLE) -> None:
        """Limit the joint speed of legs (6,) to `top` [rad/s] until they have caught up."""
        for leg, joint in np.ndindex(6, 3):
            if legs[leg]:
                self._limits.limit_joint(leg, joint, top)

    def _put_back(self) -> None:
        """Step legs that hung back to their footholds as soon as possible.

        Without a step they would scrape or jam, because they start from an arbitrary position.
        """
        back = self._hung.update(self._joints.torque_disabled, self._joints.unsure, self._executor.flying)
        if back.any() and self._executor.resting:
            self._executor.put_back(back, apply(self._odometry.T_odom_body, self._odometry.feet))
            self._eased, self._top = back, self._hung.put_back()
            self._q_wanted[back] = self._q_wanted_when_read[back] = self._joints.goals[back]  # these legs had no other target

    @property
    def _stay(self) -> NDArray[np.bool_]:
        """(6,) legs that hold their goals until they are recovered.

        A femur that moves down without its tibia would lift the body.
        """
        return np.asarray(self._hung.dangling | (self._hung.hung & ~self._limp_legs()))

    def _legs(self) -> Legs:
        """Return the state of the walk that the guard needs."""
        walker = self._executor
        body, feet = walker.stance_at_end
        return Legs(
            step=walker.step,
            resting=walker.resting,
            planned=walker.planned,
            swing=walker.swing,
            clearance=walker.clearance,
            body=body,
            feet=feet,
            body_now=walker.body_ref,
            feet_now=walker.feet_odom,
            air_s=walker.air_s,
            trouble=walker.trouble,
            waits=self._waits(),
        )

    def _waits(self) -> str:
        """Return why no plan may be walked yet, or an empty string."""
        if self._executor.searching.any() or self._executor.is_returning:
            return self._executor.trouble
        takes_up = self._executor.gentle or (self._executor.resting and self._limits.is_limiting)
        return "the joints are catching up with their goals, slowly" if takes_up else ""

    def _perform(self, acts: tuple[Act, ...]) -> None:
        """Execute the acts that the guard has decided."""
        for act in acts:
            match act:
                case Act.TORQUE_OFF:
                    self._joints.torque_off()
                    self._off.keep(self._guard.off_ns)
                    self._limits.forget()
                    self._posing, self._hung = None, LegRecovery()
                case Act.TORQUE_ON:
                    if self._off.take_back(self._guard.given_ns, self._clock()):
                        self._joints.torque_on()
                    self._limits.forget()
                    self._still, self._posing, self._hung = True, None, LegRecovery()
                    self._q_wanted = self._joints.goals.copy()
                    self._q_wanted_when_read = self._q_wanted.copy()
                case Act.RISE:
                    self._still, self._q_last, self._hung = False, None, LegRecovery()
                    self._posing = StandUp(
                        self._profile, body_forward(self._profile, self._joints.goals), self._settings.stand_s
                    )
                case Act.LIE_DOWN:
                    self._still, self._q_last, self._hung = False, None, LegRecovery()
                    feet = body_forward(self._profile, self._q_wanted)
                    self._posing = LieDown(self._profile, feet, self._settings.stand_s)
                case Act.SET_DOWN:
                    self._executor.set_down(lambda feet: reaches(self._profile, feet))
                case Act.FREEZE:
                    self._limits.forget()
                    self._posing, self._still = None, True

    # ------------------------------------------------------------------------------------------------------------ moves

    def _move(self, dt: float, T_odom_body: Array, now_ns: int) -> None:
        if self._still or self._joints.not_responding:  # do not advance legs that do not follow
            self._send(self._joints.goals)
            return
        if self._posing is not None:
            targets = self._posing.update(dt)
        else:
            self._put_back()
            if self._executor.gentle:
                self._ease(self._eased, self._top)
            # A leg whose servo is silent or without torque is assumed to stand as planned, because its contact is unknown.
            stands = self._feeler.bears | self._feeler.silent(self._clock()) | self._limp_legs()
            feet, awaiting = self._odometry.feet, self._executor.awaiting
            heaves = self._gravity.heaves(T_odom_body, feet, awaiting, now_ns)
            feeler, firm, known = self._feeler, self._contact.firm, ~self._unsure()
            heard = feeler.heard(self._clock())
            goals = apply(T_odom_body, body_forward(self._profile, self._joints.goals))
            felt = FootContact(
                feeler.touches, stands, apply(T_odom_body, feet), firm, heaves, feeler.leans, known, heard, goals
            )
            targets = self._executor.update(dt, T_odom_body, felt, self._limits.pace)
        self._reach_for(targets, dt)
        if self._posing is not None and self._posing.done:
            self._end_pose(targets)

    def _end_pose(self, targets: Targets) -> None:
        """Finish standing up or lying down."""
        risen = isinstance(self._posing, StandUp)
        self._posing = None
        if risen:
            self._stand_on(self._measured(), targets.feet)
            self._executor.doubt(~self._contact.legs)  # on uneven ground some feet hang
            self._guard.risen()
        else:
            self._still = True
            self._perform(self._guard.seated(self._last_ns))

    def _note_findings(self, now_ns: int) -> None:
        """Store the contacts that feet have found until the next state message."""
        for found in self._executor.take_findings():
            self._touch_ns[found.leg], self._touch_carries[found.leg] = now_ns, found.carries
            self._touch[found.leg] = found.p_odom - [0.0, 0.0, self._profile.foot.radius]

    def _reach_for(self, targets: Targets, dt: float) -> None:
        """Send the goals that bring the loaded feet to their targets."""
        feet = nearest_reachable(self._profile, targets.feet)
        q = body_inverse(self._profile, feet)
        reached = np.isfinite(q)
        sag = sag_feed_forward(self._profile, np.where(reached, q, 0.0), feet, targets.share, targets.R_level_body)
        before = q if self._q_last is None else self._q_last
        rates = np.where(reached & np.isfinite(before), (q - before) / dt, 0.0)
        lag = np.where(self._limits.gentle, 0.0, lag_feed_forward(self._profile, rates, dt))  # must not run ahead of them
        self._q_last = q
        stays = self._stay[:, None]
        wanted = np.where(stays, self._joints.goals, q + sag + lag)
        goal, self._warning = self._limits.safe(wanted, self._joints.goals, dt)
        rest = np.where(self._limits.gentle, goal - sag - lag, q)  # limited joints have not been commanded further yet
        self._q_wanted = np.where(reached & ~stays, rest, self._q_wanted)
        self._send(goal)

    def _send(self, goals: Array) -> None:
        """Send goals, unless torque must be off or the goals are too old.

        Goals are too old if this process was suspended within the cycle.
        """
        if not self._off.holds and self._clock() - self._last_ns < GAP_S * 1e9:
            self._joints.write(goals)

    def _take_over(self, torque: bool, load: Array) -> None:
        """Start at the present pose, and lower feet that were left in the air.

        Args:
            torque: Whether torque is on.
            load: (6, 3) [N m] motor torques.
        """
        q, self._q_last = self._joints.q, None  # earlier targets do not belong to the present motion
        if torque:
            self._ease(_ALL)
        self._contact.update(q, load, math.inf)
        lifted = self._contact.lifted(body_forward(self._profile, q)) if torque else np.zeros(6)
        self._stand_on(q, standing=lifted == 0.0)
        if lifted.any():
            self._eased, self._top = _ALL, LOWERED  # limits the force if a foot meets an obstacle
            self._executor.lower(lifted)

    def _stand_on(self, q: Array, feet: Array | None = None, standing: NDArray[np.bool_] | None = None) -> None:
        """Restart odometry and walk.

        The ground is level at z = 0 under the standing feet, and the body is over their middle.
        """
        measured = body_forward(self._profile, q)
        standing = np.ones(6, dtype=np.bool_) if standing is None else standing
        height = self._profile.foot.radius - float(measured[standing, 2].mean())
        T_odom_body = from_xyz_rpy((0.0, 0.0, height), np.zeros(3))
        self._odometry = LegOdometry(self._profile, q, T_odom_body)
        ground = self._odometry.anchors[:, 2]
        self._executor = StepExecutor(self._settings, measured if feet is None else feet, T_odom_body, ground)
        self._hung = LegRecovery()
        self._guard.set_epoch(self._clock())

    # ---------------------------------------------------------------------------------------------------------- outputs

    def _odometry_message(self, stamp_ns: int) -> Odometry:
        odometry = self._odometry
        return Odometry(
            stamp_ns=stamp_ns,
            T_odom_body=odometry.T_odom_body.copy(),
            travelled=odometry.travelled,
            turned=odometry.turned,
            stance=self._standing(),
            reliable=odometry.reliable,
        )

    def _slipping(self) -> str:
        """Return which feet slip, or an empty string.

        Slip is motion of standing feet against each other.
        """
        feet = [LEGS[leg] for leg in np.flatnonzero(self._odometry.slip > _SLIPS)]
        return f"slipping: {', '.join(feet)}" if feet else ""

    def _warnings(self) -> tuple[str, ...]:
        """Return the texts of all warnings; some are empty."""
        guard = self._guard
        return (
            self._warning,
            self._slipping(),
            guard.tipped,
            self._imu_problem,
            guard.objection,
            self._off.unkept,
            self._off.stuck,
            self._off.unseen,
            self._authorization.trouble,
            self._verdict.broken if guard.mode in (Mode.OFF, Mode.READY) else "",  # in other modes this is the reason
            *self._verdict.warnings,
        )

    def _state_message(self, stamp_ns: int) -> ActuatorState:
        walker = self._executor
        return ActuatorState(
            stamp_ns=stamp_ns,
            mode=self._guard.mode,
            reason=self._guard.reason,
            lease=self._guard.lease(stamp_ns),
            epoch=self._guard.epoch,
            pace=float(self._verdict.pace),
            refused=self._guard.refused,
            refused_ns=self._guard.refused_ns,
            plan_ns=walker.plan_ns,
            step=walker.step,
            phase=float(walker.phase),
            swing=walker.swing.copy(),
            contact=self._contact.legs,
            q=self._measured(),
            load_nm=self._joints.load.copy(),
            feet=self._odometry.feet.copy(),
            T_odom_body=self._odometry.T_odom_body.copy(),
            body_ref=walker.body_ref,
            T_world_odom=self._T_world_odom.copy(),
            voltage=_known(np.fmin.reduce(self._joints.voltage)),
            temperature=_known(np.fmax.reduce(self._joints.temperature)),
            warnings=tuple(w for w in self._warnings() if w),
            touch_ns=self._touch_ns.copy(),
            touch=self._touch.copy(),
            touch_carries=self._touch_carries.copy(),
            slip=float(self._odometry.slip.max()),
        )


def _known(value: float) -> float:
    """Return a number, or zero if it is NaN."""
    return 0.0 if np.isnan(value) else float(value)
