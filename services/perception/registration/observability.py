"""Names of the directions that a scene does not constrain."""

import numpy as np
from numpy.typing import NDArray

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_AXIS_SHARE = 0.8  # share of an axis in the unobservable directions, above which the axis is named on its own
_PART = 0.3  # smallest component of an oblique direction that is named


def unobservable_directions(twists: NDArray[np.float64]) -> tuple[str, ...]:
    """Name the directions that unobservable twists span.

    Args:
        twists: (k, 6) unit error twists [m, rad] in world axes, as `RegistrationResult.degenerate`.

    Returns:
        One name per direction: an axis such as `yaw`, or an oblique direction such as `x+y`. Axes come first, in the order of
        `AXES`.
    """
    axes, oblique = [], []
    span = _orthonormal_rows(twists)
    while len(span):
        shares = np.linalg.norm(span, axis=0)
        axis = int(np.argmax(shares))
        if shares[axis] > _AXIS_SHARE:
            direction = span.T @ span[:, axis] / shares[axis]
            axes.append(AXES[axis])
        else:
            direction = span[0]
            oblique.append(_oblique_name(direction))
        span = _orthonormal_rows(span - np.outer(span @ direction, direction))
    return (*sorted(axes, key=AXES.index), *oblique)


def _oblique_name(direction: NDArray[np.float64]) -> str:
    """Name a unit twist (6,) by its larger components, such as `x-y`."""
    parts = [axis for axis in range(6) if abs(direction[axis]) > _PART]
    positive = direction[parts[0]] > 0
    first, *others = parts
    return AXES[first] + "".join(("+" if (direction[axis] > 0) == positive else "-") + AXES[axis] for axis in others)


def _orthonormal_rows(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis (r, 6) of the span of rows (k, 6)."""
    if not len(rows):
        return np.zeros((0, 6))
    _, sizes, basis = np.linalg.svd(rows, full_matrices=False)
    return np.asarray(basis[sizes > 1e-6])
