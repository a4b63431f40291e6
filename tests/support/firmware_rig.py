"""A board whose firmware runs behind stand-ins of its ports, with a driver, servos, faults, and a record of all turns."""

import importlib.util
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS, Bridge
from sextant.services.actuator.servo_bus.pulse_bridge import PulseBridge
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import ServoBank, make_servo_bank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import pwm
from sextant.shared.servo.bridge_protocol import LOAD, Limits
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.servo.firmware import board, config
from sextant.shared.servo.servo_model import ServoModel

STAND_INS = Path(__file__).parent / "micropython"
TICKS = 1 << 30  # period of `time.ticks_us` on boards
PERIOD_NS = 20_000_000
START_US = TICKS - 2_000_000  # the counter wraps two seconds after the start


def stand_in(name: str, folder: Path = STAND_INS) -> ModuleType:
    """Import a module of MicroPython's stand-ins."""
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@contextmanager
def imported(**modules: ModuleType) -> Iterator[None]:
    """Let modules be imported by these names."""
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def ticks_diff(new: int, old: int) -> int:
    """Return the difference of two values of the counter, as MicroPython has it."""
    return (new - old + TICKS // 2) % TICKS - TICKS // 2


class Transfers:
    """Port of the I2C transfers, as `board.I2cPort`; the emulated chips answer later."""

    def __init__(self) -> None:
        self.received = self.sent = b""

    def read(self) -> bytes:
        data, self.received = self.received, b""
        return data

    def write(self, data: bytes) -> None:
        self.sent += data

    def take(self) -> bytes:
        data, self.sent = self.sent, b""
        return data


class BoardFirmware:
    """The firmware behind `UartPort`s, with the interface of `Firmware`."""

    def __init__(
        self, boot: int, now_us: int, model: ServoModel, echo: bool, record: list[str], pulses: pwm.Pulses | None = None
    ) -> None:
        machine, self._record, self._echo = stand_in("machine"), record, echo
        self._now_us = now_us
        self._clock = board.Clock(self._ticks, ticks_diff)
        servo, rate = model.name, model.bus_rate
        values = {**vars(config), "SERVO": servo, "BAUD_RATE": rate, "ECHO": echo, "DIRECTION": None if echo else 6}
        if pulses:
            values["PULSES"] = pulses.of_board
        settings = SimpleNamespace(**{**values, "HOST_UART": 0, "HOST_TX": 0, "HOST_RX": 1})
        self._host = board.open_host(machine, settings, None)
        self._computer = self._host._uart  # type: ignore[attr-defined]
        if pulses and pulses.board == "pca9685":
            self._bus = self._servos = Transfers()
        else:
            self._bus = board.open_bus(machine, settings)
            self._servos = self._bus._uart
            self._servos.pin = self._bus._direction
        self._began_us = now_us
        self.firmware = board.start(settings, boot, self._clock.now_us())
        words = " ".join(map(str, pulses.of_board)) if pulses else ""
        record.append(f"B,{boot},{self._ticks()},{servo},{int(echo)},{rate},{words}")

    def _ticks(self) -> int:
        return (START_US + self._now_us) % TICKS

    @property
    def mode(self) -> int:
        return self.firmware.mode

    @property
    def due_us(self) -> int:
        return self._began_us + self.firmware.due_us

    def step(self, now_us: int, from_host: bytes = b"", from_bus: bytes = b"") -> tuple[bytes, bytes]:
        self._now_us = now_us
        self._computer.received += from_host
        self._servos.received += from_bus
        board.turn(self.firmware, self._clock, self._host, self._bus)
        to_host, to_bus = self._computer.take(), self._servos.take()
        if self._echo:
            self._servos.received += to_bus
        sent = (from_host, from_bus, to_host, to_bus)
        self._record.append(",".join(["T", str(self._ticks()), *(data.hex() for data in sent)]))
        return to_host, to_bus


class RecordedBoard(Board):
    """Simulated board that runs the firmware behind its ports, and records all turns."""

    def __init__(self, bus: BusFaults, model: ServoModel, echo: bool, pulses: pwm.Pulses | None = None) -> None:
        self.record: list[str] = []
        self._echoes = echo
        super().__init__(bus, model=model, pulses=pulses)

    def _boot(self, now_ns: int) -> Any:
        return BoardFirmware(self.boots, now_ns // 1000, self._model, self._echoes, self.record, self._pulses)


class FirmwareRig:
    """Servos, the board in front of them, and the actuator's driver."""

    def __init__(self, model: ServoModel, count: int = 6, echo: bool = False) -> None:
        ids = list(range(1, count + 1))
        self.now_ns, self.model, self.count = 0, model, count
        self.bank = ServoBank(ids, model)
        settings = {model.table.baud_rate: model.rate_code(model.bus_rate), **model.joint_settings}
        for row in range(count):
            for register, value in settings.items():
                self.bank.write(row, register.address, register.encode(value))
        self.faults = BusFaults(ServoBusEmulator(self.bank, BusTiming(model.bus_rate, 0)), self.bank)
        self.board = RecordedBoard(self.faults, model, echo)
        self.port = MemoryPort(self.board, lambda: self.now_ns, READ_NS * 1e-9)
        self._read, self._write = self.port.read, self.port.write
        self.driver = Bridge(self.port, ids, self.port.now_ns, model=model)

    def tamper(self, change: Callable[[bytes], bytes] | None) -> None:
        """Change all bytes between host and board, or end that."""
        if change is None:
            self.port.read, self.port.write = self._read, self._write  # type: ignore[method-assign]
        else:
            self.port.read = lambda size=1, /: change(self._read(size))  # type: ignore[method-assign]
            self.port.write = lambda data, /: self._write(change(data))  # type: ignore[method-assign]

    def inject(self, target: str, kind: str, for_s: float, **more: Any) -> None:
        """Break the servo bus for a time."""
        self.faults.inject(BusFault(target, kind, 0.0, for_s, **more), self.now_ns)  # type: ignore[arg-type]

    def limit_torque(self, ticks: int) -> None:
        """Send the bridge's message that sets the torque limit register of all servos."""
        share = round(ticks * self.model.units.torque / LOAD)
        self.driver._send(Limits(*self.driver._head(), (share,) * self.count))

    def registers(self, name: str) -> list[int]:
        """Return a register of all servos, by its role in the control table."""
        register = getattr(self.model.table, name)
        return [register.decode(self.bank.read(row, register.address, register.size)) for row in range(self.count)]

    def cycle(self, count: int, goals: float | None = None) -> None:
        """Run cycles of an actuator that sends goals [rad] for all servos; without goals it only reads."""
        for _ in range(count):
            self.now_ns = max(self.now_ns + PERIOD_NS, self.port.now_ns())
            self.board.advance(self.now_ns)
            on = np.array(self.registers("torque_enable"), dtype=bool)
            aims = np.array([self.model.units.angle(ticks) for ticks in self.registers("goal_position")])
            self.bank.step(np.where(on, aims, self.bank._q), np.zeros(self.count), np.zeros(self.count), PERIOD_NS * 1e-9)
            self.driver.poll(6_500_000)
            if goals is not None:
                ticks = self.model.units.ticks(goals) + np.arange(self.count)
                self.driver.sync_write_goals(np.minimum(ticks, self.model.units.max_position))


def exchange(model: ServoModel, echo: bool = False, seed: int = 5) -> FirmwareRig:
    """Return a rig after a session with every fault that the bridge has to survive; the robot keeps its torque until the end.

    Bytes are lost and broken on both lines, the host is silent, the board restarts, and servos do not answer.
    """
    rig, rng = FirmwareRig(model, echo=echo), np.random.default_rng(seed)

    def breaks(data: bytes) -> bytes:
        out = bytearray(byte for byte in data if rng.random() > 0.005)
        for at in np.flatnonzero(rng.random(len(out)) < 0.01):
            out[at] ^= int(rng.integers(1, 256))
        return bytes(out)

    rig.driver.setup()
    rig.cycle(4, 0.0)
    rig.driver.set_torque(True)
    rig.cycle(4, 0.0)
    rig.cycle(10, 0.12)
    rig.limit_torque(700)
    rig.inject("bytes", "garbage", 0.3, share=0.02)
    rig.cycle(16, 0.2)
    rig.inject("bytes", "silent", 0.2, share=0.02)
    rig.cycle(12, 0.1)
    rig.inject("servo", "silent", 0.2, servo=3)
    rig.cycle(14, 0.15)
    rig.tamper(breaks)
    rig.cycle(30, 0.2)
    rig.tamper(None)
    rig.cycle(20)  # the host is silent: the board holds
    rig.cycle(30, -0.4)  # it catches up
    rig.board.restart(rig.port.now_ns())
    rig.cycle(50, -0.4)
    assert rig.registers("torque_enable") == [1] * rig.count
    rig.driver.set_torque(False)
    rig.cycle(4, -0.4)
    return rig


def exchange_pulses(board_of_pulses: pwm.Board, seed: int = 5) -> RecordedBoard:
    """Return a microcontroller with hobby servos at two PCA9685 or a Maestro after a session with faults, as `exchange`."""
    profile = load_profile("printed_ds3218")
    assert profile.servo.pulses is not None
    pulses = replace(profile.servo.pulses, board=board_of_pulses)
    channels, rng = (0, 1, 2, 16, 17, 18), np.random.default_rng(seed)
    bank = make_servo_bank(replace(profile.servo, pulses=pulses), channels, np.zeros(6))
    chips = make_board(bank, pulses, on_uart=True)
    faults = BusFaults(chips, bank)
    made = RecordedBoard(faults, bank.model, echo=False, pulses=pulses)
    now_ns = 0
    port = MemoryPort(made, lambda: now_ns, READ_NS * 1e-9)
    driver = PulseBridge(port, channels, port.now_ns, pulses)
    read, write, centre = port.read, port.write, bank.model.units.centre

    def breaks(data: bytes) -> bytes:
        return bytes(byte ^ (rng.random() < 0.01) * int(rng.integers(1, 256)) for byte in data)

    def cycle(count: int, goal: int | None = None) -> None:
        nonlocal now_ns
        for _ in range(count):
            now_ns = max(now_ns + PERIOD_NS, port.now_ns())
            made.advance(now_ns)
            driver.poll(6_500_000)
            if goal is not None:
                driver.sync_write_goals(np.full(6, centre + goal), 50 if goal < 0 else 0)

    def torque() -> int:
        return int(bank.column(pwm.TABLE.torque_enable).sum())

    driver.setup()
    cycle(4, 100)
    driver.set_torque(True)
    cycle(90, 100)
    assert torque() == 6
    cycle(10, 300)
    faults.inject(BusFault("bus", "silent", 0.0, 0.2), now_ns)
    cycle(30, 200)
    port.read, port.write = lambda size=1, /: breaks(read(size)), lambda data, /: write(breaks(data))  # type: ignore[method-assign]
    cycle(30, 250)
    port.read, port.write = read, write  # type: ignore[method-assign]
    cycle(20)  # the host is silent: the board holds
    cycle(60, -600)  # it catches up
    made.restart(port.now_ns())
    cycle(50, -600)
    assert torque() == 6
    chips.restart(now_ns)
    cycle(30, -600)
    assert torque() == 0
    driver.set_torque(True)
    cycle(90, -600)
    assert torque() == 6
    driver.set_torque(False)
    cycle(4, -600)
    assert torque() == 0
    return made
