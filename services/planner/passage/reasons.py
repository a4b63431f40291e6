"""Why a search ended without a way, in words: which test stops which leg where, and how wide the gap is."""

import numpy as np
from numpy.typing import NDArray

from services.planner.passage import search
from services.planner.passage.field import Field
from shared.geometry import Array, apply
from shared.robot import LEGS

WORDS = (
    "",
    "out of reach",
    "foot under the body",
    "foot behind its level of the body",
    "feet closer than allowed",
    "no foothold",
    "ground unknown",
    "support too small",
    "torque too large",
    "legs too close to each other",
    "body or leg too close to the ground",
    "no room to swing",
)
_AHEAD = 0.6  # [m] in which the next foothold is looked for
_BESIDE = 0.05  # [m] of a leg's line that count as before it


def fault_in_words(found: NDArray[np.int64], repair: float) -> str:
    """Why a stance is no beginning.

    Args:
        found: (7,) the test that each leg fails, then the whole robot.
        repair: [m] by which the body may be shifted.
    """
    legs = [f"{LEGS[leg]} leg: {WORDS[found[leg]]}" for leg in range(6) if found[leg]]
    whole = [WORDS[found[6]]] if found[6] else []
    return f"the robot stands badly, and no shift of {repair * 100:.0f} cm helps: {'; '.join(legs + whole)}"


def in_words(fails: NDArray[np.int64], body: Array, feet: Array, strokes: Array, field: Field, spent: bool) -> tuple[str, bool]:
    """Why nothing leads on from the furthest configurations, and whether it is for want of known ground.

    Args:
        fails: (tests, 7) how often each test failed there, by leg, the last for none.
        body: (3,) [m] {strip} of the furthest.
        feet: (6, 3) [m] {strip}.
        strokes: (6,) [m] by which each foot can be set forward while the body stands.
        field: The strip.
        spent: Whether the budget ended before all was tried.
    """
    x, y, _ = apply(field.T_world_strip, body)
    where = f"({x:.2f}, {y:.2f}) m"
    if not fails.any():
        return f"nothing leads on at {where}", False
    blind = fails[search.UNKNOWN].sum() > 0.2 * fails.sum()
    told = fails.copy()
    told[0] = 0
    test, leg = (int(k) for k in np.unravel_index(int(np.argmax(told)), told.shape))
    who = f"{LEGS[leg]} leg: " if leg < 6 else ""
    tried = "not all was tried" if spent else "all was tried"
    gap = _gap(feet, strokes, field)
    look = "; cells ahead are unknown: look again" if blind else ""
    return f"at {where} {who}{WORDS[test]} ({told[test, leg]} of {told.sum()} refusals; {tried}){gap}{look}", bool(blind)


def _gap(feet: Array, strokes: Array, field: Field) -> str:
    """The stretch without a foothold before a foot that is the widest beside the leg's stroke, in words."""
    widest, whose = -np.inf, -1
    x0, y0 = field.corner
    for leg in range(6):
        i = int((feet[leg, 0] - x0) / field.resolution) + 1
        j = round((feet[leg, 1] - y0) / field.resolution)
        half = round(_BESIDE / field.resolution)
        ahead = field.evaluation[i : i + round(_AHEAD / field.resolution), max(0, j - half) : j + half + 1]
        carries = np.asarray((ahead < 0).any(axis=1))
        bare = np.flatnonzero(~carries)
        if not len(bare):
            continue
        begin = int(bare[0])
        beyond = np.flatnonzero(carries[begin:])
        width = (int(beyond[0]) if len(beyond) else len(carries) - begin) * field.resolution
        if width - strokes[leg] > widest:
            widest, whose = width - strokes[leg], leg
    if whose < 0:
        return ""
    width, reach = widest + strokes[whose], f"{strokes[whose] * 100:.0f} cm"
    by = f", {widest * 100:.0f} cm more than" if widest > 0.0 else " of"
    return f"; before the {LEGS[whose]} foot {width * 100:.0f} cm carry none{by} the {reach} that its leg goes"
