"""Sixth-order arc of Erasmus (5.22): its conditions, and a target that moves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial

from sextant.services.actuator.locomotion.sixth_order_arc import SixthOrderArc, arc_coefficients, on_arc
from sextant.shared.geometry import Array

WILD = settings(max_examples=30)
CYCLES = 40

places = st.floats(-0.5, 0.5)
shifts = st.tuples(st.floats(-0.03, 0.03), st.floats(-0.03, 0.03), st.floats(-0.03, 0.03))


def fly(targets: Array, clearance: float = 0.04) -> Array:
    """Return the path (n + 1, 3) of a foot from the origin for targets (n, 3)."""
    start, n = np.zeros(3), len(targets)
    arc = SixthOrderArc(start[None], targets[:1], np.array([clearance]))
    return np.array([start, *(arc.update(aim[None], k / n, 1 / n)[0].copy() for k, aim in enumerate(targets))])


@given(places, places, places, st.floats(0.3, 2.0))
@WILD
def test_coefficients_of_equation_5_22_meet_boundary_conditions(q_i: float, q_m: float, q_f: float, t_f: float) -> None:
    a = arc_coefficients(np.array(q_i), np.array(q_m), np.array(q_f), t_f)
    speed = polynomial.polyder(a)
    for t, q in ((0.0, q_i), (t_f / 2, q_m), (t_f, q_f)):
        assert polynomial.polyval(t, a) == pytest.approx(q, abs=1e-9)
    for t in (0.0, t_f):
        assert polynomial.polyval(t, speed) == pytest.approx(0.0, abs=1e-7)
        assert polynomial.polyval(t, polynomial.polyder(speed)) == pytest.approx(0.0, abs=1e-6)


@given(places, places, places, st.floats(0.0, 1.0))
@WILD
def test_arc_equals_rest_to_rest_quintic_plus_midpoint_term(q_i: float, q_m: float, q_f: float, s: float) -> None:
    """Check that seven conditions determine the polynomial of sixth order."""
    way = q_f - q_i
    q = q_i + way * (10 * s**3 - 15 * s**4 + 6 * s**5) + (q_m - q_i - way / 2) * 64 * s**3 * (1 - s) ** 3
    assert on_arc(np.array(q_i), np.array(q_m), np.array(q_f), s) == pytest.approx(q, abs=1e-9)


@pytest.mark.parametrize("clearance", [0.025, 0.04, 0.08])
def test_arc_peaks_at_midpoint_with_clearance_on_level_ground(clearance: float) -> None:
    way = fly(np.tile([0.1, 0.0, 0.0], (CYCLES, 1)), clearance)
    assert way[:, 2].argmax() == CYCLES // 2
    assert way[CYCLES // 2] == pytest.approx([0.05, 0.0, clearance])


@pytest.mark.parametrize("rise", [-0.04, 0.04])
def test_arc_over_a_step_has_clearance_at_midpoint_and_peaks_uphill(rise: float) -> None:
    way = fly(np.tile([0.1, 0.0, rise], (CYCLES, 1)), 0.04)
    assert way[CYCLES // 2] == pytest.approx([0.05, 0.0, max(rise, 0.0) + 0.04])
    assert (way[:, 2].argmax() > CYCLES // 2) == (rise > 0)
    assert way[:, 2].max() < max(rise, 0.0) + 1.1 * 0.04


def test_arc_does_not_clear_a_riser_early_in_the_swing() -> None:
    """Check a riser of 4 cm in the first quarter of the path: the foot is lower there.

    This is why the arc serves only as a reference.
    """
    way = fly(np.tile([0.1, 0.0, 0.04], (CYCLES, 1)), 0.04)
    assert np.interp(0.015, way[:, 0], way[:, 2]) < 0.04


@WILD
@given(st.lists(st.tuples(st.integers(0, CYCLES - 1), shifts), max_size=6), st.floats(0.03, 0.16), st.floats(-0.05, 0.05))
def test_arc_ends_at_moved_target(moves, length, rise) -> None:  # type: ignore[no-untyped-def]
    targets = np.tile([length, 0.0, rise], (CYCLES, 1))
    for cycle, shift in moves:
        targets[cycle:] += shift
    way = fly(targets)
    assert np.isfinite(way).all()
    np.testing.assert_array_equal(way[-1], targets[-1])


@WILD
@given(shifts, st.integers(1, CYCLES // 2))
def test_moved_target_causes_no_jump_and_no_second_peak(shift: tuple[float, float, float], cycle: int) -> None:
    targets = np.tile([0.1, 0.0, 0.0], (CYCLES, 1))
    still = np.linalg.norm(np.diff(fly(targets), axis=0), axis=1)
    targets[cycle:] += shift
    way = fly(targets)
    farther = float(np.linalg.norm(shift))
    # The arc changes at once. The difference, including height above the higher end, is made up at the arc's own pace.
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() <= still.max() + 12.0 * farther / CYCLES
    turns = np.diff(np.sign(np.diff(way[:, 2])))
    assert (turns < 0).sum() <= 1  # it has one maximum


def test_feet_move_independently() -> None:
    targets, clearance = np.array([[0.1, 0.0, 0.0], [0.05, 0.05, 0.03], [-0.08, 0.02, -0.02]]), np.array([0.03, 0.04, 0.05])
    together = SixthOrderArc(np.zeros((3, 3)), targets, clearance)
    ways = [fly(np.tile(t, (CYCLES, 1)), c) for t, c in zip(targets, clearance, strict=True)]
    for k in range(CYCLES):
        feet = together.update(targets, k / CYCLES, 1 / CYCLES)
        np.testing.assert_allclose(feet, [way[k + 1] for way in ways], atol=1e-12)
