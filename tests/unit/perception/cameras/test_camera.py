"""Camera base: check of the device against the profile, and conversion of stamps.

Device stamps become times of this machine.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.perception.cameras.camera import CameraError, DeviceClock, check_depth_scale, check_intrinsics
from sextant.shared.robot.camera import Intrinsics

LENS = Intrinsics(640, 480, 585.0, 585.0, 319.5, 239.5)


@pytest.mark.parametrize(
    "found",
    [
        replace(LENS, width=848),
        replace(LENS, fx=600.0),
        replace(LENS, fy=500.0),
        replace(LENS, cx=340.0),
        replace(LENS, cy=220.0),
    ],
)
def test_mismatched_intrinsics_are_refused_with_expected_and_found_values(found: Intrinsics) -> None:
    with pytest.raises(CameraError, match=r"640x480, fx 585\.0.*expected.*found") as caught:
        check_intrinsics("camera", LENS, found)
    assert "profile" in caught.value.remedy


def test_intrinsics_within_tolerance_are_accepted() -> None:
    check_intrinsics("camera", LENS, replace(LENS, fx=590.0, fy=580.0, cx=325.0, cy=236.0))


def test_mismatched_depth_scale_is_refused() -> None:
    check_depth_scale("camera", 1000.0, 1 / 0.001)
    with pytest.raises(CameraError, match=r"1000 units per metre expected.*found 10000"):
        check_depth_scale("camera", 1000.0, 1 / 0.0001)


@given(st.lists(st.floats(0.0, 0.2), min_size=2, max_size=60), st.integers(0, 10**15))
def test_stamps_keep_device_spacing_and_are_never_in_the_future(late_s: list[float], origin_ns: int) -> None:
    clock = DeviceClock()
    device = [33_000_000 * k for k in range(len(late_s))]
    arrived = [origin_ns + stamp + round(late * 1e9) for stamp, late in zip(device, late_s, strict=True)]
    found = [clock.host_ns(stamp, at) for stamp, at in zip(device, arrived, strict=True)]
    assert all(stamp <= at for stamp, at in zip(found, arrived, strict=True))
    settled = int(np.argmin(late_s))  # after the picture with the least delay the estimate does not change
    assert set(np.diff(found[settled:]).tolist()) <= {33_000_000}


def test_device_clock_reset_is_followed() -> None:
    clock = DeviceClock(delay_ns=5)
    assert clock.host_ns(1000, 5000) == 4995
    assert clock.host_ns(0, 9000) == 8995
