"""Lotriet's baseline: his gait's rules, his search in squares, his floor height, and what he requires of a step."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.baselines import lotriet
from sextant.plugins import ElevationMap, NoStep, Step, StepRequest, TerrainMap
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.plugins.step_planner import checked_step
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
HEIGHT = PROFILE.stance.body_height
REST = PROFILE.rest_feet(HEIGHT)
N, CELL = 160, 0.01
TRIPOD = np.arange(6) % 2 == 0


def ground(height: float | np.ndarray = 0.0, score: float | np.ndarray = 0.0) -> TerrainMap:
    """Return a map around the origin with heights and scores (N, N), or one of each."""
    layer = np.zeros((N, N), dtype=np.float32)
    origin = np.full(2, -CELL * N / 2)
    no = np.zeros((N, N), dtype=bool)
    heights, scores = (layer + np.asarray(value, dtype=np.float32) for value in (height, score))
    return TerrainMap(0, CELL, origin, heights, layer, scores, no, no.astype(np.int8))


def request(
    terrain: TerrainMap, velocity: tuple[float, float] = (0.06, 0.0), yaw_rate: float = 0.0, refused: int = 0
) -> StepRequest:
    """Return a request of a robot at rest at the origin."""
    body = from_xyz_rpy((0.0, 0.0, HEIGHT), (0.0, 0.0, 0.0))
    feet = REST + np.array([0.0, 0.0, HEIGHT])
    return StepRequest(
        body, feet, (TRIPOD, ~TRIPOD), np.array(velocity), yaw_rate, HEIGHT, 0.03, 1.0, 1, terrain, refused=refused
    )


def elevation(heights: np.ndarray) -> ElevationMap:
    heights = heights.astype(np.float32)
    return ElevationMap(heights, np.zeros_like(heights), np.zeros(2), CELL, PROFILE.foot.radius)


@pytest.mark.parametrize(("slope_deg", "good"), [(0.0, True), (25.0, True), (35.0, False)])
def test_score_refuses_steep_ground(slope_deg: float, good: bool) -> None:
    heights = np.tan(np.radians(slope_deg)) * CELL * np.arange(20.0)[:, None] + np.zeros(20)
    inside = lotriet.score(elevation(heights))[4:-4, 4:-4]
    assert (inside <= 1.0).all() == good


def test_score_refuses_edges_and_keeps_unknown_cells() -> None:
    heights = np.zeros((20, 20))
    heights[10:] = 0.03
    heights[2, 2] = np.nan
    score = lotriet.score(elevation(heights))
    assert (score[9:11, 6:14] > 1.0).all()
    assert (score[6, 6:14] <= 1.0).all()
    assert np.isnan(score[1:4, 1:4]).all()


@pytest.mark.parametrize("leg", range(6))
def test_tripod_of_the_active_leg_swings_unless_it_is_stretched(leg: int) -> None:
    along = REST[leg, :2]
    mine = (np.arange(6) - leg) % 2 == 0
    assert (lotriet.swinging(along, REST, REST) == mine).all()
    stretched = REST.copy()
    stretched[leg, :2] *= 1.1
    assert (lotriet.swinging(along, stretched, REST) == ~mine).all()


def test_no_direction_has_no_active_leg() -> None:
    assert lotriet.swinging(np.zeros(2), REST, REST) is None


def test_search_takes_a_corner_of_a_smaller_square_before_a_nearer_cell_of_a_larger_one() -> None:
    score = np.full((N, N), 2.0)
    middle = N // 2
    score[middle + 2, middle + 2] = score[middle + 3, middle] = 0.0  # 2.8 and 3 cells away, and
    score[middle - 3, middle - 3] = 0.0
    place = lotriet.first_place(ground(0.02, score), np.zeros(2))
    assert place == pytest.approx([0.02, 0.02, 0.02], abs=1e-6)


def test_search_ends_at_its_square_and_at_the_border_of_the_map() -> None:
    score = np.full((N, N), 2.0)
    score[N // 2 + 7, N // 2] = 0.0
    assert lotriet.first_place(ground(0.0, score), np.zeros(2)) is None
    assert lotriet.first_place(ground(), np.array([5.0, 0.0])) is None
    assert lotriet.first_place(ground(score=np.nan), np.zeros(2)) is None


def test_search_passes_over_cells_out_of_reach() -> None:
    place = lotriet.first_place(ground(), np.zeros(2), lambda places: places[:, 0] > 0.015)
    assert place is not None
    assert place[:2] == pytest.approx([0.02, -0.02], abs=1e-6)


def test_floor_is_the_mean_of_the_three_highest_targets() -> None:
    assert lotriet.floor_height(np.array([0.0, 0.06, -0.1, 0.03, 0.0, 0.0])) == pytest.approx(0.03)


@pytest.mark.parametrize(
    ("velocity", "yaw_rate"), [((0.06, 0.0), 0.0), ((0.0, 0.05), 0.0), ((0.0, 0.0), 0.2), ((-0.04, 0.02), 0.1)]
)
def test_step_over_level_ground_moves_the_body_as_commanded(velocity: tuple[float, float], yaw_rate: float) -> None:
    step = checked_step(lotriet.Steps(PROFILE).plan(request(ground(), velocity, yaw_rate)), request(ground()))
    assert isinstance(step, Step)
    assert step.T_world_body == pytest.approx(from_xyz_rpy((*velocity, HEIGHT), (0.0, 0.0, yaw_rate)))
    assert step.swing.sum() == 3
    assert step.touchdown[step.swing, 2] == pytest.approx(PROFILE.foot.radius, abs=1e-6)


@pytest.mark.parametrize("velocity", [(0.06, 0.0), (0.0, 0.05), (-0.04, 0.02)])
def test_feet_land_half_a_travel_ahead_of_their_rest(velocity: tuple[float, float]) -> None:
    step = lotriet.Steps(PROFILE).plan(request(ground(), velocity))
    assert isinstance(step, Step)
    nominal = REST[:, :2] + 1.5 * np.array(velocity)  # (5.19)
    assert np.abs(step.touchdown[:, :2] - nominal)[step.swing].max() <= CELL / 2 + 1e-9


def test_body_rises_with_the_targets_and_over_ground_between_the_legs() -> None:
    rise = np.zeros((N, N))
    rise[N // 2 + 4 :] = 0.04  # under the front legs
    step = lotriet.Steps(PROFILE).plan(request(ground(rise), (0.03, 0.0)))
    assert isinstance(step, Step)
    assert step.T_world_body[2, 3] - HEIGHT > 0.01
    hump = np.zeros((N, N))
    hump[N // 2 - 2 : N // 2 + 3, N // 2 - 2 : N // 2 + 3] = 0.03
    step = lotriet.Steps(PROFILE).plan(request(ground(hump), (0.03, 0.0)))
    assert isinstance(step, Step)
    assert step.T_world_body[2, 3] == pytest.approx(HEIGHT + 0.03)


def test_missing_foothold_names_its_leg() -> None:
    found = lotriet.Steps(PROFILE).plan(request(ground(score=2.0)))
    assert isinstance(found, NoStep)
    assert "no cell with a score of at most 1" in found.reason
    assert found.leg in range(6)


def test_foot_out_of_reach_is_refused() -> None:
    tall = np.zeros((N, N))
    tall[:, N // 2 + 5 :] = 0.3
    found = lotriet.Steps(PROFILE).plan(request(ground(tall)))
    assert isinstance(found, NoStep)
    assert "in reach" in found.reason


def test_standing_foot_that_would_stay_behind_out_of_reach_is_refused() -> None:
    asked = request(ground())
    stretched = asked.feet.copy()
    stretched[~TRIPOD] += [-0.16, 0.0, 0.0]
    found = lotriet.Steps(PROFILE).plan(replace(asked, feet=stretched, velocity=np.array([0.001, 0.0])))
    assert isinstance(found, NoStep)
    assert "out of reach" in found.reason


def test_refused_step_is_tried_shorter() -> None:
    planner, asked = lotriet.Steps(PROFILE), request(ground())
    whole, shorter = planner.plan(asked), planner.plan(replace(asked, refused=1))
    assert isinstance(whole, Step)
    assert isinstance(shorter, Step)
    assert shorter.T_world_body[0, 3] < whole.T_world_body[0, 3]
