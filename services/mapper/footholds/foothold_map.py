"""Masri's foothold map and its evaluation function: where a foot may stand, and how far from the end of such ground.

1. Foothold map B (Masri 2016, section 4.5): a cell is accessible if it is known, on no edge between areas of different
   height, at most 0.25 m below the body, and its normal within pi/4 of the vertical.
2. Closing with a square of 5 cm (eq. 4.5-4.7) bridges vacant cells between accessible ones.
3. Evaluation function F (section 4.6): the Manhattan distance (4.8) to the nearest cell that is not accessible, taken as
   negative, and outside the distance to the nearest that is. Below -5 cm all is equally good.

What is in cells there is in metres here, since a cell of the thesis is a centimetre: the square is the odd number of cells
nearest to 5 cm, the bound the whole number nearest. F itself is counted in cells.

Readings and departures:
- "Areas with the zero value represent the edges": no cell is at zero. Neighbours on the two sides of the border of B are
  at -1 and 1, since (4.9) counts from the first cell that is not accessible; the zero lies between them.
- The two passes of (4.9)-(4.10) are made along the columns and then along the rows: |dx| + |dy| is separable, and each pass
  is then without a dependence inside a row.
- The closing is meant for vacant cells, but it also brings back an edge that was removed: a step takes cells off both its
  sides, fewer than five. Here what was refused stays refused, and nothing is bridged within the square around it.
- It bridges a crack between two blocks, too, that the camera does not see into, and feet have slipped into such. Here only
  holes are bridged: vacant cells with accessible ones all around that are narrower than the square both ways.
- A vacant cell within accessible ones counts as accessible ground for its neighbours, but never is a foothold itself; and
  next to what stays vacant, where an edge may be hidden, cells keep the clearance that the score keeps.
`published_evaluation` is the form of the thesis.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.runtime.compiled import compiled
from sextant.shared.wire.messages import UNKNOWN


@dataclass(frozen=True, slots=True)
class FootholdRules:
    """What carries a foot; the first two and the last three are Masri's."""

    depth_limit: float = 0.25  # [m] below the body's centre
    slope_limit: float = math.pi / 4  # [rad] of a normal from the vertical, eq. 4.4
    edge_deviation: float = 1.7e-3  # [m] from the local plane: what a step of 7 mm leaves. He gives no number for an edge
    unknown_clearance: float = 0.02  # [m] cells this near to vacant ground are not accessible
    closing: float = 0.05  # [m] edge of the square
    bound: float = 0.05  # [m] deeper inside accessible ground than this all is equal
    reach: float = 0.15  # [m] further outside than this all is equal; he has no such bound, but a byte has

    def __post_init__(self) -> None:
        for name in ("depth_limit", "edge_deviation", "bound", "reach"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"positive {name} expected, found {getattr(self, name)}")
        for name in ("unknown_clearance", "closing"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} of at least 0 expected, found {getattr(self, name)}")
        if not 0 < self.slope_limit < math.pi / 2:
            raise ValueError(f"slope_limit between 0 and pi/2 expected, found {self.slope_limit}")


class EvaluationFunction:
    """Makes the evaluation function of foothold maps; holds only what the rules come to in cells."""

    def __init__(self, resolution: float, rules: FootholdRules | None = None) -> None:
        """Take the cells' edge [m] and the rules.

        Raises:
            ValueError: The resolution is not positive, or the bound is more than 126 cells; the reach ends there.
        """
        if not 0 < resolution < math.inf:
            raise ValueError(f"positive resolution expected, found {resolution}")
        self.rules = rules or FootholdRules()
        self.bound = max(1, round(self.rules.bound / resolution))  # [cells]
        self.reach = min(max(1, round(self.rules.reach / resolution)), UNKNOWN - 1)  # [cells]
        if self.bound >= UNKNOWN:
            raise ValueError(f"a bound of at most {UNKNOWN - 1} cells expected, found {self.bound}")
        self._half = max(0, round((self.rules.closing / resolution - 1) / 2))
        self._square = np.ones((2 * self._half + 1, 2 * self._half + 1), dtype=np.uint8)
        self._vacant_disc = disc(self.rules.unknown_clearance / resolution, least=0)  # one cell for no clearance
        # How far a cell of the result looks: to its nearest border, and what makes the border there.
        self.halo = max(self.bound, self.reach) + 2 * self._half + 1 + self._vacant_disc.shape[0] // 2

    def evaluate(
        self,
        accessible: NDArray[np.uint8],
        refused: NDArray[np.uint8],
        known: NDArray[np.uint8],
        level: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.int8]:
        """The evaluation function of a map, or of a part of one; what lies beyond counts as vacant.

        1. Close holes of B, but not beside what was refused, and take off it what lies near to ground that is still vacant.
        2. Of cells with a wider margin keep those in whose margin all is ground.
        3. The signed Manhattan distance within its bounds.
        4. Cells never seen are marked.

        Args:
            accessible: (nx, ny) 1 where the map carries a foot, else 0: B.
            refused: (nx, ny) 1 where it was found not to, else 0.
            known: (nx, ny) 1 where there is a height, else 0.
            level: (nx, ny) [cells] of margin that a cell is to keep, `TOO_WIDE` for more than any; None for none at all.

        Returns:
            (nx, ny) [cells] negative on accessible ground, at least -bound; positive elsewhere, at most reach; UNKNOWN where
            there is no height.
        """
        clear = _eroded(np.asarray(refused ^ 1, dtype=np.uint8), self._square)
        bridged = closed(accessible, self._half) & clear & holes(accessible, 2 * self._half)
        ground = np.asarray(accessible | bridged, dtype=np.uint8)
        # Whatever is known or bridged keeps nothing away; beyond the border all is vacant.
        filled = ground | known
        ground &= _eroded(filled, self._vacant_disc)
        if level is not None:
            firm = ground.copy()
            for k in np.unique(level[level > 0]).tolist():
                np.copyto(firm, np.uint8(0) if k == TOO_WIDE else _eroded(ground, DISCS[k]), where=level == k)
            ground = firm
        F = signed_manhattan(ground, self.bound, self.reach)
        np.copyto(F, UNKNOWN, where=known == 0)
        return F


def closed(accessible: NDArray[np.uint8], half: int) -> NDArray[np.uint8]:
    """Binary closing (nx, ny) with a square of 2 * half + 1 cells, nothing being accessible beyond the border.

    Source: Masri 2016, eq. (4.5)-(4.7).
    """
    if half == 0:
        return accessible.copy()
    # The dilated image reaches beyond the map; cut off there, its border would erode wrongly.
    framed = _framed(accessible, 2 * half, 0)
    square = np.ones((2 * half + 1, 2 * half + 1), dtype=np.uint8)
    return np.ascontiguousarray(cv2.morphologyEx(framed, cv2.MORPH_CLOSE, square)[2 * half : -2 * half, 2 * half : -2 * half])


def holes(accessible: NDArray[np.uint8], widest: int) -> NDArray[np.uint8]:
    """Cells (nx, ny) of 0 with 1 all around, of which a hole is at most so many [cells] wide along both axes.

    Cells of 0 that touch each other, be it by their corners, are one; what reaches to the border is no hole.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats(np.asarray(accessible ^ 1, dtype=np.uint8))
    first = stats[:, [cv2.CC_STAT_TOP, cv2.CC_STAT_LEFT]]
    size = stats[:, [cv2.CC_STAT_HEIGHT, cv2.CC_STAT_WIDTH]]
    inner = ((first > 0) & (first + size < accessible.shape)).all(axis=1)
    small = np.asarray(inner & (size <= widest).all(axis=1), dtype=np.uint8)
    small[0] = 0  # the cells of 1
    return np.asarray(small[labels])


def signed_manhattan(ground: NDArray[np.uint8], bound: int, reach: int) -> NDArray[np.int8]:
    """Distance (nx, ny) [cells] by eq. (4.8): on 1 to the next 0, negative, at least -bound; on 0 to the next 1, at most reach.

    Beyond the border all is 0. The bounds are from 1 to 126.

    Source: Masri 2016, eq. (4.8)-(4.10) and the threshold of section 4.6.
    """
    inside = _framed(np.asarray(ground * np.uint8(bound)), 1, 0)
    outside = np.asarray((ground == 0) * np.uint8(reach))
    inside, outside = _manhattan(inside)[1:-1, 1:-1], _manhattan(outside)
    return np.asarray(outside.astype(np.int8) - inside.astype(np.int8))


def published_evaluation(accessible: NDArray[np.uint8], half: int, bound: int, reach: int) -> NDArray[np.int8]:
    """The evaluation function as the thesis has it, for comparison: closed and measured, whatever was refused or never seen."""
    return signed_manhattan(closed(accessible, half), bound, reach)


def disc(radius: float, least: int = 1) -> NDArray[np.uint8]:
    """Cells within a radius [cells], and always all whose row and column are `least` off at most."""
    half = max(least, math.floor(radius + 1e-6))
    i, j = np.mgrid[-half : half + 1, -half : half + 1]
    near = (i**2 + j**2 <= (radius + 1e-6) ** 2) | (np.maximum(abs(i), abs(j)) <= least)
    return np.asarray(near, dtype=np.uint8)


TOO_WIDE = 15  # [cells] of margin, which no cell keeps
DISCS = tuple(disc(k, least=0) for k in range(TOO_WIDE))  # by the cells of margin that are kept


def _eroded(layer: NDArray[np.uint8], room: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Least of the cells (nx, ny) within a room around each, 0 beyond the border."""
    return np.asarray(cv2.erode(layer, room, borderType=cv2.BORDER_CONSTANT, borderValue=[0.0]), dtype=np.uint8)


def _framed(layer: NDArray[np.uint8], width: int, value: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.copyMakeBorder(layer, width, width, width, width, cv2.BORDER_CONSTANT, value=[float(value)]))


def _manhattan(start: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Distance to the next 0 from cells that start with the greatest distance told."""
    d = np.array(start, dtype=np.uint8, order="C")
    _along_columns(d)
    turned = np.asarray(cv2.transpose(d), dtype=np.uint8)
    _along_columns(turned)
    return np.asarray(cv2.transpose(turned), dtype=np.uint8)


@compiled
def _along_columns(d: NDArray[np.uint8]) -> None:
    """Each cell at most one more than the cell above and below it, in place."""
    rows, columns = d.shape
    one = np.uint8(1)
    for i in range(1, rows):
        before, row = d[i - 1], d[i]
        for j in range(columns):
            step = np.uint8(before[j] + one)
            row[j] = step if step < row[j] else row[j]
    for i in range(rows - 2, -1, -1):
        before, row = d[i + 1], d[i]
        for j in range(columns):
            step = np.uint8(before[j] + one)
            row[j] = step if step < row[j] else row[j]
