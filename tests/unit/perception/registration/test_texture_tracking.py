"""Texture: what it says about the motion over a bare floor, and when it says nothing."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.perception.registration.error_twist import apply_twist
from sextant.services.perception.registration.params import TextureParams
from sextant.services.perception.registration.texture_tracking import Tracks
from sextant.shared.scenario.scenario import Floor
from tests.support.textured_floor import CAMERA, DRIFT, TexturedFloor, trusted

Gray = NDArray[np.uint8]
_FRAMES = 30
_LEGS = _FRAMES * DRIFT  # [m] and [rad] error of the legs alone, approximately


@pytest.fixture(scope="module")
def legs_only() -> TexturedFloor:
    """The walk without texture."""
    floor = TexturedFloor()
    floor.walk(_FRAMES)
    return floor


def test_known_motion_over_a_textured_floor_is_recovered() -> None:
    floor = TexturedFloor(texture=trusted())
    found = floor.walk(_FRAMES)
    assert found.ok
    assert len(found.degenerate) == 0
    assert np.abs(floor.error()[:2]).max() < 0.0005  # 0.25 % of the way, a twentieth of the drift of the legs
    assert abs(floor.error()[5]) < 0.0005
    sigma = np.sqrt(np.diag(found.covariance))
    assert (sigma[[0, 1, 5]] < 0.001).all()


def test_legs_alone_drift_on_a_bare_floor(legs_only: TexturedFloor) -> None:
    assert legs_only.found is not None
    assert len(legs_only.found.degenerate) == 3
    assert abs(legs_only.error()[5]) > 0.8 * _LEGS[5]


@pytest.mark.parametrize("look", ["uniform", "black", "glossy"])
def test_a_floor_without_texture_of_its_own_changes_no_pose(look: str, legs_only: TexturedFloor) -> None:
    floor = TexturedFloor(Floor(look=look), TextureParams())  # type: ignore[arg-type]
    found = floor.walk(_FRAMES)
    assert len(found.degenerate) == 3
    assert legs_only.found is not None
    np.testing.assert_array_equal(found.T_world_camera, legs_only.found.T_world_camera)


@pytest.mark.parametrize("gray", [None, np.zeros((0, 0), np.uint8), np.full((12, 16), 90, np.uint8)])
def test_without_a_grey_image_of_the_right_size_nothing_changes(gray: Gray | None, legs_only: TexturedFloor) -> None:
    floor = TexturedFloor(texture=trusted())
    found = floor.walk(_FRAMES, change=lambda *_: gray)
    assert legs_only.found is not None
    np.testing.assert_array_equal(found.T_world_camera, legs_only.found.T_world_camera)


def test_texture_can_be_turned_off(legs_only: TexturedFloor) -> None:
    floor = TexturedFloor(texture=trusted(use=False))
    found = floor.walk(_FRAMES)
    assert legs_only.found is not None
    np.testing.assert_array_equal(found.T_world_camera, legs_only.found.T_world_camera)


def _flicker(gray: Gray, frame: int) -> Gray:
    """Change brightness and contrast from frame to frame, and shade one side of the image."""
    gain = (1.0 + 0.4 * np.sin(1.3 * frame)) * np.linspace(0.7, 1.1, gray.shape[1])
    return np.clip(gray * gain + 20.0 * np.cos(0.7 * frame), 0, 255).astype(np.uint8)


def test_changing_light_does_not_matter() -> None:
    floor = TexturedFloor(texture=trusted())
    floor.walk(_FRAMES, change=_flicker)
    assert np.abs(floor.error()[:2]).max() < 0.0005
    assert abs(floor.error()[5]) < 0.0005


def _lamp(gray: Gray, frame: int) -> Gray:
    """Move with the robot: a bright disc with a sharp edge, as of a lamp on it."""
    lit = gray.copy()
    cv2.circle(lit, (150 + 2 * frame, 120), 50, 60, -1)
    return np.asarray(cv2.addWeighted(gray, 1.0, lit - np.minimum(lit, gray), 1.0, 40 if frame % 2 else 0), dtype=np.uint8)


def _walker(share: float):  # type: ignore[no-untyped-def]
    """Return a change of the image in which something with texture passes, over a share of its width."""
    cloth = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (240, 1000), dtype=np.uint8), (0, 0), 2.0)
    cloth = cv2.normalize(cloth, None, 40, 200, cv2.NORM_MINMAX)

    def change(gray: Gray, frame: int) -> Gray:
        width = round(share * gray.shape[1])
        passed = gray.copy()
        passed[:, 60 : 60 + width] = cloth[:, 3 * frame : 3 * frame + width]
        return passed

    return change


@pytest.mark.parametrize("change", [_lamp, _walker(0.25)], ids=["patch of light", "person"])
def test_what_moves_in_a_part_of_the_image_is_rejected(change) -> None:  # type: ignore[no-untyped-def]
    floor = TexturedFloor(texture=trusted())
    floor.walk(_FRAMES, change=change)
    assert np.abs(floor.error()[:2]).max() < 0.0005
    assert abs(floor.error()[5]) < 0.0005


def test_what_moves_in_most_of_the_image_is_no_worse_than_the_legs(legs_only: TexturedFloor) -> None:
    floor = TexturedFloor(texture=TextureParams())
    floor.walk(_FRAMES, change=_walker(0.7))
    assert (np.abs(floor.error()) <= np.abs(legs_only.error()) + 1e-3).all()


def test_texture_that_moves_before_a_robot_at_rest_does_not_move_it() -> None:
    floor = TexturedFloor(texture=trusted())
    for _ in range(5):
        floor.move(0.0, drift=np.zeros(6))
    for _ in range(15):
        floor.move(0.0, drift=np.zeros(6), change=_walker(0.7))
    assert np.abs(floor.error()).max() < 1e-3


def test_equations_are_those_of_the_positions() -> None:
    rng = np.random.default_rng(2)
    T = TexturedFloor.at(3.0)
    seen = rng.uniform((-0.4, -0.3, 0.6), (0.4, 0.3, 1.5), (40, 3))
    points = seen @ T[:3, :3].T + T[:3, 3]
    pixels = seen[:, :2] / seen[:, 2:]
    information = np.tile((1e5, 2e4, 8e4), (40, 1))
    tracks = Tracks(points, pixels, information, np.zeros(40, np.int64), 40, 1.0 / CAMERA.intrinsics.gray.fx)
    H, g = tracks.equations(T)
    np.testing.assert_allclose(g, 0.0, atol=1e-6)
    for axis in range(6):  # the gradient at a small error, which the weight of the robust loss hardly changes
        _, off = tracks.equations(apply_twist(T, 1e-5 * np.eye(6)[axis]))
        np.testing.assert_allclose(off / 1e-5, H[axis], rtol=5e-3, atol=5e-3 * np.abs(H).max())
    assert tracks.agreeing(T).all()
    assert not tracks.agreeing(apply_twist(T, np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0]))).any()
