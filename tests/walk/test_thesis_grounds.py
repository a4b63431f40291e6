"""The theses' own tests of their maps.

They are the scoring terrain with its six picks, the walk past objects, and the single pillar. A camera is carried over each
scenario's ground; its images pass perception and mapper with noise and codec. If a figure is missing, the expected result comes
from the text next to it.
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.peers.synthetic_trajectory import CarriedCamera, Errors, Ride, ride
from sextant.services.mapper.config import Settings as MapperSettings
from sextant.services.mapper.footholds.foothold_score import WalkabilityScorer, published_score
from sextant.services.mapper.footholds.layers import FootholdLayers
from sextant.services.mapper.footholds.params import ScoreParams
from sextant.services.mapper.service import Mapper
from sextant.services.perception.config import Settings as PerceptionSettings
from sextant.services.perception.service import Perception
from sextant.services.planner.compiled_terrain import GOOD
from sextant.services.planner.locomotion.foothold_search import Foothold, offsets_by_distance
from sextant.services.planner.terrain import Layer, Terrain
from sextant.services.simulator.physics import terrain as ground
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import LEGS
from sextant.shared.runtime.lockstep import Lockstep
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE, UNKNOWN, TerrainMap
from tests.support import thesis_grounds as things
from tests.support.long_leg import search
from tests.support.walks import blocked

SEARCH = 0.06  # [m] search radius of the planner
R = 0.01  # [m]


@cache
def truth(name: str) -> ground.Terrain:
    return build_terrain(load_scenario(name), np.random.default_rng(0))


@cache
def ridden(name: str, length: float = 2.0, frames: int = 50) -> tuple[Ride, list[TerrainMap]]:
    """Carry a camera over a scenario's ground; return the trajectory and all maps."""
    way = ride(truth(name), np.random.default_rng(1), Errors(), frames, length)
    camera = CarriedCamera(way, np.random.default_rng(2))
    maps: list[TerrainMap] = []

    def hear(topic: AnyTopic, frame: bytes, _at_ns: int) -> None:
        if topic is topics.TERRAIN:
            maps.append(codec.decode(frame, TerrainMap, topics.TERRAIN.max_bytes)[0])

    settings = PerceptionSettings(settle_s=0.0, scan_rate_hz=way.profile.camera.sensor.rate_hz)
    services = {
        "carried camera": lambda: camera,
        "perception": lambda: Perception(way.profile, settings),
        "mapper": lambda: Mapper(way.profile, MapperSettings()),
    }
    Lockstep(services, hear, latency_s={topics.ODOMETRY.key: 0.001}).run(int(way.stamps_ns[-1]) + 300_000_000)
    return way, maps


def true_heights(name: str, map_: TerrainMap) -> Array:
    return truth(name).raster(*map_.origin, *map_.elevation.shape, map_.resolution)


def test_ground_images_match_their_generator() -> None:
    for name, heights in things.GROUNDS.items():
        path = Path(load_scenario(name).folder) / f"{name}.png"
        np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), things.grey(heights()))


# ---- the scoring terrain: Lotriet 2024, section 6.5


class Pick(NamedTuple):
    """A nominal foothold of Figure 6.8, and its result by the text."""

    xy: tuple[float, float]  # [m]
    stays: bool
    height: tuple[float, float]  # [m] true ground under the chosen place
    level: bool = True  # otherwise on the ramp


PICKS = {
    "middle left, on level ground": Pick((1.6, 0.45), True, (0.0, 0.0)),
    "top right, too near a box": Pick((2.20, -0.37), False, (0.0, 0.0)),
    "bottom right, onto the ramp": Pick((1.085, -0.46), False, (0.04, 0.076), level=False),
    "middle right, onto the round pedestal": Pick((1.6, -0.375), False, (things.PEDESTAL_TOP, things.PEDESTAL_TOP)),
    "top left, onto the sloped pillar": Pick((2.2, 0.37), False, (things.PILLAR_TOP, things.PILLAR_TOP)),
    "bottom left, into the sloped hole": Pick((1.06, 0.52), False, (things.HOLE_BOTTOM, things.HOLE_BOTTOM)),
}


def chosen(terrain: Terrain, xy: tuple[float, float]) -> Foothold:
    found = search(terrain, np.array(xy), offsets_by_distance(SEARCH, R))
    assert isinstance(found, Foothold), found.reason
    return found


@pytest.mark.parametrize("layer", ["score", "evaluation"])
@pytest.mark.parametrize("name", PICKS)
def test_chosen_footholds_match_figure_6_8(name: str, layer: Layer) -> None:
    pick = PICKS[name]
    _, maps = ridden("lotriet_scoring")
    terrain = Terrain(maps[-1], layer)
    found = chosen(terrain, pick.xy)
    low, high = pick.height
    here = truth("lotriet_scoring").height_at(found.p_world[None, :2])[0]
    assert low - 0.003 <= here <= high + 0.003  # the sides of the ground's 2 cm grid begin a little early
    assert found.p_world[2] == pytest.approx(here, abs=0.006)
    assert (found.moved == 0) == pick.stays
    if not pick.stays:
        assert terrain.suitability(np.array([pick.xy]))[0] != GOOD
    if layer == "score":
        score = terrain.scores(found.p_world[None, :2])[0]
        assert score <= MAX_FOOTHOLD_SCORE
        if not pick.level:
            assert score > 0.3  # not a perfect score, but an acceptable one


@pytest.mark.parametrize("name", PICKS)
def test_nearest_acceptable_cell_is_chosen(name: str) -> None:
    """Find no nearer cell with room around it than the chosen one.

    Section 6.3 searches growing squares for it.
    """
    _, maps = ridden("lotriet_scoring")
    terrain, nominal = Terrain(maps[-1]), np.array(PICKS[name].xy)
    cells = terrain.centres(nominal) + offsets_by_distance(SEARCH, R)
    good = terrain.suitability(cells) == GOOD
    assert chosen(terrain, PICKS[name].xy).moved <= np.linalg.norm(cells[good] - nominal, axis=1).min() + 1e-9


def raster(name: str) -> tuple[Array, NDArray[np.float32]]:
    """Return cell centres and true heights of a scenario's ground, in cells of 1 cm."""
    x, y = np.meshgrid(np.arange(0.6, 2.6, R) + R / 2, np.arange(-1.0, 1.0, R) + R / 2, indexing="ij")
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    return xy.reshape(*x.shape, 2), truth(name).height_at(xy).reshape(x.shape).astype(np.float32)


def test_slope_and_proximity_terms_match_figure_6_6() -> None:
    """Figure 6.6: slope marks slopes and walls; proximity marks walls only.

    The proximity term is wider at higher walls, and zero on the ramp.
    """
    xy, z = raster("lotriet_scoring")
    scorer = WalkabilityScorer((z.shape[0], z.shape[1]), R)
    scorer.score(z)
    terms = scorer.terms()
    on_ramp = (np.abs(xy[..., 0] - 0.95) < 0.09) & (np.abs(xy[..., 1] + 0.46) < 0.09)
    np.testing.assert_allclose(terms.slope[on_ramp], np.tan(np.radians(15.0)), atol=0.01)
    assert terms.proximity[on_ramp].max() < 1e-3
    level = (z == 0) & (cv2.dilate(np.abs(z), np.ones((9, 9))) == 0)
    assert np.nanmax(terms.slope[level]) == np.nanmax(terms.proximity[level]) == 0.0
    box = np.hypot(xy[..., 0] - 2.2, xy[..., 1] + 0.38) < 0.015  # at its wall
    assert terms.slope[box].max() > 2.0


def test_published_score_grows_with_box_height() -> None:
    """Compute Figure 6.6b by the thesis's own score.

    The thesis: "the magnitude of the height differential will increase size and strength".
    """
    widths, strengths = [], []
    for height in (0.01, 0.03, 0.10):
        z = np.zeros((60, 60), dtype=np.float32)
        z[30:] = height
        score = published_score(z, 0.0, 300.0 * 49, kernel=7, sigma=2.0)[:, 30]
        widths.append(int((score > 1).sum()))
        strengths.append(float(np.nanmax(score)))
    assert widths[0] < widths[1] <= widths[2]
    assert strengths[0] < strengths[1] < strengths[2]


def test_published_score_chooses_same_surfaces() -> None:
    """Apply the thesis's score with its two terms alone to the true ground."""
    xy, z = raster("lotriet_scoring")
    w = ScoreParams()
    score = published_score(z, w.slope / (8 * R), w.proximity * 25, kernel=5, sigma=w.proximity_sigma / R)
    for name, pick in PICKS.items():
        away = np.linalg.norm(xy - np.array(pick.xy), axis=2)
        away[~((score <= MAX_FOOTHOLD_SCORE) & (away <= SEARCH))] = np.inf
        here = z.ravel()[np.argmin(away)]
        assert np.isfinite(away.min()), name
        assert pick.height[0] - 0.005 <= here <= pick.height[1] + 0.005, name


# ---- the walk past objects: section 4.6 and Figure 6.9


class Region(NamedTuple):
    """A region of the ground."""

    x: tuple[float, float]
    y: tuple[float, float]

    def of(self, map_: TerrainMap, layer: NDArray[np.floating]) -> Array:
        """Return a layer's cells (n, m) in the region; NaN beyond the map."""
        x, y = (np.arange(lo, hi, R) + R / 2 for lo, hi in (self.x, self.y))
        i, j = np.round((x - map_.origin[0]) / R).astype(int), np.round((y - map_.origin[1]) / R).astype(int)
        out = np.full((len(x), len(y)), np.nan)
        good_i, good_j = (i >= 0) & (i < layer.shape[0]), (j >= 0) & (j < layer.shape[1])
        out[np.ix_(good_i, good_j)] = layer[np.ix_(i[good_i], j[good_j])]
        return out


PIG, BOX = Region((0.84, 1.20), (0.36, 0.62)), Region((1.06, 1.36), (-0.62, -0.30))
LATER = {
    "wedge": Region((1.55, 1.79), (0.41, 0.59)),
    "tray": Region((1.95, 2.25), (0.39, 0.69)),
    "stone": Region((2.0, 2.2), (-0.6, -0.42)),
}


def known(region: Region, map_: TerrainMap) -> NDArray[np.bool_]:
    return np.isfinite(region.of(map_, map_.elevation))


def test_map_fills_shadows_keeps_objects_and_adds_new_ones() -> None:
    _, maps = ridden("lotriet_walk_past")
    start, middle, end = maps[1], maps[len(maps) // 2], maps[-1]
    for region in (PIG, BOX):
        assert 0 < known(region, start).sum() < known(region, middle).sum() <= known(region, end).sum()
    # "The somewhat spherical pig object now also appears larger."
    high = [int((PIG.of(m, m.elevation) > 0.02).sum()) for m in (start, middle)]
    assert high[1] > high[0]
    # "The original objects are also now out of vision, but they persist": unseen cells keep their values.
    for region in (PIG, BOX):
        before, after = region.of(middle, middle.elevation), region.of(end, end.elevation)
        kept = np.isfinite(before)
        np.testing.assert_allclose(after[kept], before[kept], atol=0.02)
    for name, region in LATER.items():
        assert not known(region, start).any(), name
        assert known(region, end).mean() > 0.4, name
    # A shadow is unknown, and no foothold by either layer.
    for map_ in (start, middle, end):
        unknown = np.isnan(map_.elevation)
        assert np.isnan(map_.score[unknown]).mean() > 0.999  # single cells are bridged for the score
        assert (map_.evaluation[unknown] == UNKNOWN).all()


def test_mapped_objects_have_true_position_and_height() -> None:
    _, maps = ridden("lotriet_walk_past")
    end = maps[-1]
    error = end.elevation - true_heights("lotriet_walk_past", end)
    steep = cv2.morphologyEx(true_heights("lotriet_walk_past", end), cv2.MORPH_GRADIENT, np.ones((5, 5))) > 0.02
    away = np.isfinite(error) & ~steep
    assert np.sqrt(np.mean(error[away] ** 2)) < 0.006
    for name, region, top in (("box", BOX, 0.10), ("tray", LATER["tray"], 0.06)):
        assert np.nanpercentile(region.of(end, end.elevation), 95) == pytest.approx(top, abs=0.006), name
    # The object with a hole: the visible floor in it is floor.
    hole = Region((2.03, 2.17), (0.47, 0.61))
    assert np.nanmin(hole.of(end, end.elevation)) == pytest.approx(0.0, abs=0.008)


def test_mapped_floor_has_no_line_artifacts() -> None:
    """Map a floor without lines.

    The thesis's poses leave lines on the floor and stripes in the score (Figures 4.6 and 6.9).
    """
    _, maps = ridden("lotriet_walk_past")
    end = maps[-1]
    heights = true_heights("lotriet_walk_past", end)
    floor = (cv2.dilate(np.abs(heights), np.ones((13, 13))) == 0) & np.isfinite(end.elevation)
    assert floor.sum() > 10_000
    assert np.percentile(np.abs(end.elevation[floor]), 99) < 0.008
    known_well = floor & np.isfinite(end.score)
    assert (end.score[known_well] <= MAX_FOOTHOLD_SCORE).mean() > 0.995
    assert (end.evaluation[known_well] < 0).mean() > 0.97


# ---- the single pillar: Masri 2016, Figures 4.7 and 4.11


def test_evaluation_function_of_pillar_matches_masri() -> None:
    """Evaluate a pillar of 24 cm in an abyss.

    F decreases by one per cell from its border to its middle, and is limited at -5.
    """
    z = np.full((80, 80), -0.4, dtype=np.float32)
    z[28:52, 28:52] = 0.0
    made = FootholdLayers((80, 80), R).update(z, np.zeros_like(z), np.zeros(2, dtype=np.int64), body_height=0.1)
    across = made.evaluation[:, 40].astype(int)
    on = np.flatnonzero(across < 0)
    assert (on[0], on[-1]) == (30, 49)  # two cells of each side are edge
    np.testing.assert_array_equal(across[30:50], -np.minimum(np.minimum(np.arange(1, 21), np.arange(20, 0, -1)), 5))
    np.testing.assert_array_equal(across[15:30], np.arange(15, 0, -1))  # grows outside, also over ground that is too deep
    assert (made.evaluation[on[0] : on[-1] + 1, 30:50] < 0).all()


def test_map_and_evaluation_of_single_pillar_match_masri() -> None:
    way, maps = ridden("masri_pillar", length=0.35, frames=24)
    map_ = maps[-1]
    heights = true_heights("masri_pillar", map_)
    x, y = (map_.origin[k] + R * np.arange(map_.elevation.shape[k]) for k in (0, 1))
    F = map_.evaluation.astype(int)
    # Ground 0.25 m or more below the body is not accessible, whether it is seen or not.
    deep = np.isfinite(map_.elevation) & (map_.elevation < -0.3)
    assert deep.sum() > 1000
    assert (F[deep] > 0).all()
    # Beyond the platform only the pillar supports a foot.
    beyond = (F < 0) & (x > 0.9)[:, None]
    i, j = np.nonzero(beyond)
    assert beyond.sum() > 100
    assert (heights[beyond] == 0).all()
    assert (np.abs(x[i] - 1.40) <= 0.12 - R).all()
    assert (np.abs(y[j]) <= 0.12 - R).all()
    # Its middle is a local minimum at the threshold; from there F rises by one per cell, through zero, to beyond the border.
    assert np.abs(y[j].mean()) < 0.01
    a = int(np.argmin(np.abs(x - 1.38)))
    across = F[a]
    middle = int(np.argmin(np.abs(y)))
    assert across[middle] == F.min() == -5
    for side in (across[middle : middle + 20], across[middle::-1][:20]):
        end = int(np.argmax(side > 0))
        assert 0.06 < end * R < 0.12
        rise = np.where(side[: end + 3] > 0, side[: end + 3] - 1, side[: end + 3])  # no cell is at zero
        assert (np.diff(rise) >= 0).all()
        assert set(np.diff(rise[end - 5 :]).tolist()) <= {0, 1}
    assert way.T_world_body[-1, 2, 3] == pytest.approx(0.15, abs=0.03)


@pytest.mark.rare  # `test_robot_stops_before_pool_with_reason` walks to the same kind of end
def test_robot_stops_before_pillar_gap_with_reason() -> None:
    reason, map_ = blocked(load_scenario("masri_pillar"), 1000)
    assert any(f"{leg} leg: no foothold within 6 cm of its nominal place" in reason for leg in LEGS), reason
    assert "not seen" in reason, "how deep it goes there shows only from nearer than the leg that would have to know"
    heights = true_heights("masri_pillar", map_)
    assert (heights[(map_.evaluation < 0) & np.isfinite(heights)] == 0).all()
