"""Joints on the emulated bus, at packet level: start-up and missed goals."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE, LOWERED
from sextant.services.actuator.safety.health_monitor import SILENT
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError
from sextant.services.actuator.servo_bus.joints import Joints
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import Instruction
from sextant.shared.servo.servo_model import ServoError
from tests.support.joints_rig import GOALS, IDS, JOINT, LEG, PERIOD, PROFILE, SERVO, STAND, TICK, TORQUE, JointsRig

# ------------------------------------------------------------------------------------------------------------- start-up


@pytest.mark.parametrize("torque", [True, False])
def test_start_up_writes_no_goals_and_no_torque(torque: bool) -> None:
    rig = JointsRig(torque)
    before = rig.bank.tables[:, dxl.TORQUE_ENABLE.address : dxl.TORQUE_LIMIT.address + 2].copy()
    rig.start()
    assert (rig.joints.torque == torque).all()
    rig.cycle(3)
    after = rig.bank.tables[:, dxl.TORQUE_ENABLE.address : dxl.TORQUE_LIMIT.address + 2]
    np.testing.assert_array_equal(after, before)
    assert not {GOALS, TORQUE} & set(rig.orders())


def test_torque_state_of_each_servo_is_read_at_start_up() -> None:
    rig = JointsRig()
    rig.put(SERVO, dxl.TORQUE_ENABLE, 0)
    rig.start()
    assert np.flatnonzero(~rig.joints.torque).tolist() == [SERVO]
    assert rig.joints.vitals.torque_disabled.tolist() == (~rig.joints.torque).tolist()


@pytest.mark.parametrize("way", ["at the start", "on its return"])
def test_stored_goals_are_kept_if_within_10_deg_of_the_joints(way: str) -> None:
    off = np.radians(np.linspace(-20.0, 20.0, 18))
    rig = JointsRig(torque=False, off=off if way == "at the start" else 0.0).start()
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
def test_start_up_locks_eeprom_if_profile_requires_it(lock: bool) -> None:
    rig = JointsRig()
    rig.joints = Joints(replace(PROFILE, servo=replace(PROFILE.servo, lock_eeprom=lock)), Settings(), rig.opener, rig.clock)
    rig.cycle(1)
    assert rig.registers(dxl.LOCK) == [int(lock)] * 18
    rig.put(SERVO, dxl.TORQUE_LIMIT, 300)
    said = len(rig.bus.said)
    rig.start()
    rig.joints.torque_on()
    rig.cycle(1)
    assert (f"{dxl.LOCK.name} of {IDS[0]}" in rig.orders(said)) == (not lock), "once is enough"
    assert rig.registers(dxl.TORQUE_LIMIT) == [dxl.TORQUE_LIMIT.max] * 18, "what moves a joint is not locked"


@pytest.mark.parametrize("torque", [True, False])
def test_reduced_torque_limit_persists_until_torque_on_at_present_position(torque: bool) -> None:
    rig = JointsRig(torque, off=np.radians(5.0))
    rig.put(SERVO, dxl.TORQUE_LIMIT, 300)
    rig.start()
    rig.cycle(5, write=True)
    np.testing.assert_allclose(rig.joints.vitals.strength, np.where(np.arange(18) == SERVO, 300 / 1023, 1.0))
    assert rig.registers(dxl.TORQUE_LIMIT)[SERVO] == 300
    said, where = len(rig.bus.said), rig.measured[LEG, JOINT]
    rig.joints.torque_on()
    rig.cycle(1)
    assert rig.orders(said)[-2:] == [f"{dxl.GOAL_POSITION.name} of {IDS[SERVO]}", f"{dxl.TORQUE_LIMIT.name} of {IDS[SERVO]}"]
    assert rig.registers(dxl.TORQUE_LIMIT) == [dxl.TORQUE_LIMIT.max] * 18
    assert abs(rig.measured[LEG, JOINT] - where) < TICK
    assert (rig.joints.vitals.strength == 1.0).all()


def test_torque_limit_equal_to_max_torque_register_counts_as_full() -> None:
    rig = JointsRig()
    rig.put(SERVO, dxl.MAX_TORQUE, 800)
    rig.put(SERVO, dxl.TORQUE_LIMIT, 800)
    rig.start()
    assert (rig.joints.strength == 1.0).all()


def test_torque_on_does_not_restore_an_overheated_servo() -> None:
    rig = JointsRig()
    rig.bank._latched_errors[SERVO] = int(ServoError.OVERHEATING)
    rig.put(SERVO, dxl.LED, 0)
    rig.bank.tables[SERVO, dxl.TORQUE_LIMIT.address :][:2] = 0
    rig.start()
    rig.cycle(8)
    rig.joints.torque_on()
    rig.cycle(1)
    assert rig.registers(dxl.TORQUE_LIMIT)[SERVO] == 0


def test_torque_restored_beyond_joint_limit_moves_to_limit_slowly() -> None:
    rig = JointsRig().start()
    rig.cycle(8, write=True)
    low = PROFILE.joint_limits[LEG, JOINT, 0]
    rig.joints.q[LEG, JOINT] = low - np.radians(5.0)
    rig.joints.restore_torque(SERVO)
    assert rig.joints.goals[LEG, JOINT] == low
    assert rig.said_speeds == [dxl.moving_speed_from(GENTLE) if row == SERVO else 0 for row in range(18)]


def test_torque_on_beyond_joint_limit_moves_to_limit_slowly() -> None:
    rig = JointsRig(torque=False).start()
    rig.cycle(8)
    low = PROFILE.joint_limits[LEG, JOINT, 0]
    rig.joints.q[LEG, JOINT] = low - np.radians(12.0)
    rig.joints.torque_on()
    assert rig.joints.goals[LEG, JOINT] == low
    assert rig.said_speeds == [dxl.moving_speed_from(GENTLE) if row == SERVO else 0 for row in range(18)]


def test_restored_torque_limit_does_not_exceed_max_torque_register() -> None:
    rig = JointsRig()
    rig.put(SERVO, dxl.MAX_TORQUE, 700)
    rig.put(SERVO, dxl.TORQUE_LIMIT, 700)
    rig.start()
    rig.cycle(8)
    rig.joints.restore_torque(SERVO)
    assert rig.registers(dxl.TORQUE_LIMIT)[SERVO] == 700


def test_voltage_and_temperature_are_nan_until_first_reading() -> None:
    rig = JointsRig().start()
    assert np.isnan(rig.joints.voltage).all()
    assert np.isnan(rig.joints.temperature).all()
    assert rig.joints.vitals.newest == np.inf
    rig.cycle(8)
    assert (rig.joints.voltage > 9.0).all()
    assert (rig.joints.temperature > 15.0).all()
    assert rig.joints.vitals.newest < 0.05
    assert rig.joints.vitals.trouble == ""


def test_newest_voltage_of_servos_that_seldom_report_it_is_that_of_all() -> None:
    profile = load_profile("jethexa_hx35h")
    bank = make_servo_bank(profile.servo, profile.servo_ids.ravel().tolist(), np.zeros(18))
    bus, now_ns = ServoBusEmulator(bank), 0
    port = MemoryPort(bus, lambda: now_ns)
    joints = Joints(profile, Settings(), lambda: port, port.now_ns)
    table, ticks = bank.table, round(bank.voltage / bank.model.units.volt)
    for lower in (0, 600, 300):  # a sag of 0.6 V
        bank.column(table.present_voltage)[:] = ticks - lower
        for _ in range(20):  # 0.4 s
            now_ns = max(now_ns + PERIOD, port.now_ns())
            bus.advance(now_ns)
            joints.read([])
        np.testing.assert_allclose(joints.voltage, (ticks - lower) * bank.model.units.volt, atol=0.01)


def test_packet_loss_is_zero_until_observation_window_is_filled() -> None:
    rig = JointsRig().start()
    rig.suffer("packets", "silent", 0.5, share=0.5)
    losses = []
    for _ in range(15):
        rig.cycle(write=True)
        losses.append(rig.joints.vitals.loss)
    assert losses[:9] == [0.0] * 9
    assert min(losses[12:]) > 0.3


def test_start_up_waits_for_late_servos_until_timeout() -> None:
    rig = JointsRig()
    rig.suffer("bus", "silent", 1.0)
    rig.start()
    np.testing.assert_allclose(rig.joints.q, rig.measured, atol=TICK)
    dead = JointsRig()
    dead.suffer("bus", "silent", 100.0)
    with pytest.raises(BusSetupError, match="none of the 18 servos answers"):
        dead.start()


def test_torque_off_interrupts_servo_queries_at_start_up() -> None:
    rig = JointsRig()
    asked = list[int]()

    def latched() -> bool:
        asked.append(len(rig.bus.said))
        return len(asked) > 40

    Joints(PROFILE, Settings(), rig.plug_in, rig.clock, latched)
    ordered = asked[40]
    words = [(packet.servo_id, packet.code, packet.parameters) for packet in rig.bus.said[ordered : ordered + 2]]
    assert words == [(dxl.BROADCAST_ID, Instruction.WRITE, bytes((dxl.TORQUE_ENABLE.address, 0)))] * 2
    assert len(rig.bus.said) > ordered + 20, "more servos were due"
    rig.bus.advance(rig.clock() + PERIOD)
    assert rig.registers(dxl.TORQUE_ENABLE) == [0] * 18


def test_servo_that_goes_silent_during_start_up_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = JointsRig()

    def set_up(joints: Joints) -> None:
        joints._bus.setup()
        rig.suffer("servo", "silent", 100.0, servo=IDS[SERVO])

    monkeypatch.setattr(Joints, "_set_up_bus", set_up)
    with pytest.raises(ConnectionError, match=f"servo {IDS[SERVO]} stopped answering while its state was read"):
        rig.start()


def test_read_loads_uses_joint_sign_and_zero_for_silent_servos() -> None:
    rig = JointsRig().start()
    load = np.linspace(-0.5, 0.5, 18).reshape(6, 3)
    rig.bank.step(rig.q, np.zeros(18), (PROFILE.servo_signs * load).ravel(), 0.02)
    rig.suffer("servo", "silent", 1.0, servo=IDS[SERVO])
    load[LEG, JOINT] = 0.0
    np.testing.assert_allclose(rig.joints.read_loads(), load, atol=0.005)


# ------------------------------------------------------------------------------------------------------- missed goals

GENTLY, SLOWLY = (dxl.moving_speed_from(speed) for speed in (GENTLE, LOWERED))


def test_only_returning_servo_moves_slowly_until_it_reaches_its_goal() -> None:
    rig = JointsRig().start()
    rig.cycle(8, write=True)
    rig.suffer("servo", "silent", 1.0, servo=IDS[SERVO])
    rig.until(lambda: rig.joints.vitals.missed[SERVO] >= SILENT, write=True)
    moved = rig.joints.goals.copy()
    moved[LEG, JOINT] += np.radians(20.0)
    rig.joints.write(moved)
    rig.until(lambda: rig.joints.vitals.missed[SERVO] == 0, write=True)
    speeds = np.array(rig.registers(dxl.MOVING_SPEED))
    np.testing.assert_array_equal(speeds, np.where(np.arange(18) == SERVO, SLOWLY, 0))
    assert not rig.joints.all_behind, "the others were there all the while"
    rig.until(lambda: not rig.joints.vitals.behind.any(), write=True)
    rig.cycle(2, write=True)
    assert rig.registers(dxl.MOVING_SPEED) == [0] * 18
    assert abs(rig.measured[LEG, JOINT] - moved[LEG, JOINT]) < np.radians(5.0)


def test_all_servos_move_gently_if_contact_is_lost_during_catch_up() -> None:
    rig = JointsRig().start()
    rig.cycle(8, write=True)
    rig.suffer("servo", "silent", 5.0, servo=IDS[SERVO])
    rig.until(lambda: rig.joints.vitals.missed[SERVO] >= SILENT, write=True)
    rig.cycle(write=True)
    assert rig.said_speeds == [SLOWLY if row == SERVO else 0 for row in range(18)]
    rig.joints.mark_stale()
    rig.joints.write(rig.joints.goals)
    assert rig.said_speeds == [GENTLY] * 18


def test_silent_bus_limits_speed_until_all_servos_respond() -> None:
    rig = JointsRig().start()
    rig.cycle(8, write=True)
    assert not rig.joints.not_responding
    rig.suffer("bus", "silent", 0.5)
    begin = rig.now_ns
    rig.until(lambda: rig.joints.not_responding, write=True)
    assert not rig.joints.all_behind
    rig.until(lambda: rig.joints.all_behind, write=True)
    assert rig.now_ns - begin < 0.25e9
    while rig.now_ns - begin < 0.5e9:
        assert rig.said_speeds == [GENTLY] * 18
        rig.cycle(write=True)
    assert rig.joints.all_behind
    rig.until(lambda: not rig.joints.all_behind, write=True)
    assert not rig.joints.not_responding
    assert not rig.joints.vitals.missed.any()
    rig.cycle(2, write=True)
    assert rig.registers(dxl.MOVING_SPEED) == [0] * 18


def test_permanently_silent_servo_delays_recovery_by_less_than_2_s() -> None:
    rig = JointsRig().start()
    rig.cycle(8, write=True)
    rig.suffer("bus", "silent", 0.5)
    rig.suffer("servo", "silent", 100.0, servo=IDS[SERVO])
    rig.until(lambda: rig.joints.all_behind, write=True)
    rig.until(lambda: rig.joints.vitals.newest < 0.05, write=True)
    begin = rig.now_ns
    rig.until(lambda: not rig.joints.all_behind, write=True)
    assert rig.now_ns - begin < 2.0e9
    assert rig.joints.vitals.missed[SERVO] >= SILENT


# --------------------------------------------------------------------------------------------------- corrected horns


def test_correction_of_horns_moves_no_servo_and_next_goals_bring_the_links_to_the_wanted_angles() -> None:
    rig = JointsRig().start()
    rig.cycle(3, write=True)
    goals, q, ticks = rig.joints.goals.copy(), rig.joints.q.copy(), rig.registers(dxl.GOAL_POSITION)
    offsets = np.radians(np.linspace(-4.0, 4.0, 18)).reshape(6, 3)
    rig.joints.correct(offsets)
    np.testing.assert_allclose(rig.joints.q, q + offsets)
    rig.cycle(8, write=True)  # the goals that it holds
    np.testing.assert_allclose(rig.registers(dxl.GOAL_POSITION), ticks, atol=1)
    np.testing.assert_allclose(rig.joints.q, rig.measured + offsets, atol=1e-9)
    rig.joints.write(goals)
    rig.cycle(8)
    np.testing.assert_allclose(rig.joints.q, goals, atol=TICK)
    np.testing.assert_allclose(rig.measured, goals - offsets, atol=TICK)


def test_corrected_goals_keep_joint_limits_with_and_without_the_correction() -> None:
    rig = JointsRig().start()
    offsets = np.radians(np.linspace(-4.0, 4.0, 18)).reshape(6, 3)
    rig.joints.correct(offsets)
    for end in range(2):
        limits = PROFILE.joint_limits[..., end]
        rig.joints.write(limits)
        rig.cycle(8)
        np.testing.assert_allclose(
            rig.measured, np.clip(limits - offsets, *np.moveaxis(PROFILE.joint_limits, -1, 0)), atol=TICK
        )
        np.testing.assert_allclose(rig.joints.q, rig.joints.goals, atol=TICK)


def test_correction_of_horns_survives_a_lost_bus() -> None:
    rig = JointsRig().start()
    offsets = np.full((6, 3), np.radians(2.0))
    rig.joints.correct(offsets)
    rig.suffer("bus", "gone", 0.5)
    rig.until(lambda: rig.joints.gone != "").until(lambda: rig.joints.gone == "")
    np.testing.assert_allclose(rig.joints.q, rig.measured + offsets, atol=TICK)
