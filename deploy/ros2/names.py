"""Keys of rmw_zenoh: message keys, liveliness tokens and message attachments.

Source: ros2/rmw_zenoh, docs/design.md (rolling) and `rmw_zenoh_cpp/src/detail/`: liveliness_utils.cpp at commit 3411fde,
attachment_helpers.cpp at commit 534747d; the same in Jazzy, Kilted and Rolling.
"""

import re
import struct
from dataclasses import dataclass
from typing import Literal

import xxhash

from sextant.deploy.ros2.message_types import type_hash

Kind = Literal["MP", "MS"]  # a publisher, a subscription
_TRANSIENT_LOCAL = "1"  # durability in a token; empty for volatile, which is the default
_ATTACHMENT = struct.Struct("<qqB16s")  # number, time, length of the gid, gid
_NAME = r"[A-Za-z_]\w*"
_NAMESPACE = re.compile(rf"/|(/{_NAME})+", re.ASCII)


@dataclass(frozen=True, slots=True)
class Node:
    """A node of a ROS graph."""

    domain: int  # ROS_DOMAIN_ID
    session: str  # id of the node's Zenoh session
    name: str
    namespace: str = "/"

    def __post_init__(self) -> None:
        if not 0 <= self.domain <= 232:
            raise ValueError(f"a ROS domain from 0 to 232 expected, found {self.domain}")
        if not _NAMESPACE.fullmatch(self.namespace):
            raise ValueError(f"a ROS namespace like / or /robot_1 expected, found {self.namespace!r}")
        if not re.fullmatch(_NAME, self.name, re.ASCII):
            raise ValueError(f"a ROS node name of letters, digits and _ expected, found {self.name!r}")

    def full(self, topic: str) -> str:
        """Return a topic's full name: names without leading / are in the namespace."""
        return topic if topic.startswith("/") else f"{self.namespace.rstrip('/')}/{topic}"

    def key(self, topic: str, kind: str) -> str:
        """Return the key of a topic's messages."""
        return f"{self.domain}/{self.full(topic)[1:]}/{dds_name(kind)}/{type_hash(kind)}"

    def token(self) -> str:
        """Return the liveliness token that announces the node."""
        return f"@ros2_lv/{self.domain}/{self.session}/0/0/NN/{self._place()}"

    def endpoint_token(self, entity: int, end: Kind, topic: str, kind: str, depth: int, transient_local: bool = False) -> str:
        """Return the liveliness token that announces a publisher or subscription.

        Its QoS is reliable, keep last, and volatile or transient local.

        Args:
            entity: Its number within the session, from 1 on.
            end: Publisher or subscription.
            topic: Its topic.
            kind: Message type, e.g. "sensor_msgs/msg/JointState".
            depth: Messages that it keeps.
            transient_local: Whether later subscribers get the kept messages.
        """
        durability = _TRANSIENT_LOCAL if transient_local else ""
        about = f"{_mangled(self.full(topic))}/{dds_name(kind)}/{type_hash(kind)}/:{durability}:,{depth}:,:,:,,"
        return f"@ros2_lv/{self.domain}/{self.session}/0/{entity}/{end}/{self._place()}/{about}"

    def _place(self) -> str:
        return f"%/{_mangled(self.namespace)}/{self.name}"  # first the enclave, which is the root


def check_topic(topic: str) -> None:
    """Raise a ValueError if a text is no name of a topic."""
    if not re.fullmatch(rf"/?{_NAME}(/{_NAME})*", topic, re.ASCII):
        raise ValueError(f"a topic like /odometry/filtered expected, found {topic!r}")


def dds_name(kind: str) -> str:
    """Return a message type's name in DDS."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def gid(token: str) -> bytes:
    """Return the id (16 bytes) of an endpoint: the hash of its liveliness token."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def attachment(number: int, at_ns: int, source: bytes) -> bytes:
    """Return the attachment of a message.

    Args:
        number: Of the message, from 1 on.
        at_ns: [ns] time of day at which it was sent.
        source: Id of its publisher.
    """
    return _ATTACHMENT.pack(number, at_ns, len(source), source)
