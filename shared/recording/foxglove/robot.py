"""Translation of the robot's state and plans, for scenes and plots."""

import numpy as np
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from sextant.shared.geometry import Array
from sextant.shared.recording.foxglove import parts
from sextant.shared.robot.kinematics import leg_points
from sextant.shared.robot.links import JOINT_NAMES
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.wire.messages import ActuatorState, PassagePlan, PlannerStatus, StepPlan

_BODY, _LEG = (0.25, 0.29, 0.35, 0.9), (0.85, 0.87, 0.9, 1.0)
_CARRIES, _IN_AIR, _STANDS = (0.2, 0.75, 0.35, 1.0), (0.95, 0.65, 0.15, 1.0), (0.6, 0.6, 0.6, 1.0)
_POLYGON, _FOOTHOLD, _WAY = (0.2, 0.75, 0.35, 0.8), (0.2, 0.55, 1.0, 0.9), (1.0, 0.85, 0.2, 1.0)
_LEG_WIDTH, _POLYGON_WIDTH, _WAY_WIDTH = 0.012, 0.004, 0.006  # [m]
_FOOTHOLD_SIZE = 0.025  # [m]


def frames(state: ActuatorState, T_world_odom: Array, T_body_camera: Array) -> FrameTransforms:
    """Return the transforms world -> odom -> body -> camera."""
    stamp, found = parts.time(state.stamp_ns), FrameTransforms()
    tree = (("world", "odom", T_world_odom), ("odom", "body", state.T_odom_body), ("body", "camera", T_body_camera))
    for parent, child, T_parent_child in tree:
        where = parts.pose(T_parent_child)
        found.transforms.add(
            timestamp=stamp,
            parent_frame_id=parent,
            child_frame_id=child,
            translation=where.position,
            rotation=where.orientation,
        )
    return found


def body(state: ActuatorState, T_world_body: Array) -> Odometry:
    """Return the body pose, with the mode of the actuator as metadata."""
    words = {"mode": str(state.mode), "reason": state.reason, "lease": state.lease, "refused": state.plan_refusal}
    return Odometry(
        timestamp=parts.time(state.stamp_ns),
        frame_id="world",
        body_frame_id="body",
        pose=parts.pose(T_world_body),
        metadata=[KeyValuePair(key=key, value=value) for key, value in words.items() if value],
    )


def joints(state: ActuatorState) -> JointStates:
    """Return measured joint angles [rad] and torques [N m]."""
    found = JointStates(timestamp=parts.time(state.stamp_ns))
    for name, q, torque in zip(JOINT_NAMES, state.q.ravel().tolist(), state.load_nm.ravel().tolist(), strict=True):
        found.joints.add(name=name, position=q, effort=torque)
    return found


def drawn(state: ActuatorState, profile: RobotProfile) -> SceneUpdate:
    """Return a scene of the measured body, legs, feet and support polygon in {body}."""
    legs, radius = leg_points(profile, state.q), profile.foot.radius
    links = np.stack([legs[:, :-1], legs[:, 1:]], axis=2).reshape(-1, 3)
    colors = [_CARRIES if on else _IN_AIR if up else _STANDS for on, up in zip(state.contact, state.swing, strict=True)]
    entity = _entity(state.stamp_ns, "body", "robot", legs[:, 3], colors, 2.0 * radius)
    entity.frame_locked = True
    size = parts.vector(profile.body.size)
    entity.cubes.append(CubePrimitive(pose=parts.place((0.0, 0.0, 0.0)), size=size, color=parts.color(_BODY)))
    entity.lines.append(parts.lines(LinePrimitive.LINE_LIST, links, _LEG, _LEG_WIDTH))
    standing = legs[~state.swing, 3]
    if len(standing) >= 3:
        soles = standing - np.array([0.0, 0.0, radius])
        entity.lines.append(parts.lines(LinePrimitive.LINE_LOOP, soles, _POLYGON, _POLYGON_WIDTH))
    return SceneUpdate(entities=[entity])


def footholds(plan: StepPlan) -> SceneUpdate:
    """Return a scene of the planned touchdowns."""
    feet = plan.touchdown[plan.swing]
    return SceneUpdate(entities=[_entity(plan.stamp_ns, "world", "footholds", feet, [_FOOTHOLD] * len(feet), _FOOTHOLD_SIZE)])


def way(status: PlannerStatus) -> SceneUpdate:
    """Return a scene of the current path to the goal."""
    entity = _entity(status.stamp_ns, "world", "way")
    corners = np.column_stack([status.path, np.zeros(len(status.path))])
    entity.lines.append(parts.lines(LinePrimitive.LINE_STRIP, corners, _WAY, _WAY_WIDTH))
    return SceneUpdate(entities=[entity])


def section(plan: PassagePlan) -> SceneUpdate:
    """Return a scene of a planned section of a passage: footholds and body path."""
    feet = plan.footholds[plan.leg < len(LEGS)]
    entity = _entity(plan.stamp_ns, "world", "passage", feet, [_FOOTHOLD] * len(feet), _FOOTHOLD_SIZE)
    if len(plan.body):
        entity.lines.append(parts.lines(LinePrimitive.LINE_STRIP, plan.body, _WAY, _WAY_WIDTH))
    return SceneUpdate(entities=[entity])


_NOWHERE = np.zeros((0, 3))


def _entity(
    stamp_ns: int, frame: str, name: str, points: Array = _NOWHERE, colors: list[parts.Rgba] | None = None, size: float = 0.0
) -> SceneEntity:
    """Return an entity that replaces the last one of this name.

    It has spheres at points (n, 3) of a frame.
    """
    entity, extent = SceneEntity(timestamp=parts.time(stamp_ns), frame_id=frame, id=name), parts.vector((size, size, size))
    for p, rgba in zip(points.tolist(), colors or [], strict=True):
        entity.spheres.add(pose=parts.place(p), size=extent, color=parts.color(rgba))
    return entity
