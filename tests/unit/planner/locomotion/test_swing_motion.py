"""Motion of the joints in a swing."""

from itertools import pairwise

import numpy as np
import pytest

from sextant.services.actuator.locomotion.swing_trajectory import Swing
from sextant.services.planner.locomotion.swing_motion import SWING_TIME, shortest_swing_s, swing_joints, swing_speeds
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.kinematics import body_forward, nearest_reachable
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
REST = PROFILE.rest_feet(0.11)
STILL = np.eye(4)
FORWARD = np.array([1.0, 0.0, 0.0])


def reach(length: float) -> np.ndarray:
    return REST + np.array([length, 0.0, 0.0])


@pytest.mark.parametrize(("length", "lift"), [(0.08, 0.01), (0.08, 0.025), (0.08, 0.04), (0.1, 0.03)])
def test_feet_follow_the_path_of_the_actuator(length: float, lift: float) -> None:
    start, end, clearance = reach(-length / 2), reach(length / 2), np.full(6, lift)
    found = body_forward(PROFILE, swing_joints(PROFILE, start, end, clearance, STILL, STILL))
    swing, feet = Swing(start, end, clearance), [start]
    for begin, until in pairwise(SWING_TIME):
        feet.append(swing.update(end, float(begin), float(until - begin)).copy())
    np.testing.assert_allclose(found, [nearest_reachable(PROFILE, now) for now in feet], atol=0.009)


def test_motion_of_the_body_counts() -> None:
    T_end = from_xyz_rpy((0.05, 0.0, 0.0), np.zeros(3))
    moved = swing_joints(PROFILE, REST, REST, np.full(6, 0.02), STILL, T_end)
    np.testing.assert_allclose(body_forward(PROFILE, moved)[-1], REST - 0.05 * FORWARD, atol=1e-9)


def test_joint_that_turns_evenly_has_its_mean_speed() -> None:
    q = np.broadcast_to(SWING_TIME[:, None, None] * 2.0, (len(SWING_TIME), 6, 3))
    np.testing.assert_allclose(swing_speeds(q), 2.0)


def test_longer_and_higher_swings_take_longer() -> None:
    def time(length: float, lift: float, share: float = 0.6) -> float:
        ends = reach(-length / 2), reach(length / 2)
        return float(shortest_swing_s(PROFILE, *ends, np.full(6, lift), STILL, STILL, share).max())

    assert time(0.06, 0.03) < time(0.1, 0.03) < time(0.14, 0.03)
    assert time(0.1, 0.02) < time(0.1, 0.05)
    assert time(0.1, 0.03, share=0.3) == pytest.approx(2.0 * time(0.1, 0.03))
