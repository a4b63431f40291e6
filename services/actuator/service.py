"""The actuator: plans in, servo goals out, fifty times a second, and what the legs measure back to everybody."""

import math
import time
from collections.abc import Callable, Iterator
from typing import Self

import numpy as np
from numpy.typing import NDArray

from services.actuator.bus import BusSetupError, Port, ServoReading
from services.actuator.config import Settings
from services.actuator.contact import ContactEstimate
from services.actuator.feeler import FEMUR, Feeler, Felt
from services.actuator.guard import Guard
from services.actuator.load import lag_feed_forward, sag_feed_forward
from services.actuator.odometry import LegOdometry
from services.actuator.plumb import Plumb
from services.actuator.servos import connect
from services.actuator.stand_up import StandUp
from services.actuator.walker import Targets, Walker
from shared import dynamixel as dxl
from shared import topics
from shared.geometry import Array, apply, from_xyz_rpy
from shared.kinematics import body_forward, body_inverse, nearest_reachable
from shared.messages import ActuatorState, Message, Mode, ModeCommand, Odometry, StepPlan, Tick
from shared.robot import JOINTS, LEGS, RobotProfile
from shared.service import AnyTopic, Every, Inbox, Stages

_SETUP_PATIENCE_NS = 3_000_000_000  # [ns] that servos may take to answer: a simulation that begins is late, a hub wakes up
_STANDS = 0.5  # share of its load from which a leg counts as standing
_SLIPS = 0.01  # [m] against the others from which a standing foot is said to slip; rolling and looseness are some millimetres
_LIFTED = 0.01  # [m] over the standing feet from which a foot without load is in the air
_BALANCED = (Mode.HOLD, Mode.WALK)  # modes in which legs follow an inertial sensor
_ADOPT_WITHIN = np.radians(10.0)  # goals that stand in the servos are kept when the joints are this near to them


class Actuator:
    """Owns the servos. Every cycle: read, see where the body is, take plans through the guard, move on, write."""

    name = "actuator"
    reads: tuple[AnyTopic, ...] = (topics.STEP_PLAN, topics.MODE, topics.IMU)
    writes: tuple[AnyTopic, ...] = (topics.ODOMETRY, topics.ACTUATOR_STATE)

    def __init__(
        self,
        profile: RobotProfile,
        settings: Settings,
        port: Port | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ):
        """Open the bus and take the servos over as they stand: torque that is on stays on, torque that is off stays off.

        Args:
            profile: The robot.
            settings: Of this service.
            port: An open port in place of the one that the settings name.
            clock: [ns] what the port's timing goes by.

        Raises:
            BusSetupError: Servos are missing or wrong, all named.
            BusGone: The port cannot be opened.
        """
        self.paced_by = Every.hz(settings.rate_hz)
        self.stages = Stages()
        self._profile = profile
        self._settings = settings
        self._clock = clock
        self._bus = connect(profile, settings, port, clock)
        self._set_up()
        self._guard = Guard(profile, settings.plan_age_s)
        self._contact = ContactEstimate(profile)
        self._feeler = Feeler(profile)
        self._plumb = Plumb()
        self._imu_problem = ""
        self._trouble = ""  # between here and the servos, in words
        self._tipped = ""  # that the body leaned too far to go on, in words; until it is ordered to walk or stand
        self._q = self._read_all(dxl.PRESENT_POSITION)
        self._q_goal = self._first_goals()
        self._q_wanted = self._q_goal.copy()  # goals less the feed-forward: where the joints are to come to rest
        self._q_wanted_when_read = self._q_wanted.copy()
        self._q_last: Array | None = None  # where the joints were to be in the last cycle of one motion, to tell their speeds
        self._load = np.zeros((6, 3))
        self._voltage = np.full(18, np.nan)
        self._temperature = np.full(18, np.nan)
        self._touch_ns = np.full(6, -1, dtype=np.int64)  # what feet have found, see ActuatorState
        self._touch = np.zeros((6, 3))
        self._touch_carries = np.zeros(6, dtype=np.bool_)
        self._last_ns = -1
        self._refused, self._refused_ns = "", -1
        self._warning = ""
        self._last_order = -1
        self._told: tuple[Mode, str, str, int] | None = None  # what the last state message said
        self._silent = False  # whether the last cycle sent none
        torque = all(self._ask(i, dxl.TORQUE_ENABLE) for i in self._bus.servo_ids)
        self._mode = Mode.HOLD if torque else Mode.OFF
        self._reason = "torque was on at the start" if torque else "torque is off; order `stand` to begin"
        self._may_walk = False
        self._stand_up: StandUp | None = None
        self._T_world_odom: Array = np.eye(4)
        self._take_over(torque)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the port: the servos keep their torque and their goals, so the robot stays standing."""
        self._bus.close()

    def doing(self) -> str:
        """Mode and why, for the operator."""
        refused = f"; refused: {self._refused}" if self._refused else ""
        return f"{self._mode}: {self._reason}{refused}"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """One control cycle."""
        dt = self._cycle_time(tick.stamp_ns)
        with self.stages("bus read"):
            self._read()
        self._trouble = self._bus.trouble
        if self._trouble:
            self._walker.halt()
        now_ns = self._clock()
        self._contact.update(self._measured(), self._load, dt)
        self._odometry.update(self._measured(), self._standing(), self._walker.ground)
        for order in inbox.drain(topics.MODE):
            self._obey(order)
        self._level(dt, tick.stamp_ns, inbox)
        for plan in inbox.drain(topics.STEP_PLAN):
            self._consider(plan, tick.stamp_ns)
        if self._mode is not Mode.OFF:
            self._move(dt, self._odometry.T_odom_body, tick.stamp_ns)
            self._note_findings(now_ns)
        yield self._odometry_message(now_ns)
        news = (self._mode, self._reason, self._refused, self._walker.plan_ns)
        if news != self._told or self._silent:  # every other cycle, and at once when there is something to tell
            self._told, self._silent = news, False
            yield self._state_message(now_ns)
        else:
            self._silent = True

    # ---------------------------------------------------------------------------------------------------------- inputs

    def _cycle_time(self, stamp_ns: int) -> float:
        period = self.paced_by.period_ns
        elapsed = period if self._last_ns < 0 else min(stamp_ns - self._last_ns, 2 * period)
        self._last_ns = stamp_ns
        return elapsed * 1e-9

    def _read(self) -> None:
        """Read the legs that may meet ground, then the next servos of the rotation, and note what they say."""
        awaiting = self._walker.awaiting
        self._feeler.forget(~awaiting)
        self._feeler.see(self._measured(), self._q_goal)
        urgent = [3 * leg + FEMUR for leg in np.flatnonzero(awaiting).tolist()]
        for reading in self._bus.poll(round(self._settings.read_budget_ms * 1e6), urgent):
            leg, joint = divmod(reading.index, 3)
            sign = self._profile.servo_signs[leg, joint]
            self._q[leg, joint] = sign * reading.position - self._profile.horn_offsets[leg, joint]
            self._q_wanted_when_read[leg, joint] = self._q_wanted[leg, joint]
            self._load[leg, joint] = sign * reading.load * self._profile.servo.stall_torque
            if joint == FEMUR:
                self._feeler.read(leg, sign * reading.speed, float(self._load[leg, joint]), reading.stamp_ns)
            self._voltage[reading.index] = reading.voltage
            self._temperature[reading.index] = reading.temperature
            self._notice(reading)

    def _notice(self, reading: ServoReading) -> None:
        if reading.error and self._mode is not Mode.OFF:
            leg, joint = divmod(reading.index, 3)
            words = f"the {JOINTS[joint]} servo of the {LEGS[leg]} leg (id {reading.servo_id}) reports {reading.error.name}"
            self._mode, self._reason = Mode.FAULT, words.lower().replace("_", " ")
            self._walker.halt()

    def _level(self, dt: float, now_ns: int, inbox: Inbox) -> None:
        """Where there is an inertial sensor {odom} is as level as that says; a body that tips over stops until a new order."""
        still = self._mode is Mode.HOLD and self._walker.resting
        for reading in inbox.drain(topics.IMU):
            self._plumb.take(reading, now_ns, still)
        if self._mode in _BALANCED and not self._tipped:
            self._tipped = self._plumb.tipped(self._walker.body_ref, now_ns)
        if self._mode in _BALANCED and not self._tipped:
            self._turn(dt, now_ns)
        else:
            self._plumb.restart()
        self._imu_problem = self._plumb.problem(now_ns)
        if self._tipped:
            self._may_walk = False
            self._walker.halt()

    def _turn(self, dt: float, now_ns: int) -> None:
        step = self._walker.step if self._mode is Mode.WALK else None
        turn = self._plumb.turn(self._odometry.T_odom_body, now_ns, dt, step)
        if turn is not None:
            self._odometry.turn(turn)
            self._walker.turn(turn)

    def _measured(self) -> Array:
        """Joint angles now (6, 3) [rad]: the last readings, moved on by what was wanted of the joints since."""
        return np.asarray(self._q + (self._q_wanted - self._q_wanted_when_read))

    def _standing(self) -> NDArray[np.bool_]:
        walker = self._walker
        return np.asarray((~walker.swing | (walker.load_share > _STANDS)) & ~walker.searching)

    def _set_up(self) -> None:
        """Set the bus up; servos that are silent at first get some time."""
        until = self._clock() + _SETUP_PATIENCE_NS
        while True:
            try:
                self._bus.setup()
            except BusSetupError:
                if self._clock() >= until:
                    raise
            else:
                return

    def _read_all(self, register: dxl.Register) -> Array:
        """Every servo's register of an angle as joint angles (6, 3) [rad]; asked until all have answered."""
        ticks = np.zeros(18)
        for index, servo_id in enumerate(self._bus.servo_ids):
            ticks[index] = self._ask(servo_id, register)
        return self._profile.joint_angles(np.vectorize(dxl.angle_from_ticks)(ticks).reshape(6, 3))

    def _read_loads(self) -> Array:
        """Every servo's motor torque (6, 3) [N m] in the direction of growing joint angles; zero where one does not answer."""
        loads = [self._bus.read(i, dxl.PRESENT_LOAD) or 0 for i in self._bus.servo_ids]
        torque = np.array([dxl.load_from_register(v) for v in loads]).reshape(6, 3) * self._profile.servo.stall_torque
        return np.asarray(self._profile.servo_signs * torque)

    def _ask(self, servo_id: int, register: dxl.Register) -> int:
        """Value of a register; asked until the servo has answered."""
        until = self._clock() + _SETUP_PATIENCE_NS
        while (value := self._bus.read(servo_id, register)) is None:
            if self._clock() >= until:
                raise ConnectionError(f"servo {servo_id} stopped answering while its {register.name} was read")
        return value

    def _first_goals(self) -> Array:
        """The goals that stand in the servos where the joints are near them, else the measured angles."""
        goals = self._read_all(dxl.GOAL_POSITION)
        return np.where(np.abs(goals - self._q) < _ADOPT_WITHIN, goals, self._q)

    def _obey(self, order: ModeCommand) -> None:
        if order.sequence <= self._last_order:
            return
        self._last_order = order.sequence
        if order.mode == "off":
            self._bus.set_torque(False)
            self._mode, self._reason, self._may_walk, self._tipped = Mode.OFF, "ordered off", False, ""
        elif order.mode == "stand" and self._mode is not Mode.FAULT:
            if self._mode is Mode.OFF:
                self._q_goal = self._measured()
                self._write(self._q_goal)
                self._bus.set_torque(True)
            self._stand_up = StandUp(self._profile, body_forward(self._profile, self._q_goal), self._settings.stand_s)
            self._q_last = None
            self._mode, self._reason, self._may_walk, self._tipped = Mode.STAND, "standing up", False, ""
        elif order.mode == "walk" and self._mode in (Mode.HOLD, Mode.STAND):
            self._may_walk, self._tipped = True, ""

    def _consider(self, plan: StepPlan, now_ns: int) -> None:
        """Pass a plan on to the walker, or keep the reason why not."""
        if not self._may_walk or self._mode not in (Mode.HOLD, Mode.WALK):
            tipped = self._tipped and f"{self._tipped}; order `walk` anew"
            why = tipped or f"the mode is {self._mode}, not ordered to walk"
            self._refused = f"plan of step {plan.step} refused: {why}"
            return
        walker = self._walker
        if self._trouble or walker.searching.any():
            self._refused = f"plan of step {plan.step} refused: {self._trouble or walker.trouble}"
            return
        revises = plan.step == walker.step
        body, feet = (walker.body_ref, walker.feet_odom) if revises else walker.stance_at_end
        self._refused = self._guard.untimely(plan, now_ns, walker.step, walker.resting, walker.swing)
        if self._refused:
            return
        self._refused = self._guard.unwalkable(plan, body, feet)
        if self._refused:
            self._refused_ns = plan.stamp_ns
        else:
            walker.accept(plan)
            self._T_world_odom = plan.T_world_odom
            self._mode, self._reason = Mode.WALK, "walking"

    # ------------------------------------------------------------------------------------------------------------ moves

    def _move(self, dt: float, T_odom_body: Array, now_ns: int) -> None:
        if self._trouble:  # legs that do not follow are not led on; the step goes on when they do
            self._write(self._q_goal)
            return
        if self._stand_up is not None:
            targets = self._stand_up.update(dt)
        else:
            # A leg whose servo is silent is taken to stand where the plan says.
            stands = self._feeler.bears | self._feeler.silent(self._clock())
            feet, awaiting = self._odometry.feet, self._walker.awaiting
            heaves = self._plumb.heaves(T_odom_body, feet, awaiting, now_ns)
            feeler, firm = self._feeler, self._contact.firm
            felt = Felt(feeler.touches, stands, apply(T_odom_body, feet), firm, heaves, feeler.leans)
            targets = self._walker.update(dt, T_odom_body, felt)
        self._reach_for(targets, dt)
        if self._stand_up is not None and self._stand_up.done:
            self._stand_up = None
            self._stand_on(self._measured(), targets.feet)
            if self._mode is Mode.STAND:  # a fault that came meanwhile stays one
                self._mode, self._reason = Mode.HOLD, "standing"
        elif self._walker.resting and self._mode is Mode.WALK:
            ended = self._tipped or self._walker.trouble or "the last accepted step is finished and no new plan came"
            self._mode, self._reason = Mode.HOLD, ended

    def _note_findings(self, now_ns: int) -> None:
        """Keep what feet have found for everybody, and the reason while something is not as planned."""
        for found in self._walker.drain_findings():
            self._touch_ns[found.leg], self._touch_carries[found.leg] = now_ns, found.carries
            self._touch[found.leg] = found.p_odom - [0.0, 0.0, self._profile.foot.radius]
        if self._mode is Mode.WALK:
            self._reason = self._trouble or self._walker.trouble or "walking"

    def _reach_for(self, targets: Targets, dt: float) -> None:
        """Send the goals that bring the feet where they shall be, under their load."""
        feet = nearest_reachable(self._profile, targets.feet)
        q = body_inverse(self._profile, feet)
        reached = np.isfinite(q)
        sag = sag_feed_forward(self._profile, np.where(reached, q, 0.0), feet, targets.share, targets.R_level_body)
        before = q if self._q_last is None else self._q_last
        rates = np.where(reached & np.isfinite(before), (q - before) / dt, 0.0)
        lag = lag_feed_forward(self._profile, rates, dt)
        self._q_last = q
        goal, self._warning = self._guard.safe_goals(q + sag + lag, self._q_goal, dt)
        self._q_wanted = np.where(reached, q, self._q_wanted)
        self._write(goal)

    def _take_over(self, torque: bool) -> None:
        """Begin where the robot stands; feet that were in the air, since the last actuator ended in mid-step, come down."""
        carrying = self._contact.update(self._q, self._read_loads(), math.inf)
        standing = carrying if torque and carrying.sum() >= 3 else np.ones(6, dtype=np.bool_)
        self._stand_on(self._q, standing=standing)
        lifted = self._odometry.anchors[:, 2] - self._profile.foot.radius > _LIFTED
        if torque and (lifted & ~standing).any():
            self._walker.lower(lifted & ~standing, self._profile.foot.radius)
            self._reason = "torque was on at the start; lowering the feet that are in the air"

    def _stand_on(self, q: Array, feet: Array | None = None, standing: NDArray[np.bool_] | None = None) -> None:
        """Begin odometry and walk anew: the ground is level at z = 0 under the standing feet, the body over their middle."""
        measured = body_forward(self._profile, q)
        standing = np.ones(6, dtype=np.bool_) if standing is None else standing
        height = self._profile.foot.radius - float(measured[standing, 2].mean())
        T_odom_body = from_xyz_rpy((0.0, 0.0, height), np.zeros(3))
        self._odometry = LegOdometry(self._profile, q, T_odom_body)
        ground = self._odometry.anchors[:, 2]
        self._walker = Walker(self._settings, measured if feet is None else feet, T_odom_body, ground)

    def _write(self, q_goal: Array) -> None:
        servo = self._profile.servo_angles(q_goal).ravel()
        self._bus.sync_write_goals(_ticks(servo))
        self._q_goal = q_goal

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

    def _state_message(self, stamp_ns: int) -> ActuatorState:
        walker = self._walker
        return ActuatorState(
            stamp_ns=stamp_ns,
            mode=self._mode,
            reason=self._reason,
            refused=self._refused,
            refused_ns=self._refused_ns,
            plan_ns=walker.plan_ns,
            step=walker.step,
            phase=float(walker.phase),
            swing=walker.swing.copy(),
            contact=self._contact.legs,
            q=self._measured(),
            load_nm=self._load.copy(),
            feet=self._odometry.feet.copy(),
            T_odom_body=self._odometry.T_odom_body.copy(),
            body_ref=walker.body_ref,
            T_world_odom=self._T_world_odom.copy(),
            voltage=_known(np.fmin.reduce(self._voltage)),
            temperature=_known(np.fmax.reduce(self._temperature)),
            warnings=tuple(w for w in (self._warning, self._slipping(), self._tipped, self._imu_problem, self._trouble) if w),
            touch_ns=self._touch_ns.copy(),
            touch=self._touch.copy(),
            touch_carries=self._touch_carries.copy(),
            slip=float(self._odometry.slip.max()),
        )


def _known(value: float) -> float:
    """A number, or zero while there is none."""
    return 0.0 if np.isnan(value) else float(value)


def _ticks(servo: Array) -> NDArray[np.int64]:
    """Goal registers (18,) of servo angles (18,) [rad]."""
    ticks = np.rint(dxl.TICK_CENTRE + servo / dxl.TICK_RAD)
    return np.minimum(np.maximum(ticks, 0.0), dxl.TICK_MAX).astype(np.int64)
