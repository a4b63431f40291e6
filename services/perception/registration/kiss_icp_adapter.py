"""KISS-ICP behind the interface of `registration`: point-to-point against a voxel map, for scanners with a wide field.

Its cost holds no prior, so the prior starts the iteration only (as in Masri 2016, section 4.2.1). How well the pose
fits and which directions the scene constrains is measured on keyframes afterwards; along the others KISS-ICP slides,
and there the prior is put back.
"""

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from numpy.typing import NDArray

from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.services.perception.registration.keyframes import Keyframes, Match
from sextant.services.perception.registration.projective_icp import (
    Acceptance,
    Registered,
    belief,
    error_twist,
    first,
    jump,
    moved,
    objection,
    prior_information,
    refused,
    too_little,
)
from sextant.shared.geometry import orthonormal
from sextant.shared.robot.camera import DepthSensor, Intrinsics

_MAX_ITERATIONS = 50  # as Masri 2016, section 4.2.1
_GATE = 0.02  # [m] farthest plane a point is matched with when the pose is judged
_STRIDE = 4  # every how many points are judged
_PATIENCE = 15  # failed frames in a row until the map starts anew: nothing is searched for, and the prior only gets worse


class KissRegistration:
    """Camera poses from depth frames by KISS-ICP 1.3 (Vizzo et al. 2023), one thread, deskew off."""

    def __init__(
        self,
        intrinsics: Intrinsics,
        sensor: DepthSensor,
        acceptance: Acceptance | None = None,
        *,
        voxel_size: float = 0.01,
        threshold: float | None = 0.005,
    ) -> None:
        """Set up for one camera.

        Args:
            intrinsics: Of the full image; block means of it are registered.
            sensor: Range, noise and raw unit of the camera.
            acceptance: When a pose is refused, and the map starts anew.
            voxel_size: [m] edge of the voxel map.
            threshold: [m] fixed width of its robust kernel; None lets it adapt to the motion, as for a prior
                without odometry.

        Raises:
            ValueError: A voxel size or threshold that is not positive.
        """
        if not voxel_size > 0 or (threshold is not None and not threshold > 0):
            raise ValueError(f"positive voxel size and threshold expected, found {voxel_size} and {threshold} m")
        self._config = KISSConfig()
        self._config.data.deskew = False
        self._config.data.min_range = 0.0  # the sensor's range has been applied to the depth already
        # Range is along the ray, depth along the axis: keep what the image's corners can see.
        corner = max(intrinsics.width / intrinsics.fx, intrinsics.height / intrinsics.fy)
        self._config.data.max_range = sensor.max_range * float(np.hypot(1.0, corner))
        self._config.mapping.voxel_size = voxel_size
        self._config.registration.max_num_iterations = _MAX_ITERATIONS
        self._config.registration.max_num_threads = 1  # the order of sums, and so the result, is then fixed
        self._config.adaptive_threshold.fixed_threshold = threshold
        self._config.adaptive_threshold.initial_threshold = 5 * voxel_size
        self._config.adaptive_threshold.min_motion_th = voxel_size / 5
        self._acceptance = acceptance or Acceptance(patience=_PATIENCE)
        self._frame = BlockFrame(intrinsics, sensor)
        self._keyframes = Keyframes(self._frame, stored=32, active=4, distance=0.12, angle=0.12)
        self._kiss = KissICP(self._config)
        self._voxel_information = np.eye(6) * (2.0 / voxel_size) ** 2  # half a voxel [m], and [rad] at a distance of 1 m
        self._failures = 0

    def update(
        self,
        depth_raw: NDArray[np.uint16],
        stamp_ns: int,
        T_world_camera_prior: NDArray[np.float64],
        prior_covariance: NDArray[np.float64],
    ) -> Registered:
        """Register one frame; arguments, result and errors as in `Registration.update`."""
        information = prior_information(T_world_camera_prior, prior_covariance)
        self._frame.load(depth_raw)
        reason = too_little(self._frame, self._acceptance)
        if reason:
            return self._refuse(stamp_ns, T_world_camera_prior, prior_covariance, None, reason)
        if len(self._keyframes) == 0:
            self._restart(T_world_camera_prior)
            return first(stamp_ns, T_world_camera_prior, prior_covariance)

        T, downsampled = self._align(T_world_camera_prior)

        match = self._keyframes.match(T, self._keyframes.select(T), _GATE, _STRIDE)
        believed, degenerate = belief(match)
        # The voxels blur its pose: (H^-1 + R)^-1, written so that H may be singular.
        H = believed @ match.H
        H -= H @ np.linalg.solve(H + self._voxel_information, H)
        covariance = np.linalg.inv(H + information)
        T = orthonormal(moved(T_world_camera_prior, covariance @ H @ error_twist(T, T_world_camera_prior)))
        reason = objection(match, self._acceptance) or jump(T, T_world_camera_prior, prior_covariance, self._acceptance)
        if reason:
            return self._refuse(stamp_ns, T_world_camera_prior, prior_covariance, match, reason)
        self._failures = 0
        self._extend_map(T, downsampled, match.overlap)
        return Registered(stamp_ns, T, (covariance + covariance.T) / 2.0, match.overlap, match.rmse, degenerate, True, "")

    def _align(self, T_prior: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What `KissICP.register_frame` does up to its map update, but from our own prediction: pose and map points."""
        source, downsampled = self._kiss.voxelize(self._frame.points)
        sigma = self._kiss.adaptive_threshold.get_threshold()
        T = np.asarray(
            self._kiss.registration.align_points_to_map(
                points=source,
                voxel_map=self._kiss.local_map,
                initial_guess=T_prior,
                max_correspondance_distance=3 * sigma,
                kernel=sigma,
            )
        )
        self._kiss.adaptive_threshold.update_model_deviation(np.linalg.inv(T_prior) @ T)
        return T, downsampled

    def _extend_map(self, T: NDArray[np.float64], downsampled: NDArray[np.float64], overlap: float) -> None:
        self._kiss.local_map.update(downsampled, T)
        if self._keyframes.is_news(T, overlap):
            self._keyframes.add(T)

    def _restart(self, T: NDArray[np.float64]) -> None:
        self._kiss = KissICP(self._config)
        self._keyframes.clear()
        self._extend_map(T, self._kiss.voxelize(self._frame.points)[1], 1.0)

    def _refuse(
        self,
        stamp_ns: int,
        T_prior: NDArray[np.float64],
        prior_covariance: NDArray[np.float64],
        match: Match | None,
        reason: str,
    ) -> Registered:
        self._failures += 1
        if self._failures >= self._acceptance.patience and match is not None:
            reason = f"{reason}; {self._failures} frames in a row failed, the map starts anew at the prior"
            self._restart(T_prior)
            self._failures = 0
        return refused(stamp_ns, T_prior, prior_covariance, match, reason)
