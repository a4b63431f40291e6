"""Emulated workbench with single servos or a whole robot on a stand.

Single servos are new and are plugged in one by one. The workbench has the same bus and servos as the simulator, but no physics:
a joint follows its motor, and with torque off it stays where the operator has bent it. Time advances with the host's transfers;
there is neither a thread nor another clock.
"""

import re
from collections.abc import Iterable
from dataclasses import replace
from datetime import date

import numpy as np

from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.motors import Supply
from sextant.services.simulator.servo_bus.pulse_bench import PulseBench
from sextant.services.simulator.servo_bus.servo_bank import ServoVariation
from sextant.services.simulator.servo_bus.servo_banks import make_robot_servos
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import JOINTS, LEGS, Calibration, RobotProfile
from sextant.shared.servo.servo_model import Access, Register

HORNS_DEG = 6.0  # [deg] maximum mounting error of the servo horns
_MAX_BEND_DEG = 150.0  # [deg] maximum angle of a bent joint, the measuring range of a servo
_STEP_NS = 4_000_000  # [ns] time step of the joints
_MAX_CATCH_UP_NS = 2_000_000_000  # [ns] maximum time to simulate after a pause, in which all joints come to rest
_MAX_RATE_ERROR = 0.03  # [1] relative difference of two baud rates up to which bytes are received correctly


class BenchEmulator(ServoBusEmulator):
    """Bus with all servos of a robot, of which any number is plugged in."""

    commands = "plug [N], unplug [ID], bend LEG COXA FEMUR TIBIA (degrees), list, quit"  # that `execute` accepts

    def __init__(
        self,
        profile: RobotProfile,
        rng: np.random.Generator,
        *,
        fresh: bool = False,
        rate: int | None = None,
        echo: bool = False,
        bus: int = 0,
    ):
        """Create the servos.

        Args:
            profile: The robot that the servos belong to.
            rng: Generator of the horns' mounting errors and of the shaft angles of new servos.
            fresh: True for servos with factory settings, none plugged in; False for a configured robot with torque off.
            rate: Baud rate of the host [bit/s], see `set_baud_rate`; None, as of a network port, reaches all servos.
            echo: Whether the adapter echoes all sent bytes.
            bus: Index of the bus, of a robot with several.
        """
        trims = rng.uniform(-HORNS_DEG, HORNS_DEG, (len(LEGS), 3)).round(1)
        entries = [Calibration(leg, date.min, (c, f, t)) for leg, (c, f, t) in zip(LEGS, trims.tolist(), strict=True)]
        self.robot = replace(profile, calibration=tuple(entries))  # with the true mounting errors
        n, rows = profile.servo_ids.size, list(profile.servos.buses[bus].rows)
        q = rng.uniform(-1.0, 1.0, n) if fresh else self.robot.servo_angles(np.zeros((len(LEGS), 3))).ravel()
        exact = ServoVariation(np.ones(n), np.ones(n), np.zeros(n))
        self._servos = make_robot_servos(profile, q, Supply().capacity_ah, 1.0, exact).on_bus[bus]
        self._damping = profile.servos.damping.ravel()[rows]
        for row, (joint, model) in enumerate(zip(rows, map(self._servos.model_of, range(len(rows))), strict=True)):
            table = model.table
            set_up = {**model.joint_settings, **profile.servos.each[joint].controller_settings, **_limits(profile, joint)}
            set_up[table.baud_rate] = model.rate_code(model.bus_rate)
            for register, value in ({table.id: table.id.default} if fresh else set_up).items():
                self._servos.write(row, register.address, register.encode(value))
        self._plugged = set() if fresh else set(range(len(rows)))
        self._rate = rate
        self._now_ns = -1  # [ns] bus time up to which the joints have moved
        self._q, self._qd, self._torque = q[rows], np.zeros(len(rows)), np.zeros(len(rows))
        self._servos.step(self._q, self._qd, self._torque, _STEP_NS * 1e-9)  # compiles the code before the first packet ...
        self._servos.read(
            0, self._servos.table.state.address, self._servos.table.state.size
        )  # ... whose response must be in time
        super().__init__(self._servos, BusTiming(self._servos.model.bus_rate), echo=echo)

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Advance the joints to a time [ns], then process the bytes of the host."""
        self._catch_up(now_ns)
        return super().receive(data, now_ns)

    def set_baud_rate(self, rate: int | None) -> None:
        """Set the baud rate [bit/s] of the host."""
        self._rate = rate
        self._find_listeners()

    @property
    def unplugged(self) -> list[int]:
        """Rows of the servos that are not plugged in."""
        return [row for row in range(len(self._servos)) if row not in self._plugged]

    def plug(self, rows: Iterable[int]) -> None:
        """Plug servos in, which resets their RAM registers to factory values."""
        for row in rows:
            factory = self._servos.model_of(row).factory_table()
            for register in self._tables[row].registers:
                if not register.eeprom and register.access is Access.READ_WRITE:
                    self._servos.write(row, register.address, factory[register.address : register.address + register.size])
            self._plugged.add(row)
        self._find_listeners()

    def unplug(self, rows: Iterable[int]) -> None:
        """Unplug servos from the bus."""
        self._plugged -= set(rows)
        self._find_listeners()

    def bend(self, leg: int, pose: Array) -> None:
        """Bend a leg by hand to joint angles (3,) [rad].

        Servos with torque on move it back.
        """
        servo = self.robot.servo_angles(np.tile(pose, (len(LEGS), 1)))[leg]
        for servo_id, angle in zip(self.robot.servo_ids[leg], servo, strict=True):
            self._q[self._with_id(int(servo_id))] = angle
        self._servos.step(self._q, self._qd, self._torque, _STEP_NS * 1e-9)  # updates the measured values

    def execute(self, line: str) -> str:
        """Execute a command that the operator typed, and return the new state as text.

        Raises:
            ValueError: The command is invalid; the message lists the valid ones.
        """
        words = line.split()
        bend = re.fullmatch(r"bend (.+?)((?: +-?\d+(?:\.\d*)?){3})", line.strip())
        if words[:1] == ["plug"] and len(words) <= 2 and all(w.isdecimal() for w in words[1:]):
            self.plug(self.unplugged[: int(words[1]) if len(words) == 2 else 1])
        elif words[:1] == ["unplug"] and len(words) <= 2 and all(w.isdecimal() for w in words[1:]):
            rows = sorted(self._plugged)
            if len(words) == 2:  # one servo, also if several have the id
                rows = [row for row in rows if self._value(row, self._tables[row].id) == int(words[1])][-1:]
            if not rows:
                raise ValueError(f"the id of a servo that is plugged in expected, found {line.strip()!r}; `list` shows them")
            self.unplug(rows)
        elif bend and bend[1] in LEGS:
            pose = [float(angle) for angle in bend[2].split()]
            if max(map(abs, pose)) > _MAX_BEND_DEG:
                raise ValueError(f"angles of at most {_MAX_BEND_DEG:.0f} deg either way expected, found {line.strip()!r}")
            self.bend(LEGS.index(bend[1]), np.radians(pose))
            return f"the {bend[1]} leg is bent to {', '.join(bend[2].split())} deg ({', '.join(JOINTS)})"
        elif words != ["list"]:
            raise ValueError(f"one of {self.commands} expected, found {line.strip()!r}")
        ids = sorted(self._value(row, self._tables[row].id) for row in self._plugged)
        plugged = f"{len(ids)} {'servo is' if len(ids) == 1 else 'servos are'} plugged in"
        return f"{plugged}: {', '.join(map(str, ids)) or 'none'}; {len(self.unplugged)} not"

    def _with_id(self, servo_id: int) -> list[int]:
        return [row for row in range(len(self._servos)) if self._value(row, self._tables[row].id) == servo_id]

    def _hears(self, row: int) -> bool:
        rate = self._models[row].rates.get(self._value(row, self._tables[row].baud_rate), 0)
        return row in self._plugged and (self._rate is None or abs(rate - self._rate) <= _MAX_RATE_ERROR * self._rate)

    def _catch_up(self, now_ns: int) -> None:
        self._now_ns = max(self._now_ns, now_ns - _MAX_CATCH_UP_NS)
        while self._now_ns + _STEP_NS <= now_ns:
            self._now_ns += _STEP_NS
            self.advance(self._now_ns)
            command = self._servos.step(self._q, self._qd, self._torque, _STEP_NS * 1e-9)
            spring_torque = command.stiffness * (command.setpoint - self._q)
            self._torque = np.clip(spring_torque, -command.torque_limit, command.torque_limit)
            self._qd = self._torque / self._damping
            self._q = self._q + self._qd * (_STEP_NS * 1e-9)


def _limits(profile: RobotProfile, joint: int) -> dict[Register, int]:
    """Return the position limits that `sextant servos set-id` widens for a joint, by register."""
    model = profile.servos.models[joint]
    table, units = model.table, model.units
    low, high = sorted(units.ticks(profile.servo_angles(profile.joint_limits[..., end]).ravel()[joint]) for end in (0, 1))
    whole = {table.low_limit: 0} if low < model.default(table.low_limit) else {}
    return whole | ({table.high_limit: units.max_position} if high > model.default(table.high_limit) else {})


def make_bench(
    profile: RobotProfile, rng: np.random.Generator, *, fresh: bool = False, bus: int = 0
) -> BenchEmulator | PulseBench:
    """Return the workbench of a robot: its servo bus, or the board of its hobby servos, which have no settings."""
    if profile.servo.pulses is not None:
        return PulseBench(profile)
    return BenchEmulator(profile, rng, fresh=fresh, bus=bus)
