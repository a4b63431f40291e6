"""MuJoCo specification of a hexapod with 18 servo joints on a terrain, and its export as MJCF.

A servo is a position actuator without velocity gain. The joint damping is the motor's: stall torque divided by no-load speed.
"""

from dataclasses import dataclass, field
from itertools import product
from typing import Any

import mujoco
import numpy as np

from sextant.services.simulator.physics.solids import Boxes, HeightField
from sextant.services.simulator.physics.terrain import DEPTH, Terrain
from sextant.services.simulator.physics.tipping import add_tipping
from sextant.shared.geometry import Array, quaternion_from_rotation
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.links import LINK_RADII_M
from sextant.shared.robot.profile import JOINTS, RobotProfile
from sextant.shared.scenario.scenario import Variation

TIME_STEP_NS = 2_000_000  # [ns]
ROBOT_GROUP, TERRAIN_GROUP = 1, 0  # geom groups, for ray casts against only one of them
# Colours in MuJoCo's viewer and in exported models; the simulated cameras have their own.
_FLOOR_RGBA, _BLOCK_RGBA = (0.80, 0.80, 0.78, 1.0), (0.66, 0.55, 0.42, 1.0)
_TRUNK_RGBA, _LEG_RGBA = (0.18, 0.22, 0.28, 1.0), (0.90, 0.50, 0.16, 1.0)
FRICTION = 0.8  # [1] sliding friction of feet on ordinary ground
_FRICTION = (FRICTION, 0.005, 0.0001)  # sliding [1]; torsional and rolling [m], which contacts with condim = 3 do not use
_LIMIT_MARGIN = np.radians(5.0)  # [rad] from the servo's limit to the mechanical stop of the brackets
_TOUCH_RADIUS = 0.013  # [m] margin of the touch sensor around a foot; shank contacts further up are not foot contacts


@dataclass(frozen=True, slots=True)
class Factors:
    """Factors and lengths by which the physics of a run deviates from the profile."""

    armature: Array  # (6, 3) [1] on the profile's armature
    joint_friction: Array  # (6, 3) [1] on the profile's joint friction
    ground_friction: float  # [1] on the sliding friction of 0.8
    foot_friction: Array = field(default_factory=lambda: np.ones(6))  # (6,) [1] on that of each foot
    link_lengths: Array = field(default_factory=lambda: np.zeros((6, 3)))  # (6, 3) [m] added to coxa, femur and tibia

    @classmethod
    def none(cls) -> "Factors":
        """Return factors of 1, without deviation from the profile."""
        return cls(np.ones((6, 3)), np.ones((6, 3)), 1.0)

    @classmethod
    def draw(cls, variation: Variation, rng: np.random.Generator) -> "Factors":
        """Draw uniform factors between 1/x and x, separately for each joint.

        Raises:
            ValueError: A bound x is less than 1.
        """
        if variation.armature < 1 or variation.friction < 1:
            raise ValueError(f"variations of 1 or more expected, found {variation.armature} and {variation.friction}")
        armature = rng.uniform(1 / variation.armature, variation.armature, (6, 3))
        friction = rng.uniform(1 / variation.friction, variation.friction, (6, 3))
        return cls(armature, friction, float(rng.uniform(1 / variation.friction, variation.friction)))


def mjcf(profile: RobotProfile) -> str:
    """Return the simulator's model of a robot on level ground as MJCF, a standalone XML text.

    It has a camera `depth` where the depth camera is, and a keyframe `stand` in which the robot stands.
    """
    no_boxes = Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    spec = model_spec(profile, Terrain(no_boxes, plane=0.0), Factors.none(), imu=True)
    lens, T = profile.camera.intrinsics, profile.camera.T_body_camera
    view = T[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # a camera of MuJoCo looks along -z, with y up
    fovy = 2 * np.degrees(np.arctan(lens.height / 2 / lens.fy))
    spec.body("body").add_camera(name="depth", pos=T[:3, 3], quat=quaternion_from_rotation(view), fovy=fovy)
    q = body_inverse(profile, profile.rest_feet()).ravel()
    spec.add_key(name="stand", qpos=[0, 0, profile.stance.body_height, 1, 0, 0, 0, *q], ctrl=q)
    spec.compile()
    return str(spec.to_xml())


def model_spec(profile: RobotProfile, terrain: Terrain, factors: Factors, imu: bool = False) -> Any:
    """Return the specification (`mujoco.MjSpec`) of a robot on a terrain; `imu` adds an IMU at the body's origin."""
    spec = mujoco.MjSpec()
    spec.modelname = profile.name
    spec.compiler.degree = False
    option = spec.option
    option.timestep = TIME_STEP_NS / 1e9
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    option.noslip_iterations = 3
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # `step` reports divergence instead of a silent reset
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND  # one robot is one island, so the search for islands is useless
    spec.stat.extent = 1.0
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35] * 3, [0.25] * 3
    spec.worldbody.add_light(name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=[0.4, 0.3, -1], castshadow=False)
    spec.memory = 64 << 20  # [bytes] a robot that lies on a fine height field has hundreds of contacts
    friction = [_FRICTION[0] * factors.ground_friction, *_FRICTION[1:]]
    _add_terrain(spec, terrain, friction)
    _add_robot(spec, profile, factors, friction, imu)
    _add_weak(spec, terrain, friction)
    add_tipping(spec, terrain.boxes, terrain.tipping, _ground(friction))
    return spec


def _ground(friction: list[float]) -> dict[str, Any]:
    """Return the common attributes of all terrain geoms."""
    return {
        "contype": 2,
        "conaffinity": 1,
        "condim": 3,
        "friction": friction,
        "solref": [0.01, 1.0],
        "group": TERRAIN_GROUP,
        "rgba": _BLOCK_RGBA,
    }


def _add_terrain(spec: Any, terrain: Terrain, friction: list[float]) -> None:
    solid, world = _ground(friction), spec.worldbody
    level = solid | {"rgba": _FLOOR_RGBA}
    ground = terrain.carrying_boxes()
    if terrain.plane is not None and not len(ground):
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        world.add_geom(name="plane", type=plane, size=[0, 0, 0.05], pos=[0, 0, terrain.plane], **level)
    for kind, boxes in (("box", terrain.boxes), ("ground", ground)):
        for i, (centre, half, quat) in enumerate(zip(boxes.centre, boxes.half, quaternion_from_rotation(boxes.R), strict=True)):
            if kind == "box" and (i in terrain.weak.box or i in terrain.tipping.box):
                continue
            look = solid if kind == "box" else level
            world.add_geom(name=f"{kind} {i}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=half, quat=quat, **look)
    if terrain.height_field is not None:
        _add_height_field(spec, terrain.height_field, solid)


def _add_weak(spec: Any, terrain: Terrain, friction: list[float]) -> None:
    """Add the weak boxes as mocap bodies, each with a touch sensor.

    These sensors must be the last ones of the model.
    """
    boxes = terrain.boxes
    for i in terrain.weak.box:
        quat = quaternion_from_rotation(boxes.R[i])
        pillar = spec.worldbody.add_body(name=f"weak {i}", mocap=True, pos=boxes.centre[i], quat=quat)
        box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "name": f"weak {i}"}
        pillar.add_geom(size=boxes.half[i], **box, **_ground(friction))
        pillar.add_site(size=boxes.half[i] + _TOUCH_RADIUS, group=5, **box)
        touch, site = mujoco.mjtSensor.mjSENS_TOUCH, mujoco.mjtObj.mjOBJ_SITE
        spec.add_sensor(name=f"weak {i}", type=touch, objtype=site, objname=f"weak {i}")


def _add_height_field(spec: Any, field: HeightField, solid: dict[str, Any]) -> None:
    low = float(field.heights.min())
    rise = float(np.ptp(field.heights)) or 1e-3  # must be positive for MuJoCo; the normalised heights of level ground are zero
    half = field.resolution * (np.array(field.heights.shape) - 1) / 2
    asset = spec.add_hfield(name="field", nrow=field.heights.shape[1], ncol=field.heights.shape[0])
    asset.size = [*half, rise, DEPTH]
    asset.userdata = ((field.heights - low) / rise).T.ravel()
    position = [*(np.array(field.origin) + half), low]
    kind = mujoco.mjtGeom.mjGEOM_HFIELD
    spec.worldbody.add_geom(name="field", type=kind, hfieldname="field", pos=position, **solid)


def _add_robot(spec: Any, profile: RobotProfile, factors: Factors, friction: list[float], imu: bool) -> None:
    solid = {
        "contype": 1,
        "conaffinity": 2,
        "condim": 3,
        "friction": friction,
        "solref": [0.01, 1.0],
        "group": ROBOT_GROUP,
    }
    body = spec.worldbody.add_body(name="body")
    body.add_freejoint(name="body")
    half = np.array(profile.body.size) / 2
    body.add_geom(name="trunk", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, rgba=_TRUNK_RGBA, **solid)
    body.explicitinertial, body.mass, body.ipos = True, profile.body.mass, profile.body.centre_of_mass
    body.inertia = profile.body.trunk_inertia
    lengths = factors.link_lengths + np.array([profile.links.coxa, profile.links.femur, profile.links.tibia])
    up = [0.0, -1.0, 0.0]  # a positive rotation about -y lifts a link that points along x
    for leg, (name, T) in enumerate(zip((part.name for part in profile.legs), profile.T_body_coxa, strict=True)):
        parent: Any = body
        links = lengths[leg]
        position, quat = T[:3, 3], quaternion_from_rotation(T[:3, :3])
        for joint, (part, axis) in enumerate(zip(JOINTS, ([0.0, 0.0, 1.0], up, up), strict=True)):
            label, end = f"{part} {name}", links[joint]
            link = parent.add_body(name=label, pos=position, quat=quat)
            low, high = profile.joint_limits[leg, joint] + np.array([-_LIMIT_MARGIN, _LIMIT_MARGIN])
            hinge = link.add_joint(name=label, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
            hinge.limited, hinge.range = mujoco.mjtLimited.mjLIMITED_TRUE, [low, high]
            data_sheet = profile.servos.each[3 * leg + joint]
            hinge.damping = [data_sheet.damping, 0.0, 0.0]  # linear damping only
            hinge.armature = data_sheet.armature * factors.armature[leg, joint]
            hinge.frictionloss = data_sheet.friction * factors.joint_friction[leg, joint]
            tip = end - profile.foot.radius if part == "tibia" else end  # only the foot sphere reaches the ground
            link.add_geom(
                name=label,
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=[0, 0, 0, tip, 0, 0],
                size=[LINK_RADII_M[joint], 0, 0],
                mass=profile.body.leg_link_masses[joint],
                rgba=_LEG_RGBA,
                **solid,
            )
            if profile.body.leg_link_inertias[joint]:
                link.explicitinertial, link.mass, link.ipos = True, profile.body.leg_link_masses[joint], [tip / 2, 0.0, 0.0]
                link.inertia = profile.body.link_inertia(joint, tip, LINK_RADII_M[joint])
            servo = spec.add_actuator(name=label, target=label, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=data_sheet.stiffness)
            servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            servo.forcerange = [-data_sheet.stall_torque, data_sheet.stall_torque]
            parent, position, quat = link, np.array([end, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        foot = {"pos": [links[2], 0.0, 0.0], "type": sphere}
        foot_friction = [friction[0] * factors.foot_friction[leg], *friction[1:]]
        look = solid | {"friction": foot_friction, "rgba": _TRUNK_RGBA}
        parent.add_geom(name=f"foot {name}", size=[profile.foot.radius, 0, 0], mass=0.0, priority=1, **foot, **look)
        parent.add_site(name=f"foot {name}", size=[profile.foot.radius + _TOUCH_RADIUS, 0, 0], group=5, **foot)
        whole = {"pos": [links[2] / 2, 0.0, 0.0], "size": [links[2] / 2 + profile.foot.radius + _TOUCH_RADIUS, 0, 0]}
        parent.add_site(name=f"shank {name}", type=sphere, group=5, **whole)
    for kind, name in product(("foot", "shank"), (leg.name for leg in profile.legs)):
        touch, site = mujoco.mjtSensor.mjSENS_TOUCH, mujoco.mjtObj.mjOBJ_SITE
        spec.add_sensor(name=f"{kind} {name}", type=touch, objtype=site, objname=f"{kind} {name}")
    if imu:
        body.add_site(name="imu", group=5)
        for kind in (mujoco.mjtSensor.mjSENS_GYRO, mujoco.mjtSensor.mjSENS_ACCELEROMETER):
            spec.add_sensor(name=str(kind), type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
