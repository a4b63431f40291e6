"""ROS 2 bridge: a service that republishes Sextant's state and drives by Twists."""

import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np

from sextant.deploy.ros2 import converted
from sextant.deploy.ros2 import message_types as ros
from sextant.deploy.ros2.clock import TimeOfDay
from sextant.deploy.ros2.depth_images import CAMERA_INFO, IMAGE, info_topic, read_depth
from sextant.deploy.ros2.lead import Lead
from sextant.deploy.ros2.message_types import CdrError, TwistStamped, decode, encode
from sextant.deploy.ros2.names import Node, attachment, gid
from sextant.shared.geometry import Array, inverse, rotation_from_quaternion, transform
from sextant.shared.robot.links import BASE, CAMERA
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.urdf import urdf
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ExternalPose, Message, Odometry, Tick

RATE_HZ = 50.0
MAX_TWIST_BYTES = 1024  # of a Twist with a header whose frame has a long name
_WORD_S = 1.0  # [s] for which the actuator's last message is valid
_WAITING = 64  # most Twists, or poses, that may wait to be read

MAX_ODOMETRY_BYTES = 2048
ODOMETRY = "nav_msgs/msg/Odometry"
_MAX_NUMBER = 1e9  # [m] and [m^2] of a position and its covariance
_UNIT_TOLERANCE = 1e-3  # [1] of the length of a quaternion
_VARIANCE_TOLERANCE = 1e-9  # [m^2] and [rad^2] rounding error of a covariance
TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
# Topic, message type, and history depth of the QoS profile.
PUBLISHED = (
    ("odom", "nav_msgs/msg/Odometry", 10),
    ("pose", "geometry_msgs/msg/PoseWithCovarianceStamped", 10),
    ("/tf", "tf2_msgs/msg/TFMessage", 100),
    ("joint_states", "sensor_msgs/msg/JointState", 10),
    ("terrain", "grid_map_msgs/msg/GridMap", 1),
    ("terrain_points", "sensor_msgs/msg/PointCloud2", 1),
)
# Published once, and kept for later subscribers (transient local).
LATCHED = (("robot_description", "std_msgs/msg/String", 1), ("/tf_static", "tf2_msgs/msg/TFMessage", 1))
PICTURES = (
    ("camera/depth_preview/compressed", "sensor_msgs/msg/CompressedImage", 1),
    ("camera/color_preview/compressed", "sensor_msgs/msg/CompressedImage", 1),
)
SUBSCRIBED = (("cmd_vel", TWIST, 10), ("cmd_vel_stamped", TWIST_STAMPED, 10))


class Publisher(Protocol):
    """Publishes bytes on a key of ROS."""

    def send(self, payload: bytes, attachment: bytes) -> None:
        """Publish; never blocks."""
        ...

    def wanted(self) -> bool:
        """Return whether there is a subscriber."""
        ...


class Wire(Protocol):
    """The Zenoh session for ROS nodes; implemented in `sextant.shared.wire.transport`."""

    @property
    def id(self) -> str:
        """Id of the session."""
        ...

    def announce(self, token: str) -> None:
        """Declare a liveliness token for the lifetime of the session."""
        ...

    def publisher(self, key: str, kept: int = 0) -> Publisher:
        """Declare a publisher; `kept` of its newest payloads are kept for later subscribers."""
        ...

    def subscribe(self, key: str, receive: Callable[[bytes], None]) -> None:
        """Call `receive` with each payload of a key, from a thread of the session."""
        ...


class Outlet:
    """One published topic."""

    def __init__(
        self,
        wire: Wire,
        node: Node,
        entity: int,
        topic: str,
        kind: str,
        depth: int,
        wall: Callable[[], int],
        latched: bool = False,
    ):
        """Declare the topic, as publisher number `entity`; a latched one keeps its messages for later subscribers."""
        token = node.endpoint_token(entity, "MP", topic, kind, depth, latched)
        self._publisher = wire.publisher(node.key(topic, kind), depth if latched else 0)
        self._kind, self._gid, self._wall = kind, gid(token), wall
        self._sent = 0
        wire.announce(token)

    def wanted(self) -> bool:
        """Return whether there is a subscriber; otherwise no message need be made."""
        return self._publisher.wanted()

    def publish(self, message: object) -> None:
        """Publish one message."""
        self._sent += 1
        self._publisher.send(encode(self._kind, message), attachment(self._sent, self._wall(), self._gid))


class Bridge:
    """ROS 2 node that publishes poses and maps, and forwards Twists."""

    name = "ros2"
    subscribes: tuple[AnyTopic, ...] = (
        topics.ODOMETRY,
        topics.ACTUATOR_STATE,
        topics.BODY_POSE,
        topics.TERRAIN,
        topics.PREVIEW,
    )
    publishes: tuple[AnyTopic, ...] = (topics.VELOCITY, topics.MODE, topics.EXTERNAL_POSE, topics.EXTERNAL_DEPTH)

    def __init__(
        self,
        profile: RobotProfile,
        wire: Wire,
        node: Node,
        lead: Lead,
        wall: Callable[[], int],
        say: Callable[[str], None] = lambda _words: None,
        pictures: bool = False,
        pose_from: str = "",
        depth_from: str = "",
    ):
        """Announce the node.

        Args:
            profile: Of the robot.
            wire: Session for the ROS nodes.
            node: Identity of the node.
            lead: Converts Twists to velocity commands.
            wall: Time of day [ns].
            say: Receives log lines.
            pictures: Also forward the camera previews, which are made only for subscribers.
            pose_from: Topic of odometry that is forwarded to the robot as its external pose; empty: none.
            depth_from: Topic of depth images that are forwarded to the robot's camera process; empty: none.
        """
        self.trigger = Every.hz(RATE_HZ)
        self.stages = Stages()
        self.refused = 0  # invalid Twists and poses
        self.last_refusal = ""
        if not pictures:
            self.subscribes = tuple(topic for topic in self.subscribes if topic is not topics.PREVIEW)
        self._profile = profile
        self._lead, self._wall, self._tell = lead, wall, say
        self._time = TimeOfDay()
        self._before: Odometry | None = None
        unused = {topics.EXTERNAL_POSE: not pose_from, topics.EXTERNAL_DEPTH: not depth_from}
        self.publishes = tuple(topic for topic in self.publishes if not unused.get(topic, False))
        self._poses: deque[bytes] = deque(maxlen=_WAITING)
        self._depth: deque[bytes] = deque(maxlen=1)  # newest depth image, and the CameraInfo of its camera
        self._info: deque[bytes] = deque(maxlen=1)
        self._twists: deque[tuple[str, bytes]] = deque(maxlen=_WAITING)
        wire.announce(node.token())
        published = (*PUBLISHED, *(PICTURES if pictures else ()))
        self._outlets = {
            topic: Outlet(wire, node, entity, topic, kind, depth, wall)
            for entity, (topic, kind, depth) in enumerate(published, 1)
        }
        self._latched = [  # a publisher that is dropped keeps nothing
            Outlet(wire, node, entity, topic, kind, depth, wall, latched=True)
            for entity, (topic, kind, depth) in enumerate(LATCHED, 1 + len(published))
        ]
        messages = ros.String(urdf(profile)), converted.fixed_transforms(profile, wall())
        for outlet, message in zip(self._latched, messages, strict=True):
            outlet.publish(message)
        for entity, (topic, kind, depth) in enumerate(SUBSCRIBED, 1 + len(published) + len(LATCHED)):
            wire.subscribe(node.key(topic, kind), self._receiver(kind))
            wire.announce(node.endpoint_token(entity, "MS", topic, kind, depth))
        others = (
            *([(pose_from, ODOMETRY, self._poses)] if pose_from else []),
            *([(depth_from, IMAGE, self._depth), (info_topic(depth_from), CAMERA_INFO, self._info)] if depth_from else []),
        )
        for entity, (topic, kind, waiting) in enumerate(others, 1 + len(published) + len(LATCHED) + len(SUBSCRIBED)):
            wire.subscribe(node.key(topic, kind), waiting.append)
            wire.announce(node.endpoint_token(entity, "MS", topic, kind, 10 if kind == ODOMETRY else 1))

    def status(self) -> str:
        """Return whether a Twist drives the robot, and the number of refused Twists."""
        words = "a Twist drives the robot" if self._lead.leading else "publishing the robot's state, waiting for cmd_vel"
        return f"{words}; {self.refused} messages refused: {self.last_refusal}" if self.refused else words

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Run one cycle: forward messages in both directions."""
        now = tick.stamp_ns
        self._pass_odometry(inbox)
        self._pass_state(inbox)
        self._pass_pose(inbox)
        self._pass_terrain(inbox)
        if topics.PREVIEW in self.subscribes:
            self._pass_pictures(inbox)
        while self._twists:
            self._take_twist(*self._twists.popleft(), now)
        while self._poses:
            yield from self._take_pose(self._poses.popleft())
        if self._depth:
            yield from self._take_depth(self._depth.pop())
        yield from self._lead.beat(now, inbox.fresh(topics.ACTUATOR_STATE, _WORD_S))
        for words in self._lead.drain_words():
            self._tell(words)

    def release(self, now_ns: int) -> list[Message]:
        """Return the messages to send before the bridge ends."""
        return self._lead.release(now_ns)

    # ---------------------------------------------------------------------------------------------------------- to ROS

    def _pass_odometry(self, inbox: Inbox) -> None:
        for message in inbox.drain(topics.ODOMETRY):
            at_ns = self._at(message)
            self._publish("odom", converted.odometry, message, self._before, at_ns)
            self._publish("/tf", converted.transforms, at_ns, (converted.ODOM, BASE, message.T_odom_body))
            self._before = message

    def _pass_state(self, inbox: Inbox) -> None:
        for message in inbox.drain(topics.ACTUATOR_STATE):
            at_ns = self._at(message)
            self._publish("joint_states", converted.joint_state, message, at_ns)
            self._publish("/tf", converted.leg_transforms, self._profile, message.q, at_ns)

    def _pass_pose(self, inbox: Inbox) -> None:
        for message in inbox.drain(topics.BODY_POSE):
            at_ns = self._at(message)
            correction = (converted.MAP, converted.ODOM, message.T_world_odom)
            self._publish("pose", converted.pose, message, at_ns)
            self._publish("/tf", converted.transforms, at_ns, correction)

    def _pass_terrain(self, inbox: Inbox) -> None:
        for message in inbox.drain(topics.TERRAIN):
            with self.stages("terrain"):
                self._publish("terrain", converted.grid_map, message, self._at(message))
                self._publish("terrain_points", converted.points, message, self._at(message))

    def _pass_pictures(self, inbox: Inbox) -> None:
        for message in inbox.drain(topics.PREVIEW):
            for (topic, *_), data in zip(PICTURES, (message.depth_jpeg, message.color_jpeg), strict=True):
                if len(data):
                    self._publish(topic, converted.jpeg, data, self._at(message))

    def _at(self, message: Message) -> int:
        """Return the stamp of a message as time of day [ns]."""
        self._time.learn(message.stamp_ns, self._wall())
        return self._time.of(message.stamp_ns)

    def _publish(self, topic: str, make: Callable[..., object], *arguments: Any) -> None:
        outlet = self._outlets[topic]
        if outlet.wanted():
            outlet.publish(make(*arguments))

    # -------------------------------------------------------------------------------------------------------- from ROS

    def _receiver(self, kind: str) -> Callable[[bytes], None]:
        return lambda payload: self._twists.append((kind, payload))

    def _take_twist(self, kind: str, payload: bytes, now_ns: int) -> None:
        try:
            velocity, yaw_rate = read_twist(kind, payload)
        except CdrError as error:
            self._refuse("Twist", error)
            return
        self._lead.twist(velocity, yaw_rate, now_ns)

    def _take_pose(self, payload: bytes) -> Iterator[Message]:
        try:
            yield read_pose(payload, self._time.robot_ns, self._profile.camera.T_body_camera)
        except CdrError as error:
            self._refuse("pose", error)

    def _take_depth(self, payload: bytes) -> Iterator[Message]:
        info = self._info[0] if self._info else None
        try:
            with self.stages("depth"):
                frame = read_depth(payload, info, self._profile.camera.sensor.depth_scale, self._time.robot_ns)
            yield frame
        except CdrError as error:
            self._refuse("depth image", error)

    def _refuse(self, what: str, error: CdrError) -> None:
        self.refused += 1
        if str(error) != self.last_refusal:
            self.last_refusal = str(error)
            self._tell(f"{what} refused: {error}")


def read_twist(kind: str, payload: bytes) -> tuple[Array, float]:
    """Return velocity (2,) [m/s] {body} and yaw rate [rad/s] of a Twist.

    `kind` may be the stamped type. The other components are ignored.

    Raises:
        CdrError: It is malformed or not finite.
    """
    if len(payload) > MAX_TWIST_BYTES:
        raise CdrError(f"{kind}: at most {MAX_TWIST_BYTES} bytes expected, found {len(payload)}")
    found = decode(kind, payload)
    twist = found.twist if isinstance(found, TwistStamped) else found
    linear, angular = ((part.x, part.y, part.z) for part in (twist.linear, twist.angular))
    if not all(map(math.isfinite, (*linear, *angular))):
        raise CdrError(f"{kind}: finite numbers expected, found linear {linear}, angular {angular}")
    return np.array(linear[:2]), angular[2]


def read_pose(payload: bytes, robot_ns: Callable[[int], int | None], T_body_camera: Array) -> ExternalPose:
    """Return the body pose of a nav_msgs/Odometry; its twist is ignored.

    Args:
        payload: The message in CDR.
        robot_ns: Converts a time of day [ns] to the robot's clock [ns]; returns None while that is unknown.
        T_body_camera: (4, 4) of the optical frame, for the pose of a camera.

    Raises:
        CdrError: It is malformed, not finite, of another frame, or its quaternion or covariance is wrong.
    """
    if len(payload) > MAX_ODOMETRY_BYTES:
        raise CdrError(f"{ODOMETRY}: at most {MAX_ODOMETRY_BYTES} bytes expected, found {len(payload)}")
    found = decode(ODOMETRY, payload)
    p, q = found.pose.pose.position, found.pose.pose.orientation
    place, wxyz = np.array([p.x, p.y, p.z]), np.array([q.w, q.x, q.y, q.z])
    covariance = np.asarray(found.pose.covariance, dtype=np.float64).reshape(6, 6)
    if not np.abs(np.concatenate([place, wxyz, covariance.ravel()])).max() <= _MAX_NUMBER:  # NaN, too
        raise CdrError(
            f"{ODOMETRY}: numbers up to {_MAX_NUMBER:g} expected, found {place}, {wxyz}, covariance {covariance[0]}..."
        )
    length = float(np.linalg.norm(wxyz))
    if abs(length - 1.0) > _UNIT_TOLERANCE:
        raise CdrError(f"{ODOMETRY}: a unit quaternion expected, found one of length {length:.3g}")
    T_child_body = {BASE: np.eye(4), CAMERA: inverse(T_body_camera)}.get(found.child_frame_id)
    if T_child_body is None:
        raise CdrError(f"{ODOMETRY}: child_frame_id {BASE!r} or {CAMERA!r} expected, found {found.child_frame_id!r:.80}")
    low, high = np.linalg.eigvalsh([(block + block.T) / 2 for block in (covariance[:3, :3], covariance[3:, 3:])])[:, [0, -1]].T
    if low.min() < -_VARIANCE_TOLERANCE:
        raise CdrError(f"{ODOMETRY}: a positive semidefinite covariance expected, found an eigenvalue of {low.min():.3g}")
    stamp = found.header.stamp
    at_ns = robot_ns(stamp.sec * 1_000_000_000 + stamp.nanosec)
    if at_ns is None or at_ns < 0:
        raise CdrError(f"{ODOMETRY}: a stamp since the robot's start expected, found {stamp.sec} s; the robot must run")
    T = transform(rotation_from_quaternion(wxyz / length), place) @ T_child_body
    return ExternalPose(at_ns, found.header.frame_id, T, *np.sqrt(np.maximum(high, 0.0)).tolist())
