"""Joints that are lost and found again, at packet level.

The port disconnects and returns; servos lose torque and are enabled again.
"""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE
from sextant.services.actuator.servo_bus import servo_interface
from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError
from sextant.services.actuator.servo_bus.mcu_bridge import READ_NS
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import Instruction
from sextant.shared.servo.servo_model import Recovery, Register, ServoError
from tests.support.joints_rig import GOALS, IDS, JOINT, LEG, PERIOD, PROFILE, SERVO, STAND, TICK, TORQUE, JointsRig

# ----------------------------------------------------------------------------------------------- a port that disconnects


def test_lost_port_is_reported_and_reconnects_at_measured_positions() -> None:
    rig = JointsRig().start()
    rig.cycle(8)
    rig.suffer("bus", "gone", 1.0)
    left, begin = rig.bank.tables.copy(), rig.now_ns
    rig.until(lambda: rig.joints.gone != "")
    assert rig.joints.vitals.trouble == rig.joints.gone != ""
    assert rig.joints.vitals.loss == 0.0
    rig.joints.write(rig.joints.goals + 0.5)  # with no receiver
    rig.joints.load[:] = 0.7  # [N m] load of legs that moved at the last reading
    rig.until(lambda: rig.joints.gone == "")
    assert np.abs(rig.joints.load).max() < 0.1
    assert 1.0e9 <= rig.now_ns - begin < 1.5e9
    assert rig.joints.all_behind
    assert rig.joints.torque.all()
    np.testing.assert_allclose(rig.joints.goals, rig.measured, atol=TICK)
    for register in (dxl.GOAL_POSITION, dxl.TORQUE_ENABLE, dxl.TORQUE_LIMIT):
        at = slice(register.address, register.address + register.size)
        np.testing.assert_array_equal(rig.bank.tables[:, at], left[:, at])


def test_a_joint_that_was_catching_up_slowly_continues_slowly_when_the_port_is_back() -> None:
    rig = JointsRig().start()
    rig.cycle(8, write=True)
    rig.jammed.add(SERVO)  # its joint is still on its way to the goal
    goals = rig.joints.goals.copy()
    goals[LEG, JOINT] += np.radians(8.0)
    rig.joints._catching_up.leave_behind(np.arange(18) == SERVO, GENTLE)
    rig.joints.write(goals)
    rig.suffer("bus", "gone", 0.5)
    rig.until(lambda: rig.joints.gone != "")
    rig.until(lambda: rig.joints.gone == "")
    assert rig.joints.goals[LEG, JOINT] == pytest.approx(goals[LEG, JOINT], abs=TICK)
    rig.joints.write(rig.joints.goals)
    assert rig.said_speeds == [dxl.moving_speed_from(GENTLE) if row == SERVO else 0 for row in range(18)]
    assert rig.joints.all_behind
    rig.jammed.clear()
    rig.until(lambda: not rig.joints.all_behind, write=True)
    rig.cycle(2, write=True)
    assert rig.said_speeds == [0] * 18


@pytest.mark.parametrize("act", ["write", "let go", "grip", "revive"])
def test_writes_to_a_lost_port_raise_no_error(act: str) -> None:
    rig = JointsRig().start()
    rig.suffer("bus", "gone", 1.0)
    for _ in range(2):  # the first call detects the lost port
        match act:
            case "write":
                rig.joints.write(rig.joints.goals)
            case "let go":
                rig.joints.torque_off()
            case "grip":
                rig.joints.torque_on()
            case _:
                rig.joints.restore_torque(SERVO)
    assert rig.joints.gone
    assert rig.joints.torque.all() == (act in ("write", "revive"))


def test_lost_port_is_retried_5_times_per_second() -> None:
    tried = list[int]()

    def plug_in() -> MemoryPort:
        tried.append(rig.now_ns)
        return rig.plug_in()

    rig = JointsRig(opener=plug_in)
    rig.start()
    rig.suffer("bus", "gone", 1.5)
    rig.cycle(90)
    assert rig.joints.gone == ""
    assert len(tried) > 5
    assert (np.diff(tried[1:]) >= 0.2e9).all()
    assert (np.diff(tried[1:]) <= 0.25e9).all()


def test_torque_off_during_port_loss_is_sent_first_on_reconnection() -> None:
    rig = JointsRig().start()
    rig.cycle(3, write=True)
    rig.suffer("bus", "gone", 0.5)
    rig.until(lambda: rig.joints.gone != "", write=True)
    heard = len(rig.bus.said)
    rig.joints.torque_off()
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


def test_torque_off_is_repeated_until_torque_on() -> None:
    rig = JointsRig().start()
    rig.suffer("bus", "silent", 0.3)
    rig.joints.torque_off()
    rig.cycle()
    assert rig.registers(dxl.TORQUE_ENABLE) == [1] * 18, "nobody has heard"
    rig.cycle(20)
    assert rig.registers(dxl.TORQUE_ENABLE) == [0] * 18
    rig.joints.torque_on()
    heard = len(rig.bus.said)
    rig.cycle(20)
    assert TORQUE not in rig.orders(heard)
    assert rig.registers(dxl.TORQUE_ENABLE) == [1] * 18


def test_reconnection_waits_for_missing_servo() -> None:
    rig = JointsRig().start()
    rig.suffer("bus", "gone", 0.4)
    rig.suffer("servo", "silent", 2.0, servo=IDS[SERVO])
    rig.until(lambda: rig.joints.gone != "")
    begin = rig.now_ns
    rig.cycle(30)
    assert rig.joints.gone.endswith(
        f"the port is back, but {PROFILE.servo_names[IDS[SERVO]]} (id {IDS[SERVO]}) does not answer"
    )
    rig.until(lambda: rig.joints.gone == "")
    assert rig.now_ns - begin > 1.5e9


def test_reconnection_succeeds_despite_packet_loss() -> None:
    rig = JointsRig().start()
    rig.suffer("bus", "gone", 0.4)
    rig.suffer("packets", "silent", 100.0, share=0.1)
    begin = rig.now_ns
    rig.until(lambda: rig.joints.gone != "")
    rig.until(lambda: rig.joints.gone == "")
    assert rig.now_ns - begin < 3e9


def test_reconnection_finds_port_under_another_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def open_port(url: str, rate: int, timeout_ns: int) -> MemoryPort:
        try:
            return rig.plug_in(int(url.removeprefix("port")))
        except OSError as error:
            raise BusDisconnectedError(str(error)) from error

    monkeypatch.setattr(servo_interface, "open_port", open_port)
    rig = JointsRig(opener=servo_interface.PortFinder(Settings(port="port0, port1")).open)
    rig.start()
    for _ in range(2):
        rig.suffer("bus", "gone", 0.5, renamed=True)
        rig.until(lambda: rig.joints.gone != "")
        rig.until(lambda: rig.joints.gone == "" or "expected, found 2" in rig.joints.gone)
        if rig.joints.gone:
            return  # a third name does not exist
        rig.cycle(8)
        assert rig.joints.vitals.newest < 0.05
    raise AssertionError("the second new name was none of those that were given")


# ---------------------------------------------------------------------------------------------- servos without torque


@pytest.mark.parametrize("cable", [True, False])
def test_power_loss_of_servo_is_distinguished_from_silence(cable: bool) -> None:
    rig = JointsRig().start()
    rig.cycle(8)
    rig.suffer("servo", "silent", 1.0, servo=IDS[SERVO], cable=cable)
    rig.cycle(40)
    assert np.flatnonzero(rig.joints.vitals.missed >= 4).tolist() == [SERVO]
    assert rig.joints.torque.all(), "nobody knows"
    rig.cycle(60)
    assert np.flatnonzero(rig.joints.vitals.missed).tolist() == []
    assert np.flatnonzero(rig.joints.vitals.torque_disabled).tolist() == [SERVO] * cable


def test_torque_query_is_repeated_after_lost_replies(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = JointsRig().start()
    rig.cycle(8)
    rig.suffer("servo", "silent", 1.0, servo=IDS[SERVO], cable=True)
    rig.cycle(40)
    read, lost = rig.joints._bus.read, list[int]()

    def lossy(servo_id: int, register: Register) -> int | None:
        if register is dxl.TORQUE_ENABLE and servo_id == IDS[SERVO] and len(lost) < 3:
            lost.append(servo_id)
            return None
        return read(servo_id, register)

    monkeypatch.setattr(rig.joints._bus, "read", lossy)
    rig.until(lambda: bool(rig.joints.vitals.torque_disabled.any()))
    assert lost == [IDS[SERVO]] * 3


def test_torque_on_sets_goals_of_torqueless_joints_to_their_position() -> None:
    rig = JointsRig().start()
    rig.cycle(8)
    rig.suffer("servo", "silent", 0.5, servo=IDS[SERVO], cable=True)
    rig.until(lambda: bool(rig.joints.vitals.torque_disabled.any()))
    rig.q[SERVO] += 0.3  # the joint has sunk
    rig.cycle(8)
    before, heard = rig.joints.goals.copy(), len(rig.bus.said)
    rig.joints.torque_on()
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


def overloaded_rig() -> JointsRig:
    """Return a rig with one servo shut down and hanging 0.3 rad below its goal."""
    rig = JointsRig().start()
    rig.cycle(8)
    rig.put(SERVO, dxl.TORQUE_LIMIT, 0)
    rig.bank._latched_errors[SERVO] = int(ServoError.OVERLOAD)
    rig.q[SERVO] += 0.3
    rig.cycle(16)
    assert rig.joints.vitals.errors[SERVO] & ServoError.OVERLOAD
    return rig


def test_restore_torque_sets_goal_to_position_before_torque_limit() -> None:
    rig = overloaded_rig()
    goals, heard = rig.joints.goals.copy(), len(rig.bus.said)
    rig.joints.restore_torque(SERVO)
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


def test_servo_that_reboots_to_end_its_shutdown_has_lost_its_torque() -> None:
    rig = JointsRig().start()
    model = replace(rig.joints._bus.model_of(IDS[SERVO]), recovery=Recovery.REBOOT)
    rig.joints._bus._models = {IDS[SERVO]: model}  # type: ignore[attr-defined]
    rig.joints._reboots[SERVO] = True
    rig.joints._restore_torque_limit(SERVO)
    assert np.flatnonzero(rig.joints.vitals.torque_disabled).tolist() == [SERVO]


def test_restore_torque_is_skipped_without_goal_confirmation() -> None:
    rig = overloaded_rig()
    rig.suffer("packets", "silent", 0.1, share=1.0)
    heard = len(rig.bus.said)
    rig.joints.restore_torque(SERVO)
    assert f"{dxl.TORQUE_LIMIT.name} of {IDS[SERVO]}" not in rig.orders(heard)
    rig.cycle(16)
    assert rig.registers(dxl.TORQUE_LIMIT)[SERVO] == 0


def test_close_writes_no_register() -> None:
    rig = JointsRig().start()
    rig.cycle()
    before = rig.bank.tables.copy()
    rig.joints.close()
    rig.bus.advance(rig.clock() + PERIOD)
    np.testing.assert_array_equal(rig.bank.tables, before)
    with pytest.raises(OSError, match="closed"):
        rig.port.write(b"x")  # type: ignore[union-attr]


def test_lost_port_of_mcu_bridge_reconnects() -> None:
    rig = JointsRig()
    board = Board(rig.bus)

    def plug_in() -> MemoryPort:
        rig.port = MemoryPort(board, lambda: rig.now_ns, READ_NS * 1e-9, start_ns=rig.clock())
        return rig.port

    rig.opener, rig.device = plug_in, board
    rig.start(Settings(bridge=True))
    rig.cycle(20, write=True)
    rig.suffer("bus", "gone", 0.5)
    rig.until(lambda: rig.joints.gone != "", write=True)
    lost_ns = rig.now_ns
    rig.until(lambda: rig.joints.trouble == "" and not rig.joints.all_behind, write=True)
    assert rig.now_ns - lost_ns < 2.0e9
    assert rig.joints.torque.all()
    rig.cycle(20, write=True)
    assert rig.joints.trouble == ""


# ------------------------------------------------------------------------------------------ servos with torque disabled


@pytest.mark.parametrize("servo", [None, SERVO])
def test_missed_torque_on_is_detected_by_reading_torque_enable(servo: int | None) -> None:
    rig = JointsRig(torque=False).start()
    rig.cycle(8)
    target = {"servo": IDS[servo]} if servo is not None else {}
    rig.suffer("bus" if servo is None else "servo", "silent", 0.03, **target)
    rig.joints.torque_on()
    rig.cycle(60, write=True)
    truly = np.array(rig.registers(dxl.TORQUE_ENABLE)) > 0
    np.testing.assert_array_equal(rig.joints.torque, truly)
    assert truly.sum() == (0 if servo is None else 17)
    rig.joints.torque_on()
    rig.cycle(60, write=True)
    assert rig.joints.torque.all()
    assert all(rig.registers(dxl.TORQUE_ENABLE))


@pytest.mark.parametrize("gap_s", [0.04, 0.06, 0.08, 0.10, 0.12, 0.2])
def test_short_power_loss_of_servo_between_reads_is_detected(gap_s: float) -> None:
    rig = JointsRig().start()
    rig.cycle(20, write=True)
    rig.suffer("servo", "silent", gap_s, servo=IDS[SERVO], cable=True)
    rig.cycle(120, write=True)
    assert rig.registers(dxl.TORQUE_ENABLE)[SERVO] == 0
    assert np.flatnonzero(~rig.joints.torque).tolist() == [SERVO]


def test_torque_off_lost_on_reconnection_is_repeated_and_goals_reset() -> None:
    rig = JointsRig().start()
    rig.cycle(5, write=True)
    rig.suffer("bus", "gone", 0.5)
    rig.until(lambda: rig.joints.gone != "")
    rig.joints.torque_off()
    hears, deaf_for = rig.bus.receive, [2]

    def spoil(data: bytes, now_ns: int) -> list[Reply]:
        """Drop the first two packets that turn torque off."""
        if deaf_for[0] and data == dxl.write(dxl.BROADCAST_ID, dxl.TORQUE_ENABLE.address, b"\x00"):
            deaf_for[0] -= 1
            return []
        return hears(data, now_ns)

    rig.bus.receive = spoil  # type: ignore[method-assign]
    rig.until(lambda: rig.joints.gone == "")
    assert not deaf_for[0]
    rig.cycle(5)
    assert not any(rig.registers(dxl.TORQUE_ENABLE))
    assert not rig.joints.torque.any()
    rig.q = STAND + 0.7  # the legs hang
    rig.cycle(30)
    rig.joints.torque_on()
    rig.cycle()
    np.testing.assert_allclose(np.array(rig.registers(dxl.GOAL_POSITION)), rig.registers(dxl.PRESENT_POSITION), atol=1.0)
