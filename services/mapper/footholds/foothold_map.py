"""Masri's foothold map and its evaluation function.

The map holds the cells where a foot may stand. The function is the distance from the border of this ground.

1. Foothold map B (Masri 2016, section 4.5): a cell is accessible if it is known, on no edge between areas of different
   height, at most 0.25 m below the body, and its normal is within pi/4 of the vertical.
2. Closing with a square of 5 cm (eq. 4.5-4.7) bridges vacant cells between accessible ones.
3. Evaluation function F (section 4.6): the Manhattan distance (4.8), negative on accessible ground to the nearest cell that
   is not, and positive elsewhere to the nearest accessible one. Below -5 cm all cells are equally good.

Lengths that the thesis gives in cells are in metres here, because a cell of the thesis is one centimetre. The square is the odd
number of cells nearest to 5 cm, the bound the nearest whole number. F itself is counted in cells.

Interpretations and deviations:
- "Areas with the zero value represent the edges": no cell has the value zero. Neighbours on the two sides of the border of B
  have -1 and 1, because (4.9) counts from the first cell that is not accessible; zero lies between them.
- The two passes of (4.9)-(4.10) run along the columns and then along the rows. |dx| + |dy| is separable, and each pass then
  has no dependence inside a row.
- The closing is meant for vacant cells, but it also restores a removed edge, because a step removes fewer than five cells on
  its two sides. Here refused cells stay refused, and nothing is bridged within the square around them.
- It also bridges a crack between two blocks that the camera does not see into, and feet have slipped into such cracks. Here
  only holes are bridged: vacant cells surrounded by accessible ones and narrower than the square in both directions.
- A vacant cell within accessible ones counts as accessible ground for its neighbours, but is never a foothold itself. Next to
  cells that stay vacant, where an edge may be hidden, cells keep the same clearance as in the score.
`published_evaluation` is the form of the thesis.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.footholds.params import FootholdMapParams
from sextant.shared.runtime.compiled import compiled
from sextant.shared.wire.messages import UNKNOWN


class EvaluationFunction:
    """Evaluation function of foothold maps; it holds only the rules in cells."""

    def __init__(self, resolution: float, rules: FootholdMapParams | None = None) -> None:
        """Create the function for a cell edge [m] and rules.

        Raises:
            ValueError: The resolution is not positive, or the bound exceeds 126 cells. A larger reach is limited to that.
        """
        if not 0 < resolution < math.inf:
            raise ValueError(f"positive resolution expected, found {resolution}")
        self.rules = rules or FootholdMapParams()
        self.bound = max(1, round(self.rules.bound / resolution))  # [cells]
        self.reach = min(max(1, round(self.rules.reach / resolution)), UNKNOWN - 1)  # [cells]
        if self.bound >= UNKNOWN:
            raise ValueError(f"a bound of at most {UNKNOWN - 1} cells expected, found {self.bound}")
        self._half = max(0, round((self.rules.closing / resolution - 1) / 2))
        self._square = np.ones((2 * self._half + 1, 2 * self._half + 1), dtype=np.uint8)
        self._vacant_disc = disc(self.rules.unknown_clearance / resolution, least=0)  # one cell for no clearance
        # Range of a cell of the result: to its nearest border, and to the cells that make the border there.
        self.halo = max(self.bound, self.reach) + 2 * self._half + 1 + self._vacant_disc.shape[0] // 2

    def evaluate(
        self,
        accessible: NDArray[np.uint8],
        refused: NDArray[np.uint8],
        known: NDArray[np.uint8],
        level: NDArray[np.uint8] | None = None,
    ) -> NDArray[np.int8]:
        """Compute the evaluation function of a map or a part of it; the outside is vacant.

        1. Close holes of B, except next to refused cells, and remove cells near ground that is still vacant.
        2. Of cells with a wider margin, keep those whose margin is all ground.
        3. Compute the signed Manhattan distance within its bounds.
        4. Mark cells that were never seen.

        Args:
            accessible: (nx, ny) 1 where the map is a foothold (B), else 0.
            refused: (nx, ny) 1 where it is known not to be, else 0.
            known: (nx, ny) 1 where there is a height, else 0.
            level: (nx, ny) [cells] margin of each cell, `TOO_WIDE` for more than any; None for no margins.

        Returns:
            (nx, ny) [cells] negative on accessible ground, at least -bound; positive elsewhere, at most reach; UNKNOWN where
            there is no height.
        """
        clear = _eroded(np.asarray(refused ^ 1, dtype=np.uint8), self._square)
        bridged = closed(accessible, self._half) & clear & holes(accessible, 2 * self._half)
        ground = np.asarray(accessible | bridged, dtype=np.uint8)
        # Known or bridged cells need no clearance; everything outside the border is vacant.
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
    """Close a map (nx, ny) with a square of 2 * half + 1 cells.

    The outside is not accessible.

    Source: Masri 2016, eq. (4.5)-(4.7).
    """
    if half == 0:
        return accessible.copy()
    # The dilated image extends beyond the map; if it were cut, its border would erode wrongly.
    framed = _framed(accessible, 2 * half, 0)
    square = np.ones((2 * half + 1, 2 * half + 1), dtype=np.uint8)
    return np.ascontiguousarray(cv2.morphologyEx(framed, cv2.MORPH_CLOSE, square)[2 * half : -2 * half, 2 * half : -2 * half])


def holes(accessible: NDArray[np.uint8], widest: int) -> NDArray[np.uint8]:
    """Return the cells (nx, ny) of holes of at most `widest` [cells] in both axes.

    A hole is a group of zeros surrounded by ones. Zeros that touch, even at corners, are one group. A group that reaches the
    border is no hole.
    """
    out = np.zeros(accessible.shape, dtype=np.uint8)
    _mark_holes(accessible, widest, out)
    return out


@compiled
def _mark_holes(accessible: NDArray[np.uint8], widest: int, out: NDArray[np.uint8]) -> None:
    """Write 1 for the cells of `holes`; `out` is zero before.

    A cell is 1 while its run of zeros along the row may be part of a hole, and 2 once its group has been visited.
    """
    nx, ny = accessible.shape
    for i in range(1, nx - 1):
        before = 0  # the last one of the row, or its first cell
        for j in range(1, ny):
            if accessible[i, j] != 0:
                if 0 < j - before - 1 <= widest and accessible[i, before] != 0:
                    out[i, before + 1 : j] = 1
                before = j
    group = np.empty((8 * widest * widest + 9, 2), dtype=np.int64)  # a visited cell adds at most its 8 neighbours
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            if out[i, j] != 1:
                continue
            out[i, j] = 2
            group[0, 0], group[0, 1] = i, j
            size, visited, is_hole = 1, 0, True
            last, left, right = i, j, j
            while visited < size and is_hole:
                a, b = group[visited, 0], group[visited, 1]
                visited += 1
                last, left, right = max(last, a), min(left, b), max(right, b)
                is_hole = last - i < widest and right - left < widest
                for u in range(a - 1, a + 2):
                    for v in range(b - 1, b + 2):
                        if accessible[u, v] == 0 and out[u, v] == 1:
                            out[u, v] = 2
                            group[size, 0], group[size, 1] = u, v
                            size += 1
                        elif accessible[u, v] == 0 and out[u, v] == 0:
                            is_hole = False
            if not is_hole:
                for k in range(size):
                    out[group[k, 0], group[k, 1]] = 0
    for i in range(nx):
        for j in range(ny):
            out[i, j] >>= 1


def signed_manhattan(ground: NDArray[np.uint8], bound: int, reach: int) -> NDArray[np.int8]:
    """Compute the signed Manhattan distance (nx, ny) [cells] by eq. (4.8).

    On a 1 it is the negative distance to the nearest 0, at least -bound. On a 0 it is the distance to the nearest 1, at most
    reach. Everything outside the border is 0. The bounds are from 1 to 126.

    Source: Masri 2016, eq. (4.8)-(4.10) and the threshold of section 4.6.
    """
    inside = _framed(np.asarray(ground * np.uint8(bound)), 1, 0)
    outside = np.asarray((ground == 0) * np.uint8(reach))
    inside, outside = _manhattan(inside)[1:-1, 1:-1], _manhattan(outside)
    return np.asarray(outside.astype(np.int8) - inside.astype(np.int8))


def published_evaluation(accessible: NDArray[np.uint8], half: int, bound: int, reach: int) -> NDArray[np.int8]:
    """Compute the evaluation function as in the thesis, for comparison.

    It is closed and measured without regard to refused or unseen cells.
    """
    return signed_manhattan(closed(accessible, half), bound, reach)


def disc(radius: float, least: int = 1) -> NDArray[np.uint8]:
    """Return the cells within a radius [cells], and at least a square.

    The square contains the cells whose row and column differ by at most `least`.
    """
    half = max(least, math.floor(radius + 1e-6))
    i, j = np.mgrid[-half : half + 1, -half : half + 1]
    near = (i**2 + j**2 <= (radius + 1e-6) ** 2) | (np.maximum(abs(i), abs(j)) <= least)
    return np.asarray(near, dtype=np.uint8)


TOO_WIDE = 15  # [cells] margin that no cell can keep
DISCS = tuple(disc(k, least=0) for k in range(TOO_WIDE))  # indexed by the margin in cells


def _eroded(layer: NDArray[np.uint8], room: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the minimum (nx, ny) over a neighbourhood, with 0 outside the border."""
    return np.asarray(cv2.erode(layer, room, borderType=cv2.BORDER_CONSTANT, borderValue=[0.0]), dtype=np.uint8)


def _framed(layer: NDArray[np.uint8], width: int, value: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.copyMakeBorder(layer, width, width, width, width, cv2.BORDER_CONSTANT, value=[float(value)]))


def _manhattan(start: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the distance to the nearest 0, limited by the start value of each cell."""
    d = np.array(start, dtype=np.uint8, order="C")
    _along_columns(d)
    turned = np.asarray(cv2.transpose(d), dtype=np.uint8)
    _along_columns(turned)
    return np.asarray(cv2.transpose(turned), dtype=np.uint8)


@compiled
def _along_columns(d: NDArray[np.uint8]) -> None:
    """Limit each cell to one more than the cells above and below it, in place."""
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
