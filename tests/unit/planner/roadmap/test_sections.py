"""Section goals in a gap crossing, and ground that gave way."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.peers.passage_strips import FAR, GAP, NEAR, heights, thesis_blocks
from sextant.evaluation.whole_maps.strip import strip_of
from sextant.services.planner.gap_crossing.params import GapDetectionParams
from sextant.services.planner.roadmap import sections
from sextant.services.planner.roadmap.params import BareGroundParams
from sextant.services.planner.roadmap.sections import bare, foothold_heights, hidden_behind, nearest_view, without
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import apply, inverse
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import UNKNOWN

goal_behind = partial(sections.goal_behind, params=BareGroundParams())
PILLARS = strip_of(heights(thesis_blocks(1, GAP, 0.16, 0.17, 0.035, 0.27), GAP))
BEHIND = NEAR + GAP + 0.40  # [m] x at which the whole robot stands behind the gap
END = NEAR + GAP + FAR
EDGE = 0.05  # [m] width of the strip along a gap's edge that carries a foot badly
places = st.floats(0.05, END - 0.05)


@given(places, places)
def test_section_goal_lies_behind_gap_and_not_beyond_target(x: float, target: float) -> None:
    goal = goal_behind(PILLARS, x, target)
    if x >= target or x > BEHIND + EDGE:
        assert goal is None
    elif x < NEAR + GAP and target > NEAR + 2 * EDGE:
        assert goal is not None
        assert x < goal <= target
        assert goal == target or goal == pytest.approx(BEHIND, abs=EDGE) or target < NEAR + GAP + EDGE


def test_middle_at_one_border_does_not_widen_places_at_the_other() -> None:
    evaluation = np.full((40, 60), 9, dtype=np.int8)  # all of it is a gap, but
    evaluation[20:22, :6] = [-5, -5, -4, -3, -2, -1]  # ground with a middle at the left border
    evaluation[18:24, -6:] = -1  # and more, without a middle, at the right one
    field = replace(PILLARS, elevation=np.zeros_like(evaluation, dtype=np.float32), evaluation=evaluation)
    assert not sections.has_wide_places(field, BareGroundParams(), -5)
    evaluation[18:24, -6:] = -5
    assert sections.has_wide_places(field, BareGroundParams(), -5)


def test_continuous_ground_has_no_section_goal() -> None:
    """Check that there is no goal either if the target lies beyond the strip.

    The end of the strip is not the end of the ground.
    """
    for target in (1.9, 5.0):
        assert goal_behind(strip_of(np.zeros((200, 100), dtype=np.float32)), 0.6, target) is None


def test_first_of_two_separated_gaps_is_crossed_first() -> None:
    elevation = np.zeros((300, 100), dtype=np.float32)
    elevation[100:130] = elevation[240:280] = -0.4
    field = strip_of(elevation)
    for x in (0.6, 1.2):
        assert goal_behind(field, x, 9.0) == pytest.approx(1.3 + 0.40, abs=EDGE)
    assert goal_behind(field, 1.5, 9.0) == pytest.approx(1.3 + 0.40, abs=EDGE)
    assert goal_behind(field, 2.0, 9.0) == pytest.approx(2.8 + 0.40, abs=EDGE)
    elevation[160:240] = -0.4  # too little ground between the gaps
    assert goal_behind(strip_of(elevation), 0.6, 9.0) == pytest.approx(2.8 + 0.40, abs=EDGE)


def test_distant_gap_has_no_section_goal_yet() -> None:
    elevation = np.zeros((300, 100), dtype=np.float32)
    elevation[200:240] = -0.4
    assert goal_behind(strip_of(elevation), 1.0, 9.0) is None
    assert goal_behind(strip_of(elevation), 1.5, 9.0) is not None


def test_bare_ground_follows_parameters_of_gap_detection() -> None:
    """Check that ground which the detection of gaps accepts is no gap for the goal of a section, and vice versa."""
    elevation = np.zeros((300, 100), dtype=np.float32)
    elevation[100:140, 56:72] = -0.4  # a hole of 16 cm to the right of the middle
    field = strip_of(elevation)
    for params, is_gap in (
        (GapDetectionParams(), True),
        (GapDetectionParams(carrying_share=0.2), False),
        (GapDetectionParams(half_width_m=0.04), False),
    ):
        assert bare(field, params)[110:130].all() == is_gap
        assert (sections.goal_behind(field, 0.6, 9.0, params) is not None) == is_gap


def test_gap_at_strip_end_has_section_goal() -> None:
    elevation = np.zeros((200, 100), dtype=np.float32)
    elevation[160:] = -0.4
    assert goal_behind(strip_of(elevation), 1.0, 5.0) == pytest.approx(2.0 + 0.40, abs=0.07)


def test_unknown_ground_is_not_gap() -> None:
    level = strip_of(np.zeros((200, 100), dtype=np.float32))
    evaluation = level.evaluation.copy()
    evaluation[120:] = UNKNOWN
    assert goal_behind(replace(level, evaluation=evaluation), 0.6, 1.9) is None
    nothing = replace(level, evaluation=np.full_like(evaluation, UNKNOWN))
    assert goal_behind(nothing, 0.4, 1.9) is None


@given(st.floats(-0.5, 3.0), st.floats(-1.0, 1.0), st.floats(-0.4, 0.1), st.floats(0.0, 0.2))
def test_ground_that_gave_way_is_removed_and_other_cells_stay(x: float, y: float, z: float, radius: float) -> None:
    before = partly_unseen_pillars()
    after = without(before, np.array([x, y, z]), radius)
    i, j = np.indices(before.evaluation.shape)
    x0, y0 = before.first_cell
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


@given(st.floats(-0.5, 0.5), st.floats(0.0, 0.2))
def test_foothold_heights_follow_ground_and_ignore_single_cells(level: float, step: float) -> None:
    elevation = np.full((60, 40), level, dtype=np.float32)
    elevation[30:] += np.float32(step)
    field = StripMap(elevation, np.full(elevation.shape, -5, dtype=np.int8), 0.01, np.eye(4))
    assert foothold_heights(field) == pytest.approx((level, level + step), abs=1e-6)
    elevation[10, 10], elevation[11, 11] = level + 1.0, np.nan  # an outlier at the edge of its ground, and an unknown cell
    evaluation = field.evaluation.copy()
    evaluation[9:13, 9:13] = -1
    assert foothold_heights(replace(field, evaluation=evaluation)) == pytest.approx((level, level + step), abs=1e-6)


def test_ground_without_footholds_has_no_heights() -> None:
    nothing = StripMap(np.ones((5, 5), dtype=np.float32), np.full((5, 5), UNKNOWN, dtype=np.int8), 0.01, np.eye(4))
    assert foothold_heights(nothing) == (0.0, 0.0)


@given(st.integers(10, 80), st.integers(5, 30), st.integers(1, 40))
def test_ground_hidden_behind_high_ground_begins_where_it_ends(begin: int, length: int, shadow: int) -> None:
    field = strip_of(np.zeros((200, 40), dtype=np.float32))
    elevation, evaluation = field.elevation.copy(), field.evaluation.copy()
    elevation[begin : begin + length, 5:9] = 0.04
    evaluation[begin + length : begin + length + shadow, 5:9] = UNKNOWN
    shadowed = replace(field, elevation=elevation, evaluation=evaluation)
    assert hidden_behind(shadowed, 0.02, 0.3) == pytest.approx([field.first_cell[0] + field.resolution * (begin + length)])
    assert not hidden_behind(shadowed, 0.05, 0.3).size, "the ground before it is not high"
    assert not hidden_behind(shadowed, 0.02, 0.05).size, "it is outside the band"
    assert not hidden_behind(replace(shadowed, evaluation=field.evaluation), 0.02, 0.3).size, "it is seen"


@pytest.mark.parametrize("robot", ["phantomx_mk2", "lotriet_rx64"])
@pytest.mark.parametrize("height", [0.09, 0.12])
def test_ground_is_in_view_from_nearest_view_on(robot: str, height: float) -> None:
    camera = load_profile(robot).camera
    x = nearest_view(camera, height) + np.array([-0.02, 0.02])
    ahead = apply(inverse(camera.T_body_camera), np.column_stack([x, [0.0, 0.0], [-height, -height]]))
    rows = camera.intrinsics.fy * ahead[:, 1] / ahead[:, 2] + camera.intrinsics.cy
    seen = (rows <= camera.intrinsics.height - 1) & (ahead[:, 2] >= camera.sensor.min_range)
    assert seen.tolist() == [False, True]


def partly_unseen_pillars() -> StripMap:
    rng = np.random.default_rng(0)
    unseen = rng.random(PILLARS.evaluation.shape) < 0.1
    elevation = np.where(unseen, np.float32(np.nan), PILLARS.elevation)
    return StripMap(elevation, np.where(unseen, np.int8(UNKNOWN), PILLARS.evaluation), PILLARS.resolution, np.eye(4))
