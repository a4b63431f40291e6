"""Roadmap planner on level ground and over pillars.

Its plans can be walked, and it names the reason when it finds none.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.peers.passage_checker import violations
from benchmarks.peers.passage_strips import BEYOND, FAR, FLOOR, NEAR, START, Block, heights, thesis_blocks
from sextant.evaluation.scoring.passage_truth import stance_at
from sextant.evaluation.whole_maps.strip import strip_of
from sextant.services.planner.roadmap import roadmap_search
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import ATTEMPTS, NoSection, Roadmap, SectionPlan, Stance
from sextant.services.planner.roadmap.roadmap_search import nearest_seen
from sextant.services.planner.roadmap.sections import bare, hidden_behind, nearest_view
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import apply, from_xyz_rpy
from sextant.shared.robot.profile import LEGS
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import UNKNOWN

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.11
GAP = 0.8
SETTINGS = PassageSettings(body_height=HEIGHT)


@pytest.fixture(scope="module")
def roadmap() -> Roadmap:
    return Roadmap(PROFILE, SETTINGS)


def level(length: float = 2.0) -> StripMap:
    return strip_of(np.zeros((round(length / 0.01), 100), dtype=np.float32))


def grown(
    roadmap: Roadmap,
    field: StripMap,
    stance: Stance,
    goal_x: float,
    seed: int = 1,
    part: int = 10**6,
    turning: bool = False,
    inward: int | None = None,
) -> SectionPlan | NoSection:
    roadmap.begin(field, stance, goal_x, seed, turning, inward)
    while (outcome := roadmap.grow(part)) is None:
        pass
    return outcome


def test_plan_over_level_ground_reaches_goal(roadmap: Roadmap) -> None:
    found = grown(roadmap, level(), stance_at(PROFILE, START, HEIGHT), 1.2)
    assert isinstance(found, SectionPlan)
    assert found.complete
    assert found.steps[-1].body[0] >= 1.2 - 1e-9
    assert min(step.margin for step in found.steps) >= SETTINGS.margin_m
    assert {step.leg for step in found.steps} >= set(range(6))
    np.testing.assert_array_equal(found.end.body, found.steps[-1].body)
    assert len(roadmap.edges) >= len(found.steps)


def test_plan_depends_on_seed_but_not_on_batch_size(roadmap: Roadmap) -> None:
    field, stance = level(), stance_at(PROFILE, START, HEIGHT)
    first, second = grown(roadmap, field, stance, 0.9, 3), grown(roadmap, field, stance, 0.9, 3, part=7)
    assert isinstance(first, SectionPlan)
    assert isinstance(second, SectionPlan)
    assert [(s.leg, *s.touchdown, *s.body, s.clearance) for s in first.steps] == [
        (s.leg, *s.touchdown, *s.body, s.clearance) for s in second.steps
    ]
    other = grown(roadmap, field, stance, 0.9, 4)
    assert isinstance(other, SectionPlan)
    assert [s.leg for s in other.steps] != [s.leg for s in first.steps] or (other.end.feet != first.end.feet).any()


@pytest.mark.parametrize("scenario", [1, 2, 3])
def test_planned_footholds_lie_in_middle_of_pillars(roadmap: Roadmap, scenario: int) -> None:
    field = strip_of(heights(thesis_blocks(scenario, GAP, 0.17, 0.20, 0.03, 0.30), GAP), HEIGHT)
    for seed in range(4):
        found = grown(roadmap, field, stance_at(PROFILE, START, HEIGHT), NEAR + GAP + BEYOND, seed)
        if isinstance(found, SectionPlan):
            break
    assert isinstance(found, SectionPlan)
    x0, y0 = field.first_cell
    for step in found.steps:
        if step.leg >= 0:
            i, j = np.rint((step.touchdown[:2] - (x0, y0)) / field.resolution).astype(int)
            assert field.evaluation[i, j] <= SETTINGS.weakest_cells
            assert step.touchdown[2] == pytest.approx(field.elevation[i, j] + PROFILE.foot.radius)
            assert SETTINGS.swing_clear_m <= step.clearance <= PROFILE.stance.max_lift


@pytest.mark.parametrize(("inward", "farthest_m"), [(0, 0.035), (1, 0.025)])
def test_footholds_in_the_middle_of_each_pillar(roadmap: Roadmap, inward: int, farthest_m: float) -> None:
    """Check pillars with shallow minima of the evaluation function at their edges, as noise makes them."""
    middles = np.array([(x, y) for x in (0.13, 0.35, 0.57) for y in (-0.16, 0.16)])
    field = strip_of(heights([Block(x, y, 0.2, 0.2) for x, y in middles], 0.7), HEIGHT)
    on_pillars = np.zeros(field.evaluation.shape, dtype=np.bool_)
    on_pillars[round((NEAR + 0.01) / 0.01) : round((NEAR + 0.7 - 0.01) / 0.01)] = True
    edge = on_pillars & (field.evaluation == -2)
    edge[1::3] = edge[:, 1::3] = False
    field.evaluation[edge] = -4
    found = grown(roadmap, field, stance_at(PROFILE, START, HEIGHT), NEAR + 0.7 + BEYOND, inward=inward)
    assert isinstance(found, SectionPlan), found.reason
    feet = np.array([step.touchdown[:2] for step in found.steps if step.leg >= 0])
    i, j = np.rint((feet - field.first_cell) / field.resolution).astype(int).T
    away = np.abs(feet[on_pillars[i, j], None] - middles - (NEAR, 0.0)).max(axis=2).min(axis=1)
    assert len(away) > 0
    assert away.max() == pytest.approx(farthest_m, abs=0.001)


@pytest.mark.parametrize(("size", "is_wide"), [((0.2, 0.2), True), ((0.17, 0.10), False)])
def test_middles_are_tried_first_on_wide_pillars_alone(roadmap: Roadmap, size: tuple[float, float], is_wide: bool) -> None:
    blocks = [Block(x, y, *size) for x in (0.15, 0.4, 0.65) for y in (-0.16, 0.16)]
    field = strip_of(heights(blocks, GAP), HEIGHT)
    assert roadmap.attempts(field) == (*((1, 0) if is_wide else ()), *(None,) * ATTEMPTS)
    found = grown(roadmap, field, stance_at(PROFILE, START, HEIGHT), NEAR + GAP + BEYOND, inward=0)
    assert is_wide or isinstance(found, NoSection), "narrow pillars have no middle"


def test_ground_without_a_place_is_not_wide(roadmap: Roadmap) -> None:
    assert roadmap.attempts(strip_of(heights([], GAP), HEIGHT)) == (None,) * ATTEMPTS


def bridge(lines: list[tuple[float, float, float]], tops: tuple[float, float] = (0.0, 0.0)) -> StripMap:
    """Return a wide strip with pairs of pillars in a gap.

    Each line is the middle (x, y) [m] {strip} of a pair and its heading [rad]. The tops [m] are those of the left and the right
    pillar of the first pair; they change sides from pair to pair.
    """
    x = 0.01 * (np.arange(round((NEAR + GAP + FAR) / 0.01)) + 0.5)
    y = 0.01 * (np.arange(140) - 69.5)
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    ground = np.where((x > NEAR) & (x < NEAR + GAP), FLOOR, 0.0)[:, None] * np.ones(len(y))
    for k, (along, aside, heading) in enumerate(lines):
        T_strip_pair = from_xyz_rpy((along, aside, 0.0), (0.0, 0.0, heading))
        for side, top in ((1, tops[k % 2]), (-1, tops[1 - k % 2])):
            off = np.abs((places - T_strip_pair[:2, 3]) @ T_strip_pair[:2, :2] - [0.0, 0.16 * side])
            ground[(off[..., 0] <= 0.085) & (off[..., 1] <= 0.05)] = top
    return strip_of(ground.astype(np.float32), HEIGHT)


def turned_bridge(heading: float) -> StripMap:
    """Return a bridge of three pairs on a line at a heading [rad] to the strip."""
    middle = NEAR + GAP / 2
    return bridge([(middle + off, (0.3 + off) * np.tan(heading), heading) for off in (-0.25, 0.0, 0.25)])


@pytest.mark.parametrize(
    "field",
    [
        pytest.param(turned_bridge(np.radians(20.0)), id="20 deg to the left"),
        pytest.param(turned_bridge(np.radians(-30.0)), id="30 deg to the right"),
        pytest.param(bridge([(NEAR + 0.15, 0.0, 0.3), (NEAR + 0.4, 0.1, 0.0), (NEAR + 0.65, 0.0, -0.3)]), id="S"),
    ],
)
def test_bridge_that_bends_is_crossed_with_turns_of_the_body(roadmap: Roadmap, field: StripMap) -> None:
    stance, goal_x = stance_at(PROFILE, START, HEIGHT), NEAR + GAP + BEYOND
    for seed in range(8):
        found = grown(roadmap, field, stance, goal_x, seed, turning=True)
        if isinstance(found, SectionPlan) and found.complete:
            break
    assert isinstance(found, SectionPlan)
    assert found.complete
    assert violations(PROFILE, field, stance, found.steps) == []
    yaws = [0.0, *(step.yaw for step in found.steps)]
    turns = np.degrees(np.diff(yaws))
    assert np.abs(turns).max() <= SETTINGS.turn_deg + 1e-9
    assert {step.leg for step, turn in zip(found.steps, turns, strict=True) if turn} == {-1}
    assert found.end.yaw == found.steps[-1].yaw


def test_search_from_turned_stance_keeps_its_heading_on_level_ground(roadmap: Roadmap) -> None:
    yaw = np.radians(30.0)
    body = np.array([START, -0.2, HEIGHT])
    stance = Stance(body, apply(from_xyz_rpy(body, (0.0, 0.0, yaw)), PROFILE.rest_feet(HEIGHT)), yaw)
    field = strip_of(np.zeros((200, 140), dtype=np.float32))
    found = grown(roadmap, field, stance, 1.0, turning=True)
    assert isinstance(found, SectionPlan)
    assert found.complete
    assert violations(PROFILE, field, stance, found.steps) == []


def uneven_bridge(jitter: int) -> StripMap:
    """Return a straight bridge of three pairs whose pillars are 4 cm higher and lower in turn, with jittered places."""
    rng = np.random.default_rng(jitter)
    middle = NEAR + GAP / 2
    return bridge([(middle + off + rng.uniform(-0.01, 0.01), 0.0, 0.0) for off in (-0.25, 0.0, 0.25)], (0.04, -0.04))


@pytest.mark.parametrize("jitter", [0, 1])
def test_uneven_pillars_are_crossed_with_a_body_that_rises_and_sinks(roadmap: Roadmap, jitter: int) -> None:
    field, stance = uneven_bridge(jitter), stance_at(PROFILE, START, HEIGHT)
    for seed in range(16):
        found = grown(roadmap, field, stance, NEAR + GAP + BEYOND, seed)
        if isinstance(found, SectionPlan) and found.complete:
            break
    assert isinstance(found, SectionPlan)
    assert found.complete
    assert violations(PROFILE, field, stance, found.steps) == []
    assert np.ptp([step.body[2] for step in found.steps]) > 0.03


def test_pillars_hidden_behind_higher_ones_are_looked_for_from_nearer(roadmap: Roadmap) -> None:
    """Check that the section ends where the ground behind the high pillar comes into view, and never further."""
    plain = uneven_bridge(0)
    middle = plain.elevation.shape[1] // 2
    end = int(np.flatnonzero((plain.elevation[:, :middle] > 0.03).any(axis=1))[-1]) + 1  # of the second pillar on the right
    hidden = np.zeros(plain.evaluation.shape, dtype=np.bool_)
    hidden[end : end + 32, :middle] = True  # the third one
    field = replace(
        plain,
        elevation=np.where(hidden, np.float32(np.nan), plain.elevation),
        evaluation=np.where(hidden, np.int8(UNKNOWN), plain.evaluation),
    )
    stance = stance_at(PROFILE, START, HEIGHT)
    behind = hidden_behind(field, 0.0, 0.3)
    found = grown(roadmap, field, stance, NEAR + GAP + BEYOND)
    assert isinstance(found, NoSection)
    assert found.unseen
    assert found.closer is not None
    assert violations(PROFILE, field, stance, found.closer.steps) == []
    assert stance.body[0] + 0.05 <= found.closer.end.body[0] <= float(behind.max()) - nearest_view(PROFILE.camera, HEIGHT)


@pytest.mark.slow
def test_gap_without_pillars_is_reported_as_lacking_footholds(roadmap: Roadmap) -> None:
    field = strip_of(heights([], GAP), HEIGHT)
    found = grown(roadmap, field, stance_at(PROFILE, START, HEIGHT), NEAR + GAP + BEYOND)
    assert isinstance(found, NoSection)
    assert "without a foothold" in found.reason
    assert not found.unseen
    assert found.furthest.body[0] < NEAR
    assert sum(found.fails.values()) > 0


@pytest.mark.slow
def test_failed_search_returns_steps_to_furthest_stance_and_leg(roadmap: Roadmap) -> None:
    field, stance = strip_of(heights([], GAP), HEIGHT), stance_at(PROFILE, START, HEIGHT)
    found = grown(roadmap, field, stance, NEAR + GAP + BEYOND)
    assert isinstance(found, NoSection)
    np.testing.assert_array_equal(found.steps[-1].body, found.furthest.body)
    feet = stance.feet.copy()
    for step in found.steps:
        if step.leg >= 0:
            feet[step.leg] = step.touchdown
    np.testing.assert_array_equal(feet, found.furthest.feet)
    assert violations(PROFILE, field, stance, found.steps) == []
    assert f"{LEGS[found.leg]} leg" in found.reason


def test_section_ends_before_unknown_ground(roadmap: Roadmap) -> None:
    elevation = np.zeros((200, 100), dtype=np.float32)
    elevation[110:] = np.nan
    known = np.isfinite(elevation)
    F = strip_of(np.zeros((200, 100), dtype=np.float32)).evaluation
    field = StripMap(elevation, np.where(known, F, np.int8(UNKNOWN)), 0.01, np.eye(4))
    found = grown(roadmap, field, stance_at(PROFILE, START, HEIGHT), 1.5)
    assert isinstance(found, SectionPlan)
    assert not found.complete
    assert "known" in found.reason
    end = found.steps[-1].body[0]
    on = grown(roadmap, field, found.end, 1.5)
    assert isinstance(on, SectionPlan), "no section ends where nothing leads on"
    assert on.end.body[0] > end
    assert max(step.touchdown[0] for step in found.steps if step.leg >= 0) < 1.10


@pytest.mark.parametrize("far_side_seen", [True, False])
def test_pillars_leading_to_unknown_ground_are_not_entered(roadmap: Roadmap, far_side_seen: bool) -> None:
    plain = strip_of(heights(thesis_blocks(1, GAP, 0.16, 0.17, 0.0, 0.17), GAP), HEIGHT)
    from_, to = (round((NEAR + along) / plain.resolution) for along in (0.25, 0.75))
    evaluation = plain.evaluation.copy()
    evaluation[from_:to] = evaluation[from_:to] if far_side_seen else UNKNOWN
    field = StripMap(plain.elevation, evaluation, plain.resolution, plain.T_world_strip)
    found = grown(roadmap, field, stance_at(PROFILE, START, HEIGHT), NEAR + GAP + BEYOND)
    assert isinstance(found, SectionPlan) is far_side_seen
    if isinstance(found, NoSection):
        assert found.unseen
        assert "cells ahead are unknown" in found.reason


def test_gap_with_unseen_floor_is_crossed(roadmap: Roadmap) -> None:
    """Check that a sample on the floor counts as the edge next to it, seen or not."""
    plain = strip_of(heights(thesis_blocks(1, GAP, 0.16, 0.17, 0.0, 0.17), GAP), HEIGHT)
    floor = plain.evaluation > 1
    unseen = replace(plain, evaluation=np.where(floor, np.int8(UNKNOWN), plain.evaluation))
    expanded = []
    for field in (plain, unseen):
        found = [grown(roadmap, field, stance_at(PROFILE, START, HEIGHT), NEAR + GAP + BEYOND, seed) for seed in range(1, 6)]
        assert all(isinstance(way, SectionPlan) and way.complete for way in found)
        expanded.append(sum(way.expanded for way in found))
    assert expanded[1] < 3 * expanded[0], "nor does it take much longer"


@given(st.integers(1, 60), st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_nearest_seen_cell_matches_brute_force(seen: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    evaluation = np.full((9, 13), UNKNOWN, dtype=np.int8)
    evaluation.ravel()[rng.choice(evaluation.size, seen, replace=False)] = -1
    nearest = np.full(evaluation.shape, -1, dtype=np.int32)
    nearest_seen(evaluation, nearest)
    places = np.argwhere(evaluation != UNKNOWN)
    for i, j in np.ndindex(*evaluation.shape):
        c, d = divmod(int(nearest[i, j]), evaluation.shape[1])
        assert evaluation[c, d] != UNKNOWN
        assert abs(c - i) + abs(d - j) == np.abs(places - (i, j)).sum(axis=1).min()
    nearest_seen(np.full((3, 3), UNKNOWN, dtype=np.int8), nearest[:3, :3])
    assert (nearest[:3, :3] == -1).all()


@pytest.mark.slow
def test_foot_at_gap_edge_does_not_count_as_on_pillars(roadmap: Roadmap) -> None:
    """Check that a foot on the near side's last rows does not count as on pillars."""
    plain = strip_of(heights(thesis_blocks(1, GAP, 0.16, 0.17, 0.0, 0.17), GAP), HEIGHT)
    from_, to = (round((NEAR + along) / plain.resolution) for along in (0.25, 0.75))
    evaluation = plain.evaluation.copy()
    evaluation[from_:to] = UNKNOWN
    field = StripMap(plain.elevation, evaluation, plain.resolution, plain.T_world_strip)
    near = round(START / field.resolution)
    verge = (near + int(np.argmax(bare(field, SETTINGS.bare_ground)[near:])) + 1) * field.resolution
    level = stance_at(PROFILE, START, HEIGHT)
    ahead = np.array([verge - level.feet[:, 0].max(), 0.0, 0.0])
    stance = Stance(level.body + ahead, level.feet + ahead)
    ways = [grown(roadmap, field, stance, NEAR + GAP + BEYOND, seed) for seed in range(1, 7)]
    assert all(isinstance(way, NoSection) and way.closer is None for way in ways)
    assert any(isinstance(way, NoSection) and way.unseen for way in ways), "or it would not go closer in any case"


def test_slightly_invalid_stance_is_repaired_by_body_shift(roadmap: Roadmap) -> None:
    stance = stance_at(PROFILE, START, HEIGHT)
    feet = stance.feet.copy()
    feet[:2, 0] = stance.body[0] + PROFILE.T_body_coxa[0, 0, 3] - 0.01  # front feet behind their coxa axes
    found = grown(roadmap, level(), Stance(stance.body, feet), 0.7)
    assert isinstance(found, SectionPlan)
    assert found.steps[0].leg == -1
    assert 0.0 < np.linalg.norm(found.steps[0].body - stance.body) <= SETTINGS.max_repair_m + 1e-9


def test_invalid_stance_is_reported_by_leg_and_test(roadmap: Roadmap) -> None:
    stance = stance_at(PROFILE, START, HEIGHT)
    feet = stance.feet.copy()
    feet[0, 0] += 0.2
    feet[3, 1] -= 0.2
    found = grown(roadmap, level(), Stance(stance.body, feet), 0.7)
    assert isinstance(found, NoSection)
    assert "left front leg: out of reach" in found.reason
    assert "right rear leg: out of reach" in found.reason
    assert (found.leg, found.steps) == (0, ())
    np.testing.assert_array_equal(found.furthest.feet, feet)


def test_invalid_arguments_are_refused(roadmap: Roadmap) -> None:
    with pytest.raises(ValueError, match="finite feet"):
        roadmap.begin(level(), Stance(np.zeros(3), np.full((6, 3), np.nan)), 1.0, 0)
    with pytest.raises(ValueError, match="begun"):
        Roadmap(PROFILE, PassageSettings(nodes=100)).grow(1)
    for bad in (
        {"body_moves": 0},
        {"body_angle_deg": 0.0},
        {"foot_angle_deg": np.nan},
        {"wide_cells": -1},
        {"weakest_cells": 0},
    ):
        with pytest.raises(ValueError, match=next(iter(bad))):
            PassageSettings(**bad)


def test_synthetic_blocks_are_at_given_positions() -> None:
    h = heights([Block(0.2, 0.1)], GAP)
    at = round((NEAR + 0.2) / 0.01), round((0.6 + 0.1) / 0.01)
    assert h[at] == 0.0
    assert (h[at[0] - 5 : at[0] + 5, at[1] - 5 : at[1] + 5] == 0.0).all()
    assert (h[70:150] == 0.0).sum() == 100


def test_search_is_compiled_once_for_any_array_layout(roadmap: Roadmap) -> None:
    """Check that the search is compiled once for any kind of array.

    Arrays of a message are read-only and may be unaligned; ground that gave way replaces them by copies.
    """
    grown(roadmap, level(), stance_at(PROFILE, START, HEIGHT), 0.7)
    compiled = len(roadmap_search.grow.signatures)  # type: ignore[attr-defined]
    field = level()
    raw = np.frombuffer(b"x" + field.elevation.tobytes(), dtype=np.uint8)[1:].view(np.float32).reshape(field.elevation.shape)
    evaluation = field.evaluation.copy()
    evaluation.setflags(write=False)
    grown(roadmap, StripMap(raw, evaluation, field.resolution, np.eye(4)), stance_at(PROFILE, START, HEIGHT), 0.7)
    assert len(roadmap_search.grow.signatures) == compiled  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.parametrize("sunk", [False, True])
def test_foot_steps_back_only_from_sunk_ground(roadmap: Roadmap, sunk: bool) -> None:
    plain, stance = level(), stance_at(PROFILE, START, HEIGHT)
    feet = stance.feet.copy()
    feet[0, 0] += 0.05
    i, j = np.rint((feet[0, :2] - plain.first_cell) / plain.resolution).astype(int)
    evaluation = plain.evaluation.copy()
    evaluation[i - 4 :, evaluation.shape[1] // 2 :] = 5  # no foothold to the side of the foot or ahead of it
    if not sunk:
        evaluation[i - 2 : i + 3, j - 2 : j + 3] = -5  # but the foot's own place carries
    field = StripMap(plain.elevation, evaluation, plain.resolution, plain.T_world_strip)
    grown(roadmap, field, Stance(stance.body, feet), 1.9, part=2000)
    reached = roadmap.sampled(np.random.default_rng(0), 4000)
    back = min(float(s.feet[0, 0]) for s in reached)
    assert bool(back < feet[0, 0] - 0.03) is sunk


@pytest.mark.slow
def test_reason_gives_world_position_and_excess_gap_width(roadmap: Roadmap) -> None:
    elevation = heights([], 0.8)
    plain = strip_of(elevation, HEIGHT)
    elsewhere = from_xyz_rpy((5.0, 2.0, 0.0), np.zeros(3))
    field = StripMap(plain.elevation, plain.evaluation, plain.resolution, elsewhere)
    found = grown(roadmap, field, stance_at(PROFILE, START, HEIGHT), NEAR + 0.8 + BEYOND)
    assert isinstance(found, NoSection)
    assert re.match(r"no step from \(5\.\d\d, (1\.9|2\.0)\d\) m: ", found.reason), found.reason
    assert re.search(r"without a foothold, \d+ cm more than the leg's reach of \d+ cm", found.reason), found.reason
