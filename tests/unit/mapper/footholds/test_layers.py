"""Foothold layers of a map that grows and moves.

Updates equal a complete computation. The margin widens with doubt. Each thesis has its own refusals.
"""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.mapper.footholds.foothold_score import published_score
from sextant.services.mapper.footholds.layers import FootholdLayers, Layers, Margin
from sextant.services.mapper.footholds.params import ScoreParams
from sextant.shared.wire.messages import UNKNOWN

Heights = NDArray[np.float32]

N = 48
WEIGHTS = ScoreParams(unknown_clearance=0.02)
ORIGIN = np.zeros(2, dtype=np.int64)


def layers(margin: Margin | None = None, n: int = N) -> FootholdLayers:
    return FootholdLayers((n, n), 0.01, margin, WEIGHTS)


def of(z: NDArray[np.floating], sigma: float = 0.0, body: float = math.inf, **options: float) -> Layers:
    """Return the layers of one map with heights known to the millimetre."""
    h = z.astype(np.float32)
    maker = FootholdLayers((h.shape[0], h.shape[1]), 0.01, Margin(**options), WEIGHTS)
    return maker.update(h, np.where(np.isnan(h), np.float32(np.nan), np.float32(1e-6)), ORIGIN, body, sigma)


# ---- partial updates


@pytest.mark.slow
@given(st.integers(0, 2**32), st.integers(3, 12))
@settings(deadline=None, max_examples=25)
def test_incremental_layers_equal_full_recomputation(seed: int, rounds: int) -> None:
    rng = np.random.default_rng(seed)
    world = np.full((4 * N, 4 * N), np.nan, dtype=np.float32)
    variance = np.full_like(world, 1e-6)
    first = np.array([3 * N // 2, 3 * N // 2])
    kept = layers()
    for _ in range(rounds):
        for _ in range(rng.integers(0, 3)):
            i, j = first + rng.integers(0, N, 2)
            patch = slice(i, i + rng.integers(1, 25)), slice(j, j + rng.integers(1, 25))
            level = rng.choice([0.0, 0.0, 0.02, -0.03, 0.1, -0.4, np.nan])
            world[patch] = level + rng.normal(0.0, 0.001, world[patch].shape)
            variance[patch] = rng.choice([1e-6, 4e-5, 2e-4])
        first = np.clip(first + rng.choice([0, 0, 1, -2, 5, -40, 60], 2), 0, 3 * N)
        window = tuple(slice(k, k + N) for k in first)
        arguments = (variance[window], first, 0.1 + 0.05 * rng.random(), float(rng.choice([0.0, 0.004, 0.01])))
        a, b = kept.update(world[window], *arguments), layers().update(world[window], *arguments)
        np.testing.assert_allclose(a.score, b.score, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(a.evaluation, b.evaluation)


@pytest.mark.parametrize("resolution", [0.001, 0.004, 0.01, 0.02, 0.05, 1.0])
@pytest.mark.parametrize("shape", [(40, 90), (90, 40)])
def test_wall_is_refused_and_level_ground_accepted_at_any_resolution(shape: tuple[int, int], resolution: float) -> None:
    """Check that a wall is refused and level ground accepted at any cell size."""
    z = np.zeros(shape, dtype=np.float32)
    z[:, shape[1] // 2 :] = 0.5
    made = FootholdLayers(shape, resolution, None, WEIGHTS).update(z, np.zeros_like(z), ORIGIN)
    wall = slice(shape[1] // 2 - 1, shape[1] // 2 + 1)
    for good in (made.score <= 1, made.evaluation < 0):
        assert not good[:, wall].any()
    far = 0.02 / resolution + 4
    if far < shape[1] / 4:
        level = made.evaluation[:, shape[1] // 4][round(far) : -round(far)]
        assert level.size == 0 or (level < 0).all()


def test_only_changed_cells_are_rescored() -> None:
    rng = np.random.default_rng(0)
    z = rng.normal(0.0, 0.001, (N, N)).astype(np.float32)
    kept, variance = layers(), np.full_like(z, 1e-6)
    assert kept.update(z, variance, ORIGIN).rescored == 1.0
    assert kept.update(z, variance, ORIGIN).rescored == 0.0
    z[20:24, 30:36] += 0.01
    assert kept.update(z, variance, ORIGIN).rescored == pytest.approx((4 + 6) * (6 + 6) / N**2)


def test_later_update_does_not_modify_earlier_result() -> None:
    z = np.zeros((N, N), dtype=np.float32)
    kept = layers()
    before = kept.update(z, z, ORIGIN)
    score, evaluation = before.score.copy(), before.evaluation.copy()
    z[10:20] = 0.1
    kept.update(z, z, ORIGIN)
    np.testing.assert_array_equal(before.score, score)
    np.testing.assert_array_equal(before.evaluation, evaluation)


# ---- foothold map


def test_level_ground_is_accessible_up_to_unknown_clearance() -> None:
    F = of(np.zeros((N, N))).evaluation
    assert (F[2:-2, 2:-2] < 0).all()
    assert (F[[0, 1, -2, -1]] > 0).all()
    assert F.min() == -5
    assert (F[6:-6, 6:-6] == -5).all()


@pytest.mark.parametrize("height", [0.01, 0.04, 0.3, -0.02])
def test_both_layers_refuse_both_sides_of_edge(height: float) -> None:
    z = np.zeros((N, N))
    z[N // 2 :] = height
    made = of(z)
    near = slice(N // 2 - 2, N // 2 + 2)  # within 2 cm
    assert (made.evaluation[near, 5:-5] > 0).all()
    assert (made.score[near, 5:-5] > 1).all()
    assert (made.evaluation[N // 2 - 4, 5:-5] < 0).all()
    assert (made.evaluation[N // 2 + 3, 5:-5] < 0).all()


@pytest.mark.parametrize(("degrees", "accessible"), [(0, True), (30, True), (43, True), (47, False), (70, False)])
@pytest.mark.parametrize("heading", [0.0, 0.6, math.pi / 4])
def test_normals_up_to_45_degrees_are_accessible(degrees: float, accessible: bool, heading: float) -> None:
    i, j = np.mgrid[:N, :N] * 0.01
    F = of(math.tan(math.radians(degrees)) * (i * math.cos(heading) + j * math.sin(heading))).evaluation
    assert ((F[5:-5, 5:-5] < 0) == accessible).all()


def test_depth_limit_is_relative_to_body_height() -> None:
    z = np.zeros((N, N))
    z[:, 24:] = -0.2
    for body, deep in ((0.04, False), (0.06, True), (0.10, True)):
        F = of(z, body=body).evaluation
        assert (F[5:-5, 10] < 0).all()
        assert ((F[5:-5, 35] > 0) == deep).all()


def test_unknown_cells_are_footholds_in_neither_layer() -> None:
    rng = np.random.default_rng(5)
    z = rng.normal(0.0, 0.0005, (N, N))
    z[rng.random(z.shape) < 0.03] = np.nan
    z[:, 40:] = np.nan
    made = of(z)
    unknown = np.isnan(z)
    assert (made.evaluation[unknown] == UNKNOWN).all()
    assert (made.evaluation[~unknown] != UNKNOWN).all()
    assert (made.evaluation[:, 38:] > 0).all()
    assert (made.evaluation[4:-4, 4:34][~unknown[4:-4, 4:34]] < 0).mean() > 0.95  # specks are bridged


# ---- margin


def edge_distance(layer: NDArray[np.bool_]) -> float:
    """Return the distance [m] from the middle step to a column's nearest foothold."""
    rows = np.flatnonzero(layer[:, N // 2])
    return float(np.abs(rows - N // 2 + 0.5).min()) * 0.01


@pytest.mark.parametrize("foot", [0.005, 0.01, 0.02, 0.035])
@pytest.mark.parametrize("sigma", [0.0, 0.002, 0.005, 0.01])
def test_footholds_keep_margin_from_edges_in_both_layers(foot: float, sigma: float) -> None:
    z = np.zeros((N, N))
    z[N // 2 :] = 0.03
    made = of(z, sigma, foot_radius=foot)
    for layer in (made.score <= 1, made.evaluation < 0):
        kept = edge_distance(layer)
        assert kept >= foot + 2 * sigma - 0.005  # a foot aimed at a cell may land on the cell's border
        assert kept <= max(0.025, foot + 2 * sigma + 0.011)  # and the margin is not larger than necessary


def test_uncertain_ground_widens_margin_locally() -> None:
    z = np.zeros((N, N), dtype=np.float32)
    z[N // 2 :] = 0.03
    variance = np.full_like(z, 1e-6)
    variance[:, N // 2 :] = 0.012**2
    made = layers().update(z, variance, ORIGIN)
    for layer in (made.score <= 1, made.evaluation < 0):
        sure, unsure = np.flatnonzero(layer[: N // 2, 12]).max(), np.flatnonzero(layer[: N // 2, 36]).max()
        assert unsure < sure
    assert made.score[10, 36] <= 1  # far from edges nothing is lost


def test_small_pose_uncertainty_changes_nothing() -> None:
    z = np.random.default_rng(3).normal(0.0, 0.001, (N, N))
    z[20:30, 20:30] += 0.03
    sure, doubtful = of(z), of(z, sigma=0.003)
    np.testing.assert_array_equal(sure.score, doubtful.score)
    np.testing.assert_array_equal(sure.evaluation, doubtful.evaluation)


def test_more_pose_uncertainty_never_adds_foothold() -> None:
    rng = np.random.default_rng(8)
    z = np.kron(rng.choice([0.0, 0.03], (6, 6)), np.ones((8, 8)))
    made = [of(z, sigma=s) for s in (0.0, 0.008, 0.012, 0.02, 0.2)]
    for less, more in pairwise(made):
        assert ((less.score <= 1) | ~(more.score <= 1)).all()
        assert (less.evaluation <= more.evaluation).all()


# ---- Lotriet's form


@pytest.mark.parametrize("resolution", [0.005, 0.01, 0.02])
def test_large_pose_uncertainty_leaves_no_foothold_in_either_layer(resolution: float) -> None:
    z = np.zeros((N, N), dtype=np.float32)
    maker = FootholdLayers((N, N), resolution, None, WEIGHTS)
    made = maker.update(z, np.full_like(z, 1e-6), ORIGIN, math.inf, 0.5)
    assert not (made.score <= 1).any()
    assert not (made.evaluation < 0).any()
    sure = maker.update(z, np.full_like(z, 1e-6), ORIGIN, math.inf, 0.001)
    assert (sure.score <= 1).any()
    assert (sure.evaluation < 0).any()


def test_pose_uncertainty_widens_margin_on_ground_steep_for_score_only() -> None:
    """Check ground of 35 deg, which only Masri's map accepts, next to unknown ground.

    It is too steep for Lotriet's score.
    """
    z = 0.7 * 0.01 * np.arange(N)[:, None] * np.ones(N)
    z[:, N // 2 :] = np.nan
    assert not (of(z).score <= 1).any()
    good = [int((of(z, sigma).evaluation[N // 2] < 0).sum()) for sigma in (0.0, 0.01, 0.02, 0.5)]
    assert good[0] > good[1] > good[2] > good[3] == 0


def test_score_without_roughness_matches_published_score() -> None:
    """Check that slope and proximity equal the thesis's on known ground.

    The comparison fixes two of the constants.
    """
    rng = np.random.default_rng(2)
    z = np.kron(rng.choice([0.0, 0.02, 0.05], (6, 6)), np.ones((8, 8))).astype(np.float32)
    weights = ScoreParams(roughness=0.0)
    ours = FootholdLayers((N, N), 0.01, None, weights).update(z, np.zeros_like(z), ORIGIN).score
    n = 5
    theirs = published_score(z, weights.slope / (8 * 0.01), weights.proximity * n**2, n, 1.5)
    inner = (slice(n, -n), slice(n, -n))
    np.testing.assert_allclose(ours[inner], theirs[inner], rtol=1e-3, atol=1e-4)
    assert np.isnan(theirs[:2]).all()


def test_invalid_arguments_are_refused() -> None:
    z = np.zeros((N, N), dtype=np.float32)
    with pytest.raises(ValueError, match="maps"):
        layers().update(z[:-1], z, ORIGIN)
    with pytest.raises(ValueError, match="position_sigma"):
        layers().update(z, z, ORIGIN, 0.1, math.nan)
    with pytest.raises(ValueError, match="infinite"):
        layers().update(np.where(np.eye(N) > 0, np.float32(np.inf), z), z, ORIGIN)
    with pytest.raises(ValueError, match="foot radius"):
        Margin(foot_radius=0.0)
    with pytest.raises(ValueError, match="odd kernel"):
        published_score(z, 1.0, 1.0, kernel=4)
