"""Laws of changes of the mapped ground."""

import numpy as np
import pytest

from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.elevation.ground_changes import GroundChanges
from sextant.services.mapper.elevation.leg_heights import LegHeights

FIRST, SECOND = np.array([0.01, -0.005, 0.02]), np.array([0.016, 0.002, 0.03])
CORNERS = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]


def ground(x: float, y: float) -> float:
    return 0.05 + 0.1 * x - 0.05 * y


def changed(height: float, x: float, y: float, change: np.ndarray) -> float:
    a, b, c = change
    return float(height + a * x + b * y + c)


def test_first_scan_and_equal_scans_change_nothing() -> None:
    changes = GroundChanges()
    assert changes.next(FIRST) is None, "the map was made with this correction"
    assert changes.next(FIRST) is None


def test_changes_add_up_to_the_stated_total() -> None:
    """Steps from one total to the next give the same ground as the totals themselves."""
    grid, changes = ElevationGrid(128, 0.01), GroundChanges()
    grid.move_to([0.05, -0.1])
    grid.seed_plane(CORNERS, [0.05, 0.1, -0.05])
    changes.next(np.zeros(3))
    for total in (0.5 * FIRST, FIRST, SECOND):
        step = changes.next(total)
        assert step is not None
        grid.change_ground(step)
    for x, y in ((0.305, 0.205), (-0.205, 0.305), (0.005, -0.495)):
        assert float(grid.heights([x, y])) == pytest.approx(changed(ground(x, y), x, y, SECOND), abs=1e-6)


def test_new_start_of_perception_changes_nothing() -> None:
    changes = GroundChanges()
    changes.next(np.array([0.05, 0.0, 0.0]))
    assert changes.next(np.zeros(3)) is None, "more than a slow correction"
    step = changes.next(np.array([0.001, 0.0, 0.0]))
    assert step is not None
    assert step == pytest.approx([0.001, 0.0, 0.0])


@pytest.mark.parametrize("small", [0.5, 0.01])
def test_new_start_of_perception_after_a_small_correction_changes_nothing(small: float) -> None:
    """The map would turn about the origin of {world}, which may be far away."""
    changes = GroundChanges()
    changes.next(small * FIRST)
    assert changes.next(np.zeros(3)) is None
    assert changes.next(np.zeros(3)) is None


def test_legs_follow_the_ground() -> None:
    """The ground by touch does not change with the map, so the difference does."""
    legs = LegHeights(0.02)
    for _ in range(5):
        legs.update(2, 0.0, 0.006)
    before = legs.differences.copy()
    legs.change_ground(np.full(6, -0.002))
    assert legs.differences[2] == pytest.approx(before[2] + 0.002)
    assert legs.differences[[0, 1, 3, 4, 5]].tolist() == [0.0] * 5, "they have not touched the ground yet"


def test_measured_differences_are_not_drawn_to_zero() -> None:
    legs = LegHeights(0.02)
    assert np.isnan(legs.measured).all()
    legs.update(1, 0.0, 0.006)
    assert legs.measured[1] == pytest.approx(-0.006, abs=2e-4)
    assert abs(legs.differences[1]) < 0.005
    assert np.isnan(legs.measured[0])


def test_legs_that_follow_nothing_report_nothing() -> None:
    legs = LegHeights(0.0)
    legs.update(1, 0.0, 0.006)
    assert np.isnan(legs.measured).all()
