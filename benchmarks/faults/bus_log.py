"""Recorder on the servo bus.

It records goals sent by the host, and torque switches and resets received by the servos.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.servo_model import Kind, Recovery, Register, Request

SIDES = ("sent", "heard")


class Role(Enum):
    """What a switch does."""

    TORQUE = auto()  # turn torque on or off
    RESET = auto()  # end the shutdown of a servo


class Switch(NamedTuple):
    """A command that switches some servos."""

    t_s: float
    heard: bool  # received by the servos; else sent by the host
    role: Role
    values: dict[int, int]  # value of the register for each servo ID, 0 for a reboot


class Goals(NamedTuple):
    """A sync write of goals, sent by the host."""

    t_s: float
    ticks: NDArray[np.int64]  # (18,) in the order of the robot profile
    speeds: NDArray[np.int64]  # (18,) goal speeds of the same packet [ticks], 0 for the maximum


@dataclass(frozen=True, slots=True)
class Outside:
    """A goal outside the joint limits."""

    t_s: float
    servo: int
    ticks: int


class WireLog(ABC):
    """Goals and switches on the wire; every goal is compared with the joint limits."""

    def __init__(self, profile: RobotProfile):
        """Start without data."""
        self.goals: list[Goals] = []
        self.switches: list[Switch] = []
        self.outside: list[Outside] = []
        self._ids = profile.servo_ids.ravel().tolist()
        servo = profile.servo_angles(np.moveaxis(profile.joint_limits, -1, 0)).reshape(2, 18)
        units = profile.servo_model.units
        ticks = units.centre + np.sort(servo, axis=0) / units.tick_rad
        # a goal is a whole tick: the nearest one may be half a tick beyond the limit
        self._low, self._high = (np.rint(side).clip(0, units.max_position).astype(np.int64) for side in ticks)

    def sent(self, data: bytes, now_ns: int) -> None:
        """Process bytes sent by the host."""
        self._hear("sent", data, now_ns)

    def heard(self, data: bytes, now_ns: int) -> None:
        """Process bytes received by the servos."""
        self._hear("heard", data, now_ns)

    @abstractmethod
    def _hear(self, side: str, data: bytes, now_ns: int) -> None:
        """Decode bytes, and store what they mean."""

    def _judge(self, t_s: float, values: dict[int, int], speeds: dict[int, int]) -> None:
        """Store goals, and those outside the joint limits."""
        before = self.goals[-1].ticks if self.goals else np.full(18, -1)
        ticks = np.array([values.get(i, old) for i, old in zip(self._ids, before, strict=True)])
        self.goals.append(Goals(t_s, ticks, np.array([speeds.get(i, 0) for i in self._ids])))
        for index in np.flatnonzero((ticks >= 0) & ((ticks < self._low) | (ticks > self._high))).tolist():
            self.outside.append(Outside(t_s, self._ids[index], int(ticks[index])))


class Recorder(WireLog):
    """Decodes the packets of a servo bus."""

    def __init__(self, profile: RobotProfile):
        """Start without data."""
        super().__init__(profile)
        self._model = profile.servo_model
        self._protocol, self._table = self._model.protocol, self._model.table
        self._parsers = {side: self._protocol.instruction_parser() for side in SIDES}

    def _hear(self, side: str, data: bytes, now_ns: int) -> None:
        for packet in self._parsers[side].feed(data):
            request = self._protocol.request(packet) if packet.intact else None
            if request is not None:
                self._note(side, now_ns * 1e-9, packet.servo_id, request)

    def _note(self, side: str, t_s: float, servo_id: int, request: Request) -> None:
        """Store the goals and switches of a request to one servo or to all."""
        ids = self._ids if servo_id == self._protocol.BROADCAST_ID else [servo_id]
        if request.kind is Kind.REBOOT:
            self.switches.append(Switch(t_s, side == "heard", Role.RESET, dict.fromkeys(ids, 0)))
            return
        if request.kind not in (Kind.WRITE, Kind.SYNC_WRITE):
            return
        rows = dict(request.rows) if request.kind is Kind.SYNC_WRITE else dict.fromkeys(ids, request.data)

        def written(register: Register) -> dict[int, int]:
            start = register.address - request.address
            end = start + register.size
            return {i: register.decode(row[start:end]) for i, row in rows.items() if start >= 0 and end <= len(row)}

        table = self._table
        if side == "sent" and (goals := written(table.goal_position)):
            self._judge(t_s, goals, written(table.goal_speed))
        # Torque off to one servo begins the reset of its shutdown, if the model asks for that.
        one_by_one = request.kind is Kind.WRITE and len(ids) == 1 and self._model.recovery is Recovery.TORQUE_ENABLE
        if torque := written(table.torque_enable):
            role = Role.RESET if one_by_one and not any(torque.values()) else Role.TORQUE
            self.switches.append(Switch(t_s, side == "heard", role, torque))
        if self._model.recovery is Recovery.TORQUE_LIMIT and (limits := written(table.torque_limit)):
            self.switches.append(Switch(t_s, side == "heard", Role.RESET, limits))
