"""Foothold map of Masri: closing, signed Manhattan distance, and excluded cells."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.mapper.footholds.foothold_map import (
    EvaluationFunction,
    FootholdMapParams,
    closed,
    disc,
    holes,
    published_evaluation,
    signed_manhattan,
)
from sextant.shared.wire.messages import UNKNOWN

Mask = NDArray[np.uint8]


@st.composite
def masks(draw: st.DrawFn, most: int = 24) -> Mask:
    """Draw a mask of random blocks and specks, from nearly empty to nearly full."""
    shape = draw(st.tuples(st.integers(1, most), st.integers(1, most)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    mask = (rng.random(shape) < draw(st.sampled_from([0.0, 0.02, 0.5, 0.98, 1.0]))).astype(np.uint8)
    for _ in range(draw(st.integers(0, 4))):
        i, j = rng.integers(0, shape[0]), rng.integers(0, shape[1])
        mask[i : i + rng.integers(1, 9), j : j + rng.integers(1, 9)] = rng.integers(0, 2)
    return mask


def brute_force(mask: Mask, bound: int, reach: int) -> NDArray[np.int64]:
    """Compute (4.8) over every pair of cells, with a ring of zeros around the map."""
    padded = np.pad(mask, 1)
    i, j = np.nonzero(padded == 0)
    k, m = np.nonzero(padded == 1)
    out = np.full(mask.shape, reach, dtype=np.int64)
    for a, b in np.ndindex(*mask.shape):
        if mask[a, b]:
            out[a, b] = -min(bound, (abs(i - a - 1) + abs(j - b - 1)).min())
        elif len(k):
            out[a, b] = min(reach, (abs(k - a - 1) + abs(m - b - 1)).min())
    return out


# ---- distance


@given(masks(), st.integers(1, 30), st.integers(1, 30))
@settings(deadline=None, max_examples=60)
def test_signed_distance_matches_brute_force(mask: Mask, bound: int, reach: int) -> None:
    np.testing.assert_array_equal(signed_manhattan(mask, bound, reach), brute_force(mask, bound, reach))


@given(masks())
@settings(deadline=None, max_examples=30)
def test_signed_distance_matches_opencv_inside_ground(mask: Mask) -> None:
    inside = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L1, 3)[1:-1, 1:-1]
    np.testing.assert_array_equal(np.minimum(signed_manhattan(mask, 126, 126), 0), -inside)


@given(masks())
@settings(deadline=None, max_examples=40)
def test_signed_distance_sign_and_neighbour_difference(mask: Mask) -> None:
    F = signed_manhattan(mask, 126, 126).astype(int)
    np.testing.assert_array_equal(F < 0, mask == 1)
    assert (F != 0).all()
    if mask.any():
        # From -1 to 1 is one step; other neighbours differ by at most one. So greedy descent never skips a value.
        rank = np.where(F > 0, F - 1, F)
        for axis in (0, 1):
            assert (np.abs(np.diff(rank, axis=axis)) <= 1).all()


@given(masks(), st.integers(0, 2**32))
@settings(deadline=None, max_examples=40)
def test_added_ground_never_raises_signed_distance(mask: Mask, seed: int) -> None:
    more = mask | (np.random.default_rng(seed).random(mask.shape) < 0.1)
    assert (signed_manhattan(more.astype(np.uint8), 5, 15) <= signed_manhattan(mask, 5, 15)).all()


@given(masks(), st.integers(1, 9))
@settings(deadline=None, max_examples=30)
def test_bound_only_clips_signed_distance(mask: Mask, bound: int) -> None:
    np.testing.assert_array_equal(signed_manhattan(mask, bound, 126), np.maximum(signed_manhattan(mask, 126, 126), -bound))


# ---- closing


def closing_by_definition(mask: Mask, half: int) -> Mask:
    """Compute (4.5)-(4.7) by unions and intersections of translated masks.

    The plane is empty outside the map.
    """
    k = 2 * half
    wide = np.pad(mask, 2 * k).astype(bool)
    steps = [(i, j) for i in range(-half, half + 1) for j in range(-half, half + 1)]
    dilated = np.logical_or.reduce([np.roll(wide, s, (0, 1)) for s in steps])
    eroded = np.logical_and.reduce([np.roll(dilated, s, (0, 1)) for s in steps])
    return eroded[2 * k : 2 * k + mask.shape[0], 2 * k : 2 * k + mask.shape[1]].astype(np.uint8)


@given(masks(), st.integers(1, 3), st.integers(0, 2**32))
@settings(deadline=None, max_examples=40)
def test_closing_matches_definition_and_is_idempotent_and_monotonic(mask: Mask, half: int, seed: int) -> None:
    once = closed(mask, half)
    np.testing.assert_array_equal(once, closing_by_definition(mask, half))
    assert (once >= mask).all()  # it only adds cells
    np.testing.assert_array_equal(closed(once, half), once)  # it is idempotent
    more = mask | (np.random.default_rng(seed).random(mask.shape) < 0.1)
    assert (closed(more.astype(np.uint8), half) >= once).all()  # it is monotonic


@pytest.mark.parametrize(("gap", "bridged"), [(1, True), (4, True), (5, False), (8, False)])
def test_closing_bridges_gaps_below_5_cm(gap: int, bridged: bool) -> None:
    mask = np.ones((30, 30), dtype=np.uint8)
    mask[10 : 10 + gap] = 0
    assert closed(mask, 2)[12, 15] == bridged or gap < 3
    assert closed(mask, 2)[10, 15] == bridged


# ---- evaluation function


def evaluate(accessible: Mask, refused: Mask | None = None, known: Mask | None = None, rules: FootholdMapParams | None = None):
    nothing = np.zeros_like(accessible)
    all_known = np.ones_like(accessible)
    return EvaluationFunction(0.01, rules).evaluate(
        accessible, nothing if refused is None else refused, all_known if known is None else known
    )


@given(masks(), masks())
@settings(deadline=None, max_examples=60)
def test_unknown_and_refused_cells_are_not_footholds(a: Mask, b: Mask) -> None:
    n, m = min(len(a), len(b)), min(a.shape[1], b.shape[1])
    known, refused = a[:n, :m], b[:n, :m] & a[:n, :m]
    F = evaluate(known & ~refused & 1, refused, known)
    np.testing.assert_array_equal(F == UNKNOWN, known == 0)
    assert (F[refused == 1] > 0).all()


def test_evaluation_matches_thesis_without_refused_or_vacant_cells() -> None:
    rules = FootholdMapParams(unknown_clearance=0.0)
    mask = np.zeros((40, 40), dtype=np.uint8)
    mask[5:20, 5:30] = 1
    mask[12, 9:13] = 0  # a hole, which is closed
    F = evaluate(mask, rules=rules)
    np.testing.assert_array_equal(F, published_evaluation(mask, 2, 5, 15))
    assert F[12, 10] == -5


@pytest.mark.parametrize("width", [1, 2, 4])
def test_crack_between_blocks_is_not_bridged_unlike_in_thesis(width: int) -> None:
    known = np.zeros((40, 40), dtype=np.uint8)
    known[5:35, 10:30] = 1
    known[20 : 20 + width] = 0
    known[22, 15:18] = 1  # specks in the air between the blocks
    assert published_evaluation(known, 2, 5, 15)[20 + width // 2, 20] < 0 or width < 3
    F = evaluate(known, None, known)
    assert (F[18:20, 10:30] > 0).all()  # the clearance from the vacant crack
    assert (F[20 + width : 22 + width, 10:30] > 0).all()
    assert (F[20 : 20 + width] > 0).all()
    assert F[14, 20] == -4


@given(masks(), st.integers(1, 4))
@settings(deadline=None, max_examples=60)
def test_hole_is_narrow_and_enclosed_by_ground(mask: Mask, widest: int) -> None:
    found = holes(mask, widest)
    assert not (found & mask).any()
    padded = np.pad(mask | found, 1)
    shifts = [
        np.roll(padded, s, (0, 1))[1:-1, 1:-1] for s in [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)]
    ]
    assert np.logical_and.reduce(shifts)[found == 1].all()  # ground or the same hole on all sides
    for run in (found, found.T):
        lengths = [len(part) for row in run for part in "".join(map(str, row)).split("0")]
        assert max(lengths, default=0) <= widest
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask ^ 1)
    for label, (j, i, columns, rows, _) in enumerate(stats.tolist()):
        within = min(i, j) > 0 and i + rows < mask.shape[0] and j + columns < mask.shape[1] and max(rows, columns) <= widest
        assert label == 0 or (found[labels == label] == within).all(), "all holes, and nothing else"


def test_refused_edge_is_not_restored_by_closing_unlike_in_thesis() -> None:
    refused = np.zeros((40, 40), dtype=np.uint8)
    refused[20:22] = 1  # both sides of a step
    mask = np.asarray(1 - refused, dtype=np.uint8)
    assert (published_evaluation(mask, 2, 5, 15)[20:22, 10] < 0).all()
    assert (evaluate(mask, refused)[20:22, 10] == 1).all()


def test_vacant_region_needs_clearance_but_single_vacant_cell_does_not() -> None:
    known = np.ones((40, 40), dtype=np.uint8)
    known[10, 10] = 0
    known[20:30, 20:30] = 0
    F = evaluate(known, None, known)
    assert F[10, 11] == -5
    assert F[10, 10] == UNKNOWN
    i, j = np.mgrid[:40, :40]
    away = np.hypot(np.maximum(np.maximum(20 - i, i - 29), 0), np.maximum(np.maximum(20 - j, j - 29), 0))
    region = known == 0
    np.testing.assert_array_equal((F > 0)[2:-2, 2:-2], ((away <= 2) | region)[2:-2, 2:-2])


def test_thesis_parameters_scale_with_resolution() -> None:
    """Check that the thesis's numbers scale with the resolution.

    The bound of -5 cm is -5 cells of 1 cm and -10 cells of 5 mm. The square of the closing scales in the same way.
    """
    for resolution, bound, half in ((0.01, 5, 2), (0.005, 10, 4), (0.02, 2, 1)):
        e = EvaluationFunction(resolution)
        n = round(0.6 / resolution)
        ground = np.ones((n, n), dtype=np.uint8)
        assert e.evaluate(ground, 0 * ground, ground).min() == -bound == -e.bound
        ground[n // 2 : n // 2 + 2 * half, n // 2 : n // 2 + 2 * half] = 0
        assert e.evaluate(ground, 0 * ground, np.ones_like(ground))[n // 2, n // 2] == -bound
        ground[n // 2 : n // 2 + 2 * half + 1, n // 2 : n // 2 + 2 * half] = 0
        assert e.evaluate(ground, 0 * ground, np.ones_like(ground))[n // 2, n // 2] > 0


@given(masks(), st.integers(1, 3))
@settings(deadline=None, max_examples=30)
def test_margin_requires_disc_of_ground_around_each_foothold(mask: Mask, cells: int) -> None:
    rules = FootholdMapParams(unknown_clearance=0.0, closing=0.0)
    level = np.full(mask.shape, cells, dtype=np.uint8)
    known = np.ones_like(mask)
    F = EvaluationFunction(0.01, rules).evaluate(mask, 1 - mask, known, level)
    padded = np.pad(mask, cells)
    around = [padded[cells + i : cells + i + len(mask), cells + j : cells + j + mask.shape[1]] for i, j in offsets(cells)]
    np.testing.assert_array_equal(F < 0, np.logical_and.reduce(around))


def offsets(radius: int) -> list[tuple[int, int]]:
    return [(int(i), int(j)) for i, j in np.argwhere(disc(radius, least=0)) - radius]


def test_invalid_rules_are_refused() -> None:
    with pytest.raises(ValueError, match="bound"):
        FootholdMapParams(bound=0.0)
    with pytest.raises(ValueError, match="slope_limit"):
        FootholdMapParams(slope_limit=2.0)
    with pytest.raises(ValueError, match="closing"):
        FootholdMapParams(closing=-0.01)
    with pytest.raises(ValueError, match="resolution"):
        EvaluationFunction(0.0)
    with pytest.raises(ValueError, match="126 cells"):
        EvaluationFunction(0.0002)
