"""Walks by the poses of another localization; the robot holds with the reason when they stop or jump."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ExternalPose, Mode
from tests.support.external_localization import Localization, by_external_poses
from tests.support.walks import S, Walk, flat, walk

PROFILE = load_profile("phantomx_mk2")
FAULT_S, END_S = 9.0, 14.0
SHIFT = from_xyz_rpy((0.4, 0.0, 0.0), np.zeros(3))


def walked(distance: float, localization: Localization) -> Walk:
    return walk(flat(distance), 1000, guests=[localization], around=by_external_poses(PROFILE))


def test_robot_walks_by_poses_with_noise_drift_and_delay() -> None:
    found = walked(0.8, Localization(1, drift=0.02, delay_s=0.12))
    report = found.report
    assert report.success, report.reason
    assert report.pose_error_m.rms < 0.02
    assert abs(report.map_error_m.bias) < 0.003
    poses = found.heard.of(topics.BODY_POSE)
    assert all(pose.ok for pose in poses)
    assert poses[0].T_world_body[0, 3] == pytest.approx(0.0, abs=0.01), "{world} begins where the robot stands"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda _: None, "no pose from elsewhere for"),
        (
            lambda pose: replace(pose, T_frame_body=SHIFT @ pose.T_frame_body),
            "the pose from elsewhere is refused: it jumps: ",
        ),
    ],
    ids=["stops", "jumps"],
)
def test_robot_holds_while_poses_stop_or_jump_and_goes_on_afterwards(change, reason: str) -> None:  # type: ignore[no-untyped-def]
    def faulty(pose: ExternalPose) -> ExternalPose | None:
        return change(pose) if FAULT_S < pose.stamp_ns * 1e-9 < END_S else pose

    found = walked(0.9, Localization(1, change=faulty))
    assert found.report.success, found.report.reason
    assert found.report.falls == 0
    within = [pose for pose in found.heard.of(topics.BODY_POSE) if FAULT_S + 0.7 < pose.stamp_ns * 1e-9 < END_S]
    assert within
    assert all(not pose.ok and reason in pose.reason for pose in within)
    held = [state for state in found.states(FAULT_S + 3.0, END_S) if state.mode is Mode.HOLD]
    assert len(held) > 0.9 * len(found.states(FAULT_S + 3.0, END_S))
    told = found.statuses(FAULT_S + 3.0, END_S)
    assert all(reason in status.reason for status in told), "the planner gives the reason of perception"
    truth = [message for message in found.heard.of(topics.TRUTH) if FAULT_S + 3.0 < message.stamp_ns / S < END_S]
    assert np.ptp([message.T_world_body[0, 3] for message in truth]) < 0.005
