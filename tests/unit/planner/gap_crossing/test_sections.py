"""Section goals in a gap crossing, and ground that gave way."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.deploy.evaluation.passage_fields import FAR, GAP, NEAR, field_of, heights, thesis_blocks
from sextant.services.planner.gap_crossing.sections import goal_behind, without
from sextant.services.planner.gap_crossing.strip_map import StripMap
from sextant.shared.wire.messages import UNKNOWN

PILLARS = field_of(heights(thesis_blocks(1, GAP, 0.16, 0.17, 0.035, 0.27), GAP))
BEHIND = NEAR + GAP + 0.40  # [m] x at which the whole robot stands behind the gap
END = NEAR + GAP + FAR
EDGE = 0.05  # [m] width of the strip along a gap's edge that carries a foot badly
places = st.floats(0.05, END - 0.05)


@given(places, places)
def test_a_goal_lies_ahead_at_most_at_the_target_and_behind_the_gap(x: float, target: float) -> None:
    goal = goal_behind(PILLARS, x, target)
    if x >= target or x > BEHIND + EDGE:
        assert goal is None
    elif x < NEAR + GAP and target > NEAR + 2 * EDGE:
        assert goal is not None
        assert x < goal <= target
        assert goal == target or goal == pytest.approx(BEHIND, abs=EDGE) or target < NEAR + GAP + EDGE


def test_where_ground_carries_as_anywhere_there_is_no_goal() -> None:
    """Check that there is no goal either if the target lies beyond the strip.

    The end of the strip is not the end of the ground.
    """
    for target in (1.9, 5.0):
        assert goal_behind(field_of(np.zeros((200, 100), dtype=np.float32)), 0.6, target) is None


def test_of_two_gaps_with_room_to_walk_between_them_the_first_comes_first() -> None:
    elevation = np.zeros((300, 100), dtype=np.float32)
    elevation[100:130] = elevation[240:280] = -0.4
    field = field_of(elevation)
    for x in (0.6, 1.2):
        assert goal_behind(field, x, 9.0) == pytest.approx(1.3 + 0.40, abs=EDGE)
    assert goal_behind(field, 1.5, 9.0) == pytest.approx(1.3 + 0.40, abs=EDGE)
    assert goal_behind(field, 2.0, 9.0) == pytest.approx(2.8 + 0.40, abs=EDGE)
    elevation[160:240] = -0.4  # too little ground between the gaps
    assert goal_behind(field_of(elevation), 0.6, 9.0) == pytest.approx(2.8 + 0.40, abs=EDGE)


def test_a_gap_that_is_far_ahead_is_walked_to() -> None:
    elevation = np.zeros((300, 100), dtype=np.float32)
    elevation[200:240] = -0.4
    assert goal_behind(field_of(elevation), 1.0, 9.0) is None
    assert goal_behind(field_of(elevation), 1.5, 9.0) is not None


def test_a_gap_that_the_strip_ends_in_is_one() -> None:
    elevation = np.zeros((200, 100), dtype=np.float32)
    elevation[160:] = -0.4
    assert goal_behind(field_of(elevation), 1.0, 5.0) == pytest.approx(2.0 + 0.40, abs=0.07)


def test_beyond_what_is_known_nothing_is_a_gap() -> None:
    level = field_of(np.zeros((200, 100), dtype=np.float32))
    evaluation = level.evaluation.copy()
    evaluation[120:] = UNKNOWN
    assert goal_behind(replace(level, evaluation=evaluation), 0.6, 1.9) is None
    nothing = replace(level, evaluation=np.full_like(evaluation, UNKNOWN))
    assert goal_behind(nothing, 0.4, 1.9) is None


@given(st.floats(-0.5, 3.0), st.floats(-1.0, 1.0), st.floats(-0.4, 0.1), st.floats(0.0, 0.2))
def test_what_gave_way_carries_nothing_and_all_else_stays(x: float, y: float, z: float, radius: float) -> None:
    before = unseen_here_and_there()
    after = without(before, np.array([x, y, z]), radius)
    i, j = np.indices(before.evaluation.shape)
    x0, y0 = before.corner
    off = np.hypot(x0 + i * before.resolution - x, y0 + j * before.resolution - y)
    inside = off <= radius
    np.testing.assert_array_equal(after.evaluation[~inside], before.evaluation[~inside])
    np.testing.assert_array_equal(after.elevation[~inside], before.elevation[~inside])
    assert (after.evaluation[inside] > 0).all()
    np.testing.assert_array_equal(after.evaluation == UNKNOWN, before.evaluation == UNKNOWN)
    np.testing.assert_array_equal(np.isnan(after.elevation), np.isnan(before.elevation))
    sunk = off <= 0.5 * radius
    assert not (after.elevation[sunk] > np.float32(z)).any()
    assert not (after.elevation > before.elevation).any()
    again = without(after, np.array([x, y, z]), radius)
    np.testing.assert_array_equal(again.evaluation, after.evaluation)
    np.testing.assert_array_equal(again.elevation, after.elevation)


def unseen_here_and_there() -> StripMap:
    rng = np.random.default_rng(0)
    unseen = rng.random(PILLARS.evaluation.shape) < 0.1
    elevation = np.where(unseen, np.float32(np.nan), PILLARS.elevation)
    return StripMap(elevation, np.where(unseen, np.int8(UNKNOWN), PILLARS.evaluation), PILLARS.resolution, np.eye(4))
