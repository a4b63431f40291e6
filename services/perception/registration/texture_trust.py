"""Trust in the ground's texture, which must agree with the legs before it corrects them.

A glossy floor shows the lamps of the ceiling, which hardly move with the robot. A person in view moves although the robot does
not. Therefore texture is used only after its motion has agreed with that of the legs over some way, and not in a frame in which
it departs from them by more than they can slip.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.error_twist import error_twist
from sextant.services.perception.registration.params import TextureParams
from sextant.services.perception.registration.texture_tracking import Tracks
from sextant.shared.geometry import inverse


class TextureTrust:
    """Compares the motion that texture shows with that of the legs, since each keyframe."""

    def __init__(self, stored: int, params: TextureParams):
        """Start without trust; `stored` is the number of keyframes."""
        self._params = params
        self._legs: NDArray[np.float64] = np.eye(4)  # camera pose by the legs alone
        self._legs_at = np.tile(np.eye(4), (stored, 1, 1))  # of the keyframes
        self._last: NDArray[np.float64] | None = None  # pose of the last frame
        self._step = 0.0  # [m] way of the legs since the last frame
        self._agreed = 0.0  # [m] way of the legs over which texture has agreed with them
        self._few = 0  # consecutive frames with too few points

    @property
    def given(self) -> bool:
        """Whether texture corrects the pose."""
        return self._agreed >= self._params.probation

    def begin_frame(self, T_prior: NDArray[np.float64]) -> None:
        """Follow the legs to the expected pose (4, 4) of the next frame."""
        if self._last is not None:
            self._legs = self._legs @ inverse(self._last) @ T_prior
            self._step = float(np.linalg.norm(T_prior[:2, 3] - self._last[:2, 3]))

    def end_frame(self, T: NDArray[np.float64]) -> None:
        """Set the pose (4, 4) of the frame."""
        self._last = T

    def store(self, slot: int) -> None:
        """Remember the legs' pose at a new keyframe."""
        self._legs_at[slot] = self._legs

    def judge(self, T: NDArray[np.float64], tracks: Tracks, poses: NDArray[np.float64]) -> bool:
        """Return whether a pose (4, 4) found with texture may be used, and update the trust.

        Args:
            T: Camera pose.
            tracks: Positions of texture.
            poses: (n, 4, 4) camera poses of the keyframes.
        """
        params, good = self._params, tracks.agreeing(T)
        if good.sum() < max(params.min_tracks, params.min_agreement * len(good), params.min_found * tracks.expected):
            self._few += 1
            if self._few > params.patience or not self.given:
                self._agreed = 0.0
            return False
        self._few = 0
        if any(self._is_contradicted(T, poses[slot], self._legs_at[slot]) for slot in np.unique(tracks.slots[good])):
            self._agreed = 0.0
            return False
        self._agreed += self._step
        return self.given

    def _is_contradicted(
        self, T: NDArray[np.float64], T_keyframe: NDArray[np.float64], T_legs_keyframe: NDArray[np.float64]
    ) -> bool:
        """Return whether the motion since a keyframe contradicts the legs."""
        params, margin = self._params, self._params.trusted_margin if self.given else 1.0
        expected = T_keyframe @ inverse(T_legs_keyframe) @ self._legs
        twist = np.abs(error_twist(T, expected))
        way = float(np.linalg.norm(expected[:2, 3] - T_keyframe[:2, 3]))
        slipped = float(np.hypot(twist[0], twist[1])) > margin * params.slip + params.slip_share * way
        return slipped or bool(twist[5] > margin * params.turn + params.turn_rate * way)
