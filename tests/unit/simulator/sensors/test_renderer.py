import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.simulator.physics.model import ROBOT_GROUP
from sextant.services.simulator.physics.solids import Boxes, HeightField
from sextant.services.simulator.physics.terrain import Terrain, build_terrain
from sextant.services.simulator.physics.world import World
from sextant.services.simulator.sensors.renderer import BOX, FIELD, PLANE, ROBOT, Renderer
from sextant.shared.geometry import Array, from_xyz_rpy, transform
from sextant.shared.robot.camera import Intrinsics
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Box, Pillars, Plane, Rubble, Slope, Stairs
from sextant.shared.scenario.terrain import Terrain as Primitive

PROFILE = load_profile("phantomx_mk2")
XTION = PROFILE.camera.intrinsics
WIDE = Intrinsics(320, 240, 92.4, 100.7, 150.0, 125.0)  # 120 x 100 deg, off centre
OPTICAL = transform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
Q = np.tile([0.0, 0.6, -1.9], (6, 1))


def build(*terrain: Primitive) -> Terrain:
    return build_terrain(Scenario("course", terrain, Goal(1.0)), np.random.default_rng(0))


def rolling(n: int, spacing: float) -> HeightField:
    x = spacing * np.arange(n)
    waves = 0.04 * np.sin(5 * x)[:, None] * np.cos(4 * x)
    return HeightField(waves + np.random.default_rng(2).uniform(0, 0.01, (n, n)), spacing, (-1.2, -1.2))


KINDS = {
    "plane": build(Plane()),
    "boxes": build(Plane(), Box((0.4, 0.3), (0.2, 0.3), 0.08, yaw_deg=30.0), Box((0.7, -0.2), (0.2, 0.2), 0.15)),
    "stairs": build(Plane(), Stairs((0.3, 0.0), 0.05, 0.2, 4, 1.0, yaw_deg=10.0)),
    "slope": build(Plane(), Slope((0.3, 0.0), 20.0, 0.8, 1.0)),
    "pillars": build(Pillars(tuple((0.2 * i - 0.6, 0.2 * j - 0.6) for i in range(10) for j in range(7)), 0.13, 0.0)),
    "rubble": build(Plane(), Rubble((0.4, 2.0), (-0.7, 0.7), 50, (0.08, 0.18), (0.02, 0.08))),
    "height field": Terrain(build(Pillars((), 0.1, 0.1)).boxes, rolling(61, 0.04)),
    "height field on a plane": Terrain(build(Box((0.5, 0.2), (0.2, 0.2), 0.1)).boxes, rolling(41, 0.06), 0.0),
}


def views(rng: np.random.Generator, world: World) -> list[tuple[Array, Intrinsics]]:
    """Return the poses and intrinsics of cameras.

    They are the robot's own camera, some near its legs, some outside, and one between the legs.
    """
    out = [(world.T_world_body @ PROFILE.camera.T_body_camera, XTION)]
    for k in range(4):
        around = 2.0 * np.pi * k / 4 + rng.uniform(0, 1.0)
        place = 0.45 * np.array([np.cos(around), np.sin(around), 0.0]) + [0.0, 0.0, rng.uniform(0.15, 0.35)]
        look = (rng.normal() * 0.2, 0.5, around + np.pi)
        out.append((world.T_world_body @ from_xyz_rpy(place, look) @ OPTICAL, (XTION, WIDE)[k % 2]))
    for _ in range(3):
        look = (rng.normal() * 0.3, rng.uniform(-0.2, 1.4), rng.uniform(-3, 3))
        out.append((from_xyz_rpy([*rng.uniform(-1, 1, 2), rng.uniform(0.2, 0.6)], look) @ OPTICAL, XTION))
    out.append((world.T_world_body @ from_xyz_rpy((0, 0, 0.06), (0.1, 0.3, 0.9)) @ OPTICAL, WIDE))
    return out


def depth_by_rays(
    world: World, T: Array, intrinsics: Intrinsics, u: NDArray[np.int64], v: NDArray[np.int64]
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the depth of pixels (n,) by MuJoCo's rays, and hits on the robot."""
    rays = np.stack([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(len(u))], axis=1)
    geom, depth = np.zeros(len(u), dtype=np.int32), np.zeros(len(u))
    vectors = np.ascontiguousarray(rays @ T[:3, :3].T).ravel()
    mujoco.mj_multiRay(world.model, world.data, T[:3, 3].copy(), vectors, None, 1, -1, geom, depth, None, len(u), 1e6)
    return np.where(geom >= 0, depth, np.inf), (geom >= 0) & (world.model.geom_group[geom] == ROBOT_GROUP)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_rendered_depth_matches_physics_ray_cast(kind: str) -> None:
    rng = np.random.default_rng(7)
    world = World(PROFILE, KINDS[kind])
    world.place(Q + rng.normal(0, 0.1, (6, 3)), from_xyz_rpy((0, 0, 0.16), (0.05, -0.04, 0.3)))
    on_robot = 0
    for T, intrinsics in views(rng, world):
        u, v = rng.integers(0, intrinsics.width, 300), rng.integers(0, intrinsics.height, 300)
        theirs, robot = depth_by_rays(world, T, intrinsics, u, v)
        ours = Renderer(KINDS[kind], intrinsics).depth(T, world.robot_solids())[v, u]
        np.testing.assert_array_equal(np.isfinite(ours), np.isfinite(theirs))
        near = theirs < 5.0
        np.testing.assert_allclose(ours[near], theirs[near], atol=1e-5)
        np.testing.assert_allclose(ours[~near], theirs[~near], rtol=1e-5)
        on_robot += int(robot.sum())
    assert on_robot > 150


def test_sunken_pillars_are_rendered_as_in_physics() -> None:
    rng = np.random.default_rng(8)
    terrain = build(Pillars(((0.6, 0.2), (0.6, -0.2), (0.9, 0.0), (0.3, 0.0)), 0.2, 0.0, weak=2, bears=0.0, sinks=0.06))
    world, renderer = World(PROFILE, terrain), Renderer(terrain, XTION)
    world.place(Q, from_xyz_rpy((0, 0, 1.0), (0.0, 0.0, 0.0)))
    T = from_xyz_rpy((0, 0, 0.4), (0.0, 0.5, 0.0)) @ OPTICAL
    before = renderer.depth(T).copy()
    world.sink(np.array([0.06, 0.02]))
    renderer.settle(world.loose_boxes)
    u, v = rng.integers(0, XTION.width, 500), rng.integers(0, XTION.height, 500)
    theirs, _ = depth_by_rays(world, T, XTION, u, v)
    ours = renderer.depth(T)
    np.testing.assert_allclose(ours[v, u], theirs, atol=1e-5)
    assert (ours != before).any()
    world.sink(np.zeros(2))
    renderer.settle(world.loose_boxes)
    np.testing.assert_allclose(renderer.depth(T), before, atol=1e-6)


def test_tipped_pillars_are_rendered_as_in_physics() -> None:
    rng = np.random.default_rng(8)
    terrain = build(Pillars(((0.6, 0.2), (0.6, -0.2), (0.9, 0.0)), 0.2, 0.0, tipping=2, bears_within=0.05))
    world, renderer = World(PROFILE, terrain), Renderer(terrain, XTION)
    world.place(Q, from_xyz_rpy((0, 0, 1.0), (0.0, 0.0, 0.0)))
    T = from_xyz_rpy((0, 0, 0.4), (0.0, 0.5, 0.0)) @ OPTICAL
    before = renderer.depth(T).copy()
    world.data.qpos[25:] = 0.0, 0.3, 0.2, 0.0, 0.5, 0.0, 0.0, 0.0
    mujoco.mj_kinematics(world.model, world.data)
    renderer.settle(world.loose_boxes)
    u, v = rng.integers(0, XTION.width, 500), rng.integers(0, XTION.height, 500)
    theirs, _ = depth_by_rays(world, T, XTION, u, v)
    ours = renderer.depth(T)
    np.testing.assert_allclose(ours[v, u], theirs, atol=1e-5)
    assert (ours != before).any()


def test_inverse_depth_is_reciprocal_and_zero_in_the_sky() -> None:
    renderer = Renderer(KINDS["boxes"], XTION)
    T = from_xyz_rpy((0, 0, 0.3), (0, 0, 0)) @ OPTICAL
    depth = renderer.depth(T)
    w = renderer.inverse_depth(T)
    sky = ~np.isfinite(depth)
    assert sky[:240].all()
    assert not sky[245:].any()
    np.testing.assert_array_equal(w[sky], 0.0)
    np.testing.assert_allclose(w[~sky] * depth[~sky], 1.0, rtol=1e-6)


def test_rendered_depth_is_independent_of_previous_images() -> None:
    one, two = Renderer(KINDS["rubble"], XTION), Renderer(KINDS["rubble"], XTION)
    rng = np.random.default_rng(1)
    poses = [from_xyz_rpy((0, 0, 0.3), (0, 0.5, yaw)) @ OPTICAL for yaw in rng.uniform(-1, 1, 3)]
    first = [one.depth(T) for T in poses]
    second = [two.depth(T) for T in reversed(poses)][::-1]
    for a, b in zip(first, second, strict=True):
        assert a.tobytes() == b.tobytes()


def test_level_ground_is_seen_from_above_only() -> None:
    down = from_xyz_rpy((0, 0, 0.5), (0, np.pi / 2, 0)) @ OPTICAL
    np.testing.assert_allclose(Renderer(KINDS["plane"], XTION).depth(down), 0.5, atol=1e-6)
    below = from_xyz_rpy((0, 0, -0.5), (0, -np.pi / 2, 0)) @ OPTICAL
    assert not np.isfinite(Renderer(KINDS["plane"], XTION).depth(below)).any()


def test_surfaces_have_the_same_depth_and_show_the_robot_where_it_is_nearer() -> None:
    world = World(PROFILE, KINDS["boxes"])
    world.stand(Q)
    T = from_xyz_rpy((-0.6, 0.5, 0.4), (0, 0.45, -0.7)) @ OPTICAL
    renderer, robot = Renderer(KINDS["boxes"], XTION), world.robot_solids()
    canvas = renderer.surfaces(T, robot)
    np.testing.assert_array_equal(canvas.w, renderer.inverse_depth(T, robot))
    robot_only = Renderer(Terrain(Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))), XTION)
    nearer = np.isfinite(robot_only.depth(T, robot)) & (renderer.depth(T, robot) < renderer.depth(T))
    np.testing.assert_array_equal((canvas.material == ROBOT) & (canvas.w > 0), nearer)
    assert nearer.sum() > 5000
    assert set(np.unique(canvas.material[canvas.w > 0])) == {PLANE, ROBOT, BOX}
    level = (canvas.material == PLANE) & (canvas.w > 0)
    assert (canvas.normal[level] == [0.0, 0.0, 1.0]).all()


def test_surfaces_show_a_height_field_that_a_camera_all_but_touches() -> None:
    renderer = Renderer(KINDS["height field"], WIDE)
    T = from_xyz_rpy((0, 0, 0.06), (0, 0.3, 0.2)) @ OPTICAL
    canvas = renderer.surfaces(T)
    seen = canvas.w > 0
    assert seen.mean() > 0.4
    assert (canvas.material[seen] == FIELD).all()


def test_invalid_camera_pose_is_refused() -> None:
    renderer = Renderer(KINDS["plane"], XTION)
    with pytest.raises(ValueError, match="finite camera pose"):
        renderer.depth(np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match="finite camera pose"):
        renderer.depth(np.eye(3))
