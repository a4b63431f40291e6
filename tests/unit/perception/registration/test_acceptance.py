"""Acceptance of poses: limits of the jump from the prior."""

import numpy as np

from sextant.services.perception.registration.acceptance import Acceptance, check_jump
from sextant.services.perception.registration.error_twist import apply_twist
from sextant.shared.geometry import from_xyz_rpy


def test_jump_limit_scales_with_prior_covariance():
    T = from_xyz_rpy([1.0, 2.0, 3.0], [0.1, 0.2, 0.3])
    acceptance = Acceptance(jump_distance=0.02, jump_angle=0.02)
    covariance = np.diag([0.01, 0.002, 0.002, 0.01, 0.01, 0.01]) ** 2
    assert check_jump(apply_twist(T, np.array([0.059, 0, 0, 0, 0, 0.059])), T, covariance, acceptance) == ""
    assert "jump of 0.061 m in x" in check_jump(apply_twist(T, np.array([0.061, 0, 0, 0, 0, 0])), T, covariance, acceptance)
    assert (
        check_jump(apply_twist(T, np.array([0, 0, 0.055, 0.15, -0.15, 0])), T, covariance, acceptance) == ""
    )  # the floor shows these
    foot = np.array([-0.1, 0.15, -0.25])  # [m] from the camera: the robot tips about it when another foot slips off an edge
    tipped = np.array([0.0, 0.14, 0.0])
    assert check_jump(apply_twist(T, np.concatenate([-np.cross(tipped, foot), tipped])), T, covariance, acceptance) == ""
    assert "deg in pitch" in check_jump(apply_twist(T, np.array([0, 0, 0, 0, 0.2, 0])), T, covariance, acceptance)
    assert "deg in yaw" in check_jump(apply_twist(T, np.array([0, 0, 0, 0, 0, 0.07])), T, covariance, acceptance)
