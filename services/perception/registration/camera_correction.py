"""Corrected mount of a camera, and the frame of its map.

The registration keeps its keyframes in {track}, so that a correction does not spoil them. A correction turns {track} about the
body: the pose of the body stays where it is, and ground that was mapped with the old mount gets its new height.
"""

from dataclasses import replace

import numpy as np

from sextant.services.perception.registration.registration_result import RegistrationResult
from sextant.shared.geometry import Array, exp_so3, inverse, on_twists, orthonormal, transform
from sextant.shared.robot.profile import Camera


class CameraCorrection:
    """Correction of the mount of a camera.

    Attributes:
        tilt: (2,) [rad] roll and pitch by which the profile's mount is turned against the corrected one, in axes of the body.
        height: [m] by which it is higher than the corrected one.
        T_body_camera: (4, 4) corrected mount.
    """

    def __init__(self, camera: Camera) -> None:
        """Start with the mount of the profile, and {track} at {world}."""
        self._T_profile = camera.T_body_camera
        self.tilt: Array = np.zeros(2)
        self.height = 0.0
        self.T_body_camera = self._T_profile
        self._T_world_track: Array = np.eye(4)

    @property
    def ground_change(self) -> Array:
        """How corrections have changed heights: by a x + b y + c, as (3,) [1, 1, m] {world}."""
        return np.array(self._T_world_track[2, [0, 1, 3]])

    def in_track(self, T_world_camera: Array, covariance: Array) -> tuple[Array, Array]:
        """Return a pose (4, 4) and its covariance (6, 6) in {track}."""
        J = on_twists(self._T_world_track[:3, :3].T)
        return inverse(self._T_world_track) @ T_world_camera, J @ covariance @ J.T

    def in_world(self, found: RegistrationResult) -> RegistrationResult:
        """Return a result in {world}."""
        J = on_twists(self._T_world_track[:3, :3])
        return replace(
            found,
            T_world_camera=self._T_world_track @ found.T_world_camera,
            covariance=J @ found.covariance @ J.T,
            degenerate=found.degenerate @ J.T,
        )

    def change(self, tilt: Array, height: float, T_world_body: Array) -> None:
        """Correct the mount; the pose (4, 4) of the body stays.

        Args:
            tilt: (2,) [rad] new value of `tilt`.
            height: [m] new value of `height`.
            T_world_body: (4, 4) newest pose of the body.
        """
        T_track_camera = inverse(self._T_world_track) @ T_world_body @ self.T_body_camera
        self.tilt, self.height = tilt, height
        R, p = self._T_profile[:3, :3], self._T_profile[:3, 3]
        self.T_body_camera = transform(exp_so3([-tilt[0], -tilt[1], 0.0]) @ R, p - [0.0, 0.0, height])
        # A rotation that is not exactly orthonormal would depart from one with each correction, faster and faster.
        self._T_world_track = orthonormal(orthonormal(T_world_body) @ self.T_body_camera @ inverse(T_track_camera))
