"""KISS-ICP with the interface of `Registration`, for scanners with a wide field.

KISS-ICP registers point-to-point against a voxel map. Its cost has no prior, so the prior only starts the iteration (as in
Masri 2016, section 4.2.1). Keyframes then measure the quality of fit and the directions that the scene constrains. KISS-ICP
slides along the other directions, in which the result is set back to the prior.
"""

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP
from numpy.typing import NDArray

from sextant.services.perception.registration.acceptance import Acceptance, check_jump, check_measured_share, rejection_reason
from sextant.services.perception.registration.alignment import prior_information
from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.services.perception.registration.constraint_weights import constraint_weights
from sextant.services.perception.registration.error_twist import apply_twist, error_twist
from sextant.services.perception.registration.keyframes import Keyframes
from sextant.services.perception.registration.projective_matching import Match
from sextant.services.perception.registration.registration_result import RegistrationResult, first_result, refused_result
from sextant.shared.geometry import orthonormal
from sextant.shared.robot.camera import DepthSensor, Intrinsics

_MAX_ITERATIONS = 50  # as Masri 2016, section 4.2.1
_GATE = 0.02  # [m] largest point-to-plane distance of a match when the pose is evaluated
_STRIDE = 4  # every n-th point is evaluated
_PATIENCE = 15  # consecutive failed frames before a new map: there is no search, and the prior degrades


class KissRegistration:
    """Registration by KISS-ICP 1.3 (Vizzo et al. 2023), one thread, deskew off.

    It estimates camera poses from depth frames.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        sensor: DepthSensor,
        acceptance: Acceptance | None = None,
        *,
        voxel_size: float = 0.01,
        threshold: float | None = 0.005,
    ) -> None:
        """Create a registration for one camera.

        Args:
            intrinsics: Of the full image; its block means are registered.
            sensor: Range, noise and raw unit of the camera.
            acceptance: Limits for refusing a pose and for starting a new map.
            voxel_size: [m] edge of the voxel map.
            threshold: [m] fixed width of the robust kernel. With None it adapts to the motion, which suits a prior
                without odometry.

        Raises:
            ValueError: The voxel size or the threshold is not positive.
        """
        if not voxel_size > 0 or (threshold is not None and not threshold > 0):
            raise ValueError(f"positive voxel size and threshold expected, found {voxel_size} and {threshold} m")
        self._config = KISSConfig()
        self._config.data.deskew = False
        self._config.data.min_range = 0.0  # the sensor's range is already applied to the depth
        # Range is measured along the ray, depth along the axis: keep the corners of the image.
        corner = max(intrinsics.width / intrinsics.fx, intrinsics.height / intrinsics.fy)
        self._config.data.max_range = sensor.max_range * float(np.hypot(1.0, corner))
        self._config.mapping.voxel_size = voxel_size
        self._config.registration.max_num_iterations = _MAX_ITERATIONS
        self._config.registration.max_num_threads = 1  # fixes the order of sums, and so the result
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
    ) -> RegistrationResult:
        """Register one frame; arguments, result and errors as in `Registration.update`."""
        information = prior_information(T_world_camera_prior, prior_covariance)
        self._frame.load(depth_raw)
        reason = check_measured_share(self._frame, self._acceptance)
        if reason:
            return self._refuse(stamp_ns, T_world_camera_prior, prior_covariance, None, reason)
        if len(self._keyframes) == 0:
            self._restart(T_world_camera_prior)
            return first_result(stamp_ns, T_world_camera_prior, prior_covariance)

        T, downsampled = self._align(T_world_camera_prior)

        match = self._keyframes.match(T, self._keyframes.select(T), _GATE, _STRIDE)
        believed, degenerate = constraint_weights(match)
        # The voxel size limits the accuracy of the pose: (H^-1 + R)^-1, in a form that allows a singular H.
        H = believed @ match.H
        H -= H @ np.linalg.solve(H + self._voxel_information, H)
        covariance = np.linalg.inv(H + information)
        T = orthonormal(apply_twist(T_world_camera_prior, covariance @ H @ error_twist(T, T_world_camera_prior)))
        reason = rejection_reason(match, self._acceptance) or check_jump(
            T, T_world_camera_prior, prior_covariance, self._acceptance
        )
        if reason:
            return self._refuse(stamp_ns, T_world_camera_prior, prior_covariance, match, reason)
        self._failures = 0
        self._extend_map(T, downsampled, match.overlap)
        return RegistrationResult(
            stamp_ns, T, (covariance + covariance.T) / 2.0, match.overlap, match.rmse, degenerate, True, ""
        )

    def _align(self, T_prior: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Align to the map from a given prior; return the pose and the map points.

        This repeats `KissICP.register_frame` without its map update.
        """
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
        if self._keyframes.is_new_view(T, overlap):
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
    ) -> RegistrationResult:
        self._failures += 1
        if self._failures >= self._acceptance.patience and match is not None:
            reason = f"{reason}; {self._failures} frames in a row failed, the map restarts at the prior pose"
            self._restart(T_prior)
            self._failures = 0
        return refused_result(stamp_ns, T_prior, prior_covariance, match, reason)
