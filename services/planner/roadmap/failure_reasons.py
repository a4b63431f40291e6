"""Reasons for a failed search: the failing test, leg and place, and the gap width."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.roadmap import roadmap_search
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array, apply
from sextant.shared.robot.profile import LEGS

TEST_NAMES = (
    "",
    "out of reach",
    "foot under the body",
    "foot on the wrong side of its leg mount",
    "feet closer than allowed",
    "no foothold",
    "ground unknown",
    "support margin too small",
    "torque too large",
    "legs too close to each other",
    "body or leg too close to the ground",
    "no room to swing",
)
WHOLE_ROBOT = 6  # index for the whole robot instead of a leg
_LINE_HALF_WIDTH_M = 0.05  # [m] to either side of a leg's line, where ground counts as ahead of it
_WORTH_TELLING = 0.5  # [1] share of a leg's stroke, from which a bare stretch is an obstacle


class FailureReason(NamedTuple):
    """Reason why no step leads on."""

    words: str
    unseen: bool  # whether unknown ground is the cause
    leg: int  # the leg whose test fails, WHOLE_ROBOT for no single leg


def describe_fault(found: NDArray[np.int64], repair: float) -> str:
    """Return why a stance cannot be the start of a section, as text.

    Args:
        found: (7,) failed test of each leg, then of the whole robot.
        repair: [m] maximum shift of the body.
    """
    legs = [f"{LEGS[leg]} leg: {TEST_NAMES[found[leg]]}" for leg in range(6) if found[leg]]
    whole = [TEST_NAMES[found[6]]] if found[6] else []
    return f"the start stance is invalid, even with the body shifted by up to {repair * 100:.0f} cm: {'; '.join(legs + whole)}"


def explain_failure(
    fails: NDArray[np.int64], body: Array, feet: Array, strokes: Array, field: StripMap, yaw: float = 0.0
) -> FailureReason:
    """Return why no step leads on from the furthest configuration.

    Args:
        fails: (tests, 7) number of failures of each test there, by leg; the last column is for the whole robot.
        body: (3,) [m] {strip} body of the furthest configuration.
        feet: (6, 3) [m] {strip}.
        strokes: (6,) [m] forward reach of each foot while the body stands.
        field: The strip.
        yaw: [rad] {strip} of the body.
    """
    x, y, _ = apply(field.T_world_strip, body)
    where = f"({x:.2f}, {y:.2f}) m"
    if abs(yaw) > 1e-6:
        where += f", turned by {abs(np.degrees(yaw)):.0f} deg to the {'left' if yaw > 0.0 else 'right'}"
    if not fails.any():
        return FailureReason(f"no step is possible at {where}", False, WHOLE_ROBOT)
    blind = bool(fails[roadmap_search.UNKNOWN].sum() > 0.2 * fails.sum())
    told = fails.copy()
    told[0] = 0
    test, leg = (int(k) for k in np.unravel_index(int(np.argmax(told)), told.shape))
    who = "" if leg == WHOLE_ROBOT else f"{LEGS[leg]} leg: "
    gap = _gap(feet, strokes, field, yaw)
    look = "; cells ahead are unknown" if blind else ""
    return FailureReason(
        f"no step from {where}: {who}{TEST_NAMES[test]} ({told[test, leg]} of {told.sum()} failed tests){gap}{look}", blind, leg
    )


def _gap(feet: Array, strokes: Array, field: StripMap, yaw: float) -> str:
    """Return the stretch without a foothold that is widest relative to a leg's stroke.

    It lies ahead of that leg. The text is "" if it is no obstacle.
    """
    stretches = [_bare_before(foot, stroke, field, yaw) for foot, stroke in zip(feet, strokes, strict=True)]
    widths = np.array([width for width, _ in stretches])
    leg = int(np.argmax(widths - strokes))
    width, ends = stretches[leg]
    if width < _WORTH_TELLING * strokes[leg]:
        return ""
    bare, reach = round(100 * width), round(100 * float(strokes[leg]))
    more = f"{bare - reach} cm more than the leg's reach of" if bare > reach else "the leg reaches"
    stretch = f"{bare} cm{'' if ends else ' or more'}"
    return f"; ahead of the {LEGS[leg]} foot {stretch} of ground without a foothold, {more} {reach} cm"


def _bare_before(foot: Array, stroke: float, field: StripMap, yaw: float) -> tuple[float, bool]:
    """Return the widest bare stretch [m] ahead of a foot, in the direction `yaw` [rad] {strip}, and whether it ends.

    The foot is (3,) [m] {strip}. The stretch carries no foot and begins within a stroke.
    """
    half, (nx, ny) = round(_LINE_HALF_WIDTH_M / field.resolution), field.evaluation.shape
    ahead, aside = np.arange(1, nx + ny)[:, None], np.arange(-half, half + 1)
    x, y = (foot[:2] - field.first_cell) / field.resolution
    i = np.rint(x + ahead * np.cos(yaw) - aside * np.sin(yaw)).astype(np.int64)
    j = np.rint(y + ahead * np.sin(yaw) + aside * np.cos(yaw)).astype(np.int64)
    inside = (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
    carried = inside & (field.evaluation[np.where(inside, i, 0), np.where(inside, j, 0)] < 0)
    carries = np.asarray(carried.any(axis=1)[inside.any(axis=1)])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ~carries, [0]])))
    begins, ends = edges[::2], edges[1::2]
    near = begins * field.resolution <= stroke
    if not near.any():
        return 0.0, True
    widest = int(np.argmax((ends - begins)[near]))
    return float(ends[widest] - begins[widest]) * field.resolution, bool(ends[widest] < len(carries))
