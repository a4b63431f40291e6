"""Ground from files of measured heights: arrays, grey pictures, and grid maps of ROS 2."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sextant.services.simulator.physics.solids import HeightField
from sextant.shared.files import array_file, picture_file
from sextant.shared.geometry import Array
from sextant.shared.scenario.terrain import HeightMap

if TYPE_CHECKING:
    from sextant.shared.recording.grid_map import GridMapLayer

_MAX_HEIGHT_M = 100.0  # [m] maximum absolute height of measured ground


def read_height_map(part: HeightMap, folder: Path) -> HeightField:
    """Return the measured ground of a scenario.

    Args:
        part: File, place and scale of the map.
        folder: Of the scenario, to which the file is relative.

    Raises:
        ValueError: The file is missing or cannot be read, or its heights are invalid.
    """
    path = part.path(folder)
    if not path.exists():
        raise ValueError(f"height map {str(path)!r} expected, found no such file; name it relative to the scenario file")
    stored, scale, resolution, xy = _stored(path, part)
    with np.errstate(over="ignore"):  # infinite heights are rejected below
        heights = _cropped(stored, part) * scale + part.base
    known = ~np.isnan(heights)
    if not known.any():
        raise ValueError(f"{path}: at least one known height expected, found none")
    low, high = float(heights[known].min()), float(heights[known].max())
    if not -_MAX_HEIGHT_M <= low <= high <= _MAX_HEIGHT_M:
        limits = f"heights within {_MAX_HEIGHT_M:g} m of 0"
        raise ValueError(f"{path}: {limits} expected, found {low:g} to {high:g} m; set scale and base")
    return HeightField(np.where(known, heights, low), resolution, xy)


def _stored(path: Path, part: HeightMap) -> tuple[Array, float, float, tuple[float, float]]:
    """Return the heights of a file, their scale, and the map's resolution [m] and position [m]."""
    scale = 1.0 if part.scale is None else part.scale
    if part.is_grid_map:
        grid = _grid_map(path, part)
        x, y = grid.origin.tolist() if part.xy is None else part.xy
        return grid.values.astype(np.float64), scale, part.resolution or grid.resolution, (x, y)
    assert part.resolution is not None  # both are checked when the scenario is read
    assert part.xy is not None
    if path.suffix.lower() == ".npy":
        return array_file.read_numbers(path), scale, part.resolution, part.xy
    if path.suffix.lower() != ".png":
        raise ValueError(f"a height map in .npy, .png or .mcap expected, found {part.file!r}")
    if part.scale is None:
        raise ValueError(f"{path}: scale expected (metres per grey value), e.g. scale = 0.001; found none")
    grey = np.asarray(picture_file.read_grey(path, bits=(8, 16)), dtype=np.float64)
    return grey, scale, part.resolution, part.xy


def _grid_map(path: Path, part: HeightMap) -> "GridMapLayer":
    try:
        from sextant.shared.recording.grid_map import read_grid_map
    except ImportError as error:
        raise ValueError(f"{path}: a grid map needs {error.name}: pip install 'sextant[recording]'") from None
    return read_grid_map(path, part.layer, part.topic)


def _cropped(heights: Array, part: HeightMap) -> Array:
    """Return the cropped and rotated heights of a height map."""
    if heights.ndim != 2:
        raise ValueError(f"a grid of at least 2x2 heights expected, found {heights.shape} in {part.file!r}")
    for name, wanted, there in (("rows", part.rows, heights.shape[0]), ("columns", part.columns, heights.shape[1])):
        if wanted is not None and wanted[1] > there:
            raise ValueError(f"{name} of at most {there} expected, found {wanted}; {part.file!r} has no more")
    taken = heights[slice(*(part.rows or (None,))), slice(*(part.columns or (None,)))]
    return np.asarray(np.rot90(taken, part.quarter_turns))
