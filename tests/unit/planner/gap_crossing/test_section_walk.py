"""Section walk: steps in the world, and feet away from their footholds."""

import numpy as np
import pytest

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.section_walk import SectionWalk, body_step
from sextant.services.planner.roadmap.roadmap import PassageStep
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.services.planner.robot_estimate import WorldStance
from sextant.shared.geometry import apply, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.10
T_WORLD_STRIP = from_xyz_rpy((1.0, 2.0, 0.0), (0.0, 0.0, 0.5))
FIELD = StripMap(np.zeros((10, 10), dtype=np.float32), np.zeros((10, 10), dtype=np.int8), 0.01, T_WORLD_STRIP)
BODY = np.array([0.5, 0.0, HEIGHT])
FEET = PROFILE.rest_feet(HEIGHT) + BODY  # {strip}
AHEAD = np.array([0.04, 0.0, 0.0])
STEPS = (
    PassageStep(2, FEET[2] + AHEAD, 0.03, BODY, 0.05),
    PassageStep(-1, BODY + AHEAD, 0.0, BODY + AHEAD, 0.05),
    PassageStep(2, FEET[2] + 2 * AHEAD, 0.03, BODY + AHEAD, 0.05),
)


def stance(leg_2: float) -> WorldStance:
    """Return the robot with one foot moved ahead by a distance [m]."""
    feet = FEET + leg_2 * np.array([1.0, 0.0, 0.0]) * (np.arange(6) == 2)[:, None]
    return WorldStance(T_WORLD_STRIP @ from_xyz_rpy(BODY, np.zeros(3)), apply(T_WORLD_STRIP, feet))


@pytest.fixture
def walk() -> SectionWalk:
    return SectionWalk("section 1", STEPS, FIELD, step_before=7)


def test_progress_is_counted_from_the_step_before(walk: SectionWalk) -> None:
    assert [walk.done(step) for step in (7, 8, 10)] == [0, 1, 3]
    walk.repeat_last()
    assert walk.done(8) == 0
    assert walk.describe(2) == "gap crossing, section 1: step 2 of 3"


def test_step_swings_one_leg_to_its_foothold(walk: SectionWalk) -> None:
    planned = walk.planned_step(0, stance(0.0), PROFILE, Settings())
    assert np.flatnonzero(planned.swing).tolist() == [2]
    np.testing.assert_allclose(planned.touchdown[2], apply(T_WORLD_STRIP, STEPS[0].touchdown))
    np.testing.assert_allclose(planned.touchdown[~planned.swing], stance(0.0).feet[~planned.swing])
    assert planned.clearance[2] == 0.03
    assert planned.duration >= PROFILE.stance.step_s


def test_step_of_the_body_alone_swings_no_leg(walk: SectionWalk) -> None:
    planned = walk.planned_step(1, stance(0.04), PROFILE, Settings())
    assert not planned.swing.any()
    np.testing.assert_allclose(planned.body_goal, T_WORLD_STRIP @ from_xyz_rpy(BODY + AHEAD, np.zeros(3)))
    moved = body_step(stance(0.0), BODY_RAISED)
    np.testing.assert_array_equal(moved.touchdown, stance(0.0).feet)
    np.testing.assert_array_equal(moved.body_goal, BODY_RAISED)


BODY_RAISED = from_xyz_rpy((0.0, 0.0, 0.17), np.zeros(3))


def test_foot_is_compared_with_its_newest_completed_step(walk: SectionWalk) -> None:
    assert walk.stray_foot(stance(0.04), 1) == ""
    assert walk.stray_foot(stance(0.08), 3) == ""
    assert "foot is 4 cm from its planned foothold" in walk.stray_foot(stance(0.04), 3)
    assert walk.stray_foot(stance(0.5), 0) == "", "no step is completed"


@pytest.mark.parametrize(("depth", "sunk"), [(0.02, 0), (0.03, 1)])
def test_sunk_foot_is_below_its_foothold(walk: SectionWalk, depth: float, sunk: int) -> None:
    standing = stance(0.04)
    standing.feet[2, 2] -= depth
    soles = walk.sunk_soles(standing, 1, PROFILE.foot.radius)
    assert len(soles) == sunk
    for sole in soles:
        np.testing.assert_allclose(sole, standing.feet[2] - [0.0, 0.0, PROFILE.foot.radius])
