"""Depth images of ROS as frames for the robot: values, time, and why they are refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.deploy.ros2 import message_types as ros
from sextant.deploy.ros2.bridge import TWIST
from sextant.deploy.ros2.depth_images import MAX_INFO_BYTES, info_topic, read_depth, read_info
from sextant.deploy.ros2.message_types import CdrError, encode
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ExternalDepth
from tests.support.ros_images import LENS, MM, WALL, image, info

S = 1_000_000_000


def robot_ns(at_ns: int) -> int:
    return at_ns - WALL


def read(payload: bytes, about: bytes | None = None, depth_scale: float = 1000.0) -> ExternalDepth:
    return read_depth(payload, info() if about is None else about, depth_scale, robot_ns)


def test_millimetres_pass_unchanged_with_lens_and_robot_time() -> None:
    found = read(image())
    np.testing.assert_array_equal(found.depth, MM)
    assert (found.fx, found.fy, found.cx, found.cy) == LENS
    assert found.depth_scale == 1000.0
    assert found.stamp_ns == 7 * S
    assert codec.decode(codec.encode(found), ExternalDepth, topics.EXTERNAL_DEPTH.max_bytes)[0].stamp_ns == 7 * S


@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize("big", [False, True])
def test_byte_order_and_padding_of_rows_are_those_of_the_image(padding: int, big: bool) -> None:
    np.testing.assert_array_equal(read(image(MM.astype(">u2" if big else "<u2"), padding=padding, big=big)).depth, MM)


def test_metres_become_raw_units_and_invalid_numbers_no_return() -> None:
    metres = np.array([[0.7, np.nan, np.inf, -np.inf], [-1.0, 0.0, 1e30, 0.0004]], np.float32)
    np.testing.assert_array_equal(read(image(metres, "32FC1")).depth, [[700, 0, 0, 0], [0, 0, 0, 0]])
    np.testing.assert_array_equal(read(image(metres, "32FC1"), depth_scale=10000.0).depth, [[7000, 0, 0, 0], [0, 0, 0, 4]])
    np.testing.assert_array_equal(read(image(), depth_scale=10000.0).depth, [[0, 7000, 0, 10], [5000, 5010, 5020, 5030]])


def test_camera_info_is_on_the_topic_next_to_the_image() -> None:
    assert info_topic("/camera/depth/image_rect_raw") == "/camera/depth/camera_info"
    assert info_topic("depth") == "camera_info"


@pytest.mark.parametrize(
    ("payload", "about", "words"),
    [
        (image(encoding="rgb8"), info(), "encoding 16UC1, mono16, 32FC1 expected, found 'rgb8'"),
        (image(), info(width=8), "8x2 as in its CameraInfo expected, found 4x2"),
        (image(step=9), info(), "2 rows of 8 bytes expected, found 16 bytes in rows of 9"),
        (image(step=4), info(), "2 rows of 8 bytes expected, found 16 bytes in rows of 4"),
        (image(encoding="32FC1"), info(), "2 rows of 16 bytes expected"),
        (image(np.zeros((0, 4), np.uint16)), info(height=0), "0 rows of 8 bytes expected"),
        (image(stamp_ns=0), info(), "a stamp since the robot's start expected, found 0 s"),
        (image(), info(lens=(0.0, 1.0, 1.0, 1.0)), "finite focal lengths above 0 expected"),
        (image(), info(lens=(np.nan, 1.0, 1.0, 1.0)), "finite focal lengths above 0 expected"),
        (image(), bytes(MAX_INFO_BYTES + 1), "at most 8192 bytes expected, found 8193"),
        (encode(TWIST, ros.Twist(ros.Vector3(0.0, 0.0, 0.0), ros.Vector3(0.0, 0.0, 0.0))), info(), "a message in plain CDR"),
        (bytes(40_000_000), info(), "pixels expected, found 40000000 bytes"),
    ],
)
def test_wrong_image_is_refused_with_the_reason(payload: bytes, about: bytes, words: str) -> None:
    with pytest.raises(CdrError) as refused:
        read(payload, about)
    assert words in str(refused.value)


def test_image_without_camera_info_or_robot_is_refused() -> None:
    with pytest.raises(CdrError, match="one expected on the topic next to that of the image, found none yet"):
        read_depth(image(), None, 1000.0, robot_ns)
    with pytest.raises(CdrError, match="the robot must run"):
        read_depth(image(), info(), 1000.0, lambda _: None)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=300), st.booleans())
def test_fuzzed_image_is_a_frame_or_refused(data: bytes, of_info: bool) -> None:
    good = info() if of_info else image()
    for broken in (data, good[:4] + data, good[: max(0, len(good) - len(data))] + data):
        try:
            found = read(image(), broken) if of_info else read(broken)
        except CdrError:
            continue
        codec.decode(codec.encode(found), ExternalDepth, topics.EXTERNAL_DEPTH.max_bytes)


def test_info_has_size_and_lens() -> None:
    assert read_info(info()) == (4, 2, LENS)
