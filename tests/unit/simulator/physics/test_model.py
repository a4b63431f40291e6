"""Exported models: MuJoCo loads URDF and MJCF, and they agree with the kinematics and with the simulator."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from sextant.services.simulator.physics.model import Factors, mjcf, model_spec
from sextant.services.simulator.physics.solids import Boxes
from sextant.services.simulator.physics.terrain import Terrain
from sextant.shared.geometry import Array, apply, quaternion_from_rotation
from sextant.shared.robot.kinematics import body_inverse, leg_forward
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.robot.urdf import urdf

FLAT = Terrain(Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3))), plane=0.0)
PHANTOMX = load_profile("phantomx_mk2")
by_profile = pytest.mark.parametrize("profile", [load_profile(name) for name in profile_names()], ids=lambda p: p.name)


def random_angles(profile: RobotProfile, rng: np.random.Generator) -> Array:
    limits = profile.joint_limits
    return rng.uniform(limits[..., 0], limits[..., 1])


def feet(profile: RobotProfile, q: Array) -> Array:
    return np.array([apply(T, foot) for T, foot in zip(profile.T_body_coxa, leg_forward(q, profile.links), strict=True)])


def spheres(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    return np.array(data.geom_xpos[model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE])


@by_profile
def test_feet_of_urdf_and_mjcf_agree_with_kinematics(profile: RobotProfile) -> None:
    rng = np.random.default_rng(0)
    for text in (urdf(profile), mjcf(profile)):
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        for _ in range(10):
            q = random_angles(profile, rng)
            data.qpos[-18:] = q.ravel()
            mujoco.mj_kinematics(model, data)
            np.testing.assert_allclose(spheres(model, data), feet(profile, q) + data.qpos[:3] * (model.nq > 18), atol=1e-6)


@by_profile
def test_links_of_urdf_have_masses_and_inertias_of_simulator(profile: RobotProfile) -> None:
    found = mujoco.MjModel.from_xml_string(urdf(profile))
    expected = model_spec(profile, FLAT, Factors.none()).compile()
    np.testing.assert_allclose(found.body_mass[-18:], expected.body_mass[-18:], rtol=1e-6)
    np.testing.assert_allclose(np.sort(found.body_inertia[-18:]), np.sort(expected.body_inertia[-18:]), rtol=1e-6)
    np.testing.assert_allclose(found.dof_damping, expected.dof_damping[-18:], rtol=1e-6)


def test_inertias_of_a_profile_are_those_of_the_simulator_and_of_the_urdf() -> None:
    body = replace(PHANTOMX.body, inertia=(0.003, 0.005, 0.007), leg_link_inertias=(0.00005, 0.0001, 0.0002))
    robot = replace(PHANTOMX, body=body)
    for model in (model_spec(robot, FLAT, Factors.none()).compile(), mujoco.MjModel.from_xml_string(urdf(robot))):
        np.testing.assert_allclose(
            np.sort(model.body_inertia[-18:], axis=1)[:3, 1:], [[5e-5] * 2, [1e-4] * 2, [2e-4] * 2], rtol=1e-6
        )
        np.testing.assert_allclose(model.body_mass[-18:].sum(), 6 * sum(body.leg_link_masses))
    trunk = model_spec(robot, FLAT, Factors.none()).compile().body("body")
    np.testing.assert_allclose(trunk.inertia, body.inertia)


@by_profile
def test_mjcf_is_model_of_simulator(profile: RobotProfile) -> None:
    found = mujoco.MjModel.from_xml_string(mjcf(profile))
    expected = model_spec(profile, FLAT, Factors.none()).compile()
    for name in (
        "body_mass",
        "jnt_range",
        "dof_damping",
        "dof_armature",
        "dof_frictionloss",
        "actuator_forcerange",
        "geom_size",
    ):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-5, atol=1e-6, err_msg=name)


@by_profile
def test_robot_of_mjcf_stands_at_its_keyframe(profile: RobotProfile) -> None:
    model = mujoco.MjModel.from_xml_string(mjcf(profile))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    np.testing.assert_allclose(data.qpos[7:], body_inverse(profile, profile.rest_feet()).ravel(), atol=1e-5)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert data.body("body").xmat[8] > np.cos(np.radians(1.0)), "the trunk is level"
    assert data.qpos[2] > profile.stance.body_height - 0.01


@by_profile
def test_camera_of_mjcf_is_depth_camera_of_profile(profile: RobotProfile) -> None:
    model = mujoco.MjModel.from_xml_string(mjcf(profile))
    camera, lens = model.camera("depth"), profile.camera.intrinsics
    T = profile.camera.T_body_camera
    np.testing.assert_allclose(camera.pos, T[:3, 3], atol=1e-6)
    turned = quaternion_from_rotation(T[:3, :3] @ np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_allclose(abs(camera.quat @ turned), 1.0, atol=1e-6)
    assert np.tan(np.radians(camera.fovy[0]) / 2) * lens.fy == pytest.approx(lens.height / 2, rel=1e-4)
