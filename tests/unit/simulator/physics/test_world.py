from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.services.simulator.physics.model import TIME_STEP_NS, Factors
from sextant.services.simulator.physics.solids import Boxes, HeightField
from sextant.services.simulator.physics.terrain import Terrain, build_terrain
from sextant.services.simulator.physics.world import PhysicsError, World
from sextant.services.simulator.sensors.imu import Imu, ImuNoise
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.stability import centre_of_mass
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal, Scenario, Variation
from sextant.shared.scenario.terrain import Patches, Pillars, Plane, Rubble, Slope

NO_BOXES = Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
FLAT = Terrain(NO_BOXES, plane=0.0)
ABYSS = Terrain(NO_BOXES)
PROFILE = load_profile("phantomx_mk2")
RIGID, STRONG = 18.0, PROFILE.servo.stall_torque


def leg_points(profile: RobotProfile, q: Array) -> Array:
    """Return leg points (6, 4, 3) [m] {body}, by trigonometry from the profile alone.

    The points are the coxa, femur and tibia axes and the foot's centre.
    """
    links, points = profile.links, np.zeros((6, 4, 3))
    for i, leg in enumerate(profile.legs):
        yaw = np.radians(leg.neutral_yaw_deg) + q[i, 0]
        reach, height = [0.0, links.coxa], [0.0, 0.0]
        for length, angle in ((links.femur, q[i, 1]), (links.tibia, q[i, 1] + q[i, 2])):
            reach.append(reach[-1] + length * np.cos(angle))
            height.append(height[-1] + length * np.sin(angle))
        points[i] = leg.mount_xyz + np.outer(reach, [np.cos(yaw), np.sin(yaw), 0.0]) + np.outer(height, [0.0, 0.0, 1.0])
    return points


def standing_angles(profile: RobotProfile) -> Array:
    """Return joint angles (6, 3) of the resting stance, by the law of cosines."""
    links = profile.links
    reach = profile.foot_radii - links.coxa
    drop = profile.foot.radius - profile.stance.body_height
    d = np.hypot(reach, drop)
    knee = np.arccos((links.femur**2 + links.tibia**2 - d**2) / (2 * links.femur * links.tibia))
    hip = np.arccos((links.femur**2 + d**2 - links.tibia**2) / (2 * links.femur * d))
    return np.column_stack([np.zeros(6), np.arctan2(drop, reach) + hip, knee - np.pi])


def random_angles(rng: np.random.Generator) -> Array:
    limits = PROFILE.joint_limits
    return rng.uniform(limits[..., 0], limits[..., 1])


def tilt(world: World) -> float:
    return float(np.arccos(np.clip(world.T_world_body[2, 2], -1.0, 1.0)))


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (0.03, -0.02, 0.05)])
def test_model_centre_of_mass_matches_profile(centre: tuple[float, float, float]) -> None:
    profile = replace(PROFILE, body=replace(PROFILE.body, centre_of_mass=centre))
    rng, world = np.random.default_rng(1), World(profile, ABYSS)
    assert world.model.body_subtreemass[0] == pytest.approx(profile.body.total_mass)
    for _ in range(10):
        q, T = random_angles(rng), from_xyz_rpy(rng.normal(size=3), rng.uniform(-1, 1, 3))
        world.place(q, T)
        np.testing.assert_allclose(world.data.subtree_com[0], apply(T, centre_of_mass(profile, q)), atol=2e-3)


def test_model_kinematics_match_profile() -> None:
    rng = np.random.default_rng(0)
    world = World(PROFILE, ABYSS)
    for _ in range(20):
        q, T = random_angles(rng), from_xyz_rpy(rng.normal(size=3), rng.uniform(-1, 1, 3))
        world.place(q, T)
        points = apply(T, leg_points(PROFILE, q))
        np.testing.assert_allclose(world.q, q, atol=1e-12)
        np.testing.assert_allclose(world.T_world_body, T, atol=1e-12)
        np.testing.assert_allclose(world.p_world_foot, points[:, 3], atol=1e-12)
        trunk, capsules = world.robot_solids()
        np.testing.assert_allclose(trunk.centre[0], T[:3, 3], atol=1e-12)
        np.testing.assert_allclose(2 * trunk.half[0], PROFILE.body.size)
        np.testing.assert_allclose(capsules.start[:18], points[:, :3].reshape(18, 3), atol=1e-12)
        links = capsules.end[:18].reshape(6, 3, 3)
        np.testing.assert_allclose(links[:, :2], points[:, 1:3], atol=1e-12)
        # The tibia ends inside the foot's sphere, so that only the sphere meets the ground.
        np.testing.assert_allclose(np.linalg.norm(links[:, 2] - points[:, 3], axis=1), PROFILE.foot.radius, atol=1e-12)
        np.testing.assert_allclose(capsules.start[18:], points[:, 3], atol=1e-12)


def test_model_mass_matches_profile() -> None:
    world = World(PROFILE, FLAT)
    assert world.model.body_mass.sum() == pytest.approx(PROFILE.body.total_mass)
    assert np.all(world.model.body_inertia[1:] > 0)


def test_standing_robot_is_still_and_level_on_six_feet() -> None:
    q = standing_angles(PROFILE)
    world = World(PROFILE, FLAT)
    T = world.stand(q, (0.4, -0.2), 0.7)
    assert T[2, 3] == pytest.approx(PROFILE.stance.body_height)
    feet = world.p_world_foot
    for _ in range(1000):
        world.step(q, RIGID, STRONG)
        assert tilt(world) < np.radians(0.5)
    assert world.time_ns == 1000 * TIME_STEP_NS
    np.testing.assert_allclose(world.T_world_body[:2, 3], [0.4, -0.2], atol=1e-4)
    np.testing.assert_allclose(world.p_world_foot, feet, atol=1e-3)
    assert np.all(world.foot_contact)
    assert np.all(world.leg_contact)
    assert world.foot_force.sum() == pytest.approx(9.81 * PROFILE.body.total_mass, rel=1e-3)
    np.testing.assert_allclose(world.body_twist, 0.0, atol=1e-3)
    assert world.T_world_body[2, 3] > PROFILE.stance.body_height - 0.005  # servos sag a little


def test_robot_is_placed_on_terrain_below_its_feet() -> None:
    terrain = build_terrain(load_scenario("steps"), np.random.default_rng(3))
    world = World(PROFILE, terrain)
    world.stand(standing_angles(PROFILE), (1.4, 0.0))
    gaps = world.p_world_foot[:, 2] - PROFILE.foot.radius - terrain.height_at(world.p_world_foot[:, :2])
    assert gaps.min() == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(ValueError, match="ground below every foot expected, found none below left front, right front"):
        World(PROFILE, ABYSS).stand(standing_angles(PROFILE))


def test_robot_without_torque_falls() -> None:
    q = standing_angles(PROFILE)
    world = World(PROFILE, FLAT)
    world.stand(q)
    for _ in range(2000):
        world.step(q, RIGID, 0.0)
        np.testing.assert_array_equal(world.torque, 0.0)
    assert world.T_world_body[2, 3] < 0.7 * PROFILE.stance.body_height


def test_zero_torque_of_one_joint_does_not_affect_others() -> None:
    q = standing_angles(PROFILE)
    world = World(PROFILE, FLAT)
    world.stand(q)
    limit = np.full((6, 3), STRONG)
    limit[2, 1] = 0.0
    for _ in range(200):
        world.step(q, np.full((6, 3), RIGID), limit)
    assert world.torque[2, 1] == 0.0
    assert np.all(np.abs(world.torque[[0, 1, 3, 4, 5], 1]) > 0.01)


def test_servo_torque_and_speed_stay_within_data_sheet() -> None:
    world = World(PROFILE, ABYSS)
    low, high = PROFILE.joint_limits[..., 0], PROFILE.joint_limits[..., 1]
    world.place(0.5 * (low + high), from_xyz_rpy((0, 0, 5), (0, 0, 0)))
    fastest = 0.0
    for step in range(600):
        world.step(high if step // 100 % 2 == 0 else low, 50.0, STRONG)
        assert np.abs(world.torque).max() <= STRONG + 1e-12
        fastest = max(fastest, float(np.abs(world.qd[:, 0]).max()))
    assert 0.6 * PROFILE.servo.no_load_speed < fastest < 1.1 * PROFILE.servo.no_load_speed


def test_joint_directions_match_profile() -> None:
    world = World(PROFILE, ABYSS)
    for leg in range(6):
        for joint in range(3):
            world.place(np.zeros((6, 3)), from_xyz_rpy((0, 0, 2), (0, 0, 0)))
            target = np.zeros((6, 3))
            target[leg, joint] = 0.2
            for _ in range(150):
                world.step(target, RIGID, STRONG)
            assert world.q[leg, joint] == pytest.approx(0.2, abs=0.03)


def test_simulation_is_bit_reproducible() -> None:
    terrain = build_terrain(load_scenario("steps"), np.random.default_rng(1))
    worlds = []
    for _ in range(2):
        rng = np.random.default_rng(5)
        world = World(PROFILE, terrain, Factors.draw(Variation(), rng))
        q = standing_angles(PROFILE)
        world.stand(q, (1.2, 0.0))
        for _ in range(300):
            world.step(q + rng.normal(0.0, 0.1, (6, 3)), RIGID, STRONG)
        worlds.append(world)
    one, two = worlds
    assert one.data.qpos.tobytes() == two.data.qpos.tobytes()
    assert one.data.qvel.tobytes() == two.data.qvel.tobytes()


def test_placing_robot_again_resets_state_but_not_time() -> None:
    q = standing_angles(PROFILE)
    fresh, used = World(PROFILE, FLAT), World(PROFILE, FLAT)
    fresh.stand(q)
    used.stand(q + 0.1)
    for _ in range(50):
        used.step(q, RIGID, STRONG)
    used.stand(q)
    for world in (fresh, used):
        for _ in range(50):
            world.step(q, RIGID, STRONG)
    np.testing.assert_array_equal(fresh.data.qpos, used.data.qpos)
    assert used.time_ns == 100 * TIME_STEP_NS


def test_variation_stays_within_its_bounds_and_reaches_the_model() -> None:
    rng = np.random.default_rng(2)
    factors = Factors.draw(Variation(armature=2.0, friction=1.2), rng)
    assert factors.armature.min() >= 0.5
    assert factors.armature.max() <= 2.0
    assert factors.joint_friction.min() >= 1 / 1.2
    assert factors.joint_friction.max() <= 1.2
    world = World(PROFILE, FLAT, factors)
    np.testing.assert_allclose(world.model.dof_armature[6:].reshape(6, 3), PROFILE.servo.armature * factors.armature)
    np.testing.assert_allclose(world.model.dof_frictionloss[6:].reshape(6, 3), PROFILE.servo.friction * factors.joint_friction)
    foot = world.model.geom("foot left front")
    assert foot.friction[0] == pytest.approx(0.8 * factors.ground_friction)
    with pytest.raises(ValueError, match="at least 1"):
        Factors.draw(Variation(friction=0.9), rng)


def test_body_twist_is_in_the_body_frame() -> None:
    world = World(PROFILE, ABYSS)
    world.place(np.zeros((6, 3)), from_xyz_rpy((0, 0, 3), (0, 0.3, 1.2)))
    for _ in range(100):
        world.step(np.zeros((6, 3)), RIGID, STRONG)
    T0, twist = world.T_world_body, world.body_twist
    world.step(np.zeros((6, 3)), RIGID, STRONG)
    moved = (world.T_world_body[:3, 3] - T0[:3, 3]) / (TIME_STEP_NS / 1e9)
    np.testing.assert_allclose(T0[:3, :3] @ twist[:3], moved, atol=0.03)
    assert twist[0] > 0.2
    assert abs(twist[1]) < 0.05


def test_imu_at_rest_measures_gravity_upward() -> None:
    q = standing_angles(PROFILE)
    world = World(PROFILE, FLAT, imu=True)
    world.stand(q)
    for _ in range(1000):
        world.step(q, RIGID, STRONG)
    rate, force = world.imu
    np.testing.assert_allclose(rate, 0.0, atol=2e-3)
    np.testing.assert_allclose(force, [0.0, 0.0, 9.81], atol=0.03)
    with pytest.raises(ValueError, match="imu=True"):
        _ = World(PROFILE, FLAT).imu


def test_imu_noise_has_specified_bias_and_density() -> None:
    noise = ImuNoise(gyro_walk=0.0, force_walk=0.0)
    imu, dt = Imu(noise, np.random.default_rng(0)), 0.01
    readings = [imu.update(np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 9.81]), dt) for _ in range(4000)]
    gyro, force = (np.array(column) for column in zip(*readings, strict=True))
    for values, truth, density, bias in (
        (gyro, [0.1, 0.2, 0.3], noise.gyro_density, noise.gyro_bias),
        (force, [0.0, 0.0, 9.81], noise.force_density, noise.force_bias),
    ):
        np.testing.assert_allclose(values.std(axis=0), density / np.sqrt(dt), rtol=0.05)
        offset = np.abs(values.mean(axis=0) - truth)
        assert np.all(offset < 4 * bias)
        assert np.any(offset > 0.1 * bias)
    with pytest.raises(ValueError, match="positive interval"):
        imu.update(np.zeros(3), np.zeros(3), 0.0)


def test_invalid_world_inputs_are_refused() -> None:
    world = World(PROFILE, FLAT)
    with pytest.raises(ValueError, match=r"joint angles \(6, 3\) expected, found \(18,\)"):
        world.place(np.zeros(18), np.eye(4))
    with pytest.raises(ValueError, match="bad values"):
        world.place(np.full((6, 3), np.nan), np.eye(4))
    with pytest.raises(ValueError, match="body pose"):
        world.place(np.zeros((6, 3)), np.eye(3))
    world.stand(standing_angles(PROFILE))
    with pytest.raises(ValueError, match="finite setpoints"):
        world.step(np.full((6, 3), np.nan), RIGID, STRONG)
    world.stand(standing_angles(PROFILE))
    world.data.qvel[:] = 1e4
    with pytest.raises(PhysicsError, match=r"the physics has diverged at 0\.\d+ s"):
        world.step(standing_angles(PROFILE), RIGID, STRONG)


def test_warning_of_mujoco_is_an_error_and_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    world = World(PROFILE, FLAT)
    world.stand(standing_angles(PROFILE))
    world.data.qvel[7] = 1e12  # of one joint; the body's own velocity is valid
    with pytest.raises(PhysicsError, match=r"the physics is invalid \([^.]* in Q(POS|VEL|ACC) at DOF \d+\) at 0\.\d+ s"):
        world.step(standing_angles(PROFILE), RIGID, STRONG)
    assert not list(tmp_path.iterdir())
    world.stand(standing_angles(PROFILE))  # a robot that is placed again starts without the warning
    world.step(standing_angles(PROFILE), RIGID, STRONG)


def rolling() -> Terrain:
    x = 0.04 * np.arange(41)
    waves = 0.02 * np.sin(5 * x)[:, None] * np.cos(4 * x)
    return Terrain(NO_BOXES, HeightField(waves, 0.04, (-0.8, -0.8)))


@pytest.mark.parametrize(
    "terrain",
    [
        rolling(),
        build_terrain(Scenario("slope", (Slope((-1.0, 0.0), 12.0, 2.0, 2.0),), Goal(1.0)), np.random.default_rng(0)),
        build_terrain(
            Scenario("rubble", (Plane(), Rubble((-0.4, 0.4), (-0.4, 0.4), 12, (0.1, 0.2), (0.01, 0.04))), Goal(1.0)),
            np.random.default_rng(0),
        ),
    ],
    ids=["height field", "slope", "rubble"],
)
def test_standing_robot_does_not_creep_on_any_ground(terrain: Terrain) -> None:
    q = standing_angles(PROFILE)
    world = World(PROFILE, terrain)
    world.stand(q)
    for _ in range(500):
        world.step(q, RIGID, STRONG)
    settled = world.p_world_foot
    ground = terrain.height_at(settled[:, :2])
    carried = np.zeros(6)
    for _ in range(500):
        world.step(q, RIGID, STRONG)
        carried += world.foot_force / 500
    assert np.linalg.norm(world.p_world_foot - settled, axis=1).max() < 2e-4
    standing = world.foot_contact
    assert standing.sum() >= 3
    # On a slope a foot touches next to its lowest point, so its centre is at least a radius above the ground below it.
    assert np.all(settled[:, 2] - ground > PROFILE.foot.radius - 1e-3)
    # Normal forces lean with the ground, so their sum differs a little from the weight.
    assert carried.sum() == pytest.approx(9.81 * PROFILE.body.total_mass, rel=0.1)


@pytest.mark.parametrize("leg", range(6))
def test_shank_on_edge_counts_as_leg_contact_but_not_foot_contact(leg: int) -> None:
    q, T = standing_angles(PROFILE), from_xyz_rpy((0.0, 0.0, 0.5), (0.0, 0.0, 0.0))
    q[leg, 2] += np.radians(50.0)  # the tibia slants outwards
    knee, foot = apply(T, leg_points(PROFILE, q)[leg, 2:])
    middle = 0.5 * (knee + foot)
    half = np.array([0.005, 0.005, (middle[2] - 0.005) / 2])  # the top is slightly within the tibia
    block = Boxes(np.array([[*middle[:2], half[2]]]), half[None], np.eye(3)[None])
    world = World(PROFILE, Terrain(block))
    world.place(q, T)
    world.step(q, RIGID, STRONG)
    np.testing.assert_array_equal(world.leg_contact, np.arange(6) == leg)
    assert not world.foot_contact.any()


def pillars_under_feet(bears: float) -> Terrain:
    """Return a pillar under each foot of the resting stance, one of them weak."""
    world = World(PROFILE, FLAT)
    world.stand(standing_angles(PROFILE))
    xy = tuple((float(x), float(y)) for x, y, _ in world.p_world_foot)
    pillars = Pillars(xy, 0.08, 0.0, weak=1, bears=bears, sinks=0.05)
    return build_terrain(Scenario("pillars", (pillars,), Goal(1.0)), np.random.default_rng(0))


def test_weak_pillar_sinks_under_load_and_stays_down() -> None:
    q, world = standing_angles(PROFILE), World(PROFILE, pillars_under_feet(2.0))
    (leg,) = world.terrain.weak.box
    world.stand(q)
    assert world.sunk == 0.0
    for _ in range(150):
        world.step(q, RIGID, STRONG, steps=2)
    assert world.sunk == pytest.approx(0.05)
    assert not world.foot_contact[leg]
    assert world.foot_contact.sum() >= 4
    assert tilt(world) < 0.1
    assert world.terrain.sink_at(world.p_world_foot[:, :2]) == pytest.approx(np.where(np.arange(6) == leg, 0.05, 0.0))
    raised = q.copy()
    raised[leg, 1] += 0.5  # no load on it now
    for _ in range(50):
        world.step(raised, RIGID, STRONG, steps=2)
    assert world.sunk == pytest.approx(0.05)


def test_pillar_with_sufficient_capacity_does_not_sink() -> None:
    q, world, firm = standing_angles(PROFILE), World(PROFILE, pillars_under_feet(20.0)), pillars_under_feet(20.0)
    world.stand(q)
    other = World(PROFILE, Terrain(firm.boxes))
    other.stand(q)
    for _ in range(100):
        world.step(q, RIGID, STRONG, steps=2)
        other.step(q, RIGID, STRONG, steps=2)
    assert world.sunk == 0.0
    assert world.foot_contact.all()
    np.testing.assert_allclose(world.p_world_foot, other.p_world_foot, atol=1e-6)


def pillar_beside_foot(off: float) -> Terrain:
    """Return a tipping pillar whose middle is `off` [m] behind the first foot, and firm ones under the other feet."""
    world = World(PROFILE, FLAT)
    world.stand(standing_angles(PROFILE))
    (x, y, _), *others = world.p_world_foot.tolist()
    firm = Pillars(tuple((a, b) for a, b, _ in others), 0.10, 0.0)
    tipping = Pillars(((x - off, y),), 0.20, 0.0, tipping=1, bears_within=0.03, tip_height=0.04, tip_mass=0.2)
    return build_terrain(Scenario("pillars", (firm, tipping), Goal(1.0)), np.random.default_rng(0))


@pytest.mark.parametrize(("off", "tips"), [(0.0, False), (0.028, False), (-0.028, False), (0.08, True), (-0.08, True)])
def test_pillar_tips_only_when_loaded_beyond_its_base(off: float, tips: bool) -> None:
    q, world = standing_angles(PROFILE), World(PROFILE, pillar_beside_foot(off))
    world.stand(q)
    for _ in range(150):
        world.step(q, RIGID, STRONG, steps=2)
    assert (np.degrees(world.tipped[0]) > 0.2) == tips
    load = float(world.foot_force[0])
    assert load > 1.0
    if tips:  # about the edge, load and weight balance but for friction, whose lever arm is the height of the box
        assert abs(load * (abs(off) - 0.03) - 0.2 * 9.81 * 0.03) < 0.8 * load * 0.04


def test_tipped_pillar_falls_back_without_load() -> None:
    q, world = standing_angles(PROFILE), World(PROFILE, pillar_beside_foot(0.08))
    world.stand(q)
    pressed, raised = q.copy(), q.copy()
    pressed[0, 1] -= 0.15
    raised[0, 1] += 0.5
    for _ in range(100):
        world.step(pressed, RIGID, STRONG, steps=2)
    assert np.degrees(world.tipped[0]) > 5.0
    for _ in range(200):
        world.step(raised, RIGID, STRONG, steps=2)
    assert np.degrees(world.tipped[0]) < 0.5
    np.testing.assert_allclose(world.loose_boxes.centre, world.terrain.boxes.centre[world.terrain.tipping.box], atol=1e-3)


def test_foot_has_the_friction_of_the_patch_under_it() -> None:
    everywhere = Patches((0.0, 0.0), (0.0, 0.0), 1, (9.0, 9.0), (0.2,))
    terrain = build_terrain(Scenario("patch", (Plane(), everywhere), Goal(1.0)), np.random.default_rng(0))
    factors = Factors(np.ones((6, 3)), np.ones((6, 3)), 1.0, foot_friction=np.linspace(0.9, 1.1, 6))
    world = World(PROFILE, terrain, factors)
    q = standing_angles(PROFILE)
    world.stand(q)
    world.step(q, RIGID, STRONG)
    feet = [world.model.geom(f"foot {leg.name}").friction[0] for leg in PROFILE.legs]
    np.testing.assert_allclose(feet, 0.2 * np.linspace(0.9, 1.1, 6))
