"""Maps from files: heights and place survive, and what is missing is named."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from sextant.evaluation.map_plan.map_file import read_map
from sextant.evaluation.whole_maps.terrain_map import MapPlanError

HEIGHTS = np.array([[0.0, 0.1, np.nan], [0.2, 0.3, 0.4], [0.5, 0.6, 0.7], [0.8, 0.9, 1.0]], dtype=np.float32)


def test_array_has_the_given_resolution_or_that_of_the_export_next_to_it(tmp_path: Path) -> None:
    path = tmp_path / "map.npy"
    np.save(path, HEIGHTS)
    with pytest.raises(MapPlanError, match="the resolution of the cells in metres expected"):
        read_map(path)
    found = read_map(path, 0.02)
    assert np.array_equal(found.heights, HEIGHTS, equal_nan=True)
    assert (found.resolution, found.origin) == (0.02, (0.0, 0.0))
    path.with_suffix(".json").write_text(json.dumps({"resolution_m": 0.01, "origin_m": [-1.0, 2.0]}))
    found = read_map(path)
    assert (found.resolution, found.origin) == (0.01, (-1.0, 2.0))
    path.with_suffix(".json").write_text("{}")
    with pytest.raises(MapPlanError, match="give --resolution, or correct the file"):
        read_map(path)


def test_grey_picture_has_rows_along_x(tmp_path: Path) -> None:
    path = tmp_path / "map.png"
    cv2.imwrite(str(path), np.arange(12, dtype=np.uint16).reshape(4, 3) * 100)
    with pytest.raises(MapPlanError, match="metres per grey value expected"):
        read_map(path, 0.01)
    found = read_map(path, 0.01, 0.001)
    assert found.heights.shape == (4, 3)
    assert found.heights[3, 2] == pytest.approx(1.1)


def test_recording_has_its_own_resolution(tmp_path: Path) -> None:
    path = tmp_path / "walk.mcap"
    path.write_bytes(b"no recording")
    with pytest.raises(MapPlanError, match="leave --resolution and --scale out"):
        read_map(path, 0.01)
    with pytest.raises(MapPlanError, match="a recorded walk or a grid_map_msgs/msg/GridMap of ROS 2 expected, found neither"):
        read_map(path)
