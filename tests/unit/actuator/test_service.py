"""Actuator service: torque, orders and plans."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.services.simulator.servo_bus.bus import ServoBusEmulator
from sextant.services.simulator.servo_bus.servo_bank import ServoBank
from sextant.shared.geometry import apply, from_xyz_rpy, inverse
from sextant.shared.robot.kinematics import body_forward, joint_torques
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire.messages import Mode, ModeCommand, Odometry
from tests.support.actuator_rig import CRAWL, OUT, PERIOD, PROFILE, REST, TRIPOD, Rig


def test_start_up_keeps_torque_state() -> None:
    for torque in (True, False):
        rig = Rig(torque=torque)
        state = rig.cycle(5)
        assert rig.torque == torque
        assert state.mode == (Mode.HOLD if torque else Mode.OFF)


def test_start_up_on_standing_robot_does_not_jerk_joints() -> None:
    rig = Rig()
    before = rig.goals
    states = []
    for _ in range(20):
        goals = rig.goals
        states.append(rig.cycle())
        assert np.abs(rig.goals - goals).max() <= GENTLE * 1e-9 * PERIOD + dxl.TICK_RAD
    # The goals change once by the sag under load; then nothing moves.
    after = rig.goals
    assert np.abs(after - before).max() < 0.08
    assert np.abs(states[-1].feet - states[-2].feet).max() < 1e-3


def test_off_writes_no_goals() -> None:
    rig = Rig(CRAWL, torque=False)
    before = rig.goals
    rig.cycle(20)
    np.testing.assert_array_equal(rig.goals, before)


def test_stand_raises_a_lying_robot_to_rest() -> None:
    rig = Rig(CRAWL, torque=False)
    rig.cycle(2)
    rig.command("stand")
    assert rig.cycle().mode is Mode.STAND
    assert rig.cycle(2).mode is Mode.STAND
    state = rig.cycle(round(Settings().stand_s * 50))
    assert rig.torque
    assert state.mode is Mode.HOLD
    assert state.reason == "standing"
    feet = body_forward(PROFILE, rig.goals)
    np.testing.assert_allclose(feet[:, :2], (REST + 0.03 * OUT)[:, :2], atol=0.03)
    assert (feet[:, 2] < REST[:, 2] + 2e-3).all()  # the sag is fed forward: feet go beyond the height, never short of it


def test_repeated_order_sequence_is_ignored() -> None:
    rig = Rig()
    rig.cycle()
    rig.command("stand")
    rig.cycle()
    rig.hear(ModeCommand(rig.now_ns, "off", rig.order))  # with a sequence number that was used before
    assert rig.cycle().mode is Mode.STAND
    assert rig.torque


def test_second_stand_order_does_not_jump() -> None:
    rig = Rig()
    rig.cycle(5)
    before = rig.goals
    rig.command("stand")
    rig.cycle(2)
    assert np.abs(rig.goals - before).max() < 0.02


def test_off_order_during_walk_turns_torque_off_at_once() -> None:
    rig = Rig()
    rig.walking()
    rig.command("off")
    rig.cycle(2)
    assert not rig.torque
    rig.command("walk")  # has no effect in this mode
    state = rig.cycle(2)
    assert state.mode is Mode.OFF
    assert not rig.torque


def test_torque_stays_off_after_restart_until_new_order(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "off")
    rig = Rig(latch=latch)
    rig.walking()
    rig.command("off")
    rig.cycle(2)
    assert latch.closed
    rig.bank.tables[:, dxl.TORQUE_ENABLE.address] = 1  # the servos missed the order: the bus was gone
    before = rig.goals
    rig.start()  # a new process on servos with torque enabled
    rig.bus.advance(rig.now_ns)
    assert not rig.torque, "before anything else"
    np.testing.assert_array_equal(rig.goals, before)
    rig.leads = False
    assert rig.cycle(50).mode is Mode.OFF
    rig.command("stand")
    assert rig.cycle(2).mode is Mode.STAND
    assert rig.torque
    assert not latch.closed


def test_latched_process_turns_torque_off_before_first_bus_read(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "off")
    rig = Rig(latch=latch)
    latch.close()
    heard: list[bytes] = []
    rig.bus.overhear = lambda data, _: heard.append(data)
    rig.start()
    assert heard[0] == dxl.write(dxl.BROADCAST_ID, dxl.TORQUE_ENABLE.address, b"\0")


def test_closed_latch_turns_torque_off_without_any_message(tmp_path: Path) -> None:
    latch = Latch(tmp_path / "off")
    rig = Rig(latch=latch)
    rig.walking()
    latch.close()
    state = rig.cycle(2)
    assert state.mode is Mode.OFF
    assert not rig.torque


class LateLatch(Latch):
    """A latch that another process closes right after a check, once it is armed."""

    armed = False

    @property
    def closed(self) -> bool:
        was = super().closed
        if self.armed:
            self.close()
        return was


def test_latch_closed_in_mid_cycle_turns_torque_off_before_any_goal(tmp_path: Path) -> None:
    """Check a process that was stopped after its check and continues much later."""
    latch = LateLatch(tmp_path / "off")
    rig = Rig(latch=latch)
    rig.walking()
    heard: list[bytes] = []
    rig.bus.overhear = lambda data, _: heard.append(data)
    latch.armed = True
    rig.cycle(3)
    writes = [data[5] for data in heard if data[4] in (dxl.Instruction.WRITE, dxl.Instruction.SYNC_WRITE)]  # address
    assert writes[0] == dxl.TORQUE_ENABLE.address
    assert dxl.GOAL_POSITION.address not in writes
    assert not rig.torque


def test_goals_are_not_sent_after_long_pause_within_a_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    state = rig.walking()
    rig.hear(rig.plan(state))
    rig.cycle(5)
    heard: list[bytes] = []
    rig.bus.overhear = lambda data, _: heard.append(data)
    read = rig.port.read

    def stopped(size: int = 1) -> bytes:
        data, rig.now_ns = read(size), rig.port.now_ns() + 2_000_000_000
        monkeypatch.undo()
        return data

    monkeypatch.setattr(rig.port, "read", stopped)
    rig.cycle()
    assert len(heard) >= 1, "it has asked"
    assert not [data for data in heard if data[4] == dxl.Instruction.SYNC_WRITE]
    rig.cycle()
    assert [data for data in heard if data[4] == dxl.Instruction.SYNC_WRITE and data[5] == dxl.GOAL_POSITION.address]


def test_plan_without_walk_order_is_refused_with_reason() -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.cycle(2)))
    state = rig.cycle()
    assert state.mode is Mode.HOLD
    assert "not ordered to walk" in state.plan_refusal
    assert "not ordered to walk" in rig.actuator.status()


def test_plan_is_executed_then_robot_holds_with_torque_on() -> None:
    rig = Rig()
    state = rig.walking()
    start, plan = state.T_odom_body, rig.plan(state)
    rig.hear(plan)
    modes, phases = [], []
    for _ in range(40):
        state = rig.cycle()
        modes.append(state.mode)
        phases.append(state.phase)
    assert modes[0] is Mode.WALK
    assert modes[-1] is Mode.HOLD
    assert "no new plan received" in state.reason
    assert rig.torque
    assert state.step == plan.step
    assert (np.diff(phases) >= 0).all()
    assert phases[-1] == 1.0
    assert state.plan_refusal == ""
    assert (inverse(start) @ state.T_odom_body)[0, 3] == pytest.approx(0.04, abs=0.015)
    held = rig.goals
    rig.cycle(50)
    assert np.abs(rig.goals - held).max() < 4.5 * dxl.TICK_RAD


def test_published_odometry_matches_joint_odometry() -> None:
    rig = Rig()
    state = rig.walking()
    for _ in range(3):
        rig.hear(rig.plan(state))
        state = rig.cycle(45)
    if len(rig.made) == 1:  # odometry only: the state comes with the next cycle
        state = rig.cycle()
    odometry = next(m for m in rig.made if isinstance(m, Odometry))
    assert odometry.reliable
    assert odometry.stance.all()
    assert odometry.stamp_ns == state.stamp_ns
    np.testing.assert_array_equal(odometry.T_odom_body, state.T_odom_body)
    np.testing.assert_allclose(state.T_odom_body[:2, 3], state.body_ref[:2, 3], atol=5e-3)
    assert odometry.path_length >= np.linalg.norm(state.T_odom_body[:2, 3]) - 1e-9


def test_state_has_joint_angles_by_the_horns_of_the_profile_and_feet_by_the_corrected_ones() -> None:
    """`sextant camera calibrate` measures the horns of the profile by these angles."""
    rig = Rig()
    state = rig.cycle(20)
    np.testing.assert_allclose(body_forward(PROFILE, state.q), state.feet, atol=1e-9)
    offsets = np.radians(np.linspace(-4.0, 4.0, 18)).reshape(6, 3)
    rig.actuator._joints.correct(offsets)
    after = rig.cycle(2)
    np.testing.assert_allclose(after.q, state.q, atol=0.02)
    np.testing.assert_allclose(body_forward(PROFILE, after.q + offsets), after.feet, atol=1e-9)


def test_refused_plan_does_not_change_step_or_mode() -> None:
    rig = Rig()
    state = rig.walking()
    rig.hear(rig.plan(state, duration=99.0))
    after = rig.cycle()
    assert after.mode is Mode.HOLD
    assert "99.00 s" in after.plan_refusal
    assert after.step == state.step
    rig.hear(rig.plan(after))
    assert rig.cycle().plan_refusal == ""


def test_an_old_plan_is_refused() -> None:
    rig = Rig()
    state = rig.walking()
    plan = rig.plan(state)
    rig.cycle(60)
    rig.hear(plan)
    assert "s old" in rig.cycle().plan_refusal


def test_next_plan_waits_for_running_step_without_a_pause() -> None:
    rig = Rig()
    state = rig.walking()
    first = rig.plan(state)
    rig.hear(first)
    state = rig.cycle(26)  # so that the next plan waits less than the deadline: no plan renews it
    swing = ~first.swing
    goal = first.body_goal @ from_xyz_rpy((0.04, 0.0, 0.0), np.zeros(3))
    touchdown = np.where(swing[:, None], apply(goal, REST + np.array([0.02, 0.0, 0.0])), first.touchdown)
    touchdown[:, 2] = first.touchdown[:, 2]
    rig.hear(replace(first, stamp_ns=state.stamp_ns, step=first.step + 1, swing=swing, touchdown=touchdown, body_goal=goal))
    state = rig.cycle()
    assert state.plan_refusal == ""
    assert state.step == first.step
    modes = []
    for _ in range(20):
        state = rig.cycle()
        modes.append(state.mode)
    assert state.step == first.step + 1
    assert set(modes) == {Mode.WALK}


def test_contacts_and_loads_follow_servo_readings() -> None:
    rig = Rig()
    rig.ground[:] = False
    rig.push[TRIPOD, 2] = 8.0
    state = rig.cycle(40)
    np.testing.assert_array_equal(state.contact, TRIPOD)
    expected = joint_torques(PROFILE, state.q, rig.push)
    np.testing.assert_allclose(state.load_nm, expected, atol=0.02)
    assert 9.0 < state.voltage < 13.0
    assert 20.0 < state.temperature < 40.0


def test_start_up_fails_if_servos_are_missing() -> None:
    rig = Rig()
    rig.bus = ServoBusEmulator(ServoBank([1, 2, 3]))
    with pytest.raises(OSError, match="15 of 18 servos are not ready"):
        rig.start()


@pytest.mark.parametrize(
    "nonsense", [{"rate_hz": 5.0}, {"read_budget_ms": 30.0}, {"unload_s": 0.0}, {"load_s": 0.29}, {"brake_s": 0.0}]
)
def test_invalid_settings_are_refused(nonsense: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Settings(**nonsense)  # type: ignore[arg-type]
