"""The swing that the planner checks lies below the one that the actuator performs.

The foot therefore clears all that the planner's swing clears.
"""

import numpy as np
import pytest

from sextant.services.actuator.locomotion.swing_trajectory import Swing
from sextant.services.planner.locomotion.swing_clearance import LEVEL, descent_clearance, lowest_path
from sextant.services.planner.roadmap import roadmap_search
from sextant.shared.geometry import Array

CYCLES = 60


def swing_path(end: Array, clearance: Array) -> Array:
    """Return the path (n, 3) of a foot from the origin to end (1, 3)."""
    swing = Swing(np.zeros((1, 3)), end, clearance)
    return np.array([np.zeros(3), *(swing.update(end, k / CYCLES, 1 / CYCLES)[0].copy() for k in range(CYCLES))])


@pytest.mark.parametrize("length", [0.08, 0.12, 0.20])
@pytest.mark.parametrize("rise", [-0.05, 0.0, 0.05])
@pytest.mark.parametrize("clearance", [0.025, 0.04, 0.08])
def test_swing_is_not_lower_than_planner_model(length: float, rise: float, clearance: float) -> None:
    start, end, over = np.zeros((1, 3)), np.array([[length, 0.0, rise]]), np.array([clearance])
    way, checked = swing_path(end, over), lowest_path(start, end, over)[:, 0]
    assert (np.interp(checked[:, 0], way[:, 0], way[:, 2]) >= checked[:, 2] - 0.003).all()


@pytest.mark.parametrize("length", [0.10, 0.15, 0.20])
@pytest.mark.parametrize("before", [0.025, 0.04])
@pytest.mark.parametrize("block", [0.02, 0.035, 0.05])
@pytest.mark.parametrize("rise", [-0.03, 0.0, 0.01])
def test_swing_clears_block_before_touchdown(length: float, before: float, block: float, rise: float) -> None:
    """A block begins at the middle of the path and ends at `before` [m] from its end."""
    end, share = np.array([[length, 0.0, rise]]), np.linspace(0.0, 1.0, 21)
    along = share * length
    stands = (share >= 0.5) & (along <= length - before)
    ground = np.where(stands, block, np.where(share > 0.5, rise, 0.0))[:, None]
    needed = descent_clearance(ground, np.zeros((1, 3)), end, 0.008)
    way = swing_path(end, np.maximum(needed, 0.02))
    assert (np.interp(along, way[:, 0], way[:, 2])[stands] >= block + 0.005).all()


def test_even_ground_needs_no_extra_clearance() -> None:
    ground = np.linspace(0.0, 0.03, 21)[:, None]
    assert descent_clearance(ground, np.zeros((1, 3)), np.array([[0.2, 0.0, 0.03]]), 0.008)[0] == -np.inf


def test_search_and_planner_use_same_swing_height() -> None:
    """Keep both copies of the number equal.

    The compiled search has its own copy, because its cache ignores changes in other files.
    """
    assert roadmap_search._LEVEL_SHARE == LEVEL


@pytest.mark.parametrize("length", [0.05, 0.10, 0.20, 0.25])
@pytest.mark.parametrize("rise", [-0.05, 0.0, 0.05])
@pytest.mark.parametrize("clearance", [0.03, 0.048, 0.08, 0.11])
def test_swing_slope_is_within_search_model(length: float, rise: float, clearance: float) -> None:
    way = swing_path(np.array([[length, 0.0, rise]]), np.array([clearance]))
    along, over = way[:, 0] / length, max(0.0, rise) + clearance
    _, near_start, rises = roadmap_search._RISES
    _, near_end, falls = roadmap_search._FALLS
    assert (way[along <= near_start, 2] <= (rises + 0.005) * over).all()
    last = (along >= near_end) & (np.arange(len(way)) > len(way) / 2)
    assert (way[last, 2] - rise <= (falls + 0.005) * (over - rise)).all()
