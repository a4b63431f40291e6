"""Message types have the hashes that ROS publishes, and only exact messages are decoded."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from sextant.deploy.ros2 import message_types as ros
from sextant.deploy.ros2.bridge import LATCHED, PICTURES, PUBLISHED, SUBSCRIBED, TWIST, TWIST_STAMPED
from sextant.deploy.ros2.message_types import CdrError, decode, encode, type_hash

# As rosidl generates them, from published packages of Jazzy and Kilted. Some come from packages that refer to these types and
# contain the expected hashes. That of String is also in the design of rmw_zenoh.
PUBLISHED_HASHES = {
    "builtin_interfaces/msg/Time": "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "std_msgs/msg/Header": "f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "std_msgs/msg/MultiArrayLayout": "4c66e6f78e740ac103a94cf63259f968e48c617e7699e829b63c21a5cb50dac6",
    "std_msgs/msg/Float32MultiArray": "0599f6f85b4bfca379873a0b4375a0aca022156bd2d7021275d116ed1fa8bfe0",
    "geometry_msgs/msg/Pose": "d501954e9476cea2996984e812054b68026ae0bfae789d9a10b23daf35cc90fa",
    "geometry_msgs/msg/TransformStamped": "0a241f87d04668d94099cbb5ba11691d5ad32c2f29682e4eb5653424bd275206",
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "geometry_msgs/msg/TwistStamped": "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "sensor_msgs/msg/CompressedImage": "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "grid_map_msgs/msg/GridMapInfo": "0a36d6b5bc9af8463d1d5a5008ef9fcac0c1373ba090f80c3594e47cc565b745",
    "grid_map_msgs/msg/GridMap": "343b0e72887541beda6b035cc053f2d6fffaad9d6dcb2773c15a808dfca31fde",
}
IN_USE = sorted({kind for _, kind, _ in (*PUBLISHED, *LATCHED, *PICTURES, *SUBSCRIBED)})
TWIST_MESSAGE = ros.Twist(ros.Vector3(0.1, -0.2, 0.0), ros.Vector3(0.0, 0.0, 0.3))
EXAMPLES = {TWIST: TWIST_MESSAGE, TWIST_STAMPED: ros.TwistStamped(ros.Header(ros.Time(1, 2), "base_link"), TWIST_MESSAGE)}


@pytest.mark.parametrize("kind", PUBLISHED_HASHES)
def test_type_hash_matches_published_hash(kind: str) -> None:
    assert type_hash(kind) == f"RIHS01_{PUBLISHED_HASHES[kind]}"


@pytest.mark.parametrize("release", [Stores.ROS2_KILTED, Stores.ROS2_LYRICAL], ids=lambda release: release.value)
@pytest.mark.parametrize("kind", [kind for kind in IN_USE if not kind.startswith("grid_map_msgs")])
def test_type_hash_is_the_same_in_later_releases(kind: str, release: Stores) -> None:
    assert type_hash(kind) == get_typestore(release).hash_rihs01(kind)


@pytest.mark.parametrize("kind", EXAMPLES)
@pytest.mark.parametrize("padding", range(4))
def test_decoder_reads_encoded_message(kind: str, padding: int) -> None:
    assert decode(kind, encode(kind, EXAMPLES[kind]) + bytes(padding)) == EXAMPLES[kind]


def test_decoder_reads_big_endian_message() -> None:
    assert decode(TWIST, b"\0\0\0\0" + np.array([0.1, -0.2, 0.0, 0.0, 0.0, 0.3], ">f8").tobytes()) == TWIST_MESSAGE


@pytest.mark.parametrize("kind", EXAMPLES)
def test_truncated_or_overlong_message_is_refused(kind: str) -> None:
    frame = encode(kind, EXAMPLES[kind])
    for wrong in (*(frame[:length] for length in range(len(frame))), frame + bytes(4)):
        with pytest.raises(CdrError, match=f"{kind}: a message in plain CDR expected, found (nothing|{len(wrong)} bytes)"):
            decode(kind, wrong)


@given(st.sampled_from(IN_USE), st.binary(max_size=200))
@settings(max_examples=150, deadline=None)
def test_random_bytes_decode_or_raise_cdr_error(kind: str, data: bytes) -> None:
    for head in (b"", b"\0\1\0\0", b"\0\0\0\0"):
        try:
            decode(kind, head + data)
        except CdrError as error:
            assert str(error).startswith(f"{kind}: ")  # noqa: PT017


def test_excessive_sequence_length_is_refused() -> None:
    for kind in ("tf2_msgs/msg/TFMessage", "std_msgs/msg/String"):
        with pytest.raises(CdrError, match=r"Invalid (sequence|string) length"):
            decode(kind, b"\0\1\0\0" + b"\xff\xff\xff\xff")
