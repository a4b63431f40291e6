"""`sextant topics ros2`: the robot as a ROS 2 node, without a ROS installation."""

import argparse

from sextant.deploy.commands.common import FAILED, INTERRUPTED, InputError, complain, met, say

_LOOK_S = 0.1


def ros2(arguments: argparse.Namespace) -> int:
    """`sextant topics ros2`: run a ROS 2 node over rmw_zenoh until Ctrl-C."""
    import threading
    import time

    try:
        from sextant.deploy.ros2.bridge import PICTURES, PUBLISHED, SUBSCRIBED, Bridge
    except ImportError as error:
        raise InputError(f"{error}: pip install 'sextant[ros2]'") from None
    from sextant.deploy.ros2.lead import Lead, Walk
    from sextant.deploy.ros2.names import Node
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.shared.robot.profiles import load_profile
    from sextant.shared.runtime.zenoh_runner import run_live
    from sextant.shared.wire import codec, topics
    from sextant.shared.wire.transport import ForeignLink, ZenohLink

    profile = load_profile(arguments.robot)
    lead = Lead(Walk(profile.stance.max_speed, profile.stance.body_height, gait=arguments.gait))
    endpoints = met(arguments)
    if endpoints.keys is not None and not arguments.ros_connect:
        raise InputError("ROS nodes have no certificates; give their router, on this machine, with --ros-connect")
    stop = threading.Event()
    with (
        Interrupts() as interrupts,
        ZenohLink(endpoints) as link,
        ForeignLink(tuple(arguments.ros_connect or endpoints.connect)) as wire,
    ):
        try:
            node = Node(arguments.domain, wire.id, "sextant", arguments.ros_namespace)
        except ValueError as error:
            raise InputError(str(error)) from None
        bridge = Bridge(profile, wire, node, lead, time.time_ns, complain, arguments.pictures)
        published = (*PUBLISHED, *(PICTURES if arguments.pictures else ()))
        say(f"node {node.full('sextant')} in ROS domain {node.domain}; Ctrl-C stops it")
        say(f"publishes {', '.join(node.full(topic) for topic, *_ in published)}")
        say(f"subscribes to {', '.join(node.full(topic) for topic, *_ in SUBSCRIBED)}")
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
