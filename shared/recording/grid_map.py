"""Reader of ROS 2 grid maps (grid_map_msgs/msg/GridMap) in MCAP recordings, for example those of `ros2 bag record`.

Neither ROS nor its message definitions are needed. The layout is that of the library grid_map: cell (0, 0) lies at
the largest x and y, rows go along x and columns along y, and the stored matrix is a circular buffer that begins at the
start indices.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.records import Channel, Schema
from mcap.records import Message as Entry
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.recording.layout import RecordingError
from sextant.shared.recording.reader import read_records
from sextant.shared.recording.records import Condition, printable
from sextant.shared.spelling import hint

TYPE = "grid_map_msgs/msg/GridMap"
_CDR = "cdr"  # encoding of ROS 2's messages
_COLUMN_MAJOR, _ROW_MAJOR = ("column_index", "row_index"), ("row_index", "column_index")
_LEVEL = 1e-3  # [1] largest component of a quaternion's vector that counts as no rotation


@dataclass(frozen=True, slots=True, eq=False)
class GridMapLayer:
    """A layer of a grid map in ascending order; cell (i, j) is centred at origin + resolution * (i, j)."""

    values: NDArray[np.float32]  # (nx, ny), NaN where unknown
    resolution: float  # [m]
    origin: Array  # (2,) [m] {frame} centre of cell (0, 0)
    frame: str


def read_grid_map(path: Path, layer: str = "elevation", topic: str = "") -> GridMapLayer:
    """Return a layer of the newest grid map of a recording.

    Args:
        path: MCAP file with messages of ROS 2.
        layer: Name of the layer.
        topic: Topic of the grid map; empty if the recording has only one.

    Raises:
        RecordingError: The file cannot be read, has no such grid map or layer, or the grid map is invalid.
    """
    newest = _newest_of_each_topic(path)
    if not newest:
        raise RecordingError(f"{path}: a message {TYPE} of ROS 2 expected, found none")
    if not topic and len(newest) > 1:
        raise RecordingError(f"{path}: a topic expected, because there are several grid maps, on {', '.join(sorted(newest))}")
    topic = topic or next(iter(newest))
    if topic not in newest:
        raise RecordingError(f"{path}: a grid map on {topic} expected, found some on {', '.join(sorted(newest))}")
    try:
        return _decode(newest[topic], layer)
    except _InvalidError as error:
        raise RecordingError(f"{path}: {printable(topic)}: {error}") from None


class _InvalidError(ValueError):
    """A message is no valid grid map."""


def _newest_of_each_topic(path: Path) -> dict[str, bytes]:
    """Return topic -> newest message of the topics with grid maps."""
    grids: set[int] = set()  # schemas
    topics: dict[int, str] = {}  # channel -> topic
    newest: dict[str, bytes] = {}
    for record in read_records(path, Condition()):
        match record:
            case Schema(name=name) if name == TYPE:
                grids.add(record.id)
            case Channel() if record.schema_id in grids and record.message_encoding == _CDR:
                topics[record.id] = record.topic
            case Entry() if record.channel_id in topics:
                newest[topics[record.channel_id]] = record.data
    return newest


class _Cdr:
    """Reader of a message in plain CDR of either byte order."""

    def __init__(self, data: bytes):
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
            raise _InvalidError(f"a message in plain CDR expected, found {data[:4].hex(' ') or 'none'}")
        self._data, self._at, self._order = data[4:], 0, "<" if data[1] else ">"

    def numbers(self, kind: str, count: int = 1) -> Array:
        """Return numbers (count,) of a NumPy type such as "f8", aligned to their size."""
        size = np.dtype(kind).itemsize
        begin = -(-self._at // size) * size
        self._at = begin + size * count
        if self._at > len(self._data):
            raise _InvalidError(f"a complete {TYPE} expected, found one cut off after {len(self._data)} bytes")
        return np.frombuffer(self._data[begin : self._at], f"{self._order}{kind}")

    def count(self) -> int:
        """Return a length."""
        return int(self.numbers("u4")[0])

    def text(self) -> str:
        """Return a string, safe to print."""
        return printable(self.numbers("u1", self.count()).tobytes().rstrip(b"\0").decode(errors="replace"))


def _decode(data: bytes, layer: str) -> GridMapLayer:
    """Return a layer of an encoded grid map.

    Raises:
        _InvalidError: It is invalid, or has no such layer.
    """
    message = _Cdr(data)
    message.numbers("i4", 2)  # stamp
    frame = message.text()
    resolution, length_x, length_y = message.numbers("f8", 3).tolist()
    position, rotation = message.numbers("f8", 3), message.numbers("f8", 4)
    layers = [message.text() for _ in range(message.count())]
    for _ in range(message.count()):  # basic layers
        message.text()
    matrices = [_matrix(message) for _ in range(message.count())]
    starts = message.numbers("u2", 2).tolist()
    if layer not in layers[: len(matrices)]:
        raise _InvalidError(f"a layer {layer} expected, found {', '.join(layers) or 'none'}; {hint(layer, layers)}")
    values = matrices[layers.index(layer)]
    shape = np.array(values.shape)
    if not (0.001 <= resolution <= 10.0 and np.isfinite(position).all()):
        raise _InvalidError(f"a resolution of 0.001 to 10 m and a finite position expected, found {resolution:g} m, {position}")
    if np.abs([length_x, length_y] - resolution * shape).max(initial=0.0) > 0.5 * resolution or not math.isfinite(length_x):
        cells = f"{shape[0]} x {shape[1]} cells of {resolution:g} m"
        raise _InvalidError(f"the lengths of {cells} expected, found {length_x:g} x {length_y:g} m")
    if not np.abs(rotation[:3]).max() < _LEVEL:
        raise _InvalidError(f"a grid map along the axes of {frame} expected, found one with orientation {rotation.tolist()}")
    if any(start >= cells for start, cells in zip(starts, values.shape, strict=True)):
        raise _InvalidError(f"start indices within {shape[0]} x {shape[1]} cells expected, found {starts}")
    ascending = np.roll(values, (-starts[0], -starts[1]), axis=(0, 1))[::-1, ::-1]
    return GridMapLayer(ascending, resolution, position[:2] - 0.5 * resolution * (shape - 1), frame)


def _matrix(message: _Cdr) -> NDArray[np.float32]:
    """Return the matrix (rows, columns) of a std_msgs/msg/Float32MultiArray."""
    dims = [(message.text(), *message.numbers("u4", 2).tolist()) for _ in range(message.count())]
    offset = message.count()
    values = message.numbers("f4", message.count())[offset:]
    labels, sizes = tuple(dim[0] for dim in dims), [dim[1] for dim in dims]
    if labels not in (_COLUMN_MAJOR, _ROW_MAJOR):
        raise _InvalidError(
            f"layers with the dimensions column_index and row_index expected, found {', '.join(labels) or 'none'}"
        )
    if not math.prod(sizes) == len(values) > 0:
        raise _InvalidError(f"{sizes[0]} x {sizes[1]} values of a layer expected, found {len(values)}")
    stored = np.asarray(values, dtype=np.float32).reshape(sizes)
    return stored.T if labels == _COLUMN_MAJOR else stored
