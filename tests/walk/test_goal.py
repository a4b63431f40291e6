"""A goal behind a wall: the planner finds a path around it.

The walk runs in lockstep with camera and estimated pose.
"""

import numpy as np
import pytest

from sextant.evaluation.report import as_table, check
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Mode
from tests.support.walks import walk


@pytest.mark.rare
def test_robot_walks_around_wall_to_goal() -> None:
    heard = (topics.ACTUATOR_STATE, topics.PLANNER_STATUS, topics.GOAL, topics.VELOCITY, topics.BODY_POSE, topics.TRUTH)
    found = walk(load_scenario("wall"), 1001, heard)
    report = found.report
    assert report.success, report.reason
    assert (report.falls, report.shutdowns, report.collisions) == (0, 0, 0)
    assert found.heard.of(topics.GOAL)
    assert not found.heard.of(topics.VELOCITY), "nobody steers it"
    statuses = found.statuses()
    assert "arrived" in {status.state for status in statuses}
    ways = [status.path for status in statuses if len(status.path)]
    goal = found.heard.of(topics.GOAL)[0].waypoints[-1]
    np.testing.assert_allclose(ways[0][-1], goal)
    assert max(len(way) for way in ways) > 2, "it goes around a corner"
    track = np.array([pose.T_world_body[:2, 3] for pose in found.heard.of(topics.BODY_POSE)])
    assert np.abs(track[:, 1]).max() > 0.3
    assert found.states()[-1].mode is Mode.HOLD
    assert not check(as_table(report))


@pytest.mark.rare
def test_robot_walks_over_rubble_and_stairs_to_goal() -> None:
    found = walk(load_scenario("goal_stairs"), 1001, (topics.GOAL, topics.VELOCITY, topics.BODY_POSE))
    report = found.report
    assert report.success, report.reason
    assert (report.falls, report.shutdowns, report.collisions) == (0, 0, 0)
    assert found.heard.of(topics.GOAL)
    assert not found.heard.of(topics.VELOCITY), "nobody steers it"
    heights = [pose.T_world_body[2, 3] for pose in found.heard.of(topics.BODY_POSE)]
    assert heights[-1] - heights[0] > 0.08, "three risers up"
