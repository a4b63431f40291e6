"""Stall detection: approach counts as progress, other motion only for a while.

A detour is allowed, but not alternation between two ways.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.planner.navigation.stall_detection import StallDetector
from sextant.shared.geometry import Array

S = 1_000_000_000
SPEED = 0.1


def update(progress: StallDetector, t: float, left: float, error: float = 0.0, place: Array | None = None) -> str:
    moving = np.array([t, 0.0, 0.0])  # away from the previous place
    return progress.update(round(t * S), moving if place is None else place, left, error, SPEED)


def test_slow_approach_is_progress_and_standing_is_stall() -> None:
    progress = StallDetector()
    assert not any(update(progress, t, 9.0 - 0.02 * t) for t in range(200))
    place = np.array([1.0, 2.0, 3.0])
    words = [update(progress, 200 + t, 5.0, 0.0, place) for t in range(6)]
    assert words[:4] == [""] * 4
    assert words[4] == "no motion for 4 s"


def test_turn_towards_desired_heading_is_progress() -> None:
    progress, t = StallDetector(), 0
    for left in (3.0, 2.5, 2.0):
        for error in np.radians(np.arange(170.0, 0.0, -3.0)):
            t += 1
            assert not update(progress, t, left, float(error))


def test_longer_path_after_path_change_is_not_stall() -> None:
    progress = StallDetector()
    assert not any(update(progress, t, 3.0 - 0.1 * t) for t in range(20))
    progress.changed = True
    assert not any(update(progress, 20 + t, 6.0 - 0.1 * t, max(2.0 - 0.2 * t, 0.0)) for t in range(60))


def test_longer_path_without_path_change_is_stall() -> None:
    progress = StallDetector()
    assert not any(update(progress, t, 3.0 - 0.1 * t) for t in range(20))
    words = [update(progress, 20 + t, 6.0 - 0.1 * t) for t in range(20)]
    assert "no progress for 16 s" in words


@given(st.floats(0.06, 3.0), st.floats(0.2, 3.0), st.floats(2.0, 40.0))
@settings(max_examples=30)
def test_alternation_between_two_paths_is_stall(way: float, turn: float, period: float) -> None:
    progress = StallDetector()
    for t in np.arange(0.0, 6 * (2 * period + 17.0), 0.5):
        progress.changed = True
        there_and_back = 0.5 - 0.5 * float(np.cos(2 * np.pi * t / period))
        if update(progress, float(t), 3.0 + way * there_and_back, turn * (1.0 - there_and_back)):
            return
    pytest.fail("it goes on for ever")


def test_pause_between_updates_is_not_stall() -> None:
    progress, place = StallDetector(), np.zeros(3)
    assert not update(progress, 0.0, 3.0, 0.0, place)
    assert not update(progress, 3600.0, 3.0, 0.0, place)
    assert not update(progress, 3601.0, 3.0, 0.0, place)
    assert update(progress, 3603.0, 3.0, 0.0, place)


def test_slow_commanded_speed_is_not_stall() -> None:
    progress = StallDetector()
    assert not any(progress.update(t * S, np.array([0.005 * t, 0.0, 0.0]), 3.0 - 0.005 * t, 0.0, 0.005) for t in range(100))


def test_time_without_data_does_not_count_as_stall() -> None:
    progress, place = StallDetector(), np.zeros(3)
    for second in range(60):
        progress.pause()
        assert progress.update(second * 10**9, place, 1.0, 0.0, 0.1) == ""
    assert [bool(progress.update((60 + second) * 10**9, place, 1.0, 0.0, 0.1)) for second in range(4)] == [False] * 3 + [True]
