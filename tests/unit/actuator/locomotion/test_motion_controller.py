"""Motion controller: one motion at a time, slow after legs were not under control."""

import numpy as np
import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.locomotion.joint_rate_limits import GENTLE, LOWERED
from sextant.services.actuator.locomotion.motion_controller import MotionController
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.kinematics import body_forward, body_inverse
from sextant.shared.robot.profiles import load_profile
from tests.support.walker_steps import plan_to

PROFILE = load_profile("phantomx_mk2")
SETTINGS = Settings()
REST = PROFILE.rest_feet()
Q_REST = body_inverse(PROFILE, REST)
START = from_xyz_rpy((0.0, 0.0, PROFILE.foot.radius - REST[0, 2]), np.zeros(3))
GROUND = np.full(6, PROFILE.foot.radius)
DT = 0.02
NONE = np.zeros(6, dtype=np.bool_)
SURE = np.zeros((6, 3), dtype=np.bool_)
FIRST = np.arange(6) == 0


class Legs:
    """Joints that follow their goals."""

    def __init__(self, q: Array = Q_REST) -> None:
        self.q = q
        self.motion = MotionController(PROFILE, SETTINGS, q)
        self.motion.restart(body_forward(PROFILE, q), START, GROUND)

    def cycle(self, unsure: Array = SURE, recovers: bool = True) -> Array:
        """Run a cycle; return the largest joint speed (6,) [rad/s] of each leg."""
        if recovers:
            self.motion.recover_legs(unsure, unsure, apply(START, body_forward(PROFILE, self.q)), self.q)
        before = self.q
        self.q, _ = self.motion.update(DT, START, None, self.q, unsure.any(axis=1))
        return np.asarray(np.abs(self.q - before).max(axis=1) / DT)


def test_it_walks_the_plans_of_its_executor() -> None:
    legs = Legs()
    legs.motion.executor.accept(plan_to(1, START @ from_xyz_rpy((0.02, 0.0, 0.0), np.zeros(3))))
    lifted = np.zeros(6)
    while legs.motion.executor.step == 0 or not legs.motion.executor.resting:
        legs.cycle()
        lifted = np.maximum(lifted, body_forward(PROFILE, legs.q)[:, 2] - REST[:, 2])
    swing = plan_to(1, START).swing
    assert lifted[swing].min() > 0.02
    assert lifted[~swing].max() < 0.01


def test_only_a_walk_sets_legs_down() -> None:
    """Legs whose servos hold where they are, or that change posture, may be in the air."""
    legs = Legs()
    assert legs.motion.set_down.all()
    legs.motion.executor.accept(plan_to(1, START))
    while not legs.motion.executor.flying.any():
        legs.cycle()
    np.testing.assert_array_equal(legs.motion.set_down, ~plan_to(1, START).swing)
    legs.motion.freeze()
    assert not legs.motion.set_down.any()
    legs.motion.stand_up(legs.q)
    assert not legs.motion.set_down.any()


def test_standing_up_ends_at_rest_and_then_the_robot_stands() -> None:
    legs = Legs(body_inverse(PROFILE, PROFILE.rest_feet(0.05)))
    legs.motion.freeze()
    legs.motion.stand_up(legs.q)
    assert legs.motion.changes_posture
    assert not legs.motion.is_holding
    cycles = 0
    while not legs.motion.posture_is_reached:
        legs.cycle(recovers=False)
        cycles += 1
    assert cycles * DT == pytest.approx(SETTINGS.stand_s, abs=DT)
    np.testing.assert_allclose(body_forward(PROFILE, legs.motion.goals.wanted)[:, 2], REST[:, 2], atol=1e-6)
    assert legs.motion.end_posture()
    assert not legs.motion.is_holding


def test_lying_down_lowers_the_body_and_then_the_legs_hold() -> None:
    legs = Legs()
    legs.motion.lie_down()
    while not legs.motion.posture_is_reached:
        legs.cycle(recovers=False)
    assert (body_forward(PROFILE, legs.motion.goals.wanted)[:, 2] > REST[:, 2] + 0.03).all()
    assert not legs.motion.end_posture()
    assert legs.motion.is_holding


def test_freezing_ends_a_posture_change() -> None:
    legs = Legs()
    legs.motion.lie_down()
    legs.motion.freeze()
    assert legs.motion.is_holding
    assert not legs.motion.changes_posture


def test_a_hold_takes_the_goals_of_the_servos() -> None:
    legs = Legs()
    legs.motion.hold(Q_REST + 0.1)
    assert legs.motion.is_holding
    np.testing.assert_array_equal(legs.motion.goals.wanted, Q_REST + 0.1)


def test_a_lowered_foot_moves_slowly_to_the_ground() -> None:
    feet = REST + np.where(FIRST[:, None], np.array([0.0, 0.0, 0.03]), 0.0)
    legs = Legs(body_inverse(PROFILE, feet))
    legs.motion.take_over(slowly=True)
    legs.motion.lower(np.where(FIRST, 0.03, 0.0))
    assert legs.motion.waiting_reason
    assert max(legs.cycle().max() for _ in range(150)) <= LOWERED + 1e-9
    assert body_forward(PROFILE, legs.motion.goals.wanted)[0, 2] == pytest.approx(REST[0, 2], abs=1e-3)
    assert not legs.motion.waiting_reason


def test_a_leg_that_lost_torque_is_put_back_slowly_once_it_is_under_control() -> None:
    legs = Legs()
    lost = SURE.copy()
    lost[0, 1] = True
    for _ in range(5):
        legs.cycle(unsure=lost)
    assert legs.motion.unsure_legs(lost).tolist() == FIRST.tolist()
    hanging = body_inverse(PROFILE, REST + np.array([0.0, 0.0, 0.02]))
    legs.q = np.where(FIRST[:, None], hanging, legs.q)
    assert not legs.motion.executor.gentle
    speed = legs.cycle()[0]
    assert legs.motion.executor.gentle
    assert legs.motion.behind[:3].any()
    assert legs.motion.waiting_reason
    assert max(speed, *(legs.cycle()[0] for _ in range(200))) <= GENTLE + 1e-9
    assert legs.motion.executor.resting
    assert not legs.motion.behind.any()
    assert not legs.motion.waiting_reason


def test_unsure_legs_do_not_stand_unless_fewer_than_three_would_remain() -> None:
    legs, unsure = Legs(), SURE.copy()
    unsure[0, 2] = True
    assert legs.motion.standing(unsure).tolist() == (~FIRST).tolist()
    unsure[1:4] = True
    assert legs.motion.standing(unsure).all()


def test_a_joint_resumes_slowly_only_in_a_motion() -> None:
    legs = Legs()
    legs.motion.freeze()
    legs.motion.resume_joint(4)
    assert not legs.motion.behind.any()
    legs.motion.stand_up(legs.q)
    legs.motion.resume_joint(4)
    assert np.flatnonzero(legs.motion.behind).tolist() == [4]
