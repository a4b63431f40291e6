"""Which part of a passage is planned next: to where the ground carries as anywhere again."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.gap_crossing.strip_map import Field
from sextant.shared.geometry import Array
from sextant.shared.wire.messages import UNKNOWN

_BEYOND = 0.40  # [m] behind the gap where the body's centre must be for the whole robot to stand behind it
_ROOM = 0.80  # [m] of ground that carries as anywhere, on which the whole robot stands and walks on
_HALF_WIDTH = 0.20  # [m] of the band ahead whose ground tells where the gap ends
_CARRYING = 0.8  # [1] share of that band from which ground carries the robot as anywhere
_KNOWN = 0.3  # [1] share of it that is known at the end of what is known
_BORDER = 0.05  # [m] at the strip's far end that tells of no gap: what lies beside a strip counts as vacant
_UNDER = 0.7  # [1] share of the radius of what gave way, in which the ground has sunk with the foot for certain
_GONE = 1  # of the evaluation function: no foot stands there


def goal_behind(field: Field, x: float, target: float) -> float | None:
    """Where the body is to get for the whole robot to stand behind what carries it only here and there.

    Args:
        field: The strip.
        x: [m] {strip} of the body.
        target: [m] likewise, of what is behind it all.

    Returns:
        [m] {strip}, at most the target and behind the first such stretch, though others may follow after room to walk; None
        where none is nearer than there is room to walk, and where it is past the target.
    """
    rows = bare(field)
    centres = field.corner[0] + field.resolution * np.arange(len(rows))
    ahead = np.flatnonzero(rows & (centres > x - _BEYOND) & (centres < target))
    if not len(ahead) or x >= target or centres[ahead[0]] > x + _ROOM:
        return None
    apart = np.flatnonzero(np.diff(centres[ahead]) > _ROOM)
    return min(target, float(centres[ahead[apart[0] if len(apart) else -1]]) + _BEYOND)


def without(field: Field, sole: Array, radius: float) -> Field:
    """The same ground, of which a disc carries nothing, since it gave way under a foot.

    Args:
        field: The strip.
        sole: (3,) [m] {strip} underside of the foot: as low as it went, the ground under it is at the most.
        radius: [m] within which no foot shall stand; the ground is lower in the inner part of the disc.
    """
    nx, ny = field.evaluation.shape
    x0, y0 = field.corner
    x, y = x0 + field.resolution * np.arange(nx), y0 + field.resolution * np.arange(ny)
    off = np.hypot(x[:, None] - sole[0], y - sole[1])
    gone = (off <= radius) & (field.evaluation != UNKNOWN)
    low = np.where(off <= _UNDER * radius, np.minimum(field.elevation, np.float32(sole[2])), field.elevation)
    return replace(
        field, elevation=low, evaluation=np.where(gone, np.maximum(field.evaluation, np.int8(_GONE)), field.evaluation)
    )


def bare(field: Field) -> NDArray[np.bool_]:
    """Which (nx,) rows of cells across carry a foot only here and there; none beyond what is known or at the strip's end."""
    y = field.corner[1] + field.resolution * np.arange(field.evaluation.shape[1])
    band = field.evaluation[:, np.abs(y) <= _HALF_WIDTH]
    known = np.flatnonzero((band != UNKNOWN).mean(axis=1) > _KNOWN)
    rows = (band < 0).mean(axis=1) < _CARRYING
    rows[known[-1] + 1 if len(known) else 0 :] = False
    rows[-round(_BORDER / field.resolution) - 1 :] = False
    return np.asarray(rows)
