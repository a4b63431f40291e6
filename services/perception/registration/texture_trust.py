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
from sextant.shared.geometry import inverse, yaw_of


class TextureTrust:
    """Compares the motion that texture shows with that of the legs, since each keyframe."""

    def __init__(self, stored: int, params: TextureParams):
        """Start without trust; `stored` is the number of keyframes."""
        self._params = params
        self._legs: NDArray[np.float64] = np.eye(4)  # camera pose by the legs alone
        self._legs_at = np.tile(np.eye(4), (stored, 1, 1))  # of the keyframes
        self._last: NDArray[np.float64] | None = None  # pose of the last frame
        self._path = self._turned = 0.0  # [m], [rad] way and turning of the legs, both ways added
        self._path_at, self._turned_at = np.zeros(stored), np.zeros(stored)  # of the keyframes
        self._away, self._farthest = np.zeros(stored), np.zeros(stored)  # [m] distance from the keyframes, and its maximum
        self._grown = np.zeros(stored)  # [m] by which the last frame raised the maximum
        self._agreed = 0.0  # [m] such growth over which texture has agreed with the legs
        self._few = 0  # consecutive frames with too few points

    @property
    def given(self) -> bool:
        """Whether texture corrects the pose."""
        return self._agreed >= self._params.probation

    def begin_frame(self, T_prior: NDArray[np.float64]) -> None:
        """Follow the legs to the expected pose (4, 4) of the next frame."""
        if self._last is None:
            self._legs = T_prior
            return
        self._legs = self._legs @ inverse(self._last) @ T_prior
        self._path += float(np.linalg.norm(T_prior[:2, 3] - self._last[:2, 3]))
        self._turned += abs(yaw_of(T_prior @ inverse(self._last)))
        self._away = np.linalg.norm(self._legs[:2, 3] - self._legs_at[:, :2, 3], axis=1)
        self._grown = np.maximum(self._away - self._farthest, 0.0)
        self._farthest += self._grown

    def end_frame(self, T: NDArray[np.float64]) -> None:
        """Set the pose (4, 4) of the frame."""
        self._last = T

    def store(self, slot: int) -> None:
        """Remember the legs' pose at a new keyframe."""
        self._legs_at[slot] = self._legs
        self._path_at[slot], self._turned_at[slot] = self._path, self._turned
        self._away[slot] = self._farthest[slot] = self._grown[slot] = 0.0

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
        slots = np.unique(tracks.slots[good])
        path, turned = self._path - self._path_at, self._turned - self._turned_at
        if not all(self._agrees(T, poses[slot], slot, path[slot], turned[slot]) for slot in slots):
            self._agreed = 0.0
            return False
        # A long path allows any distance, so only a keyframe that agrees for its distance earns trust.
        earned = [self._grown[slot] for slot in slots if self._agrees(T, poses[slot], slot, self._away[slot], 0.0)]
        self._agreed += float(max(earned, default=0.0))
        return self.given

    def _agrees(self, T: NDArray[np.float64], T_keyframe: NDArray[np.float64], slot: int, way: float, turned: float) -> bool:
        """Return whether the motion since a keyframe agrees with the legs, which drift over a way [m] and a turning [rad]."""
        params, margin = self._params, self._params.trusted_margin if self.given else 1.0
        twist = np.abs(error_twist(T, T_keyframe @ inverse(self._legs_at[slot]) @ self._legs))
        slipped = float(np.hypot(twist[0], twist[1])) > margin * params.slip + params.slip_share * way
        turn = margin * params.turn + params.turn_rate * way + params.slip_share * turned
        return not slipped and bool(twist[5] <= turn)
