"""Keys, tokens and attachments equal those of rmw_zenoh."""

import re

import pytest
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st

from sextant.deploy.ros2.message_types import type_hash
from sextant.deploy.ros2.names import Node, attachment, dds_name, gid

STRING = "std_msgs/msg/String"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_tokens_and_keys_match_rmw_zenoh_examples() -> None:
    listener = Node(2, "aac3178e146ba6f1fc6e6a4085e77f21", "listener")
    assert listener.token() == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    assert listener.endpoint_token(10, "MS", "chatter", STRING, 10) == (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/"
        f"std_msgs::msg::dds_::String_/{HASH}/::,10:,:,:,,"
    )
    talker = Node(2, "8b20917502ee955ac4476e0266340d5c", "talker")
    assert talker.endpoint_token(10, "MP", "/chatter", STRING, 7) == (
        f"@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{HASH}/::,7:,:,:,,"
    )
    latched = talker.endpoint_token(10, "MP", "/chatter", STRING, 7, transient_local=True)
    assert latched.endswith("/:1:,7:,:,:,,"), "durability 1 is transient local"
    assert listener.key("chatter", STRING) == f"2/chatter/std_msgs::msg::dds_::String_/{HASH}"


def test_namespace_prefixes_relative_names_and_tokens() -> None:
    node = Node(0, "1", "sextant", "/fleet/robot_1")
    assert node.full("odom") == "/fleet/robot_1/odom"
    assert node.full("/tf") == "/tf"
    assert node.key("camera/x", STRING).startswith("0/fleet/robot_1/camera/x/std_msgs::msg::dds_::String_/RIHS01_")
    assert node.token() == "@ros2_lv/0/1/0/0/NN/%/%fleet%robot_1/sextant"
    assert "/sextant/%fleet%robot_1%camera%x/" in node.endpoint_token(1, "MP", "camera/x", STRING, 1)


@pytest.mark.parametrize(
    ("domain", "name", "namespace", "words"),
    [
        (-1, "a", "/", "domain from 0 to 232"),
        (233, "a", "/", "found 233"),
        (0, "a b", "/", "node name"),
        (0, "a/b", "/", "node name"),
        (0, "", "/", "node name"),
        (0, "a", "robot", "namespace like"),
        (0, "a", "/robot/", "namespace like"),
        (0, "a", "/rob*t", "namespace like"),
        (0, "a", "", "namespace like"),
    ],
)
def test_invalid_domain_name_or_namespace_is_refused(domain: int, name: str, namespace: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Node(domain, "1", name, namespace)


@given(st.integers(1, 2**62), st.integers(0, 2**62), st.binary(min_size=16, max_size=16))
def test_attachment_decodes_with_zenoh_deserializer(number: int, at_ns: int, source: bytes) -> None:
    data = zenoh.ZBytes(attachment(number, at_ns, source))
    kinds = tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes]
    assert zenoh.ext.z_deserialize(kinds, data) == (number, at_ns, source)


def test_gid_is_hash_of_token() -> None:
    tokens = [Node(0, "1", "a").endpoint_token(n, "MP", "odom", STRING, 1) for n in (1, 2)]
    assert len({gid(token) for token in tokens}) == 2
    assert [len(gid(token)) for token in tokens] == [16, 16]
    # The 128-bit XXH3 of empty data, by its specification: the low half first.
    assert gid("") == (0x99AA06D3014798D86001C324468D497F).to_bytes(16, "little")


def test_keys_and_tokens_are_valid_key_expressions() -> None:
    node = Node(0, "1", "sextant", "/robot")
    for key in (node.key("odom", STRING), node.token(), node.endpoint_token(1, "MS", "odom", STRING, 10)):
        assert str(zenoh.KeyExpr(key)) == key
    assert dds_name("geometry_msgs/msg/Twist") == "geometry_msgs::msg::dds_::Twist_"
    assert re.fullmatch(r"RIHS01_[0-9a-f]{64}", type_hash(STRING))
