import numpy as np
import pytest

from sextant.evaluation.figures.relief import shaded


def test_shading_keeps_colors_of_level_ground() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    height = np.full((5, 7), 0.3, dtype=np.float32)
    height[2, 3] = np.nan
    np.testing.assert_array_equal(shaded(rgb, height, 0.01), rgb)


def test_slopes_facing_light_are_brighter() -> None:
    """Light comes from small x and large y."""
    rgb = np.full((9, 9, 3), 100, dtype=np.uint8)
    x, y = np.meshgrid(0.01 * np.arange(9), 0.01 * np.arange(9), indexing="ij")
    towards, away = (shaded(rgb, (s * (x - y)).astype(np.float32), 0.01)[4, 4, 0] for s in (0.3, -0.3))
    assert towards > 100 > away


def test_shading_of_single_cell_and_mismatched_shapes() -> None:
    np.testing.assert_array_equal(shaded(np.full((1, 1, 3), 9, np.uint8), np.zeros((1, 1), np.float32), 0.01), 9)
    with pytest.raises(ValueError, match="colours"):
        shaded(np.zeros((2, 2, 3), np.uint8), np.zeros((2, 3), np.float32), 0.01)
