"""Plans on maps: they reach what can be reached, say why not otherwise, and every foot stands on the map's ground."""

import json
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.evaluation.map_plan.map_walk import MapPlan, plan_on_map
from sextant.evaluation.whole_maps.terrain_map import MapPlanError
from sextant.shared.geometry import yaw_of
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profile import LEGS
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
ORIGIN = (-0.6, -1.0)
Heights = NDArray[np.float32]


def flat() -> Heights:
    return np.zeros((360, 200), dtype=np.float32)


def row(x: float) -> int:
    return round((x - ORIGIN[0]) / 0.01)


def plan(heights: Heights, goal: tuple[float, float] = (2.4, 0.0), **more: object) -> MapPlan:
    return plan_on_map(PROFILE, heights, 0.01, goal, origin=ORIGIN, **more)  # type: ignore[arg-type]


def pillars() -> Heights:
    """Return a gap of 80 cm with pillars of 8 cm."""
    heights, rng = flat(), np.random.default_rng(1)
    heights[row(0.9) : row(1.7)] = -0.5
    for i in range(row(0.95), row(1.7), 16):
        for j in (60, 78, 96, 114, 132):
            a, b = i + rng.integers(-2, 3), j + rng.integers(-3, 4)
            heights[a : a + 8, b : b + 8] = rng.uniform(-0.02, 0.02)
    return heights


def check(found: MapPlan) -> None:
    """Check that the legs reach all feet, that feet stand on the map, and that only swinging feet move."""
    r, radius = found.terrain.resolution, PROFILE.foot.radius
    for before, after in pairwise((found.start, *found.moves)):
        still = np.array([leg not in after.legs for leg in LEGS])
        assert np.array_equal(before.feet[still], after.feet[still])
        in_body = (after.feet - after.T_map_body[:3, 3]) @ after.T_map_body[:3, :3]
        assert np.isfinite(body_inverse(PROFILE, in_body)).all()
        for k in np.flatnonzero(~still):
            i, j = np.rint((after.feet[k, :2] - found.terrain.origin) / r).astype(int)
            around = found.terrain.elevation[i - 1 : i + 2, j - 1 : j + 2]
            assert np.nanmin(np.abs(around - (after.feet[k, 2] - radius))) < 0.02


def test_walk_over_steps_reaches_the_goal_on_the_map() -> None:
    heights = flat()
    heights[row(0.8) : row(1.2)], heights[row(1.2) :] = 0.04, 0.07
    found = plan(heights, (2.4, 0.2))
    assert found.reached, found.reason
    assert np.linalg.norm(found.moves[-1].T_map_body[:2, 3] - [2.4, 0.2]) < 0.06
    assert 2.4 <= found.length < 2.7
    assert found.moves[-1].T_map_body[2, 3] == pytest.approx(0.07 + PROFILE.stance.body_height, abs=0.02)
    check(found)


def test_path_leads_around_a_wall() -> None:
    heights = flat()
    heights[row(0.9) : row(1.0), 60:140] = 0.3
    found = plan(heights)
    assert found.reached, found.reason
    assert len(found.path) > 2
    assert max(abs(move.T_map_body[1, 3]) for move in found.moves) > 0.4
    check(found)


def test_gap_is_crossed_over_pillars_or_refused() -> None:
    found = plan(pillars())
    assert found.reached, found.reason
    assert sum(move.crosses for move in found.moves) > 20
    check(found)
    around = plan(pillars(), cross_gaps=False)
    assert not around.reached
    assert around.reason.startswith("no path to (2.4, 0.0): blocked by")


def test_bridge_aside_of_the_goal_is_crossed_with_turns_of_the_body() -> None:
    heights, turn = flat(), np.radians(20.0)
    heights[row(0.9) : row(1.7)] = -0.5
    x, y = np.meshgrid(
        0.01 * np.arange(heights.shape[0]) + ORIGIN[0], 0.01 * np.arange(heights.shape[1]) + ORIGIN[1], indexing="ij"
    )
    for along in (-0.26, 0.0, 0.26):
        off_x, off_y = x - 1.3 - along, y - (0.35 + along) * np.tan(turn)
        ahead, left = np.cos(turn) * off_x + np.sin(turn) * off_y, np.cos(turn) * off_y - np.sin(turn) * off_x
        heights[(np.abs(ahead) <= 0.085) & (np.abs(np.abs(left) - 0.16) <= 0.05)] = 0.0
    found = plan(heights)
    assert found.reached, found.reason
    assert max(yaw_of(move.T_map_body) for move in found.moves if move.crosses) > np.radians(10.0)
    check(found)


@pytest.mark.parametrize("cells", [30, 36, 38, 42])
def test_bridge_about_as_wide_as_the_feet_is_walked_or_crossed(cells: int) -> None:
    """Check that no width lies between those that a crossing takes and those that a path takes."""
    heights = flat()
    heights[row(0.9) : row(1.7)] = -0.5
    heights[:, 100 - cells // 2 : 100 + cells // 2] = 0.0
    found = plan(heights)
    assert found.reached, found.reason
    assert any(move.crosses for move in found.moves) == (cells < 40)
    assert not found.moves[-1].crosses
    check(found)


def test_gap_without_footholds_is_refused_with_the_leg_that_fails() -> None:
    heights = flat()
    heights[row(0.9) : row(1.5)] = -0.5
    found = plan(heights)
    assert not found.reached
    assert "no gap crossing: straight on: no step from" in found.reason
    assert "; with turns of the body: no step from" in found.reason
    assert "front leg: out of reach" in found.reason


def test_ground_beyond_the_map_is_no_path() -> None:
    heights = flat()
    heights[row(1.3) :] = np.nan
    found = plan(heights)
    assert not found.reached
    assert "without measurements" in found.reason
    assert all(move.T_map_body[0, 3] < 1.3 for move in found.moves)


def test_robot_turns_towards_a_goal_behind_it() -> None:
    found = plan(flat(), (0.0, 0.4), start=(1.2, 0.0, 0.4))
    assert found.reached, found.reason
    assert abs(yaw_of(found.moves[-1].T_map_body)) > 1.5
    check(found)


def test_coarse_map_gives_the_same_walk_as_a_fine_one() -> None:
    fine, coarse = plan(flat()), plan_on_map(PROFILE, flat()[::2, ::2], 0.02, (2.4, 0.0), origin=ORIGIN)
    assert coarse.terrain.resolution == 0.01
    assert coarse.reached
    assert coarse.length == pytest.approx(fine.length, abs=0.05)


def test_summary_is_plain_json() -> None:
    found = plan(pillars())
    table = json.loads(json.dumps(found.summary(), allow_nan=False))
    assert table["reached"] is True
    assert len(table["moves"]) == len(found.moves)
    assert set(table["start"]["footholds"]) == set(LEGS)
    assert {move["kind"] for move in table["moves"]} == {"step", "gap crossing"}
    steps = sum(len(places) for places in found.footholds())
    assert steps == sum(len(move["footholds"]) for move in table["moves"])


@pytest.mark.parametrize(
    ("heights", "more", "words"),
    [
        (flat(), {"start": (5.0, 0.0, 0.0)}, "found no cell of the map under the left front one"),
        (np.where(np.arange(360)[:, None] < 80, np.float32(np.nan), flat()), {}, "found unknown ground under"),
        (np.full((40, 40), np.nan, dtype=np.float32), {}, "a map with known heights expected, found none"),
        (np.zeros(5, dtype=np.float32), {}, "at least 3 x 3 cells expected"),
        (np.where(np.arange(200) < 100, flat(), np.float32(0.2)), {}, "where the robot can stand level expected"),
    ],
)
def test_map_without_a_start_is_refused(heights: Heights, more: dict[str, object], words: str) -> None:
    with pytest.raises(MapPlanError, match=words):
        plan(heights, **more)
