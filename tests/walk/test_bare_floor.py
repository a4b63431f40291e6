"""Walks over a bare floor: texture or a gyroscope fixes the heading. A floor that only mirrors the lamps changes nothing."""

from dataclasses import replace

import numpy as np

from sextant.shared.geometry import yaw_of
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.wire import topics
from tests.support.walks import Walk, walk

OFF: dict[str, object] = {"perception": {"texture": {"use": False}}}


def poses(walked: Walk) -> np.ndarray:  # type: ignore[type-arg]
    return np.array([pose.T_world_body for pose in walked.heard.of(topics.BODY_POSE)])


def heading_error(walked: Walk) -> float:
    """Return the error of the heading [rad] that has come up since the start."""
    truths, found = walked.heard.of(topics.TRUTH), walked.heard.of(topics.BODY_POSE)
    apart = []
    for pose in (found[0], found[-1]):
        truth = min(truths, key=lambda truth: abs(truth.stamp_ns - pose.stamp_ns))
        apart.append(yaw_of(pose.T_world_body) - yaw_of(truth.T_world_body))
    return abs(apart[1] - apart[0])


def walked(scenario: Scenario, **changes: object) -> Walk:
    return walk(replace(scenario, **changes), 1000)  # type: ignore[arg-type]


def test_texture_fixes_the_heading_of_a_robot_with_wrong_horns() -> None:
    usual = replace(load_scenario("bare_floor+usual"), goal=Goal(0.8, corridor=0.5))
    seeing, legs_only = walked(usual), walked(usual, params=OFF)
    assert seeing.report.success, seeing.report.reason
    assert heading_error(seeing) < 0.5 * heading_error(legs_only)
    found = seeing.heard.of(topics.BODY_POSE)
    assert all(pose.ok for pose in found)
    walking = found[len(found) // 2 : -len(found) // 5]  # at rest the legs are used
    assert sum(len(pose.degenerate) == 0 for pose in walking) > 0.8 * len(walking)


def test_gyroscope_fixes_the_heading_of_a_robot_with_wrong_horns() -> None:
    usual = replace(load_scenario("flat+usual"), goal=Goal(0.8, corridor=0.5))
    legs_only, with_gyroscope = walked(usual), walked(usual, robot="phantomx_mk2_imu")
    assert with_gyroscope.report.success, with_gyroscope.report.reason
    assert heading_error(with_gyroscope) < 0.3 * heading_error(legs_only)


def test_glossy_floor_changes_no_pose() -> None:
    short = replace(load_scenario("bare_floor"), goal=Goal(0.5, corridor=0.5))
    seeing = walked(short, floor=replace(short.floor, look="glossy"))
    np.testing.assert_array_equal(poses(seeing), poses(walked(short, params=OFF)))
