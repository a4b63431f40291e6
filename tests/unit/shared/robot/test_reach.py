"""Reach around the resting stance: what is reported is reached, and a little more is not."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profile import MAX_TRAVEL_M
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.reach import height_range, least_support_margin, longest_stride, steady_stride

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


def test_steady_stride_is_the_longest_that_keeps_the_support_margin() -> None:
    stride = steady_stride(PROFILE)
    rest, share = PROFILE.rest_feet(), np.array([[1.0, 0.0] * 3, [0.0, 1.0] * 3])

    def margin(way: float) -> float:
        ends = [rest + np.array([x, 0.0, 0.0]) for x in (-way / 2, way / 2)]
        return min(least_support_margin(PROFILE, np.array([end, end]), share) for end in ends)

    assert margin(stride) >= PROFILE.stance.support_margin
    assert stride == MAX_TRAVEL_M or margin(stride + 0.0026) < PROFILE.stance.support_margin
    far = replace(PROFILE, stance=replace(PROFILE.stance, support_margin=1.0))
    assert steady_stride(far) == 0.0
