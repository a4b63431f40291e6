"""Terrain type: firm, water or loose ground, from colour, shape and feet."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.mapper.footholds.terrain_type import GroundType, Palette, TerrainType, TypeMap, TypeModel
from sextant.shared.color import ycocg_from_rgb
from sextant.shared.geometry import Array

N, R = 80, 0.01
MODEL = TypeModel()
GREY, TAN, BLUE, BROWN = (125, 122, 116), (180, 150, 110), (74, 94, 118), (110, 85, 60)
FLAT = np.zeros((N, N), dtype=np.float32)


def centres() -> Array:
    i, j = np.indices((N, N)).reshape(2, -1)
    return np.column_stack([(i - N // 2 + 0.5) * R, (j - N // 2 + 0.5) * R])


def square(x: float, y: float, half: float) -> NDArray[np.bool_]:
    p = centres()
    return np.asarray((np.abs(p - [x, y]) < half).all(axis=1).reshape(N, N))


def painted(
    ground: tuple[int, int, int], *patches: tuple[NDArray[np.bool_], tuple[int, int, int]], seed: int = 0
) -> TerrainType:
    """Return ground that was seen in a few pictures under varying light."""
    rng = np.random.default_rng(seed)
    known = TerrainType((N, N), R, np.full(2, -N // 2))
    for _ in range(4):
        rgb = np.tile(np.array(ground, dtype=float), (N, N, 1))
        for cells, color in patches:
            rgb[cells] = color
        rgb *= rng.normal(1.0, 0.08, (N, N, 1))
        rgb += rng.normal(0.0, 3.0, rgb.shape)
        known.add_colors(centres(), ycocg_from_rgb(np.clip(rgb, 0, 255).reshape(-1, 3)))
    return known


def classified(known: TerrainType, slope: NDArray[np.float32] = FLAT, rough: NDArray[np.float32] = FLAT) -> TypeMap:
    return known.classify(slope, rough)


ALL = np.ones((N, N), dtype=np.bool_)
POOL = square(0.1, 0.1, 0.08)
AWAY = ~square(0.1, 0.1, 0.13)


def test_ground_like_start_ground_is_firm() -> None:
    known = painted(GREY)
    assert known.learn_start_ground(ALL)
    found = classified(known)
    assert found.probability[..., GroundType.FIRM].min() > 0.8
    assert not found.hazard.any()
    assert not found.cost.any()
    assert found.confidence.min() >= 80


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("light", [0.6, 1.0, 1.4])
def test_flat_sky_reflecting_patch_is_water(seed: int, light: float) -> None:
    grey, blue = (tuple(int(light * c) for c in color) for color in (GREY, BLUE))
    known = painted(grey, (POOL, blue), seed=seed)  # type: ignore[arg-type]
    known.learn_start_ground(~POOL)
    found = classified(known)
    assert (found.hazard[POOL] == GroundType.WATER).mean() > 0.99
    assert (found.cost[POOL] > 1.0).mean() > 0.99
    assert (found.hazard[AWAY] == 0).mean() > 0.999


def test_water_hazard_is_widened_by_foot_radius() -> None:
    known = painted(GREY, (POOL, BLUE))
    known.learn_start_ground(~POOL)
    beside = square(0.1, 0.1, 0.105) & ~square(0.1, 0.1, 0.095)
    assert (classified(known).hazard[beside] == GroundType.WATER).all()


def test_other_dry_material_is_not_hazard() -> None:
    known = painted(GREY, (POOL, TAN))
    known.learn_start_ground(~POOL)
    assert not classified(known).hazard[POOL].any()


def test_blue_ground_is_firm_if_start_ground_is_blue() -> None:
    """Check that blue is firm on a blue floor."""
    known = painted(BLUE)
    known.learn_start_ground(ALL)
    assert not classified(known).hazard.any()


def test_steep_or_rough_patch_is_not_water() -> None:
    known = painted(GREY, (POOL, BLUE))
    known.learn_start_ground(~POOL)
    steep, rough = np.full((N, N), 0.3, dtype=np.float32), np.full((N, N), 0.008, dtype=np.float32)
    assert not classified(known, steep, rough).hazard[POOL].any()
    unknown = np.full((N, N), np.nan, dtype=np.float32)
    assert np.isfinite(classified(known, unknown, unknown).probability).all()


def test_sunk_foot_marks_all_ground_of_that_color_loose() -> None:
    other = square(-0.2, -0.2, 0.06)
    known = painted(GREY, (POOL, BROWN), (other, BROWN))
    known.learn_start_ground(~POOL & ~other)
    before = classified(known)
    assert not before.hazard[POOL].any()
    for _ in range(2):
        known.touch(np.array([0.1, 0.1]), 0.018)
    after = classified(known)
    assert (after.hazard[other] == GroundType.LOOSE).mean() > 0.9
    assert (after.hazard[AWAY & ~square(-0.2, -0.2, 0.11)] == 0).mean() > 0.999


def test_small_sink_on_new_color_causes_no_hazard() -> None:
    """Check small errors of map, pose and joints: some millimetres, foot after foot."""
    known = painted(GREY, (POOL, TAN))
    known.learn_start_ground(~POOL)
    rng = np.random.default_rng(0)
    for k in range(40):
        where = rng.uniform(0.04, 0.16, 2) if k % 2 else rng.uniform(-0.3, -0.1, 2)
        known.touch(where, float(np.clip(rng.normal(0.003, 0.003), 0.0, 0.009)))
        assert not classified(known).hazard.any()


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "outliers"), [(0.006, 0.0), (0.003, 0.05), (0.006, 0.05)])
@pytest.mark.parametrize("seed", range(3))
def test_thousands_of_steps_on_firm_ground_cause_no_hazard(sigma: float, outliers: float, seed: int) -> None:
    """Check errors as the model assumes them, on ground that is new at every touch."""
    rng = np.random.default_rng(seed)
    known = painted(GREY)
    assert known.learn_start_ground(ALL)
    place, model = np.zeros(2), known.model
    for k in range(4000):
        sink = rng.uniform(0.0, model.deepest) if rng.random() < outliers else rng.normal(0.0, sigma)
        known.touch(place, float(sink))
        known._touch[:] = 0.0
        if k % 500 == 499:
            assert not classified(known).hazard.any()


def test_carrying_feet_clear_hazard_of_color() -> None:
    known = painted(GREY, (POOL, BLUE))
    known.learn_start_ground(~POOL)
    assert classified(known).hazard[POOL].any()
    for xy in ((0.08, 0.08), (0.12, 0.12), (0.12, 0.08)):
        known.touch(np.array(xy), 0.001)
    assert (classified(known).hazard[POOL] == 0).mean() > 0.9


def test_foot_contacts_classify_ground_without_color() -> None:
    known = TerrainType((N, N), R, np.full(2, -N // 2))
    known.touch(np.array([0.2, 0.0]), 0.04)
    known.touch(np.array([-0.2, 0.0]), 0.0)
    found = classified(known)
    wet, dry, far = (found.probability[N // 2 + at, N // 2] for at in (20, -20, 0))
    assert wet[GroundType.FIRM] < 0.5
    assert far[GroundType.FIRM] == pytest.approx(MODEL.prior[0])
    assert dry[GroundType.FIRM] > MODEL.prior[0]
    assert found.confidence[N // 2, N // 2] == 0
    assert found.confidence[N // 2 - 20, N // 2] > 90


def test_no_ground_found_indicates_water_and_zero_sink_firm() -> None:
    known = TerrainType((N, N), R, np.full(2, -N // 2))
    nothing, carried = known.sink_log_likelihood(None), known.sink_log_likelihood(0.0)
    assert np.argmax(nothing) == GroundType.WATER
    assert np.argmax(carried) == GroundType.FIRM
    deeper = [
        known.sink_log_likelihood(s)[GroundType.WATER] - known.sink_log_likelihood(s)[GroundType.LOOSE]
        for s in (0.02, 0.05, 0.08)
    ]
    assert deeper == sorted(deeper), "the deeper, the rather water"


@settings(max_examples=60, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(0.0, 1.0), st.floats(0.0, 0.1), st.integers(0, 2**32 - 1))
def test_probabilities_stay_normalized_for_any_input(sink: float, slope: float, rough: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    known = TerrainType((16, 16), R, np.zeros(2, dtype=np.int64))
    color = rng.uniform((0, -255, -255), (255, 255, 255), (256, 3)).astype(np.float32)
    color[rng.random(256) < 0.3] = np.nan
    i, j = np.indices((16, 16)).reshape(2, -1)
    known.add_colors(np.column_stack([(i + 0.5) * R, (j + 0.5) * R]), color)
    known.learn_start_ground(np.ones((16, 16), dtype=np.bool_))
    for _ in range(30):
        known.touch(rng.uniform(-0.05, 0.2, 2), sink if rng.random() < 0.8 else None)
    layers = [np.full((16, 16), value, dtype=np.float32) for value in (slope, rough)]
    found = known.classify(*layers)
    assert np.isfinite(found.probability).all()
    np.testing.assert_allclose(found.probability.sum(axis=-1), 1.0, atol=1e-4)
    assert np.isfinite(found.cost).all()
    assert ((found.hazard > 0) == (found.cost > 1.0)).all()


def test_moved_window_keeps_overlap_and_clears_the_rest() -> None:
    known = painted(GREY, (POOL, BLUE))
    known.learn_start_ground(~POOL)
    before = known.rgb()
    known.move_to(np.array([-N // 2 + 7, -N // 2 - 3]))
    after = known.rgb()
    np.testing.assert_array_equal(after[:-7, 3:], before[7:, :-3])
    assert not after[-7:].any()
    assert not after[:, :3].any()
    known.move_to(np.array([1000, 1000]))
    assert not known.rgb().any()


def test_start_ground_is_not_learned_without_color() -> None:
    assert not TerrainType((N, N), R, np.zeros(2, dtype=np.int64)).learn_start_ground(ALL)


def test_palette_keeps_most_frequent_colors() -> None:
    palette, sigma = Palette(), np.ones(3)
    for k in range(Palette.SIZE):
        for _ in range(5):
            palette.add(0, np.array([10.0 * k, 0.0, 0.0]), 1.0, sigma)
    palette.add(0, np.array([100.0, 0.0, 0.0]), 1.0, sigma)
    assert 100.0 not in palette.mean[0, :, 0]
    palette.add(0, np.array([0.5, 0.0, 0.0]), 5.0, sigma)
    np.testing.assert_allclose(sorted(palette.mean[0, :, 0])[0], 0.25)
    assert palette.weight[0].sum() == 5 * Palette.SIZE + 5


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="priors"):
        TypeModel(prior=(0.5, 0.5, 0.5))
    with pytest.raises(ValueError, match="free_below"):
        TypeModel(free_below=0.6)
    with pytest.raises(ValueError, match="a colour for each"):
        TerrainType((N, N), R, np.zeros(2, dtype=np.int64)).add_colors(np.zeros((2, 2)), np.zeros((3, 3), dtype=np.float32))


@pytest.mark.parametrize("sink", [0.0, 0.03])
def test_repeated_contacts_at_one_place_do_not_change_other_ground(sink: float) -> None:
    known = painted(GREY, (POOL, BLUE))
    known.learn_start_ground(~POOL)
    assert classified(known).hazard[POOL].all()
    for _ in range(300):
        known.touch(np.array([-0.2, -0.2]), sink)
    found = classified(known)
    assert np.isfinite(found.probability).all()
    np.testing.assert_allclose(found.probability.sum(axis=-1), 1.0, atol=1e-5)
    assert (found.hazard[POOL] > 0).all()
