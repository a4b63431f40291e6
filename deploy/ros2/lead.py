"""Driving by Twists from ROS, with a dead-man timeout; pure, time is an argument.

A sender takes the lease by the rules of all operators while it is free, and loses it to another operator who takes over. A zero
Twist does not start driving. After a refusal or a loss of the lease, Twists have no effect until they have paused or were zero.
Times are this machine's; stamps and sequence numbers of outgoing messages are the robot's, wherever this runs.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.runtime.robot_clock import RobotClockEstimate
from sextant.shared.wire.messages import ActuatorState, GaitRequest, Message, Mode, ModeCommand, VelocityCommand

DEAD_MAN_NS = 300_000_000  # [ns] without a Twist, after which the robot stops
_REPEAT_NS = 500_000_000  # [ns] between two messages of an order, which keeps the lease
_LEASE_NS = 1_000_000_000  # [ns] within which the actuator should grant the lease
_VELOCITY_NS = 40_000_000  # [ns] least time between two velocity commands
_FASTEST_TURN = 1.0  # [rad/s]; the planner limits it to the robot's capability
_LED = (Mode.HOLD, Mode.WALK)  # modes in which driving may start
_GOES_ON = (*_LED, Mode.FAULT)  # modes in which it continues: a fault stops the legs by itself


@dataclass(frozen=True, slots=True)
class Walk:
    """Walk parameters that a Twist does not contain."""

    max_speed: float  # [m/s] of the robot
    body_height: float  # [m] over the floor
    lift: float = 0.04  # [m] clearance of swing feet
    gait: GaitRequest = "tripod"


@dataclass(slots=True)
class Lead:
    """Converts Twists to messages; call `beat` every few hundredths of a second."""

    walk: Walk
    holder: str = "ros2"
    leading: bool = False
    _begun_ns: int = 0  # since when it drives, or waits for the lease
    _lapsed: bool = False  # current Twists have no effect
    _heard_ns: int = -DEAD_MAN_NS - 1
    _velocity: Array = field(default_factory=lambda: np.zeros(2))
    _yaw_rate: float = 0.0
    _state: ActuatorState | None = None
    _sequence: int = 0
    _order: ModeCommand | None = None
    _velocity_ns: int = 0
    _new: list[Message] = field(default_factory=list)  # to send at the next beat
    _words: list[str] = field(default_factory=list)
    _robot: RobotClockEstimate = field(default_factory=RobotClockEstimate)

    def twist(self, velocity: Array, yaw_rate: float, now_ns: int) -> None:
        """Process a Twist.

        Args:
            velocity: (2,) [m/s] {body} forward, left; finite.
            yaw_rate: [rad/s] finite.
            now_ns: [ns]
        """
        if self.leading and now_ns - self._heard_ns > DEAD_MAN_NS:
            self._let_go(now_ns)
        moves = bool(np.any(velocity)) or yaw_rate != 0.0
        if now_ns - self._heard_ns > DEAD_MAN_NS or not moves:
            self._lapsed = False
        self._heard_ns = now_ns
        if not self.leading:
            if self._lapsed or not moves:
                return
            refused = self._refused()
            if refused:
                self._lapsed = True
                self._words.append(f"Twist refused: {refused}")
                return
            self.leading, self._begun_ns = True, now_ns
            self._words.append("a Twist drives the robot")
            self._say("walk", now_ns)
        speed = math.hypot(*velocity.tolist())
        self._velocity = velocity * min(1.0, self.walk.max_speed / speed) if speed > 0.0 else np.zeros(2)
        self._yaw_rate = min(max(yaw_rate, -_FASTEST_TURN), _FASTEST_TURN)

    def beat(self, now_ns: int, state: ActuatorState | None) -> list[Message]:
        """Return the messages to send now [ns].

        `state` is the actuator's newest state; None if there was none for a while.
        """
        self._state = state
        if void := self._robot.see(now_ns, None if state is None else state.stamp_ns):
            self._sequence = 0
            self._lapse(void)
        if self.leading:
            self._watch(now_ns)
        if self.leading and self._order is not None and now_ns - self._order.stamp_ns >= _REPEAT_NS:
            self._order = replace(self._order, stamp_ns=now_ns)
            self._new.append(self._order)
        out, self._new = self._new, []
        if self.leading and state is not None and state.lease == self.holder and now_ns - self._velocity_ns >= _VELOCITY_NS:
            self._velocity_ns = now_ns
            out.append(self._command(now_ns, self._velocity, self._yaw_rate))
        return [replace(message, stamp_ns=self._robot()) for message in out]

    def release(self, now_ns: int) -> list[Message]:
        """Return the messages to send at the end: they stop the robot if it is driven."""
        if self.leading:
            self._let_go(now_ns, "the bridge is ending")
        out, self._new = [replace(message, stamp_ns=self._robot()) for message in self._new], []
        return out

    def drain_words(self) -> list[str]:
        """Return the log lines since the last call."""
        words, self._words = self._words, []
        return words

    def _refused(self) -> str:
        """Return why the robot cannot be driven now, or an empty string."""
        state = self._state
        if state is None:
            return "no message from the actuator; is it running?"
        if state.lease not in ("", self.holder):
            return f"{state.lease} holds the lease"
        if state.mode not in _LED:
            return f"the robot cannot walk in mode {state.mode}: {state.reason}; run `sextant order stand`"
        return ""

    def _watch(self, now_ns: int) -> None:
        state = self._state
        if now_ns - self._heard_ns > DEAD_MAN_NS:
            self._let_go(now_ns)
        elif state is not None and state.lease not in ("", self.holder):
            self._lapse(f"{state.lease} has taken the lease over")
        elif state is not None and not state.lease and now_ns - self._begun_ns > _LEASE_NS:
            self._lapse(f"the actuator does not grant the lease{''.join(f'; {words}' for words in state.warnings)}")
        elif state is not None and state.mode not in _GOES_ON:
            self._lapse(f"the robot no longer follows Twists: {state.mode}: {state.reason}")

    def _let_go(self, now_ns: int, why: str = f"no Twist for {DEAD_MAN_NS * 1e-9:.1f} s") -> None:
        """Stop the robot: send a zero velocity and the stop order once."""
        self.leading = False
        self._words.append(f"the robot is stopped: {why}")
        self._new.append(self._command(now_ns, np.zeros(2), 0.0))
        self._say("stop", now_ns)

    def _lapse(self, why: str) -> None:
        self.leading, self._lapsed = False, True
        self._words.append(why)

    def _say(self, mode: Literal["walk", "stop"], now_ns: int) -> None:
        self._sequence = max(self._sequence + 1, self._robot())  # larger than those of an earlier bridge on any machine
        self._order = ModeCommand(now_ns, mode, self._sequence, self.holder)
        self._new.append(self._order)

    def _command(self, now_ns: int, velocity: Array, yaw_rate: float) -> VelocityCommand:
        walk = self.walk
        asked = walk.body_height, walk.lift, walk.gait
        return VelocityCommand(now_ns, velocity, yaw_rate, *asked, auto_speed=walk.gait == "auto")
