"""Reach around the resting stance: what is reported is reached, and a little more is not."""

import numpy as np
import pytest

from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.reach import height_range, longest_stride

PROFILE = load_profile("phantomx_mk2")


def test_reached_heights_contain_the_range_of_the_profile() -> None:
    low, high = height_range(PROFILE)
    assert low < PROFILE.stance.body_height_range[0] < PROFILE.stance.body_height_range[1] < high
    for height, reaches in ((low, True), (high, True), (low - 0.002, False), (high + 0.002, False)):
        assert within_limits(PROFILE, body_inverse(PROFILE, PROFILE.rest_feet(height))).all() == reaches


@pytest.mark.parametrize("height", [*PROFILE.stance.body_height_range, PROFILE.stance.body_height])
def test_longest_stride_is_reached_and_a_longer_one_is_not(height: float) -> None:
    found = longest_stride(PROFILE, height)
    for half, reaches in ((found.length / 2, True), (found.length / 2 + 0.003, False)):
        feet = PROFILE.rest_feet(height) + np.array([[[half, 0.0, 0.0]], [[-half, 0.0, 0.0]]])
        assert within_limits(PROFILE, body_inverse(PROFILE, feet)).all() == reaches
    assert "leg, by its" in found.limited_by
