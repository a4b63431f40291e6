"""Types and their hashes equal those that ROS publishes."""

import pytest
from rosbags.typesys import Stores, get_typestore

from sextant.deploy.ros2 import interface
from sextant.deploy.ros2.definitions import DEFINITIONS
from sextant.deploy.ros2.interface import fields, type_hash

# As rosidl generates them, from published packages of Jazzy and Kilted. Some come from packages that refer to these types and
# contain the expected hashes. That of String is also in the design of rmw_zenoh.
PUBLISHED = {
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
STORES = {store: get_typestore(store) for store in (Stores.ROS2_JAZZY, Stores.ROS2_KILTED)}


@pytest.mark.parametrize("name", PUBLISHED)
def test_type_hash_matches_published_hash(name: str) -> None:
    assert type_hash(name) == f"RIHS01_{PUBLISHED[name]}"


@pytest.mark.parametrize("store", STORES, ids=lambda store: store.value)
@pytest.mark.parametrize("name", [name for name in DEFINITIONS if not name.startswith("grid_map_msgs")])
def test_fields_and_hash_match_rosbags(name: str, store: Stores) -> None:
    peer = STORES[store]
    assert [field.name for field in fields(name)] == [name for name, _ in peer.fielddefs[name][1]]
    assert type_hash(name) == peer.hash_rihs01(name)


def test_all_referenced_types_are_defined() -> None:
    for name in DEFINITIONS:
        assert fields(name)
        assert all(not field.nested or field.base in DEFINITIONS for field in fields(name)), name


@pytest.mark.parametrize("line", ["float64", "float64 X", "float64[ x", "int32 x = 3", "float64[<] x", ""])
def test_invalid_field_line_is_refused(line: str) -> None:
    with pytest.raises(ValueError, match="a type and a name expected"):
        interface._field(line, "a/msg/B")


def test_all_array_kinds_are_parsed() -> None:
    found = [interface._field(line, "a/msg/B") for line in ("int8 x", "int8[3] x", "int8[] x", "int8[<=4] x", "C[] x", "d/E x")]
    assert [(field.base, field.array, field.length) for field in found] == [
        ("int8", "", 0),
        ("int8", "fixed", 3),
        ("int8", "sequence", 0),
        ("int8", "bounded", 4),
        ("a/msg/C", "sequence", 0),
        ("d/msg/E", "", 0),
    ]


def test_undefined_message_type_is_named() -> None:
    with pytest.raises(ValueError, match="found 'geometry_msgs/msg/Wrench'"):
        fields("geometry_msgs/msg/Wrench")
