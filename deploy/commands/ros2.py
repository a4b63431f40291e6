"""`sextant topics ros2`: the robot as a ROS 2 node, without a ROS installation."""

from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import FAILED, INTERRUPTED, InputError, complain, say
from sextant.deploy.terminal.arguments import command, flag, option

if TYPE_CHECKING:
    from sextant.shared.wire.messages import GaitRequest

_LOOK_S = 0.1


@command()
@option(
    "--domain", "ROS domain id (default: ROS_DOMAIN_ID, or 0)", "N", type=options.NATURAL, default=0, envvar="ROS_DOMAIN_ID"
)
@option("--ros-namespace", "namespace of the node and its topics, for several robots in one graph", "/NAME", default="/")
@option(
    "--ros-connect",
    "router of the ROS nodes, `ros2 run rmw_zenoh_cpp rmw_zenohd` (default: the robot's router)",
    "ENDPOINT",
    multiple=True,
)
@options.connection
@options.robot
@option("--gait", "gait for Twist messages; auto: the planner chooses gait and speed", type=options.GAIT, default="tripod")
@flag("--pictures", "also publish the small camera previews")
@option("--pose-from", "topic of nav_msgs/Odometry for a perception with method=external", "TOPIC", default="")
@option("--depth-from", "topic of depth images (sensor_msgs/Image) for a camera with device=external", "TOPIC", default="")
def ros2(
    domain: int,
    ros_namespace: str,
    ros_connect: tuple[str, ...],
    connection: options.Connection,
    robot: str,
    gait: "GaitRequest",
    pictures: bool,
    pose_from: str,
    depth_from: str,
) -> int:
    """Run the robot as a ROS 2 node over rmw_zenoh, without ROS, see docs/ros2.md."""
    import threading
    import time

    try:
        from sextant.deploy.ros2.bridge import LATCHED, PICTURES, PUBLISHED, SUBSCRIBED, Bridge
    except ImportError as error:
        raise InputError(f"{error}: pip install 'sextant[ros2]'") from None
    from sextant.deploy.ros2.lead import Lead, Walk
    from sextant.deploy.ros2.names import Node, check_topic
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.runtime.zenoh_runner import run_live
    from sextant.shared.wire import codec, topics
    from sextant.shared.wire.transport import ForeignLink, ZenohLink

    profile = load_profile(robot)
    lead = Lead(Walk(profile.stance.max_speed, profile.stance.body_height, gait=gait))
    endpoints = connection.endpoints()
    if endpoints.keys is not None and not ros_connect:
        raise InputError("ROS nodes have no certificates; give their router, on this machine, with --ros-connect")
    stop = threading.Event()
    with (
        Interrupts() as interrupts,
        ZenohLink(endpoints) as link,
        ForeignLink(ros_connect or endpoints.connect) as wire,
    ):
        try:
            node = Node(domain, wire.id, "sextant", ros_namespace)
            taken = {"--pose-from": pose_from, "--depth-from": depth_from}
            for topic in filter(None, taken.values()):
                check_topic(topic)
        except ValueError as error:
            raise InputError(str(error)) from None
        published = (*PUBLISHED, *LATCHED, *(PICTURES if pictures else ()))
        for name, topic in taken.items():
            if topic and node.full(topic) in (node.full(own) for own, *_ in published):
                raise InputError(f"{name}: a topic of another node expected, found {topic}, which this node publishes")
        bridge = Bridge(profile, wire, node, lead, time.time_ns, complain, pictures, pose_from, depth_from)
        say(f"node {node.full('sextant')} in ROS domain {node.domain}; Ctrl-C stops it")
        say(f"publishes {', '.join(node.full(topic) for topic, *_ in published)}")
        subscribed = [topic for topic, *_ in SUBSCRIBED] + [topic for topic in taken.values() if topic]
        say(f"subscribes to {', '.join(map(node.full, subscribed))}")
        running = threading.Thread(target=run_live, args=(bridge, link, stop), kwargs={"role": endpoints.role}, name="ros2")
        running.start()
        try:
            while not interrupts.asked() and running.is_alive():
                stop.wait(_LOOK_S)
        finally:
            stop.set()
            running.join()
        for message in bridge.release(time.monotonic_ns()):
            link.send(topics.OF_TYPE[type(message)], codec.encode(message))
        return INTERRUPTED if interrupts.asked() else FAILED
