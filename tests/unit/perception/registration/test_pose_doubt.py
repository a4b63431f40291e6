"""Doubt about the pose: when to search, and when to believe what a search finds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.perception.registration.pose_doubt import PoseDoubt
from sextant.shared.geometry import from_xyz_rpy

EXPECTED = from_xyz_rpy([1.0, 0.5, 0.1], [0.0, 0.1, 0.3])
AWAY = from_xyz_rpy([0.2, 0.0, 0.0], [0.0, 0.0, 0.1]), EXPECTED  # found and expected pose
OTHER = from_xyz_rpy([0.2, 0.06, 0.0], [0.0, 0.0, 0.1]), EXPECTED


@pytest.fixture
def doubt() -> PoseDoubt:
    return PoseDoubt(frames_before_search=3, search_every=4)


def test_search_is_due_after_consecutive_doubtful_frames_and_then_repeatedly(doubt: PoseDoubt) -> None:
    due, lasts = [], []
    for _ in range(12):
        doubt.update(True)
        due.append(doubt.is_search_due())
        lasts.append(doubt.lasts)
    assert np.flatnonzero(due).tolist() == [2, 6, 10]
    assert lasts == [False] * 2 + [True] * 10
    doubt.update(False)
    assert not doubt.is_search_due()
    assert not doubt.lasts


def test_two_searches_in_a_row_must_agree(doubt: PoseDoubt) -> None:
    assert not doubt.is_confirmed(*AWAY)
    assert not doubt.is_confirmed(*OTHER)
    assert doubt.is_confirmed(*OTHER)


@given(st.floats(-1.0, 1.0), st.floats(-0.5, 0.5), st.floats(-1.0, 1.0), st.floats(-3.0, 3.0))
def test_searches_agree_on_a_displaced_robot_that_walks_on(x: float, y: float, yaw: float, turned: float) -> None:
    doubt, correction = PoseDoubt(3, 4), from_xyz_rpy([0.3, -0.2, 0.0], [0.0, 0.0, turned])
    walked = EXPECTED @ from_xyz_rpy([x, y, 0.0], [0.0, 0.0, yaw])
    assert not doubt.is_confirmed(correction @ EXPECTED, EXPECTED)
    assert doubt.is_confirmed(correction @ walked, walked)


def test_good_frame_in_between_discards_the_first_search(doubt: PoseDoubt) -> None:
    doubt.is_confirmed(*AWAY)
    doubt.update(False)
    assert not doubt.is_confirmed(*AWAY)


def test_search_after_the_doubt_ended_needs_its_own_second_search(doubt: PoseDoubt) -> None:
    """Check a frame that is in doubt right after the pose found by two searches was taken."""
    doubt.is_confirmed(*AWAY)
    assert doubt.is_confirmed(*AWAY)
    doubt.clear()
    doubt.update(True)
    assert not doubt.is_confirmed(*AWAY)


def test_restart_of_the_map_forgets_frames_searches_and_suspension(doubt: PoseDoubt) -> None:
    for _ in range(3):
        doubt.update(True)
    doubt.is_confirmed(*AWAY)
    doubt.suspend()
    doubt.reset()
    assert not doubt.lasts
    assert not doubt.is_suspended()
    assert not doubt.is_confirmed(*AWAY)


def test_suspension_lasts_for_the_time_between_two_searches(doubt: PoseDoubt) -> None:
    assert not doubt.is_suspended()
    doubt.suspend()
    assert doubt.lasts
    assert [doubt.is_suspended() for _ in range(5)] == [True, True, True, False, False]
