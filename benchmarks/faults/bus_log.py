"""Recorder on the servo bus.

It records goals sent by the host, and torque switches and resets received by the servos.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import Instruction, PacketParser
from sextant.shared.servo.servo_model import Packet, Register

_SIDES = ("sent", "heard")


class Switch(NamedTuple):
    """A register write to some servos."""

    t_s: float
    heard: bool  # received by the servos; else sent by the host
    register: Register
    values: dict[int, int]  # value for each servo ID


class Goals(NamedTuple):
    """A sync write of goals, sent by the host."""

    t_s: float
    ticks: NDArray[np.int64]  # (18,) in the order of the robot profile
    speeds: NDArray[np.int64]  # (18,) moving speeds of the same packet, 0 for the maximum


@dataclass(frozen=True, slots=True)
class Outside:
    """A goal outside the joint limits."""

    t_s: float
    servo: int
    ticks: int


class Recorder:
    """Decodes bus traffic, and compares every goal with the joint limits."""

    def __init__(self, profile: RobotProfile):
        """Start without data."""
        self.goals: list[Goals] = []
        self.switches: list[Switch] = []
        self.outside: list[Outside] = []
        self._ids = profile.servo_ids.ravel().tolist()
        self._parsers = {side: PacketParser() for side in _SIDES}
        servo = profile.servo_angles(np.moveaxis(profile.joint_limits, -1, 0)).reshape(2, 18)
        ticks = dxl.TICK_CENTRE + np.sort(servo, axis=0) / dxl.TICK_RAD
        # a goal is a whole tick: the nearest one may be half a tick beyond the limit
        self._low, self._high = (np.rint(side).clip(0, dxl.TICK_MAX).astype(np.int64) for side in ticks)

    def sent(self, data: bytes, now_ns: int) -> None:
        """Process bytes sent by the host."""
        self._hear("sent", data, now_ns)

    def heard(self, data: bytes, now_ns: int) -> None:
        """Process bytes received by the servos."""
        self._hear("heard", data, now_ns)

    def _hear(self, side: str, data: bytes, now_ns: int) -> None:
        for packet in self._parsers[side].feed(data):
            writes = _writes(packet)
            if writes:
                self._note(side, now_ns * 1e-9, *writes)

    def _note(self, side: str, t_s: float, address: int, rows: dict[int, bytes]) -> None:
        speeds: dict[int, int] = {}
        for register in (dxl.MOVING_SPEED, dxl.GOAL_POSITION, dxl.TORQUE_ENABLE, dxl.TORQUE_LIMIT):
            start = register.address - address
            ids = self._ids if dxl.BROADCAST_ID in rows else rows
            values = {
                i: int.from_bytes(rows.get(i, rows.get(dxl.BROADCAST_ID, b""))[start : start + register.size], "little")
                for i in ids
                if start >= 0 and len(rows.get(i, rows.get(dxl.BROADCAST_ID, b""))) >= start + register.size
            }
            if not values:
                continue
            if register is dxl.MOVING_SPEED:
                speeds = values
            elif register is not dxl.GOAL_POSITION:
                self.switches.append(Switch(t_s, side == "heard", register, values))
            elif side == "sent":
                self._judge(t_s, values, speeds)

    def _judge(self, t_s: float, values: dict[int, int], speeds: dict[int, int]) -> None:
        """Store goals, and those outside the joint limits."""
        before = self.goals[-1].ticks if self.goals else np.full(18, -1)
        ticks = np.array([values.get(i, old) for i, old in zip(self._ids, before, strict=True)])
        self.goals.append(Goals(t_s, ticks, np.array([speeds.get(i, 0) for i in self._ids])))
        for index in np.flatnonzero((ticks >= 0) & ((ticks < self._low) | (ticks > self._high))).tolist():
            self.outside.append(Outside(t_s, self._ids[index], int(ticks[index])))


def _writes(packet: Packet) -> tuple[int, dict[int, bytes]] | None:
    """Return the address written by a packet, and the data by servo.

    Return None for a packet that writes nothing.
    """
    parameters = packet.parameters
    if packet.code == Instruction.WRITE and len(parameters) >= 2:
        return parameters[0], {packet.servo_id: parameters[1:]}
    if packet.code != Instruction.SYNC_WRITE or len(parameters) < 2 or not parameters[1]:
        return None
    size = parameters[1]
    rows = range(2, len(parameters) - size, size + 1)
    return parameters[0], {parameters[i]: parameters[i + 1 : i + 1 + size] for i in rows}
