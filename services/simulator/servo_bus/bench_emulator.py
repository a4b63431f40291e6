"""Servos on a workbench: a box of new ones to be plugged in one by one, or a whole robot on a stand, its legs in the air.

The same emulated bus and servos that walk in simulation, without a world around them: a joint follows its motor, and stays
where a hand has bent it while the servo is limp. Time passes as the host talks: no thread, and no other clock.
"""

import re
from collections.abc import Iterable
from dataclasses import replace
from datetime import date

import numpy as np

from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.servos import bank_of
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import JOINTS, LEGS, Calibration, RobotProfile
from sextant.shared.servo import dynamixel as dxl

HORNS_DEG = 6.0  # by which the horns of the emulated robot sit wrong, at most
_BENT_DEG = 150.0  # by hand, at most: as far as a servo can tell
_STEP_NS = 4_000_000
_PATIENCE_NS = 2_000_000_000  # what nobody looked at for longer has come to rest
_RAM = dxl.TORQUE_ENABLE.address  # from here on the control table is lost with the power
HELP = "plug [N], unplug [ID], bend LEG COXA FEMUR TIBIA (degrees), list, quit"


class Workbench(ServoBusEmulator):
    """A bus with a robot's worth of servos, some of them plugged in."""

    def __init__(
        self,
        profile: RobotProfile,
        rng: np.random.Generator,
        *,
        fresh: bool = False,
        rate: int | None = None,
        echo: bool = False,
    ):
        """Lay the servos out.

        Args:
            profile: What robot they are for.
            rng: By which the horns sit wrong, and the shafts of new servos stand.
            fresh: As they come from the factory, none plugged in; else built into the robot, set up, torque off.
            rate: [1/s] at which the host talks, see `tune`; None is heard by all, as a network port has no rate.
            echo: The adapter returns every byte sent.
        """
        trims = rng.uniform(-HORNS_DEG, HORNS_DEG, (len(LEGS), 3)).round(1)
        entries = [Calibration(leg, date.min, (c, f, t)) for leg, (c, f, t) in zip(LEGS, trims.tolist(), strict=True)]
        self.robot = replace(profile, calibration=tuple(entries))  # as its horns truly sit
        ids = list(profile.servo_names)
        q = rng.uniform(-1.0, 1.0, len(ids)) if fresh else self.robot.servo_angles(np.zeros((len(LEGS), 3))).ravel()
        self._servos = bank_of(profile.servo.model, ids, q)
        if fresh:
            self._servos.tables[:, dxl.ID.address] = dxl.ID.default
        else:
            self._servos.tables[:, dxl.RETURN_DELAY.address] = 0
            self._servos.tables[:, dxl.BAUD_RATE.address] = dxl.BAUD_RATE.default
        self._plugged = set() if fresh else set(range(len(ids)))
        self._rate = rate
        self._now_ns = -1  # of the joints
        self._q, self._qd, self._torque = q.copy(), np.zeros(len(ids)), np.zeros(len(ids))
        self._servos.step(self._q, self._qd, self._torque, _STEP_NS * 1e-9)  # compiled before the first packet comes ...
        self._servos.read(0, dxl.PRESENT_POSITION.address, dxl.PRESENT_POSITION.size)  # ... and is answered in time
        super().__init__(self._servos, BusTiming(), echo=echo)

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        """Take bytes from the host, after the joints have come to this time."""
        self._catch_up(now_ns)
        return super().receive(data, now_ns)

    def tune(self, rate: int | None) -> None:
        """Let the host talk at another baud rate [1/s]."""
        self._rate = rate
        self._find_listeners()

    @property
    def boxed(self) -> list[int]:
        """Rows of the servos that are not plugged in."""
        return [row for row in range(len(self._servos)) if row not in self._plugged]

    def plug(self, rows: Iterable[int]) -> None:
        """Plug servos in: power comes, and with it what they forget without."""
        for row in rows:
            factory = self._servos.model.factory_table()
            self._servos.write(row, _RAM, factory[_RAM : dxl.PRESENT_POSITION.address])
            self._servos.write(row, dxl.LOCK.address, factory[dxl.LOCK.address :])
            self._plugged.add(row)
        self._find_listeners()

    def unplug(self, rows: Iterable[int]) -> None:
        """Take servos off the bus."""
        self._plugged -= set(rows)
        self._find_listeners()

    def bend(self, leg: int, pose: Array) -> None:
        """Bend a leg by hand until its joints (3,) [rad] are as wanted; servos with torque on move back."""
        servo = self.robot.servo_angles(np.tile(pose, (len(LEGS), 1)))[leg]
        for servo_id, angle in zip(self.robot.servo_ids[leg], servo, strict=True):
            self._q[self._with_id(int(servo_id))] = angle
        self._servos.step(self._q, self._qd, self._torque, _STEP_NS * 1e-9)  # what they measure from now on

    def obey(self, line: str) -> str:
        """Do what is typed at the terminal, and tell in words what is there then.

        Raises:
            ValueError: What is typed is no order; the message says what would be one.
        """
        words = line.split()
        bend = re.fullmatch(r"bend (.+?)((?: +-?\d+(?:\.\d*)?){3})", line.strip())
        if words[:1] == ["plug"] and len(words) <= 2 and all(w.isdecimal() for w in words[1:]):
            self.plug(self.boxed[: int(words[1]) if len(words) == 2 else 1])
        elif words[:1] == ["unplug"] and len(words) <= 2 and all(w.isdecimal() for w in words[1:]):
            rows = self._with_id(int(words[1])) if len(words) == 2 else list(self._plugged)
            if not self._plugged.intersection(rows):
                raise ValueError(f"the id of a servo that is plugged in expected, found {line.strip()!r}; `list` shows them")
            self.unplug(rows)
        elif bend and bend[1] in LEGS:
            pose = [float(angle) for angle in bend[2].split()]
            if max(map(abs, pose)) > _BENT_DEG:
                raise ValueError(f"angles of at most {_BENT_DEG:.0f} deg either way expected, found {line.strip()!r}")
            self.bend(LEGS.index(bend[1]), np.radians(pose))
            return f"the {bend[1]} leg is bent to {', '.join(bend[2].split())} deg ({', '.join(JOINTS)})"
        elif words != ["list"]:
            raise ValueError(f"one of {HELP} expected, found {line.strip()!r}")
        ids = sorted(self._value(row, dxl.ID) for row in self._plugged)
        return f"{len(ids)} servos are plugged in: {', '.join(map(str, ids)) or 'none'}; {len(self.boxed)} are not"

    def _with_id(self, servo_id: int) -> list[int]:
        return [row for row in range(len(self._servos)) if self._value(row, dxl.ID) == servo_id]

    def _hears(self, row: int) -> bool:
        rate = dxl.baud_rate(self._value(row, dxl.BAUD_RATE))
        return row in self._plugged and (self._rate is None or abs(rate - self._rate) <= 0.03 * self._rate)

    def _catch_up(self, now_ns: int) -> None:
        self._now_ns = max(self._now_ns, now_ns - _PATIENCE_NS)
        while self._now_ns + _STEP_NS <= now_ns:
            self._now_ns += _STEP_NS
            self.advance(self._now_ns)
            command = self._servos.step(self._q, self._qd, self._torque, _STEP_NS * 1e-9)
            pull = command.stiffness * (command.setpoint - self._q)
            self._torque = np.clip(pull, -command.torque_limit, command.torque_limit)
            self._qd = self._torque / self.robot.servo.damping
            self._q = self._q + self._qd * (_STEP_NS * 1e-9)
