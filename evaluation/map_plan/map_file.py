"""Maps to plan on, from files: arrays, grey pictures, grid maps of ROS 2 and recordings of walks."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.viewers.file_export import merged_map
from sextant.evaluation.whole_maps.terrain_map import MapPlanError
from sextant.shared.files import array_file, input_file, picture_file
from sextant.shared.recording.grid_map import TYPE, read_grid_map
from sextant.shared.recording.layout import RecordingError


@dataclass(frozen=True, slots=True, eq=False)
class MapFile:
    """Heights and their place; cell (i, j) is centred at origin + resolution * (i, j)."""

    heights: NDArray[np.float32]  # (nx, ny) [m], NaN where unknown
    resolution: float  # [m]
    origin: tuple[float, float]  # [m]


def read_map(
    path: Path, resolution: float | None = None, scale: float | None = None, layer: str = "elevation", topic: str = ""
) -> MapFile:
    """Return the map in a file, or in the folder of a recorded walk.

    Args:
        path: `.npy` with heights [m], NaN where unknown; `.png` with grey values of 8 or 16 bits; `.mcap` or folder. Rows
            run along x.
        resolution: [m] of the cells. A `.npy` file may have it in a JSON file next to it, as `sextant recording export --map`
            writes it; grid maps and recordings have their own.
        scale: [m] per grey value of a `.png`.
        layer: Layer of a grid map.
        topic: Topic of a grid map; needed if there are several.

    Raises:
        MapPlanError: The resolution or the scale is missing, or is given for a map that has its own; or nothing is in the file.
        FileError: The file cannot be read.
    """
    kind = path.suffix.lower()
    if kind in (".npy", ".png"):
        about = path.with_suffix(".json")
        if kind == ".npy" and resolution is None and about.is_file():
            return _exported(path, about)
        if resolution is None:
            raise MapPlanError(f"{path}: the resolution of the cells in metres expected, e.g. --resolution 0.01; found none")
        if kind == ".npy":
            return MapFile(array_file.read_numbers(path).astype(np.float32), resolution, (0.0, 0.0))
        if scale is None:
            raise MapPlanError(f"{path}: metres per grey value expected, e.g. --scale 0.001; found none")
        grey = np.asarray(picture_file.read_grey(path, bits=(8, 16)), dtype=np.float32)
        return MapFile(grey * np.float32(scale), resolution, (0.0, 0.0))
    if resolution is not None or scale is not None:
        raise MapPlanError(f"{path}: a recording, which has its own resolution; leave --resolution and --scale out")
    return _recorded(path, layer, topic)


def _exported(path: Path, about: Path) -> MapFile:
    """Return an exported map by its description."""
    try:
        table = json.loads(input_file.read_text(about))
        resolution, (x, y) = float(table["resolution_m"]), table["origin_m"]
        return MapFile(array_file.read_numbers(path).astype(np.float32), resolution, (float(x), float(y)))
    except (KeyError, TypeError, ValueError) as error:
        words = "resolution_m and origin_m as `sextant recording export --map` writes them expected"
        raise MapPlanError(f"{about}: {words}; give --resolution, or correct the file ({error})") from None


def _recorded(path: Path, layer: str, topic: str) -> MapFile:
    """Return the maps of a recorded walk, or else the newest grid map in a recording of ROS 2."""
    try:
        found = merged_map(path)
        x, y = found.origin.tolist()
        return MapFile(found.heights, found.resolution, (x, y))
    except RecordingError as error:
        if path.suffix.lower() != ".mcap":
            raise
        walk = error
    try:
        grid = read_grid_map(path, layer, topic)
    except RecordingError as error:
        raise MapPlanError(f"{path}: a recorded walk or a {TYPE} of ROS 2 expected, found neither: {walk}; {error}") from None
    x, y = grid.origin.tolist()
    return MapFile(grid.values, grid.resolution, (x, y))
