"""Foothold search against brute force, and its reasons when there is no foothold."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sextant.services.planner.locomotion.foothold_search import Foothold, NoFoothold, offsets_by_distance
from sextant.services.planner.terrain import Terrain, flat_terrain
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE
from tests.support.long_leg import NO_OTHER_FEET, search

RADIUS, RESOLUTION = 0.06, 0.01
OFFSETS = offsets_by_distance(RADIUS, RESOLUTION)
NOWHERE = 9.0  # [m] no place is further along x
Maker = Callable[..., Terrain]


def patchy(seed: int, bad: float) -> Terrain:
    """Return level ground with a share of bad cells and a tenth of unknown cells."""
    ground = flat_terrain(0, np.zeros(2), 0.0, half_size=0.3)
    rng = np.random.default_rng(seed)
    score, elevation = ground.map.score, ground.map.elevation
    score[rng.random(score.shape) < bad] = 2.0 * MAX_FOOTHOLD_SCORE
    unknown = rng.random(score.shape) < 0.1
    score[unknown], elevation[unknown] = np.nan, np.nan
    return ground


def test_offsets_are_all_cells_in_radius_sorted_by_distance() -> None:
    assert (OFFSETS[0] == 0).all()
    distance = np.linalg.norm(OFFSETS, axis=1)
    assert (np.diff(distance) >= -1e-12).all()
    cells = np.rint(OFFSETS / RESOLUTION).astype(int)
    n = round(RADIUS / RESOLUTION)
    expected = {(i, j) for i in range(-n, n + 1) for j in range(-n, n + 1) if i * i + j * j <= n * n}
    assert {(int(i), int(j)) for i, j in cells} == expected
    assert len(cells) == len(expected)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 0.8, 0.97]), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
@example(7, 0.3, 0.005, -0.015)  # on the border between cells
@settings(max_examples=60)
def test_nearest_foothold_among_those_with_most_room_is_found(seed: int, bad: float, x: float, y: float) -> None:
    ground, nominal = patchy(seed, bad), np.array([x, y])
    others = np.random.default_rng(seed + 1).uniform(-0.2, 0.2, (5, 3))
    found = search(ground, nominal, OFFSETS, others, 0.04, beyond=x - 0.0301)
    map_ = ground.map
    best = dict.fromkeys(range(9), np.inf)  # by the number of good cells around a place: the distance of the nearest such place
    i0, j0 = np.rint((nominal - map_.origin) / map_.resolution).astype(int)
    for i in range(map_.score.shape[0]):
        for j in range(map_.score.shape[1]):
            if (i - i0) ** 2 + (j - j0) ** 2 > (RADIUS / RESOLUTION) ** 2 or not map_.score[i, j] <= MAX_FOOTHOLD_SCORE:
                continue
            places = [map_.origin + map_.resolution * np.array([i, j])]
            around = map_.score[i - 1 : i + 2, j - 1 : j + 2]
            room = int((around <= MAX_FOOTHOLD_SCORE).sum()) - 1
            if (i, j) == (i0, j0) and room == 8:
                places.append(nominal)
            for place in places:
                if np.linalg.norm(others[:, :2] - place, axis=1).min() >= 0.04 and place[0] > x - 0.0301:
                    best[room] = min(best[room], float(np.linalg.norm(place - nominal)))
    if np.isinf(min(best.values())):
        assert isinstance(found, NoFoothold)
    else:
        assert isinstance(found, Foothold)
        most = max(room for room, distance in best.items() if np.isfinite(distance))
        assert found.moved == pytest.approx(best[most], abs=1e-9)
        assert np.linalg.norm(found.p_world[:2] - nominal) == pytest.approx(found.moved)


def test_nominal_foothold_is_kept_on_good_ground() -> None:
    nominal = np.array([0.1234, -0.0567])
    found = search(flat_terrain(0, np.zeros(2), 0.07), nominal, OFFSETS)
    assert isinstance(found, Foothold)
    np.testing.assert_allclose(found.p_world, [*nominal, 0.07], atol=1e-7)
    assert found.moved == 0.0


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_reason_counts_each_cell_once(seed: int) -> None:
    ground = patchy(seed, 0.7)
    others = np.random.default_rng(seed).uniform(-0.05, 0.05, (2, 3))
    found = search(ground, np.zeros(2), OFFSETS, others, 0.05, NOWHERE)
    assert isinstance(found, NoFoothold)
    total = int(re.search(r"(\d+) cells: ", found.reason)[1])  # type: ignore[index]
    tests = {what: int(n) for n, what in re.findall(r"(\d+) (not seen|too steep|too near another|out of)", found.reason)}
    assert total == len(OFFSETS) == sum(tests.values())
    scores = ground.scores(ground.centres(OFFSETS))
    assert tests.get("not seen", 0) == int(np.isnan(scores).sum())
    assert tests.get("too steep", 0) == int((scores > MAX_FOOTHOLD_SCORE).sum())
    assert f"within {RADIUS * 100:.0f} cm" in found.reason


@pytest.mark.parametrize(
    ("score", "others", "beyond", "words"),
    [
        (np.nan, NO_OTHER_FEET, -NOWHERE, "not seen"),
        (5.0, NO_OTHER_FEET, -NOWHERE, "too steep or too near an edge"),
        (0.0, np.zeros((1, 3)), -NOWHERE, "too near another foot"),
        (0.0, NO_OTHER_FEET, NOWHERE, "out of reach"),
    ],
)
def test_reason_names_failed_test(make_terrain: Maker, score: float, others: Array, beyond: float, words: str) -> None:
    ground = make_terrain(score=lambda x, y: np.full_like(x, score))
    found = search(ground, np.zeros(2), OFFSETS, others, 0.2, beyond)
    assert isinstance(found, NoFoothold)
    assert f"({len(OFFSETS)} cells: {len(OFFSETS)} {words}" in found.reason


def test_no_foothold_outside_map() -> None:
    ground = flat_terrain(0, np.zeros(2), 0.0, half_size=0.2)
    assert isinstance(search(ground, np.array([5.0, 0.0]), OFFSETS), NoFoothold)


def test_score_at_limit_is_acceptable(make_terrain: Maker) -> None:
    ground = make_terrain(score=lambda x, y: np.full_like(x, MAX_FOOTHOLD_SCORE))
    assert isinstance(search(ground, np.zeros(2), OFFSETS), Foothold)


@pytest.mark.parametrize(("number", "words"), [(1, "water"), (2, "loose ground")])
def test_reason_names_hazardous_ground_type(number: int, words: str) -> None:
    ground = flat_terrain(0, np.zeros(2), 0.0)
    shape = ground.map.elevation.shape
    score = np.full(shape, 3.0, dtype=np.float32)
    score[:100] = 5.0  # also too steep
    hazard = np.full(shape, number, dtype=np.uint8)
    hazard[:100] = 0
    wet = Terrain(replace(ground.map, score=score, hazard=hazard))
    found = search(wet, np.zeros(2), OFFSETS)
    assert isinstance(found, NoFoothold)
    assert f" {words}" in found.reason
    assert "too steep" in found.reason


# ---- Masri's evaluation function


def block(half: int, bound: int = 5) -> Callable[[Array, Array], Array]:
    """Return the evaluation function of a square of (2 * half + 1) cells.

    The square lies around the origin.
    """

    def F(x: Array, y: Array) -> Array:
        i, j = np.abs(np.rint(x / RESOLUTION)), np.abs(np.rint(y / RESOLUTION))
        outside = np.maximum(i - half, 0) + np.maximum(j - half, 0)
        return np.asarray(np.where(outside > 0, outside, -np.minimum(np.minimum(half + 1 - i, half + 1 - j), bound)))

    return F


def search_on(ground: Terrain, nominal: Array, beyond: float = -NOWHERE) -> Foothold | NoFoothold:
    return search(replace(ground, layer="evaluation"), nominal, OFFSETS, beyond=beyond)


def test_foothold_near_border_moves_inwards_and_central_one_stays(make_terrain: Maker) -> None:
    ground = make_terrain(evaluation=block(10), score=lambda x, y: np.full_like(x, 9.0))  # the score is not used
    inside = search_on(ground, np.array([0.03, -0.07]))
    assert isinstance(inside, Foothold)
    assert inside.moved == 0.0
    border = search_on(ground, np.array([0.10, 0.0]))
    assert isinstance(border, Foothold)
    assert border.p_world[0] == pytest.approx(0.08)  # 3 cm from the border


@pytest.mark.parametrize("half", [1, 2, 3])
def test_local_minimum_is_chosen_on_small_ground(make_terrain: Maker, half: int) -> None:
    ground = make_terrain(evaluation=block(half))
    for nominal in ((0.01 * half, 0.0), (0.01 * (half + 1), 0.01)):
        found = search_on(ground, np.array(nominal))
        assert isinstance(found, Foothold)
        assert ground.map.evaluation[tuple(ground.cells(found.p_world[None, :2])[0][0])] == -min(half + 1, 3)


def test_poor_foothold_is_chosen_if_no_better_one_is_reachable(make_terrain: Maker) -> None:
    ground = make_terrain(evaluation=block(10))
    found = search_on(ground, np.array([0.10, 0.0]), beyond=0.095)
    assert isinstance(found, Foothold)
    assert found.p_world[0] == pytest.approx(0.10)


def test_evaluation_layer_gives_same_reasons(make_terrain: Maker) -> None:
    none = search_on(make_terrain(evaluation=lambda x, y: np.full_like(x, 4.0)), np.zeros(2))
    assert isinstance(none, NoFoothold)
    assert f"{len(OFFSETS)} too steep or too near an edge" in none.reason
    unseen = search_on(make_terrain(evaluation=lambda x, y: np.full_like(x, 127.0)), np.zeros(2))
    assert isinstance(unseen, NoFoothold)
    assert f"{len(OFFSETS)} not seen" in unseen.reason


def test_flat_terrain_is_good_on_both_layers() -> None:
    flat = flat_terrain(0, np.zeros(2), 0.0)
    for ground in (flat, replace(flat, layer="evaluation")):
        found = search(ground, np.array([0.123, -0.2]), OFFSETS)
        assert isinstance(found, Foothold)
        assert found.moved == 0.0
