"""Packets that write to all servos of a bus: one sync write for all servos that have the same registers.

An AX-12A and an MX-28 have their goals at the same addresses, so one packet has the goals of both.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.shared.servo.servo_model import BusProtocol, ControlTable, Register, ServoModel


def whole(values: ArrayLike, register: Register, count: int) -> NDArray[np.int64]:
    """Validate the values of a register, for each of `count` servos or one for all.

    Raises:
        ValueError: A value out of range, not a whole number, or of another shape.
    """
    array = np.asarray(values)
    if array.dtype.kind not in "iu" or array.shape not in ((), (count,)):
        raise ValueError(f"{register.name}: integers of shape ({count},) expected, found {array.dtype} of shape {array.shape}")
    numbers = array.ravel().tolist()
    if min(numbers) < register.min or max(numbers) > register.max:
        raise ValueError(f"{register.name} takes {register.min} to {register.max}, found {array.tolist()}")
    return array.astype(np.int64, copy=False)


class GroupWrites:
    """Goals and torque of the servos on one bus. Arrays are in the order of their list."""

    def __init__(self, protocol: BusProtocol, servo_ids: Sequence[int], models: Sequence[ServoModel]) -> None:
        """Group the servos (n,) by their registers."""
        self._protocol, self._ids = protocol, tuple(servo_ids)
        self._positions, self._speeds, self._torques = (
            _by_register(models, role)
            for role in (lambda t: t.goal_position, lambda t: t.goal_speed, lambda t: t.torque_enable)
        )
        places: dict[tuple[int | str, ...], list[int]] = {}
        for index, model in enumerate(models):
            places.setdefault(_places(model.table), []).append(index)
        self._rows = [_GoalRows(protocol, models[of[0]].table, np.array(of), servo_ids) for of in places.values()]

    def goals(self, goal_ticks: ArrayLike, speed_ticks: ArrayLike) -> tuple[list[int], list[bytes]]:
        """Return goal positions as a list (n,), and the packets that send them with their speeds.

        Args:
            goal_ticks: (n,) or one goal position register.
            speed_ticks: (n,) or one goal speed register, 0 for no limit.

        Raises:
            ValueError: A value out of range, not a whole number, or of another shape.
        """
        goals, speeds = self._valid(goal_ticks, self._positions), self._valid(speed_ticks, self._speeds)
        listed: list[int] = goals.tolist() if goals.ndim else [int(goals)] * len(self._ids)
        return listed, [rows.packet(goals, speeds) for rows in self._rows]

    def torque_on(self) -> list[bytes]:
        """Return the packets that turn the torque of all servos on."""
        return self._torque(1)

    def torque_off(self) -> list[bytes]:
        """Return the packets that turn all torque off: the shortest possible one to all servos, if they have one register."""
        if len(self._torques) > 1:  # the address may be that of something else in another servo
            return self._torque(0)
        (enable,) = self._torques
        return [self._protocol.write(self._protocol.BROADCAST_ID, enable.address, enable.encode(0))]

    def _torque(self, value: int) -> list[bytes]:
        return [
            self._protocol.sync_write(enable.address, enable.size, [(self._ids[k], enable.encode(value)) for k in of])
            for enable, of in self._torques.items()
        ]

    def _valid(self, values: ArrayLike, registers: Mapping[Register, Sequence[int]]) -> NDArray[np.int64]:
        """Return values after validation, each with the register of its servo."""
        count = len(self._ids)
        if len(registers) == 1:
            return whole(values, next(iter(registers)), count)
        array = np.asarray(values)
        if array.shape not in ((), (count,)):
            return whole(array, next(iter(registers)), count)  # which raises
        for register, of in registers.items():
            whole(array[of] if array.ndim else array, register, len(of))
        return array.astype(np.int64, copy=False)


class _GoalRows:
    """Sync write of goal positions and speeds to servos that have them at the same addresses."""

    def __init__(self, protocol: BusProtocol, table: ControlTable, of: NDArray[np.int64], servo_ids: Sequence[int]) -> None:
        """Prepare the packet of the servos `of` a list of ids."""
        self._protocol, self._block = protocol, table.goals
        self._of = slice(None) if len(of) == len(servo_ids) else of
        rows = self._bytes = np.zeros((len(of), 1 + table.goals.size), dtype=np.uint8)  # id, goal position and speed
        rows[:, 0] = np.array(servo_ids)[of]
        self._goals, self._speeds = (
            _view(rows, 1 + register.address - table.goals.address, register.dtype)
            for register in (table.goal_position, table.goal_speed)
        )

    def packet(self, goals: NDArray[np.int64], speeds: NDArray[np.int64]) -> bytes:
        """Return the packet, from values of all servos of the bus or one for all."""
        self._goals[:] = goals[self._of] if goals.ndim else goals
        self._speeds[:] = speeds[self._of] if speeds.ndim else speeds
        return self._protocol.sync_write_rows(self._block.address, self._block.size, self._bytes.tobytes())


def _by_register(models: Sequence[ServoModel], role: Callable[[ControlTable], Register]) -> dict[Register, list[int]]:
    """Return the indices of the servos that have the same register in a role."""
    found: dict[Register, list[int]] = {}
    for index, model in enumerate(models):
        found.setdefault(role(model.table), []).append(index)
    return found


def _places(table: ControlTable) -> tuple[int | str, ...]:
    """Return where the goals of a servo are, and in which order of bytes."""
    block, registers = table.goals, (table.goal_position, table.goal_speed)
    return (block.address, block.size, *(number for one in registers for number in (one.address, one.dtype)))


def _view(rows: NDArray[np.uint8], offset: int, dtype: str) -> NDArray[np.unsignedinteger]:
    """Return a column (n,) of numbers in rows of bytes."""
    n, width = rows.shape
    return np.ndarray((n,), dtype=dtype, buffer=rows.data, offset=offset, strides=(width,))
