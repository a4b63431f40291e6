"""Walkability score: invariances, slopes, steps, and unknown cells.

Some cases are missed by the signed mean of the thesis.
"""

import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.mapper.footholds.foothold_score import ScoreTerms, Walkability, WalkabilityScorer
from sextant.services.mapper.footholds.params import ScoreParams
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE

RESOLUTION = 0.01


class Scored(NamedTuple):
    """A score with its terms."""

    whole: Walkability
    terms: ScoreTerms

    @property
    def score(self) -> NDArray[np.float32]:
        return self.whole.score

    @property
    def acceptable(self) -> NDArray[np.bool_]:
        return self.whole.acceptable

    @property
    def slope(self) -> NDArray[np.float32]:
        return self.terms.slope

    @property
    def proximity(self) -> NDArray[np.float32]:
        return self.terms.proximity

    @property
    def roughness(self) -> NDArray[np.float32]:
        return self.terms.roughness


def score(elevation: NDArray[np.floating], weights: ScoreParams | None = None) -> Scored:
    scorer = WalkabilityScorer((elevation.shape[0], elevation.shape[1]), RESOLUTION, weights)
    return Scored(scorer.score(elevation.astype(np.float32)), scorer.terms())


def plane(degrees: float, heading: float = 0.0, size: int = 41) -> NDArray[np.float64]:
    i, j = np.mgrid[:size, :size] * RESOLUTION
    return np.asarray(math.tan(math.radians(degrees)) * (i * math.cos(heading) + j * math.sin(heading)))


def terrain(seed: int, shape: tuple[int, int] = (40, 52)) -> NDArray[np.float64]:
    """Return blocks, a ramp, millimetre noise and unknown cells."""
    rng = np.random.default_rng(seed)
    z = rng.normal(0.0, 0.001, shape)
    for _ in range(5):
        i, j = rng.integers(0, shape[0] - 8), rng.integers(0, shape[1] - 8)
        z[i : i + rng.integers(3, 12), j : j + rng.integers(3, 12)] += rng.uniform(-0.04, 0.04)
    z += 0.2 * RESOLUTION * np.arange(shape[1])
    z[rng.random(shape) < 0.01] = np.nan
    return np.asarray(z, dtype=np.float64)


def steps_from_edge(size: int = 40, edge: int = 20) -> NDArray[np.float64]:
    """Return the distance (size,) [m] of cell centres from a step.

    The step lies between the cells `edge - 1` and `edge`.
    """
    return np.asarray(np.abs(np.arange(size) - edge + 0.5) * RESOLUTION)


# ---- invariances


@given(st.integers(0, 1000), st.floats(-2.0, 2.0))
@settings(deadline=None, max_examples=25)
def test_constant_height_offset_does_not_change_score(seed: int, constant: float) -> None:
    z = terrain(seed)
    a, b = score(z), score(z + constant)
    np.testing.assert_allclose(a.score, b.score, atol=0.02)  # float32 heights near 2 m are 0.1 micrometres apart
    np.testing.assert_array_equal(np.isnan(a.score), np.isnan(b.score))


@pytest.mark.parametrize("turn", [lambda m: m.T, lambda m: m[::-1], lambda m: m[:, ::-1], lambda m: m[::-1, ::-1].T])
def test_score_is_equivariant_to_rotation_and_reflection(turn: object) -> None:
    assert callable(turn)
    for seed in range(5):
        z = terrain(seed)
        a, b = score(z), score(np.ascontiguousarray(turn(z)))
        # The roughness is the root of a difference from the noise, so rounding grows if both are nearly equal.
        for name, tolerance in (("score", 0.01), ("slope", 1e-5), ("proximity", 1e-6), ("roughness", 2e-5)):
            np.testing.assert_allclose(turn(getattr(a, name)), getattr(b, name), atol=tolerance)


def test_hole_and_block_have_equal_score() -> None:
    z = np.zeros((40, 40))
    z[15:25, 15:25] = 0.03
    np.testing.assert_allclose(score(z).score, score(-z).score, atol=1e-5)


def test_score_is_weighted_sum_relative_to_limit() -> None:
    w = ScoreParams(slope=0.7, proximity=33.0, roughness=210.0, limit=0.4)
    s = score(terrain(3), w)
    weighted_sum = 0.7 * s.slope + 33.0 * s.proximity + 210.0 * s.roughness
    np.testing.assert_allclose(s.score, weighted_sum / 0.4, rtol=1e-5)
    np.testing.assert_array_equal(s.acceptable, s.score <= MAX_FOOTHOLD_SCORE)


# ---- slope


@pytest.mark.parametrize("heading", [0.0, 0.5, math.pi / 4, 2.0, -math.pi / 2])
def test_slope_of_plane_is_true_gradient_without_edges(heading: float) -> None:
    for degrees in (0.0, 5.0, 15.0, 35.0, 60.0):
        s = score(plane(degrees, heading))
        inside = (slice(3, -3), slice(3, -3))
        np.testing.assert_allclose(s.slope[inside], math.tan(math.radians(degrees)), rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(s.proximity[inside], 0.0, atol=1e-5)
        assert (s.roughness[inside] == 0.0).all()


@pytest.mark.parametrize("heading", [0.0, 0.7, math.pi / 2])
def test_slopes_to_15_deg_are_acceptable_and_from_35_deg_are_not(heading: float) -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 0.0007, (41, 41))
    for degrees in (0.0, 10.0, 15.0):
        assert score(plane(degrees, heading)).acceptable[3:-3, 3:-3].all()
        assert score(plane(degrees, heading) + noise).acceptable[3:-3, 3:-3].mean() > 0.995
    for degrees in (35.0, 45.0, 70.0):
        assert not score(plane(degrees, heading)).acceptable.any()
        assert score(plane(degrees, heading) + noise).acceptable.mean() < 0.005


# ---- steps


@pytest.mark.parametrize("height", [0.01, 0.02, 0.04, -0.01, -0.04])
def test_only_cells_within_2_cm_of_step_are_refused(height: float) -> None:
    z = np.zeros((40, 40))
    z[20:] = height
    near = steps_from_edge() < 0.02
    for ground, axis in ((z, 0), (z.T, 1)):
        accepted = np.moveaxis(score(ground).acceptable, axis, 0)[1:-1, 3:-3]
        assert not accepted[near[1:-1]].any()
        assert accepted[~near[1:-1]].all()


@pytest.mark.parametrize("height", [0.01, 0.02, 0.04])
def test_cells_within_2_cm_of_corner_or_slanted_edge_are_refused(height: float) -> None:
    i, j = np.mgrid[:24, :24]
    grounds = [np.where((i >= 12) & (j >= 12), height, 0.0)]
    for angle in np.linspace(0.0, math.pi, 17):
        side = (i - 11.5) * math.cos(angle) + (j - 11.5) * math.sin(angle)
        grounds += [np.where(side >= 0, height, 0.0)]
    for ground in grounds:
        for k, m in np.argwhere(score(ground).acceptable[2:-2, 2:-2]) + 2:  # where the whole window is known
            other = np.abs(ground - ground[k, m]) > 1e-6  # cells of another height: distance to the nearest side or corner
            gap = np.hypot(np.maximum(np.abs(i - k) - 0.5, 0.0), np.maximum(np.abs(j - m) - 0.5, 0.0))
            assert gap[other].min() * RESOLUTION >= 0.02, (k, m)


def test_1_cm_step_is_detected_in_noise() -> None:
    rng = np.random.default_rng(4)
    z = rng.normal(0.0, 0.001, (40, 400))
    z[20:] += 0.01
    accepted = score(z).acceptable[2:-2, 2:-2]
    near = (steps_from_edge() < 0.02)[2:-2]
    assert accepted[near].mean() < 0.02
    assert accepted[~near].mean() > 0.98


def test_5_mm_step_is_acceptable() -> None:
    z = np.zeros((40, 40))
    z[20:] = 0.005
    assert score(z).acceptable[1:-1, 1:-1].all()


# ---- steps that cancel in the signed mean


@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_narrow_tread_between_two_steps_is_refused(width: int) -> None:
    z = np.zeros((40, 40))
    z[:18] = 0.03
    z[18 + width :] = -0.03
    s = score(z)
    assert not s.acceptable[16 : 20 + width].any()
    if width % 2:
        centre = 18 + width // 2
        assert s.proximity[centre, 20] == pytest.approx(0.0, abs=1e-6)  # the reason for the third term


def test_middle_of_wide_tread_is_accepted() -> None:
    z = np.zeros((40, 40))
    z[:15] = 0.03
    z[20:] = -0.03
    assert score(z).acceptable[17, 3:-3].all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_ridges_grooves_and_saddles_are_refused(sign: float) -> None:
    i, j = np.mgrid[-20:21, -20:21]
    ridge = np.where(i == 0, 0.02, 0.0)
    vee = 0.01 * math.tan(math.radians(30.0)) * np.abs(i)
    saddle = 10.0 * 1e-4 * (i**2 - j**2)
    for ground in (ridge, vee, saddle):
        assert not score(sign * ground).acceptable[20, 20]
    assert score(sign * saddle).slope[20, 20] == pytest.approx(0.0, abs=1e-5)
    assert score(sign * saddle).proximity[20, 20] == pytest.approx(0.0, abs=1e-6)


def test_score_grows_with_step_height() -> None:
    scores = []
    for height in (0.01, 0.02, 0.04):
        z = np.zeros((20, 20))
        z[10:] = height
        scores.append(score(z).score[8:12, 10])
    assert (scores[0] < scores[1]).all()
    assert (scores[1] < scores[2]).all()


# ---- unknown cells


def test_only_cells_next_to_unknown_cells_or_border_have_no_score() -> None:
    z = plane(10.0)
    z[20, 20] = np.nan
    s = score(z)
    unscored = np.zeros(z.shape, dtype=bool)
    unscored[19:22, 19:22] = True
    unscored[[0, -1], :] = unscored[:, [0, -1]] = True
    for layer in (s.score, s.slope, s.proximity, s.roughness):
        np.testing.assert_array_equal(np.isnan(layer), unscored)
    np.testing.assert_array_equal(s.acceptable, ~unscored)


def test_unknown_cells_cause_no_false_edges() -> None:
    rng = np.random.default_rng(2)
    for heading in (0.0, 0.8):
        z = plane(12.0, heading) + 0.4
        z[rng.random(z.shape) < 0.04] = np.nan
        z[:, 30:] = np.nan
        s = score(z)
        scored = ~np.isnan(s.score)
        assert scored[:, :29].mean() > 0.5
        np.testing.assert_allclose(s.slope[scored], math.tan(math.radians(12.0)), rtol=1e-3)
        assert s.roughness[scored].max() == 0.0
        assert s.acceptable[scored].all()


def test_unknown_clearance_setting_is_applied() -> None:
    z = np.zeros((40, 40))
    z[20, 20] = np.nan
    s = score(z, ScoreParams(unknown_clearance=0.03))
    i, j = np.mgrid[:40, :40]
    distance = np.hypot(i - 20, j - 20)
    inside = (np.minimum(i, j) >= 3) & (np.maximum(i, j) < 37)
    np.testing.assert_array_equal(s.acceptable[inside], (distance > 3 + 1e-6)[inside])


def test_unseen_map_has_no_score() -> None:
    s = score(np.full((20, 30), np.nan))
    assert np.isnan(s.score).all()
    assert not s.acceptable.any()


def test_repeated_calls_do_not_modify_earlier_result() -> None:
    scorer = WalkabilityScorer((40, 52), RESOLUTION)
    first = scorer.score(terrain(1).astype(np.float32))
    copy = first.score.copy()
    scorer.score(terrain(2).astype(np.float32))
    np.testing.assert_array_equal(first.score, copy)
    np.testing.assert_array_equal(scorer.score(terrain(1).astype(np.float32)).score, copy)


def test_coarser_map_gives_same_acceptability() -> None:
    for degrees, good in ((15.0, True), (35.0, False)):
        i = np.arange(30) * 0.02
        z = np.broadcast_to(math.tan(math.radians(degrees)) * i[:, None], (30, 30)).astype(np.float32)
        s = WalkabilityScorer((30, 30), 0.02).score(z)
        assert (s.acceptable[2:-2, 2:-2] == good).all()
    z = np.zeros((30, 30), dtype=np.float32)
    z[15:] = 0.02
    assert not WalkabilityScorer((30, 30), 0.02).score(z).acceptable[14:16].any()


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="3x3"):
        WalkabilityScorer((2, 40), RESOLUTION)
    with pytest.raises(ValueError, match="resolution"):
        WalkabilityScorer((40, 40), 0.0)
    with pytest.raises(ValueError, match="flat_radius"):
        WalkabilityScorer((40, 40), 0.0005)
    with pytest.raises(ValueError, match="shape"):
        WalkabilityScorer((40, 40), RESOLUTION).score(np.zeros((40, 41), dtype=np.float32))
    with pytest.raises(ValueError, match="infinite"):
        score(np.full((20, 20), np.inf))
    with pytest.raises(ValueError, match="infinite"):
        score(np.where(np.eye(20) > 0, [[np.inf]], -np.inf))
    with pytest.raises(ValueError, match="limit"):
        ScoreParams(limit=0.0)
    with pytest.raises(ValueError, match="noise_sigma"):
        ScoreParams(noise_sigma=math.nan)
