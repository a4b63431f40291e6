"""The joints on emulated servos that follow their goals, with a log of the bus."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus.joints import Joints
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.servo.dynamixel import Instruction, PacketParser
from sextant.shared.servo.servo_model import Packet, Register

PROFILE = load_profile("phantomx_mk2")
IDS = PROFILE.servo_ids.ravel().tolist()
STAND = PROFILE.servo_angles(body_inverse(PROFILE, PROFILE.rest_feet())).ravel()  # (18,) [rad]
PERIOD = 20_000_000
TICK = dxl.TICK_RAD
SERVO = 7  # row of a servo, 0 to 17
LEG, JOINT = divmod(SERVO, 3)


class Tap(BusFaults):
    """The bus with its faults, and a log of all packets from the host."""

    def __init__(self, bank: ServoBank) -> None:
        super().__init__(ServoBusEmulator(bank), bank)
        self.parser, self.said = PacketParser(), list[Packet]()

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        self.said += self.parser.feed(data)
        return super().receive(data, now_ns)


class JointsRig:
    """Servos that reach their goals within a cycle if their torque is on."""

    def __init__(self, torque: bool = True, off: Array | float = 0.0, opener: Callable[[], Any] | None = None) -> None:
        """Create servos whose goals differ from the joint positions by `off` (18,) [rad]."""
        self.now_ns = 0
        self.bank = ServoBank(IDS, q=STAND)
        for row, goal in enumerate(STAND + off):
            self.put(row, dxl.GOAL_POSITION, dxl.ticks_from_angle(goal))
            self.put(row, dxl.TORQUE_ENABLE, int(torque))
        self.bus = Tap(self.bank)
        self.device: Tap | Board = self.bus  # the device behind the port
        self.q = STAND.copy()
        self.port: MemoryPort | None = None
        self.opener = opener or self.plug_in
        self.jammed: set[int] = set()  # rows of servos that do not move

    def plug_in(self, name: int | None = None) -> MemoryPort:
        self.port = MemoryPort(self.bus, lambda: self.now_ns, name=name, start_ns=self.clock())
        return self.port

    def clock(self) -> int:
        return self.now_ns if self.port is None else self.port.now_ns()

    def start(self, settings: Settings | None = None) -> "JointsRig":
        self.joints = Joints(PROFILE, settings or Settings(), self.opener, self.clock)
        self.now_ns = self.clock()
        return self

    def put(self, row: int, register: Register, value: int) -> None:
        self.bank.write(row, register.address, register.encode(value))

    def registers(self, register: Register) -> list[int]:
        return [int.from_bytes(self.bank.read(row, register.address, register.size), "little") for row in range(18)]

    def suffer(self, target: str, kind: str, for_s: float, **more: Any) -> None:
        self.bus.inject(BusFault(target, kind, 0.0, for_s, **more), self.now_ns)  # type: ignore[arg-type]

    def cycle(self, count: int = 1, write: bool = False) -> None:
        for _ in range(count):
            self.now_ns = max(self.now_ns + PERIOD, self.clock())
            self.device.advance(self.now_ns)
            goals = np.array([dxl.angle_from_ticks(ticks) for ticks in self.registers(dxl.GOAL_POSITION)])
            pulls = np.array(self.registers(dxl.TORQUE_ENABLE)) * np.array(self.registers(dxl.TORQUE_LIMIT)) > 0
            moves = pulls & ~np.isin(np.arange(18), list(self.jammed))
            self.q = np.where(moves, goals, self.q)
            self.bank.step(self.q, np.zeros(18), np.zeros(18), PERIOD * 1e-9)
            self.joints.read([])
            if write:
                self.joints.write(self.joints.goals)

    def until(self, done: Callable[[], bool], write: bool = False) -> "JointsRig":
        for _ in range(400):
            if done():
                return self
            self.cycle(write=write)
        raise AssertionError("it has not come about within eight seconds")

    @property
    def measured(self) -> Array:
        return PROFILE.joint_angles(self.q.reshape(6, 3))

    @property
    def said_speeds(self) -> list[int]:
        """Moving speeds in the newest goals that were sent, received or not."""
        goals = next(p for p in reversed(self.bus.said) if p.code == Instruction.SYNC_WRITE and p.parameters[1] == 4)
        return [int.from_bytes(goals.parameters[at + 3 : at + 5], "little") for at in range(2, len(goals.parameters), 5)]

    def orders(self, since: int = 0) -> list[str]:
        """Return what the host wrote to the servos; reads are omitted."""
        words = []
        for packet in self.bus.said[since:]:
            if packet.code in (Instruction.WRITE, Instruction.SYNC_WRITE):
                register = next(r for r in dxl.REGISTERS if r.address == packet.parameters[0])
                whom = "all" if packet.servo_id == dxl.BROADCAST_ID else str(packet.servo_id)
                words.append(f"{register.name} of {whom}")
        return words


GOALS, TORQUE = f"{dxl.GOAL_POSITION.name} of all", f"{dxl.TORQUE_ENABLE.name} of all"
