"""The joints behind the emulated bus, byte for byte: taken over, let go, woken; a port that goes and is back."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from services.actuator import servos
from services.actuator.bus import BusGone, BusSetupError
from services.actuator.config import Settings
from services.actuator.goal_limits import GENTLE
from services.actuator.health import SILENT
from services.actuator.joints import Joints
from services.simulator.bus import MemoryPort, ServoBusEmulator
from services.simulator.bus_faults import BusFaults
from services.simulator.servos import ServoBank
from services.simulator.wire import Reply
from shared import dynamixel as dxl
from shared.bus_fault import BusFault
from shared.dynamixel import Instruction, Packet, PacketParser, Register
from shared.geometry import Array
from shared.kinematics import body_inverse
from shared.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
IDS = PROFILE.servo_ids.ravel().tolist()
STAND = PROFILE.servo_angles(body_inverse(PROFILE, PROFILE.rest_feet())).ravel()  # (18,) [rad]
PERIOD = 20_000_000
TICK = dxl.TICK_RAD
SERVO = 7  # of 0 to 17
LEG, JOINT = divmod(SERVO, 3)


class Tap(BusFaults):
    """The bus with its faults, and all that a host has said on it."""

    def __init__(self, bank: ServoBank) -> None:
        super().__init__(ServoBusEmulator(bank), bank)
        self.parser, self.said = PacketParser(), list[Packet]()

    def receive(self, data: bytes, now_ns: int) -> list[Reply]:
        self.said += self.parser.feed(data)
        return super().receive(data, now_ns)


class Rig:
    """Servos that go where they are told within a cycle, if they pull."""

    def __init__(self, torque: bool = True, off: Array | float = 0.0, opener: Callable[[], Any] | None = None) -> None:
        """Goals may lie off where the joints are, by (18,) [rad]."""
        self.now_ns = 0
        self.bank = ServoBank(IDS, q=STAND)
        for row, goal in enumerate(STAND + off):
            self.put(row, dxl.GOAL_POSITION, dxl.ticks_from_angle(goal))
            self.put(row, dxl.TORQUE_ENABLE, int(torque))
        self.bus = Tap(self.bank)
        self.q = STAND.copy()
        self.port: MemoryPort | None = None
        self.opener = opener or self.plug_in

    def plug_in(self, name: int | None = None) -> MemoryPort:
        self.port = MemoryPort(self.bus, lambda: self.now_ns, name=name, start_ns=self.clock())
        return self.port

    def clock(self) -> int:
        return self.now_ns if self.port is None else self.port.now_ns()

    def start(self) -> "Rig":
        self.joints = Joints(PROFILE, Settings(), self.opener, self.clock)
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
            self.bus.advance(self.now_ns)
            goals = np.array([dxl.angle_from_ticks(ticks) for ticks in self.registers(dxl.GOAL_POSITION)])
            pulls = np.array(self.registers(dxl.TORQUE_ENABLE)) * np.array(self.registers(dxl.TORQUE_LIMIT)) > 0
            self.q = np.where(pulls, goals, self.q)
            self.bank.step(self.q, np.zeros(18), np.zeros(18), PERIOD * 1e-9)
            self.joints.read([])
            if write:
                self.joints.write(self.joints.goals)

    def until(self, done: Callable[[], bool], write: bool = False) -> "Rig":
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
        """Moving speeds of the newest goals, heard or not."""
        goals = next(p for p in reversed(self.bus.said) if p.code == Instruction.SYNC_WRITE and p.parameters[1] == 4)
        return [int.from_bytes(goals.parameters[at + 3 : at + 5], "little") for at in range(2, len(goals.parameters), 5)]

    def orders(self, since: int = 0) -> list[str]:
        """What was said to the servos, but for questions."""
        words = []
        for packet in self.bus.said[since:]:
            if packet.code in (Instruction.WRITE, Instruction.SYNC_WRITE):
                register = next(r for r in dxl.REGISTERS if r.address == packet.parameters[0])
                whom = "all" if packet.servo_id == dxl.BROADCAST_ID else str(packet.servo_id)
                words.append(f"{register.name} of {whom}")
        return words


GOALS, TORQUE = f"{dxl.GOAL_POSITION.name} of all", f"{dxl.TORQUE_ENABLE.name} of all"

# ---------------------------------------------------------------------------------------------------------- a beginning


@pytest.mark.parametrize("torque", [True, False])
def test_a_beginning_moves_nobody_and_turns_nothing_on_or_off(torque: bool) -> None:
    rig = Rig(torque)
    before = rig.bank.tables[:, dxl.TORQUE_ENABLE.address : dxl.TORQUE_LIMIT.address + 2].copy()
    rig.start()
    assert (rig.joints.torque == torque).all()
    rig.cycle(3)
    after = rig.bank.tables[:, dxl.TORQUE_ENABLE.address : dxl.TORQUE_LIMIT.address + 2]
    np.testing.assert_array_equal(after, before)
    assert not {GOALS, TORQUE} & set(rig.orders())


def test_it_knows_of_each_servo_whether_it_pulls() -> None:
    rig = Rig()
    rig.put(SERVO, dxl.TORQUE_ENABLE, 0)
    rig.start()
    assert np.flatnonzero(~rig.joints.torque).tolist() == [SERVO]
    assert rig.joints.vitals.limp.tolist() == (~rig.joints.torque).tolist()


@pytest.mark.parametrize("way", ["at the start", "on its return"])
def test_goals_that_stand_in_the_servos_are_kept_within_ten_degrees_and_else_they_are_where_the_joints_are(way: str) -> None:
    off = np.radians(np.linspace(-20.0, 20.0, 18))
    rig = Rig(torque=False, off=off if way == "at the start" else 0.0).start()
    if way == "on its return":
        rig.suffer("bus", "gone", 0.5)
        rig.until(lambda: rig.joints.gone != "")
        for row, goal in enumerate(STAND + off):
            rig.put(row, dxl.GOAL_POSITION, dxl.ticks_from_angle(goal))
        rig.until(lambda: rig.joints.gone == "")
    expected = PROFILE.joint_angles((STAND + np.where(np.abs(off) < np.radians(10.0), off, 0.0)).reshape(6, 3))
    np.testing.assert_allclose(rig.joints.goals, expected, atol=TICK)
    np.testing.assert_allclose(rig.joints.q, rig.measured, atol=TICK)


@pytest.mark.parametrize("lock", [True, False])
def test_a_beginning_locks_what_servos_keep_without_power_if_the_robot_says_so(lock: bool) -> None:
    rig = Rig()
    rig.joints = Joints(replace(PROFILE, servo=replace(PROFILE.servo, lock_eeprom=lock)), Settings(), rig.opener, rig.clock)
    rig.cycle(1)
    assert rig.registers(dxl.LOCK) == [int(lock)] * 18
    rig.put(SERVO, dxl.TORQUE_LIMIT, 300)
    said = len(rig.bus.said)
    rig.start()
    rig.joints.grip()
    rig.cycle(1)
    assert (f"{dxl.LOCK.name} of {IDS[0]}" in rig.orders(said)) == (not lock), "once is enough"
    assert rig.registers(dxl.TORQUE_LIMIT) == [dxl.TORQUE_LIMIT.max] * 18, "what moves a joint is not locked"


@pytest.mark.parametrize("torque", [True, False])
def test_a_servo_that_was_left_weak_is_known_and_stays_so_until_an_order_takes_it_up_where_it_is(torque: bool) -> None:
    rig = Rig(torque, off=np.radians(5.0))
    rig.put(SERVO, dxl.TORQUE_LIMIT, 300)
    rig.start()
    rig.cycle(5, write=True)
    np.testing.assert_allclose(rig.joints.vitals.strength, np.where(np.arange(18) == SERVO, 300 / 1023, 1.0))
    assert rig.registers(dxl.TORQUE_LIMIT)[SERVO] == 300
    said, where = len(rig.bus.said), rig.measured[LEG, JOINT]
    rig.joints.grip()
    rig.cycle(1)
    assert rig.orders(said)[-2:] == [f"{dxl.GOAL_POSITION.name} of {IDS[SERVO]}", f"{dxl.TORQUE_LIMIT.name} of {IDS[SERVO]}"]
    assert rig.registers(dxl.TORQUE_LIMIT) == [dxl.TORQUE_LIMIT.max] * 18
    assert abs(rig.measured[LEG, JOINT] - where) < TICK
    assert (rig.joints.vitals.strength == 1.0).all()


def test_less_torque_than_the_data_sheets_is_not_weak_where_the_servo_keeps_that_for_its_most() -> None:
    rig = Rig()
    rig.put(SERVO, dxl.MAX_TORQUE, 800)
    rig.put(SERVO, dxl.TORQUE_LIMIT, 800)
    rig.start()
    assert (rig.joints.strength == 1.0).all()


def test_a_servo_that_has_shut_down_for_its_heat_is_not_taken_up() -> None:
    rig = Rig()
    rig.bank._faults[SERVO] = int(dxl.ServoError.OVERHEATING)
    rig.put(SERVO, dxl.LED, 0)
    rig.bank.tables[SERVO, dxl.TORQUE_LIMIT.address :][:2] = 0
    rig.start()
    rig.cycle(8)
    rig.joints.grip()
    rig.cycle(1)
    assert rig.registers(dxl.TORQUE_LIMIT)[SERVO] == 0


def test_a_joint_that_hangs_beyond_its_limit_is_taken_up_at_the_limit_and_slowly() -> None:
    rig = Rig().start()
    rig.cycle(8, write=True)
    low = PROFILE.joint_limits[LEG, JOINT, 0]
    rig.joints.q[LEG, JOINT] = low - np.radians(5.0)
    rig.joints.revive(SERVO)
    assert rig.joints.goals[LEG, JOINT] == low
    assert rig.said_speeds == [dxl.moving_speed_from(GENTLE) if row == SERVO else 0 for row in range(18)]


def test_nothing_is_known_before_the_first_readings_and_then_all_is() -> None:
    rig = Rig().start()
    assert np.isnan(rig.joints.voltage).all()
    assert np.isnan(rig.joints.temperature).all()
    assert rig.joints.vitals.newest == np.inf
    rig.cycle(8)
    assert (rig.joints.voltage > 9.0).all()
    assert (rig.joints.temperature > 15.0).all()
    assert rig.joints.vitals.newest < 0.05
    assert rig.joints.vitals.trouble == ""


def test_what_is_lost_counts_once_the_bus_has_been_watched_for_a_while() -> None:
    rig = Rig().start()
    rig.suffer("packets", "silent", 0.5, share=0.5)
    losses = []
    for _ in range(15):
        rig.cycle(write=True)
        losses.append(rig.joints.vitals.loss)
    assert losses[:9] == [0.0] * 9
    assert min(losses[12:]) > 0.3


def test_servos_may_take_a_while_to_answer_at_the_start_and_no_longer() -> None:
    rig = Rig()
    rig.suffer("bus", "silent", 1.0)
    rig.start()
    np.testing.assert_allclose(rig.joints.q, rig.measured, atol=TICK)
    dead = Rig()
    dead.suffer("bus", "silent", 100.0)
    with pytest.raises(BusSetupError, match="none of the 18 servos answers"):
        dead.start()


def test_an_order_to_let_go_that_comes_while_servos_are_asked_does_not_wait_for_the_last_of_them() -> None:
    rig = Rig()
    asked = list[int]()

    def latched() -> bool:
        asked.append(len(rig.bus.said))
        return len(asked) > 40

    Joints(PROFILE, Settings(), rig.plug_in, rig.clock, latched)
    ordered = asked[40]
    words = [(packet.servo_id, packet.code, packet.parameters) for packet in rig.bus.said[ordered : ordered + 2]]
    assert words == [(dxl.BROADCAST_ID, Instruction.WRITE, bytes((dxl.TORQUE_ENABLE.address, 0)))] * 2
    assert len(rig.bus.said) > ordered + 20, "there were more to be asked"
    rig.bus.advance(rig.clock() + PERIOD)
    assert rig.registers(dxl.TORQUE_ENABLE) == [0] * 18


def test_a_servo_that_falls_silent_while_it_is_taken_over_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()

    def set_up(joints: Joints) -> None:
        joints._bus.setup()
        rig.suffer("servo", "silent", 100.0, servo=IDS[SERVO])

    monkeypatch.setattr(Joints, "_set_up", set_up)
    with pytest.raises(ConnectionError, match=f"servo {IDS[SERVO]} stopped answering while it was asked how it stands"):
        rig.start()


def test_motor_torques_are_those_in_the_direction_of_growing_angles_and_zero_where_nobody_answers() -> None:
    rig = Rig().start()
    load = np.linspace(-0.5, 0.5, 18).reshape(6, 3)
    rig.bank.step(rig.q, np.zeros(18), (PROFILE.servo_signs * load).ravel(), 0.02)
    rig.suffer("servo", "silent", 1.0, servo=IDS[SERVO])
    load[LEG, JOINT] = 0.0
    np.testing.assert_allclose(rig.joints.read_loads(), load, atol=0.005)


# ------------------------------------------------------------------------------------------------------- missed goals

GENTLY = dxl.moving_speed_from(GENTLE)


def test_a_servo_that_was_silent_goes_slowly_until_it_is_where_it_was_sent_and_nobody_else_does() -> None:
    rig = Rig().start()
    rig.cycle(8, write=True)
    rig.suffer("servo", "silent", 1.0, servo=IDS[SERVO])
    rig.until(lambda: rig.joints.vitals.missed[SERVO] >= SILENT, write=True)
    moved = rig.joints.goals.copy()
    moved[LEG, JOINT] += np.radians(20.0)
    rig.joints.write(moved)
    rig.until(lambda: rig.joints.vitals.missed[SERVO] == 0, write=True)
    speeds = np.array(rig.registers(dxl.MOVING_SPEED))
    np.testing.assert_array_equal(speeds, np.where(np.arange(18) == SERVO, GENTLY, 0))
    assert not rig.joints.out_of_touch, "the others were there all the while"
    rig.until(lambda: not rig.joints.vitals.behind.any(), write=True)
    rig.cycle(2, write=True)
    assert rig.registers(dxl.MOVING_SPEED) == [0] * 18
    assert abs(rig.measured[LEG, JOINT] - moved[LEG, JOINT]) < np.radians(5.0)


def test_where_nobody_answers_touch_is_lost_and_regained_once_all_have_answered_and_all_go_slowly_meanwhile() -> None:
    rig = Rig().start()
    rig.cycle(8, write=True)
    assert not rig.joints.deaf
    rig.suffer("bus", "silent", 0.5)
    begin = rig.now_ns
    rig.until(lambda: rig.joints.deaf, write=True)
    assert not rig.joints.out_of_touch
    rig.until(lambda: rig.joints.out_of_touch, write=True)
    assert rig.now_ns - begin < 0.25e9
    while rig.now_ns - begin < 0.5e9:
        assert rig.said_speeds == [GENTLY] * 18
        rig.cycle(write=True)
    assert rig.joints.out_of_touch
    rig.until(lambda: not rig.joints.out_of_touch, write=True)
    assert not rig.joints.deaf
    assert not rig.joints.vitals.missed.any()
    rig.cycle(2, write=True)
    assert rig.registers(dxl.MOVING_SPEED) == [0] * 18


def test_a_servo_that_stays_silent_does_not_keep_the_others_waiting_for_long() -> None:
    rig = Rig().start()
    rig.cycle(8, write=True)
    rig.suffer("bus", "silent", 0.5)
    rig.suffer("servo", "silent", 100.0, servo=IDS[SERVO])
    rig.until(lambda: rig.joints.out_of_touch, write=True)
    rig.until(lambda: rig.joints.vitals.newest < 0.05, write=True)
    begin = rig.now_ns
    rig.until(lambda: not rig.joints.out_of_touch, write=True)
    assert rig.now_ns - begin < 2.0e9
    assert rig.joints.vitals.missed[SERVO] >= SILENT


# ------------------------------------------------------------------------------------------------------ a port that goes


def test_a_port_that_goes_is_said_and_raises_nothing_and_comes_back_as_it_stands() -> None:
    rig = Rig().start()
    rig.cycle(8)
    rig.suffer("bus", "gone", 1.0)
    left, begin = rig.bank.tables.copy(), rig.now_ns
    rig.until(lambda: rig.joints.gone != "")
    assert rig.joints.vitals.trouble == rig.joints.gone != ""
    assert rig.joints.vitals.loss == 0.0
    rig.joints.write(rig.joints.goals + 0.5)  # to nobody
    rig.joints.load[:] = 0.7  # [N m] of legs that moved when they were last heard
    rig.until(lambda: rig.joints.gone == "")
    assert np.abs(rig.joints.load).max() < 0.1
    assert 1.0e9 <= rig.now_ns - begin < 1.5e9
    assert rig.joints.out_of_touch
    assert rig.joints.torque.all()
    np.testing.assert_allclose(rig.joints.goals, rig.measured, atol=TICK)
    for register in (dxl.GOAL_POSITION, dxl.TORQUE_ENABLE, dxl.TORQUE_LIMIT):
        at = slice(register.address, register.address + register.size)
        np.testing.assert_array_equal(rig.bank.tables[:, at], left[:, at])


@pytest.mark.parametrize("act", ["write", "let go", "grip", "revive"])
def test_whatever_is_said_to_a_port_that_has_just_gone_is_no_error(act: str) -> None:
    rig = Rig().start()
    rig.suffer("bus", "gone", 1.0)
    for _ in range(2):  # the first finds it gone
        match act:
            case "write":
                rig.joints.write(rig.joints.goals)
            case "let go":
                rig.joints.let_go()
            case "grip":
                rig.joints.grip()
            case _:
                rig.joints.revive(SERVO)
    assert rig.joints.gone
    assert rig.joints.torque.all() == (act in ("write", "revive"))


def test_it_is_looked_for_five_times_a_second() -> None:
    tried = list[int]()

    def plug_in() -> MemoryPort:
        tried.append(rig.now_ns)
        return rig.plug_in()

    rig = Rig(opener=plug_in)
    rig.start()
    rig.suffer("bus", "gone", 1.5)
    rig.cycle(90)
    assert rig.joints.gone == ""
    assert len(tried) > 5
    assert (np.diff(tried[1:]) >= 0.2e9).all()
    assert (np.diff(tried[1:]) <= 0.25e9).all()


def test_what_is_ordered_off_while_the_port_is_gone_is_off_first_of_all_on_its_return_and_before_any_goal() -> None:
    rig = Rig().start()
    rig.cycle(3, write=True)
    rig.suffer("bus", "gone", 0.5)
    rig.until(lambda: rig.joints.gone != "", write=True)
    heard = len(rig.bus.said)
    rig.joints.let_go()
    assert not rig.joints.torque.any()
    assert len(rig.bus.said) == heard
    rig.until(lambda: rig.joints.gone == "")
    first = rig.bus.said[heard]
    assert (first.servo_id, first.code) == (dxl.BROADCAST_ID, Instruction.WRITE)
    assert first.parameters == bytes((dxl.TORQUE_ENABLE.address, 0)), "off, all of them"
    assert GOALS not in rig.orders(heard)
    rig.cycle()
    assert rig.registers(dxl.TORQUE_ENABLE) == [0] * 18
    assert not rig.joints.torque.any()


def test_torque_off_is_said_until_it_is_ordered_on_since_nobody_answers() -> None:
    rig = Rig().start()
    rig.suffer("bus", "silent", 0.3)
    rig.joints.let_go()
    rig.cycle()
    assert rig.registers(dxl.TORQUE_ENABLE) == [1] * 18, "nobody has heard"
    rig.cycle(20)
    assert rig.registers(dxl.TORQUE_ENABLE) == [0] * 18
    rig.joints.grip()
    heard = len(rig.bus.said)
    rig.cycle(20)
    assert TORQUE not in rig.orders(heard)
    assert rig.registers(dxl.TORQUE_ENABLE) == [1] * 18


def test_a_port_that_is_back_with_a_servo_missing_is_not_taken_for_the_whole() -> None:
    rig = Rig().start()
    rig.suffer("bus", "gone", 0.4)
    rig.suffer("servo", "silent", 2.0, servo=IDS[SERVO])
    rig.until(lambda: rig.joints.gone != "")
    begin = rig.now_ns
    rig.cycle(30)
    assert rig.joints.gone.endswith(f"it is back, but {PROFILE.servo_names[IDS[SERVO]]} (id {IDS[SERVO]}) does not answer")
    rig.until(lambda: rig.joints.gone == "")
    assert rig.now_ns - begin > 1.5e9


def test_a_port_that_is_back_is_found_through_lost_answers() -> None:
    rig = Rig().start()
    rig.suffer("bus", "gone", 0.4)
    rig.suffer("packets", "silent", 100.0, share=0.1)
    begin = rig.now_ns
    rig.until(lambda: rig.joints.gone != "")
    rig.until(lambda: rig.joints.gone == "")
    assert rig.now_ns - begin < 3e9


def test_a_port_that_is_back_under_another_name_is_found_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def open_port(url: str, timeout_ns: int) -> MemoryPort:
        try:
            return rig.plug_in(int(url.removeprefix("port")))
        except OSError as error:
            raise BusGone(str(error)) from error

    monkeypatch.setattr(servos, "open_port", open_port)
    rig = Rig(opener=servos.Outlet(Settings(port="port0, port1")).open)
    rig.start()
    for _ in range(2):
        rig.suffer("bus", "gone", 0.5, renamed=True)
        rig.until(lambda: rig.joints.gone != "")
        rig.until(lambda: rig.joints.gone == "" or "expected, found 2" in rig.joints.gone)
        if rig.joints.gone:
            return  # there is no third name
        rig.cycle(8)
        assert rig.joints.vitals.newest < 0.05
    raise AssertionError("the second new name was none of those that were given")


# -------------------------------------------------------------------------------------------------------- limp servos


@pytest.mark.parametrize("cable", [True, False])
def test_a_servo_that_comes_back_limp_is_said_so_and_one_that_was_silent_only_pulls(cable: bool) -> None:
    rig = Rig().start()
    rig.cycle(8)
    rig.suffer("servo", "silent", 1.0, servo=IDS[SERVO], cable=cable)
    rig.cycle(40)
    assert np.flatnonzero(rig.joints.vitals.missed >= 4).tolist() == [SERVO]
    assert rig.joints.torque.all(), "nobody knows"
    rig.cycle(60)
    assert np.flatnonzero(rig.joints.vitals.missed).tolist() == []
    assert np.flatnonzero(rig.joints.vitals.limp).tolist() == [SERVO] * cable


def test_it_is_asked_again_where_that_answer_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig().start()
    rig.cycle(8)
    rig.suffer("servo", "silent", 1.0, servo=IDS[SERVO], cable=True)
    rig.cycle(40)
    read, lost = rig.joints._bus.read, list[int]()

    def lossy(servo_id: int, register: Register) -> int | None:
        if register is dxl.TORQUE_ENABLE and len(lost) < 3:
            lost.append(servo_id)
            return None
        return read(servo_id, register)

    monkeypatch.setattr(rig.joints._bus, "read", lossy)
    rig.until(lambda: bool(rig.joints.vitals.limp.any()))
    assert lost == [IDS[SERVO]] * 3


def test_torque_comes_on_where_limp_joints_are_and_others_keep_their_goals() -> None:
    rig = Rig().start()
    rig.cycle(8)
    rig.suffer("servo", "silent", 0.5, servo=IDS[SERVO], cable=True)
    rig.until(lambda: bool(rig.joints.vitals.limp.any()))
    rig.q[SERVO] += 0.3  # it has sunk
    rig.cycle(8)
    before, heard = rig.joints.goals.copy(), len(rig.bus.said)
    rig.joints.grip()
    assert rig.joints.torque.all()
    words = rig.orders(heard)
    assert set(words) == {GOALS, TORQUE}
    assert words.index(TORQUE) == words.count(GOALS), "goals come first"
    rig.cycle(8)
    assert rig.registers(dxl.TORQUE_ENABLE) == [1] * 18
    here = rig.measured
    before[LEG, JOINT] = here[LEG, JOINT]
    np.testing.assert_allclose(rig.joints.goals, before, atol=TICK)
    assert here[LEG, JOINT] == pytest.approx(PROFILE.joint_angles(rig.q.reshape(6, 3))[LEG, JOINT])
    assert abs(rig.q[SERVO] - STAND[SERVO] - 0.3) < 2 * TICK, "it stays where it is"


def overloaded() -> Rig:
    """One servo has shut down and hangs 0.3 rad below where it was told to be."""
    rig = Rig().start()
    rig.cycle(8)
    rig.put(SERVO, dxl.TORQUE_LIMIT, 0)
    rig.bank._faults[SERVO] = int(dxl.ServoError.OVERLOAD)
    rig.q[SERVO] += 0.3
    rig.cycle(16)
    assert rig.joints.vitals.errors[SERVO] & dxl.ServoError.OVERLOAD
    return rig


def test_a_servo_is_woken_where_it_is_and_knows_that_before_it_pulls() -> None:
    rig = overloaded()
    goals, heard = rig.joints.goals.copy(), len(rig.bus.said)
    rig.joints.revive(SERVO)
    words = rig.orders(heard)
    assert words[-1] == f"{dxl.TORQUE_LIMIT.name} of {IDS[SERVO]}"
    assert words.index(GOALS) < len(words) - 1
    assert TORQUE not in words
    rig.cycle(16)
    assert rig.registers(dxl.TORQUE_LIMIT)[SERVO] == 1023
    assert abs(rig.q[SERVO] - STAND[SERVO] - 0.3) < 2 * TICK
    assert not rig.joints.vitals.errors.any()
    others = np.ones((6, 3), dtype=bool)
    others[LEG, JOINT] = False
    np.testing.assert_array_equal(rig.joints.goals[others], goals[others])


def test_a_servo_that_does_not_say_that_it_has_its_goal_is_not_woken() -> None:
    rig = overloaded()
    rig.suffer("packets", "silent", 0.1, share=1.0)
    heard = len(rig.bus.said)
    rig.joints.revive(SERVO)
    assert f"{dxl.TORQUE_LIMIT.name} of {IDS[SERVO]}" not in rig.orders(heard)
    rig.cycle(16)
    assert rig.registers(dxl.TORQUE_LIMIT)[SERVO] == 0


def test_closing_leaves_all_as_it_is() -> None:
    rig = Rig().start()
    rig.cycle()
    before = rig.bank.tables.copy()
    rig.joints.close()
    rig.bus.advance(rig.clock() + PERIOD)
    np.testing.assert_array_equal(rig.bank.tables, before)
    with pytest.raises(OSError, match="closed"):
        rig.port.write(b"x")  # type: ignore[union-attr]
