"""Evidence of a replay: pictures that support a trajectory, or one sentence.

The sentence appears if too few pictures support it.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.replay.evidence import (
    Evidence,
    PictureEvidence,
    TrueComparison,
    camera_motions,
    depth_range,
    in_words,
    picture_evidence,
)
from sextant.services.perception.trajectory_error import relative_size
from sextant.shared.geometry import exp_so3, from_xyz_rpy
from sextant.shared.robot.camera import DepthSensor
from sextant.shared.wire.messages import BodyPose

SENSOR = DepthSensor(max_range=2.5)
DEPTH = depth_range(np.full((48, 64), 1500, np.uint16), SENSOR)
RATE_HZ = 30.0


def pictures(count: int = 60, **changed: object) -> list[PictureEvidence]:
    return [replace(PictureEvidence(n / RATE_HZ, True, "", 0.9, (), DEPTH), **changed) for n in range(count)]  # type: ignore[arg-type]


def evidence(found: list[PictureEvidence], truth: TrueComparison | None = None, sensor: DepthSensor = SENSOR) -> Evidence:
    return Evidence(tuple(found), sensor, truth)


def test_fully_observable_pictures_support_trajectory() -> None:
    found = evidence(pictures())
    assert found.problem == ""
    assert found.supporting == 59
    assert found.longest_gap_s == 0.0
    assert found.as_table()["supported"]


def test_first_picture_is_not_counted_as_evidence() -> None:
    first = replace(pictures(1)[0], unobservable=("x", "y", "z", "roll", "pitch", "yaw"))
    assert evidence([first, *pictures()[1:]]).problem == ""
    assert "at least 2 pictures" in evidence([first]).problem
    assert "at least 2 pictures" in evidence([]).problem


def test_unobservable_directions_are_named_and_counted() -> None:
    found = evidence(pictures(unobservable=("x", "yaw")))
    assert found.unobservable == {"x": 59, "yaw": 59}
    assert "0 of 59 pictures show every direction" in found.problem
    assert "x, yaw unobservable" in found.problem
    assert found.longest_gap_s == pytest.approx(59 / RATE_HZ)


@pytest.mark.parametrize(("missing", "supported"), [(3, True), (20, False)])
def test_only_short_registration_gap_is_accepted(missing: int, supported: bool) -> None:
    found = pictures(600)
    found[100 : 100 + missing] = [replace(p, registered=False, reason="lost") for p in found[100 : 100 + missing]]
    whole = evidence(found)
    assert whole.longest_gap_s == pytest.approx((missing + 1) / RATE_HZ)
    assert (whole.problem == "") is supported
    if not supported:
        assert "did not register" in whole.problem
        assert "at 3.33 s: lost" in whole.problem


def test_low_frame_rate_is_not_a_gap() -> None:
    assert evidence([replace(p, stamp_s=2.0 * n) for n, p in enumerate(pictures(5))]).problem == ""


def test_fitting_depth_scale_is_proposed() -> None:
    rng = np.random.default_rng(0)
    wrong = replace(SENSOR, depth_scale=5000.0)
    millimetres = rng.uniform(800, 2400, (48, 64)).astype(np.uint16)
    found = evidence([replace(p, depth=depth_range(millimetres, wrong)) for p in pictures()], sensor=wrong)
    assert found.fitting_scale == 1000.0
    assert "depth_scale 5000" in found.problem
    assert "median 0.3" in found.problem
    assert "depth_scale = 1000 in camera.toml fits" in found.problem, "even where all of them registered"


def test_correct_depth_scale_is_not_changed() -> None:
    far = depth_range(np.full((48, 64), 6000, np.uint16), SENSOR)
    found = evidence([replace(p, depth=far) for p in pictures()])
    assert found.problem == "", "depths beyond the range that register all the same may be right"
    near = depth_range(np.full((48, 64), 400, np.uint16), SENSOR)
    found = evidence([replace(p, depth=near) for p in pictures()])
    assert found.fitting_scale is None
    assert "set min_range and max_range" in found.problem


def test_pictures_without_depth_do_not_support_trajectory() -> None:
    empty = depth_range(np.zeros((48, 64), np.uint16), SENSOR)
    assert empty.measured == empty.in_range == 0.0
    assert math.isnan(empty.depths[1])
    found = evidence(pictures(depth=empty, registered=False, reason="nothing measured"))
    assert "16-bit depth images" in found.problem
    assert json.dumps(found.as_table(), allow_nan=False)
    assert json.dumps(found.pictures[0].as_table(), allow_nan=False)
    assert in_words(found.as_table())


def test_depth_range_counts_measured_and_in_range_depths() -> None:
    raw = np.zeros((160, 160), np.uint16)
    raw[:80], raw[80:120] = 1000, 4000
    found = depth_range(raw, SENSOR)
    assert found.measured == pytest.approx(0.75, abs=0.05)
    assert found.in_range == pytest.approx(2 / 3, abs=0.05)
    assert found.depths == pytest.approx((1.0, 1.0, 4.0), abs=1e-6)


def test_contradicting_ground_truth_is_reported() -> None:
    assert evidence(pictures(), TrueComparison(0.02, 1.0, 1.0)).problem == ""
    half = evidence(pictures(), TrueComparison(0.3, 1.0, 0.5))
    assert "0.5 times the true size" in half.problem
    assert "depth_scale = 500 in camera.toml fits" in half.problem
    elsewhere = evidence(pictures(), TrueComparison(0.3, 1.0, None))
    assert "300 mm rms off groundtruth.txt, 100 mm allowed" in elsewhere.problem


def test_relative_size_compares_trajectories_of_same_shape() -> None:
    rng = np.random.default_rng(1)
    truth = np.cumsum(rng.normal(size=(50, 3)), axis=0)
    R = exp_so3(np.array([0.3, -0.2, 1.0]))
    assert relative_size(0.2 * truth @ R.T + [1.0, 2.0, 3.0], truth) == pytest.approx(0.2)
    assert relative_size(np.cumsum(rng.normal(size=(50, 3)), axis=0), truth) is None, "another shape"
    assert relative_size(np.zeros((50, 3)), truth) is None, "it stands still"
    assert relative_size(truth, np.zeros((50, 3))) is None


def test_picture_evidence_follows_pose_message() -> None:
    pose = BodyPose(0, np.eye(4), np.eye(4), np.zeros((6, 6)), 0.8, True, "", np.eye(6)[:1])
    found = picture_evidence(0, pose, DEPTH)
    assert found.unobservable == ("x",)
    assert not found.supports
    lost = picture_evidence(0, replace(pose, ok=False, reason="dark"), DEPTH)
    assert not lost.registered
    assert lost.reason == "dark"
    assert picture_evidence(0, None, DEPTH).reason == "no pose was estimated"


def test_motion_faster_than_a_hand_is_no_evidence_without_truth() -> None:
    stamps_ns = np.array([0, 33_333_333, 66_666_667])
    for step_m, turn_rad, jumps in ((0.05, 0.1, False), (0.31, 0.0, True), (0.0, 0.5, True)):
        poses = np.stack([np.eye(4), np.eye(4), from_xyz_rpy((step_m, 0.0, 0.0), (0.0, 0.0, turn_rad))])
        found = replace(evidence(pictures()), motions=camera_motions(stamps_ns, poses))
        assert bool(found.problem) is jumps
        if jumps:
            assert f"jumps by {step_m:.2f} m and {turn_rad:.2f} rad from 0.03 to 0.07 s" in found.problem
        assert replace(found, truth=TrueComparison(0.001, 1.0, 1.0)).problem == "", "the truth decides"
