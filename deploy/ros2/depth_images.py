"""Depth images of ROS: sensor_msgs/Image and CameraInfo to frames for the robot's camera process."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sextant.deploy.ros2.message_types import CdrError, decode
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ExternalDepth

IMAGE, CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
_ENCODINGS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}  # REP 118: millimetres in 16 bits, metres as float
_MM_PER_M = 1000.0
_MOST_PIXELS = topics.cells_that_fit(topics.EXTERNAL_DEPTH)
_HEADER_BYTES = 4096
MAX_INFO_BYTES = 8192


def info_topic(topic: str) -> str:
    """Return the topic of a camera's CameraInfo, which is next to that of its image."""
    return f"{topic.rpartition('/')[0]}/camera_info" if "/" in topic else "camera_info"


def read_info(payload: bytes) -> tuple[int, int, tuple[float, ...]]:
    """Return width, height, and fx, fy, cx, cy [px] of a CameraInfo: those of its projection matrix.

    Raises:
        CdrError: It is malformed, or describes no lens.
    """
    if len(payload) > MAX_INFO_BYTES:
        raise CdrError(f"{CAMERA_INFO}: at most {MAX_INFO_BYTES} bytes expected, found {len(payload)}")
    found = decode(CAMERA_INFO, payload)
    p = np.asarray(found.p, dtype=np.float64)
    lens = tuple(map(float, p[[0, 5, 2, 6]]))
    if not (np.isfinite(lens).all() and min(lens[:2]) > 0.0):
        raise CdrError(f"{CAMERA_INFO}: finite focal lengths above 0 expected, found {lens}")
    return int(found.width), int(found.height), lens


def read_depth(payload: bytes, info: bytes | None, depth_scale: float, robot_ns: Callable[[int], int | None]) -> ExternalDepth:
    """Return a depth frame from an Image and the newest CameraInfo of its camera.

    Args:
        payload: The Image in CDR: 16UC1 or mono16 [mm], or 32FC1 [m]; 0 and invalid numbers are no return.
        info: The CameraInfo in CDR; None before the first.
        depth_scale: Raw units per metre of the result.
        robot_ns: Converts a time of day [ns] to the robot's clock [ns]; returns None while that is unknown.

    Raises:
        CdrError: One of them is malformed or missing, or they do not fit each other.
    """
    if len(payload) > 4 * _MOST_PIXELS + _HEADER_BYTES:
        raise CdrError(f"{IMAGE}: at most {_MOST_PIXELS} pixels expected, found {len(payload)} bytes")
    if info is None:
        raise CdrError(f"{CAMERA_INFO}: one expected on the topic next to that of the image, found none yet")
    found = decode(IMAGE, payload)
    kind = _ENCODINGS.get(found.encoding)
    if kind is None:
        raise CdrError(f"{IMAGE}: encoding {', '.join(_ENCODINGS)} expected, found {found.encoding!r:.80}")
    width, height, lens = read_info(info)
    if (found.width, found.height) != (width, height):
        raise CdrError(f"{IMAGE}: {width}x{height} as in its CameraInfo expected, found {found.width}x{found.height}")
    item = np.dtype((">" if found.is_bigendian else "<") + kind)
    row = width * item.itemsize
    data = np.asarray(found.data, dtype=np.uint8)
    if not 0 < width * height <= _MOST_PIXELS or found.step < row or data.size != found.step * height:
        raise CdrError(f"{IMAGE}: {height} rows of {row} bytes expected, found {data.size} bytes in rows of {found.step}")
    rows = np.ascontiguousarray(data.reshape(height, found.step)[:, :row])
    values = rows.view(item)
    at_ns = robot_ns(found.header.stamp.sec * 1_000_000_000 + found.header.stamp.nanosec)
    if at_ns is None or at_ns < 0:
        raise CdrError(
            f"{IMAGE}: a stamp since the robot's start expected, found {found.header.stamp.sec} s; the robot must run"
        )
    if kind == "u2" and depth_scale == _MM_PER_M:
        return ExternalDepth(at_ns, values.astype(np.uint16), depth_scale, *lens)
    return ExternalDepth(at_ns, _raw(values / (_MM_PER_M if kind == "u2" else 1.0), depth_scale), depth_scale, *lens)


def _raw(metres: NDArray[np.floating], depth_scale: float) -> NDArray[np.uint16]:
    """Return depths in raw units; 0 for those that are invalid or do not fit."""
    with np.errstate(invalid="ignore", over="ignore"):
        raw = np.rint(metres * depth_scale)
        return np.where((raw > 0) & (raw <= np.iinfo(np.uint16).max), raw, 0).astype(np.uint16)
