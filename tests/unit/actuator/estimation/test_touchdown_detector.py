"""Touchdown detection from the femur's load.

Free motion gives no contact. A foot that meets ground is detected within a few readings.
"""

from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.estimation.touchdown_detector import FEMUR, FemurReading, TouchdownDetector
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.physics.world import World
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.kinematics import body_inverse, link_torques
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Plane
from sextant.shared.servo import dynamixel as dxl
from tests.support.families import robot_with

PROFILE = load_profile("phantomx_mk2")
SERVO = PROFILE.servo
# Foot distances of mid-swing: nearer to the coxa the femur has less leverage on the ground force and detects less.
OUT = np.column_stack([PROFILE.T_body_coxa[:, :2, 0], np.zeros(6)])
Q = body_inverse(PROFILE, PROFILE.rest_feet() + (0.144 - PROFILE.foot_radii)[:, None] * OUT)
LEG = 2
PERIOD = 20_000_000
STEPS = 20  # integration steps of the joint's motion per 20 ms


def femur(speed: float, load: float, stamp_ns: int, angle: float = 0.0) -> FemurReading:
    """Return a reading taken in the last quarter of a cycle."""
    return FemurReading(angle, speed, load, stamp_ns, stamp_ns - PERIOD * 3 // 4)


class Swing(NamedTuple):
    """Detections during one motion of a femur."""

    touches: list[bool]  # per cycle
    pushes: list[float]  # [N]
    met: int  # cycle of ground contact, or -1


def swing(
    goals: Array,
    armature: float = 1.0,
    ground: float = -np.inf,
    told: float = 0.3,
    coarse: bool = False,
    period_ns: int = PERIOD,
    bridged: RobotProfile | None = None,
    transmission_ms: float = 0.0,
) -> Swing:
    """Run the detector while one femur follows goals (n,) [rad].

    The servo model is the simulator's: a damped spring to the goal with dry friction, a leg and an armature. From the middle
    of the motion, ground as hard as stone lies below a femur angle [rad]. Readings are taken at the start of each cycle and
    goals are sent after the share `told` of it. A coarse servo counts in ticks and has a compliance margin of one tick. A
    robot `bridged` has its servos behind a microcontroller, and they receive goals some time after they were sent.
    """
    profile, servo = bridged or PROFILE, (bridged or PROFILE).servo
    tick = dxl.TICK_RAD if coarse else 1e-9
    goals = np.round(goals / tick) * tick
    feeler = TouchdownDetector(profile)
    feeler.period_ns, feeler.bridged = period_ns, bridged is not None
    inertia = feeler._inertia[0] + (armature - 1.0) * servo.armature
    q, angle, speed, load, met = Q.copy(), float(goals[0]), 0.0, 0.0, -1
    touches, pushes = list[bool](), list[float]()
    steps = STEPS * period_ns // PERIOD
    dt = period_ns * 1e-9 / steps
    taken = told + transmission_ms * 1e6 / period_ns
    for cycle, goal in enumerate(goals):
        earliest, before = goals[max(cycle - 2, 0)], goals[max(cycle - 1, 0)]
        seen = round(angle / tick) * tick
        q[LEG, FEMUR] = seen
        q_goal = q.copy()
        q_goal[LEG, FEMUR] = before
        feeler.begin_cycle(q, q_goal)
        feeler.add_reading(LEG, FemurReading(seen, speed, load, cycle * period_ns, round((cycle - 1 + told) * period_ns)))
        touches.append(bool(feeler.touches[LEG]))
        pushes.append(float(feeler.push[LEG]))
        held = link_torques(profile, q)[LEG, FEMUR]
        for step in range(steps):
            written = earliest if step < (taken - 1.0) * steps else before if step < taken * steps else goal
            left = np.sign(written - angle) * max(abs(written - angle) - tick, 0.0)
            load = float(np.clip(servo.stiffness * left, -servo.stall_torque, servo.stall_torque))
            sunk = max(ground - angle, 0.0) if cycle > len(goals) / 2 else 0.0
            if sunk and met < 0:
                met = cycle
            torque = load - held + 400.0 * sunk - servo.friction * np.tanh(speed / 0.02)
            speed = (speed + dt * torque / inertia) / (1.0 + dt * (servo.damping + 4.0 * (sunk > 0)) / inertia)
            angle += dt * speed
    return Swing(touches, pushes, met)


def stroke(height: float, cycles: int) -> Array:
    """Return goals up by a height [rad], down again and at rest, smooth as swings are."""
    s = np.linspace(0.0, 1.0, cycles)
    up = height * np.sin(np.pi * s) ** 2
    return np.asarray(Q[LEG, FEMUR] + np.concatenate([np.zeros(3), up, np.zeros(5)]))


@pytest.mark.slow
@given(st.floats(0.2, 0.8), st.integers(28, 60), st.floats(0.6, 1.6), st.floats(0.1, 0.9))
@settings(max_examples=60)
def test_free_motion_gives_no_contact_at_any_goal_delay(height: float, cycles: int, armature: float, told: float) -> None:
    assert not any(swing(stroke(height, cycles), armature, told=told).touches)


@pytest.mark.parametrize("told", [0.2, 0.85, 0.95])
def test_quantization_and_compliance_margin_give_no_contact(told: float) -> None:
    for height, cycles in ((0.2, 40), (0.4, 34), (0.6, 34)):
        assert not any(swing(stroke(height, cycles), told=told, coarse=True).touches)


@pytest.mark.parametrize("since_ms", [3, 4, 6, 8, 10, 12])
@pytest.mark.parametrize("model", ["AX-12A", "XL430-W250", "XM430-W350", "STS3215"])
@pytest.mark.parametrize("transmission_ms", [2.5, 3.5])
def test_bridge_detects_ground_and_nothing_else_at_any_reading_delay(model: str, since_ms: int, transmission_ms: float) -> None:
    """Check readings that come soon after the servos have received new goals, or just before."""
    goals, told, robot = stroke(0.5, 34), 1.0 - since_ms / 20, robot_with(model)
    free = swing(goals, told=told, bridged=robot, transmission_ms=transmission_ms)
    assert np.abs(free.pushes).max() < 1.5
    ground = float(Q[LEG, FEMUR]) + 0.2
    found = swing(goals, ground=ground, told=told, bridged=robot, transmission_ms=transmission_ms)
    assert found.touches.index(True) - found.met in (1, 2, 3)


@pytest.mark.parametrize("period_ms", [20, 30, 40])
@pytest.mark.parametrize("told", [0.1, 0.3])
@pytest.mark.parametrize("height", [0.2, 0.4, 0.6])
def test_control_rates_of_slow_computers_detect_ground_and_nothing_else(height: float, told: float, period_ms: int) -> None:
    goals, period_ns = stroke(height, 700 // period_ms), period_ms * 1_000_000
    free = swing(goals, told=told, period_ns=period_ns)
    assert not any(free.touches)
    assert np.abs(free.pushes).max() < 1.0
    found = swing(goals, ground=Q[LEG, FEMUR] + 0.4 * height, told=told, period_ns=period_ns)
    assert found.met > 0
    assert found.touches.index(True) - found.met in (1, 2, 3)


def test_push_at_full_torque_is_independent_of_reading_delay() -> None:
    """Check that a femur far behind its goal has the same push at any reading delay."""
    pushes = list[float]()
    for since_ms in (0.5, 3.0, 6.0, 10.0, 18.0):
        feeler, ahead = TouchdownDetector(PROFILE), Q.copy()
        for cycle in range(3):
            ahead[LEG, FEMUR] = Q[LEG, FEMUR] - 0.5 - 0.06 * cycle
            feeler.begin_cycle(Q, ahead)
            stamp_ns = cycle * PERIOD
            angle, full = float(Q[LEG, FEMUR]), -SERVO.stall_torque
            feeler.add_reading(LEG, FemurReading(angle, -3.5, full, stamp_ns, stamp_ns - round(since_ms * 1e6)))
        pushes.append(float(feeler.push[LEG]))
    np.testing.assert_allclose(pushes, pushes[0])


def test_push_in_free_motion_is_nearly_independent_of_goal_delay() -> None:
    """Check that the push hardly depends on when goals are sent within a cycle.

    At 3 rad/s the femur's load falls by 0.03 N m per millisecond, a quarter of a newton at the foot.
    """
    pushes = np.array([swing(stroke(0.6, 34), told=told).pushes for told in np.linspace(0.1, 0.9, 9)])
    assert np.ptp(pushes, axis=0).max() < 0.7
    assert np.abs(pushes).max() < 1.0


def test_contact_threshold_scales_with_robot_weight() -> None:
    body = replace(PROFILE.body, mass=PROFILE.body.mass + PROFILE.body.total_mass)  # twice the total mass
    for profile, felt in ((PROFILE, True), (replace(PROFILE, body=body), False)):
        feeler = TouchdownDetector(profile)
        for _ in range(3):
            feeler.begin_cycle(Q, Q)  # constant goals
        held = link_torques(profile, Q)[LEG, FEMUR] - 3.0 * feeler._arm[LEG]
        for cycle in range(3):
            feeler.add_reading(LEG, femur(0.0, held, cycle * PERIOD))
        assert feeler.push[LEG] == pytest.approx(3.0)
        assert feeler.touches[LEG] == felt


@pytest.mark.parametrize("since_ms", [0.0, 2.0, 4.0])
def test_load_shows_if_servo_was_read_before_its_new_goal(since_ms: float) -> None:
    """Check that the pull shows whether a servo that was read had received its goal.

    The femur moves down at 3 rad/s. Its torque is that of the new goal, or of the previous one 20 ms later in its motion.
    """
    speed, step = -3.0, -3.0 * PERIOD * 1e-9
    held = link_torques(PROFILE, Q)[LEG, FEMUR] + SERVO.damping * speed - 2.5 * SERVO.friction
    goal = Q[LEG, FEMUR] + held / SERVO.stiffness  # of a spring that pulls with this torque 8 ms after it receives its goal
    found = list[float]()
    for heard in (True, False):
        feeler = TouchdownDetector(PROFILE)
        for cycle in range(4):
            told = Q.copy()
            told[LEG, FEMUR] = goal + cycle * step
            feeler.begin_cycle(Q, told)
            late_ns = round(since_ms * 1e6) + (0 if heard else PERIOD)  # time since the goal that the servo pulls to
            angle = Q[LEG, FEMUR] + (cycle - (not heard)) * step + speed * (late_ns * 1e-9 - 0.008)
            pull = SERVO.stiffness * (goal + (cycle - (not heard)) * step - angle)
            stamp_ns = cycle * PERIOD + round(since_ms * 1e6)
            feeler.add_reading(LEG, FemurReading(angle, speed, pull, stamp_ns, cycle * PERIOD))
        found.append(float(feeler.push[LEG]))
    np.testing.assert_allclose(found, 0.0, atol=0.05)


@pytest.mark.parametrize("armature", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("height", [0.4, 0.6])
@pytest.mark.parametrize("told", [0.2, 0.3, 0.6])
def test_ground_contact_is_detected_within_three_readings(height: float, armature: float, told: float) -> None:
    found = swing(stroke(height, 34), armature, ground=Q[LEG, FEMUR] + 0.4 * height, told=told)
    assert found.met > 0
    assert found.touches.index(True) - found.met in (1, 2, 3)


def test_full_torque_at_high_speed_gives_no_contact() -> None:
    """Check that full torque at high speed gives no contact.

    The model does not explain all of the full torque, but ground would have stopped the leg.
    """
    robot = load_profile("lotriet_rx64")
    q = body_inverse(robot, robot.rest_feet())
    for speed, touches in ((-5.75, False), (0.0, True)):  # [rad/s]
        feeler = TouchdownDetector(robot)
        for k in range(4):
            feeler.begin_cycle(q, q)
            feeler.add_reading(LEG, femur(speed, -robot.servo.stall_torque, k * PERIOD))
        assert feeler.touches[LEG] == touches


def test_push_at_rest_marks_foot_as_bearing_load() -> None:
    feeler = TouchdownDetector(PROFILE)
    held = link_torques(PROFILE, Q)
    for newton, bears in ((0.0, False), (1.5, True)):
        arm = 0.1
        for cycle in range(3):
            feeler.begin_cycle(Q, Q)
            for leg in range(6):
                feeler.add_reading(leg, femur(0.0, float(held[leg, FEMUR]) - newton * arm, (1 + cycle) * PERIOD))
        assert feeler.bears.all() == bears
        assert not feeler.touches.any()
        feeler.forget(np.ones(6, dtype=bool))
        assert not feeler.bears.any()


@pytest.mark.parametrize(
    ("newton", "bears", "touches"), [(2.9, False, False), (3.1, True, False), (4.4, True, False), (4.6, True, True)]
)
def test_single_strong_push_is_enough_for_contact(newton: float, bears: bool, touches: bool) -> None:
    feeler, held = TouchdownDetector(PROFILE), link_torques(PROFILE, Q)[LEG, FEMUR]
    for cycle in range(3):
        feeler.begin_cycle(Q, Q)
        push = newton * feeler._mass_ratio * (cycle == 2)
        feeler.add_reading(LEG, femur(0.0, held - push * feeler._arm[LEG], cycle * PERIOD))
    assert (feeler.bears[LEG], feeler.touches[LEG]) == (bears, touches)
    feeler.add_reading(LEG, femur(0.0, held, 6 * PERIOD))
    assert feeler.push[LEG] == 0.0
    assert not feeler.bears[LEG], "after a gap what was felt before it counts no more"


def test_foot_leans_after_one_reading_and_bears_after_two() -> None:
    feeler, arm = TouchdownDetector(PROFILE), 0.1
    held = link_torques(PROFILE, Q)
    for cycle, newton in enumerate((0.0, 0.0, 1.5, 1.5, 0.0)):
        feeler.begin_cycle(Q, Q)
        for leg in range(6):
            feeler.add_reading(leg, femur(0.0, float(held[leg, FEMUR]) - newton * arm, (1 + cycle) * PERIOD))
        assert feeler.may_bear.all() == feeler.may_bear.any() == (newton > 0)
        assert feeler.bears.all() == feeler.bears.any() == (cycle == 3)


def test_load_within_compliance_margin_is_not_taken_for_missed_goal() -> None:
    """Check a goal that moved down by 1.5 ticks.

    The servo's compliance margin makes it pull as for the previous goal.
    """
    pushes = list[float]()
    for told in (0.0, -1.5 * dxl.TICK_RAD):
        feeler, goal = TouchdownDetector(PROFILE), Q.copy()
        for cycle in range(3):
            goal[LEG, FEMUR] = Q[LEG, FEMUR] + told * (cycle - 2)
            feeler.begin_cycle(Q, goal)
            feeler.add_reading(
                LEG,
                FemurReading(
                    float(Q[LEG, FEMUR]), -1.0, -told * SERVO.stiffness, cycle * PERIOD, cycle * PERIOD - PERIOD // 10
                ),
            )
        pushes.append(float(feeler.push[LEG] - told * SERVO.stiffness / feeler._arm[LEG]))
    assert pushes[1] == pytest.approx(pushes[0], abs=0.1)


def test_leg_is_silent_after_its_servo_stops_responding() -> None:
    feeler = TouchdownDetector(PROFILE)
    feeler.begin_cycle(Q, Q)
    assert feeler.silent(1_000_000_000).all()
    feeler.add_reading(LEG, femur(0.0, 0.0, 1_000_000_000))
    np.testing.assert_array_equal(np.flatnonzero(~feeler.silent(1_250_000_000)), [LEG])
    assert feeler.silent(1_400_000_000).all()


@pytest.mark.parametrize("name", ["phantomx_mk2", "lotriet_rx64"])
def test_leg_inertia_matches_simulation_with_knee_at_90_deg(name: str) -> None:
    robot = load_profile(name)
    world = World(robot, build_terrain(Scenario("flat", (Plane(),), Goal(1.0)), np.random.default_rng(0)))
    world.place(np.tile([0.0, 0.3, -np.pi / 2], (6, 1)), from_xyz_rpy((0.0, 0.0, 1.0), np.zeros(3)))
    inertia = np.zeros((world.model.nv, world.model.nv))
    mujoco.mj_fullM(world.model, world.data, inertia)
    femora = 6 + 3 * np.arange(6) + FEMUR  # after the body's six degrees of freedom
    np.testing.assert_allclose(inertia[femora, femora], TouchdownDetector(robot)._inertia, rtol=0.05)


def test_leg_counts_as_responding_with_two_recent_readings() -> None:
    feeler = TouchdownDetector(PROFILE)
    feeler.begin_cycle(Q, Q)
    expected = []
    for cycle, asked_in_vain in enumerate((False, False, False, True, False, True, True, False, False)):
        now = cycle * PERIOD + PERIOD * 3 // 4
        if not asked_in_vain:
            feeler.add_reading(LEG, femur(0.0, 0.0, now))
        expected.append(bool(feeler.heard(now + 2_000_000)[LEG]))
        assert not np.delete(feeler.heard(now), LEG).any()
    # One missed reading does not count as silence, two do. After two, the first reading has no predecessor to compare with.
    assert expected == [False, True, True, True, True, True, False, False, True]


def test_readings_far_apart_give_no_push() -> None:
    feeler = TouchdownDetector(PROFILE)
    for cycle in range(5):
        feeler.begin_cycle(Q, Q)
        feeler.add_reading(LEG, femur(0.0, -1.5, cycle * 4 * PERIOD))
        assert feeler.push[LEG] == 0.0


def test_load_noise_at_short_lever_arm_gives_no_contact() -> None:
    """Check that 0.14 N m of noise, rare in free swings, gives no contact.

    It would be 5 N on a foot only 3 cm from its femur's axis.
    """
    feeler = TouchdownDetector(PROFILE)
    near = body_inverse(PROFILE, PROFILE.rest_feet(0.13) + (PROFILE.links.coxa + 0.03 - PROFILE.foot_radii)[:, None] * OUT)
    held = link_torques(PROFILE, near)
    for cycle, noise in enumerate((0.0, 0.0, 0.14)):
        feeler.begin_cycle(near, near)
        for leg in range(6):
            feeler.add_reading(leg, femur(0.0, float(held[leg, FEMUR]) - noise, cycle * PERIOD))
        assert not feeler.touches.any()
