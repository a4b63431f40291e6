"""Exhaustive search for a way across a gap.

Clear cases have the expected answer, more ground never removes a way, and an undecided search returns no answer.
"""

import numpy as np
import pytest

from sextant.deploy.evaluation.passage_fields import (
    BEYOND,
    GAP,
    NEAR,
    START,
    Block,
    field_of,
    heights,
    random_blocks,
    stance_at,
    thesis_blocks,
)
from sextant.services.planner.gap_crossing.exhaustive import has_way, passable
from sextant.services.planner.gap_crossing.roadmap import Roadmap, SectionPlan, Stance
from sextant.services.planner.gap_crossing.settings import PassageSettings
from sextant.services.planner.gap_crossing.strip_map import StripMap
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.105
SETTINGS = PassageSettings(body_height=HEIGHT)
STANCE, GOAL_X = stance_at(PROFILE, START, HEIGHT), NEAR + GAP + BEYOND


def across(blocks: list[Block], room: int = 50_000) -> bool | None:
    return has_way(PROFILE, SETTINGS, field_of(heights(blocks, GAP), HEIGHT), STANCE, GOAL_X, room)


def strewn(seed: int, n: int = 12) -> list[Block]:
    """Return pillars on a grid, spaced so that none changes another's foothold."""
    rng = np.random.default_rng(seed)
    places = [(x, y) for x in np.arange(0.09, GAP - 0.08, 0.16) for y in np.arange(-0.24, 0.25, 0.16)]
    return [Block(*places[k], 0.10, 0.10) for k in rng.permutation(len(places))[:n]]


def test_level_ground_has_a_way() -> None:
    field = field_of(np.zeros((200, 100), dtype=np.float32), HEIGHT)
    assert has_way(PROFILE, SETTINGS, field, STANCE, 1.2)
    assert passable(PROFILE, SETTINGS, field, STANCE, 1.2) is True


def test_a_gap_without_pillars_has_none() -> None:
    assert across([]) is False
    assert passable(PROFILE, SETTINGS, field_of(heights([], GAP), HEIGHT), STANCE, GOAL_X, attempts=1) is False


@pytest.mark.parametrize("scenario", [1, 2, 3])
def test_the_thesis_bridges_have_a_way(scenario: int) -> None:
    assert across(thesis_blocks(scenario, GAP, 0.16, 0.17, 0.035, 0.27))


def test_a_gap_as_wide_as_a_stroke_is_stepped_over_and_a_wider_one_is_not() -> None:
    """Check that ways exist up to some gap width, and for no wider gap."""
    told = [
        has_way(PROFILE, SETTINGS, field_of(heights([], gap), HEIGHT), STANCE, NEAR + gap + BEYOND)
        for gap in (0.05, 0.10, 0.20, 0.40)
    ]
    assert told == sorted(told, reverse=True)
    assert (told[0], told[-1]) == (True, False)


@pytest.mark.parametrize("seed", range(2))
def test_more_pillars_never_take_a_way_away(seed: int) -> None:
    blocks = strewn(seed, 20)
    told = [across(blocks[:n]) for n in (4, 12, 20)]
    known = [way for way in told if way is not None]
    assert known == sorted(known)


@pytest.mark.parametrize("seed", [1])
def test_the_order_of_pillars_and_their_mirror_image_do_not_matter(seed: int) -> None:
    blocks = strewn(seed, 9)
    mirrored = [Block(b.x, -b.y, b.length, b.width) for b in blocks]
    assert across(blocks) == across(blocks[::-1])
    told = across(blocks), across(mirrored)
    assert None in told or told[0] == told[1]


def test_what_the_roadmap_crosses_is_never_called_impassable() -> None:
    roadmap, crossed = Roadmap(PROFILE, SETTINGS), 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        blocks = [Block(b.x, b.y, *rng.uniform(0.10, 0.12, 2)) for b in random_blocks(rng, GAP, 0.13, 0.85, 0.10)]
        field = field_of(heights(blocks, GAP), HEIGHT)
        roadmap.begin(field, STANCE, GOAL_X, 0)
        while (found := roadmap.grow(SETTINGS.budget)) is None:
            pass
        if isinstance(found, SectionPlan) and found.complete:
            crossed += 1
            assert has_way(PROFILE, SETTINGS, field, STANCE, GOAL_X, 50_000) is not False
    assert crossed >= 2


def test_where_there_is_no_room_to_tell_nothing_is_told() -> None:
    assert across([], room=100) is None


def test_feet_on_nothing_are_refused() -> None:
    feet = STANCE.feet + np.array([NEAR, 0.0, 0.0])
    with pytest.raises(ValueError, match="every foot on a foothold"):
        has_way(PROFILE, SETTINGS, field_of(heights([], GAP), HEIGHT), Stance(STANCE.body, feet), GOAL_X)


def test_cells_of_another_size_than_the_lattice_are_refused() -> None:
    level = np.zeros((100, 50), dtype=np.float32)
    field = StripMap(level, np.full(level.shape, -5, dtype=np.int8), 0.02, np.eye(4))
    with pytest.raises(ValueError, match="lattice"):
        has_way(PROFILE, SETTINGS, field, STANCE, 1.2)
