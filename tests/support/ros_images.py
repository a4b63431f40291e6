"""Depth images of ROS with their CameraInfo, in CDR."""

from typing import Any

import numpy as np

from sextant.deploy.ros2 import message_types as ros
from sextant.deploy.ros2.depth_images import CAMERA_INFO, IMAGE
from sextant.deploy.ros2.message_types import encode

S = 1_000_000_000
WALL = 1_700_000_000 * S
LENS = (58.5, 59.5, 3.5, 2.5)
MM = np.array([[0, 700, 65535, 1], [500, 501, 502, 503]], np.uint16)


def header(stamp_ns: int = WALL + 7 * S) -> ros.Header:
    return ros.Header(ros.Time(stamp_ns // S, stamp_ns % S), "camera_depth_optical_frame")


def image(values: Any = MM, encoding: str = "16UC1", padding: int = 0, **changes: Any) -> bytes:
    rows = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), values.shape[1] * values.itemsize)
    data = np.hstack([rows, np.full((len(rows), padding), 0xEE, np.uint8)])
    given_ = {"height": len(values), "width": values.shape[1], "step": data.shape[1], "big": False, "stamp_ns": WALL + 7 * S}
    given_ |= changes
    big, step = int(given_["big"]), given_["step"]
    return encode(
        IMAGE, ros.Image(header(given_["stamp_ns"]), given_["height"], given_["width"], encoding, big, step, data.ravel())
    )


def info(width: int = 4, height: int = 2, lens: tuple[float, ...] = LENS) -> bytes:
    fx, fy, cx, cy = lens
    k, r = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]), np.eye(3).ravel()
    p = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])
    roi = ros.RegionOfInterest(0, 0, 0, 0, False)
    return encode(CAMERA_INFO, ros.CameraInfo(header(), height, width, "plumb_bob", np.zeros(5), k, r, p, 0, 0, roi))
