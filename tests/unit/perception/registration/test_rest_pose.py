"""Rest pose: where a camera stays while its prior does not move."""

import numpy as np

from sextant.services.perception.registration.rest_pose import RestPose
from sextant.shared.geometry import Array, from_xyz_rpy


def at(x: float, z: float = 0.3) -> Array:
    return from_xyz_rpy((x, 0.0, z), np.zeros(3))


def resting(follows_prior: bool = True) -> RestPose:
    rest = RestPose(0.001, follows_prior)
    for _ in range(2):
        rest.update(at(0.0))
        rest.end_frame(at(0.0))
    return rest


def test_camera_rests_from_the_second_frame_without_motion() -> None:
    rest = RestPose(0.001, follows_prior=True)
    rest.update(at(0.0))
    assert rest.pose is None
    rest.end_frame(at(0.0))
    rest.update(at(0.0))
    assert rest.pose is not None


def test_motion_of_the_prior_ends_the_rest() -> None:
    rest = resting()
    rest.update(at(0.002))
    assert rest.pose is None
    assert not rest.is_left(at(0.5))


def test_rest_pose_follows_small_motions_of_legs_alone() -> None:
    for follows, x in ((True, 0.0005), (False, 0.0)):
        rest = resting(follows)
        rest.update(at(0.0005))
        assert rest.pose is not None
        np.testing.assert_allclose(rest.pose[0, 3], x)


def test_rest_is_left_along_the_ground_alone() -> None:
    rest = resting()
    assert rest.is_left(at(0.002))
    assert not rest.is_left(at(0.0, z=0.4))


def test_prior_at_rest_fixes_x_y_and_yaw() -> None:
    T, covariance = resting().as_prior(at(0.01, z=0.4), np.full((6, 6), 0.04) + np.eye(6))
    np.testing.assert_allclose(T[:3, 3], (0.0, 0.0, 0.4))
    np.testing.assert_allclose(np.diag(covariance)[[0, 1, 5]], 1e-8)
    np.testing.assert_allclose(np.diag(covariance)[[2, 3, 4]], 1.04)
    assert not covariance[0, 1:].any()
