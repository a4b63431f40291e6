"""Fault grid of the servo bus emulator: faults of the servos and their bus.

There are six kinds of faults on four targets, and fault conditions of servos and battery. `GRID` defines the meaning and the
parameters of each cell. A parameter that a cell does not use is an error.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

from sextant.shared.files import config
from sextant.shared.wire.messages import BrokenPart, FaultCommand, FaultKind, FaultTarget


class Cell(NamedTuple):
    """One cell of the grid."""

    means: str  # description of the fault
    takes: tuple[str, ...] = ()  # parameters of `BusFault` besides its times
    needs_servo: bool = False


def _of_servo(means: str, *takes: str) -> Cell:
    return Cell(means, ("servo", *takes), needs_servo=True)


_PACKETS, _WINDOWS, _OF_BUS = ("share", "servo"), ("on_ms", "off_ms"), "servo"
GRID: Mapping[tuple[FaultTarget, FaultKind], Cell] = MappingProxyType(
    {
        ("bytes", "silent"): Cell("a share of the bytes is lost, both ways", ("share",)),
        ("bytes", "stuck"): Cell("a share of the bytes is replaced by one value, both ways", ("share", "value")),
        ("bytes", "garbage"): Cell("a share of the bytes is replaced by random bytes, both ways", ("share",)),
        ("bytes", "wrong"): Cell("a share of the bytes has one bit flipped, both ways", ("share",)),
        ("bytes", "slow"): Cell(
            "a share of the bytes from servos arrives late, and all bytes behind them", ("share", "delay_ms")
        ),
        ("bytes", "intermittent"): Cell("bursts: every byte is random for a while, both ways", _WINDOWS),
        ("packets", "silent"): Cell("a share of the answers is lost", _PACKETS),
        ("packets", "stuck"): Cell("a share of the answers is replaced by the servo's previous answer", _PACKETS),
        ("packets", "garbage"): Cell("noise precedes a share of the answers", _PACKETS),
        ("packets", "wrong"): Cell(
            "a share of the answers is wrong: in one part, with a correct checksum, or in two bits or bytes",
            (*_PACKETS, "part"),
        ),
        ("packets", "slow"): Cell("a share of the answers arrives late", (*_PACKETS, "delay_ms")),
        ("packets", "intermittent"): Cell("for a while every answer is lost", ("servo", *_WINDOWS)),
        ("servo", "silent"): _of_servo(
            "it neither receives nor answers; with its cable pulled it has no power either", "cable"
        ),
        ("servo", "stuck"): _of_servo("its position register does not change; the joint moves"),
        ("servo", "jammed"): _of_servo("its joint does not move; its readings are correct"),
        ("servo", "garbage"): _of_servo("its answers are random bytes"),
        ("servo", "wrong"): _of_servo("its position register is off", "offset_ticks"),
        ("servo", "slow"): _of_servo("its answers arrive late", "delay_ms"),
        ("servo", "intermittent"): _of_servo("a loose cable: silent for a while, again and again", *_WINDOWS, "cable"),
        ("servo", "overload"): _of_servo("it has latched an overload, and latches it again until the end"),
        ("servo", "heat"): _of_servo("its motor is heated from outside", "kelvin_per_s"),
        ("servo", "hot"): _of_servo("its temperature register has a fixed value", "celsius"),
        ("servo", "slipped"): _of_servo("its horn slips: the link turns against it, within a fifth of a second", "degrees"),
        ("servo", "jump"): _of_servo("its encoder jumps, and the servo moves its link accordingly", "degrees"),
        ("servo", "drift"): _of_servo("its encoder drifts, and the servo moves its link accordingly", "deg_per_s"),
        ("servo", "bit"): _of_servo("one bit of its goal register is stuck at 0, or at 1 if `value` is not 0", "bit", "value"),
        ("servo", "sign"): _of_servo("its load register has the wrong sign"),
        ("servo", "weak"): _of_servo("its motor has only a share of its torque; its load register does not show that", "share"),
        ("bus", "silent"): Cell(
            "the adapter has no power: no bytes pass in either direction; servos hold their goals", (_OF_BUS,)
        ),
        ("bus", "stuck"): Cell("the line is stuck: one byte repeats endlessly, servos receive nothing", (_OF_BUS, "value")),
        ("bus", "garbage"): Cell("random bytes arrive endlessly, servos receive nothing", (_OF_BUS,)),
        ("bus", "wrong"): Cell("every answer is that of the previous request", (_OF_BUS,)),
        ("bus", "slow"): Cell(
            "every answer arrives late, as from a USB adapter with its default latency timer", (_OF_BUS, "delay_ms")
        ),
        ("bus", "intermittent"): Cell("silent for a while, again and again", (_OF_BUS, *_WINDOWS)),
        ("bus", "gone"): Cell("the port disappears, and returns, optionally under another name", (_OF_BUS, "renamed")),
        ("supply", "sag"): Cell("the voltage is lower", ("volts",)),
        ("supply", "drain"): Cell("the battery drains steadily from the beginning to the end"),
    }
)


# Cells that hobby servos and the board of their pulses have. Such servos report nothing, and nothing measures their supply.
WITHOUT_FEEDBACK: frozenset[tuple[FaultTarget, FaultKind]] = frozenset(
    (target, kind)
    for target, kind in GRID
    if target in ("bytes", "bus")
    or (target == "packets" and kind != "wrong")
    or (target == "servo" and kind in ("silent", "intermittent", "jammed", "slipped", "jump", "drift", "weak"))
)


def _off_the_grid(target: FaultTarget, kind: FaultKind) -> Iterator[config.Misfit]:
    if (target, kind) not in GRID:
        known = ", ".join(k for t, k in GRID if t == target)
        yield config.Misfit("kind", f"one of {known} for target = {target!r}", repr(kind))


def _meaningless(target: FaultTarget, kind: FaultKind, *values: object) -> Iterator[config.Misfit]:
    """Yield parameters that a cell of the grid does not use, and a missing servo id."""
    cell = GRID.get((target, kind))
    if cell is None:
        return
    defaults = {field.name: field.default for field in dataclasses.fields(BusFault)}
    for name, value in zip(_PARAMETERS, values, strict=True):
        if name not in cell.takes and value != defaults[name]:
            yield config.Misfit(name, f"none for {target} {kind}", repr(value))
        elif name == "servo" and cell.needs_servo and value == defaults[name]:
            yield config.Misfit(name, f"the bus id of a servo, 0 to 253, for {target} {kind}", repr(value))


_PARAMETERS = (
    *("servo", "share", "value", "part", "delay_ms", "on_ms", "off_ms"),
    *("cable", "offset_ticks", "kelvin_per_s", "celsius", "degrees", "deg_per_s", "bit", "renamed", "volts"),
)


@dataclass(frozen=True, slots=True)
class BusFault:
    """Temporary fault of the servos or their bus.

    Target and kind define its meaning, and which parameters it takes.
    """

    target: FaultTarget  # what fails
    kind: FaultKind  # how it fails
    at_s: float  # [s] simulated start time; a past time means at once
    for_s: float = 2.0  # [s] duration
    servo: int = -1  # bus id; with packets, -1 for all servos; with bus, that of a servo on it, -1 for all buses
    share: float = 0.01  # [1] of the affected bytes or responses; of the torque of a weak servo
    value: int = 0  # of a byte, or of a bit
    part: BrokenPart = "value"  # part of the response that is wrong
    delay_ms: float = 16.0  # [ms] of a response
    on_ms: float = 200.0  # [ms] healthy part of the cycle
    off_ms: float = 50.0  # [ms] faulty part of the cycle, after the healthy one
    cable: bool = False  # True: the servo loses its power too; afterwards torque is off and its RAM is reset
    offset_ticks: int = 100  # [ticks] of the position register
    kelvin_per_s: float = 1.0  # [K/s] heating rate
    celsius: int = 85  # [deg C] value of the temperature register
    degrees: float = 20.0  # [deg] by which the horn slips or the encoder jumps, in the direction of growing servo angles
    deg_per_s: float = 2.0  # [deg/s] drift of the encoder
    bit: int = 6  # of the goal register, 0 to 9, or 11 with 4096 positions; bit 6 is 19 deg of an AX-12A
    renamed: bool = False  # True: the port returns under another name
    volts: float = 2.0  # [V] voltage drop

    checks = (
        *config.each("at_s", lambda at: 0 <= at <= 1e6, "a time from 0 to 1000000 s"),
        *config.each("for_s", lambda length: 0 < length <= 1e6, "more than 0 and at most 1000000 s"),
        config.Check(("target", "kind"), _off_the_grid),
        *config.each("servo", lambda servo: -1 <= servo <= 253, "a servo id from 0 to 253, or -1 for none in particular,"),
        *config.each("share", lambda share: 0 < share <= 1, "a share above 0, at most 1,"),
        *config.each("value", lambda value: 0 <= value <= 255, "a byte, 0 to 255,"),
        *config.each("delay_ms on_ms off_ms", lambda time: 0 < time <= 60_000, "more than 0 and at most 60000 ms"),
        *config.each("offset_ticks", lambda ticks: 0 < abs(ticks) <= 4095, "-4095 to 4095 ticks, not 0,"),
        *config.each("kelvin_per_s", lambda rate: 0 < rate <= 100, "more than 0 and at most 100 K/s"),
        *config.each("celsius", lambda celsius: 0 <= celsius <= 255, "0 to 255 deg C"),
        *config.each("degrees", lambda angle: 0 < abs(angle) <= 90, "-90 to 90 deg, not 0,"),
        *config.each("deg_per_s", lambda rate: 0 < abs(rate) <= 1000, "-1000 to 1000 deg/s, not 0,"),
        *config.each("bit", lambda bit: 0 <= bit <= 11, "a bit from 0 to 11"),
        *config.each("volts", lambda volts: 0 < volts <= 20, "more than 0 and at most 20 V"),
        config.Check(("target", "kind", *_PARAMETERS), _meaningless),
    )

    def __post_init__(self) -> None:
        config.verify(self)

    def __str__(self) -> str:
        takes = GRID[self.target, self.kind].takes
        given = (f"{name} {getattr(self, name)}" for name in takes if name != "servo" or self.servo >= 0)
        return ", ".join((f"{self.target} {self.kind}", *given))

    def command(self, stamp_ns: int) -> FaultCommand:
        """Return the message that makes the simulator inject this fault."""
        return FaultCommand(stamp_ns, **{field.name: getattr(self, field.name) for field in dataclasses.fields(self)})

    @classmethod
    def of(cls, command: FaultCommand) -> "BusFault":
        """Return the fault that a message requests.

        Raises:
            ValueError: The fault is invalid; the text lists all errors.
        """
        return cls(**{field.name: getattr(command, field.name) for field in dataclasses.fields(cls)})
