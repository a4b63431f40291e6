"""Recorder on the servo bus.

It records goals sent by the host, and torque switches and resets received by the servos.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.servo_model import ControlTable, Kind, Recovery, Register, Request

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
        servo, servos = profile.servo_angles(np.moveaxis(profile.joint_limits, -1, 0)), profile.servos
        ticks = (servos.centre + np.sort(servo, axis=0) / servos.tick_rad).reshape(2, 18)
        most = [model.units.max_position for model in servos.models]
        # a goal is a whole tick: the nearest one may be half a tick beyond the limit
        self._low, self._high = (np.rint(side).clip(0, most).astype(np.int64) for side in ticks)

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
            if self._ids[index] in values:
                self.outside.append(Outside(t_s, self._ids[index], int(ticks[index])))


class Recorder(WireLog):
    """Decodes the packets of a servo bus."""

    def __init__(self, profile: RobotProfile):
        """Start without data."""
        super().__init__(profile)
        self._models = profile.servo_models  # by id
        self._protocol = profile.servo_model.protocol
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

        def written(role: Callable[[ControlTable], Register], recovery: Recovery | None = None) -> dict[int, int]:
            found = {}
            for i, row in rows.items():
                model = self._models.get(i)
                if model is not None and recovery in (None, model.recovery):
                    register = role(model.table)
                    start = register.address - request.address
                    if start >= 0 and start + register.size <= len(row):
                        found[i] = register.decode(row[start : start + register.size])
            return found

        if side == "sent" and (goals := written(lambda table: table.goal_position)):
            self._judge(t_s, goals, written(lambda table: table.goal_speed))
        # Torque off to one servo begins the reset of its shutdown, if the model asks for that.
        one_by_one = request.kind is Kind.WRITE and len(ids) == 1
        if torque := written(lambda table: table.torque_enable):
            resets = one_by_one and self._models[ids[0]].recovery is Recovery.TORQUE_ENABLE and not any(torque.values())
            self.switches.append(Switch(t_s, side == "heard", Role.RESET if resets else Role.TORQUE, torque))
        if limits := written(lambda table: table.torque_limit, Recovery.TORQUE_LIMIT):
            self.switches.append(Switch(t_s, side == "heard", Role.RESET, limits))
