"""The swing that the planner checks lies under the one that the actuator flies."""

import numpy as np
import pytest

from services.actuator.swing import Swing
from services.planner.leg_clearance import swing_shape

CYCLES = 60


@pytest.mark.parametrize("length", [0.08, 0.12, 0.20])
@pytest.mark.parametrize("rise", [-0.05, 0.0, 0.05])
@pytest.mark.parametrize("clearance", [0.025, 0.04, 0.08])
def test_the_foot_flies_no_lower_than_the_planner_thinks(length: float, rise: float, clearance: float) -> None:
    start, end, over = np.zeros((1, 3)), np.array([[length, 0.0, rise]]), np.array([clearance])
    swing = Swing(start, end, over)
    way = np.array([start[0], *(swing.update(end, k / CYCLES, 1 / CYCLES)[0].copy() for k in range(CYCLES))])
    checked = swing_shape(start, end, over)[:, 0]
    flown = np.interp(checked[:, 0], way[:, 0], way[:, 2])
    assert (flown >= checked[:, 2] - 0.003).all()
