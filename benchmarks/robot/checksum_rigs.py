"""Emulated servos with a driver, in memory, in simulated time; what it believes is compared with what they are and do.

Joints turn and loads vary at random, and an error of a servo comes and goes. The driver reads the servos in cycles of 20 ms,
and a register of one of them in between.
"""

import itertools
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import NamedTuple, Protocol

import numpy as np

from benchmarks.robot.spoilt_answers import (
    NO_ODDS,
    OF_ANOTHER,
    WAYS,
    Found,
    SpoiltLink,
    Way,
    contains_other,
    contains_other_message,
    contains_other_part,
    has_other_bytes,
)
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError, ServoBus, ServoReading
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS, Bridge
from sextant.services.actuator.servo_bus.pwm_servos import PwmServos
from sextant.services.actuator.servo_bus.several_buses import AnyBus, SeveralBuses
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.motors import MOTOR_AND_SUPPLY, PWM_MOTOR, PWM_SUPPLY
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.services.simulator.servo_bus.servo_banks import ServoBanks
from sextant.shared.robot.joint_servos import BusRows
from sextant.shared.servo import dynamixel2, pwm
from sextant.shared.servo.models import MODEL_NAMED
from sextant.shared.servo.servo_model import Feedback, ServoModel

_N = 6
_CYCLE_NS, _BUDGET_NS = 20_000_000, 12_000_000
_STEP_RAD = 0.04  # [rad] largest motion of a joint in a cycle, 2 rad/s
_REACH_RAD = 1.2
_MOST_LOAD, _LOAD_STEP = 0.3, 0.06  # [1] of the stall torque
_CHARGE_STEP = 0.02  # [1] of the battery
_REGISTERS_SHARE = 0.2  # of cycles in which registers are read
_ERROR_SHARE = 0.005  # of cycles in which an error of a servo comes or goes
_SLOW_CYCLES = 50  # in which a voltage or a temperature of a servo with commands is read, and reported
_BRIDGE_CYCLES = 4  # in which a value passes a bridge
_SAME = 1.0 + 1e-6  # [units] largest difference of a register from the value
_COUNT_US = 5.0  # [us] of a PCA9685, at most
_RESTART_SHARE, _OPEN_SHARE, _SWITCH_SHARE = 0.002, 0.02, 0.3  # of exchanges with a board of hobby servos
_ON_SHARE = 0.7  # of switches, to which torque is turned on


class Rig(Protocol):
    """Servos with a driver, whose answers are spoilt."""

    def exchange(self) -> None:
        """Let the driver read some of the servos, and count what it believes."""


class _Truth(NamedTuple):
    """State of one servo, in physical units as in its readings."""

    position: float
    speed: float
    load: float
    voltage: float
    temperature: float
    error: int


class _Servos:
    """Servos of some models on one bus, in the order of the models, and their states of the last cycles."""

    def __init__(self, ids: Sequence[int], models: Sequence[ServoModel], rng: Random, found: Found, cycles: int = 1) -> None:
        """Create the servos at angle 0, with the bit rate of a robot.

        Args:
            ids: Their ids.
            models: The model of each.
            rng: Random numbers.
            found: Where wrong values are counted.
            cycles: Number of cycles whose states are right in a reading.
        """
        self._rng, self._found, self.models = rng, found, tuple(models)
        self._banks: list[ServoBank] = []
        rows: list[list[int]] = []
        for model, group in itertools.groupby(range(len(ids)), key=lambda row: models[row].name):
            rows.append(list(group))
            motor, supply = MOTOR_AND_SUPPLY[model]
            self._banks.append(ServoBank([ids[row] for row in rows[-1]], MODEL_NAMED[model], motor, supply=supply))
        self._places = [(bank, k) for bank, of_bank in zip(self._banks, rows, strict=True) for k, _ in enumerate(of_bank)]
        for bank in self._banks:
            bank.column(bank.table.baud_rate)[:] = bank.model.rate_code(bank.model.bus_rate)
        self.bank = self._banks[0] if len(self._banks) == 1 else ServoBanks(self._banks, rows)
        n = len(ids)
        self.q, self._load = np.zeros(n), np.zeros(n)
        self._torque = np.array([bank.motor.stall_torque for bank, _ in self._places])
        self._states = [deque[_Truth](maxlen=cycles) for _ in range(n)]
        self._slow = [deque[_Truth](maxlen=_SLOW_CYCLES) for _ in range(n)]
        self.note()

    @property
    def goals(self) -> list[int]:
        """The positions [ticks] of the servos as goals."""
        return [model.units.ticks(float(q)) for model, q in zip(self.models, self.q, strict=True)]

    def move(self) -> None:
        """Let a cycle pass."""
        rng, n = self._rng, len(self.q)
        before = self.q
        self.q = np.clip(before + [rng.uniform(-_STEP_RAD, _STEP_RAD) for _ in range(n)], -_REACH_RAD, _REACH_RAD)
        loads = self._load + [rng.uniform(-_LOAD_STEP, _LOAD_STEP) for _ in range(n)]
        self._load = np.clip(loads, -_MOST_LOAD, _MOST_LOAD)
        if rng.random() < _ERROR_SHARE:
            bank, k = rng.choice(self._places)
            most = bank.table.max_voltage
            column, factory = bank.column(most), bank.model.default(most)
            column[k] = most.min if column[k] == factory else factory
        self.bank.charge = min(max(self.bank.charge + rng.uniform(-_CHARGE_STEP, _CHARGE_STEP), 0.0), 1.0)
        dt = _CYCLE_NS * 1e-9
        self.bank.step(self.q, (self.q - before) / dt, self._load * self._torque, dt)
        self.note()

    def note(self) -> None:
        """Note the states of the servos."""
        for row, (bank, k) in enumerate(self._places):
            truth = _Truth(
                float(self.q[row]),
                float(bank._qd[k]),
                float(bank._load[k]),
                bank.voltage,
                float(bank.temperature[k]),
                bank.error(k) & int(bank.model.errors),
            )
            self._states[row].append(truth)
            self._slow[row].append(truth)

    def compare(self, row: int, reading: ServoReading) -> None:
        """Count a reading of the servo in a row, and its wrong values."""
        model, states = self.models[row], self._states[row]
        units = model.units
        slow = states if model.commands is None else self._slow[row]
        wrong = []
        for kind, unit, of_state in (
            (Feedback.POSITION, units.tick_rad, states),
            (Feedback.SPEED, units.speed_rad_s, states),
            (Feedback.LOAD, units.load, states),
            (Feedback.VOLTAGE, units.volt, slow),
            (Feedback.TEMPERATURE, 1.0, slow),
        ):
            name = str(kind.name).lower()
            value = getattr(reading, name)
            if kind in reading.measured and not any(abs(value - getattr(one, name)) <= _SAME * unit for one in of_state):
                wrong.append(name)
        # An alert does not tell the error, which is read in one of the next cycles.
        right = any(reading.error == one.error or (model.protocol.ALERT and not reading.error & ~one.error) for one in states)
        if not right:
            wrong.append("error")
        if "position" in wrong:
            off = math.degrees(min(abs(reading.position - one.position) for one in states))
            self._found.position_off_deg = max(self._found.position_off_deg, off)
        self._found.readings += 1
        self._found.note(wrong)

    def read_any(self, row: int, servo_id: int, read: Callable[..., int | None]) -> None:
        """Read a random register of the servo in a row, and compare it with its table."""
        model = self.models[row]
        register = self._rng.choice([one for one in model.table.registers if model.has(one)])
        value = read(servo_id, register)
        if value is not None:
            held = register.decode(self.bank.read(row, register.address, register.size))
            self._found.registers += 1
            self._found.note([] if value == held else ["register"])


class _Buses:
    """Servos on one or several buses, the models of each in their order."""

    def __init__(self, buses: Sequence[Sequence[ServoModel]], way: Way, rng: Random, found: Found, fast: bool = False) -> None:
        self._rng, self._now_ns, self._fast = rng, 0, fast
        self._ports: list[MemoryPort] = []
        self._links: list[SpoiltLink] = []
        self._emulators: list[ServoBusEmulator] = []
        self._servos: list[_Servos] = []
        self._rows: list[range] = []  # of the servos of each bus
        for models in buses:
            first = sum(map(len, self._rows))
            self._rows.append(range(first, first + len(models)))
            self._connect(models, way, rng, found)
        self._driver = self._new_driver()
        self._driver.setup()
        self._driver.set_torque(True)
        for link in self._links:
            link.spoils = True

    def _connect(self, models: Sequence[ServoModel], way: Way, rng: Random, found: Found) -> None:
        """Connect the servos of a bus."""
        servos = _Servos([1 + row for row in self._rows[-1]], models, rng, found)
        for row, model in enumerate(models):
            if not self._fast and model.fast_firmware is not None:  # answers of single servos, not a combined one
                firmware = model.table.firmware
                servos.bank.write(row, firmware.address, (model.fast_firmware - 1).to_bytes(firmware.size, "little"))
        protocol, emulator = models[0].protocol, ServoBusEmulator(servos.bank)
        # Old answers of two servos in one exchange may look in order.
        tells_odds = way.odds is not None and not (models[0].sync_read is not None and way is WAYS[OF_ANOTHER])
        if not tells_odds:
            found.expected = found.most_wrong = None

        def is_other(reply: Reply, spoilt: bytes) -> bool:
            if reply.servo_id == protocol.BROADCAST_ID:
                return contains_other_part(len(reply.parts), reply.data, spoilt)
            return contains_other(protocol, reply.servo_id, reply.data, spoilt)

        odds = way.odds or NO_ODDS
        link = SpoiltLink(emulator, way, rng, found, odds.crc if protocol is dynamixel2 else odds.one_byte, is_other)
        link.only = dynamixel2.BROADCAST_ID if self._fast else None
        self._servos.append(servos)
        self._emulators.append(emulator)
        self._links.append(link)
        self._ports.append(MemoryPort(link, self._clock))

    def _new_driver(self) -> AnyBus:
        parts: dict[BusRows, ServoBus] = {}
        for number, (port, servos, rows) in enumerate(zip(self._ports, self._servos, self._rows, strict=True)):
            ids, first = [1 + row for row in rows], servos.models[0]
            models = dict(zip(ids, servos.models, strict=True))
            if len(self._rows) == 1:
                return bus_of(first)(port, ids, self._clock, model=first, models=models)
            bus = ServoBus(port, ids, self._clock, model=first, models=models, rows=rows)
            parts[BusRows(f"bus {number}", tuple(rows))] = bus
        return SeveralBuses(parts)

    def _clock(self) -> int:
        return max([self._now_ns, *(port.last_ns for port in self._ports)])

    def exchange(self) -> None:
        """Let a cycle pass, in which the driver reads the servos, or registers of some."""
        self._now_ns = max(self._now_ns + _CYCLE_NS, self._clock())
        for emulator, servos in zip(self._emulators, self._servos, strict=True):
            emulator.advance(self._now_ns + _CYCLE_NS)  # also what is still on the wire, because registers are compared
            servos.move()
        if self._fast:  # a driver that has lost a combined answer does not ask for the next one
            self._driver = self._new_driver()
        elif self._rng.random() < _REGISTERS_SHARE:
            for servos, rows in zip(self._servos, self._rows, strict=True):
                for row in self._rng.sample(rows, 2):
                    servos.read_any(row - rows.start, 1 + row, self._driver.read)
            return
        for reading in self._driver.poll(_BUDGET_NS):
            number = next(k for k, rows in enumerate(self._rows) if reading.index in rows)
            self._servos[number].compare(reading.index - self._rows[number].start, reading)
        self._driver.sync_write_goals([goal for servos in self._servos for goal in servos.goals])


class _Bridged:
    """Servos behind a microcontroller bridge; the frames of its wire are spoilt."""

    def __init__(self, model: ServoModel, way: Way, rng: Random, found: Found) -> None:
        self._rng, self._now_ns = rng, 0
        ids = range(1, _N + 1)
        self._servos = _Servos(ids, [model] * _N, rng, found, _BRIDGE_CYCLES)
        self._board = Board(ServoBusEmulator(self._servos.bank, BusTiming(usb_transaction_ns=0)), model=model)
        found.expected = None if way.odds is None else 0.0  # old frames are intact, but not believed: they have numbers
        self._link = SpoiltLink(self._board, way, rng, found, (way.odds or NO_ODDS).crc, _is_other_message)
        self._port = MemoryPort(self._link, lambda: self._now_ns, READ_NS * 1e-9)
        self._driver = Bridge(self._port, ids, self._port.now_ns, model=model)
        self._driver.setup()
        for on in (False, True):
            self._driver.set_torque(on)
            for _ in range(3):
                self.exchange()
        self._link.spoils = True

    def exchange(self) -> None:
        """Let a cycle pass, in which the driver takes the states of the board."""
        self._now_ns = max(self._now_ns + _CYCLE_NS, self._port.now_ns())
        self._board.advance(self._now_ns)
        self._servos.move()
        for reading in self._driver.poll(_BUDGET_NS):
            self._servos.compare(reading.index, reading)
        self._driver.sync_write_goals(self._servos.goals)


class _PulseBoard:
    """Hobby servos at a board without a checksum.

    The driver asks which pulses channels have. Their torque and goals, as it then believes, are compared with the pulses.
    """

    def __init__(self, board: pwm.Board, way: Way, rng: Random, found: Found) -> None:
        self._rng, self._found, self._now_ns = rng, found, 0
        self._pulses = pwm.Pulses(board, us_per_rad=424.4)
        model = pwm.model_of(self._pulses)
        channels = range(_N)
        self._bank = ServoBank(channels, model, PWM_MOTOR, supply=PWM_SUPPLY, stiffness=20.0)
        self._board = make_board(self._bank, self._pulses)
        found.expected, found.most_wrong = None, None if way.odds is None else 0.0
        self._link = SpoiltLink(self._board, way, rng, found, (way.odds or NO_ODDS).twice, _has_other_bytes)
        self._port = MemoryPort(self._link, lambda: self._now_ns)
        self._driver = self._opened()
        self._link.spoils = True

    def _opened(self) -> PwmServos:
        driver = PwmServos(self._port, range(_N), self._port.now_ns, self._pulses)
        driver.setup()
        return driver

    def exchange(self) -> None:
        """Let a cycle pass: change the pulses of a channel, and ask for those of others."""
        rng, table = self._rng, self._bank.table
        self._now_ns = max(self._now_ns + _CYCLE_NS, self._port.now_ns())
        self._board.advance(self._now_ns)
        channel, most = rng.randrange(_N), self._bank.model.units.max_position
        if rng.random() < _RESTART_SHARE:
            self._board.restart(self._now_ns)
        elif rng.random() < _OPEN_SHARE:
            self._open_again()
        elif rng.random() < _SWITCH_SHARE:
            self._driver.write(channel, table.goal_position, rng.randrange(most + 1))
            self._driver.write(channel, table.torque_enable, int(rng.random() < _ON_SHARE))
        self._driver.poll(_BUDGET_NS)
        self._driver.sync_write_goals([rng.randrange(most + 1) for _ in range(_N)])
        for channel in rng.sample(range(_N), 2):
            self._settle()
            believed = self._driver.read(channel, table.torque_enable)
            if believed is not None:
                self._found.registers += 1
                held = int(self._bank.column(table.torque_enable)[channel])
                self._found.note([] if believed == held else ["torque"])

    def _open_again(self) -> None:
        """Let a new driver adopt the pulses, and compare the goals that it has then."""
        table = self._bank.table
        try:
            self._driver = self._opened()
        except BusSetupError:  # it does not believe the board
            return
        self._settle()
        for channel in range(_N):
            believed = self._driver.read(channel, table.goal_position)
            if believed is None or not self._bank.column(table.torque_enable)[channel]:
                continue
            off = abs(believed - int(self._bank.column(table.goal_position)[channel])) / pwm.TICKS_PER_US
            self._found.registers += 1
            self._found.note([] if off <= _COUNT_US else ["goal"])

    def _settle(self) -> None:
        """Let the ordered pulses begin."""
        self._now_ns = self._port.now_ns()
        self._board.advance(self._now_ns + 2 * _CYCLE_NS)


def _is_other_message(reply: Reply, spoilt: bytes) -> bool:
    return contains_other_message(reply.data, spoilt)


def _has_other_bytes(reply: Reply, spoilt: bytes) -> bool:
    return has_other_bytes(reply.data, spoilt)


def _of_buses(*buses: Sequence[str], fast: bool = False) -> Callable[[Way, Random, Found], Rig]:
    models = [[MODEL_NAMED[name] for name in names] for names in buses]
    return lambda way, rng, found: _Buses(models, way, rng, found, fast)


def _of_bridge(name: str) -> Callable[[Way, Random, Found], Rig]:
    return lambda way, rng, found: _Bridged(MODEL_NAMED[name], way, rng, found)


def _of_board(board: pwm.Board) -> Callable[[Way, Random, Found], Rig]:
    return lambda way, rng, found: _PulseBoard(board, way, rng, found)


_COMBINED, _BRIDGED = "XL430-W250, combined answers", "AX-12A behind a bridge"
_MAESTRO, _PCA9685 = "hobby servos, Maestro", "hobby servos, PCA9685"
ONE_SENDER = (_COMBINED, _BRIDGED, _MAESTRO, _PCA9685)  # of all answers
_X = ("XM430-W350",) * 3 + ("XL430-W250",) * 3
RIGS: Mapping[str, Callable[[Way, Random, Found], Rig]] = {
    **{name: _of_buses((name,) * _N) for name in MODEL_NAMED},
    _COMBINED: _of_buses(("XL430-W250",) * _N, fast=True),
    "XM430-W350 with XL430-W250": _of_buses(_X),
    "the same, and STS3215 on a second bus": _of_buses(_X, ("STS3215",) * 3),
    _BRIDGED: _of_bridge("AX-12A"),
    _MAESTRO: _of_board("maestro"),
    _PCA9685: _of_board("pca9685"),
}
