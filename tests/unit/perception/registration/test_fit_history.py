"""Fit history: a frame is compared with recent good frames."""

import numpy as np
import pytest

from sextant.services.perception.registration.acceptance import HAND_HELD, Acceptance
from sextant.services.perception.registration.fit_history import FitHistory
from sextant.services.perception.registration.projective_matching import Match


def match(rmse: float = 0.002, misfit: float = 1.0, overlap: float = 0.9) -> Match:
    return Match(np.eye(6), np.zeros(6), np.eye(6), 1, overlap=overlap, agreement=1.0, rmse=rmse, misfit=misfit)


@pytest.fixture
def fit() -> FitHistory:
    """Return the history of many frames with surfaces 2 mm apart."""
    history = FitHistory(Acceptance())
    for _ in range(200):
        history.add(match())
    return history


def test_first_frame_is_compared_with_the_absolute_limit_alone() -> None:
    history = FitHistory(Acceptance())
    assert history.rejection_reason(match(rmse=0.009, misfit=50.0), 1.0) == ""
    assert "mm apart" in history.rejection_reason(match(rmse=0.011), 1.0)
    assert not history.is_poor(match(rmse=0.009, misfit=50.0))


def test_rmse_limit_follows_the_average(fit: FitHistory) -> None:
    assert fit.rejection_reason(match(rmse=0.0069), 1.0) == ""
    assert "8.0 mm apart, 7.0 mm allowed" in fit.rejection_reason(match(rmse=0.008), 1.0)
    fit.reset()
    assert fit.rejection_reason(match(rmse=0.008), 1.0) == ""


def test_missing_pixels_are_part_of_the_reason(fit: FitHistory) -> None:
    assert fit.rejection_reason(match(overlap=0.1), 0.9).endswith("needed")
    assert fit.rejection_reason(match(overlap=0.1), 0.3).endswith("70% of the pixels in view have no measurement")
    assert fit.rejection_reason(match(), 0.3) == ""


def test_worse_fit_than_lately_is_poor(fit: FitHistory) -> None:
    assert not fit.is_poor(match(rmse=0.0031, misfit=1.2))
    assert fit.is_poor(match(misfit=1.3))
    assert fit.is_poor(match(rmse=0.0033))


def test_place_found_by_a_search_must_fit_like_recent_frames(fit: FitHistory) -> None:
    assert fit.is_plausible(match(rmse=0.0039))
    assert not fit.is_plausible(match(rmse=0.0041))


def test_only_a_camera_without_legs_is_refused_for_a_worsening(fit: FitHistory) -> None:
    bad = match(misfit=3.0, overlap=0.5)
    assert fit.worsening(bad) == ""
    hand_held = FitHistory(HAND_HELD)
    hand_held.add(match())
    assert hand_held.worsening(bad) == "50% of the frame overlaps known ground and fits 3.0 times worse than recent frames"
    assert hand_held.worsening(match(misfit=3.0)) == "", "a large overlap"
    assert hand_held.worsening(match(misfit=3.0), overlap=1.0)
