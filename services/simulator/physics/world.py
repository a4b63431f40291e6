"""Simulated physics of a hexapod with 18 servo joints on a terrain, by MuJoCo.

Setpoint, stiffness and torque limit are inputs of each step, because they are registers of the real servos.
"""

from math import isfinite
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sextant.services.simulator.physics.model import FRICTION, TIME_STEP_NS, Factors, model_spec
from sextant.services.simulator.physics.solids import Boxes, Capsules
from sextant.services.simulator.physics.terrain import Terrain
from sextant.shared.errors import SextantError
from sextant.shared.files.config import ConfigError
from sextant.shared.geometry import Array, quaternion_from_rotation, rotation_z, transform
from sextant.shared.robot.profile import JOINTS, RobotProfile
from sextant.shared.scenario.mismatch import PATCH_EDGE_M

_SINKING = 0.25  # [m/s] sinking speed of weak boxes


class PhysicsError(SextantError, FloatingPointError):
    """The physics is no longer valid."""

    exit_status = 1


class World:
    """Simulated robot on a terrain, with a time step of 2 ms.

    Call `place` or `stand` before the first step. Values that are read after a step belong to the end of that step. Forces and
    torques are an exception: they are those that acted during the step.
    """

    def __init__(
        self,
        profile: RobotProfile,
        terrain: Terrain,
        factors: Factors | None = None,
        imu: bool = False,
        patches: Array | None = None,
    ):
        """Build the MuJoCo model.

        Args:
            profile: The robot.
            terrain: The ground.
            factors: Deviation of the physics from the profile, `Factors.none()` by default.
            imu: Whether to simulate an IMU at the body's origin.
            patches: (n, n) [1] factors of the ground's friction by patch along x and y; they repeat. By default 1 everywhere.
        """
        _disable_log()
        self.profile, self.terrain = profile, terrain
        spec = model_spec(profile, terrain, Factors.none() if factors is None else factors, imu)
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
        self._q, self._qd = d.qpos[7:25].reshape(6, 3), d.qvel[6:24].reshape(6, 3)
        self._body_position, self._body_axes = d.xpos[body], d.xmat[body]
        self._geom_position = d.geom_xpos
        self._warnings = d.warning.number  # of each kind, since the robot was placed
        self._steps = 0
        self._imu = slice(12, 18) if imu else None
        self._patches = None if patches is None or bool((patches == 1.0).all()) else patches
        self._foot_friction = np.array(m.geom_friction[self._foot_geoms, 0])  # (6,) [1] sliding, where the patch is 1
        self._pressed = d.sensordata[len(d.sensordata) - len(terrain.weak) :]  # (n,) [N] load on the weak boxes
        loose = [f"weak {i}" for i in terrain.weak.box] + [f"tipping {i}" for i in terrain.tipping.box]
        self._loose_geoms = np.array([int(m.geom(name).id) for name in loose], dtype=np.intp)
        self._tipped = d.qpos[25:].reshape(-1, 4)  # [rad] angles of the hinges of the tipping boxes
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
        if self._patches is not None or len(self.terrain.friction):
            self.model.geom_friction[self._foot_geoms, 0] = self._friction()  # a foot's friction replaces that of the ground
        # mj_step2 before mj_step1: positions, velocities and contacts are then those after the step, at the cost of mj_step.
        for _ in range(steps):
            mujoco.mj_step2(self.model, self.data)
            mujoco.mj_step1(self.model, self.data)
        self._steps += steps
        if len(self._sunk):
            self._give_way(steps * TIME_STEP_NS / 1e9)
        # One velocity is enough, because a NaN spreads to all joints within a step.
        if not abs(self._qvel[0]) < 1e3 or self._warnings.tobytes().strip(b"\0"):
            raise PhysicsError(f"{self._fault()} at {self.time_ns / 1e9:.3f} s; check the commands before that time")

    def _friction(self) -> Array:
        """Return the friction (6,) of the feet where they are."""
        xy, friction = self._geom_position[self._foot_geoms, :2], self._foot_friction
        if self._patches is not None:
            patch = np.floor(xy / PATCH_EDGE_M).astype(int) % len(self._patches)
            friction = friction * self._patches[patch[:, 0], patch[:, 1]]
        if len(self.terrain.friction):
            on_patch = self.terrain.friction.at(xy)
            friction = np.where(np.isnan(on_patch), friction, friction * on_patch / FRICTION)
        return np.asarray(friction)

    def _fault(self) -> str:
        """Return what is wrong with the physics."""
        if not self._warnings.any():
            return "the physics has diverged"
        kind = int(np.argmax(self._warnings > 0))
        text = mujoco.mju_warningText(kind, int(self.data.warning.lastinfo[kind]))
        return f"the physics is invalid ({text.partition('. ')[0].rstrip('.')})"

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
    def tipped(self) -> Array:
        """Angles (n,) [rad] by which the tipping boxes have tipped."""
        return np.asarray(np.hypot(*np.abs(self._tipped.reshape(-1, 2, 2)).max(axis=2).T))

    @property
    def loose_boxes(self) -> Boxes:
        """The weak boxes, then the tipping boxes, where they are now."""
        loose = self._loose_geoms
        axes = np.array(self.data.geom_xmat[loose]).reshape(-1, 3, 3)
        return Boxes(np.array(self._geom_position[loose]), np.array(self.model.geom_size[loose]), axes)

    @property
    def time_ns(self) -> int:
        """Simulated time [ns] since the world was built."""
        return self._steps * TIME_STEP_NS

    @property
    def joints(self) -> tuple[Array, Array, Array]:
        """Views of `q`, `qd` and `torque`, which change at the next step."""
        return self._q, self._qd, self._torque

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
