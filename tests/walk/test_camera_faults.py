"""Camera faults during a walk.

The fault is named, the robot stops on an old map, invents no ground, and goes on.
"""

import numpy as np
import pytest

from sextant.shared.scenario.scenario import Fault, Goal, Scenario, Variation
from sextant.shared.scenario.scenario import Walk as Options
from sextant.shared.scenario.terrain import Box, Plane
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Mode
from tests.support.walks import Walk, flat, walk

AT_S, FOR_S = 4.5, 5.0
HEARD = (topics.ACTUATOR_STATE, topics.PLANNER_STATUS, topics.TRUTH, topics.BODY_POSE, topics.TERRAIN, topics.SCAN)
REASONS = {
    "absent": "the camera sends no images: unplugged",
    "frozen": "frozen",
    "noise": "the camera sends noise",
    "stale": "old by their stamps",
    "ahead": "the camera stamps its images 1.0 s in the future",
    "backward": "old by their stamps",
}


def faulty(kind: str, for_s: float = FOR_S, goal: float = 0.3) -> Walk:
    return walk(flat(goal, faults=(Fault(AT_S, "camera", kind, for_s=for_s),)), 1000, wanted=HEARD)  # type: ignore[arg-type]


def assert_goal_reached_with_correct_maps(found: Walk) -> None:
    """Check that the robot reached its goal, and that every map was correct.

    No map contains ground where there is none.
    """
    assert found.report.success, found.report.reason
    assert found.report.falls == 0
    for terrain in found.heard.of(topics.TERRAIN):
        assert np.nanmax(np.abs(terrain.elevation)) < 0.05


@pytest.mark.parametrize("kind", REASONS)
def test_robot_stops_on_camera_fault_with_reason_and_resumes(kind: str) -> None:
    found = faulty(kind)
    during = found.states(AT_S, AT_S + FOR_S)
    assert during[-1].mode is Mode.HOLD
    if kind == "absent":
        assert during[-1].step - during[0].step <= 1, "no more than one step began"
    said = {status.reason for status in found.statuses(AT_S, AT_S + FOR_S)}
    assert any(REASONS[kind] in reason for reason in said), said
    assert all(state.mode is Mode.HOLD for state in found.states(AT_S + 3.5, AT_S + FOR_S)), "it stands"
    bad = [p for p in found.heard.of(topics.BODY_POSE, AT_S + 2.5, AT_S + FOR_S) if p.ok]
    assert not bad, "no pose stands on such pictures"
    assert len(found.heard.of(topics.SCAN, AT_S + 2.5, AT_S + FOR_S)) == 0
    assert_goal_reached_with_correct_maps(found)


def test_blind_camera_is_reported_while_robot_walks_over_mapped_ground() -> None:
    found = faulty("blind", goal=0.5)
    poses = found.heard.of(topics.BODY_POSE, AT_S + 0.2, AT_S + FOR_S)
    assert poses
    assert all(not pose.ok and pose.reason for pose in poses)
    assert_goal_reached_with_correct_maps(found)


def test_gap_of_200_ms_in_images_does_not_stop_walk() -> None:
    found = faulty("absent", 0.2)
    assert all(state.mode is Mode.WALK for state in found.states(AT_S, AT_S + 2.0))
    assert all(pose.ok for pose in found.heard.of(topics.BODY_POSE, AT_S))
    assert_goal_reached_with_correct_maps(found)


@pytest.mark.parametrize("imu", [True, pytest.param(False, marks=pytest.mark.rare)])
def test_robot_walks_by_touch_over_unseen_ground_on_request(imu: bool) -> None:
    blocks = tuple(Box((0.75 + 0.13 * i, y), (0.09, 0.12), 0.02 + 0.01 * (i % 3)) for i in range(2) for y in (-0.2, 0.2))
    course = Scenario(
        "dark",
        (Plane(), *blocks),
        Goal(0.7),
        walk=Options(by_touch=True),
        variation=Variation(imu=imu),
        faults=(Fault(AT_S, "camera", "absent", for_s=1000.0),),
    )
    found = walk(course, 1000, wanted=HEARD)
    assert found.report.success, found.report.reason
    assert found.report.falls == 0
    assert any("by touch" in status.reason for status in found.statuses())
    stood = [status for status in found.statuses(AT_S, AT_S + 4.0) if status.state == "waiting"]
    assert any(REASONS["absent"] in status.reason for status in stood), "it had stopped with a reason before the question"
    if imu:
        up = [truth.T_world_body[2, 2] for truth in found.heard.of(topics.TRUTH, AT_S)]
        assert np.degrees(np.arccos(np.percentile(up, 5))) < 6.0, "with an IMU its tilt does not drift away"
