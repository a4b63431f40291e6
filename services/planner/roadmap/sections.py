"""Sections: the part of a gap crossing that is planned next."""

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from sextant.services.planner.roadmap.params import BareGroundParams
from sextant.services.planner.roadmap.strip_map import KNOWN_SHARE, StripMap
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import Camera
from sextant.shared.wire.messages import UNKNOWN

_BEYOND = 0.40  # [m] from the gap to the body's centre, with which the whole robot stands behind the gap
_ROOM = 0.80  # [m] of normal ground, enough for the whole robot to stand and walk on
_BORDER = 0.05  # [m] at the strip's far end where no gap is detected, because cells outside a strip count as vacant
_UNDER = 0.7  # [1] share of the radius of failed ground, in which the ground has certainly sunk with the foot
_WIDE_SHARE = 0.8  # [1] minimum share of wide places in the footholds
_GONE = 1  # evaluation function of a cell without a foothold
_INNER = -2  # [cells] evaluation function of footholds with ground on all sides, whose heights are no outliers


def goal_behind(field: StripMap, x: float, target: float, params: BareGroundParams) -> float | None:
    """Return the body's goal, from which the whole robot stands behind bare ground.

    Bare ground carries a foot only in some places.

    Args:
        field: The strip.
        x: [m] {strip} of the body.
        target: [m] {strip} of the goal behind all bare ground.
        params: Parameters of bare ground.

    Returns:
        [m] {strip}, at most the target and behind the first bare stretch. Other stretches may follow after room to walk. None
        if there is no bare stretch within the room to walk, or if the body is past the target.
    """
    rows = bare(field, params)
    centres = field.first_cell[0] + field.resolution * np.arange(len(rows))
    ahead = np.flatnonzero(rows & (centres > x - _BEYOND) & (centres < target))
    if not len(ahead) or x >= target or centres[ahead[0]] > x + _ROOM:
        return None
    apart = np.flatnonzero(np.diff(centres[ahead]) > _ROOM)
    return min(target, float(centres[ahead[apart[0] if len(apart) else -1]]) + _BEYOND)


def has_wide_places(field: StripMap, params: BareGroundParams, middle: int) -> bool:
    """Return whether the places of bare ground that carry a foot have a middle, far from their edges.

    Args:
        field: The strip.
        params: Parameters of bare ground.
        middle: [cells] highest evaluation function of a middle.
    """
    carries = (field.evaluation < 0) & bare(field, params)[:, None]
    middles = np.pad(carries & (field.evaluation <= middle), -middle)
    around = 1 - 2 * middle  # [cells] from one edge of a middle to the other
    wide = np.asarray(sliding_window_view(middles, (around, around)).any(axis=(2, 3)))
    return bool(carries.any() and wide[carries].mean() >= _WIDE_SHARE)


def without(field: StripMap, sole: Array, radius: float) -> StripMap:
    """Return the field with a disc that carries no foot, where the ground gave way.

    Args:
        field: The strip.
        sole: (3,) [m] {strip} underside of the foot; the ground under it is at most this high.
        radius: [m] of the disc; the ground is lowered in the inner part of the disc.
    """
    nx, ny = field.evaluation.shape
    x0, y0 = field.first_cell
    x, y = x0 + field.resolution * np.arange(nx), y0 + field.resolution * np.arange(ny)
    off = np.hypot(x[:, None] - sole[0], y - sole[1])
    gone = (off <= radius) & (field.evaluation != UNKNOWN)
    low = np.where(off <= _UNDER * radius, np.minimum(field.elevation, np.float32(sole[2])), field.elevation)
    return replace(
        field, elevation=low, evaluation=np.where(gone, np.maximum(field.evaluation, np.int8(_GONE)), field.evaluation)
    )


def foothold_heights(field: StripMap) -> tuple[float, float]:
    """Return the lowest and the highest height [m] {strip} of the ground that carries a foot, (0, 0) if none does."""
    heights = field.elevation[(field.evaluation <= _INNER) & np.isfinite(field.elevation)]
    return (float(heights.min()), float(heights.max())) if heights.size else (0.0, 0.0)


def is_uneven(field: StripMap, relief: float) -> bool:
    """Return whether the heights of the footholds differ by more than a relief [m]."""
    low, high = foothold_heights(field)
    return high - low > relief


def hidden_behind(field: StripMap, height: float, half_width: float) -> Array:
    """Return where unknown ground begins behind high ground, along the strip.

    Behind such ground there may be footholds that are too low to be seen from before it.

    Args:
        field: The strip.
        height: [m] {strip} from which ground is high.
        half_width: [m] of the band around the middle line that counts.

    Returns:
        (n,) [m] {strip}, in rising order.
    """
    y = field.first_cell[1] + field.resolution * np.arange(field.evaluation.shape[1])
    band = np.abs(y) <= half_width
    high, unknown = field.elevation[:-1, band] > height, field.evaluation[1:, band] == UNKNOWN
    rows = np.flatnonzero((high & unknown).any(axis=1)) + 1
    return np.asarray(field.first_cell[0] + field.resolution * rows)


def nearest_view(camera: Camera, body_height: float) -> float:
    """Return how far ahead of the body [m] level ground begins to be in the picture and in range.

    Args:
        camera: The camera.
        body_height: [m] over the ground.
    """
    T, lens = camera.T_body_camera, camera.intrinsics
    height, ahead = body_height + float(T[2, 3]), T[:3, 2]
    lowest = T[:3, :3] @ [0.0, (lens.height - 1 - lens.cy) / lens.fy, 1.0]  # ray of the lowest row of the picture
    picture = height * lowest[0] / -lowest[2] if lowest[2] < 0.0 else np.inf
    in_range = (camera.sensor.min_range + ahead[2] * height) / ahead[0] if ahead[0] > 0.0 else np.inf
    return float(T[0, 3] + max(picture, in_range))


def bare(field: StripMap, params: BareGroundParams) -> NDArray[np.bool_]:
    """Return which (nx,) rows of cells carry a foot only in some places.

    Rows beyond the known ground and at the end of the strip do not count.
    """
    y = field.first_cell[1] + field.resolution * np.arange(field.evaluation.shape[1])
    band = field.evaluation[:, np.abs(y) <= params.half_width_m]
    known = np.flatnonzero((band != UNKNOWN).mean(axis=1) > KNOWN_SHARE)
    rows = (band < 0).mean(axis=1) < params.carrying_share
    rows[known[-1] + 1 if len(known) else 0 :] = False
    rows[-round(_BORDER / field.resolution) - 1 :] = False
    return np.asarray(rows)
