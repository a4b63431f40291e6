"""Faces of boxes, with corners that are counterclockwise as seen from outside."""

import numpy as np

from sextant.shared.geometry import Array

# Corners of the six faces of a box as signs along its axes.
_CORNERS = np.array(
    [
        [[1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1]],
        [[-1, -1, -1], [-1, -1, 1], [-1, 1, 1], [-1, 1, -1]],
        [[-1, 1, -1], [-1, 1, 1], [1, 1, 1], [1, 1, -1]],
        [[-1, -1, -1], [1, -1, -1], [1, -1, 1], [-1, -1, 1]],
        [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]],
        [[-1, -1, -1], [-1, 1, -1], [1, 1, -1], [1, -1, -1]],
    ],
    dtype=np.float64,
)


def box_faces(centre: Array, half: Array, R: Array) -> Array:
    """Return the faces (n, 6, 4, 3) [m] {world} of boxes.

    Args:
        centre: (n, 3) [m] {world}.
        half: (n, 3) [m] half edge lengths.
        R: (n, 3, 3) rotations R_world_box.
    """
    return np.asarray(np.einsum("nij,fkj,nj->nfki", R, _CORNERS, half) + centre[:, None, None])
