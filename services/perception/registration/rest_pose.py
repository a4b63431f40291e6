"""Rest pose: where a camera is while its prior does not move."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.error_twist import ALONG_FLOOR, apply_twist, error_twist

_REST_SIGMA = 1e-4  # [m] and [rad] sigma of x, y and yaw of a camera at rest
_REST_MOVED = 0.001  # [m] and [rad] along the ground beyond which a pose is not the rest pose


class RestPose:
    """The pose (4, 4) of a camera since it came to rest, None while it moves."""

    def __init__(self, largest_step: float, follows_prior: bool):
        """Start with a moving camera.

        Args:
            largest_step: [m] and [rad] change of the prior between two frames, up to which the camera counts as at rest.
            follows_prior: Whether the rest pose follows small motions of the prior, as that of legs.
        """
        self.pose: NDArray[np.float64] | None = None
        self._largest_step, self._follows_prior = largest_step, follows_prior
        self._last: NDArray[np.float64] | None = None  # pose (4, 4) of the last frame

    def update(self, T_prior: NDArray[np.float64]) -> None:
        """Follow the prior of the next frame."""
        step = np.zeros(6) if self._last is None else error_twist(T_prior, self._last)
        if self._last is None or np.abs(step).max() > self._largest_step:
            self.pose = None
        elif self.pose is None:
            self.pose = T_prior
        elif self._follows_prior:
            self.pose = apply_twist(self.pose, step)

    def end_frame(self, T: NDArray[np.float64]) -> None:
        """Set the pose (4, 4) that the frame received."""
        self._last = T

    def is_left(self, T: NDArray[np.float64]) -> bool:
        """Return whether a pose is away from the rest pose along the ground."""
        return self.pose is not None and float(np.abs(error_twist(T, self.pose)[ALONG_FLOOR]).max()) > _REST_MOVED

    def as_prior(
        self, T_prior: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the prior (4, 4), and its covariance (6, 6), of a camera that stays at its rest pose."""
        assert self.pose is not None
        T, resting = T_prior.copy(), covariance.copy()
        T[:2, 3] = self.pose[:2, 3]
        resting[ALONG_FLOOR, :] = resting[:, ALONG_FLOOR] = 0.0
        resting[ALONG_FLOOR, ALONG_FLOOR] = _REST_SIGMA**2
        return T, resting
