"""The picture of the map layers, for any map and for an empty one."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sextant.evaluation.figures import layers_picture
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.wire.messages import TerrainMap


def terrain(known: slice, relief: float = 0.05, good: bool = True) -> TerrainMap:
    """Return a map of 60 x 80 cells with some rows known."""
    height = np.full((60, 80), np.nan, dtype=np.float32)
    height[known] = np.linspace(0.0, relief, 80, dtype=np.float32)
    score = np.where(np.isnan(height), np.float32(np.nan), np.float32(0.2 if good else 9.0))
    evaluation = np.where(np.isnan(height), 127, -5 if good else 15).astype(np.int8)
    flags = np.zeros(height.shape, dtype=np.bool_)
    return TerrainMap(0, 0.01, np.zeros(2), height, np.full_like(height, 1e-5), score, flags, evaluation)


@pytest.mark.slow
@pytest.mark.parametrize(("known", "good"), [(slice(10, 50), True), (slice(30, 31), False)])
def test_layers_of_map_are_drawn(known: slice, good: bool, tmp_path: Path) -> None:
    way = np.array([from_xyz_rpy((0.01 * k, 0.4, 0.1), (0.0, 0.0, 0.0)) for k in range(30)])
    path = tmp_path / "new" / "layers.png"
    assert layers_picture.draw(path, terrain(known, good=good), way)
    picture = cv2.imread(str(path))
    assert picture.shape[1] == 1800
    assert picture.std() > 5


def test_unknown_map_is_not_drawn(tmp_path: Path) -> None:
    assert not layers_picture.draw(tmp_path / "layers.png", terrain(slice(0, 0)))
    assert not list(tmp_path.iterdir())
