"""Joints behind the servo bus: measurements, goals and recovery of a lost bus."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.config import Settings
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE, LOWERED
from sextant.services.actuator.safety.health_monitor import SHUT_DOWN, SILENT, Vitals
from sextant.services.actuator.servo_bus import shutdown
from sextant.services.actuator.servo_bus.assumed_motion import WORDS, AssumedMotion
from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError, BusSetupError, ServoReading
from sextant.services.actuator.servo_bus.catching_up import CatchingUp
from sextant.services.actuator.servo_bus.joint_units import JointUnits
from sextant.services.actuator.servo_bus.servo_interface import Opener, Openers, Servos, connect, port_openers
from sextant.services.actuator.servo_bus.torque_loss_check import TorqueLossCheck
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.servo_model import Feedback, Recovery, ServoError

_STARTUP_TIMEOUT_NS = 3_000_000_000  # [ns] for the first answers: a simulation starts late, and a USB hub wakes up slowly
_ADOPT_WITHIN_RAD = np.radians(10.0)  # [rad] between a joint and the goal in its servo, up to which that goal is kept
_REOPEN_PERIOD_NS = 200_000_000  # [ns] between two attempts to reopen a lost bus
_WITHOUT_TORQUE = np.uint8(SHUT_DOWN | ServoError.HARDWARE)  # errors with which a servo may have turned its torque off
_MAX_REQUESTS = 3  # maximum number of requests for the state of one servo on a reopened bus
_NO_READING_S = 0.05  # [s] without a reading of any servo, from which goals may not arrive
_BUS_LOST_S = 0.1  # [s] without one, from which the state of the robot is unknown
_VOLTAGE_NS = 1_000_000_000  # [ns] for which a voltage holds that is not read with every position
_MIN_READING_TIME_NS = 200_000_000  # [ns] of reading, from which the loss rate is meaningful


class Joints:
    """18 joints, as (6, 3) arrays in the robot's joint coordinates."""

    def __init__(
        self,
        profile: RobotProfile,
        settings: Settings,
        opener: Opener | Openers | None,
        clock: Callable[[], int],
        latched: Callable[[], bool] = lambda: False,
    ):
        """Open the bus and read the joint positions; nothing moves.

        Args:
            profile: The robot.
            settings: Settings of the actuator.
            opener: Opens the port, or that of each bus by its name; None opens what the settings name. It raises OSError if
                there is no port.
            clock: [ns] monotonic clock for the timing of the port.
            latched: Returns whether torque must be off. It is polled before each request of the start.

        Raises:
            BusSetupError: Servos are missing or wrong; the message names all of them.
            BusDisconnectedError: The port cannot be opened.
            ConnectionError: A servo has stopped answering.
        """
        self._profile, self._settings, self._clock = profile, settings, clock
        self._models, self._units = profile.servos.models, JointUnits(profile)
        self._measures_load = Feedback.LOAD in profile.servo_model.feedback
        found = port_openers(profile, settings) if opener is None else opener
        self._openers: Openers = {"": found} if callable(found) else found
        self._stall_torque = profile.servos.stall_torque.ravel().tolist()  # [N m]
        self._reboots = np.array([model.recovery is Recovery.REBOOT for model in self._models])
        self.offsets = np.zeros((6, 3))  # [rad] by which links are ahead of their encoders, besides the profile's trims
        self._set_horns()
        self._budget_ns = round(settings.read_budget_ms * 1e6)
        self._latched = latched
        self._off_ordered = latched()  # whether an order requires torque off
        self._bus = self._open()
        self._set_up_bus()
        self._tried_ns = clock()
        self._since_ns = -1  # since when the bus has been read without a gap
        self.gone = ""  # why there is no bus, or an empty string
        has_position = Feedback.POSITION in profile.servo_model.feedback
        self._assumed = None if has_position else AssumedMotion(profile)
        self._torque_loss = TorqueLossCheck()
        self._tolerated = int(settings.bridge)  # unanswered requests: readings from a bridge may be a cycle old
        self._catching_up = CatchingUp()
        self.q = self.goals = np.zeros((6, 3))  # [rad] joint angles by the newest readings; goals as stored in the servos
        self.load = np.zeros((6, 3))  # [N m] of the motors, in the direction of growing joint angles
        self.torque = np.zeros(18, dtype=np.bool_)  # servos with torque on
        self._torque_flags = b""  # torque and errors of the servos for which the next were computed
        self._torque_disabled = np.zeros((6, 3), dtype=np.bool_), np.zeros(6, dtype=np.bool_)
        self.strength = np.ones(18)  # torque limit of each servo, as a share of its maximum
        self._max_torque = np.array([model.table.torque_limit.max for model in self._models])  # Max Torque registers
        self._adopt_state([self._wait_for_state(i) for i in self._bus.servo_ids])
        self._bus.between = _do_nothing
        self.voltage = np.full(18, np.nan)  # [V]
        self._voltage_ns = np.zeros(18, dtype=np.int64)  # stamps of these
        rare = np.array([model.commands is not None for model in self._models])  # servos whose voltage is seldom read
        # Servos that each one's voltage is stored for.
        self._of_supply = [rare if rare[index] else index for index in range(18)]
        self.temperature = np.full(18, np.nan)  # [deg C]

    def close(self) -> None:
        """Close the port; the servos keep their torque and goals."""
        self._bus.close()

    @property
    def assumption(self) -> str:
        """That the joint angles are assumed, or an empty string."""
        return WORDS if self._assumed else ""

    @property
    def trouble(self) -> str:
        """Why the joints do not follow, or an empty string."""
        return self.gone or self._bus.trouble

    @property
    def all_behind(self) -> bool:
        """Whether all servos missed goals, and have not yet answered and caught up."""
        return self._catching_up.all_behind

    @property
    def not_responding(self) -> bool:
        """Whether goals should not change, because servos may not receive them."""
        return bool(self.trouble) or self.all_behind or self._bus.newest_age_s > _NO_READING_S

    @property
    def vitals(self) -> Vitals:
        """Servo state that the health monitor evaluates."""
        return Vitals(
            missed=self._bus.missed,
            newest=self._bus.newest_age_s,
            load=self.load.ravel(),
            voltage=self.voltage,
            temperature=self.temperature,
            errors=self._bus.errors,
            torque_disabled=~self.torque,
            behind=self._catching_up.answering,
            strength=self.strength,
            loss=self._bus.loss if self._has_loss_rate else 0.0,
            trouble=self.trouble,
        )

    @property
    def _has_loss_rate(self) -> bool:
        """Whether the bus has been read long enough for a meaningful loss rate."""
        return not self.gone and self._since_ns >= 0 and self._clock() - self._since_ns >= _MIN_READING_TIME_NS

    @property
    def torque_disabled(self) -> NDArray[np.bool_]:
        """(6, 3) joints whose servo has no torque or has shut down."""
        return self._without_torque()[0]

    @property
    def legs_without_torque(self) -> NDArray[np.bool_]:
        """(6,) legs with at least one servo without torque."""
        return self._without_torque()[1]

    def _without_torque(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return joints (6, 3) and legs (6,) without torque; both are read several times in a cycle, and seldom change."""
        flags = self.torque.tobytes() + self._bus.errors.tobytes()
        if flags != self._torque_flags:
            joints = np.asarray(~self.torque | (self._bus.errors & _WITHOUT_TORQUE > 0)).reshape(6, 3)
            legs = np.asarray(joints.any(axis=1))
            joints.flags.writeable = legs.flags.writeable = False
            self._torque_flags, self._torque_disabled = flags, (joints, legs)
        return self._torque_disabled

    @property
    def unsure(self) -> NDArray[np.bool_]:
        """(6, 3) joints without torque, or not yet at their goal after their servos missed goals."""
        if not any(self._catching_up.behind.tolist()):
            return self.torque_disabled
        return np.asarray(self.torque_disabled | self._catching_up.behind.reshape(6, 3))

    # --------------------------------------------------------------------------------------------------- every cycle

    def read(self, urgent: Sequence[int]) -> list[ServoReading]:
        """Read the urgent servos (0 to 17), then the others in turn as time allows; reopen a lost bus."""
        if self.gone:
            self._reconnect()
            return []
        self._since_ns = self._since_ns if self._since_ns >= 0 else self._clock()
        if self._off_ordered:  # a broadcast is not acknowledged, so repeat it until torque is ordered on
            self._send_torque_off()
        try:
            readings = self._bus.poll(self._budget_ns, urgent)
            for reading in readings:
                self._store_reading(reading)
            self._check_torque_loss([reading.index for reading in readings] if self._assumed is None else self._reached)
            self._check_silence()
        except BusDisconnectedError as error:
            self._disconnect(error)
            return []
        return readings

    @property
    def _reached(self) -> range:
        """Servos (0 to 17) without feedback whose board answers."""
        return range(18 if self._bus.newest_age_s < _NO_READING_S else 0)

    def assume(self, wanted: Array, dt: float) -> None:
        """Move the joints on towards wanted angles (6, 3) [rad] for `dt` [s], if their servos do not report positions.

        While goals do not arrive, the joints stay where they are.
        """
        if self._assumed is None or self.gone or self.trouble:
            return
        before, limits, now_ns = self.q, self._catching_up.speed_limits.reshape(6, 3), self._clock()
        self.q = self._assumed.follow(self.q, wanted, self.torque.reshape(6, 3), limits, dt)
        if self._catching_up.all_behind or self._catching_up.behind.any():
            speeds, off = (self.q - before) / dt, self.q - self.goals
            for index in range(18):
                self._catching_up.note_reading(index, now_ns, float(off.flat[index]), float(speeds.flat[index]))

    def write(self, q_goal: Array) -> None:
        """Send goals (6, 3) [rad] to all servos; without a bus, only store them.

        Servos that have missed goals get a low speed, because their position is unknown when they respond again.
        """
        self.goals = self._clipped_to_limits(q_goal) if np.count_nonzero(self.offsets) else q_goal
        silent = self._bus.missed >= SILENT
        if np.count_nonzero(silent):
            self._catching_up.leave_behind(silent, LOWERED)
        ticks, speeds = self._goal_ticks(self.goals), self._units.speed_ticks(self._catching_up.speed_limits)
        self._call_bus(lambda: self._bus.sync_write_goals(ticks, speeds))

    def correct(self, offsets: Array) -> None:
        """Assume that links are ahead of their encoders by offsets (6, 3) [rad]. The servos keep their goals."""
        change, self.offsets = offsets - self.offsets, offsets.copy()
        self.q, self.goals = self.q + change, self.goals + change
        self._set_horns()

    def _set_horns(self) -> None:
        """Set what converts readings to joint angles."""
        signs, horns = self._profile.servo_signs.ravel().tolist(), (self._profile.horn_offsets - self.offsets).ravel().tolist()
        self._signs_and_horns = list(zip(signs, horns, strict=True))

    def mark_stale(self) -> None:
        """Treat all joint positions as unknown; recent goals may not have arrived."""
        self._torque_loss.doubt_all()
        self._catching_up.leave_all_behind()

    def torque_off(self) -> None:
        """Turn all torque off; without a bus, this is the first request once the bus is back."""
        self._off_ordered = True
        self.torque[:] = False
        self._send_torque_off()

    def torque_on(self) -> None:
        """Turn torque on and restore torque limits, at the present joint positions.

        Only an operator's order calls this. A joint beyond its limit returns to the limit slowly.
        """
        self._off_ordered = False
        if self._assumed is not None:  # torque may have been lost since it was last read, and the joints with it
            self._call_bus(self._read_torque)
            self.q = np.where(self.torque.reshape(6, 3), self.q, self._assumed.sit_pose)
        weak = (self.strength < 1.0) & (self._bus.errors & ServoError.OVERHEATING == 0)
        restored = (~self.torque | weak).reshape(6, 3)
        clipped = self._clipped_to_limits(self.q)
        self._catching_up.leave_behind((restored & (clipped != self.q)).ravel(), GENTLE)
        self.write(np.where(restored, clipped, self.goals))
        if self._latched():  # torque was ordered off after the order that this call executes
            self.torque_off()
            return
        for _ in range(2):  # a broadcast is not acknowledged
            self._call_bus(lambda: self._bus.set_torque(True))
        self.torque[:] = not self.gone
        self._torque_loss.doubt_all()
        # A servo that reboots and has cooled gets torque by the next order.
        cool = ~(self.temperature >= self._profile.servos.temperature_limit.ravel())
        down = (self._bus.errors & np.uint8(SHUT_DOWN) > 0) & cool & self._reboots
        for index in np.flatnonzero(weak | down).tolist():
            self._call_bus(partial(self._restore_torque_limit, index))

    def restore_torque(self, index: int) -> None:
        """End the shutdown of a servo (0 to 17) at its present position, once it acknowledges this position as its goal.

        A joint beyond its limit returns to the limit slowly.
        """
        if self._reboots[index]:  # only an operator's order reboots a servo
            return
        leg, joint = divmod(index, 3)
        goals = self.goals.copy()
        goals[leg, joint] = self._clipped_to_limits(self.q)[leg, joint]
        self._catching_up.leave_behind(np.arange(18) == index, GENTLE)
        self.write(goals)
        self._call_bus(lambda: self._restore_torque_limit(index))

    def read_loads(self) -> Array:
        """Read motor torques (6, 3) [N m] in joint direction; zero without an answer.

        Those of servos that measure no load are the ones estimated when their state was read.
        """
        if not self._measures_load:
            return self.load
        asked = zip(self._bus.servo_ids, self._models, strict=True)
        return self._torques([self._bus.read(i, model.table.present_load) or 0 for i, model in asked])

    # ------------------------------------------------------------------------------------------------- the bus itself

    def _open(self) -> Servos:
        bus = connect(self._profile, self._settings, self._openers, self._clock, lambda: self._off_ordered)
        bus.between = self._check_latch
        return bus

    def _check_latch(self) -> None:
        """Turn torque off between two requests of the start, if it has been ordered off."""
        if not self._off_ordered and self._latched():
            self._off_ordered = True
            self._bus.set_torque(False)

    def _set_up_bus(self) -> None:
        """Set the bus up, and wait some time for servos that are silent at first."""
        until = self._clock() + _STARTUP_TIMEOUT_NS
        while True:
            if self._off_ordered:
                self._bus.set_torque(False)
            try:
                self._bus.setup()
            except BusSetupError:
                if self._clock() >= until:
                    raise
            else:
                return

    def _store_reading(self, reading: ServoReading) -> None:
        index = reading.index
        leg, joint = divmod(index, 3)
        sign, horn = self._signs_and_horns[index]
        q = sign * reading.position - horn
        self.q[leg, joint] = q
        self.load[leg, joint] = sign * reading.load * self._stall_torque[index]
        if reading.voltage == reading.voltage:  # not NaN
            supplied = self._of_supply[index]
            self.voltage[supplied], self._voltage_ns[supplied] = reading.voltage, reading.stamp_ns
        elif reading.stamp_ns - self._voltage_ns[index] > _VOLTAGE_NS:
            self.voltage[index] = np.nan
        if reading.temperature == reading.temperature:
            self.temperature[index] = reading.temperature
        if self._catching_up.all_behind or self._catching_up.behind[index]:
            self._catching_up.note_reading(index, reading.stamp_ns, q - float(self.goals[leg, joint]), reading.speed)

    def _clipped_to_limits(self, q: Array) -> Array:
        """Return joint angles (6, 3) [rad] clipped to the joint limits, which hold with the offsets and without them."""
        limits, offsets = self._profile.joint_limits, self.offsets
        low, high = limits[..., 0] + np.maximum(offsets, 0.0), limits[..., 1] + np.minimum(offsets, 0.0)
        return np.asarray(np.minimum(np.maximum(q, low), high))

    def _check_silence(self) -> None:
        """Treat all joint positions as unknown if no servo answers, until all servos have caught up."""
        if self._bus.newest_age_s > _BUS_LOST_S:
            self.mark_stale()
        else:
            self._catching_up.update_all_behind(self._clock())

    def _check_torque_loss(self, answering: Iterable[int]) -> None:
        """Read Torque Enable of a few servos that answer, and keep which ones have lost torque."""
        for index in self._torque_loss.due(answering, self.torque):
            enabled = self._bus.read(self._bus.servo_ids[index], self._models[index].table.torque_enable)
            if enabled is not None:
                self.torque[index] = bool(enabled)
                self._torque_loss.confirm(index)
        self._torque_loss.end_cycle(self._bus.missed > self._tolerated)

    def _restore_torque_limit(self, index: int) -> None:
        """Give a servo its full torque limit, if it acknowledges its goal. One that reboots for it loses its torque."""
        servo_id, goal = self._bus.servo_ids[index], self._goal_ticks(self.goals)[index]
        if shutdown.end(self._bus, servo_id, int(goal), int(self._max_torque[index]), self._may_pull):
            self.strength[index] = 1.0
        elif self._reboots[index]:
            self.torque[index] = False

    def _read_torque(self) -> None:
        """Read Torque Enable of all servos; one that does not answer has none."""
        asked = zip(self._bus.servo_ids, self._models, strict=True)
        self.torque = np.array([bool(self._bus.read(i, model.table.torque_enable)) for i, model in asked])

    def _may_pull(self) -> bool:
        """Return whether no order keeps torque off."""
        return not (self._off_ordered or self._latched())

    def _call_bus(self, call: Callable[[], object]) -> None:
        """Send something to the servos; without a bus do nothing, and if the bus is lost close it."""
        if self.gone:
            return
        try:
            call()
        except BusDisconnectedError as error:
            self._disconnect(error)

    def _send_torque_off(self) -> None:
        self._call_bus(lambda: self._bus.set_torque(False))

    def _disconnect(self, error: BusDisconnectedError) -> None:
        self.gone, self._tried_ns, self._since_ns, self._catching_up.all_behind = str(error), self._clock(), -1, True
        self._bus.close()

    def _reconnect(self) -> None:
        """Try to reopen the bus, and read goals and torque of all servos again."""
        if self._clock() - self._tried_ns < _REOPEN_PERIOD_NS and not self._off_ordered:
            return
        self._tried_ns = self._clock()
        try:
            self._bus = self._open()
            if self._off_ordered:
                self._bus.set_torque(False)
            self._bus.open_session()
            found = [self._read_state_again(i) for i in self._bus.servo_ids]
        except OSError as error:
            self._bus.close()
            self.gone = f"the servo port is gone: {error}"
            return
        self._adopt_state(found)
        self._bus.between = _do_nothing
        self.gone = ""
        self._catching_up.readopt((self.q - self.goals).ravel(), self._clock())

    def _adopt_state(self, tables: list[bytes]) -> None:
        """Adopt the state of each servo; a goal far from its joint is replaced by the joint angle."""
        found = [model.table.condition.unpack(table) for model, table in zip(self._models, tables, strict=True)]
        max_torque, enabled, goals, limits, ticks, loads = np.array(found).T
        self.torque = enabled.astype(np.bool_) & (not self._off_ordered)  # a servo that has missed torque off receives it again
        self._max_torque = max_torque
        self.strength = np.minimum(limits / np.maximum(max_torque, 1), 1.0)
        positions = [model.position(value) for model, value in zip(self._models, ticks.tolist(), strict=True)]
        self.q, goal_angles = self._angles(positions), self._angles(goals)
        if self._assumed is not None:
            self.q = self._assumed.start(goal_angles, self.torque.reshape(6, 3))
        spring = np.where(self.torque.reshape(6, 3), goal_angles - self.q, 0.0) * self._profile.servos.stiffness
        most = self._profile.servos.stall_torque
        # Earlier readings may be those of a moving robot.
        self.load = self._torques(loads.tolist()) if self._measures_load else np.minimum(np.maximum(spring, -most), most)
        self.goals = np.where(np.abs(goal_angles - self.q) < _ADOPT_WITHIN_RAD, goal_angles, self.q)

    def _torques(self, loads: Sequence[int]) -> Array:
        """Return motor torques (6, 3) [N m] from load registers (18,)."""
        shares = np.array([model.load(value) for model, value in zip(self._models, loads, strict=True)]).reshape(6, 3)
        return np.asarray(self._profile.servo_signs * shares * self._profile.servos.stall_torque)

    def _read_state(self, servo_id: int) -> bytes | None:
        """Read the state block of a servo, None when it does not answer."""
        condition = self._bus.model_of(servo_id).table.condition
        return self._bus.read_bytes(servo_id, condition.address, condition.size)

    def _wait_for_state(self, servo_id: int) -> bytes:
        """Read the state block of a servo, and repeat the request until it has answered."""
        until = self._clock() + _STARTUP_TIMEOUT_NS
        while (table := self._read_state(servo_id)) is None:
            if self._clock() >= until:
                raise ConnectionError(f"servo {servo_id} stopped answering while its state was read")
        return table

    def _read_state_again(self, servo_id: int) -> bytes:
        """Read the state block of a servo on a reopened bus, with a limited number of requests."""
        for _ in range(_MAX_REQUESTS):
            if (table := self._read_state(servo_id)) is not None:
                return table
        raise ConnectionError(f"the port is back, but {self._profile.servo_names[servo_id]} (id {servo_id}) does not answer")

    def _angles(self, ticks: Iterable[int]) -> Array:
        """Return joint angles (6, 3) [rad] of position registers (18,)."""
        servo = [model.units.angle(t) for model, t in zip(self._models, ticks, strict=True)]
        return np.asarray(self._profile.joint_angles(np.array(servo).reshape(6, 3)) + self.offsets)

    def _goal_ticks(self, q: Array) -> NDArray[np.int64]:
        """Return goal registers (18,) of joint angles (6, 3) [rad]."""
        return self._units.goal_ticks(self._profile.servo_angles(q - self.offsets).ravel())


def _do_nothing() -> None:
    pass
