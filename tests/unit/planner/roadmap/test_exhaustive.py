"""Exhaustive search for a way across a gap.

Clear cases have the expected answer, more ground never removes a way, and an undecided search returns no answer.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.peers.passage_strips import BEYOND, FAR, FLOOR, GAP, NEAR, START, Block, heights, random_blocks, thesis_blocks
from sextant.evaluation.scoring.passage_truth import stance_at
from sextant.evaluation.whole_maps.strip import strip_of
from sextant.services.planner.roadmap.exhaustive import _headings, _moves, has_way, passable
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import Roadmap, SectionPlan, Stance
from sextant.services.planner.roadmap.search_tables import YAW_STEP_DEG, rules_of
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.105
SETTINGS = PassageSettings(body_height=HEIGHT)
STANCE, GOAL_X = stance_at(PROFILE, START, HEIGHT), NEAR + GAP + BEYOND


def has_way_across(blocks: list[Block], room: int = 50_000) -> bool | None:
    return has_way(PROFILE, SETTINGS, strip_of(heights(blocks, GAP), HEIGHT), STANCE, GOAL_X, room)


def random_pillars(seed: int, n: int = 12) -> list[Block]:
    """Return pillars on a grid, spaced so that none changes another's foothold."""
    rng = np.random.default_rng(seed)
    places = [(x, y) for x in np.arange(0.09, GAP - 0.08, 0.16) for y in np.arange(-0.24, 0.25, 0.16)]
    return [Block(*places[k], 0.10, 0.10) for k in rng.permutation(len(places))[:n]]


@pytest.mark.slow
def test_level_ground_is_passable() -> None:
    field = strip_of(np.zeros((200, 100), dtype=np.float32), HEIGHT)
    assert has_way(PROFILE, SETTINGS, field, STANCE, 1.2)
    assert passable(PROFILE, SETTINGS, field, STANCE, 1.2) is True


@pytest.mark.slow
def test_gap_without_pillars_is_impassable() -> None:
    assert has_way_across([]) is False
    assert passable(PROFILE, SETTINGS, strip_of(heights([], GAP), HEIGHT), STANCE, GOAL_X, attempts=1) is False


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [1, 2, 3])
def test_thesis_bridges_are_passable(scenario: int) -> None:
    assert has_way_across(thesis_blocks(scenario, GAP, 0.16, 0.17, 0.035, 0.27))


@pytest.mark.slow
def test_gap_is_passable_only_up_to_some_width() -> None:
    """Check that ways exist up to some gap width, and for no wider gap."""
    told = [
        has_way(PROFILE, SETTINGS, strip_of(heights([], gap), HEIGHT), STANCE, NEAR + gap + BEYOND)
        for gap in (0.05, 0.10, 0.20, 0.40)
    ]
    assert told == sorted(told, reverse=True)
    assert (told[0], told[-1]) == (True, False)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_added_pillars_never_make_gap_impassable(seed: int) -> None:
    blocks = random_pillars(seed, 20)
    told = [has_way_across(blocks[:n]) for n in (4, 12, 20)]
    known = [way for way in told if way is not None]
    assert known == sorted(known)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1])
def test_result_is_invariant_to_pillar_order_and_mirroring(seed: int) -> None:
    blocks = random_pillars(seed, 9)
    mirrored = [Block(b.x, -b.y, b.length, b.width) for b in blocks]
    assert has_way_across(blocks) == has_way_across(blocks[::-1])
    told = has_way_across(blocks), has_way_across(mirrored)
    assert None in told or told[0] == told[1]


@pytest.mark.slow
def test_gap_crossed_by_roadmap_is_never_impassable() -> None:
    roadmap, crossed = Roadmap(PROFILE, SETTINGS), 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        blocks = [Block(b.x, b.y, *rng.uniform(0.10, 0.12, 2)) for b in random_blocks(rng, GAP, 0.13, 0.85, 0.10)]
        field = strip_of(heights(blocks, GAP), HEIGHT)
        roadmap.begin(field, STANCE, GOAL_X, 0)
        while (found := roadmap.grow(SETTINGS.budget)) is None:
            pass
        if isinstance(found, SectionPlan) and found.complete:
            crossed += 1
            assert has_way(PROFILE, SETTINGS, field, STANCE, GOAL_X, 50_000) is not False
    assert crossed >= 2


def slanted_bridge(degrees: float) -> StripMap:
    """Return a wide strip with three pairs of pillars on a line aside of the way, turned with it."""
    direction = np.radians(degrees)
    along, left = np.array([np.cos(direction), np.sin(direction)]), np.array([-np.sin(direction), np.cos(direction)])
    x, y = 0.01 * (np.arange(round((NEAR + GAP + FAR) / 0.01)) + 0.5), 0.01 * (np.arange(140) - 69.5)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    ground = np.where((x > NEAR) & (x < NEAR + GAP), FLOOR, 0.0)[:, None] * np.ones(len(y))
    for k in (-1, 0, 1):
        middle = np.array([NEAR + GAP / 2 + 0.25 * k, (0.3 + 0.25 * k) * np.tan(direction)])
        for side in (-0.16, 0.16):
            off = np.abs((places - middle - side * left) @ np.stack([along, left], axis=1))
            ground[(off[..., 0] <= 0.085) & (off[..., 1] <= 0.05)] = 0.0
    return strip_of(ground.astype(np.float32), HEIGHT)


@pytest.mark.slow
def test_bridge_that_leads_aside_is_passable_with_turns() -> None:
    assert has_way(PROFILE, SETTINGS, slanted_bridge(-30.0), STANCE, GOAL_X, turning=True) is True


@pytest.mark.rare  # it searches millions of configurations
def test_bridge_that_leads_aside_is_impassable_without_turns() -> None:
    assert has_way(PROFILE, SETTINGS, slanted_bridge(-30.0), STANCE, GOAL_X) is False


@pytest.mark.slow
def test_turns_add_ways_and_bridge_no_gap() -> None:
    """Check that each way straight on is also one with turns, and that there is none where nothing carries."""
    straight = strip_of(heights(thesis_blocks(1, GAP, 0.16, 0.17, 0.035, 0.27), GAP), HEIGHT)
    assert has_way(PROFILE, SETTINGS, straight, STANCE, GOAL_X, turning=True) is True
    assert has_way(PROFILE, SETTINGS, strip_of(heights([], GAP), HEIGHT), STANCE, GOAL_X, turning=True) is False


def test_headings_of_bins_cover_all_yaws_of_the_search_once() -> None:
    for most in (0.0, 5.0, 30.0, 45.0, 90.0):
        rules = rules_of(PROFILE, replace(SETTINGS, most_turn_deg=most), turning=True)
        yaws = np.rint(np.degrees(np.concatenate(_headings(rules))) / YAW_STEP_DEG)
        assert yaws.tolist() == list(range(-rules.yaw_most, rules.yaw_most + 1))
    assert [yaws.tolist() for yaws in _headings(rules_of(PROFILE, SETTINGS))] == [[0.0]]


@given(st.floats(-0.8, 0.8), st.floats(0.0, 5.0), st.floats(-0.7, 0.7), st.integers(0, 200), st.integers(0, 200))
def test_motions_between_squares_hold_every_motion_between_their_places(
    yaw: float, length: float, angle: float, x: int, y: int
) -> None:
    """Check that a motion from any place leads to a square that the motions of its square lead to."""
    step = length * np.array([[np.cos(angle), np.sin(angle)]])
    begin = np.array([x, y]) / 100.0 * 2.0
    end = begin + step @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    to = np.floor(end[0] / 2.0) - np.floor(begin / 2.0)
    assert to.astype(int).tolist() in _moves(step, np.array([yaw]), 2).tolist()


def test_search_with_too_little_room_is_undecided() -> None:
    assert has_way_across([], room=100) is None


def test_start_feet_without_foothold_are_refused() -> None:
    feet = STANCE.feet + np.array([NEAR, 0.0, 0.0])
    with pytest.raises(ValueError, match="every foot on a foothold"):
        has_way(PROFILE, SETTINGS, strip_of(heights([], GAP), HEIGHT), Stance(STANCE.body, feet), GOAL_X)


def test_cell_size_unlike_lattice_is_refused() -> None:
    level = np.zeros((100, 50), dtype=np.float32)
    field = StripMap(level, np.full(level.shape, -5, dtype=np.int8), 0.02, np.eye(4))
    with pytest.raises(ValueError, match="lattice"):
        has_way(PROFILE, SETTINGS, field, STANCE, 1.2)
