"""The colour camera: images are aligned with depth, and ground keeps its colour.

No two pixels of the ground are alike.
"""

import numpy as np
import pytest

from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.sensors.color_camera import ColorCamera
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.color import ycocg_from_rgb
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Box, Plane, Puddle

PROFILE = load_profile("phantomx_mk2_rgbd")
WET = Scenario(
    "wet", (Plane(), Puddle((1.1, 0.0), (0.3, 0.3)), Box((1.2, 0.5), (0.2, 0.2), 0.05, color=(150, 60, 50))), Goal(1.0)
)
TERRAIN = build_terrain(WET, np.random.default_rng(0))
VIEWS = [
    from_xyz_rpy(xyz, (0.0, 0.0, yaw)) @ PROFILE.camera.T_body_camera
    for xyz, yaw in (((0.1, 0.0, 0.1), 0.0), ((0.3, -0.25, 0.13), 0.4))
]


def camera(seed: int = 0) -> ColorCamera:
    return ColorCamera(Renderer(TERRAIN, PROFILE.camera.intrinsics), TERRAIN, np.random.default_rng(seed))


def ground(T: Array) -> Array:
    """Return the position (h, w, 3) [m] {world} of each pixel."""
    depth = Renderer(TERRAIN, PROFILE.camera.intrinsics).depth(T)
    points = PROFILE.camera.intrinsics.points(np.where(np.isfinite(depth), depth, np.nan))
    return apply(T, points.reshape(-1, 3)).reshape(points.shape)


def inside(p: Array, centre: tuple[float, float], half: float) -> Array:
    return np.asarray((np.abs(p[..., :2] - centre) < half).all(axis=-1))


@pytest.mark.slow
@pytest.mark.parametrize("T", VIEWS)
@pytest.mark.parametrize("seed", [0, 1])
def test_colours_of_puddles_and_blocks_align_with_depth(T: Array, seed: int) -> None:
    color = ycocg_from_rgb(camera(seed).picture(T))
    p = ground(T)
    wet, red = inside(p, (1.1, 0.0), 0.13), inside(p, (1.2, 0.5), 0.09) & (p[..., 2] > 0.049)
    dry = np.isfinite(p[..., 2]) & ~inside(p, (1.1, 0.0), 0.17) & (np.abs(p[..., 2]) < 1e-3) & (p[..., 0] < 2.0)
    orange = color[..., 1] / np.maximum(color[..., 0], 1)
    assert wet.sum() > 500
    assert np.percentile(orange[wet], 99) < np.percentile(orange[dry], 1) - 0.02
    assert np.median(orange[red]) > np.percentile(orange[dry], 99)
    assert np.std(color[dry], axis=0).min() > 1.0, "a colour is not told by equality"


def test_ground_point_keeps_its_colour_between_views() -> None:
    cam = camera()
    one, two = (cam.picture(T).astype(float) for T in VIEWS)
    i = PROFILE.camera.intrinsics
    p = ground(VIEWS[0])[150:450:7, 40:600:11].reshape(-1, 3)
    p = p[(np.abs(p[:, 2]) < 1e-3) & ~inside(p, (1.1, 0.0), 0.17)]
    q = apply(np.linalg.inv(VIEWS[1]), p)
    u, v = np.rint(i.fx * q[:, 0] / q[:, 2] + i.cx).astype(int), np.rint(i.fy * q[:, 1] / q[:, 2] + i.cy).astype(int)
    r = apply(np.linalg.inv(VIEWS[0]), p)
    a, b = np.rint(i.fx * r[:, 0] / r[:, 2] + i.cx).astype(int), np.rint(i.fy * r[:, 1] / r[:, 2] + i.cy).astype(int)
    seen = (u >= 0) & (u < i.width) & (v >= 0) & (v < i.height)
    assert seen.sum() > 300
    before, after = one[b[seen], a[seen]], two[v[seen], u[seen]]
    assert np.median(np.abs(before - after)) < 5.0
    assert np.corrcoef(before[:, 1], after[:, 1])[0, 1] > 0.7


def test_illumination_is_determined_by_seed() -> None:
    np.testing.assert_array_equal(camera(5).picture(VIEWS[0]), camera(5).picture(VIEWS[0]))
    assert np.abs(camera(5).picture(VIEWS[0]).mean() - camera(6).picture(VIEWS[0]).mean()) > 1.0


def test_sky_is_even_and_faces_differ_in_brightness() -> None:
    T = from_xyz_rpy((-0.6, 0.5, 0.4), (0.0, -0.5, -0.7)) @ PROFILE.camera.T_body_camera
    renderer = Renderer(TERRAIN, PROFILE.camera.intrinsics)
    seen, picture = np.isfinite(renderer.depth(T)), camera().picture(T).astype(float)
    assert 100 < (~seen).sum() < seen.sum()
    assert np.ptp(picture[~seen], axis=0).max() <= 2 * 3.0 + 1, "noise of the sensor only"
    assert np.ptp(picture[seen], axis=0).min() > 30.0
