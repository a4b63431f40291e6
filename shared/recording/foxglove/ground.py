"""The ground: maps, scans and pictures."""

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
# Steps to which values are rounded: fractions of two, so that most of their bits are zero and pack well. The wire's own frames,
# which lie beside them, are exact.
_LENGTH, _SCORE = 2.0**-11, 2.0**-7  # [m], [1]
_TYPES = {"<f4": PackedElementField.FLOAT32, "|u1": PackedElementField.UINT8}


def grid(terrain: TerrainMap) -> Grid:
    """The map; its rows run along y, its columns along x, as Foxglove has them."""
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
    """The cells of a map that are known, where they are; in their colours, where it has some."""
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
    """The points of a scan, with the pixels behind each."""
    packed = np.empty(len(scan.points_mm), dtype=_POINT)
    packed["x"], packed["y"], packed["z"] = _rounded(scan.points, _LENGTH).T
    packed["pixels"] = scan.count
    return _cloud(scan.stamp_ns, packed)


def image(stamp_ns: int, jpeg: NDArray[np.uint8]) -> CompressedImage:
    """A picture of the camera."""
    return CompressedImage(timestamp=parts.time(stamp_ns), frame_id="camera", data=jpeg.tobytes(), format="jpeg")


def _rounded(values: NDArray[Any], step: float) -> NDArray[Any]:
    """In double precision: what is stored as float32 may overflow when it is divided."""
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
    """The fields of a structured type as Foxglove declares them."""
    declared = [(name, *dtype.fields[name]) for name in dtype.names or ()] if dtype.fields else []
    return [PackedElementField(name=name, offset=offset, type=_TYPES[kind.str]) for name, kind, offset, *_ in declared]
