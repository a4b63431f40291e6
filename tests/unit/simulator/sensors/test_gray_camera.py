"""The grey image: texture stays on the ground, light changes, motion blurs."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.simulator.physics.terrain import build_terrain
from sextant.services.simulator.sensors.gray_camera import GrayCamera
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Floor

CAMERA = load_profile("phantomx_mk2_rgbd").camera
RENDERER = Renderer(build_terrain(load_scenario("flat"), np.random.default_rng(0)), CAMERA.intrinsics)
STILL = {"light": 0.0, "noise": 0.0, "exposure_s": 0.0}


def at(x: float, yaw: float = 0.0) -> Array:
    return np.asarray(from_xyz_rpy((x, 0.0, 0.11), (0.0, 0.0, yaw)) @ CAMERA.T_body_camera)


def images(floor: Floor, poses: list[Array], seed: int = 1) -> list[NDArray[np.float64]]:
    """Return the images from some poses, 33 ms apart."""
    camera = GrayCamera(CAMERA.intrinsics, floor, np.random.default_rng(seed))
    return [camera.picture(RENDERER.surfaces(T), T, 0.033 * n).astype(np.float64) for n, T in enumerate(poses)]


def test_image_has_the_size_of_the_grey_lens() -> None:
    (image,) = images(Floor(), [at(0.0)])
    assert image.shape == (CAMERA.intrinsics.gray.height, CAMERA.intrinsics.gray.width) == (240, 320)


def test_a_point_of_the_ground_keeps_its_brightness_between_views() -> None:
    views = [at(0.0), at(0.1, 0.1)]
    one, other = images(Floor(**STILL), views)  # type: ignore[arg-type]
    lens, T = CAMERA.intrinsics.gray, views[1]
    v, u = np.mgrid[140:230:5, 60:260:5]
    rays = np.stack([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u, float)], axis=-1) @ views[0][:3, :3].T
    points = views[0][:3, 3] - views[0][2, 3] / rays[..., 2:] * rays
    seen = (points - T[:3, 3]) @ T[:3, :3]
    j = np.rint(lens.fx * seen[..., 0] / seen[..., 2] + lens.cx).astype(int)
    i = np.rint(lens.fy * seen[..., 1] / seen[..., 2] + lens.cy).astype(int)
    inside = (i >= 0) & (i < lens.height) & (j >= 0) & (j < lens.width)
    assert inside.sum() > 200
    assert np.corrcoef(one[v[inside], u[inside]], other[i[inside], j[inside]])[0, 1] > 0.9


def test_a_seed_gives_the_same_images_and_another_seed_others() -> None:
    one, same, other = (images(Floor(), [at(0.0), at(0.01)], seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.corrcoef(one[1].ravel(), other[1].ravel())[0, 1] < 0.5


def test_a_skipped_frame_changes_no_noise_of_later_frames() -> None:
    T = at(0.0)
    every, second = (GrayCamera(CAMERA.intrinsics, Floor(), np.random.default_rng(1)) for _ in range(2))
    every.picture(RENDERER.surfaces(T), T, 0.0)
    second.skip_frame()
    canvas = RENDERER.surfaces(T)
    np.testing.assert_array_equal(every.picture(canvas, T, 0.033), second.picture(canvas, T, 0.033))


def test_motion_blurs_texture() -> None:
    sharp, blurred = (
        images(Floor(light=0.0, noise=0.0, exposure_s=exposure_s), [at(0.0), at(0.02)])[1] for exposure_s in (0.0, 0.03)
    )
    assert np.abs(np.diff(blurred, axis=0)).mean() < 0.9 * np.abs(np.diff(sharp, axis=0)).mean()


def test_looks_of_the_floor_differ() -> None:
    contrast = {}
    for look in ("textured", "uniform", "black", "glossy"):
        (image,) = images(Floor(look=look, **STILL), [at(0.0)])  # type: ignore[arg-type]
        contrast[look] = np.abs(np.diff(image[120:], axis=1)).mean()
        assert (image.mean() < 10.0) == (look == "black")
    assert contrast["textured"] > 10.0 * max(contrast["uniform"], contrast["black"])
    assert contrast["glossy"] > contrast["uniform"]


def test_light_changes_over_time() -> None:
    camera = GrayCamera(CAMERA.intrinsics, Floor(light=0.2, light_period_s=4.0), np.random.default_rng(1))
    canvas = RENDERER.surfaces(at(0.0))
    means = [camera.picture(canvas, at(0.0), time_s).mean() for time_s in np.arange(0.0, 4.0, 0.5)]
    assert max(means) / min(means) > 1.3


@pytest.mark.parametrize(
    "wrong", [{"contrast": -0.1}, {"light": 1.0}, {"light_period_s": 0.0}, {"exposure_s": 1.0}, {"noise": -1.0}]
)
def test_impossible_floors_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected, found"):
        Floor(**wrong)  # type: ignore[arg-type]
