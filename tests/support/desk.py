"""Emulated servos on a workbench, reached in memory, in virtual time."""

from typing import Any

import numpy as np

from sextant.services.actuator.servo_bus.bus_driver import ServoBus
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.simulator.servo_bus.bench_emulator import BenchEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo.servo_model import Register

PHANTOMX = load_profile("phantomx_mk2")


class Desk:
    """A workbench, and ports to it that share one virtual time."""

    def __init__(
        self, profile: RobotProfile = PHANTOMX, *, fresh: bool = False, seed: int = 1, rate: int | None = -1, echo: bool = False
    ) -> None:
        self.profile = profile
        rate = profile.servo_model.bus_rate if rate == -1 else rate
        self.bench = BenchEmulator(profile, np.random.default_rng(seed), fresh=fresh, rate=rate, echo=echo)
        self.tables: Any = getattr(self.bench._servos, "tables", None)  # of servos of one model
        self.rates: list[int] = []  # rates at which a port was opened
        self.port = MemoryPort(self.bench, lambda: 0)

    def clock(self) -> int:
        return self.port.now_ns()

    def open(self, rate: int | None = None) -> MemoryPort:
        """Close the port, and open another to the same servos, possibly at another rate."""
        now = self.clock()
        self.port.close()
        self.port = MemoryPort(self.bench, lambda: now)
        rate = self.profile.servo_model.bus_rate if rate is None else rate
        self.rates.append(rate)
        if self.bench._rate is not None:
            self.bench.set_baud_rate(rate)
        return self.port

    def bus(self, *, echo: bool = False) -> ServoBus:
        names = self.profile.servo_names
        model, models = self.profile.servo_model, self.profile.servo_models
        return bus_of(model)(self.open(), list(names), self.clock, model=model, models=models, names=names, echo=echo)

    def settle(self) -> None:
        """Wait until written data has arrived and the joints are at rest."""
        for _ in range(100):
            self.port.read(1)
        self.bench.receive(b"", self.clock())

    def row(self, servo_id: int) -> int:
        """Return the row of the first servo that has this ID."""
        return self.bench._with_id(servo_id)[0]

    def change(self, servo_id: int, register: Register, value: int) -> None:
        """Change a value in a servo's table, bypassing the host."""
        self.bench._servos.write(self.row(servo_id), register.address, register.encode(value))
        self.bench._find_listeners()

    def reset(self, servo_id: int) -> None:
        """Reset a servo to its factory settings."""
        row = self.row(servo_id)
        position = self.tables[row, 36:38].copy()
        self.bench._servos.write(row, 0, self.bench._servos.model.factory_table())
        self.tables[row, 36:38] = position
        self.bench._find_listeners()
