"""Keyframes with fixed poses: storage, and selection of those that a new frame is matched with."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.services.perception.registration.projective_matching import Match, match_frame, point_misfits, shared_surface
from sextant.shared.runtime.compiled import compiled

Array = NDArray[Any]  # argument of compiled functions, any numeric type

_OVERLAP_WANTED = 0.5  # share of points below which keyframes are stored at shorter distances


class Keyframes:
    """Plane images with fixed poses; a new one replaces the farthest of a full set."""

    def __init__(self, frame: BlockFrame, stored: int, active: int, distance: float, angle: float) -> None:
        """Create empty storage that uses the frame of its owner.

        Args:
            frame: The last loaded frame, which is matched and stored.
            stored: Number of keyframes kept.
            active: Number of keyframes that a frame is matched with.
            distance: [m] from the nearest keyframe beyond which a new one is stored.
            angle: [rad] the same for the rotation.

        Raises:
            ValueError: The numbers do not satisfy 1 <= active <= stored, or a distance or angle is not positive.
        """
        if not 1 <= active <= stored:
            raise ValueError(f"1 <= active <= stored keyframes expected, found {active} and {stored}")
        if not (distance > 0 and angle > 0):
            raise ValueError(f"positive keyframe distance and angle expected, found {distance} m and {angle} rad")
        self._frame, self._active, self._distance, self._angle = frame, active, distance, angle
        self._planes = np.zeros((stored, *frame.shape, 4), dtype=np.float32)
        self._poses = np.tile(np.eye(4), (stored, 1, 1))
        self._age = np.zeros(stored, dtype=np.int64)
        self._count = 0
        self._stored = 0

    def __len__(self) -> int:
        return self._count

    @property
    def poses(self) -> NDArray[np.float64]:
        """Poses (n, 4, 4) of the keyframes."""
        return self._poses[: self._count].copy()

    def apart(self, distance: float, angle: float) -> NDArray[np.float64]:
        """Return poses (k, 4, 4) of keyframes that are far apart, newest first.

        Each differs from all earlier ones by more than `distance` [m] or `angle` [rad].
        """
        chosen = np.empty((0, 4, 4))
        for n in np.argsort(-self._age[: self._count]):
            if not _is_near(chosen, self._poses[n], distance, math.cos(angle)):
                chosen = np.concatenate([chosen, self._poses[n][None]])
        return chosen

    def clear(self) -> None:
        """Delete all keyframes."""
        self._count = 0

    def add(self, T_world_camera: NDArray[np.float64]) -> int:
        """Store the loaded frame as a keyframe at a pose, and return its number."""
        if self._count < len(self._planes):
            slot = self._count
            self._count += 1
        else:
            slot = int(np.argmax(np.linalg.norm(self._poses[:, :3, 3] - T_world_camera[:3, 3], axis=-1)))
        self._frame.fit_planes(self._planes[slot])
        self._poses[slot] = T_world_camera
        self._stored += 1
        self._age[slot] = self._stored
        return slot

    def planes(self, slot: int) -> NDArray[np.float32]:
        """Return the planes (rows, columns, 4) of a keyframe, see `BlockFrame.fit_planes`."""
        return np.asarray(self._planes[slot])

    def is_new_view(self, T_world_camera: NDArray[np.float64], overlap: float) -> bool:
        """Return whether a pose is far enough from every keyframe to store a new one.

        The limits are a quarter as large if few points overlap.
        """
        share = 1.0 if overlap >= _OVERLAP_WANTED else 0.25
        cosine = math.cos(share * self._angle)
        return not bool(_is_near(self._poses[: self._count], T_world_camera, share * self._distance, cosine))

    def select(self, T_world_camera: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the keyframes that a frame at a pose is matched with.

        They share the most surface with the frame. The first one is the oldest of those that share at least half as
        much as the best, which reduces drift.
        """
        frame, n = self._frame, self._count
        shares = shared_surface(frame, self._planes[:n], self._poses[:n], T_world_camera)
        order = np.argsort(-shares, kind="stable")
        enough = order[shares[order] >= 0.5 * shares[order[0]]]
        oldest = enough[np.argmin(self._age[enough])]
        return np.concatenate([[oldest], enough[enough != oldest][: self._active - 1]])

    def match(
        self,
        T_world_camera: NDArray[np.float64],
        chosen: NDArray[np.int64],
        gate: float,
        stride: int = 1,
        robust: bool = True,
    ) -> Match:
        """Match the loaded frame at a pose with some keyframes.

        Args:
            T_world_camera: (4, 4) pose at which the normal equations are linearised.
            chosen: (k,) keyframes, of `select`.
            gate: [m] largest point-to-plane distance of a match.
            stride: Use every stride-th point.
            robust: Whether the weight of a match falls with its distance.
        """
        return match_frame(self._frame, self._planes, self._poses, chosen, T_world_camera, gate, stride, robust)

    def misfits(self, T_world_camera: NDArray[np.float64], chosen: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the misfit of each point (n,) of the loaded frame with some keyframes.

        The misfit is the mean of k^2 / (1 + scale k^2), as in `Match`, or NaN for a point that faces no plane.
        """
        return point_misfits(self._frame, self._planes, self._poses, chosen, T_world_camera)


@compiled
def _is_near(poses: Array, T: Array, distance: float, cosine: float) -> bool:
    """Return whether a pose is near one of several poses.

    It is near within the distance [m] and the angle with the given cosine.
    """
    for n in range(len(poses)):
        square, trace = 0.0, 0.0
        for i in range(3):
            square += (poses[n, i, 3] - T[i, 3]) ** 2
            for j in range(3):
                trace += poses[n, i, j] * T[i, j]
        if square < distance * distance and (trace - 1.0) / 2.0 > cosine:
            return True
    return False
