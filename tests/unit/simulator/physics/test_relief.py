"""Laws of the heights of reliefs."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.simulator.physics.relief import build_relief, fractal
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.files.config import ConfigError
from sextant.shared.scenario.relief import Relief
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Plane

WAVES = Relief((-1.0, 3.0), (-1.0, 1.0), "washboard", amplitude=0.03, wavelength=0.4, begin=0.5, blend=0.2, base=0.1)


def _heights(relief, seed=1000):
    return build_relief(relief, np.random.default_rng(seed)).heights


@pytest.mark.parametrize("shape", ["washboard", "sine", "ridges", "fractal"])
def test_ground_is_level_before_the_shape_and_has_its_amplitude_behind(shape):
    relief = replace(WAVES, shape=shape)
    heights, x = _heights(relief), -1.0 + 0.02 * np.arange(201)
    np.testing.assert_array_equal(heights[x <= 0.5], 0.1)
    full = heights[x > 0.71] - 0.1
    if shape == "fractal":
        assert full.std() == pytest.approx(0.03, rel=0.2)
        assert abs(full.mean()) < 0.01
    else:
        assert np.abs(full).max() <= 0.03 + 1e-12
        np.testing.assert_allclose([full.min(), full.max()], [-0.03, 0.03], atol=0.004)


def test_washboard_repeats_at_its_wavelength_and_is_level_across():
    heights = _heights(WAVES)
    np.testing.assert_allclose(heights[90:120], heights[110:140], atol=1e-12)
    assert np.ptp(heights, axis=1).max() == 0.0


def test_ridges_have_straight_flanks():
    relief = replace(WAVES, shape="ridges", wavelength=0.8, blend=0.0)
    slopes = np.abs(np.diff(_heights(relief)[90:, 0])) / 0.02
    assert np.median(slopes) == pytest.approx(4 * 0.03 / 0.8)


def test_cross_slope_inclines_the_ground_by_its_angle():
    relief = replace(WAVES, shape="level", cross_slope_deg=12.0)
    heights = _heights(relief)
    np.testing.assert_allclose(np.diff(heights[-1]) / 0.02, np.tan(np.radians(12.0)))
    assert heights[-1, -1] > heights[-1, 0], "the left side, where y is positive, is higher"
    assert np.ptp(heights[0]) == 0.0


def test_amplitude_scales_the_ground_of_a_seed_and_seeds_differ():
    low, high = (_heights(replace(WAVES, shape="fractal", amplitude=size, base=0.0)) for size in (0.01, 0.02))
    np.testing.assert_allclose(high, 2 * low)
    assert not np.allclose(low, _heights(replace(WAVES, shape="fractal", amplitude=0.01, base=0.0), seed=1001))


def test_fractal_has_no_wavelength_above_the_longest_and_is_smoother_for_a_larger_exponent():
    spiky, smooth = (fractal((256, 128), 0.02, 0.5, hurst, np.random.default_rng(3)) for hurst in (0.2, 0.9))
    power = np.abs(np.fft.fft2(smooth)) ** 2
    wavenumber = np.hypot(np.fft.fftfreq(256, 0.02)[:, None], np.fft.fftfreq(128, 0.02)[None, :])
    assert power[wavenumber < 1 / 0.5 - 1e-9].max() < 1e-12 * power.max()
    assert np.abs(np.diff(smooth, axis=0)).mean() < 0.8 * np.abs(np.diff(spiky, axis=0)).mean()
    assert smooth.std() == pytest.approx(1.0)


def test_terrain_has_the_heights_of_its_relief():
    relief = replace(WAVES, shape="sine")
    terrain = build_terrain(Scenario("waves", (Plane(height=-0.5), relief), Goal(2.0)), np.random.default_rng(7))
    heights = _heights(relief, 7)
    np.testing.assert_allclose(terrain.raster(-1.0, -1.0, 200, 100, 0.02), heights[:200, :100], atol=1e-9)
    assert terrain.height_at(np.array([[9.0, 0.0]])).tolist() == [-0.5]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x": (1.0, 1.0)}, "x in rising order"),
        ({"resolution": 0.002}, "choose a larger resolution"),
        ({"blend": -0.1}, "a blend of at least 0 m"),
    ],
)
def test_impossible_relief_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        replace(WAVES, **change)


def test_second_height_field_is_refused():
    with pytest.raises(ConfigError, match="at most one height_map or relief in a terrain expected, found 2"):
        build_terrain(Scenario("two", (WAVES, WAVES), Goal(2.0)), np.random.default_rng(7))
