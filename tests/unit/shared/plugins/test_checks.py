"""What a plug-in returns is a claim: it is checked before it is used."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.plugins import NoPose, NoStep, Pose, Step, StepRequest
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.plugins.foothold_rule import checked_score
from sextant.shared.plugins.registration import checked_pose
from sextant.shared.plugins.step_planner import checked_step
from tests.support.recorded import terrain

FEET = np.arange(18.0).reshape(6, 3)
REQUEST = StepRequest(np.eye(4), FEET, (np.ones(6, dtype=bool),), np.zeros(2), 0.0, 0.1, 0.03, 1.0, 1, terrain(0))
STEP = Step(np.arange(6) < 3, np.zeros((6, 3)), np.eye(4), np.full(6, 0.03), 1.0)
POSE = Pose(from_xyz_rpy((1.0, 2.0, 3.0), (0.1, 0.2, 0.3)), np.eye(6))
NAN = np.full((6, 3), np.nan)


def test_score_becomes_float32_of_the_map():
    score = checked_score(np.array([[0, 2]], dtype=np.int64), (1, 2))
    assert score.dtype == np.float32
    assert score.tolist() == [[0.0, 2.0]]


@pytest.mark.parametrize(
    "score", [None, [[0.0]], np.zeros(3), np.zeros((2, 1)), np.array([["a", "b"]]), np.zeros((1, 2), complex)]
)
def test_other_score_is_refused(score):
    with pytest.raises(ValueError, match=r"float array \(1, 2\) expected, found"):
        checked_score(score, (1, 2))


def test_standing_legs_keep_their_feet():
    step = checked_step(replace(STEP, touchdown=np.where(STEP.swing[:, None], np.zeros((6, 3)), np.nan)), REQUEST)
    assert isinstance(step, Step)
    assert (step.touchdown[3:] == FEET[3:]).all()
    assert (step.touchdown[:3] == 0.0).all()


@pytest.mark.parametrize(
    "step",
    [
        replace(STEP, swing=np.ones(6)),
        replace(STEP, swing=np.ones(5, dtype=bool)),
        replace(STEP, touchdown=NAN),
        replace(STEP, touchdown=np.zeros((3, 3))),
        replace(STEP, T_world_body=np.full((4, 4), np.inf)),
        replace(STEP, T_world_body=2.0 * np.eye(4)),
        replace(STEP, clearance=np.zeros(5)),
        replace(STEP, duration_s=0.0),
        replace(STEP, duration_s=float("nan")),
        NoStep(""),
        NoStep("why", 6),
    ],
)
def test_invalid_step_is_refused(step):
    with pytest.raises(ValueError, match="expected, found"):
        checked_step(step, REQUEST)


def test_reason_for_no_step_passes():
    assert checked_step(NoStep("why", 2), REQUEST) == NoStep("why", 2)


@pytest.mark.parametrize("found", [None, "step", POSE])
def test_other_object_than_a_step_is_refused(found):
    with pytest.raises(TypeError, match="a Step or a NoStep expected"):
        checked_step(found, REQUEST)


def test_rounding_errors_of_a_pose_are_removed():
    rounded = POSE.T_world_camera.astype(np.float16).astype(np.float64)
    pose = checked_pose(replace(POSE, T_world_camera=rounded))
    assert isinstance(pose, Pose)
    assert np.abs(pose.T_world_camera[:3, :3] @ pose.T_world_camera[:3, :3].T - np.eye(3)).max() < 1e-12


def test_covariance_of_a_pose_becomes_symmetric():
    skew = np.eye(6)
    skew[0, 1] = 1e-3
    pose = checked_pose(replace(POSE, covariance=skew))
    assert isinstance(pose, Pose)
    assert (pose.covariance == pose.covariance.T).all()


@pytest.mark.parametrize(
    "pose",
    [
        replace(POSE, T_world_camera=np.zeros((4, 4))),
        replace(POSE, T_world_camera=np.diag([-1.0, 1.0, 1.0, 1.0])),
        replace(POSE, T_world_camera=np.full((4, 4), np.nan)),
        replace(POSE, covariance=-np.eye(6)),
        replace(POSE, covariance=np.eye(3)),
        replace(POSE, overlap=1.5),
        replace(POSE, overlap=float("nan")),
        NoPose(""),
    ],
)
def test_invalid_pose_is_refused(pose):
    with pytest.raises(ValueError, match="expected, found"):
        checked_pose(pose)


@pytest.mark.parametrize("found", [None, np.eye(4), STEP])
def test_other_object_than_a_pose_is_refused(found):
    with pytest.raises(TypeError, match="a Pose or a NoPose expected"):
        checked_pose(found)
