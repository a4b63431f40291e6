"""Servos of every family behind a bridge: the same firmware, driver and wire."""

import numpy as np
import pytest

from sextant.services.actuator.servo_bus import shutdown
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError
from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS, Bridge
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus import BusTiming, ServoBusEmulator
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.motors import MOTOR_AND_SUPPLY
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.servo.bridge_protocol import Instruction, Mode
from sextant.shared.servo.models import AX_12A, LX_16A, MX_28, SCS0009, STS3215, XL430_W250, XM430_W350
from sextant.shared.servo.servo_model import Register, ServoError, ServoModel

MODELS = (AX_12A, MX_28, STS3215, SCS0009, XL430_W250, XM430_W350)
EACH = pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
IDS = (3, 1, 2)
PERIOD_NS = 20_000_000


class Rig:
    """Three servos with a board, and a driver."""

    def __init__(self, model: ServoModel) -> None:
        self.now_ns = 0
        self.model, self.table = model, model.table
        self.bank = ServoBank(IDS, model, supply=MOTOR_AND_SUPPLY[model.name][1])
        for row in range(3):
            self.put(row, model.table.baud_rate, model.rate_code(model.bus_rate))
        self.board = Board(ServoBusEmulator(self.bank, BusTiming(model.bus_rate, 0)), model=model)
        self.port = MemoryPort(self.board, lambda: self.now_ns, READ_NS * 1e-9)
        self.driver = Bridge(self.port, IDS, self.port.now_ns, model=model)
        self.q, self.load = np.zeros(3), np.zeros(3)

    def put(self, row: int, register: Register, value: int) -> None:
        self.bank.write(row, register.address, register.encode(value))

    def get(self, register: Register) -> list[int]:
        return [register.decode(self.bank.read(row, register.address, register.size)) for row in range(3)]

    def cycle(self, count: int = 1, goals: np.ndarray | None = None):  # type: ignore[no-untyped-def]
        for _ in range(count):
            self.now_ns = max(self.now_ns + PERIOD_NS, self.port.now_ns())
            self.board.advance(self.now_ns)
            self.bank.step(self.q, np.full(3, 0.4), self.load, PERIOD_NS * 1e-9)
            readings = self.driver.poll(6_500_000)
            if goals is not None:
                self.driver.sync_write_goals(goals)
        return sorted(readings, key=lambda reading: reading.index)

    @property
    def here(self) -> np.ndarray:
        return np.array([self.model.units.ticks(q) for q in self.q])

    def walking(self) -> "Rig":
        self.driver.setup()
        self.cycle(3, self.here)
        self.driver.set_torque(True)
        self.cycle(3, self.here)
        assert self.mode is Mode.ON
        return self

    @property
    def mode(self) -> Mode:
        assert self.driver.state is not None
        return self.driver.state.mode


@EACH
def test_readings_goals_and_torque_pass_the_bridge(model: ServoModel) -> None:
    rig = Rig(model)
    rig.q = np.array([-1.0, 0.02, 1.2])
    rig.load = np.array([0.3, 0.0, -0.3])
    rig.walking()
    assert rig.get(rig.table.torque_enable) == [1, 1, 1]
    goals = rig.here + np.array([5, -3, 9])
    readings = rig.cycle(3, goals)
    assert rig.get(rig.table.goal_position) == goals.tolist()
    assert [reading.position for reading in readings] == pytest.approx(rig.q.tolist(), abs=model.units.tick_rad)
    assert [reading.speed for reading in readings] == pytest.approx([0.4] * 3, abs=model.units.speed_rad_s)
    share = 0.3 / rig.bank.motor.stall_torque
    assert [abs(reading.load) for reading in readings] == pytest.approx([share, 0.0, share], abs=0.03)
    assert readings[0].load * readings[2].load < 0.0
    assert all(rig.driver.write(servo_id, rig.table.torque_limit, 600) for servo_id in IDS)
    rig.cycle(1)
    assert rig.get(rig.table.torque_limit) == [600] * 3
    rig.driver.set_torque(False)
    rig.cycle(1)
    assert rig.get(rig.table.torque_enable) == [0, 0, 0]
    assert rig.driver.lost["bridge: garbled packet"] == 0


@pytest.mark.parametrize("model", [*MODELS, LX_16A], ids=lambda model: model.name)
def test_board_with_other_servos_is_refused_with_both_names(model: ServoModel) -> None:
    rig = Rig(model)
    other = STS3215 if model is AX_12A else AX_12A
    driver = Bridge(rig.port, IDS, rig.port.now_ns, model=other)
    words = f"the bridge drives servos {model.name}, the profile has {other.name}; set SERVO in the board's config.py"
    with pytest.raises(BusSetupError, match=words):
        driver.setup()
    assert driver.poll(5_000_000) == []
    driver.set_torque(False)
    for row in range(3):
        rig.put(row, rig.table.torque_enable, 1)
    driver.set_torque(False)
    rig.now_ns = rig.port.now_ns() + PERIOD_NS
    rig.board.advance(rig.now_ns)
    assert rig.get(rig.table.torque_enable) == [0, 0, 0], "torque off is obeyed nevertheless"


@EACH
def test_shutdown_is_reported_and_ends_behind_the_bridge(model: ServoModel) -> None:
    rig = Rig(model).walking()
    for _ in range(6000):
        if rig.bank.shutdown[1]:
            break
        rig.bank.step(rig.q, np.zeros(3), np.array([0.0, rig.bank.motor.stall_torque, 0.0]), 0.001)
    assert rig.bank.shutdown.tolist() == [False, True, False]
    readings = rig.cycle(20, rig.here)
    assert [reading.error for reading in readings] == [ServoError.NONE, ServoError.OVERLOAD, ServoError.NONE]
    ended = shutdown.end(rig.driver, IDS[1], int(rig.here[1]), model.table.torque_limit.max, lambda: True)
    assert ended == (model.table.hardware_error is None)
    rig.cycle(30, rig.here)
    assert not rig.bank.shutdown.any()
    assert rig.driver.errors.tolist() == [0, 0, 0]


@EACH
def test_one_servo_gets_torque_only_while_torque_is_ordered_on(model: ServoModel) -> None:
    rig = Rig(model).walking()
    enable = model.table.torque_enable
    rig.put(1, enable, 0)
    assert rig.driver.write(IDS[1], enable, 1)
    rig.cycle(1, rig.here)
    assert rig.get(enable) == [1, 1, 1]
    rig.q[2] = 0.4  # far from its goal
    rig.cycle(2, np.array([rig.here[0], rig.here[1], model.units.ticks(0.0)]))
    assert not rig.driver.write(IDS[2], enable, 1)
    rig.q[2] = 0.0
    rig.cycle(2, rig.here)
    sent: list[bytes] = []
    write = rig.port.write
    rig.port.write = lambda data, /: sent.append(data) or len(data)  # type: ignore[method-assign,func-returns-value]
    for _ in range(3):
        rig.driver.ask(IDS[1], Instruction.WRITE, enable.address, 0, b"\1")
    rig.driver.set_torque(False)
    rig.port.write = write  # type: ignore[method-assign]
    heard: list[bytes] = []
    receive = rig.board._bus.receive

    def overheard(data: bytes, now_ns: int) -> list[Reply]:
        heard.append(data)
        return receive(data, now_ns)

    rig.board._bus.receive = overheard  # type: ignore[method-assign]
    write(b"".join(sent))
    rig.cycle(2)
    off = model.protocol.write(model.protocol.BROADCAST_ID, enable.address, b"\0")
    behind = heard[heard.index(off) :]
    assert model.protocol.write(IDS[1], enable.address, b"\1") not in behind, "no request that waited turns torque on again"
    assert rig.get(enable) == [0, 0, 0]
