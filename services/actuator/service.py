"""The actuator: plans in, servo goals out, fifty times a second, and what the legs measure back to everybody."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.estimation.contact import ContactEstimate
from sextant.services.actuator.estimation.gravity_alignment import Plumb
from sextant.services.actuator.estimation.leg_odometry import LegOdometry
from sextant.services.actuator.estimation.touchdown_detector import FEMUR, Feeler, Felt, FemurReading
from sextant.services.actuator.locomotion.feedforward import lag_feed_forward, sag_feed_forward
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE, LOWERED, GoalLimits
from sextant.services.actuator.locomotion.leg_recovery import HungLegs
from sextant.services.actuator.locomotion.stand_sit import LieDown, StandUp
from sextant.services.actuator.locomotion.step_executor import Targets, Walker
from sextant.services.actuator.safety.command_ordering import in_turn
from sextant.services.actuator.safety.guard import Act, Guard, Legs
from sextant.services.actuator.safety.health_monitor import GAP_S, Health, Verdict
from sextant.services.actuator.safety.plan_validation import reaches
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.actuator.safety.torque_off_state import OffOrder
from sextant.services.actuator.safety.walk_authorization import Permit
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
_SLIPS = 0.01  # [m] against the others from which a standing foot is said to slip; rolling and looseness are some millimetres
_ALL = np.ones(6, dtype=np.bool_)
_BALANCED = (Mode.HOLD, Mode.WALK)  # modes in which legs follow an inertial sensor


class Actuator:
    """Owns the servos. Every cycle: read, see where the body is, take plans through the guard, move on, write."""

    name = "actuator"
    reads: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.MODE, topics.STOP, topics.IMU)
    writes: tuple[AnyTopic, ...] = (topics.ODOMETRY, topics.ACTUATOR_STATE)

    def __init__(
        self,
        profile: RobotProfile,
        settings: Settings,
        opener: Callable[[], Port] | None,
        clock: Callable[[], int],
        latch: Latch | None = None,
        permit: Permit | None = None,
        suspended_ns: Callable[[], int] = lambda: 0,
    ):
        """Open the bus and take the servos over as they stand: torque that is on stays on, torque that is off stays off.

        Args:
            profile: The robot.
            settings: Of this service.
            opener: Opens the port, in place of the one that the settings name; again, where it has gone.
            clock: [ns] what the port's timing goes by.
            latch: That torque is to be off, whoever has ordered it and when; that of the port, where none opens another.
            permit: The order to walk that is in force; likewise.
            suspended_ns: [ns] that this machine has spent suspended since it booted; 0 on simulated time.

        Raises:
            BusSetupError: Servos are missing or wrong, all named.
            BusGone: The port cannot be opened.
        """
        self.paced_by = Every.hz(settings.rate_hz)
        self.max_age_s = {BEAT: GAP_S, topics.STEP_PLAN.key: settings.plan_age_s}
        self.stages = Stages()
        self._profile = profile
        self._settings = settings
        self._clock, self._read_suspended_ns = clock, suspended_ns
        self._off = OffOrder(latch or (None if opener else Latch.of_port(settings.port)))
        self._joints = Joints(profile, settings, opener, clock, lambda: self._off.holds)
        if self._off.holds:
            self._joints.let_go()
        torque = bool(self._joints.torque.any())  # one that does not pull then is a fault, and named
        off_ns = self._off.since_ns(clock()) if self._off.holds else -1
        self._permit = permit or (Permit() if opener else Permit.of_port(settings.port))
        handover_s = settings.unload_s + settings.load_s
        self._guard = Guard(profile, settings.plan_age_s, clock(), torque, handover_s, off_ns, self._permit.order)
        self._health = Health(profile, 1.0 / settings.rate_hz)
        self._verdict = Verdict()
        self._limits = GoalLimits(profile)
        self._contact = ContactEstimate(profile)
        self._feeler = Feeler(profile)
        self._plumb = Plumb()
        self._imu_problem = ""
        self._q_wanted = self._joints.goals.copy()  # goals less the feed-forward: where the joints are to come to rest
        self._q_wanted_when_read = self._q_wanted.copy()
        self._q_last: Array | None = None  # where the joints were to be in the last cycle of one motion, to tell their speeds
        self._touch_ns = np.full(6, -1, dtype=np.int64)  # what feet have found, see ActuatorState
        self._touch = np.zeros((6, 3))
        self._touch_carries = np.zeros(6, dtype=np.bool_)
        self._last_ns = -1
        self._suspended_ns = suspended_ns()
        self._warning = ""
        self._told: tuple[Mode, str, str, int] | None = None  # what the last state message said
        self._silent = False  # whether the last cycle sent none
        self._posing: StandUp | LieDown | None = None  # what moves the legs in place of the walk
        self._still = False  # whether the legs stay as they are told
        self._away = False  # whether in the last cycle nobody knew how the servos fare
        self._eased, self._top = _ALL, GENTLE  # legs that go gently all through a gentle step, and how fast [rad/s]
        self._hung = HungLegs()
        self._T_world_odom: Array = np.eye(4)
        self._take_over(torque, self._joints.read_loads())
        if self._walker.gentle:
            self._guard.reason = "torque was on at the start; lowering the feet that are in the air"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the port: the servos keep their torque and their goals, so the robot stays standing."""
        self._joints.close()

    def doing(self) -> str:
        """Mode and why, for the operator."""
        refused = f"; refused: {self._guard.refused}" if self._guard.refused else ""
        return f"{self._guard.mode}: {self._guard.reason}{refused}"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """One control cycle."""
        elapsed, dt = self._cycle_time(tick.stamp_ns)
        slept_s = self._slept_s()
        with self.stages("bus read"):
            self._read()
        now_ns = self._clock()
        self._contact.update(self._measured(), self._joints.load, dt)
        self._odometry.update(self._measured(), self._standing(), self._walker.ground)
        self._obey_the_latch(tick.stamp_ns)
        if slept_s:
            self._perform(self._guard.woke(slept_s, tick.stamp_ns))
        self._obey(inbox.drain(topics.MODE), inbox.drain(topics.STOP), tick.stamp_ns)
        self._level(dt, tick.stamp_ns, inbox)
        for plan in inbox.drain(topics.STEP_PLAN):
            if self._guard.consider(plan, tick.stamp_ns, self._legs()):
                self._walker.accept(plan)
                self._T_world_odom = plan.T_world_odom
        self._see_to_gaps(elapsed + slept_s)
        if self._guard.mode is not Mode.OFF:
            self._move(dt, self._odometry.T_odom_body, tick.stamp_ns)
            self._note_findings(now_ns)
        self._see_to_health(tick.stamp_ns, elapsed)
        self._permit.keep(self._guard.walk_order(tick.stamp_ns))
        yield self._odometry_message(now_ns)
        news = (self._guard.mode, self._guard.reason, self._guard.refused, self._walker.plan_ns)
        if news != self._told or self._silent:  # every other cycle, and at once when there is something to tell
            self._told, self._silent = news, False
            yield self._state_message(now_ns)
        else:
            self._silent = True

    # ---------------------------------------------------------------------------------------------------------- inputs

    def _obey_the_latch(self, now_ns: int) -> None:
        """Let go where that was ordered past this process; and see to it that the latch is closed where torque is to be off."""
        if self._guard.mode is not Mode.OFF:
            self._off.drop_old(self._clock())
            if self._off.holds:
                stop = StopOrder(now_ns, "off", now_ns, "stop path")
                self._perform(self._guard.hear_stop(stop, self._off.since_ns(now_ns)))
        if self._off.unkept:
            self._off.keep(self._guard.off_ns)

    def _obey(self, orders: Sequence[ModeCommand], stops: Sequence[StopOrder], now_ns: int) -> None:
        """Obey what was ordered since the last cycle."""
        for order in in_turn(orders, stops):
            if isinstance(order, StopOrder):
                self._perform(self._guard.hear_stop(order, now_ns))
            else:
                self._perform(self._guard.hear(order, now_ns))

    def _slept_s(self) -> float:
        """Time [s] that the computer was suspended since the last cycle; 0 for a time that does not matter."""
        before, self._suspended_ns = self._suspended_ns, self._read_suspended_ns()
        slept_s = (self._suspended_ns - before) * 1e-9
        return slept_s if slept_s > GAP_S else 0.0

    def _cycle_time(self, stamp_ns: int) -> tuple[float, float]:
        """Time [s] since the last cycle, and as much of it as the legs may move in."""
        period = self.paced_by.period_ns
        elapsed = period if self._last_ns < 0 else stamp_ns - self._last_ns
        self._last_ns = stamp_ns
        return elapsed * 1e-9, min(elapsed, 2 * period) * 1e-9

    def _read(self) -> None:
        """Read the legs that may meet ground, then the next servos of the rotation, and note what they say."""
        awaiting = self._walker.awaiting
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
        """Where there is an inertial sensor {odom} is as level as that says; a body that tips over stops until a new order."""
        mode = self._guard.mode
        for reading in inbox.drain(topics.IMU):
            self._plumb.take(reading, now_ns, mode is Mode.HOLD and self._walker.resting)
        if mode in _BALANCED and not self._guard.tipped:
            leans = self._plumb.tipped(self._walker.body_ref, now_ns)
            if leans:
                self._perform(self._guard.tip(leans))
        if mode in _BALANCED and not self._guard.tipped:
            self._turn(dt, now_ns)
        else:
            self._plumb.restart()
        self._imu_problem = self._plumb.problem(now_ns)

    def _turn(self, dt: float, now_ns: int) -> None:
        step = self._walker.step if self._guard.mode is Mode.WALK else None
        turn = self._plumb.turn(self._odometry.T_odom_body, now_ns, dt, step)
        if turn is not None:
            self._odometry.turn(turn)
            self._walker.turn(turn)

    def _measured(self) -> Array:
        """Joint angles now (6, 3) [rad]: the last readings, moved on by what was wanted since of joints that pull."""
        moved = np.where(self._limp_legs()[:, None], 0.0, self._q_wanted - self._q_wanted_when_read)
        return np.asarray(self._joints.q + moved)

    def _standing(self) -> NDArray[np.bool_]:
        """(6,) legs that stand; those that are limp, or not where they were sent, stand on nothing, unless too few are left."""
        walker = self._walker
        standing = (~walker.swing | (walker.load_share > _STANDS)) & ~walker.searching
        firm = standing & ~self._unsure()
        return np.asarray(firm if firm.sum() >= 3 else standing)

    def _limp_legs(self) -> NDArray[np.bool_]:
        """(6,) legs of which a servo does not pull."""
        return np.asarray(self._joints.limp.any(axis=1))

    def _unsure(self) -> NDArray[np.bool_]:
        """(6,) legs that nobody can say of where they stand: limp, or not yet where they were sent again."""
        return np.asarray(self._joints.unsure.any(axis=1) | self._hung.hung)

    def _see_to_health(self, now_ns: int, elapsed: float) -> None:
        """Do what the servos, the battery and the running out of time ask for."""
        torque = self._guard.mode is not Mode.OFF
        vitals = self._joints.vitals
        vitals = replace(vitals, behind=vitals.behind | self._behind())
        self._verdict = self._health.update(now_ns * 1e-9, elapsed, vitals, torque)
        self._perform(self._guard.watch(now_ns, self._legs(), self._verdict))
        for index in self._verdict.revive:
            if self._off.holds:  # it has not been let go yet
                break
            self._joints.revive(index)
            if not self._still:  # then it has nothing to take up
                self._limits.ease(*divmod(index, 3))

    def _behind(self) -> NDArray[np.bool_]:
        """(18,) joints that have not taken up their work yet, and those for which legs are put back, or wait for that."""
        return np.asarray(self._limits.behind | self._hung.waiting).ravel()

    def _see_to_gaps(self, elapsed: float) -> None:
        """Begin anew, gently, where nobody has led the legs for a while: the bus was away, or this process."""
        away, self._away = self._away, self._joints.out_of_touch
        if elapsed > GAP_S and self._guard.mode is not Mode.OFF:
            self._joints.lose_touch()
        elif away and not self._away and not self._still and self._posing is None:
            self._take_over(self._guard.mode is not Mode.OFF, self._joints.load)

    def _ease(self, legs: NDArray[np.bool_], top: float = GENTLE) -> None:
        """Let the joints of legs (6,) take up their work gently, no faster than so [rad/s]."""
        for leg, joint in np.ndindex(6, 3):
            if legs[leg]:
                self._limits.ease(leg, joint, top)

    def _put_back(self) -> None:
        """Let legs that hung step to where they belong, once they can: from where they lie they would scrape, or jam."""
        back = self._hung.update(self._joints.limp, self._joints.unsure, self._walker.flying)
        if back.any() and self._walker.resting:
            self._walker.put_back(back, apply(self._odometry.T_odom_body, self._odometry.feet))
            self._eased, self._top = back, self._hung.put_back()
            self._q_wanted[back] = self._q_wanted_when_read[back] = self._joints.goals[back]  # of them nothing else was wanted

    @property
    def _stay(self) -> NDArray[np.bool_]:
        """(6,) legs that are led nowhere: a femur that came down without its tibia would lift the body; and until put back."""
        return np.asarray(self._hung.dangling | (self._hung.hung & ~self._limp_legs()))

    def _legs(self) -> Legs:
        """How far the walk is, for the guard."""
        walker = self._walker
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
        """Why no plan may be walked yet, in words, or nothing."""
        if self._walker.searching.any() or self._walker.taking_back:
            return self._walker.trouble
        takes_up = self._walker.gentle or (self._walker.resting and self._limits.easing)
        return "the joints take up their work again, slowly" if takes_up else ""

    def _perform(self, acts: tuple[Act, ...]) -> None:
        """Do what the guard has decided."""
        for act in acts:
            match act:
                case Act.LET_GO:
                    self._joints.let_go()
                    self._off.keep(self._guard.off_ns)
                    self._limits.forget()
                    self._posing, self._hung = None, HungLegs()
                case Act.GRIP:
                    if self._off.take_back(self._guard.given_ns, self._clock()):
                        self._joints.grip()
                    self._limits.forget()
                    self._still, self._posing, self._hung = True, None, HungLegs()
                    self._q_wanted = self._joints.goals.copy()
                    self._q_wanted_when_read = self._q_wanted.copy()
                case Act.RISE:
                    self._still, self._q_last, self._hung = False, None, HungLegs()
                    self._posing = StandUp(
                        self._profile, body_forward(self._profile, self._joints.goals), self._settings.stand_s
                    )
                case Act.LIE_DOWN:
                    self._still, self._q_last, self._hung = False, None, HungLegs()
                    feet = body_forward(self._profile, self._q_wanted)
                    self._posing = LieDown(self._profile, feet, self._settings.stand_s)
                case Act.SET_DOWN:
                    self._walker.set_down(lambda feet: reaches(self._profile, feet))
                case Act.FREEZE:
                    self._limits.forget()
                    self._posing, self._still = None, True

    # ------------------------------------------------------------------------------------------------------------ moves

    def _move(self, dt: float, T_odom_body: Array, now_ns: int) -> None:
        if self._still or self._joints.deaf:  # legs that do not follow are not led on
            self._send(self._joints.goals)
            return
        if self._posing is not None:
            targets = self._posing.update(dt)
        else:
            self._put_back()
            if self._walker.gentle:
                self._ease(self._eased, self._top)
            # A leg whose servo is silent, or limp, is taken to stand where the plan says: it can be asked for nothing.
            stands = self._feeler.bears | self._feeler.silent(self._clock()) | self._limp_legs()
            feet, awaiting = self._odometry.feet, self._walker.awaiting
            heaves = self._plumb.heaves(T_odom_body, feet, awaiting, now_ns)
            feeler, firm, known = self._feeler, self._contact.firm, ~self._unsure()
            heard = feeler.heard(self._clock())
            goals = apply(T_odom_body, body_forward(self._profile, self._joints.goals))
            felt = Felt(feeler.touches, stands, apply(T_odom_body, feet), firm, heaves, feeler.leans, known, heard, goals)
            targets = self._walker.update(dt, T_odom_body, felt, self._limits.pace)
        self._reach_for(targets, dt)
        if self._posing is not None and self._posing.done:
            self._end_pose(targets)

    def _end_pose(self, targets: Targets) -> None:
        """The robot has risen, or lies."""
        risen = isinstance(self._posing, StandUp)
        self._posing = None
        if risen:
            self._stand_on(self._measured(), targets.feet)
            self._walker.doubt(~self._contact.legs)  # on uneven ground some feet hang
            self._guard.risen()
        else:
            self._still = True
            self._perform(self._guard.seated(self._last_ns))

    def _note_findings(self, now_ns: int) -> None:
        """Keep what feet have found for everybody."""
        for found in self._walker.drain_findings():
            self._touch_ns[found.leg], self._touch_carries[found.leg] = now_ns, found.carries
            self._touch[found.leg] = found.p_odom - [0.0, 0.0, self._profile.foot.radius]

    def _reach_for(self, targets: Targets, dt: float) -> None:
        """Send the goals that bring the feet where they shall be, under their load."""
        feet = nearest_reachable(self._profile, targets.feet)
        q = body_inverse(self._profile, feet)
        reached = np.isfinite(q)
        sag = sag_feed_forward(self._profile, np.where(reached, q, 0.0), feet, targets.share, targets.R_level_body)
        before = q if self._q_last is None else self._q_last
        rates = np.where(reached & np.isfinite(before), (q - before) / dt, 0.0)
        lag = np.where(self._limits.gentle, 0.0, lag_feed_forward(self._profile, rates, dt))  # it may not run ahead of them
        self._q_last = q
        stays = self._stay[:, None]
        wanted = np.where(stays, self._joints.goals, q + sag + lag)
        goal, self._warning = self._limits.safe(wanted, self._joints.goals, dt)
        rest = np.where(self._limits.gentle, goal - sag - lag, q)  # gentle joints are not asked for more than that yet
        self._q_wanted = np.where(reached & ~stays, rest, self._q_wanted)
        self._send(goal)

    def _send(self, goals: Array) -> None:
        """Send goals, unless torque is to be off or they are too old: this process may have been stopped in mid-cycle."""
        if not self._off.holds and self._clock() - self._last_ns < GAP_S * 1e9:
            self._joints.write(goals)

    def _take_over(self, torque: bool, load: Array) -> None:
        """Begin where the robot stands; feet in the air, since somebody ended in mid-step, come down gently.

        Args:
            torque: Whether torque is on.
            load: (6, 3) [N m] of the motors.
        """
        q, self._q_last = self._joints.q, None  # what was wanted before is no way that the joints are on
        if torque:
            self._ease(_ALL)
        self._contact.update(q, load, math.inf)
        lifted = self._contact.lifted(body_forward(self._profile, q)) if torque else np.zeros(6)
        self._stand_on(q, standing=lifted == 0.0)
        if lifted.any():
            self._eased, self._top = _ALL, LOWERED  # whatever feet meet
            self._walker.lower(lifted)

    def _stand_on(self, q: Array, feet: Array | None = None, standing: NDArray[np.bool_] | None = None) -> None:
        """Begin odometry and walk anew: the ground is level at z = 0 under the standing feet, the body over their middle."""
        measured = body_forward(self._profile, q)
        standing = np.ones(6, dtype=np.bool_) if standing is None else standing
        height = self._profile.foot.radius - float(measured[standing, 2].mean())
        T_odom_body = from_xyz_rpy((0.0, 0.0, height), np.zeros(3))
        self._odometry = LegOdometry(self._profile, q, T_odom_body)
        ground = self._odometry.anchors[:, 2]
        self._walker = Walker(self._settings, measured if feet is None else feet, T_odom_body, ground)
        self._hung = HungLegs()
        self._guard.begin_anew(self._clock())

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
        """Which feet have slipped, in words, or nothing: those that stand have moved against each other."""
        feet = [LEGS[leg] for leg in np.flatnonzero(self._odometry.slip > _SLIPS)]
        return f"slipping: {', '.join(feet)}" if feet else ""

    def _warnings(self) -> tuple[str, ...]:
        """What is not as it should be, in words."""
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
            self._permit.trouble,
            self._verdict.broken if guard.mode in (Mode.OFF, Mode.READY) else "",  # else the reason
            *self._verdict.warnings,
        )

    def _state_message(self, stamp_ns: int) -> ActuatorState:
        walker = self._walker
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
    """A number, or zero while there is none."""
    return 0.0 if np.isnan(value) else float(value)
