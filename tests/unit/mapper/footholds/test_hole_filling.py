"""Hole filling: small holes are bridged only where the ground around them agrees."""

import numpy as np
import pytest

from sextant.services.mapper.footholds.hole_filling import fill_small_holes


def test_small_holes_on_plane_are_filled_exactly() -> None:
    i, j = np.mgrid[:30, :40]
    plane = (0.0027 * i - 0.001 * j + 0.5).astype(np.float32)  # 15 deg and more
    holed = plane.copy()
    holed[5, 5] = holed[10, 20:22] = np.nan
    holed[0, 20] = np.nan
    filled = fill_small_holes(holed)
    np.testing.assert_allclose(filled[5, 5], plane[5, 5], atol=1e-6)
    np.testing.assert_allclose(filled[10, 20:22], plane[10, 20:22], atol=1e-6)
    assert np.isnan(filled[0, 20])
    seen = ~np.isnan(holed)
    np.testing.assert_array_equal(filled[seen], holed[seen])
    assert np.isnan(holed[5, 5])


def test_holes_at_edge_and_frontier_stay_unknown() -> None:
    step = np.zeros((12, 12), dtype=np.float32)
    step[6:] = 0.04
    step[5, 5] = np.nan
    step[:, 9:] = np.nan
    filled = fill_small_holes(step)
    np.testing.assert_array_equal(np.isnan(filled), np.isnan(step))
    wide = np.zeros((12, 12), dtype=np.float32)
    wide[4:6] = np.nan
    np.testing.assert_array_equal(np.isnan(fill_small_holes(wide)), np.isnan(wide))


@pytest.mark.parametrize("second", [0.023, 0.029])
def test_trench_between_blocks_is_not_filled(second: float) -> None:
    blocks = np.full((12, 12), 0.029, dtype=np.float32)
    blocks[6:] = second
    blocks[6] = np.nan  # in the shadow of the near block
    np.testing.assert_array_equal(np.isnan(fill_small_holes(blocks)), np.isnan(blocks))
