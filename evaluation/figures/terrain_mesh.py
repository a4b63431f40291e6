"""Height map as a triangle mesh, for 3D viewers."""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.wire.messages import TerrainMap

_BEST, _WORST = np.array([60, 160, 80]), np.array([200, 60, 50])  # of scores 0 and 1; above 1 no foothold
_UNSCORED = 128.0


def terrain_mesh(
    terrain: TerrainMap,
) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.uint8]]:
    """Return a map as triangles between the centres of its known cells.

    Returns:
        (n, 3) [m] {world} points, (m, 3) point indices, (n, 3) colours by score, grey where the score is unknown.
    """
    known = np.isfinite(terrain.elevation)
    number = np.full(known.shape, -1, dtype=np.int64)
    number[known] = np.arange(known.sum())
    xy = terrain.origin + terrain.resolution * np.argwhere(known)
    points = np.column_stack([xy, terrain.elevation[known]]).astype(np.float32)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    corners = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    score = terrain.score[known][:, None]
    share = np.clip(np.nan_to_num(score, nan=0.0), 0.0, 1.0)
    colors = np.where(np.isnan(score), _UNSCORED, (1.0 - share) * _BEST + share * _WORST)
    return points, corners[(corners >= 0).all(axis=1)].astype(np.uint32), colors.astype(np.uint8)
