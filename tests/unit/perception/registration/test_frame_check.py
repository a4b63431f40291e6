"""Frame check: late, frozen, noisy frames, and frames of a wrong size."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.perception.registration.frame_check import FrameCheck
from sextant.services.perception.registration.motion_prior import Motion
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.wire.messages import DepthImage

SIZE = (48, 64)
S = 1_000_000_000
RAMP = np.add.outer(np.arange(48), np.arange(64)).astype(np.uint16) + 1000


def image(stamp_ns: int = 0, depth: NDArray[np.uint16] = RAMP) -> DepthImage:
    return DepthImage(stamp_ns, depth)


def body_at(x: float) -> Motion:
    return Motion(from_xyz_rpy((x, 0.0, 0.1), np.zeros(3)), x, 0.0, True)


@pytest.fixture
def check() -> FrameCheck:
    return FrameCheck(SIZE)


def test_older_frame_is_late_unless_the_clock_has_changed(check: FrameCheck) -> None:
    late = [check.is_late(stamp_ns) for stamp_ns in (10 * S, 10 * S, 10 * S - 1, 10 * S + 1, 2 * S, 2 * S + 1)]
    assert late == [False, True, True, False, False, False]


def test_wrong_size_is_a_fault(check: FrameCheck) -> None:
    fault = check.fault(image(depth=RAMP[:24]), body_at(0.0))
    assert "a frame of (48, 64) expected by the profile, found (24, 64)" in fault


def test_noise_is_a_fault(check: FrameCheck) -> None:
    noise = np.random.default_rng(0).integers(1, 65536, SIZE, dtype=np.uint16)
    assert "noise" in check.fault(image(depth=noise), body_at(0.0))


def test_same_image_is_frozen_once_the_body_has_moved(check: FrameCheck) -> None:
    assert check.fault(image(), body_at(0.0)) == ""
    assert check.fault(image(S), body_at(0.009)) == ""
    assert "the same image for 2.0 s while the legs moved" in check.fault(image(2 * S), body_at(0.02))
    assert check.fault(image(3 * S, RAMP + np.uint16(1)), body_at(0.03)) == ""


def test_motion_counts_from_the_first_known_pose(check: FrameCheck) -> None:
    for motion in (None, body_at(0.5), body_at(0.505)):
        assert check.fault(image(), motion) == ""
    assert "frozen" in check.fault(image(), body_at(0.52))


def test_image_without_returns_is_not_frozen(check: FrameCheck) -> None:
    blank = np.zeros(SIZE, dtype=np.uint16)
    assert [check.fault(image(depth=blank), body_at(x)) for x in (0.0, 0.1, 0.2)] == ["", "", ""]


@pytest.mark.parametrize(
    ("off_s", "words"),
    [(0.4, ""), (0.6, "stamps its images 0.6 s in the future"), (-1.4, ""), (-1.6, "images are 1.6 s old by their stamps")],
)
def test_stamp_far_from_the_clock_is_a_fault(check: FrameCheck, off_s: float, words: str) -> None:
    stamp_ns = 10 * S + round(off_s * S)
    fault = check.stamp_fault(stamp_ns, 10 * S)
    assert words in fault
    assert bool(fault) is bool(words)
    assert check.stamp_fault(stamp_ns, None) == "", "a clock that is not known shows nothing"


def test_stamps_that_stay_back_are_a_fault_and_single_late_frames_are_not(check: FrameCheck) -> None:
    found = []
    for stamp_ns in (10 * S, 10 * S - 1, 10 * S + 1, *[10 * S - S // 5] * 4, 10 * S + 2):
        found.append(check.stamp_fault(stamp_ns, None))
        if not found[-1]:
            check.is_late(stamp_ns)
    assert [bool(fault) for fault in found] == [False] * 6 + [True, False]
    assert "do not rise: the newest image is stamped 0.2 s before an earlier one" in found[6]
