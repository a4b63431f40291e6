"""The bridge between a simulated robot and simulated ROS nodes.

The nodes are connected by a wire in memory, and by Zenoh.
"""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.deploy import cli
from sextant.deploy.ros2 import message_types as ros
from sextant.deploy.ros2.bridge import (
    LATCHED,
    MAX_ODOMETRY_BYTES,
    MAX_TWIST_BYTES,
    ODOMETRY,
    PICTURES,
    PUBLISHED,
    SUBSCRIBED,
    TWIST,
    TWIST_STAMPED,
    Bridge,
    read_pose,
    read_twist,
)
from sextant.deploy.ros2.depth_images import CAMERA_INFO, IMAGE
from sextant.deploy.ros2.lead import Lead, Walk
from sextant.deploy.ros2.message_types import CdrError, decode, encode, type_hash
from sextant.deploy.ros2.names import Node, dds_name, gid
from sextant.deploy.terminal.arguments import parse
from sextant.shared.geometry import Array, apply, from_xyz_rpy, quaternion_from_rotation, rotation_from_quaternion, transform
from sextant.shared.robot.kinematics import leg_forward
from sextant.shared.robot.links import fixed_joints, hinges
from sextant.shared.robot.profile import LEGS
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.urdf import urdf
from sextant.shared.runtime.service import AnyTopic, Inbox
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.wire import codec, topics
from sextant.shared.wire.codec import Timing
from sextant.shared.wire.messages import (
    BodyPose,
    ExternalDepth,
    ExternalPose,
    Message,
    Mode,
    ModeCommand,
    Odometry,
    Preview,
    TerrainMap,
    Tick,
    VelocityCommand,
)
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, ForeignLink, Router, ZenohLink
from tests.support.commands import eventually
from tests.support.ros_images import MM, image, info
from tests.support.states import actuator_state

MS, S = 1_000_000, 1_000_000_000
PROFILE = load_profile("phantomx_mk2")
WALL = 1_700_000_000 * S
PLACE = from_xyz_rpy((1.0, 2.0, 0.5), (0.1, -0.2, 2.0))


def twist(x: float = 0.05, turn: float = 0.1) -> ros.Twist:
    return ros.Twist(ros.Vector3(x, 0.0, 0.0), ros.Vector3(0.0, 0.0, turn))


def stamped(found: ros.Twist) -> ros.TwistStamped:
    return ros.TwistStamped(ros.Header(ros.Time(1, 2), "base_link"), found)


def robot_messages(now_ns: int) -> list[Message]:
    """Return one message of each type from a standing robot."""
    height = np.full((6, 4), 0.02, np.float32)
    none = np.zeros((6, 4), dtype=bool)
    return [
        Odometry(now_ns, from_xyz_rpy((0.5, 0.0, 0.11), (0, 0, 0)), 1.0, 0.0, ~np.zeros(6, dtype=bool), True),
        actuator_state(PROFILE, stamp_ns=now_ns, mode=Mode.HOLD, lease="", q=np.full((6, 3), 0.25)),
        BodyPose(now_ns, np.eye(4), from_xyz_rpy((0.1, 0.0, 0.0), (0, 0, 0.2)), np.eye(6), 1.0, True, "", np.zeros((0, 6))),
        TerrainMap(now_ns, 0.01, np.zeros(2), height, height, height, none, none.astype(np.int8)),
        Preview(now_ns, np.frombuffer(b"depth", np.uint8), np.zeros(0, np.uint8)),
    ]


def odometry(T: Array = PLACE, **changes: Any) -> bytes:
    """Encode the pose (4, 4) of base_link in `slam` as a nav_msgs/Odometry of the robot's start plus 100 s."""
    w, x, y, z = quaternion_from_rotation(T[:3, :3]).tolist()
    given = {"stamp_ns": WALL + 100 * S, "child": "base_link", "covariance": np.zeros(36), "wxyz": (w, x, y, z), **changes}
    w, x, y, z = given["wxyz"]
    header = ros.Header(ros.Time(given["stamp_ns"] // S, given["stamp_ns"] % S), "slam")
    pose = ros.PoseWithCovariance(ros.Pose(ros.Point(*T[:3, 3].tolist()), ros.Quaternion(x, y, z, w)), given["covariance"])
    none = ros.Vector3(0.0, 0.0, 0.0)
    twist_ = ros.TwistWithCovariance(ros.Twist(none, none), np.zeros(36))
    return encode(ODOMETRY, ros.Odometry(header, given["child"], pose, twist_))


# ------------------------------------------------------------------------------------------------------ a wire in memory


@dataclass
class Played:
    """A publisher that stores sent messages."""

    asked: bool = True
    kept: int = 0
    sent: list[tuple[bytes, bytes]] = field(default_factory=list)

    def send(self, payload: bytes, attachment: bytes) -> None:
        self.sent.append((payload, attachment))

    def wanted(self) -> bool:
        return self.asked


@dataclass
class MemoryWire:
    """A wire on which the test acts as the ROS nodes."""

    id: str = "abc"
    asked: bool = True
    tokens: list[str] = field(default_factory=list)
    publishers: dict[str, Played] = field(default_factory=dict)
    receivers: dict[str, Callable[[bytes], None]] = field(default_factory=dict)

    def announce(self, token: str) -> None:
        self.tokens.append(token)

    def publisher(self, key: str, kept: int = 0) -> Played:
        return self.publishers.setdefault(key, Played(self.asked, kept))

    def subscribe(self, key: str, receive: Callable[[bytes], None]) -> None:
        self.receivers[key] = receive


class Bench:
    """A bridge in single beats, with a simulated robot and simulated ROS nodes."""

    def __init__(self, asked: bool = True, pictures: bool = False, pose_from: str = "", depth_from: str = "") -> None:
        self.wire, self.node, self.words = MemoryWire(asked=asked), Node(3, "abc", "sextant"), []
        self.words: list[str] = []
        self.now = 100 * S
        lead = Lead(Walk(0.1, 0.11))
        self.bridge = Bridge(
            PROFILE, self.wire, self.node, lead, lambda: WALL + self.now, self.words.append, pictures, pose_from, depth_from
        )
        self.inbox = Inbox(self.bridge.subscribes, self.bridge.stages)

    def hear(self, *messages: Message) -> None:
        for message in messages:
            topic = topics.OF_TYPE[type(message)]
            if topic in self.bridge.subscribes:
                self.inbox.receive(topic, codec.encode(message, Timing(self.now, self.now)), self.now)

    def beat(self) -> list[Message]:
        self.now += 20 * MS
        self.inbox.now_ns = self.now
        return list(self.bridge.step(Tick(self.now), self.inbox))

    def publish(self, kind: str, payload: bytes) -> None:
        topic = next(topic for topic, known, _ in SUBSCRIBED if known == kind)
        self.wire.receivers[self.node.key(topic, kind)](payload)

    def sent(self, topic: str, kind: str) -> list[Any]:
        """Return the decoded messages of a topic."""
        return [decode(kind, payload) for payload, _ in self.wire.publishers[self.node.key(topic, kind)].sent]


def test_published_topics_decode_to_robot_values() -> None:
    bench = Bench(pictures=True)
    bench.hear(*robot_messages(bench.now))
    bench.beat()
    found = {topic: bench.sent(topic, kind) for topic, kind, _ in (*PUBLISHED, *PICTURES)}
    assert found["odom"][0].pose.pose.position.x == 0.5
    assert found["odom"][0].header.stamp.sec * S + found["odom"][0].header.stamp.nanosec == WALL + 100 * S + 20 * MS
    assert found["joint_states"][0].position.tolist() == [0.25] * 18
    assert found["pose"][0].header.frame_id == "map"
    frames = {(one.header.frame_id, one.child_frame_id) for message in found["/tf"] for one in message.transforms}
    legs = {(joint.parent, joint.child) for joint in hinges(PROFILE)}
    assert frames == {("odom", "base_link"), ("map", "odom"), *legs}
    assert found["terrain"][0].layers == ["elevation", "variance", "score", "evaluation"]
    assert found["terrain_points"][0].width == 24
    assert bytes(found["camera/depth_preview/compressed"][0].data) == b"depth"
    assert found["camera/color_preview/compressed"] == [], "there is no colour camera"


def test_description_and_fixed_frames_are_kept_for_later_subscribers() -> None:
    bench = Bench(asked=False)
    sent = {topic: bench.sent(topic, kind) for topic, kind, _ in LATCHED}
    assert [message.data for message in sent["robot_description"]] == [urdf(PROFILE)]
    (fixed,) = sent["/tf_static"]
    frames = [(one.header.frame_id, one.child_frame_id) for one in fixed.transforms]
    assert frames == [(joint.parent, joint.child) for joint in fixed_joints(PROFILE)]
    for topic, kind, depth in LATCHED:
        assert bench.wire.publishers[bench.node.key(topic, kind)].kept == depth == 1
    tokens = [token for token in bench.wire.tokens if token.endswith(":1:,1:,:,:,,")]
    assert len(tokens) == len(LATCHED)


def test_frames_of_legs_lead_to_the_feet() -> None:
    bench = Bench()
    bench.hear(*robot_messages(bench.now))
    bench.beat()
    poses = {"base_link": np.eye(4)}
    moving = [one for message in bench.sent("/tf", "tf2_msgs/msg/TFMessage") for one in message.transforms]
    (fixed,) = bench.sent("/tf_static", "tf2_msgs/msg/TFMessage")
    for one in (*moving, *fixed.transforms):
        if one.header.frame_id in poses:
            p, q = one.transform.translation, one.transform.rotation
            T = transform(rotation_from_quaternion((q.w, q.x, q.y, q.z)), (p.x, p.y, p.z))
            poses[one.child_frame_id] = poses[one.header.frame_id] @ T
    feet = leg_forward(np.full((6, 3), 0.25), PROFILE.links)
    for leg, T_body_coxa, foot in zip(LEGS, PROFILE.T_body_coxa, feet, strict=True):
        found = poses[f"{leg.replace(' ', '_')}_foot_link"][:3, 3]
        np.testing.assert_allclose(found, apply(T_body_coxa, foot), atol=1e-9)
    np.testing.assert_allclose(poses["camera_depth_optical_frame"], PROFILE.camera.T_body_camera, atol=1e-9)


def test_attachments_have_increasing_sequence_and_token_gid() -> None:
    bench = Bench()
    for _ in range(3):
        bench.hear(*robot_messages(bench.now))
        bench.beat()
    sent = bench.wire.publishers[bench.node.key("odom", "nav_msgs/msg/Odometry")].sent
    kinds = tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes]
    read = [zenoh.ext.z_deserialize(kinds, zenoh.ZBytes(attachment)) for _, attachment in sent]
    assert [number for number, _, _ in read] == [1, 2, 3]
    (token,) = (token for token in bench.wire.tokens if "/MP/" in token and "%odom/" in token)
    assert {source for _, _, source in read} == {gid(token)}
    assert [at for _, at, _ in read] == sorted(at for _, at, _ in read)


def test_topics_without_subscribers_are_not_published() -> None:
    bench = Bench(asked=False)
    bench.hear(*robot_messages(bench.now))
    assert bench.beat() == []
    assert all(publisher.sent == [] for publisher in bench.wire.publishers.values() if not publisher.kept)
    assert topics.PREVIEW not in bench.bridge.subscribes, "perception makes pictures for who asks alone"


def test_twist_and_twist_stamped_drive_robot_equally() -> None:
    for kind, value in ((TWIST, twist()), (TWIST_STAMPED, stamped(twist()))):
        bench = Bench()
        bench.hear(*robot_messages(bench.now))
        bench.beat()
        bench.publish(kind, encode(kind, value))
        (order,) = bench.beat()
        assert isinstance(order, ModeCommand)
        assert (order.mode, order.holder) == ("walk", "ros2")
        bench.hear(actuator_state(PROFILE, stamp_ns=bench.now, mode=Mode.HOLD, lease="ros2"))
        (velocity,) = bench.beat()
        assert isinstance(velocity, VelocityCommand)
        assert (velocity.velocity.tolist(), velocity.yaw_rate) == ([0.05, 0.0], 0.1)
        assert bench.words == ["a Twist drives the robot"]


@given(st.binary(max_size=120), st.sampled_from([kind for _, kind, _ in SUBSCRIBED]))
@settings(max_examples=150)
def test_fuzzed_twist_is_finite_or_refused(data: bytes, kind: str) -> None:
    for head in (b"", b"\0\1\0\0", b"\0\0\0\0"):
        try:
            velocity, turn = read_twist(kind, head + data)
        except ros.CdrError as error:
            assert str(error).startswith(f"{kind}: ")  # noqa: PT017
        else:
            assert np.isfinite([*velocity, turn]).all()


@given(st.binary(max_size=40), st.sampled_from([kind for _, kind, _ in SUBSCRIBED]))  # a Twist has 52
@settings(max_examples=80, deadline=None)
def test_random_bytes_are_refused_counted_and_move_nothing(data: bytes, kind: str) -> None:
    bench = Bench()
    bench.hear(*robot_messages(bench.now))
    for payload in (data, b"\0\1\0\0" + data):
        bench.publish(kind, payload)
    assert bench.beat() == []
    assert bench.bridge.refused == 2
    assert bench.bridge.last_refusal.startswith(f"{kind}: ")
    assert "2 messages refused" in bench.bridge.status()
    assert all(words.startswith("Twist refused: ") for words in bench.words)


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_non_finite_twist_component_is_refused(number: float) -> None:
    for part in ("linear", "angular"):
        for axis in "xyz":
            bench = Bench()
            bench.hear(*robot_messages(bench.now))
            value = twist()
            setattr(getattr(value, part), axis, number)
            bench.publish(TWIST, encode(TWIST, value))
            assert bench.beat() == []
            assert "finite numbers expected" in bench.bridge.last_refusal


def test_odometry_of_ros_becomes_the_external_pose() -> None:
    T = PLACE
    bench = Bench(pose_from="/slam/odometry")
    receive = bench.wire.receivers[bench.node.key("/slam/odometry", ODOMETRY)]
    assert sum("%slam%odometry" in token for token in bench.wire.tokens) == 1
    receive(odometry(T))
    assert not bench.beat(), "the robot's clock is unknown before its first message"
    assert "the robot must run" in bench.words[-1]
    bench.hear(*robot_messages(bench.now))
    bench.beat()
    covariance = np.diag([0.01**2, 0.03**2, 0.02**2, 0.001**2, 0.004**2, 0.002**2]).ravel()
    receive(odometry(T, covariance=covariance, stamp_ns=WALL + bench.now))
    receive(odometry(T @ PROFILE.camera.T_body_camera, child="camera_depth_optical_frame"))
    found = bench.beat()
    assert all(isinstance(message, ExternalPose) for message in found)
    first, second = found
    np.testing.assert_allclose(first.T_frame_body, T, atol=1e-12)  # type: ignore[attr-defined]
    np.testing.assert_allclose(second.T_frame_body, T, atol=1e-12)  # type: ignore[attr-defined]
    assert abs(first.stamp_ns - (bench.now - 20 * MS)) <= 20 * MS, "by the robot's clock"
    assert first.frame == "slam"  # type: ignore[attr-defined]
    assert first.position_sigma == pytest.approx(0.03)  # type: ignore[attr-defined]
    assert first.rotation_sigma == pytest.approx(0.004)  # type: ignore[attr-defined]
    assert (second.position_sigma, second.rotation_sigma) == (0.0, 0.0), "unknown"  # type: ignore[attr-defined]
    for message in found:
        assert codec.decode(codec.encode(message), ExternalPose)[0].stamp_ns == message.stamp_ns


def test_bridge_sends_no_pose_and_no_depth_unless_asked() -> None:
    assert not {topics.EXTERNAL_POSE, topics.EXTERNAL_DEPTH} & {*Bench().bridge.publishes}
    assert topics.EXTERNAL_POSE in Bench(pose_from="/o").bridge.publishes
    assert topics.EXTERNAL_DEPTH in Bench(depth_from="/d").bridge.publishes


def test_newest_depth_image_is_forwarded_with_the_lens_of_its_camera_info() -> None:
    bench = Bench(pose_from="/slam/odometry", depth_from="/camera/depth/image_rect_raw")
    receive = bench.wire.receivers[bench.node.key("/camera/depth/image_rect_raw", IMAGE)]
    inform = bench.wire.receivers[bench.node.key("/camera/depth/camera_info", CAMERA_INFO)]
    numbers = [int(token.split("/")[4]) for token in bench.wire.tokens if token.split("/")[5] != "NN"]
    assert len(set(numbers)) == len(numbers), "each entity has its number"
    bench.hear(*robot_messages(bench.now))
    bench.beat()
    receive(image())
    assert not bench.beat()
    assert "depth image refused: sensor_msgs/msg/CameraInfo: one expected" in bench.words[-1]
    inform(info())
    receive(image(MM + 1))
    receive(image(stamp_ns=WALL + bench.now))
    (found,) = bench.beat()
    assert isinstance(found, ExternalDepth)
    np.testing.assert_array_equal(found.depth, MM)
    assert abs(found.stamp_ns - (bench.now - 20 * MS)) <= 20 * MS, "by the robot's clock"
    assert not bench.beat(), "it is forwarded once"


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (odometry(child="imu_link"), "child_frame_id 'base_link' or 'camera_depth_optical_frame' expected, found 'imu_link'"),
        (odometry(wxyz=(0.0, 0.0, 0.0, 0.0)), "a unit quaternion expected, found one of length 0"),
        (odometry(wxyz=(np.nan, 0.0, 0.0, 0.0)), "numbers up to 1e+09 expected"),
        (odometry(covariance=np.full(36, np.inf)), "numbers up to 1e+09 expected"),
        (odometry(covariance=np.full(36, 1e300)), "numbers up to 1e+09 expected"),
        (odometry(covariance=-np.eye(6).ravel()), "a positive semidefinite covariance expected, found an eigenvalue of -1"),
        (odometry(stamp_ns=0), "a stamp since the robot's start expected, found 0 s"),
        (encode(TWIST, twist()), "a message in plain CDR expected"),
        (bytes(MAX_ODOMETRY_BYTES + 1), "at most 2048 bytes expected, found 2049"),
    ],
)
def test_wrong_odometry_is_refused_with_the_reason(payload: bytes, words: str) -> None:
    bench = Bench(pose_from="/o")
    bench.hear(*robot_messages(bench.now))
    bench.beat()
    bench.wire.receivers[bench.node.key("/o", ODOMETRY)](payload)
    assert not bench.beat()
    assert bench.words[-1].startswith("pose refused: ")
    assert words in bench.words[-1]
    assert bench.bridge.refused == 1


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=1000))
def test_fuzzed_odometry_is_a_message_or_refused(data: bytes) -> None:
    good = odometry()
    for payload in (data, good[:4] + data, good[: len(good) - len(data)] + data):
        try:
            found = read_pose(payload, lambda at_ns: at_ns - WALL, PROFILE.camera.T_body_camera)
        except CdrError:
            continue
        codec.decode(codec.encode(found), ExternalPose)


def test_oversized_payload_is_refused() -> None:
    bench = Bench()
    bench.publish(TWIST, encode(TWIST, twist()) + bytes(MAX_TWIST_BYTES))
    assert bench.beat() == []
    assert f"at most {MAX_TWIST_BYTES} bytes expected" in bench.bridge.last_refusal


# -------------------------------------------------------------------------------------------------------- over Zenoh


class RosNode:
    """A ROS 2 node as rmw_zenoh would have it.

    It uses plain Zenoh.
    """

    def __init__(self, endpoint: str, domain: int):
        config = zenoh.Config.from_json5(
            f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}}, scouting: {{multicast: {{enabled: false}}}}}}'
        )
        self.session, self.domain = zenoh.open(config), domain
        self.heard: dict[str, list[Any]] = {}

    def subscribe(self, topic: str, kind: str) -> None:
        def hear(sample: zenoh.Sample) -> None:
            assert sample.attachment is not None
            assert len(sample.attachment.to_bytes()) == 33
            self.heard.setdefault(topic, []).append(decode(kind, sample.payload.to_bytes()))

        self.session.declare_subscriber(f"{self.domain}/{topic}/{dds_name(kind)}/{type_hash(kind)}", hear)

    def subscribe_late(self, topic: str, kind: str) -> None:
        """Subscribe as rmw_zenoh does with transient local durability: with what was published before."""

        def hear(sample: zenoh.Sample) -> None:
            self.heard.setdefault(topic, []).append(decode(kind, sample.payload.to_bytes()))

        key = f"{self.domain}/{topic}/{dds_name(kind)}/{type_hash(kind)}"
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        self.late = zenoh.ext.declare_advanced_subscriber(self.session, key, hear, history=history)

    def publish(self, topic: str, kind: str, message: Any) -> None:
        self.session.put(f"{self.domain}/{topic}/{dds_name(kind)}/{type_hash(kind)}", encode(kind, message))

    def graph(self) -> list[str]:
        """Return all tokens of the domain, which a node queries at its start."""
        return [str(reply.ok.key_expr) for reply in self.session.liveliness().get(f"@ros2_lv/{self.domain}/**", timeout=2.0)]


class PlayedRobot:
    """A robot that publishes odometry, state, pose and map, and stores its commands.

    It gives the lease to each sender of an order.
    """

    def __init__(self, link: ZenohLink):
        self.velocities: list[VelocityCommand] = []
        self.orders: list[ModeCommand] = []
        self.lease = ""
        self._link, self._over = link, threading.Event()
        self._thread = threading.Thread(target=self._speak, name="played robot")
        for topic in (topics.VELOCITY, topics.MODE):
            link.subscribe(topic, self._hear)

    def __enter__(self) -> "PlayedRobot":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _hear(self, topic: AnyTopic, frame: bytes) -> None:
        message, _ = codec.decode(frame, topic.type)
        if isinstance(message, ModeCommand):
            self.lease = message.holder
            self.orders.append(message)
        elif isinstance(message, VelocityCommand):
            self.velocities.append(message)

    def _speak(self) -> None:
        while not self._over.wait(0.02):
            now = time.monotonic_ns()
            for message in robot_messages(now):
                if isinstance(message, type(actuator_state(PROFILE, stamp_ns=0))):
                    message = replace(message, lease=self.lease)
                self._link.send(topics.OF_TYPE[type(message)], codec.encode(message, Timing(now, now)))


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Router((endpoint,)):
        yield endpoint


def test_ros_node_discovers_reads_and_drives_robot_over_zenoh(router: str) -> None:
    said: list[str] = []
    stop = threading.Event()
    with ZenohLink(Endpoints((router,))) as link, ForeignLink((router,)) as wire, ZenohLink(Endpoints((router,))) as robots:
        bridge = Bridge(PROFILE, wire, Node(7, wire.id, "sextant"), Lead(Walk(0.1, 0.11)), time.time_ns, said.append)
        running = threading.Thread(target=run_live, args=(bridge, link, stop), name="bridge")
        running.start()
        node = RosNode(router, 7)
        try:
            with PlayedRobot(robots) as robot:
                for topic, kind, _ in PUBLISHED:
                    node.subscribe(topic.lstrip("/"), kind)
                eventually(lambda: len(node.heard) == len(PUBLISHED), "a message on every topic", 20.0)
                stamp = node.heard["odom"][-1].header.stamp
                assert abs(stamp.sec + stamp.nanosec * 1e-9 - time.time()) < 5.0, "by the time of day"

                node.subscribe_late("robot_description", "std_msgs/msg/String")
                eventually(lambda: "robot_description" in node.heard, "the description, long after it was published", 20.0)
                assert node.heard["robot_description"][0].data == urdf(PROFILE)

                tokens = node.graph()
                assert sum("/NN/%/%/sextant" in token for token in tokens) == 1
                assert sum("/MP/%/%/sextant/" in token for token in tokens) == len(PUBLISHED) + len(LATCHED)
                assert sum("/MS/%/%/sextant/" in token for token in tokens) == len(SUBSCRIBED)
                assert all(token.split("/")[2] == wire.id for token in tokens)

                def drive() -> bool:
                    node.publish("cmd_vel", TWIST, twist(0.06, -0.2))
                    return any(v.velocity.any() for v in robot.velocities)

                eventually(drive, "a velocity", 20.0)
                led = next(v for v in robot.velocities if v.velocity.any())
                assert (led.velocity.tolist(), led.yaw_rate) == ([0.06, 0.0], -0.2)
                assert {(order.mode, order.holder) for order in robot.orders} == {("walk", "ros2")}
                eventually(lambda: robot.orders[-1].mode == "stop", "the stop, once no Twist comes", 20.0)
                eventually(lambda: not robot.velocities[-1].velocity.any(), "a velocity of zero", 20.0)

                node.session.put(f"7/cmd_vel/{dds_name(TWIST)}/{type_hash(TWIST)}", b"\0\1\0\0nothing")
                eventually(lambda: bridge.refused == 1, "the refusal of what is no Twist", 20.0)
                assert running.is_alive()
        finally:
            stop.set()
            running.join()
            node.session.close()  # type: ignore[no-untyped-call]
    assert said[0] == "a Twist drives the robot"
    assert "no Twist for 0.3 s" in said[1]
    assert "a message in plain CDR expected, found 11 bytes" in said[2]


def test_ros2_command_prints_topics_and_ends_on_ctrl_c(
    router: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sextant.deploy.terminal.interrupts import Interrupts

    looks = iter([False, False, True])
    monkeypatch.setattr(Interrupts, "asked", lambda _: next(looks, True))
    words = ["topics", "ros2", "--connect", router, "--domain", "5", "--ros-namespace", "/hexapod", "--pictures"]
    assert cli.main(words) == 130
    printed = capsys.readouterr().out
    assert "node /hexapod/sextant in ROS domain 5" in printed
    assert "/hexapod/terrain" in printed
    assert "/hexapod/camera/depth_preview/compressed" in printed
    assert "subscribes to /hexapod/cmd_vel, /hexapod/cmd_vel_stamped" in printed


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (["--ros-namespace", "robot"], 2, "a ROS namespace like / or /robot_1 expected, found 'robot'"),
        (["--domain", "400"], 2, "a ROS domain from 0 to 232 expected, found 400"),
        (["--robot", "nobody"], 2, "no profile 'nobody'"),
        (["--pose-from", "/odom*"], 2, "a topic like /odometry/filtered expected, found '/odom*'"),
        (["--pose-from", "/odom"], 2, "a topic of another node expected, found /odom, which this node publishes"),
    ],
)
def test_invalid_input_is_reported(
    words: list[str], status: int, said: str, router: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["topics", "ros2", "--connect", router, *words]) == status
    assert said in capsys.readouterr().err


def test_domain_defaults_to_ros_domain_id(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert parse(cli.sextant, "sextant", ["topics", "ros2"]).values["domain"] == 42
    monkeypatch.setenv("ROS_DOMAIN_ID", "")
    assert parse(cli.sextant, "sextant", ["topics", "ros2"]).values["domain"] == 0
    assert parse(cli.sextant, "sextant", ["topics", "ros2", "--domain", "1"]).values["domain"] == 1
