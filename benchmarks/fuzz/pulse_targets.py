"""Fuzz targets of the boards that send pulses: what a board receives, and its answers to the driver."""

import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from random import Random

import numpy as np

from benchmarks.fuzz.mutators import broken
from benchmarks.fuzz.target import Target
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError
from sextant.services.actuator.servo_bus.pwm_servos import PwmServos
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.servo import Servo
from sextant.shared.servo import maestro, pca9685
from sextant.shared.servo.pwm import Board, Pulses

_CHANNELS = (0, 1, 17)
_CYCLE_NS = 20_000_000
_BUDGET_NS = 5_000_000
_CYCLES = 3
_WIDTHS = (0, 600, 1500, 2400)  # [us] of valid answers
_WIDTH = struct.Struct("<HH")  # answer of a Maestro: errors, and the pulse width [quarter us]


def pulse_targets() -> tuple[Target, ...]:
    """Return the targets: a Maestro and two PCA9685."""
    servo = load_profile("printed_ds3218").servo
    assert servo.pulses is not None
    found = []
    boards: tuple[tuple[Board, str, tuple[bytes, ...]], ...] = (
        ("maestro", "Maestro", _commands()),
        ("pca9685", "PCA9685", _transfers()),
    )
    for board, name, commands in boards:
        pulses = replace(servo.pulses, board=board)
        sessions = tuple(_session(pulses, width) for width in _WIDTHS)
        found.append(Target(f"pulse board, {name}", (*sessions, *commands), _odd_session, _taker(servo, pulses)))
    return tuple(found)


def _commands() -> tuple[bytes, ...]:
    """Return commands of the host to a Maestro."""
    return (
        maestro.get_errors() + maestro.get_position(1) + maestro.set_target(17, 6000),
        maestro.set_multiple_targets(0, [6000, 0, 7000]) + maestro.set_speed(1, 20, maestro.DEVICE) + maestro.go_home(),
    )


def _transfers() -> tuple[bytes, ...]:
    """Return encoded transfers of the host with two PCA9685."""
    reads = (pca9685.read(pca9685.ADDRESS, register, 1) for register in (pca9685.MODE1, pca9685.PRE_SCALE))
    pulses = pca9685.write(pca9685.ADDRESS + 1, pca9685.LED0, pca9685.channel_registers(307))
    return (b"".join(map(pca9685.frame, (*reads, pulses))),)


def _session(pulses: Pulses, width_us: int) -> bytes:
    """Return the answers of a board to a starting driver and to its questions in some cycles, with pulses of one width."""
    asked = len(_CHANNELS) + _CYCLES
    if pulses.board == "maestro":
        return bytes(2) + asked * _WIDTH.pack(0, 4 * width_us)
    hertz = pulses.oscillator_mhz * 1e6
    scale = pca9685.pre_scale(pulses.rate_hz, hertz)
    mode = pca9685.answer(bytes((pca9685.AWAKE,)))
    count = round(width_us / pca9685.count_us(scale, hertz))
    boards = len({channel // pca9685.CHANNELS for channel in _CHANNELS})
    registers = pca9685.answer(pca9685.channel_registers(count))
    return boards * (mode + pca9685.answer(bytes((scale,)))) + asked * (mode + registers)


def _odd_session(data: bytes, rng: Random) -> bytes:
    """Change a few bytes of a session, or break it off."""
    changed = bytearray(data)
    for _ in range(rng.randrange(1, 4)):
        changed[rng.randrange(len(changed))] = rng.getrandbits(8)
    return bytes(changed) if rng.random() < 0.7 else broken(data, (data,), rng)


class _Port:
    """Port on which the answers of a session arrive in turn, for any request."""

    timeout: float | None = 0.006

    def __init__(self, session: bytes) -> None:
        self.now_ns, self.sent, self._left = 0, bytearray(), session

    @property
    def in_waiting(self) -> int:
        return 0

    def write(self, data: bytes) -> int:
        self.sent += data
        return len(data)

    def read(self, size: int = 1) -> bytes:
        self.now_ns += 1_000_000
        found, self._left = self._left[:size], self._left[size:]
        return found

    def reset_input_buffer(self) -> None: ...

    def close(self) -> None: ...


def _taker(servo: Servo, pulses: Pulses) -> Callable[[bytes], bool]:
    """Return a function that gives bytes to an emulated board, and to the driver as answers; it returns whether that starts.

    For any answer, the driver sends only pulses within the range of the servos, and none to servos that had none before torque
    was ordered on.
    """
    bank = make_servo_bank(replace(servo, pulses=pulses), list(_CHANNELS), np.zeros(len(_CHANNELS)))
    start = bank.tables.copy()

    def take(data: bytes) -> bool:
        bank.tables[:] = start
        board = make_board(bank, pulses)
        for half in (data[: len(data) // 2], data[len(data) // 2 :]):
            board.receive(half, _CYCLE_NS)
        board.advance(10 * _CYCLE_NS)
        port = _Port(data)
        driver = PwmServos(port, _CHANNELS, lambda: port.now_ns, pulses)
        try:
            driver.setup()
        except BusSetupError:
            return False
        had_pulses = {channel for channel, has in zip(_CHANNELS, driver._enabled.tolist(), strict=True) if has}
        for _ in range(_CYCLES):
            driver.poll(_BUDGET_NS)
            driver.sync_write_goals(np.full(len(_CHANNELS), driver.model.units.centre), 100)
            port.now_ns += _CYCLE_NS
        if woken := {channel for channel, width_us in _pulses(bytes(port.sent), pulses) if width_us} - had_pulses:
            raise AssertionError(f"pulses on the channels {had_pulses} only expected, found some on {woken}")
        driver.set_torque(True)
        most_us = pulses.range_us + 5.0  # with the rounding of a PCA9685
        widths = [width_us for _, width_us in _pulses(bytes(port.sent), pulses) if width_us]
        if any(abs(width_us - pulses.centre_us) > most_us for width_us in widths):
            raise AssertionError(f"pulses of {pulses.centre_us:g} +- {pulses.range_us:g} us expected, found {widths}")
        return True

    return take


def _pulses(sent: bytes, pulses: Pulses) -> Iterator[tuple[int, float]]:
    """Yield channel and pulse width [us] of all orders of the driver, 0 for no pulses."""
    if pulses.board == "maestro":
        for packet in maestro.CommandParser().feed(sent):
            if packet.command is maestro.Command.SET_MULTIPLE_TARGETS:
                _, first, *row = packet.data
                yield from ((first + k, maestro.value(*row[2 * k : 2 * k + 2]) / 4.0) for k in range(len(row) // 2))
        return
    hertz = pulses.oscillator_mhz * 1e6
    count_us = pca9685.count_us(pca9685.pre_scale(pulses.rate_hz, hertz), hertz)
    last = pca9685.LED0 + 4 * pca9685.CHANNELS
    for address, data, size in pca9685.FrameParser().feed(sent):
        if not size and pca9685.LED0 <= data[0] < last:
            first = (address - pca9685.ADDRESS) * pca9685.CHANNELS + (data[0] - pca9685.LED0) // 4
            yield from (
                (first + k, pca9685.pulse_count(data[1 + 4 * k : 5 + 4 * k]) * count_us) for k in range((len(data) - 1) // 4)
            )
