"""Every cell of the fault grid with the servos of every family, and the driver that reads them."""

from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.shared.servo.bus_fault import GRID, BusFault
from tests.support.families import FAMILIES, MIXED, Bench

_CYCLE_S, _BUDGET_NS, _FOR_S = 0.02, 20_000_000, 0.6
_CELLS = [pytest.param(*cell, id=" ".join(cell)) for cell in GRID]
_SERVO = 2
_STEP_RAD = 0.004  # [rad] motion of a joint in a cycle, more than two ticks
# Faults with wrong positions in answers with a correct checksum, and those with old answers of a few cycles before.
_WRONG = (("servo", "stuck"), ("servo", "wrong"), ("packets", "wrong"))
_OLD = (("packets", "stuck"), ("bus", "wrong"), *((target, "slow") for target in ("bytes", "packets", "servo", "bus")))
_OLD_CYCLES = 3


class _FaultyBench(Bench):
    """Servos on a bus with one fault, whose adapter may echo."""

    def __init__(self, name: str, fault: BusFault, echo: bool) -> None:
        super().__init__(name)
        self.echo = echo
        self.emulator = ServoBusEmulator(self.servos, echo=echo)
        self.faults = BusFaults(self.emulator, self.servos, 1, [fault])
        self.connect()

    def connect(self) -> None:
        """Open the port."""
        self.port = MemoryPort(self.faults, lambda: self.now_ns, start_ns=self.now_ns)
        self.bus = self.driver(echo=self.echo)

    def cycle(self, q: np.ndarray) -> list[Any]:
        """Write goals and read the servos; without a port, try to open it again."""
        self.now_ns = max(self.now_ns + round(_CYCLE_S * 1e9), self.port.now_ns())
        self.faults.advance(self.now_ns)
        zero = np.zeros(len(self.ids))
        self.servos.set_joint_state(q, zero, zero, self.now_ns)
        self.command = self.servos.advance(_CYCLE_S)
        try:
            self.bus.sync_write_goals(self.ticks(q))
            return self.bus.poll(_BUDGET_NS)
        except BusDisconnectedError:
            with suppress(OSError):
                self.connect()
            return []


@pytest.mark.parametrize("echo", [False, True], ids=["plain", "echo"])
@pytest.mark.parametrize("name", [*FAMILIES, *MIXED])
@pytest.mark.parametrize(("target", "kind"), _CELLS)
def test_readings_are_correct_under_each_fault_and_return_after_it(target: Any, kind: Any, name: str, echo: bool) -> None:
    cell = GRID[target, kind]
    values: dict[str, Any] = {"servo": _SERVO} if cell.needs_servo else {}
    if "share" in cell.takes:
        values["share"] = 0.05
    fault = BusFault(target, kind, 0.3, _FOR_S, **values)
    bench, q = _FaultyBench(name, fault, echo), np.array([0.2, -0.3, 0.4])
    tick = bench.tick_rad
    off = tick + _OLD_CYCLES * _STEP_RAD * ((target, kind) in _OLD)
    bench.bus.setup()
    for _ in range(5):
        assert len(bench.cycle(q)) == 3
    bench.bus.set_torque(True)
    while bench.now_ns < (0.3 + _FOR_S) * 1e9:
        q = q + _STEP_RAD
        for one in bench.cycle(q):
            assert abs(one.position - q[one.index]) <= off or (target, kind) in _WRONG
    read, last = set[int](), bench.now_ns + 1_500_000_000
    while bench.now_ns < last:
        readings = bench.cycle(q)
        read |= {one.servo_id for one in readings}
    assert read == {1, 2, 3}
    assert all(abs(one.position - q[one.index]) <= tick for one in readings)
    if (target, kind) != ("servo", "overload"):
        assert (bench.command.torque_limit > 0.0).all()


def test_bit_that_a_goal_register_lacks_is_refused() -> None:
    fault = BusFault("servo", "bit", 0.0, servo=_SERVO, bit=10)
    _FaultyBench("STS3215", fault, False)
    with pytest.raises(ValueError, match="a bit from 0 to 9 of the goal register expected, found 10"):
        _FaultyBench("AX-12A", fault, False)
