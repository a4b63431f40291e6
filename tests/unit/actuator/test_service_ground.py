"""Actuator service on missing or sloped ground, and when the robot tips over."""

import numpy as np
import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.locomotion.step_executor import StepExecutor
from sextant.shared.geometry import Array, apply, from_xyz_rpy, rotation_from_rpy
from sextant.shared.robot.kinematics import body_forward
from sextant.shared.servo.servo_model import ServoError
from sextant.shared.wire.messages import ActuatorState, Imu, Mode
from tests.support.actuator_rig import PROFILE, REST, STILL, UP, Rig


def take_two_steps(rig: Rig, first: ActuatorState) -> tuple[ActuatorState, list[ActuatorState]]:
    """Take two steps; return the last state and all states on the way.

    The second step is planned when the first has ended.
    """
    rig.hear(rig.plan(first))
    states = [rig.cycle() for _ in range(40)]
    rig.hear(rig.plan(states[-1]))
    states += [rig.cycle() for _ in range(200)]
    return states[-1], states


def test_foot_without_ground_reaches_down_then_step_is_reversed() -> None:
    rig = Rig()
    first = rig.walking()
    lost = int(np.flatnonzero(rig.plan(first).swing)[0])
    stood = apply(first.T_odom_body, first.feet)
    rig.ground[lost] = False
    state, states = take_two_steps(rig, first)
    reasons = [s.reason for s in states]
    assert any("the foot reaches down" in r for r in reasons)
    assert state.mode is Mode.HOLD
    assert "the step is reversed" in state.reason
    assert state.touchdown_ns[lost] > 0
    assert not state.touchdown_contact[lost]
    assert state.touchdown_point[lost, 2] < -0.02, "it has looked below the ground"
    others = [leg for leg in range(6) if leg != lost and state.touchdown_ns[leg] > 0]
    assert others
    assert state.touchdown_contact[others].all()
    np.testing.assert_allclose(state.touchdown_point[others, 2], 0.0, atol=6e-3)
    feet = apply(state.T_odom_body, state.feet)
    np.testing.assert_allclose(feet[lost, :2], stood[lost, :2], atol=0.015)
    assert not state.swing.any()


def test_plan_is_refused_while_a_foot_searches_for_ground() -> None:
    rig = Rig()
    first = rig.walking()
    rig.ground[int(np.flatnonzero(rig.plan(first).swing)[0])] = False
    rig.hear(rig.plan(first))
    rig.cycle(40)
    assert rig.state is not None
    rig.hear(rig.plan(rig.state))
    while "the foot reaches down" not in rig.cycle().reason:
        assert rig.now_ns < 10_000_000_000
    rig.hear(rig.plan(rig.state))
    assert "no ground under" in rig.cycle(2).plan_refusal


def measured_up(rig: Rig, R_level_ground: Array) -> Array:
    """Return up (3,) {body} of a robot that stands with six feet on a plane."""
    feet = body_forward(PROFILE, rig.goals)
    ahead, aside, _ = np.linalg.lstsq(np.column_stack([feet[:, :2], np.ones(6)]), feet[:, 2], rcond=None)[0]
    normal = np.array([-ahead, -aside, 1.0]) / np.linalg.norm([ahead, aside, 1.0])
    x = np.array([normal[2], 0.0, -normal[0]]) / np.hypot(normal[0], normal[2])
    R_ground_body = np.array([x, np.cross(normal, x), normal])
    return np.asarray((R_level_ground @ R_ground_body)[2])


def cycle_with_imu(rig: Rig, up: Array) -> ActuatorState:
    """Run a cycle with an inertial sensor that measures up (3,) {body}."""
    rig.hear(Imu(rig.now_ns, np.zeros(3), 9.81 * up))
    return rig.cycle()


@pytest.mark.slow
@pytest.mark.parametrize("slope", [(4.0, 0.0), (0.0, -5.0), (3.0, 3.0)])
def test_body_levels_on_slope_with_imu(slope: tuple[float, float]) -> None:
    rig, R = Rig(), rotation_from_rpy(np.radians([*slope, 0.0]))
    rig.walking()
    tilted = np.degrees(np.arccos(measured_up(rig, R)[2]))
    for _ in range(500):
        state = cycle_with_imu(rig, measured_up(rig, R))
    up = measured_up(rig, R)
    assert tilted > 3.5
    assert np.degrees(np.arccos(up[2])) < 1.0
    np.testing.assert_allclose(state.T_odom_body[2, :3], up, atol=np.radians(1.0))
    assert rig.state is not None
    assert rig.state.warnings == ()
    later = rig.cycle(20)
    assert any("no IMU readings" in warning for warning in later.warnings)
    np.testing.assert_allclose(later.T_odom_body[2, :3], up, atol=np.radians(1.0))


@pytest.mark.slow
def test_tipping_robot_finishes_step_then_holds_with_reason() -> None:
    rig, upright = Rig(), UP
    state = rig.walking()
    for _ in range(250):
        state = cycle_with_imu(rig, upright)
    rig.hear(rig.plan(state))
    for _ in range(10):
        state = cycle_with_imu(rig, upright)
    assert state.mode is Mode.WALK
    for tilt in np.radians(np.arange(0.0, 35.0, 2.5)):
        rig.hear(Imu(rig.now_ns, np.array([np.radians(125.0), 0.0, 0.0]), 9.81 * rotation_from_rpy((tilt, 0.0, 0.0))[2]))
        state = rig.cycle()
    running = state.step
    while state.mode is Mode.WALK:
        state = cycle_with_imu(rig, rotation_from_rpy((np.radians(35.0), 0.0, 0.0))[2])
    assert state.mode is Mode.HOLD
    assert state.step == running
    assert "deg from the commanded pose, by the IMU" in state.reason
    assert any("by the IMU" in warning for warning in state.warnings)
    rig.hear(rig.plan(state))
    assert "by the IMU" in rig.cycle().plan_refusal
    assert rig.torque


def walk_with_trusted_imu(rig: Rig, up: Array = UP) -> ActuatorState:
    """Run until walking is allowed and the sensor is trusted; up is (3,) {body}."""
    rig.walking()
    for _ in range(250):
        state = cycle_with_imu(rig, up)
    return state


def tip(rig: Rig, angle: float, cycles: int = 25) -> ActuatorState:
    """Lean the robot to one side by an angle [rad]."""
    for share in np.linspace(0.0, 1.0, cycles):
        up = rotation_from_rpy((share * angle, 0.0, 0.0))[2]
        rig.hear(Imu(rig.now_ns, np.array([angle / (cycles * 0.02), 0.0, 0.0]), 9.81 * up))
        state = rig.cycle()
    return state


@pytest.mark.slow
def test_lifted_and_turned_robot_does_not_move_legs() -> None:
    rig = Rig()
    walk_with_trusted_imu(rig)
    goals = rig.goals
    for _ in range(100):
        rig.hear(Imu(rig.now_ns, np.array([0.0, 0.0, 1.5]), 9.81 * UP))
        rig.cycle()
        np.testing.assert_allclose(rig.goals, goals, atol=STILL)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [1.0, np.pi / 2, 3.0])
def test_fallen_robot_does_not_move_legs(angle: float) -> None:
    rig = Rig()
    walk_with_trusted_imu(rig)
    state = tip(rig, angle)
    assert any("from the commanded pose" in warning for warning in state.warnings)
    goals = rig.goals
    for _ in range(150):
        state = cycle_with_imu(rig, rotation_from_rpy((angle, 0.0, 0.0))[2])
    np.testing.assert_allclose(rig.goals, goals, atol=STILL)
    assert any("from the commanded pose" in warning for warning in state.warnings)


@pytest.mark.slow
def test_upside_down_imu_does_not_move_legs() -> None:
    rig = Rig()
    rig.walking()
    rig.cycle(300)
    goals = rig.goals
    for _ in range(500):
        state = cycle_with_imu(rig, -UP)
    np.testing.assert_allclose(rig.goals, goals, atol=STILL)
    assert any("180 deg from the commanded pose" in warning for warning in state.warnings)


@pytest.mark.slow
def test_faulty_robot_does_not_level_when_tilted() -> None:
    rig = Rig()
    walk_with_trusted_imu(rig)
    rig.bank._latched_errors[4] = int(ServoError.ANGLE_LIMIT)
    rig.cycle(20)
    goals = rig.goals
    tip(rig, np.radians(10.0))
    for _ in range(150):
        state = cycle_with_imu(rig, rotation_from_rpy((np.radians(10.0), 0.0, 0.0))[2])
    assert state.mode is Mode.FAULT
    np.testing.assert_allclose(rig.goals, goals, atol=STILL)


@pytest.mark.slow
@pytest.mark.parametrize("heard", [True, False])
def test_walking_after_tipping_requires_new_order(heard: bool) -> None:
    """Check that neither a return upright nor a silent sensor allows walking again."""
    rig = Rig()
    walk_with_trusted_imu(rig)
    tip(rig, np.radians(35.0))
    for _ in range(400):
        state = cycle_with_imu(rig, UP) if heard else rig.cycle()
    rig.hear(rig.plan(state))
    state = rig.cycle()
    assert state.mode is Mode.HOLD
    assert "by the IMU" in state.plan_refusal
    rig.command("walk")
    state = cycle_with_imu(rig, UP) if heard else rig.cycle()
    rig.hear(rig.plan(state))
    assert rig.cycle().mode is Mode.WALK
    assert not any("from the commanded pose" in warning for warning in rig.cycle().warnings)


@pytest.mark.slow
def test_robot_on_its_side_refuses_walk_order() -> None:
    rig, up = Rig(), rotation_from_rpy((1.2, 0.0, 0.0))[2]
    walk_with_trusted_imu(rig)
    state = tip(rig, 1.2)
    rig.command("walk")
    rig.hear(rig.plan(state))
    assert cycle_with_imu(rig, up).mode is Mode.HOLD
    rig.hear(rig.plan(state))
    assert "by the IMU" in cycle_with_imu(rig, up).plan_refusal


@pytest.mark.slow
def test_second_stand_up_does_not_twist_the_coxae() -> None:
    """Check that standing up restarts leg odometry while the gyro continues."""
    rig = Rig()
    walk_with_trusted_imu(rig)
    rig.actuator._estimator.odometry.turn(from_xyz_rpy(np.zeros(3), (0.0, 0.0, 0.15)))  # gyro and legs agree on the turn
    rig.actuator._motion.executor = StepExecutor(Settings(), REST, rig.actuator._estimator.odometry.T_odom_body)
    rig.hear(Imu(rig.now_ns, np.array([0.0, 0.0, 0.15 / 0.02]), 9.81 * UP))
    rig.cycle()
    goals = rig.goals
    rig.command("stand")
    state = cycle_with_imu(rig, UP)
    assert state.mode is Mode.STAND
    while cycle_with_imu(rig, UP).mode is Mode.STAND:
        pass
    for _ in range(150):
        cycle_with_imu(rig, UP)
    np.testing.assert_allclose(rig.goals[:, 0], goals[:, 0], atol=STILL)
