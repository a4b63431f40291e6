"""Postures of a standing robot."""

import numpy as np

from sextant.services.planner.locomotion.posture import posture_step, rest_pose
from sextant.services.planner.robot_estimate import WorldStance
from sextant.shared.geometry import apply, from_xyz_rpy, inverse, rpy_from_rotation
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import PostureCommand

PROFILE = load_profile("phantomx_mk2")
PLACE = from_xyz_rpy((1.0, 2.0, 0.15), (0.02, -0.03, 0.7))
FEET = apply(PLACE, PROFILE.rest_feet())


def command(*values: float) -> PostureCommand:
    return PostureCommand(0, np.array(values[:3]), np.array(values[3:]))


def test_rest_pose_is_that_of_the_resting_feet() -> None:
    np.testing.assert_allclose(rest_pose(PROFILE, FEET), PLACE, atol=1e-9)


def test_posture_moves_the_body_and_no_foot() -> None:
    step = posture_step(PROFILE, command(0.01, -0.02, 0.01, 0.05, 0.1, -0.1), WorldStance(PLACE, FEET))
    assert step is not None
    assert not step.swing.any()
    np.testing.assert_allclose(step.touchdown, FEET)
    found = inverse(PLACE) @ step.body_goal
    np.testing.assert_allclose(found[:3, 3], [0.01, -0.02, 0.01], atol=1e-9)
    np.testing.assert_allclose(rpy_from_rotation(found[:3, :3]), [0.05, 0.1, -0.1], atol=1e-9)
    assert step.duration >= 0.6


def test_reached_posture_needs_no_step() -> None:
    posture = command(0.0, 0.0, 0.02, 0.0, 0.1, 0.0)
    first = posture_step(PROFILE, posture, WorldStance(PLACE, FEET))
    assert first is not None
    assert posture_step(PROFILE, posture, WorldStance(first.body_goal, FEET)) is None


def test_far_posture_is_reached_in_several_steps_that_the_actuator_permits() -> None:
    body, posture = PLACE @ from_xyz_rpy(np.zeros(3), (0.0, -0.17, 0.0)), command(0.0, 0.0, 0.0, 0.0, 0.17, 0.0)
    for _ in range(2):
        step = posture_step(PROFILE, posture, WorldStance(body, FEET))
        assert step is not None
        turn = rpy_from_rotation((inverse(body) @ step.body_goal)[:3, :3])
        assert np.degrees(np.abs(turn).max()) < 15.0
        body = step.body_goal
    assert posture_step(PROFILE, posture, WorldStance(body, FEET)) is None
