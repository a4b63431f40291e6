"""Swing trajectory: its shape, and that it arrives however the target moves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.locomotion.swing_trajectory import Swing
from sextant.shared.geometry import Array

WILD = settings(max_examples=30)
CYCLES = 30
LENGTHS = (0.03, 0.06, 0.10, 0.15)
RISES = (-0.04, -0.02, 0.0, 0.02, 0.04)

lengths = st.floats(0.03, 0.16)
rises = st.floats(-0.05, 0.05)
clearances = st.floats(0.02, 0.08)
headings = st.floats(-np.pi, np.pi)
shifts = st.tuples(st.floats(-0.03, 0.03), st.floats(-0.03, 0.03), st.floats(-0.03, 0.03))


def fly(targets: Array, clearance: float, foot: Array | None = None) -> Array:
    """Return the path (n + 1, 3) of one foot for targets (n, 3), one per cycle."""
    start = np.zeros(3) if foot is None else foot
    swing = Swing(start[None], targets[:1], np.array([clearance]))
    way, n = [start], len(targets)
    for k, target in enumerate(targets):
        way.append(swing.update(target[None], k / n, 1 / n)[0].copy())
    return np.array(way)


def fly_to(length: float, rise: float, clearance: float, heading: float = 0.0) -> Array:
    target = np.array([length * np.cos(heading), length * np.sin(heading), rise])
    return fly(np.tile(target, (CYCLES, 1)), clearance)


def steps_of(way: Array) -> Array:
    """Return the distance (n,) [m] that the foot covers in each cycle."""
    return np.asarray(np.linalg.norm(np.diff(way, axis=0), axis=1))


@WILD
@given(st.lists(st.tuples(st.integers(0, CYCLES - 1), shifts), max_size=6), lengths, rises, clearances)
def test_swing_ends_at_moved_target(moves, length, rise, clearance) -> None:  # type: ignore[no-untyped-def]
    targets = np.tile([length, 0.0, rise], (CYCLES, 1))
    for cycle, shift in moves:
        targets[cycle:] += shift
    way = fly(targets, clearance)
    assert np.isfinite(way).all()
    np.testing.assert_array_equal(way[-1], targets[-1])


@WILD
@given(lengths, rises, clearances, headings)
def test_swing_stays_above_straight_line(length: float, rise: float, clearance: float, heading: float) -> None:
    way = fly_to(length, rise, clearance, heading)
    share = np.hypot(way[:, 0], way[:, 1]) / length
    before = share < 0.9
    assert (way[before, 2] >= share[before] * rise - 1e-3).all()


@WILD
@given(lengths, rises, clearances, headings)
def test_swing_is_planar_and_never_moves_backwards(length: float, rise: float, clearance: float, heading: float) -> None:
    way = fly_to(length, rise, clearance, heading)
    aside = way[:, 1] * np.cos(heading) - way[:, 0] * np.sin(heading)
    along = way[:, 0] * np.cos(heading) + way[:, 1] * np.sin(heading)
    np.testing.assert_allclose(aside, 0.0, atol=1e-12)
    assert (np.diff(along) >= -1e-12).all()


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("rise", RISES)
@pytest.mark.parametrize("clearance", [0.03, 0.04, 0.06])
def test_swing_clears_higher_end_by_the_clearance(length: float, rise: float, clearance: float) -> None:
    top = fly_to(length, rise, clearance)[:, 2].max() - max(0.0, rise)
    assert 0.8 * clearance <= top <= 1.35 * clearance


@pytest.mark.parametrize("length", LENGTHS)
def test_swing_rises_before_a_riser(length: float) -> None:
    way = fly_to(length, 0.04, 0.04)
    later = way[:, 0] >= 0.3 * length
    assert (way[later, 2][:-1] > 0.04 - 1e-3).all()
    assert way[np.argmax(later), 2] > 0.04


@pytest.mark.parametrize("length", LENGTHS)
def test_swing_descends_after_a_downward_edge(length: float) -> None:
    way = fly_to(length, -0.04, 0.04)
    assert (way[way[:, 0] < 0.5 * length, 2] >= 0.0).all()


@pytest.mark.parametrize("length", [0.06, 0.10, 0.15, 0.20])
@pytest.mark.parametrize("rise", [-0.04, 0.0, 0.04])
@pytest.mark.parametrize("clearance", [0.025, 0.04])
def test_swing_starts_and_ends_slowly_without_corners(length: float, rise: float, clearance: float) -> None:
    way = fly_to(length, rise, clearance)
    steps = steps_of(way)
    mean = steps.mean()
    assert steps[0] < 0.2 * mean
    assert steps[-1] < 0.45 * mean
    assert steps.max() < 1.8 * mean  # and not much faster than necessary
    changes = np.diff(way, axis=0, n=2)  # a corner at full speed changes the step by more than the mean within a cycle
    assert np.linalg.norm(changes, axis=1).max() < 0.9 * mean


@WILD
@given(shifts, st.integers(1, CYCLES // 2), lengths)
def test_moved_target_causes_no_jump(shift: tuple[float, float, float], cycle: int, length: float) -> None:
    """Check a target that moves by centimetres in the first half of the swing.

    The foot moves faster only by the distance that it has to make up.
    """
    targets = np.tile([length, 0.0, 0.0], (CYCLES, 1))
    still = steps_of(fly(targets, 0.04))
    targets[cycle:] += shift
    moved = steps_of(fly(targets, 0.04))
    farther = float(np.linalg.norm(shift))
    # The remaining path grows by at most a few times the shift (up, along and down again), spread over the remaining time.
    assert moved.max() <= still.max() + 3.0 * 4.0 * farther / (CYCLES - cycle)


def test_feet_move_independently() -> None:
    targets = np.array([[0.1, 0.0, 0.0], [0.05, 0.05, 0.03], [-0.08, 0.02, -0.02]])
    clearance = np.array([0.03, 0.04, 0.05])
    together = Swing(np.zeros((3, 3)), targets, clearance)
    ways = [fly(np.tile(t, (CYCLES, 1)), c) for t, c in zip(targets, clearance, strict=True)]
    for k in range(CYCLES):
        feet = together.update(targets, k / CYCLES, 1 / CYCLES)
        np.testing.assert_allclose(feet, [way[k + 1] for way in ways], atol=1e-12)


@pytest.mark.parametrize("length", [0.0, 1e-4, 0.005])
@pytest.mark.parametrize("rise", RISES)
def test_step_in_place_arrives_without_a_jump(length: float, rise: float) -> None:
    way = fly_to(length, rise, 0.04)
    np.testing.assert_array_equal(way[-1], [length, 0.0, rise])
    assert steps_of(way).max() <= 4.0 * (abs(rise) + length + 2 * 0.04) / CYCLES + 1e-3


@WILD
@given(st.floats(-0.08, 0.0), st.lists(st.tuples(st.integers(0, CYCLES - 1), st.floats(-0.005, 0.005)), max_size=4))
def test_lowering_with_zero_clearance_reaches_moved_ground(drop: float, moves: list[tuple[int, float]]) -> None:
    targets = np.tile([0.0, 0.0, drop], (CYCLES, 1))
    for cycle, shift in moves:
        targets[cycle:, 0] += shift
    way = fly(targets, 0.0)
    assert np.isfinite(way).all()
    np.testing.assert_array_equal(way[-1], targets[-1])
    assert way[:, 2].max() <= 0.01
