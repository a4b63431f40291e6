"""Constraint of the pose by the ground's texture: which frames use it, and for which keyframes."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.alignment import Aligned, Aligner
from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.services.perception.registration.keyframes import Keyframes
from sextant.services.perception.registration.params import TextureParams
from sextant.services.perception.registration.texture_tracking import TextureTracker
from sextant.services.perception.registration.texture_trust import TextureTrust
from sextant.shared.robot.camera import Intrinsics


class TextureConstraint:
    """Texture of the loaded frame and of the keyframes."""

    def __init__(self, lens: Intrinsics, frame: BlockFrame, keyframes: Keyframes, stored: int, params: TextureParams):
        """Start without images.

        Args:
            lens: Intrinsics of the grey image.
            frame: The loaded frame.
            keyframes: The keyframes.
            stored: Number of keyframes kept.
            params: Parameters.
        """
        self._keyframes = keyframes
        self._tracker = TextureTracker(lens, frame.x, frame.y, stored, params)
        self._trust = TextureTrust(stored, params)
        self._loaded = False
        self._stored = np.zeros(stored, dtype=np.int64)  # number of keyframes when each was stored

    def begin_frame(self, gray: NDArray[np.uint8] | None, T_prior: NDArray[np.float64]) -> None:
        """Load a frame's grey image, and follow the legs to its expected pose (4, 4)."""
        self._loaded = self._tracker.load(np.zeros((0, 0), np.uint8) if gray is None else gray)
        self._trust.begin_frame(T_prior)

    def end_frame(self, T: NDArray[np.float64]) -> None:
        """Set the pose (4, 4) of the frame."""
        self._trust.end_frame(T)

    def store(self, slot: int) -> None:
        """Store the loaded frame with a new keyframe."""
        self._stored[slot] = self._stored.max() + 1
        self._tracker.store(slot, self._keyframes.planes(slot))
        self._trust.store(slot)

    def clear(self) -> None:
        """Forget all keyframes."""
        self._tracker.keep_only(())

    def align(self, aligner: Aligner, T_prior: NDArray[np.float64], information: NDArray[np.float64]) -> Aligned:
        """Align the frame from the prior, with texture where the shape of the ground leaves directions open.

        Before texture is trusted, only the newest keyframe is tracked, and the others are then forgotten: their places are
        those of the legs.
        """
        found = aligner.align(T_prior, information)
        if not self._loaded or not len(found.shapeless):
            return found
        poses, chosen, trusted = self._keyframes.poses, self._keyframes.select(T_prior), self._trust.given
        if not trusted:
            chosen = chosen[[np.argmax(self._stored[chosen])]]
        tracks = self._tracker.track(T_prior, chosen, poses)
        if tracks is None:
            return found
        other = aligner.align(T_prior, information, tracks=tracks, T_start=found.T)
        if not self._trust.judge(other.T, tracks, poses):
            return found
        if not trusted:
            self._tracker.keep_only(chosen)
        return other
