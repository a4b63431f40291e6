"""Map update of ANYbotics' elevation_mapping (BSD licence), compiled from its own sources without ROS.

Of the package it has the update of the raw map by a point cloud, `ElevationMap::add`, and grid_map's movement of the map. The
package also transforms the cloud, computes the variances of its points, updates the map by the robot's motion, fuses
neighbouring cells and cleans up by visibility; this is left out, so the times are lower than those of its node.
"""

import ctypes
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.shared.files import whole_files
from sextant.shared.geometry import Array

_CORE = Path(__file__).with_name("anybotics_core.cpp")
_PACKAGE, _GRID_MAP, _EIGEN = "elevation_mapping/elevation_mapping", "grid_map/grid_map_core", "eigen3"
_FUNCTIONS = ("add", "clean")
_OPTIMISED = ("-std=c++17", "-O3", "-DNDEBUG", "-march=native", "-shared", "-fPIC", "-w")
_PLUGINS = (
    '-DEIGEN_FUNCTORS_PLUGIN="grid_map_core/eigen_plugins/FunctorsPlugin.hpp"',
    '-DEIGEN_DENSEBASE_PLUGIN="grid_map_core/eigen_plugins/DenseBasePlugin.hpp"',
)
_VARIANCE_M2 = 9e-6  # [m^2] of each point's height; it does not affect the time


class BuildError(Exception):
    """The sources are incomplete or cannot be compiled; the message says why."""


def build(sources: Path, folder: Path) -> ctypes.CDLL:
    """Compile the map update.

    Args:
        sources: Folder with checkouts of ANYbotics' `elevation_mapping` and `grid_map`, and the headers of Eigen in `eigen3`.
        folder: Folder for the compiled library.

    Raises:
        BuildError: A source is missing, or the compiler failed.
    """
    for name in (_PACKAGE, _GRID_MAP, _EIGEN):
        if not (sources / name).is_dir():
            raise BuildError(f"a folder {name} in {sources} expected, found none")
    if shutil.which("c++") is None:
        raise BuildError("a C++ compiler named c++ expected, found none")
    text = _read(sources / _PACKAGE / "src/ElevationMap.cpp")
    functions = [_part(text, rf"^bool ElevationMap::{name}\(.*?^}}\n") for name in _FUNCTIONS]
    parameters = _part(
        _read(sources / _PACKAGE / "include/elevation_mapping/ElevationMap.hpp"), r"^  struct Parameters {.*?^  };\n"
    )
    whole_files.write_text(folder / "core.inc", "\n".join(functions))
    whole_files.write_text(folder / "parameters.inc", parameters)
    core = sources / _GRID_MAP
    includes = (folder, core / "include", sources / _PACKAGE / "include", sources / _EIGEN)
    files = (_CORE, *sorted((core / "src").rglob("*.cpp")))
    library = folder / "anybotics_core.so"
    command = ["c++", *_OPTIMISED, *_PLUGINS, *(f"-I{path}" for path in includes), *map(str, files), "-o", str(library)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BuildError(f"the compiler failed: {' / '.join(done.stderr.splitlines()[:3])}")
    loaded = ctypes.CDLL(str(library))
    loaded.map_new.restype = ctypes.c_void_p
    return loaded


class AnyboticsMap:
    """Raw map of elevation_mapping, of `size` x `size` cells."""

    def __init__(self, library: ctypes.CDLL, size: int, resolution: float):
        """Start without heights."""
        self._library, self._size, self._resolution = library, size, resolution
        self._map = ctypes.c_void_p(library.map_new(ctypes.c_double(size * resolution), ctypes.c_double(resolution)))
        self._scans = 0

    def __del__(self) -> None:
        self._library.map_delete(self._map)

    def move_to(self, p_world_xy: Array) -> None:
        """Centre the map on a point (2,) [m] {world}."""
        self._library.map_move(self._map, ctypes.c_double(p_world_xy[0]), ctypes.c_double(p_world_xy[1]))

    def add(self, points: NDArray[np.float32], p_world_camera: Array) -> None:
        """Add a cloud (n, 3) [m] {world} that a camera has seen from a point (3,) [m] {world}."""
        points, sensor = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(p_world_camera, np.float64)
        variances = np.full(len(points), _VARIANCE_M2, np.float32)
        self._scans += 1
        time_s = ctypes.c_double(self._scans / 15.0)
        pointers: list[Any] = [array.ctypes.data_as(ctypes.c_void_p) for array in (points, variances)]
        self._library.map_add(self._map, *pointers, ctypes.c_int64(len(points)), sensor.ctypes.data_as(ctypes.c_void_p), time_s)

    def heights(self, low: Array) -> NDArray[np.float32]:
        """Return the heights (size, size) [m] of the cells from cell `low` (2,) of {world} on; NaN where unknown."""
        out = np.empty((self._size, self._size), np.float32)
        x, y = ((low + 0.5) * self._resolution).tolist()
        place = ctypes.c_double(x), ctypes.c_double(y), ctypes.c_int64(self._size)
        self._library.map_heights(self._map, *place, out.ctypes.data_as(ctypes.c_void_p))
        return out


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise BuildError(f"cannot read {path}: {error.strerror}") from None


def _part(text: str, pattern: str) -> str:
    found = re.search(pattern, text, re.DOTALL | re.MULTILINE)
    if found is None:
        raise BuildError(f"{pattern.split('.')[0]!r} expected in the sources, found none; they may be of another version")
    return found[0]
