"""The keys of rmw_zenoh: where a topic's messages travel, how nodes make themselves known, and what goes with each message.

Source: ros2/rmw_zenoh, docs/design.md (rolling) and `rmw_zenoh_cpp/src/detail/`: liveliness_utils.cpp at commit 3411fde,
attachment_helpers.cpp at commit 534747d; alike in Jazzy, Kilted and Rolling.
"""

import re
import struct
from dataclasses import dataclass
from typing import Literal

import xxhash

from sextant.deploy.ros2.interface import type_hash

Kind = Literal["MP", "MS"]  # a publisher, a subscription
_ATTACHMENT = struct.Struct("<qqB16s")  # number, time, length of what follows, gid
_NAME = r"[A-Za-z_]\w*"
_NAMESPACE = re.compile(rf"/|(/{_NAME})+", re.ASCII)


@dataclass(frozen=True, slots=True)
class Node:
    """One node of a ROS graph."""

    domain: int  # ROS_DOMAIN_ID
    session: str  # id of the Zenoh session that it lives in
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
        """Whole name of a topic: one that begins with / is itself, others stand in the namespace."""
        return topic if topic.startswith("/") else f"{self.namespace.rstrip('/')}/{topic}"

    def key(self, topic: str, kind: str) -> str:
        """Where the messages of a topic travel."""
        return f"{self.domain}/{self.full(topic)[1:]}/{dds_name(kind)}/{type_hash(kind)}"

    def token(self) -> str:
        """Makes the node known for as long as it is declared."""
        return f"@ros2_lv/{self.domain}/{self.session}/0/0/NN/{self._place()}"

    def endpoint_token(self, entity: int, end: Kind, topic: str, kind: str, depth: int) -> str:
        """Makes a publisher or a subscription known: reliable, volatile, keeping the last few.

        Args:
            entity: Its number within the session, from 1 on.
            end: What it is.
            topic: Its topic.
            kind: Message type, e.g. "sensor_msgs/msg/JointState".
            depth: Messages that it keeps.
        """
        about = f"{_mangled(self.full(topic))}/{dds_name(kind)}/{type_hash(kind)}/::,{depth}:,:,:,,"
        return f"@ros2_lv/{self.domain}/{self.session}/0/{entity}/{end}/{self._place()}/{about}"

    def _place(self) -> str:
        return f"%/{_mangled(self.namespace)}/{self.name}"  # the enclave, which is the root's, first


def dds_name(kind: str) -> str:
    """A message type as DDS calls it."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def gid(token: str) -> bytes:
    """Id of an endpoint, 16 bytes: the hash of the token that makes it known."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def attachment(number: int, at_ns: int, source: bytes) -> bytes:
    """What goes with a message.

    Args:
        number: Of the message, from 1 on.
        at_ns: [ns] time of day at which it was sent.
        source: Id of its publisher.
    """
    return _ATTACHMENT.pack(number, at_ns, len(source), source)
