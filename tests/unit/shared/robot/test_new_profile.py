"""New profiles from measures: what was measured is in the profile, and the proposed stance is reached."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.new_profile import Measures, new_profile
from sextant.shared.robot.reach import longest_stride
from sextant.shared.servo.models import MODEL_NAMED

measures = st.builds(
    Measures,
    coxa=st.floats(0.02, 0.09),
    femur=st.floats(0.05, 0.12),
    tibia=st.floats(0.08, 0.16),
    front=st.floats(0.08, 0.16),
    side=st.floats(0.04, 0.08),
    middle=st.floats(0.07, 0.12),
    mass=st.floats(1.0, 3.0),
    servo=st.sampled_from(sorted(MODEL_NAMED)),
)


@pytest.mark.slow
@given(measures)
@settings(max_examples=30)
def test_proposed_stance_is_reached_over_its_range_of_heights(measured: Measures) -> None:
    robot = new_profile("any", measured)
    assert (robot.links.coxa, robot.links.femur, robot.links.tibia) == (measured.coxa, measured.femur, measured.tibia)
    assert robot.body.total_mass == pytest.approx(measured.mass, abs=1e-3)
    stance = robot.stance
    for height in (*stance.body_height_range, stance.body_height):
        assert within_limits(robot, body_inverse(robot, robot.rest_feet(height))).all()
    assert longest_stride(robot, stance.body_height).length >= stance.stride


def test_new_robot_is_symmetric() -> None:
    robot = new_profile("any", Measures(0.045, 0.06, 0.11, 0.085, 0.045, 0.07, 1.6))
    mirrored = robot.joint_limits[[1, 0, 5, 4, 3, 2]]
    np.testing.assert_allclose(robot.joint_limits[:, 1:], mirrored[:, 1:])
    np.testing.assert_allclose(robot.joint_limits[:, 0], -mirrored[:, 0, ::-1])
    np.testing.assert_allclose(robot.rest_feet()[[1, 0, 5, 4, 3, 2]] * [1, -1, 1], robot.rest_feet())


def test_unusual_measures_are_refused() -> None:
    with pytest.raises(ValueError, match=r"femur: a length of 0.005 to 0.5 m expected, found 66.0"):
        Measures(0.052, 66.0, 0.133, 0.12, 0.06, 0.1, 2.5)
