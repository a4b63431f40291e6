"""Actuator service when servos fail, legs hang, or the process was stopped."""

import numpy as np
import pytest

from sextant.services.actuator.estimation.state_estimator import StateEstimator
from sextant.services.actuator.locomotion.feedforward import lag_feed_forward
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE, LOWERED
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.servo_model import ServoError
from sextant.shared.wire.messages import Mode
from tests.support.actuator_rig import CRAWL, IDS, PROFILE, REST, TICK, TRIPOD, UP, Rig


def shut_down(rig: Rig, row: int) -> None:
    rig.bank._latched_errors[row] = int(ServoError.OVERLOAD)


def test_low_torque_limit_is_reported_and_restored_by_ready_order() -> None:
    rig = Rig()
    row = IDS.index(9)
    rig.bank.write(row, dxl.TORQUE_LIMIT.address, dxl.TORQUE_LIMIT.encode(300))
    rig.start()
    state = rig.cycle(5)
    words = "the femur servo of the left rear leg (id 9) has only 29% of its torque; order `ready` to restore it"
    assert (state.mode, words in state.warnings) == (Mode.FAULT, True)
    rig.command("ready")
    state = rig.cycle(2)
    assert state.mode is Mode.READY
    assert words not in state.warnings
    assert rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) == dxl.TORQUE_LIMIT.encode(dxl.TORQUE_LIMIT.max)


def test_servo_shutdown_is_named_and_robot_holds() -> None:
    rig = Rig()
    state = rig.walking()
    rig.hear(rig.plan(state))
    rig.cycle(5)
    shut_down(rig, IDS.index(16))
    state = rig.cycle(5)
    assert state.mode is Mode.FAULT
    words = "the femur servo of the right middle leg (id 16) has shut down because of overload"
    assert state.reason == words
    rig.hear(rig.plan(state))
    assert words in rig.cycle().plan_refusal
    assert rig.torque
    rig.command("stand")
    state = rig.cycle(2)
    assert state.mode is Mode.FAULT
    assert f"`stand` refused: {words}" in state.warnings


@pytest.mark.slow
def test_fourth_overload_in_5_minutes_sits_down_and_turns_torque_off() -> None:
    rig = Rig()
    rig.walking()
    row = IDS.index(16)
    for _ in range(3):
        rig.bank.write(row, dxl.TORQUE_LIMIT.address, bytes(2))
        shut_down(rig, row)
        assert rig.cycle(8).mode is Mode.FAULT
        state = rig.cycle(150)
        assert state.mode is Mode.HOLD
        assert state.reason == "the fault has cleared"
        assert rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) == dxl.TORQUE_LIMIT.encode(1023)
    shut_down(rig, row)
    assert rig.cycle(40).mode is Mode.FAULT
    assert rig.cycle(60).mode is Mode.SIT
    state = rig.cycle(200)
    assert state.mode is Mode.OFF
    assert "4 times in 5 minutes" in state.reason
    assert not rig.torque


def test_walk_resumes_only_after_reset_servo_has_caught_up() -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    state = rig.cycle(14)
    assert rig.air(state)[4]
    row = IDS.index(16)
    rig.bank.write(row, dxl.TORQUE_LIMIT.address, bytes(2))
    shut_down(rig, row)
    torque_disabled = rig.joint(row)
    rig.stuck[row] = torque_disabled
    leg = row // 3
    while rig.cycle().mode is Mode.WALK:
        pass
    goals = rig.goals
    state = rig.cycle(36)
    assert state.mode is Mode.FAULT
    assert (rig.air(state) == (np.arange(6) == leg)).all(), "the others have come down"
    np.testing.assert_allclose(rig.goals[leg], goals[leg], atol=1e-9, err_msg="a hanging leg is not commanded")
    while rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) == bytes(2):
        state = rig.cycle()
    del rig.stuck[row]
    seen, highest, found, course = set(), -1.0, state.touchdown_ns, [rig.goals[leg]]
    lies, last = float(state.feet[leg, 2]), rig.goals
    while state.mode is Mode.FAULT:
        seen.add(state.reason)
        state = rig.cycle()
        assert np.abs((rig.goals - last)[leg]).max() <= GENTLE * 0.02 + TICK
        highest, last = max(highest, float(state.feet[leg, 2])), rig.goals
        course.append(last[leg])
        if state.mode is Mode.FAULT and state.phase < 0.5:
            assert state.touchdown_ns[leg] == found[leg]
    assert highest > lies + 0.005, "it goes up before it comes down"
    steps = np.diff(np.array(course), axis=0)
    turns = (steps[1:] * steps[:-1] < 0.0).sum(axis=0)
    assert turns.max() <= 4, "its goals do not hunt"
    assert not rig.air(state).any()
    assert "the femur servo of the right middle leg (id 16) is catching up with its goal, slowly" in seen
    assert state.mode is Mode.HOLD
    assert abs(rig.joint(row) - torque_disabled) > np.radians(8.0), "it is where the others are"


def disable_torque_and_drop_joint(rig: Rig, row: int, by: float) -> None:
    """Shut a servo down and let its joint fall by an angle [rad]."""
    rig.bank.write(row, dxl.TORQUE_LIMIT.address, bytes(2))
    shut_down(rig, row)
    rig.stuck[row] = rig.joint(row) + by


@pytest.mark.slow
def test_two_legs_without_torque_are_recovered_one_after_the_other() -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    state = rig.cycle(40)
    rows = IDS.index(16), IDS.index(9)
    disable_torque_and_drop_joint(rig, rows[0], 0.4)
    rig.cycle(40)
    disable_torque_and_drop_joint(rig, rows[1], 0.4)
    second, order, before = rows[1] // 3, list[int](), None
    state = rig.cycle(5)
    while state.mode is Mode.FAULT:
        for row in [row for row in rig.stuck if rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) != bytes(2)]:
            del rig.stuck[row]
            before = rig.goals[second] if row == rows[1] else before
        state = rig.cycle()
        swings = np.flatnonzero(state.swing).tolist()
        order += [leg for leg in swings if leg not in order]
        if before is not None and second not in order:
            np.testing.assert_allclose(rig.goals[second], before, atol=2 * TICK)
            assert (
                state.reason
                == "the femur servo of the right middle leg (id 16), with 1 more, is catching up with its goal, slowly"
            )
    assert order == [row // 3 for row in rows], "one after the other"
    assert not rig.air(state).any()
    assert state.mode is Mode.HOLD


@pytest.mark.slow
@pytest.mark.parametrize("heard_again", [False, True])
def test_sitting_down_does_not_load_a_leg_with_lost_servo(heard_again: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    rig.cycle(14)
    row = IDS.index(14)  # the coxa of a leg in the air
    rig.bus.cut_off(frozenset([row]))
    rig.stuck[row] = rig.joint(row)
    assert rig.cycle(40).mode is Mode.FAULT
    rig.command("sit")
    monkeypatch.setattr(StateEstimator, "slip_warning", "slipping: left front")  # on its belly all feet may move
    state = rig.cycle(5)
    assert state.mode is Mode.SIT
    assert "slipping: left front" not in state.warnings
    if heard_again:
        rig.bus.cut_off(frozenset())
        rig.stuck.clear()
    while rig.cycle().mode is Mode.SIT:
        pass
    assert body_forward(PROFILE, rig.goals)[:, 2].min() > -0.03, "no foot is far below the body that lies"


@pytest.mark.slow
@pytest.mark.parametrize(("roll", "leg"), [(0.0, 1), (0.12, 1), (0.12, 4), (-0.12, 5)])
@pytest.mark.parametrize("height", [0.008, 0.02])
def test_raised_foot_at_start_up_is_lowered_to_plane_of_stance_feet(roll: float, leg: int, height: float) -> None:
    stands = np.arange(6) != leg
    level = REST + np.where(stands, 0.0, height)[:, None] * UP
    rig = Rig(apply(from_xyz_rpy((0.0, 0.0, 0.0), (roll, 0.0, 0.0)), level))
    rig.ground[:] = False
    rig.push[stands, 2] = 5.0
    rig.cycle()
    rig.start()
    assert rig.cycle().swing.tolist() == (~stands).tolist()
    for _ in range(100):
        last = rig.goals
        state = rig.cycle()
        assert np.abs(rig.goals - last).max() <= LOWERED * 0.02 + TICK
    assert state.mode is Mode.HOLD
    plane = np.column_stack([REST[:, :2], np.ones(6)])
    feet = apply(from_xyz_rpy((0.0, 0.0, 0.0), (-roll, 0.0, 0.0)), body_forward(PROFILE, rig.actuator._motion.goals.wanted))
    slope = np.linalg.lstsq(plane[stands], feet[stands, 2])[0]
    assert abs(feet[leg, 2] - plane[leg] @ slope) < 0.003


def test_stand_is_allowed_after_ready_order_during_servo_catch_up() -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    rig.cycle(14)
    row = IDS.index(16)
    rig.bank.write(row, dxl.TORQUE_LIMIT.address, bytes(2))
    shut_down(rig, row)
    rig.stuck[row] = rig.joint(row)
    while rig.bank.read(row, dxl.TORQUE_LIMIT.address, 2) == bytes(2):
        rig.cycle()
    del rig.stuck[row]
    state = rig.cycle(4)
    assert "is catching up with its goal" in state.reason
    rig.command("ready")
    state = rig.cycle(20)
    assert state.mode is Mode.READY
    rig.command("stand")
    assert rig.cycle(2).mode is Mode.STAND


def test_fault_during_stand_up_aborts_the_motion() -> None:
    rig = Rig(CRAWL, torque=False)
    rig.cycle(2)
    rig.command("stand")
    rig.cycle(20)
    shut_down(rig, 4)
    assert rig.cycle(4).mode is Mode.FAULT
    goals = rig.goals
    rig.bank._latched_errors[:] = 0  # it recovers, but the actuator has not reset it
    assert rig.cycle(200).mode is Mode.READY
    np.testing.assert_array_equal(rig.goals, goals)


def test_restarted_actuator_holds_pose_and_requires_new_walk_order() -> None:
    rig = Rig()
    state = rig.walking()
    for _ in range(2):
        rig.hear(rig.plan(state))
        state = rig.cycle(45)
    before = rig.goals
    rig.start()
    state = rig.cycle()
    assert state.mode is Mode.HOLD
    assert (state.step, state.phase) == (0, 1.0)
    assert np.abs(rig.goals - before).max() < 0.06
    rig.hear(rig.plan(state))
    assert "not ordered to walk" in rig.cycle().plan_refusal  # the new process requires a new order
    rig.order += 1
    rig.command("walk")
    state = rig.cycle(2)
    rig.hear(rig.plan(state))
    assert rig.cycle().mode is Mode.WALK


@pytest.mark.slow
@pytest.mark.parametrize("cycles", [3, 5, 9, 15, 21, 27, 29])
def test_after_process_pause_feet_are_lowered_at_limited_rate(cycles: int) -> None:
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    state = rig.cycle(cycles)
    assert state.mode is Mode.WALK
    if cycles == 15:
        assert (rig.air(state) == TRIPOD).all()
    epoch = state.epoch
    rig.now_ns += 3_500_000_000
    state = rig.cycle()
    assert state.mode is Mode.FAULT
    assert state.reason == "the actuator process did not run for 3.5 s"
    for _ in range(100):
        last = rig.goals
        state = rig.cycle()
        assert np.abs(rig.goals - last).max() <= np.radians(30.0) * 0.04 + TICK  # a cycle may take two periods
    assert state.epoch > epoch
    assert not rig.air(state).any()
    assert state.mode is Mode.HOLD


def test_plans_are_refused_until_joints_have_caught_up_after_pause() -> None:
    rig = Rig()
    epoch = rig.walking().epoch
    rig.stuck[0] = rig.joint(0) + 0.09  # the joint restarts here, and its goal has moved here, too
    rig.now_ns += 3_500_000_000
    refused: list[str] = []
    for _ in range(150):
        state = rig.cycle()
        if state.epoch > epoch and state.mode is Mode.HOLD:
            before = rig.goals
            rig.hear(rig.plan(state, stamp_ns=rig.now_ns))
            state = rig.cycle()
            if state.mode is Mode.WALK:
                break
            refused.append(state.plan_refusal)
            assert np.abs(rig.goals - before).max() <= np.radians(30.0) * 0.02 + TICK
    assert state.mode is Mode.WALK
    assert refused
    assert refused[-1].endswith("refused: the joints are catching up with their goals, slowly")


@pytest.mark.parametrize("cycles", [3, 15, 27])
def test_feedforward_rate_is_zero_in_first_cycle_after_process_pause(cycles: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rates: list[float] = []

    def noted(profile: RobotProfile, q_rate: Array, held_s: float) -> Array:
        rates.append(float(np.abs(q_rate).max()))
        return lag_feed_forward(profile, q_rate, held_s)

    monkeypatch.setattr("sextant.services.actuator.locomotion.joint_goals.lag_feed_forward", noted)
    rig = Rig()
    rig.hear(rig.plan(rig.walking()))
    epoch = rig.cycle(cycles).epoch
    rig.now_ns += 3_500_000_000
    while rig.cycle().epoch == epoch:
        rates.clear()
    assert rates[0] == 0.0


@pytest.mark.parametrize("mode", ["off", "ready"])
def test_lying_robot_reports_unresponsive_bus(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(torque=False)
    rig.cycle(2)
    if mode == "ready":
        rig.command("ready")
    rig.cycle(10)
    read = rig.port.read
    monkeypatch.setattr(rig.port, "read", lambda size=1: read(size)[:0])
    state = rig.cycle(20)
    assert state.mode.value == mode
    assert "no servo answers; check the power of the bus, its cable and the adapter" in state.warnings


@pytest.mark.slow
@pytest.mark.parametrize("order", ["ready", "stand"])
def test_stand_is_allowed_after_servo_reset_on_a_resting_robot(order: str) -> None:
    """Check that an interrupted motion is not resumed after a reset.

    The actuator gave it up when the servo shut down.
    """
    rig = Rig(feet=CRAWL, torque=False)
    rig.cycle(2)
    rig.command("ready")
    rig.cycle(5)
    if order == "stand":
        rig.command("stand")
    rig.cycle(20)
    shut_down(rig, IDS.index(16))
    state = rig.cycle(10)
    assert state.mode is (Mode.FAULT if order == "stand" else Mode.READY)
    state = rig.cycle(60)
    assert (state.mode, rig.bank._latched_errors.any()) == (Mode.READY, False)
    rig.command("stand")
    assert rig.cycle(200).mode is Mode.HOLD
