"""Strips for tests and benchmarks of the passage planner: two platforms, a gap, and pillars in it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.whole_maps.strip import RESOLUTION

GAP = 0.80  # [m]
NEAR, FAR, WIDTH = 0.70, 0.80, 1.20  # [m] platforms before and behind the gap, and width of the strip
FLOOR = -0.30  # [m]
START, BEYOND = 0.44, 0.25  # [m] initial body position along the strip, and distance behind the gap where all feet stand


@dataclass(frozen=True, slots=True)
class Block:
    """A pillar.

    Its centre is [m] from the near edge of the gap and to the left of the middle. Size [m] is along and across, top [m].
    """

    x: float
    y: float
    length: float = 0.10
    width: float = 0.10
    top: float = 0.0


def row(
    side: int, y: float, gap: float, n: int, length: float, shift: float = 0.0, between: float | None = None
) -> list[Block]:
    """Return a bridge of n blocks on one side, evenly spaced or at given distances.

    The middle block is shifted inward.
    """
    free = (gap - n * length) / (n + 1) if between is None else between
    first = (gap - n * length - (n - 1) * free) / 2 + length / 2
    inward = [shift if n == 3 and k == 1 else 0.0 for k in range(n)]
    return [Block(first + k * (length + free), side * (y - inward[k]), length) for k in range(n)]


def thesis_blocks(scenario: int, gap: float, y: float, length: float, shift: float, two: float) -> list[Block]:
    """Return the pillars of the thesis' first, second or third scenario.

    Source: Masri 2016, section 6.1-6.3.

    Args:
        scenario: 1, 2 or 3.
        gap: [m] long.
        y: [m] of the bridges' centre lines.
        length: [m] of a block in a row of three.
        shift: [m] by which the middle ones are shifted inward in the second and third scenario.
        two: [m] length of a block in a row of two, 10 cm apart.
    """
    inward = 0.0 if scenario == 1 else shift
    left = row(1, y, gap, 3, length, inward)
    return left + (row(-1, y, gap, 2, two, between=0.10) if scenario == 3 else row(-1, y, gap, 3, length, inward))


def random_blocks(
    rng: np.random.Generator, gap: float, pitch: float, share: float, size: float, relief: float = 0.0
) -> list[Block]:
    """Return pillars at a share of the points of a jittered grid.

    Their tops differ from the platforms by up to a relief [m].
    """
    out = []
    columns, rows = max(1, round(gap / pitch)), max(1, round(0.6 / pitch))
    for i in range(columns):
        for j in range(rows):
            jitter = rng.uniform(-0.5, 0.5, 2) * max(pitch - size - 0.01, 0.0)
            top = float(rng.uniform(-relief, relief)) if relief else 0.0
            if rng.random() < share:
                x, y = (i + 0.5) * gap / columns + jitter[0], (j + 0.5) * 0.6 / rows - 0.3 + jitter[1]
                out.append(Block(float(x), float(y), size, size, top))
    return out


def heights(blocks: Sequence[Block], gap: float) -> NDArray[np.float32]:
    """Return the heights (nx, ny) [m] of a strip."""
    nx, ny = round((NEAR + gap + FAR) / RESOLUTION), round(WIDTH / RESOLUTION)
    x = (np.arange(nx) + 0.5) * RESOLUTION - NEAR
    y = (np.arange(ny) + 0.5) * RESOLUTION - WIDTH / 2
    h = np.zeros((nx, ny), dtype=np.float32)
    h[(x > 0) & (x < gap)] = FLOOR
    for block in blocks:
        along, across = np.abs(x - block.x) < block.length / 2, np.abs(y - block.y) < block.width / 2
        h[np.ix_(along & (x > 0) & (x < gap), across)] = block.top
    return h
