"""Femurs in the air: they follow their goals as the physics engine's do, and a foot that is stopped shows."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.estimation.free_motion import FreeMotion
from sextant.services.actuator.estimation.touchdown_detector import FEMUR, FemurReading, TouchdownDetector
from sextant.shared.robot.kinematics import body_inverse, link_torques
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("jethexa_hx35h")
SERVO, TICK = PROFILE.servo, PROFILE.servo_model.units.tick_rad
PERIOD = 20_000_000
OUT = np.column_stack([PROFILE.T_body_coxa[:, :2, 0], np.zeros(6)])
Q = body_inverse(PROFILE, PROFILE.rest_feet() + 0.02 * OUT)
LEG = 2


def test_femur_comes_to_rest_where_its_spring_holds_the_links() -> None:
    free, holding = FreeMotion([SERVO] * 6, [0.02] * 6), [0.3] * 6
    for _ in range(100):
        free.follow([0.5] * 6, [0.0] * 6, holding, 0.02)
    assert free.at(LEG, 0.01) == pytest.approx(0.5 - 0.3 / SERVO.stiffness, abs=SERVO.friction / SERVO.stiffness)


def test_torque_of_the_spring_is_limited() -> None:
    near, far = FreeMotion([SERVO] * 6, [0.02] * 6), FreeMotion([SERVO] * 6, [0.02] * 6)
    for free, goal in ((near, SERVO.stall_torque / SERVO.stiffness + 0.1), (far, 3.0)):
        free.follow([goal] * 6, [0.0] * 6, [0.0] * 6, 0.02)
    assert near.at(LEG, 0.0025) == far.at(LEG, 0.0025) > 0.0


def swing(ground: float = -np.inf, armature: float = 1.0, friction: float = 1.0, turns: bool = False) -> tuple[list[bool], int]:
    """Lower one femur over 0.5 s on a servo with other armature and friction; return touches, and the cycle of contact or -1.

    The ground below an angle [rad] is hard. Positions are whole ticks; goals are sent in the middle of a cycle. A femur that
    turns rises first, and turns from one goal to the next, as where a new plan ends a swing elsewhere.
    """
    detector = TouchdownDetector(PROFILE)
    inertia = detector._inertia[0] + (armature - 1.0) * SERVO.armature
    start = float(Q[LEG, FEMUR])
    angle, speed, met, touches, goal = start, 0.0, -1, [], start
    for k in range(45):
        q, goals = Q.copy(), Q.copy()
        q[LEG, FEMUR], goals[LEG, FEMUR] = round(angle / TICK) * TICK, goal
        detector.begin_cycle(q, goals)
        detector.add_reading(LEG, FemurReading(float(q[LEG, FEMUR]), 0.0, 0.0, k * PERIOD, k * PERIOD - PERIOD // 2))
        touches.append(bool(detector.touches[LEG]))
        hold = float(link_torques(PROFILE, q)[LEG, FEMUR])
        share = np.clip((k - 10) / 25, 0.0, 1.0)
        following = start - 0.35 * (10 * share**3 - 15 * share**4 + 6 * share**5)
        if turns:
            following = start + (0.3 * min(k, 20) - 1.6 * max(k - 20, 0)) * PERIOD * 1e-9
        for step in range(40):
            goal = following if step >= 20 else goal
            spring = np.clip(SERVO.stiffness * (goal - angle), -SERVO.stall_torque, SERVO.stall_torque)
            dry = friction * SERVO.friction * np.clip(speed / 0.05, -1.0, 1.0)
            stop = 2000.0 * max(ground - angle, 0.0) - 5.0 * speed * (angle < ground)
            speed += (spring - SERVO.damping * speed - dry - hold + stop) / inertia * 0.0005
            angle += speed * 0.0005
            met = k if met < 0 and angle < ground else met
    return touches, met


@pytest.mark.parametrize("armature", [0.625, 1.0, 1.6])
@pytest.mark.parametrize("friction", [0.5, 1.0, 1.5])
def test_free_swing_touches_nothing(armature: float, friction: float) -> None:
    assert True not in swing(armature=armature, friction=friction)[0]


@pytest.mark.parametrize("armature", [0.625, 1.0, 1.6])
def test_femur_that_turns_abruptly_touches_nothing(armature: float) -> None:
    assert True not in swing(armature=armature, turns=True)[0]


@pytest.mark.parametrize("armature", [0.625, 1.0, 1.6])
def test_stopped_foot_is_noticed_within_five_cycles(armature: float) -> None:
    touches, met = swing(ground=float(Q[LEG, FEMUR]) - 0.2, armature=armature)
    assert met > 0
    assert True not in touches[: met + 1]
    assert touches.index(True) - met <= 5


def test_detector_measures_the_speed_of_other_servos() -> None:
    assert TouchdownDetector(PROFILE)._free
    other = load_profile("printed_sts3215")
    assert TouchdownDetector(replace(other, name="other"))._free == ()
