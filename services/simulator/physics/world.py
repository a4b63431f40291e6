"""MuJoCo model of a hexapod with 18 servo joints on a terrain.

A servo is a position actuator without velocity gain. The joint damping is the motor's: stall torque divided by no-load speed.
Setpoint, stiffness and torque limit are inputs of each step, because they are registers of the real servos.
"""

from dataclasses import dataclass
from itertools import product
from math import isfinite
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.simulator.physics.solids import Boxes, Capsules, HeightField
from sextant.services.simulator.physics.terrain import DEPTH, Terrain
from sextant.shared.errors import SextantError
from sextant.shared.files.config import ConfigError
from sextant.shared.geometry import Array, quaternion_from_rotation, rotation_z, transform
from sextant.shared.robot.profile import JOINTS, RobotProfile
from sextant.shared.scenario.scenario import Variation

TIME_STEP_NS = 2_000_000  # [ns]
ROBOT_GROUP, TERRAIN_GROUP = 1, 0  # geom groups, for ray casts against only one of them
_FRICTION = (0.8, 0.005, 0.0001)  # sliding [1]; torsional and rolling [m], which contacts with condim = 3 do not use
_LIMIT_MARGIN = np.radians(5.0)  # [rad] from the servo's limit to the mechanical stop of the brackets
_LINK_RADIUS = (0.018, 0.014, 0.008)  # [m] coxa, femur, tibia
_SINKING = 0.25  # [m/s] sinking speed of weak boxes
_TOUCH_RADIUS = 0.013  # [m] margin of the touch sensor around a foot; shank contacts further up are not foot contacts


@dataclass(frozen=True, slots=True)
class Factors:
    """Factors by which the physics of a run deviates from the profile."""

    armature: Array  # (6, 3) [1] on the profile's armature
    joint_friction: Array  # (6, 3) [1] on the profile's joint friction
    ground_friction: float  # [1] on the sliding friction of 0.8

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


class PhysicsError(SextantError, FloatingPointError):
    """The physics is no longer valid."""

    exit_status = 1


class World:
    """Simulated robot on a terrain, with a time step of 2 ms.

    Call `place` or `stand` before the first step. Values that are read after a step belong to the end of that step. Forces and
    torques are an exception: they are those that acted during the step.
    """

    def __init__(self, profile: RobotProfile, terrain: Terrain, factors: Factors | None = None, imu: bool = False):
        """Build the MuJoCo model.

        Args:
            profile: The robot.
            terrain: The ground.
            factors: Deviation of the physics from the profile, `Factors.none()` by default.
            imu: Whether to simulate an IMU at the body's origin.
        """
        _disable_log()
        self.profile, self.terrain = profile, terrain
        spec = _spec(profile, terrain, Factors.none() if factors is None else factors, imu)
        self.model: Any = spec.compile()
        self.data: Any = mujoco.MjData(self.model)
        m, d = self.model, self.data
        self._foot_geoms = np.array([int(m.geom(f"foot {leg.name}").id) for leg in profile.legs])
        self._link_geoms = np.array([int(m.geom(f"{part} {leg.name}").id) for leg in profile.legs for part in JOINTS])
        self._trunk_geom = int(m.geom("trunk").id)
        self._link_bodies = np.array(m.geom_bodyid[self._link_geoms])
        self._radii = np.array(m.geom_size[np.concatenate([self._link_geoms, self._foot_geoms]), 0])
        body = int(m.body("body").id)
        # Views into model and data are created once, because attribute access costs more than the assignments of a step.
        self._gain = m.actuator_gainprm.reshape(6, 3, -1)[..., 0]
        self._bias = m.actuator_biasprm.reshape(6, 3, -1)[..., 1]
        self._lowest, self._highest = np.moveaxis(m.actuator_forcerange.reshape(6, 3, 2), -1, 0)
        self._ctrl, self._torque = d.ctrl.reshape(6, 3), d.actuator_force.reshape(6, 3)
        self._qpos, self._qvel, self._sensors = d.qpos, d.qvel, d.sensordata
        self._q, self._qd = d.qpos[7:].reshape(6, 3), d.qvel[6:].reshape(6, 3)
        self._body_position, self._body_axes = d.xpos[body], d.xmat[body]
        self._geom_position = d.geom_xpos
        self._warnings = d.warning.number  # of each kind, since the robot was placed
        self._steps = 0
        self._imu = slice(12, 18) if imu else None
        self._pressed = d.sensordata[len(d.sensordata) - len(terrain.weak) :]  # (n,) [N] load on the weak boxes
        self._gives = np.zeros(len(terrain.weak), dtype=bool)
        self._sunk = np.zeros(len(terrain.weak))

    def place(self, q: ArrayLike, T_world_body: Array) -> None:
        """Place the robot at rest, with its servos holding the joint angles.

        Args:
            q: (6, 3) [rad] joint angles.
            T_world_body: (4, 4) body pose.

        Raises:
            ValueError: q is not (6, 3), T_world_body is not (4, 4), or a value is not finite.
        """
        T = np.asarray(T_world_body, dtype=np.float64)
        if T.shape != (4, 4) or not np.all(np.isfinite(T)):
            raise ValueError(f"a finite body pose (4, 4) expected, found {T.shape} with {np.sum(~np.isfinite(T))} bad values")
        self._pose(_joint_angles(q), T)
        mujoco.mj_forward(self.model, self.data)

    def _pose(self, q: Array, T_world_body: Array) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self._gives[:], self._sunk[:] = False, 0.0
        self._qpos[:3] = T_world_body[:3, 3]
        self._qpos[3:7] = quaternion_from_rotation(T_world_body[:3, :3])
        self._q[:] = self._ctrl[:] = q
        mujoco.mj_kinematics(self.model, self.data)

    def stand(self, q: ArrayLike, xy: ArrayLike = (0.0, 0.0), yaw: float = 0.0) -> Array:
        """Place the robot level on the ground, with no foot below the surface.

        Args:
            q: (6, 3) [rad] joint angles.
            xy: [m] {world} position of the body.
            yaw: [rad] heading of the body.

        Returns:
            T_world_body (4, 4).

        Raises:
            ConfigError: There is no ground below at least one foot.
        """
        T = transform(rotation_z(yaw), np.array([*np.asarray(xy, dtype=np.float64), 0.0]))
        self._pose(_joint_angles(q), T)
        feet = self.p_world_foot
        ground = self.terrain.height_at(feet[:, :2])
        if not np.all(np.isfinite(ground)):
            missing = [leg.name for leg, z in zip(self.profile.legs, ground, strict=True) if not np.isfinite(z)]
            words = f"ground below every foot expected, found none below {', '.join(missing)}; start somewhere else"
            raise ConfigError("start", [words])
        T[2, 3] = np.max(ground + self.profile.foot.radius - feet[:, 2])
        self.place(q, T)
        return T

    def step(self, setpoint: ArrayLike, stiffness: ArrayLike, torque_limit: ArrayLike, steps: int = 1) -> None:
        """Advance the simulation by steps of 2 ms.

        Args:
            setpoint: (6, 3) [rad] goal angles of the servos.
            stiffness: (6, 3) or scalar [N m/rad] torque per angle error.
            torque_limit: (6, 3) or scalar [N m]; zero turns the torque of a joint off.
            steps: Number of steps, all with the same inputs.

        Raises:
            ValueError: A setpoint is NaN or infinite.
            PhysicsError: The physics has diverged, or MuJoCo warns of another fault.
        """
        self._ctrl[...] = setpoint
        if not isfinite(np.vdot(self._ctrl, self._ctrl)):  # MuJoCo would silently replace all setpoints by zero
            raise ValueError(f"finite setpoints expected, found {np.asarray(setpoint)}")
        self._gain[...] = stiffness
        np.negative(stiffness, out=self._bias)
        self._highest[...] = torque_limit
        np.negative(torque_limit, out=self._lowest)
        # mj_step2 before mj_step1: positions, velocities and contacts are then those after the step, at the cost of mj_step.
        for _ in range(steps):
            mujoco.mj_step2(self.model, self.data)
            mujoco.mj_step1(self.model, self.data)
        self._steps += steps
        if len(self._sunk):
            self._give_way(steps * TIME_STEP_NS / 1e9)
        # One velocity is enough, because a NaN spreads to all joints within a step.
        if not abs(self._qvel[0]) < 1e3 or self._warnings.any():
            raise PhysicsError(f"{self._fault()} at {self.time_ns / 1e9:.3f} s; check the commands before that time")

    def _fault(self) -> str:
        """Return what is wrong with the physics."""
        kinds = np.flatnonzero(self._warnings).tolist()
        texts = [mujoco.mju_warningText(kind, int(self.data.warning.lastinfo[kind])) for kind in kinds]
        return f"the physics has diverged: {' '.join(texts)}" if texts else "the physics has diverged"

    def _give_way(self, dt: float) -> None:
        """Lower the overloaded weak boxes for a duration [s], up to their final depth."""
        weak = self.terrain.weak
        self._gives |= self._pressed > weak.bears
        self.sink(np.where(self._gives, np.minimum(self._sunk + _SINKING * dt, weak.sinks), 0.0))

    def sink(self, sunk: Array) -> None:
        """Set the sinking depths (n,) [m] of the weak boxes below their original height."""
        self._sunk[:] = sunk
        self.data.mocap_pos[:, 2] = self.terrain.boxes.centre[self.terrain.weak.box, 2] - sunk
        mujoco.mj_kinematics(self.model, self.data)

    @property
    def sunk(self) -> Array:
        """Sinking depths (n,) [m] of the weak boxes."""
        return np.array(self._sunk)

    @property
    def time_ns(self) -> int:
        """Simulated time [ns] since the world was built."""
        return self._steps * TIME_STEP_NS

    @property
    def q(self) -> Array:
        """Joint angles (6, 3) [rad]."""
        return np.array(self._q)

    @property
    def qd(self) -> Array:
        """Joint rates (6, 3) [rad/s]."""
        return np.array(self._qd)

    @property
    def torque(self) -> Array:
        """Motor torques (6, 3) [N m] in the last step, before friction."""
        return np.array(self._torque)

    @property
    def T_world_body(self) -> Array:
        """Body pose (4, 4)."""
        return transform(self._body_axes.reshape(3, 3), self._body_position)

    @property
    def body_twist(self) -> Array:
        """Velocity of the body's origin [m/s] and angular rate [rad/s], (6,) {body}."""
        return np.concatenate([self._qvel[:3] @ self._body_axes.reshape(3, 3), self._qvel[3:6]])

    @property
    def p_world_foot(self) -> Array:
        """Centres of the feet (6, 3) [m] {world}."""
        return np.asarray(self._geom_position[self._foot_geoms])  # indexing with an array returns a copy

    def robot_solids(self) -> tuple[Boxes, Capsules]:
        """Return the robot in its current pose, for the renderer.

        Returns:
            The trunk as a box; 18 links in the order (leg, link), then 6 feet, as capsules.
        """
        trunk, links, feet = self._trunk_geom, self._link_geoms, self._foot_geoms
        position, axes = self._geom_position, self.data.geom_xmat
        half = self.model.geom_size[trunk]
        boxes = Boxes(np.array(position[trunk])[None], np.array(half)[None], np.array(axes[trunk]).reshape(1, 3, 3))
        start, ends = self.data.xpos[self._link_bodies], position[feet]
        tips = np.concatenate([2.0 * position[links] - start, ends])
        return boxes, Capsules(np.concatenate([start, ends]), tips, self._radii)

    @property
    def foot_force(self) -> Array:
        """Normal force (6,) [N] of the ground on each foot in the last step."""
        return np.array(self._sensors[:6])

    @property
    def foot_contact(self) -> NDArray[np.bool_]:
        """Contact state (6,) of each foot in the last step.

        Scraping feet bounce, so debounce it over about 20 ms.
        """
        return np.asarray(self._sensors[:6] > 0.0)

    @property
    def leg_contact(self) -> NDArray[np.bool_]:
        """Contact state (6,) of each leg in the last step, by its foot or its shank.

        The shank has contact when it leans on an edge.
        """
        return np.asarray(self._sensors[6:12] > 0.0)

    @property
    def imu(self) -> tuple[Array, Array]:
        """True angular rate and specific force of the body's origin.

        They are (3,) [rad/s] and (3,) [m/s^2], {body}.

        Raises:
            ValueError: The world was built without an IMU.
        """
        if self._imu is None:
            raise ValueError("a world built with imu=True expected, found one without")
        return np.array(self._sensors[12:15]), np.array(self._sensors[15:18])


def _disable_log() -> None:
    """Keep MuJoCo from writing warnings to a file in the working directory; `World.step` raises them."""
    config = mujoco.MjLogConfig.get()
    config.logto_file = False
    config.set()


def _joint_angles(q: ArrayLike) -> Array:
    q = np.asarray(q, dtype=np.float64)
    if q.shape != (6, 3) or not np.all(np.isfinite(q)):
        raise ValueError(f"finite joint angles (6, 3) expected, found {q.shape} with {np.sum(~np.isfinite(q))} bad values")
    return q


def _spec(profile: RobotProfile, terrain: Terrain, factors: Factors, imu: bool) -> Any:
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
    spec.memory = 64 << 20  # [bytes] a robot that lies on a fine height field has hundreds of contacts
    friction = [_FRICTION[0] * factors.ground_friction, *_FRICTION[1:]]
    _add_terrain(spec, terrain, friction)
    _add_robot(spec, profile, factors, friction, imu)
    _add_weak(spec, terrain, friction)
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
    }


def _add_terrain(spec: Any, terrain: Terrain, friction: list[float]) -> None:
    solid, world = _ground(friction), spec.worldbody
    ground = terrain.carrying_boxes()
    if terrain.plane is not None and not len(ground):
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        world.add_geom(name="plane", type=plane, size=[0, 0, 0.05], pos=[0, 0, terrain.plane], **solid)
    for kind, boxes in (("box", terrain.boxes), ("ground", ground)):
        for i, (centre, half, quat) in enumerate(zip(boxes.centre, boxes.half, quaternion_from_rotation(boxes.R), strict=True)):
            if kind == "box" and i in terrain.weak.box:
                continue
            world.add_geom(name=f"{kind} {i}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=half, quat=quat, **solid)
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
    body.add_geom(name="trunk", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, **solid)
    # The inertia is that of a uniform box of the trunk's size, centred at the profile's centre of mass.
    body.explicitinertial, body.mass, body.ipos = True, profile.body.mass, profile.body.centre_of_mass
    body.inertia = profile.body.mass / 3.0 * (np.sum(half**2) - half**2)
    links = (profile.links.coxa, profile.links.femur, profile.links.tibia)
    up = [0.0, -1.0, 0.0]  # a positive rotation about -y lifts a link that points along x
    for leg, (name, T) in enumerate(zip((part.name for part in profile.legs), profile.T_body_coxa, strict=True)):
        parent: Any = body
        position, quat = T[:3, 3], quaternion_from_rotation(T[:3, :3])
        for joint, (part, axis) in enumerate(zip(JOINTS, ([0.0, 0.0, 1.0], up, up), strict=True)):
            label, end = f"{part} {name}", links[joint]
            link = parent.add_body(name=label, pos=position, quat=quat)
            low, high = profile.joint_limits[leg, joint] + np.array([-_LIMIT_MARGIN, _LIMIT_MARGIN])
            hinge = link.add_joint(name=label, type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
            hinge.limited, hinge.range = mujoco.mjtLimited.mjLIMITED_TRUE, [low, high]
            hinge.damping = [profile.servo.damping, 0.0, 0.0]  # linear damping only
            hinge.armature = profile.servo.armature * factors.armature[leg, joint]
            hinge.frictionloss = profile.servo.friction * factors.joint_friction[leg, joint]
            tip = end - profile.foot.radius if part == "tibia" else end  # only the foot sphere reaches the ground
            link.add_geom(
                name=label,
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                fromto=[0, 0, 0, tip, 0, 0],
                size=[_LINK_RADIUS[joint], 0, 0],
                mass=profile.body.leg_link_masses[joint],
                **solid,
            )
            servo = spec.add_actuator(name=label, target=label, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=profile.servo.stiffness)
            servo.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            servo.forcerange = [-profile.servo.stall_torque, profile.servo.stall_torque]
            parent, position, quat = link, np.array([end, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        foot = {"pos": [links[2], 0.0, 0.0], "type": sphere}
        parent.add_geom(name=f"foot {name}", size=[profile.foot.radius, 0, 0], mass=0.0, priority=1, **foot, **solid)
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
