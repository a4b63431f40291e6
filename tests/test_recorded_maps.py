"""Foothold layers of height maps that a quadruped recorded, half of them unknown.

The maps show stairs, rubble and stepping stones.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.mapper.footholds.layers import FootholdLayers, Layers
from sextant.services.mapper.footholds.params import ScoreParams
from sextant.shared.wire.messages import UNKNOWN
from tests.support.recordings import recording

pytestmark = pytest.mark.data

RESOLUTION = {"demo_map": 0.02, "realStairs_125cm": 0.02, "elevationMap_8_139cm": 0.03, "stepping_stones_65cm": 0.04}  # [m]
SCALE = 0.3  # of heights: the robot is smaller than the quadruped by this factor
WEIGHTS = ScoreParams(unknown_clearance=0.02)
N = 48


def heights(name: str) -> NDArray[np.float32]:
    return np.asarray(
        np.load(recording("elevation_maps", "maps.toml") / f"{name}.npy", allow_pickle=False) * SCALE, dtype=np.float32
    )


def layers(name: str, z: NDArray[np.float32], first: tuple[int, int] = (0, 0)) -> Layers:
    made = FootholdLayers((z.shape[0], z.shape[1]), RESOLUTION[name], None, WEIGHTS)
    return made.update(z, np.zeros_like(z), np.array(first))


@pytest.mark.parametrize("name", RESOLUTION)
def test_recorded_map_has_footholds_and_none_on_unknown_cells(name: str) -> None:
    z = heights(name)
    made = layers(name, z)
    unknown = np.isnan(z)
    assert (made.evaluation[unknown] == UNKNOWN).all()
    assert (made.evaluation[~unknown] != UNKNOWN).all()
    assert not (made.score <= 1)[[0, -1]].any()
    for good in (made.score <= 1, made.evaluation < 0):
        assert 0.05 < good[~unknown].mean() < 0.95


@pytest.mark.parametrize("name", RESOLUTION)
def test_risers_and_edges_are_no_footholds(name: str) -> None:
    """Neither layer accepts a cell with neighbours 3 cm above or below it."""
    z = heights(name)
    made = layers(name, z)
    steep = np.zeros(z.shape, dtype=bool)
    for axis in (0, 1):
        step = np.abs(np.diff(z, axis=axis)) > 0.03
        steep |= np.pad(step, [(0, 1), (0, 0)] if axis == 0 else [(0, 0), (0, 1)])
        steep |= np.pad(step, [(1, 0), (0, 0)] if axis == 0 else [(0, 0), (1, 0)])
    assert steep.any()
    assert not (made.score <= 1)[steep].any()
    assert (made.evaluation[steep] < 0).mean() < 0.02


@pytest.mark.parametrize("name", RESOLUTION)
def test_moving_window_gives_same_layers_as_full_update(name: str) -> None:
    z = np.pad(heights(name), N, constant_values=np.nan)
    kept = FootholdLayers((N, N), RESOLUTION[name], None, WEIGHTS)
    rng = np.random.default_rng(4)
    at = np.array([N // 2, N // 2])
    for _ in range(25):
        at = np.clip(at + rng.integers(-1, 9, 2), 0, np.array(z.shape) - N)
        part = np.ascontiguousarray(z[at[0] : at[0] + N, at[1] : at[1] + N])
        a, b = kept.update(part, np.zeros_like(part), at), layers(name, part, (int(at[0]), int(at[1])))
        np.testing.assert_allclose(a.score, b.score, rtol=1e-3, atol=1e-3)
        np.testing.assert_array_equal(a.evaluation, b.evaluation)
