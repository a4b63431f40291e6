"""The recorder on the servo bus, with given bytes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.faults.bus_log import Recorder, Role
from sextant.services.actuator.servo_bus.group_writes import GroupWrites
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo import dynamixel2
from sextant.shared.servo.servo_model import Recovery
from tests.support.families import FAMILIES, MIXED, mixed_robot, robot_with
from tests.support.timelines import PROFILE

IDS = PROFILE.servo_ids.ravel().tolist()
CENTRE = np.rint(dxl.TICK_CENTRE + PROFILE.servo_angles(PROFILE.joint_limits.mean(axis=-1)).ravel() / dxl.TICK_RAD).astype(int)


def goals(ticks: np.ndarray, speed: int = 0) -> bytes:
    rows = [(i, dxl.GOAL_POSITION.encode(int(t)) + dxl.MOVING_SPEED.encode(speed)) for i, t in zip(IDS, ticks, strict=True)]
    return dxl.sync_write(dxl.GOAL_POSITION.address, 4, rows)


@given(st.integers(0, 17), st.integers(0, 1023))
def test_goal_outside_joint_limits_is_detected_exactly(index: int, ticks: int) -> None:
    recorder = Recorder(PROFILE)
    wanted = CENTRE.copy()
    wanted[index] = ticks
    recorder.sent(goals(wanted), 1_000_000_000)
    leg, joint = divmod(index, 3)
    every = PROFILE.servo_angles(np.moveaxis(PROFILE.joint_limits, -1, 0))[:, leg, joint]
    low, high = np.rint(dxl.TICK_CENTRE + np.sort(every) / dxl.TICK_RAD)
    assert [out.servo for out in recorder.outside] == ([] if low <= ticks <= high else [IDS[index]])
    assert (recorder.goals[0].ticks == wanted).all()
    assert recorder.goals[0].t_s == 1.0
    recorder.sent(goals(CENTRE, 45), 2_000_000_000)
    assert [set(sent.speeds.tolist()) for sent in recorder.goals] == [{0}, {45}]


def test_torque_switches_are_logged_as_sent_and_received() -> None:
    recorder = Recorder(PROFILE)
    off = dxl.sync_write(dxl.TORQUE_ENABLE.address, 1, [(i, b"\0") for i in IDS])
    recorder.sent(off, 0)
    recorder.heard(off[:-1] + bytes([off[-1] ^ 1]), 0)
    assert [(s.heard, set(s.values.values())) for s in recorder.switches] == [(False, {0})]
    recorder.heard(off[:20], 0)
    recorder.heard(off[20:], 0)
    assert recorder.switches[-1].heard
    assert len(recorder.switches[-1].values) == 18
    recorder.heard(dxl.write(16, dxl.TORQUE_LIMIT.address, dxl.TORQUE_LIMIT.encode(1023)), 0)
    assert recorder.switches[-1].values == {16: 1023}
    assert recorder.switches[-1].role is Role.RESET


def test_broadcast_write_is_logged_for_all_servos_and_read_is_not() -> None:
    recorder = Recorder(PROFILE)
    recorder.heard(dxl.write(dxl.BROADCAST_ID, dxl.TORQUE_ENABLE.address, b"\1"), 0)
    assert recorder.switches[0].values == dict.fromkeys(IDS, 1)
    recorder.heard(dxl.read(16, dxl.TORQUE_ENABLE.address, 1), 0)
    assert len(recorder.switches) == 1


@pytest.mark.parametrize("name", FAMILIES)
def test_goals_switches_and_resets_are_read_from_each_family(name: str) -> None:
    profile = robot_with(name)
    model, ids = profile.servo_model, profile.servo_ids.ravel().tolist()
    table, protocol, recorder = model.table, model.protocol, Recorder(profile)
    if model.commands is None:
        start, size = table.goals.address, table.goals.size
    else:  # one packet for each servo, with a time instead of a speed
        ((start, size),) = model.commands.inside(table.goal_position.address, table.goal_position.size)
    row = bytearray(size)
    for register, value in ((table.goal_position, model.units.centre), (table.goal_speed, 77)):
        if model.has(register):
            at = register.address - start
            row[at : at + register.size] = register.encode(value)
    recorder.sent(protocol.sync_write(start, size, [(i, bytes(row)) for i in ids]), 0)
    goals = recorder.goals[-1]
    assert len(recorder.goals) == (1 if model.commands is None else len(ids))
    assert set(goals.ticks.tolist()) == {model.units.centre}
    assert set(goals.speeds.tolist()) == {77 if model.has(table.goal_speed) else 0}
    assert not recorder.outside
    recorder.heard(protocol.write(protocol.BROADCAST_ID, table.torque_enable.address, b"\0"), 0)
    limit = table.torque_limit
    match model.recovery:
        case Recovery.TORQUE_LIMIT:
            recorder.heard(protocol.write(3, limit.address, limit.encode(limit.max)), 0)
        case Recovery.TORQUE_ENABLE:
            recorder.heard(protocol.write(3, table.torque_enable.address, b"\0"), 0)
        case Recovery.REBOOT:
            recorder.heard(dynamixel2.reboot(3), 0)
    resets = [] if model.recovery is Recovery.ITSELF else [(Role.RESET, [3])]
    assert [(switch.role, list(switch.values)) for switch in recorder.switches] == [(Role.TORQUE, ids), *resets]


@pytest.mark.parametrize("name", MIXED)
def test_goals_and_switches_of_mixed_servos_are_in_the_units_and_registers_of_each(name: str) -> None:
    coxa, femur = name.split("+")
    profile = mixed_robot(coxa, femur, coxa)
    models, joints = profile.servos.models, profile.joint_limits
    recorder, writes = Recorder(profile), GroupWrites(models[0].protocol, profile.servo_ids.ravel().tolist(), models)
    middle = profile.servo_angles(joints.mean(axis=-1)).ravel()
    ends = np.sort(profile.servo_angles(np.moveaxis(joints, -1, 0)), axis=0)[1].ravel()
    for index in range(18):
        for beyond in (0, 2):
            goals = [model.units.ticks(angle) for model, angle in zip(models, middle, strict=True)]
            goals[index] = min(models[index].units.ticks(ends[index]) + beyond, models[index].units.max_position)
            outside = goals[index] > models[index].units.ticks(ends[index])
            before = len(recorder.outside)
            for packet in writes.goals(goals, 0)[1]:
                recorder.sent(packet, 0)
            assert recorder.goals[-1].ticks.tolist() == goals
            assert {one.servo for one in recorder.outside[before:]} <= {int(profile.servo_ids.flat[index])}
            assert (len(recorder.outside) > before) == outside
    for packet in writes.torque_off():
        recorder.heard(packet, 0)
    off = {servo_id for switch in recorder.switches for servo_id in switch.values}
    assert off == set(profile.servo_names)
    assert {switch.role for switch in recorder.switches} == {Role.TORQUE}
