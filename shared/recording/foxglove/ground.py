"""Translation of maps, scans and images."""

from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Vector2_pb2 import Vector2
from numpy.typing import NDArray

from sextant.shared.recording.foxglove import parts
from sextant.shared.wire.messages import UNKNOWN, Scan, TerrainMap

_LAYERS = np.dtype([("elevation", "<f4"), ("score", "<f4"), ("variance", "<f4"), ("evaluation", "<f4")])
_CELL = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("score", "<f4"), ("evaluation", "<f4")])
_COLORED = np.dtype([*_CELL.descr, ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")])
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("pixels", "u1")])
# Rounding steps. They are powers of two, so that most bits of the values are zero and compress well. The original frames in the
# same recording are exact.
_LENGTH, _SCORE = 2.0**-11, 2.0**-7  # [m], [1]
_TYPES = {"<f4": PackedElementField.FLOAT32, "|u1": PackedElementField.UINT8}


def grid(terrain: TerrainMap) -> Grid:
    """Return the map as a Grid, with rows along y and columns along x."""
    nx, ny = terrain.elevation.shape
    packed = np.empty((ny, nx), dtype=_LAYERS)
    packed["elevation"], packed["score"] = _rounded(terrain.elevation.T, _LENGTH), _rounded(terrain.score.T, _SCORE)
    packed["variance"] = terrain.variance.T
    packed["evaluation"] = _evaluation(terrain).T
    corner = np.eye(4)
    corner[:2, 3] = terrain.origin - terrain.resolution / 2
    return Grid(
        timestamp=parts.time(terrain.stamp_ns),
        frame_id="world",
        pose=parts.pose(corner),
        column_count=nx,
        cell_size=Vector2(x=terrain.resolution, y=terrain.resolution),
        row_stride=packed.strides[0],
        cell_stride=packed.strides[1],
        fields=_fields(_LAYERS),
        data=packed.tobytes(),
    )


def cells(terrain: TerrainMap) -> PointCloud:
    """Return the known cells of a map as points, with colours if available."""
    known = np.isfinite(terrain.elevation)
    xy = terrain.origin + terrain.resolution * np.argwhere(known)
    packed = np.empty(len(xy), dtype=_COLORED if terrain.color.size else _CELL)
    packed["x"], packed["y"] = _rounded(xy, _LENGTH).T
    packed["z"], packed["score"] = _rounded(terrain.elevation[known], _LENGTH), _rounded(terrain.score[known], _SCORE)
    packed["evaluation"] = _evaluation(terrain)[known]
    if terrain.color.size:
        packed["red"], packed["green"], packed["blue"] = terrain.color[known].T
        packed["alpha"] = 255
    return _cloud(terrain.stamp_ns, packed)


def points(scan: Scan) -> PointCloud:
    """Return the points of a scan, with the number of pixels of each."""
    packed = np.empty(len(scan.points_mm), dtype=_POINT)
    packed["x"], packed["y"], packed["z"] = _rounded(scan.points, _LENGTH).T
    packed["pixels"] = scan.pixel_count
    return _cloud(scan.stamp_ns, packed)


def image(stamp_ns: int, jpeg: NDArray[np.uint8]) -> CompressedImage:
    """Return a camera image."""
    return CompressedImage(timestamp=parts.time(stamp_ns), frame_id="camera", data=jpeg.tobytes(), format="jpeg")


def _rounded(values: NDArray[Any], step: float) -> NDArray[Any]:
    """Round to a step in double precision, because dividing a float32 may overflow."""
    return np.rint(np.asarray(values, dtype=np.float64) / step) * step


def _evaluation(terrain: TerrainMap) -> NDArray[np.float32]:
    return np.where(terrain.evaluation == UNKNOWN, np.float32(np.nan), terrain.evaluation.astype(np.float32))


def _cloud(stamp_ns: int, packed: NDArray[Any]) -> PointCloud:
    return PointCloud(
        timestamp=parts.time(stamp_ns),
        frame_id="world",
        pose=parts.pose(np.eye(4)),
        point_stride=packed.dtype.itemsize,
        fields=_fields(packed.dtype),
        data=packed.tobytes(),
    )


def _fields(dtype: np.dtype[Any]) -> list[PackedElementField]:
    """Return Foxglove's declaration of the fields of a structured dtype."""
    declared = [(name, *dtype.fields[name]) for name in dtype.names or ()] if dtype.fields else []
    return [PackedElementField(name=name, offset=offset, type=_TYPES[kind.str]) for name, kind, offset, *_ in declared]
