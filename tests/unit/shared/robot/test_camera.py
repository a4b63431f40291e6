"""The pinhole depth camera."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.robot.camera import DepthSensor, Intrinsics

SMALL = Intrinsics(64, 48, 58.5, 58.5, 31.5, 23.5)


@given(st.floats(0.05, 2.0), st.floats(0.01, 5.0), st.sampled_from([1000.0, 5000.0, 10000.0, 400.0]))
def test_raw_bounds_are_the_first_and_last_value_within_range(nearest: float, span: float, scale: float) -> None:
    sensor = DepthSensor(min_range=nearest, max_range=nearest + span, depth_scale=scale)
    z = np.arange(1, 65536) / scale
    within = np.flatnonzero((z >= nearest - 1e-9) & (z <= nearest + span + 1e-9)) + 1
    low, high = sensor.raw_bounds
    if len(within):
        assert (low, high) == (within[0], within[-1])
    else:
        assert low > high


@pytest.mark.parametrize("bad", [np.zeros((48, 64)), np.zeros((64, 48), np.uint16), np.zeros((48, 64, 1), np.uint16)])
def test_raw_images_of_wrong_shape_or_type_are_refused(bad: np.ndarray) -> None:  # type: ignore[type-arg]
    with pytest.raises(ValueError, match=r"uint16 depth image \(48, 64\) expected, found"):
        SMALL.check_raw(bad)
    SMALL.check_raw(np.zeros((48, 64), np.uint16))
