"""A driver of hobby servos, a microcontroller, and the boards that send pulses, in virtual time."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.servo_bus.bridge_link import READ_NS
from sextant.services.actuator.servo_bus.pulse_bridge import PulseBridge
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo.bridge_protocol import Mode
from sextant.shared.servo.firmware.pulses import LEG_US
from sextant.shared.servo.pwm import TABLE, Pulses
from sextant.shared.servo.pwm import Board as PulseBoard

PERIOD_NS, BUDGET_NS = 20_000_000, 6_500_000
CENTRE, NEAR_TICKS = 4000, 10  # a count of a PCA9685 is 4.9 us, 20 ticks
PROFILE = load_profile("printed_ds3218")
assert PROFILE.servo.pulses is not None
PULSES: dict[PulseBoard, Pulses] = {
    "pca9685": replace(PROFILE.servo.pulses, board="pca9685"),
    "maestro": replace(PROFILE.servo.pulses, board="maestro"),
}
BOARDS = pytest.mark.parametrize("pulses", PULSES.values(), ids=PULSES)


class Rig:
    """18 servos at two PCA9685 or a Maestro in virtual time, with a microcontroller, and a driver."""

    def __init__(
        self, pulses: Pulses, torque: bool = False, spread: bool = False, start: int | np.ndarray = CENTRE + 100
    ) -> None:
        self.channels = (*range(9), *range(15, 24)) if spread else tuple(range(18))
        self.pulses, self.own = pulses, replace(PROFILE, servo=replace(PROFILE.servo, pulses=pulses))
        self.bank = make_servo_bank(self.own.servo, self.channels, np.zeros(18))
        self.bank.column(TABLE.torque_enable)[:] = torque
        self.bank.column(TABLE.goal_position)[:] = start
        self.chips = make_board(self.bank, pulses, on_uart=True)
        self.faults = BusFaults(self.chips, self.bank)
        self.board = Board(self.faults, model=self.bank.model, pulses=pulses)
        self.now_ns = 0
        self.most_at_once = 0  # servos that got torque in one cycle
        self.plug_in()

    def plug_in(self) -> None:
        """Connect a new driver to a new port."""
        self.port = MemoryPort(self.board, lambda: self.now_ns, READ_NS * 1e-9)
        self.driver = PulseBridge(self.port, self.channels, self.port.now_ns, self.pulses)

    def cycle(self, count: int = 1, goals: int | np.ndarray | None = None, speed: int = 0) -> None:
        """Run control cycles of an actuator: read, and send goals [ticks] if any."""
        for _ in range(count):
            before = self.torque
            self.now_ns = max(self.now_ns + PERIOD_NS, self.port.now_ns())
            self.board.advance(self.now_ns)
            self.most_at_once = max(self.most_at_once, self.torque - before)
            assert self.driver.poll(BUDGET_NS) == []
            if goals is not None:
                self.driver.sync_write_goals(np.broadcast_to(goals, (18,)), speed)

    def on(self, goals: int = CENTRE) -> "Rig":
        self.driver.setup()
        self.cycle(3, goals)
        self.driver.set_torque(True)
        self.cycle(round(7 * LEG_US * 1000 / PERIOD_NS), goals)
        assert (self.mode, self.torque, self.driver.trouble) == (Mode.ON, 18, "")
        return self

    @property
    def torque(self) -> int:
        return int(self.bank.column(TABLE.torque_enable).sum())

    @property
    def goals(self) -> np.ndarray:
        return self.bank.column(TABLE.goal_position).astype(int)

    @property
    def mode(self) -> Mode:
        assert self.driver.state is not None
        return self.driver.state.mode
