"""Servos on a workbench, moving in the host's time.

They are plugged in, unplugged, and bent by hand.
"""

import numpy as np
import pytest

from sextant.services.simulator.servo_bus import servo_bank
from sextant.services.simulator.servo_bus.bench_emulator import HORNS_DEG, BenchEmulator
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.dynamixel import PacketParser
from sextant.shared.servo.servo_model import Packet

PROFILE = load_profile("phantomx_mk2")
MS = 1_000_000


def bench(*, fresh: bool = False, rate: int | None = None, seed: int = 2) -> BenchEmulator:
    return BenchEmulator(PROFILE, np.random.default_rng(seed), fresh=fresh, rate=rate)


def answers(made: BenchEmulator, packet: bytes, now_ns: int) -> list[Packet]:
    return PacketParser().feed(b"".join(reply.data for reply in made.receive(packet, now_ns)))


def test_servo_reaches_goal_at_moving_speed_in_host_time() -> None:
    made, row = bench(), 4
    start = dxl.ticks_from_angle(made._q[row])
    servo_id = list(PROFILE.servo_names)[row]
    for register, value in ((dxl.MOVING_SPEED, 30), (dxl.TORQUE_ENABLE, 1), (dxl.GOAL_POSITION, start + 30)):
        made.receive(dxl.write(servo_id, register.address, register.encode(value)), 0)
    speed = 30 * dxl.SPEED_RAD_S
    for now_ms in range(0, 300, 20):
        made.receive(b"", now_ms * MS)
        assert made._q[row] - dxl.angle_from_ticks(start) <= speed * now_ms * 1e-3 + dxl.TICK_RAD
    made.receive(b"", 2_000 * MS)
    assert made._q[row] == pytest.approx(dxl.angle_from_ticks(start + 30), abs=2 * dxl.TICK_RAD)
    others = np.delete(np.arange(18), row)
    np.testing.assert_array_equal(made._q[others], bench()._q[others])


def test_bent_leg_stays_without_torque_and_returns_with_torque() -> None:
    made = bench()
    made.execute("bend left front 0 30 -20")
    made.receive(b"", 500 * MS)
    q = made.robot.joint_angles(made._q.reshape(6, 3))
    np.testing.assert_allclose(np.degrees(q[0]), [0.0, 30.0, -20.0], atol=1e-9)
    made.receive(dxl.write(dxl.BROADCAST_ID, dxl.TORQUE_ENABLE.address, b"\x01"), 500 * MS)
    made.receive(b"", 600 * MS)
    made.execute("bend left front 0 0 0")
    made.receive(b"", 2_500 * MS)
    q = made.robot.joint_angles(made._q.reshape(6, 3))
    np.testing.assert_allclose(np.degrees(q[0]), [0.0, 30.0, -20.0], atol=0.6)


def test_horn_misalignment_follows_seed() -> None:
    trims = [np.degrees(bench(seed=seed).robot.trims) for seed in (2, 2, 3)]
    np.testing.assert_array_equal(trims[0], trims[1])
    assert (trims[0] != trims[2]).any()
    assert 0.0 < np.abs(trims).max() <= HORNS_DEG


def test_new_servos_can_be_plugged_in_and_unplugged() -> None:
    made = bench(fresh=True)
    assert answers(made, dxl.ping(1), 0) == []
    assert made.execute("plug") == "1 servo is plugged in: 1; 17 not"
    assert len(answers(made, dxl.ping(1), 10 * MS)) == 1
    made.receive(dxl.write(1, dxl.ID.address, b"\x05"), 20 * MS)
    assert made.execute("plug 2") == "3 servos are plugged in: 1, 1, 5; 15 not"
    assert made.execute("unplug 1") == "2 servos are plugged in: 1, 5; 16 not"
    assert made.execute("unplug 1") == "1 servo is plugged in: 5; 17 not"
    assert made.execute("unplug") == "0 servos are plugged in: none; 18 not"
    assert answers(made, dxl.ping(5), 30 * MS) == []


def test_power_loss_clears_torque_and_lock_but_keeps_id() -> None:
    made = bench()
    for register in (dxl.TORQUE_ENABLE, dxl.LOCK):
        made.receive(dxl.write(3, register.address, b"\x01"), 0)
    made.receive(b"", 10 * MS)
    (row,) = made._with_id(3)
    assert made._servos.tables[row, [dxl.TORQUE_ENABLE.address, dxl.LOCK.address]].tolist() == [1, 1]
    made.unplug([row])
    made.plug([row])
    table = made._servos.tables[row]
    assert table[[dxl.ID.address, dxl.TORQUE_ENABLE.address, dxl.LOCK.address]].tolist() == [3, 0, 0]


def test_host_at_other_baud_rate_gets_no_reply() -> None:
    made = bench(rate=1_000_000)
    assert len(answers(made, dxl.ping(1), 0)) == 1
    made.set_baud_rate(57_143)
    assert answers(made, dxl.ping(1), 10 * MS) == []
    made.set_baud_rate(None)
    assert len(answers(made, dxl.ping(1), 20 * MS)) == 1


@pytest.mark.parametrize(
    "line", ["", "plug x", "plug 1 2", "bend left knee 0 0 0", "bend left front 0 1.2.3 0", "bend left front 0 0", "jump"]
)
def test_unknown_command_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match=r"one of plug \[N\], .* expected, found"):
        bench().execute(line)


@pytest.mark.parametrize("line", ["unplug 99", "bend left front 0 999 0"])
def test_impossible_command_is_refused_without_effect(line: str) -> None:
    made = bench()
    before = made.execute("list")
    with pytest.raises(ValueError, match=rf"expected, found '{line}'"):
        made.execute(line)
    assert made.execute("list") == before


@pytest.mark.parametrize("fresh", [False, True])
def test_loops_are_compiled_before_first_request(fresh: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile before the first request.

    Compilation takes seconds on a new machine; a host takes such a late answer for a loose cable.
    """
    loops = ("update_heat", "measure", "update_controllers")
    called = []
    for name in loops:
        loop = getattr(servo_bank, name)
        monkeypatch.setattr(servo_bank, name, lambda *words, name=name, loop=loop: (called.append(name), loop(*words))[1])
    bench(fresh=fresh)
    assert set(called) == set(loops)
