"""The robot's own legs are removed from depth images, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.perception.own_legs import TOO_NEAR, without_legs
from sextant.shared.geometry import Array, apply, inverse
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.robot.kinematics import body_inverse, leg_points
from sextant.shared.robot.links import LINK_RADII_M
from sextant.shared.robot.profiles import load_profile

LENS = Intrinsics(160, 120, 80.0, 80.0, 79.5, 59.5)
SENSOR = DepthSensor(min_range=0.1, max_range=3.0, baseline=0.05, disparity_sigma=0.08, disparity_step=0.0)
PROFILE = load_profile("phantomx_mk2")
T_BODY_CAMERA = replace(PROFILE.camera, mount_xyz=(0.02, 0.0, 0.2), pitch_down_deg=40.0).T_body_camera


def legs_seen() -> Array:
    """Return the legs (6, 4, 3) [m] {camera} of a robot that lifts its front legs high and ahead."""
    feet = PROFILE.rest_feet()
    feet[:2] += [0.06, 0.0, 0.11]
    q = body_inverse(PROFILE, feet)
    points = leg_points(PROFILE, q).reshape(-1, 3)
    return apply(inverse(T_BODY_CAMERA), points).reshape(6, 4, 3)


def ground(at_m: float = 0.6) -> NDArray[np.uint16]:
    return np.full((LENS.height, LENS.width), round(at_m * 1000), dtype=np.uint16)


def with_capsules(depth: NDArray[np.uint16], legs: Array) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Return an image with the surfaces of the links, and the pixels that show them."""
    image, shown = depth.copy(), np.zeros(depth.shape, dtype=np.bool_)
    rng = np.random.default_rng(0)
    for leg in legs:
        for a, b, radius in zip(leg[:3], leg[1:], LINK_RADII_M, strict=True):
            along = rng.random((40_000, 1))
            around = rng.normal(size=(40_000, 3))
            points = a + along * (b - a) + radius * around / np.linalg.norm(around, axis=1, keepdims=True)
            points = points[points[:, 2] > SENSOR.min_range]
            u, v = (
                np.rint(f * points[:, k] / points[:, 2] + c).astype(int)
                for k, f, c in ((0, LENS.fx, LENS.cx), (1, LENS.fy, LENS.cy))
            )
            inside = (u >= 0) & (u < LENS.width) & (v >= 0) & (v < LENS.height)
            raw = np.rint(points[inside, 2] * 1000).astype(np.uint16)
            np.minimum.at(image, (v[inside], u[inside]), raw)
    shown |= image < depth
    return image, shown


def test_legs_are_removed_and_the_ground_stays() -> None:
    legs, floor = legs_seen(), ground()
    image, shown = with_capsules(floor, legs)
    assert shown.sum() > 100  # the front legs are in view
    before = image.copy()
    cleaned, removed = without_legs(image, legs, LENS, SENSOR)
    assert np.array_equal(image, before)
    assert removed == np.count_nonzero(cleaned != image)
    feet = np.array([leg[3] for leg in legs])
    v, u = np.nonzero(shown & (cleaned != TOO_NEAR))
    z = image[v, u] / 1000.0
    left = np.column_stack(((u - LENS.cx) / LENS.fx * z, (v - LENS.cy) / LENS.fy * z, z))
    assert all(np.linalg.norm(feet - point, axis=1).min() < 0.05 for point in left)  # only the ends of the feet
    assert np.array_equal(cleaned[~shown], floor[~shown])


def test_ground_near_a_foot_stays() -> None:
    legs = legs_seen()
    soles = np.array([leg[3] + [0.0, 0.0, PROFILE.foot.radius] for leg in legs])
    flat = ground(float(soles[:, 2].max()) + 0.02)
    cleaned, removed = without_legs(flat, legs, LENS, SENSOR)
    assert (removed, cleaned is flat) == (0, True)


@pytest.mark.parametrize("scale", [1.0, 8.0])
def test_removed_pixels_are_out_of_range_for_every_unit(scale: float) -> None:
    sensor = replace(SENSOR, depth_scale=scale)
    image, _ = with_capsules(ground(), legs_seen())
    coarse = np.maximum(np.rint(image * scale / 1000.0), 1).astype(np.uint16)
    cleaned, _ = without_legs(coarse, legs_seen(), LENS, sensor)
    low, high = sensor.raw_bounds
    changed = cleaned[cleaned != coarse]
    assert not ((changed >= low) & (changed <= high)).any()


def test_legs_behind_the_camera_change_nothing() -> None:
    behind = legs_seen() - [0.0, 0.0, 2.0]
    assert without_legs(ground(0.2), behind, LENS, SENSOR)[1] == 0
