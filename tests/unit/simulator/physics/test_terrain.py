import re
from dataclasses import replace
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest

from sextant.services.simulator.physics.friction import FrictionPatches
from sextant.services.simulator.physics.solids import Boxes, HeightField
from sextant.services.simulator.physics.terrain import Terrain, build_terrain
from sextant.services.simulator.physics.world import World
from sextant.shared.files import picture_file
from sextant.shared.files.config import ConfigError
from sextant.shared.geometry import Array
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.course import Blocks, Course, Flight, Gap, Level, Ramp, Stones
from sextant.shared.scenario.loading import load_scenario, scenario_names
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import (
    Box,
    HeightMap,
    Hole,
    Patches,
    PillarField,
    Pillars,
    Plane,
    Puddle,
    Puddles,
    Rubble,
    Slope,
    Stairs,
)
from sextant.shared.scenario.terrain import Terrain as Primitive
from tests.support import worn_stairs


def scenario(*terrain: Primitive, folder: Path | str = ".") -> Scenario:
    return Scenario("course", terrain, Goal(1.0), folder=str(folder))


def build(*terrain: Primitive, seed: int = 0, folder: Path | str = ".") -> Terrain:
    return build_terrain(scenario(*terrain, folder=folder), np.random.default_rng(seed))


def heights_by_rays(terrain: Terrain, xy: Array) -> Array:
    """Return the heights (n,) where MuJoCo's rays from far above hit the terrain."""
    world = World(load_profile("phantomx_mk2"), terrain)
    only_terrain = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
    mujoco.mj_forward(world.model, world.data)
    heights = np.full(len(xy), -np.inf)
    for i, (x, y) in enumerate(xy):
        geom = np.zeros(1, dtype=np.int32)
        down = mujoco.mj_ray(
            world.model, world.data, np.array([x, y, 10.0]), np.array([0, 0, -1.0]), only_terrain, 1, -1, geom, None
        )
        if down >= 0:
            heights[i] = 10.0 - down
    return heights


ROUGH = HeightField(np.random.default_rng(4).uniform(-0.05, 0.1, (21, 31)), 0.05, (-0.5, -0.7))
STRETCHES = (
    Level(0.4),
    Ramp(0.3, 10.0),
    Flight(0.05, 0.2, 2),
    Stones(0.4, 0.12, 0.05, jitter=0.01, top=(-0.01, 0.01)),
    Gap(0.1),
    Level(0.4),
)
KINDS = {
    "course": build(Plane(height=-0.4), Course(STRETCHES, 1.0, x=-1.2)),
    "plane": build(Plane(height=0.03)),
    "box": build(Plane(), Box((0.3, 0.1), (0.5, 0.3), 0.2, yaw_deg=25.0)),
    "stairs up": build(Plane(), Stairs((0.1, 0.0), 0.05, 0.2, 4, 1.0, landing=0.3, yaw_deg=-20.0)),
    "stairs down": build(Plane(height=-0.2), Stairs((0.1, 0.0), -0.05, 0.2, 4, 1.0)),
    "pillars": build(Pillars(((0.0, 0.0), (0.3, 0.1), (-0.4, 0.5)), 0.15, 0.1)),
    "slope": build(Plane(), Slope((-0.3, 0.1), 20.0, 0.8, 0.9, yaw_deg=40.0, landing=0.4)),
    "rubble": build(Plane(), Rubble((-1.0, 1.0), (-1.0, 1.0), 40, (0.1, 0.2), (0.02, 0.1))),
    "height map": Terrain(build(Pillars((), 0.1, 0.1)).boxes, ROUGH),
    "height map on a plane": Terrain(build(Box((0.2, 0.0), (0.2, 0.2), 0.08)).boxes, ROUGH, 0.0),
}


@pytest.mark.parametrize("kind", KINDS)
def test_terrain_height_matches_vertical_ray_cast(kind: str) -> None:
    xy = np.random.default_rng(1).uniform(-1.2, 1.2, (500, 2))
    ours, theirs = KINDS[kind].height_at(xy), heights_by_rays(KINDS[kind], xy)
    np.testing.assert_array_equal(np.isfinite(ours), np.isfinite(theirs))
    hit = np.isfinite(ours)
    assert hit.any()
    np.testing.assert_allclose(ours[hit], theirs[hit], atol=1e-6)  # MuJoCo stores height fields in single precision


def test_raster_matches_height_at_its_points() -> None:
    terrain = KINDS["slope"]
    raster = terrain.raster(-0.5, -0.2, 7, 5, 0.1)
    i, j = 4, 3
    assert raster.shape == (7, 5)
    assert raster[i, j] == terrain.height_at(np.array([[-0.5 + 0.1 * i, -0.2 + 0.1 * j]]))[0]


def test_slope_rises_from_ground_to_landing() -> None:
    terrain = build(Slope((1.0, 0.0), 15.0, 2.0, 1.0, landing=0.5))
    x = np.array([1.0 + 1e-6, 2.0, 3.0 - 1e-6, 3.2])
    expected = np.tan(np.radians(15.0)) * np.array([0.0, 1.0, 2.0, 2.0])
    np.testing.assert_allclose(terrain.height_at(np.stack([x, np.full(4, 0.3)], axis=1)), expected, atol=1e-5)


def test_ground_around_pillars_is_missing() -> None:
    terrain = build(Pillars(((0.0, 0.0),), 0.1, 0.3))
    np.testing.assert_array_equal(terrain.height_at(np.array([[0.0, 0.0], [0.06, 0.0]])), [0.3, -np.inf])


def test_pillar_positions_follow_seed_within_jitter_and_spread() -> None:
    xy = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    pillars = Pillars(tuple(map(tuple, xy.tolist())), 0.1, 0.0, depth=0.4, jitter=0.01, top_spread=0.03)  # type: ignore[arg-type]
    boxes, same, other = (build(pillars, seed=seed).boxes for seed in (1, 1, 2))
    np.testing.assert_array_equal(boxes.centre, same.centre)
    assert np.abs(boxes.centre - other.centre).min() > 0
    off, top = boxes.centre[:, :2] - xy, boxes.centre[:, 2] + boxes.half[:, 2]
    assert 0.008 < np.abs(off).max() <= 0.01
    assert 0.02 < np.abs(top).max() <= 0.03
    np.testing.assert_allclose(boxes.centre[:, 2] - boxes.half[:, 2], -0.4)  # all stand on one floor


def test_pillars_turn_together_about_their_pivot() -> None:
    straight = Pillars(((1.0, 0.2), (1.3, -0.2)), 0.1, 0.0, length=0.2, depth=0.4, jitter=0.01, tipping=1)
    turned = replace(straight, turn_deg=90.0, pivot=(0.8, 0.0))
    boxes, about = build(straight, seed=3).boxes, build(turned, seed=3).boxes
    away = boxes.centre[:, :2] - (0.8, 0.0)
    np.testing.assert_allclose(about.centre[:, :2], np.stack([0.8 - away[:, 1], away[:, 0]], axis=1), atol=1e-12)
    np.testing.assert_allclose(about.R @ [1.0, 0.0, 0.0], [[0.0, 1.0, 0.0]] * len(about.R), atol=1e-12)
    np.testing.assert_array_equal(about.half, boxes.half)


def test_pillar_field_density_follows_seed_and_pillars_keep_gap() -> None:
    pillars = PillarField((0.8, 1.6), (-0.4, 0.4), (0.1, 0.3), 0.1, 0.0, gap=0.02, depth=0.4)
    shares = []
    for seed in range(20):
        boxes = build(pillars, seed=seed).boxes
        np.testing.assert_array_equal(boxes.centre, build(pillars, seed=seed).boxes.centre)
        np.testing.assert_allclose(boxes.half, [[0.05, 0.05, 0.2]] * len(boxes))
        low, high = boxes.centre[:, :2].min(axis=0), boxes.centre[:, :2].max(axis=0)
        assert np.all(low >= (0.85, -0.35))
        assert np.all(high <= (1.55, 0.35))
        apart = np.abs(boxes.centre[:, None, :2] - boxes.centre[None, :, :2]).max(axis=-1) + np.eye(len(boxes))
        assert apart.min() >= 0.12 - 1e-9
        shares.append(len(boxes) * 0.01 / 0.64)
    assert 0.1 - 0.01 <= min(shares) < 0.15
    assert 0.25 < max(shares) <= 0.3 + 0.01


def test_seed_selects_given_number_of_weak_pillars() -> None:
    pillars = Pillars(((0.0, 0.0), (0.3, 0.0), (0.6, 0.0)), 0.1, 0.0, weak=1, bears=2.0, sinks=0.05)
    terrains = [build(Box((1.0, 0.0), (0.1, 0.1), 0.0), pillars, seed=seed) for seed in range(12)]
    assert {int(k) for terrain in terrains for k in terrain.weak.box} == {1, 2, 3}
    for terrain in terrains:
        (k,) = terrain.weak.box
        xy = terrain.boxes.centre[:, :2]
        np.testing.assert_array_equal(terrain.sink_at(xy), np.where(np.arange(4) == k, 0.05, 0.0))
        np.testing.assert_array_equal(terrain.height_at(xy), 0.0)  # the visible surface is unchanged


def test_tipping_pillars_look_like_the_others_from_above() -> None:
    pillars = Pillars(((0.0, 0.0), (0.3, 0.0), (0.6, 0.0)), 0.1, 0.0, jitter=0.01)
    firm, loose = build(pillars, seed=4), build(replace(pillars, tipping=2, weak=1), seed=4)
    xy = np.random.default_rng(0).uniform((-0.1, -0.1), (0.7, 0.1), (500, 2))
    np.testing.assert_array_equal(loose.height_at(xy), firm.height_at(xy))
    assert sorted([*loose.tipping.box, *loose.weak.box]) == [0, 1, 2]


def test_last_patch_of_friction_counts_and_seed_draws_patches() -> None:
    patches = Patches((0.0, 1.0), (0.0, 1.0), 3, (0.3, 0.5), (0.2, 0.4))
    one, same, other = (build(Plane(), patches, seed=seed).friction for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.low, same.low)
    assert (one.low != other.low).any()
    assert np.isnan(one.at(np.array([[5.0, 5.0]]))).all()
    both = FrictionPatches(np.zeros((2, 2)), np.ones((2, 2)), np.array([0.2, 0.4]))
    assert both.at(np.array([[0.5, 0.5]])) == 0.4


def outline(centre: Array, half: Array, R: Array) -> Array:
    """Return points (n, 2) around a block's top."""
    s = np.linspace(-1, 1, 41)
    edge = np.ones_like(s)
    around = np.concatenate([np.stack(side, axis=1) for side in ((s, edge), (s, -edge), (edge, s), (-edge, s))])
    return np.asarray((around * half[:2]) @ R[:2, :2].T + centre[:2])


@pytest.mark.parametrize("seed", range(5))
def test_rubble_stays_within_region_gap_and_size_bounds(seed: int) -> None:
    rubble = Rubble((0.5, 2.0), (-0.4, 0.4), 20, (0.1, 0.2), (0.01, 0.05), gap=0.02, yaw_deg=30.0)
    blocks = build(rubble, seed=seed).boxes
    assert len(blocks) == 20
    tops = blocks.centre[:, 2] + blocks.half[:, 2]
    assert tops.min() >= 0.01
    assert tops.max() <= 0.05
    assert np.all((2 * blocks.half[:, :2] >= 0.1) & (2 * blocks.half[:, :2] <= 0.2))
    assert np.all(np.abs(np.arctan2(blocks.R[:, 1, 0], blocks.R[:, 0, 0])) <= np.radians(30.0))
    for i in range(20):
        around = outline(blocks.centre[i], blocks.half[i], blocks.R[i])
        assert np.all((around >= [0.5 - 1e-9, -0.4 - 1e-9]) & (around <= [2.0 + 1e-9, 0.4 + 1e-9]))
        for j in range(20):
            if i != j:
                beside = np.abs((around - blocks.centre[j, :2]) @ blocks.R[j, :2, :2]) - blocks.half[j, :2]
                assert np.hypot(*np.maximum(beside, 0.0).T).min() >= 0.02 - 1e-9


def test_rubble_is_determined_by_seed() -> None:
    rubble = Rubble((0.5, 2.0), (-0.4, 0.4), 12, (0.1, 0.2), (0.01, 0.05))
    one, same, other = (build(Plane(), rubble, seed=seed).boxes for seed in (7, 7, 8))
    np.testing.assert_array_equal(one.centre, same.centre)
    assert not np.array_equal(one.centre, other.centre)


def test_rubble_without_room_is_refused() -> None:
    with pytest.raises(ValueError, match="room for 30 blocks of rubble expected, found room for about"):
        build(Rubble((0.0, 0.5), (0.0, 0.5), 30, (0.1, 0.2), (0.01, 0.05)))
    with pytest.raises(ValueError, match="rising order"):
        build(Rubble((0.0, 0.5), (0.0, 0.5), 3, (0.2, 0.1), (0.01, 0.05)))


def test_height_maps_are_read_from_files(tmp_path: Path) -> None:
    heights = np.array([[0.1, 0.2, np.nan], [0.3, 0.05, 0.4]])
    np.save(tmp_path / "ground.npy", heights)
    grey = np.array([[0, 1000], [20000, 65535]], dtype=np.uint16)
    cv2.imwrite(str(tmp_path / "ground.png"), grey)
    field = build(HeightMap("ground.npy", 0.5, (1.0, 2.0), scale=2.0), folder=tmp_path).height_field
    assert field is not None
    np.testing.assert_allclose(field.heights, 2.0 * np.where(np.isfinite(heights), heights, 0.05))
    # Rows run along x: grid point (1, 2) lies at x = 1 + 0.5, y = 2 + 1.
    np.testing.assert_allclose(field.height_at(np.array([[1.5, 3.0], [1.0, 2.5], [0.9, 2.0]])), [0.8, 0.4, -np.inf])
    field = build(HeightMap("ground.png", 0.1, (0.0, 0.0), scale=1e-5), folder=tmp_path).height_field
    assert field is not None
    np.testing.assert_allclose(field.heights, grey * 1e-5)


def test_unreadable_height_maps_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "unknown.npy", np.full((3, 3), np.nan))
    np.save(tmp_path / "line.npy", np.zeros(3))
    (tmp_path / "text.png").write_text("not a picture")
    (tmp_path / "text.npy").write_text("0.1 0.2\n0.3 0.4\n")
    (tmp_path / "ground.tif").touch()
    np.save(tmp_path / "endless.npy", np.array([[0.0, 0.1], [np.inf, 0.0]]))
    np.save(tmp_path / "tall.npy", np.array([[0.0, 255.0], [0.0, 0.0]]))
    np.save(tmp_path / "pickled.npy", np.array([[0.0, None], [0.0, 0.0]]))
    cv2.imwrite(str(tmp_path / "grey.png"), np.array([[0, 255], [0, 0]], dtype=np.uint8))
    cv2.imwrite(str(tmp_path / "colour.png"), np.zeros((2, 2, 3), dtype=np.uint8))
    for file, why in (
        ("missing.npy", "no such file"),
        ("unknown.npy", "at least one known height"),
        ("line.npy", "at least 2x2"),
        ("text.npy", "text.npy: a .npy array expected"),
        ("pickled.npy", "pickled.npy: a .npy array of numbers expected, found pickled objects"),
        ("endless.npy", "heights within 100 m of 0 expected, found 0 to inf m"),
        ("tall.npy", "heights within 100 m of 0 expected, found 0 to 255 m"),
        ("ground.tif", ".npy, .png or .mcap"),
        ("grey.png", "grey.png: scale expected .metres per grey value."),
    ):
        with pytest.raises(ValueError, match=why):
            build(HeightMap(file, 0.1, (0.0, 0.0)), folder=tmp_path)
    for file, why in (
        ("text.png", "text.png: a PNG picture expected"),
        ("colour.png", "colour.png: a grey PNG of 8 or 16 bits expected, found colour of 8 bits"),
        ("grey.png", "heights within 100 m of 0 expected, found 0 to 255 m; set scale and base"),
    ):
        with pytest.raises(ValueError, match=why):
            build(HeightMap(file, 0.1, (0.0, 0.0), scale=1.0), folder=tmp_path)


def test_stairs_risers_and_treads_follow_seed_within_spread() -> None:
    found = set()
    for seed in range(20):
        stairs = Stairs((0.0, 0.0), 0.04, 0.3, 3, 1.0, riser_spread=0.01, tread_spread=0.05)
        terrain = build_terrain(Scenario("stairs", (Plane(), stairs), Goal(1.0)), np.random.default_rng(seed))
        x = np.arange(-0.1, 1.2, 0.001)
        heights = terrain.height_at(np.column_stack([x, np.zeros_like(x)]))
        edges = x[1:][np.diff(heights) > 0]
        risers, treads = np.diff(np.unique(heights.round(6))), np.diff(edges)
        assert len(risers) == 3
        np.testing.assert_allclose(risers, risers[0], atol=1e-5)
        np.testing.assert_allclose(treads, treads[0], atol=2.1e-3)
        assert 0.03 <= risers[0] <= 0.05
        assert 0.249 <= treads[0] <= 0.351
        found.add((risers[0], treads[0]))
    assert len(found) == 20


def profile_along(terrain: Terrain, x: Array, y: float = 0.0) -> Array:
    """Return the heights along a line in the direction of x."""
    return terrain.height_at(np.column_stack([x, np.full_like(x, y)]))


def test_course_stretches_continue_at_previous_height() -> None:
    stretches = (Level(0.5), Ramp(1.0, 10.0), Level(0.5), Flight(-0.04, 0.3, 3), Gap(0.1), Level(1.0))
    terrain = build(Course(stretches, 1.0, x=0.0))
    rise = np.tan(np.radians(10.0))
    x = np.array([0.25, 1.0, 1.75, 2.15, 2.45, 2.75, 2.95, 3.5])
    down = rise - 0.04 * np.arange(1, 4)
    np.testing.assert_allclose(profile_along(terrain, x), [0.0, rise / 2, rise, *down, -np.inf, down[-1]], atol=1e-9)
    upright = terrain.boxes.R[:, 2, 2] == 1.0
    bottoms = (terrain.boxes.centre[:, 2] - terrain.boxes.half[:, 2])[upright]
    np.testing.assert_allclose(bottoms, -0.5, atol=1e-12)


def test_random_course_parameters_follow_seed_within_spread() -> None:
    stretches = (Level(0.5), Ramp(0.5, -8.0, angle_spread_deg=2.0), Flight(0.04, 0.3, 2, riser_spread=0.01), Level(1.0))
    widths, ends = [], []
    for seed in range(12):
        x = np.arange(0.0, 1.0, 0.0005)
        ditch = profile_along(build(Course((Level(0.4), Gap(0.1, spread=0.02), Level(1.0)), 1.0, x=0.0), seed=seed), x)
        widths.append(0.0005 * np.count_nonzero(~np.isfinite(ditch)))
        ends.append(float(profile_along(build(Course(stretches, 1.0, x=0.0), seed=seed), np.array([1.9]))[0]))
    assert 0.079 <= min(widths) < max(widths) <= 0.121
    low, high = (2 * riser - 0.5 * np.tan(np.radians(angle)) for riser, angle in ((0.03, 10.0), (0.05, 6.0)))
    assert low <= min(ends) < max(ends) <= high
    assert len(set(ends)) == 12


def test_shuffled_course_permutes_the_same_stretches() -> None:
    inner = (Ramp(0.3, 5.0), Flight(0.04, 0.3, 1), Blocks(0.3, 2, (0.05, 0.06), (0.02, 0.02)))
    course = Course((Level(1.0), *inner, Level(2.0)), 1.0, x=-0.2, shuffled=True, rest=0.2)
    x = np.arange(-0.1, 3.0, 0.001)
    lines = [profile_along(build(course, seed=seed), x, y=0.49) for seed in range(10)]
    # All are equal before the shuffled part and after it.
    assert np.ptp([line[x < 0.79] for line in lines], axis=0).max() == 0.0
    assert np.ptp([line[x > 2.15] for line in lines], axis=0).max() < 1e-12
    assert len({line.tobytes() for line in lines}) > 3


@pytest.mark.slow
def test_stepping_stones_keep_gaps_and_ground_between_is_low() -> None:
    stones = Stones(1.07, 0.12, 0.05, jitter=0.01, top=(-0.01, 0.01))
    assert stones.rows == 6
    terrain = build(Plane(height=-0.4), Course((Level(1.0), stones, Level(1.0)), 1.5, x=0.0), seed=3)
    blocks = terrain.boxes
    is_stone = np.abs(2 * blocks.half[:, 0] - 0.12) < 1e-9
    assert is_stone.sum() == 6 * 9
    low, high = (blocks.centre[is_stone, :2] + sign * blocks.half[is_stone, :2] for sign in (-1, 1))
    apart = np.maximum(low[:, None] - high, low - high[:, None]).max(axis=-1)
    assert apart[~np.eye(len(apart), dtype=bool)].min() >= 0.03 - 1e-9
    assert low[:, 0].min() >= 1.04
    assert high[:, 0].max() <= 1.0 + 6 * 0.17 + 0.05 - 0.04
    heights = terrain.raster(1.001, -0.7, 1060, 1400, 0.001)
    assert set(np.round(np.unique(heights[heights < -0.1]), 9)) == {-0.4}
    tops = np.unique(heights[heights > -0.1])
    assert len(tops) == 54
    assert np.abs(tops).max() <= 0.01


def test_height_map_can_be_cropped_and_rotated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = np.arange(30.0).reshape(5, 6)
    np.save(tmp_path / "ground.npy", whole)
    monkeypatch.setenv("GROUNDS", str(tmp_path))
    part = HeightMap("$GROUNDS/ground.npy", 1.0, (0.0, 0.0), rows=(1, 4), columns=(2, 6), quarter_turns=1)
    field = build(part, folder="/elsewhere").height_field
    assert field is not None
    taken = whole[1:4, 2:6]
    # A quarter turn counterclockwise moves (x, y) to (-y, x).
    ij = np.array([(i, j) for i in range(3) for j in range(4)])
    turned = np.column_stack([3 - ij[:, 1], ij[:, 0]]).astype(float)
    np.testing.assert_array_equal(field.height_at(turned), taken[ij[:, 0], ij[:, 1]])
    with pytest.raises(ConfigError, match="columns of at most 6 expected"):
        build(replace(part, columns=(2, 7)))
    with pytest.raises(ValueError, match="rows from 0 on"):
        replace(part, rows=(3, 3))


def test_missing_data_folder_setting_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = HeightMap("$MY_MAPS/stairs/map.npy", 0.02, (0.0, 0.0))
    monkeypatch.delenv("MY_MAPS", raising=False)
    with pytest.raises(
        ConfigError, match=r"the environment variable MY_MAPS is not set; set it to the folder that contains stairs"
    ):
        build(part)
    monkeypatch.setenv("MY_MAPS", str(tmp_path))
    with pytest.raises(ConfigError, match=r"stairs/map.npy' expected, found no such file"):
        build(part)


def test_every_scenario_is_built_from_what_sextant_brings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SEXTANT_DATA", raising=False)
    for name in scenario_names():
        build_terrain(load_scenario(name), np.random.default_rng([1000, 0]))


def test_worn_stairs_are_those_of_their_generator() -> None:
    stored = picture_file.read_grey(worn_stairs.FILE, bits=(16,)).astype(int)
    assert np.abs(stored - worn_stairs.picture()).max() <= 1
    terrain = build_terrain(load_scenario("worn_stairs"), np.random.default_rng(0))
    for y in (-0.4, 0.0, 0.4):
        heights = profile_along(terrain, np.arange(0.0, 2.2, 0.01), y)
        levels = np.cumsum([0.0, *worn_stairs.RISES])
        treads = [np.median(heights[np.abs(heights - level) < 0.015]) for level in levels]
        np.testing.assert_allclose(treads, levels, atol=0.003)
    assert np.ptp(terrain.raster(-0.3, -0.3, 101, 60, 0.01)) < 0.003
    landing = terrain.raster(1.56, -0.5, 40, 100, 0.01)
    assert np.ptp(landing) < 0.006  # map and box meet


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rubble", "stepping_stones", "ditch", "mixed"])
def test_seeded_courses_begin_and_end_on_level_ground(name: str) -> None:
    scenario = load_scenario(name)
    for seed in range(1000, 1020):
        terrain = build_terrain(scenario, np.random.default_rng([seed, 0]))
        assert np.ptp(terrain.raster(-0.3, -0.3, 109, 60, 0.01)) == 0.0  # as far as the camera does not see
        if name != "rubble":
            assert np.ptp(terrain.raster(scenario.goal.distance - 0.2, -0.3, 60, 60, 0.01)) < 1e-9


def test_impossible_terrain_is_refused() -> None:
    for terrain, why in (
        ((Plane(), Plane(height=0.1)), "at most one plane"),
        ((Slope((0.0, 0.0), 85.0, 1.0, 1.0),), "less than 80 deg"),
        ((Box((0.0, 0.0), (0.0, 1.0), 0.1),), "positive edges"),
    ):
        with pytest.raises(ConfigError, match=rf"^scenario .*: terrain(\[0\])?: .*{why}"):
            build(*terrain)
    with pytest.raises(ValueError, match="positive resolution"):
        HeightField(np.zeros((2, 2)), 0.0, (0.0, 0.0))
    with pytest.raises(ValueError, match="finite heights"):
        HeightField(np.array([[0.0, np.nan], [0.0, 0.0]]), 0.1, (0.0, 0.0))
    with pytest.raises(ValueError, match="positive edges"):
        Boxes(np.zeros((1, 3)), np.zeros((1, 3)), np.eye(3)[None])
    with pytest.raises(ValueError, match=r"points \(n, 2\)"):
        KINDS["plane"].height_at(np.zeros((4, 3)))


@pytest.mark.parametrize("name", ["flat", "steps"])
def test_bundled_courses_can_be_built(name: str) -> None:
    course = load_scenario(name)
    count = sum(part.count for part in course.terrain if isinstance(part, Rubble | Stairs))
    for seed in range(3):
        assert len(build_terrain(course, np.random.default_rng(seed)).boxes) == count
    # The camera sees nothing nearer than 0.5 m, so every course begins with level ground.
    strip = build_terrain(replace(course), np.random.default_rng(0)).raster(-0.3, -0.3, 100, 60, 0.01)
    assert np.ptp(strip) == 0.0


PUDDLES = (
    Puddle((1.0, 0.0), (0.2, 0.3)),
    Puddle((1.05, 0.4), (0.3, 0.1), depth=0.02),
    Puddle((2.0, -1.0), (0.1, 0.1), color=(120, 90, 60)),
)


def test_puddles_look_level_but_feet_sink() -> None:
    terrain = build_terrain(Scenario("wet", (Plane(), *PUDDLES), Goal(1.0)), np.random.default_rng(0))
    xy = np.random.default_rng(1).uniform((0.5, -1.5), (2.5, 1.0), (4000, 2))
    np.testing.assert_array_equal(terrain.height_at(xy), 0.0)
    inside = [np.all(np.abs(xy - p.xy) < np.array(p.size) / 2, axis=1) for p in PUDDLES]
    np.testing.assert_allclose(terrain.sink_at(xy), sum(p.depth * i for p, i in zip(PUDDLES, inside, strict=True)))
    # The physics supports feet at the surface minus the sink, everywhere.
    carrying = Terrain(terrain.carrying_boxes()).height_at(xy)
    np.testing.assert_allclose(carrying, terrain.height_at(xy) - terrain.sink_at(xy), atol=1e-12)


def test_stone_in_a_puddle_carries_load() -> None:
    scenario = Scenario("wet", (Plane(), PUDDLES[0], Box((1.0, 0.0), (0.1, 0.1), 0.02)), Goal(1.0))
    terrain = build_terrain(scenario, np.random.default_rng(0))
    np.testing.assert_array_equal(terrain.sink_at(np.array([[1.0, 0.0], [1.08, 0.0]])), [0.0, 0.05])


def test_scattered_puddles_keep_gap_and_follow_seed() -> None:
    scenario = Scenario("wet", (Plane(), Puddles((0.0, 2.0), (-0.5, 0.5), 15, (0.05, 0.10), gap=0.05)), Goal(1.0))
    one, same, other = (build_terrain(scenario, np.random.default_rng(seed)).hollows for seed in (3, 3, 4))
    np.testing.assert_array_equal(one.low, same.low)
    assert not np.array_equal(one.low, other.low)
    assert len(one) == 15
    gap = np.maximum(one.low[:, None] - one.high, one.low - one.high[:, None]).max(axis=-1)
    assert gap[~np.eye(15, dtype=bool)].min() >= 0.05 - 1e-9


def test_invalid_puddles_and_colours_are_refused() -> None:
    for terrain in ((PUDDLES[0],), (Plane(), Puddle((0.0, 0.0), (0.1, 0.0))), (Plane(color=(0, 0, 300)),)):
        with pytest.raises(ValueError, match=r"puddle|colours"):
            build_terrain(Scenario("bad", terrain, Goal(1.0)), np.random.default_rng(0))


def test_surfaces_keep_their_colours() -> None:
    scenario = Scenario("painted", (Plane(), Box((0, 0), (1, 1), 0.1, color=(1, 2, 3)), Box((2, 0), (1, 1), 0.1)), Goal(1.0))
    look = build_terrain(scenario, np.random.default_rng(0)).look
    assert look is not None
    np.testing.assert_array_equal(look.boxes, [[1, 2, 3], [np.nan] * 3])
    assert np.isnan(look.plane).all()


def test_hole_has_its_depth_and_level_surroundings() -> None:
    terrain = build(Plane(), Hole((1.0, 0.5), (0.4, 0.6), 0.3))
    xy = np.random.default_rng(0).uniform((0.5, 0.0), (1.5, 1.0), (500, 2))
    inside = (np.abs(xy - (1.0, 0.5)) < (0.2, 0.3)).all(axis=1)
    np.testing.assert_allclose(terrain.height_at(xy), np.where(inside, -0.3, 0.0), atol=1e-9)
    np.testing.assert_allclose(heights_by_rays(terrain, xy), terrain.height_at(xy), atol=1e-6)
    assert not terrain.sink_at(xy).any()


def test_boxes_and_holes_follow_seed_within_spread() -> None:
    box = Box((1.0, 0.0), (0.2, 1.0), 0.3, xy_spread=(0.1, 0.2), size_spread=(0.05, 0.5), top_spread=0.1)
    found = [build(box, seed=seed).boxes for seed in range(40)]
    centre, half = (np.array([getattr(boxes, name)[0] for boxes in found]) for name in ("centre", "half"))
    top = centre[:, 2] + half[:, 2]
    for values, middle, spread in (
        (centre[:, 0], 1.0, 0.1),
        (centre[:, 1], 0.0, 0.2),
        (2 * half[:, 0], 0.2, 0.05),
        (2 * half[:, 1], 1.0, 0.5),
        (top, 0.3, 0.1),
    ):
        assert np.abs(values - middle).max() <= spread
        assert np.ptp(values) > spread
    np.testing.assert_array_equal(build(box, seed=3).boxes.centre, build(box, seed=3).boxes.centre)
    hole = Hole((1.0, 0.0), (0.4, 0.4), 0.3, xy_spread=(0.3, 0.3), size_spread=(0.1, 0.1))
    assert len({build(Plane(), hole, seed=seed).raster(0.5, -0.5, 101, 101, 0.01).sum() for seed in range(5)}) == 5


def test_holes_need_level_ground() -> None:
    with pytest.raises(ConfigError, match="holes need level ground"):
        build(Hole((1.0, 0.0), (0.4, 0.4), 0.3), Box((0.0, 0.0), (1.0, 1.0), 0.0))
    for bad in ({"depth": 0.0}, {"size": (0.0, 1.0)}, {"size_spread": (0.5, 0.0)}, {"xy_spread": (-0.1, 0.0)}):
        with pytest.raises(ValueError, match="expected"):
            Hole(**({"xy": (1.0, 0.0), "size": (0.4, 0.4), "depth": 0.3} | bad))


@pytest.mark.parametrize("name", sorted(name for name in scenario_names() if name.startswith("passage")))
def test_scenario_sketch_matches_terrain_from_above(name: str) -> None:
    course = load_scenario(name)
    parts = [replace(p, jitter=0.0, top_spread=0.0) if isinstance(p, Pillars) else p for p in course.terrain]
    terrain = build_terrain(replace(course, terrain=tuple(parts)), np.random.default_rng(0))
    text = (Path(course.folder) / f"{name}.toml").read_text(encoding="utf-8")
    lines = re.findall(r"^# ([+-]\d\.\d\d)  (\S+)", text, re.MULTILINE)
    assert len(lines) == 7
    for y, drawn in lines:
        x = 0.6 + 0.025 * (np.arange(len(drawn)) + 0.4)
        carries = terrain.height_at(np.column_stack([x, np.full(len(x), float(y))])) > -0.05
        assert [sign != "." for sign in drawn] == carries.tolist()


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in scenario_names() if name.startswith(("passage", "pillar_field"))])
def test_gap_has_no_ground_outside_the_passage_lane(name: str) -> None:
    course = load_scenario(name)
    end = 0.8 + sum(gap.length for part in course.terrain if isinstance(part, Course) for gap in part.stretches[1:2])
    for seed in range(1000, 1010):
        terrain = build_terrain(course, np.random.default_rng([seed, 0]))
        x = np.arange(0.0, 2.6, 0.005)
        lanes = [terrain.height_at(np.column_stack([x, np.full(len(x), y)])) for y in np.arange(-0.6, 0.6, 0.01)]
        carries = np.array(lanes) > -0.1
        assert carries[:, x < 0.8].all()
        assert carries[:, x > end].all()
        assert np.array(lanes)[~carries].max() <= -0.3
        beyond = np.abs(np.arange(-0.6, 0.6, 0.01)) > 0.48
        assert not carries[np.ix_(beyond, (x > 0.805) & (x < end - 0.005))].any()


def test_rubble_exceeding_area_is_refused_without_placement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sextant.services.simulator.physics.terrain._place_rectangles", lambda *_: pytest.fail("tried"))
    with pytest.raises(ValueError, match="room for 500 blocks of rubble expected, found room for about"):
        build(Rubble((0.0, 1.0), (0.0, 1.0), 500, (0.1, 0.2), (0.01, 0.05)))


def test_number_of_terrain_solids_is_bounded() -> None:
    for part, message in (
        (PillarField((0.0, 1000.0), (0.0, 1000.0), (0.5, 0.5), 0.1, 0.0), "pillars in a field expected, found 50000000"),
        (Course((Stones(1000.0, 0.01, 0.01),), 1000.0), "at most 5000 stones expected, found 49999 rows of 50000"),
        (Course(tuple(Flight(0.01, 0.1, 1000) for _ in range(6)), 1.0, bottom=-100.0), "at most 5000 solids expected"),
    ):
        with pytest.raises(ValueError, match=message):
            build(part)
