"""The support margin against an independent computation."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse
from sextant.shared.robot.profiles import load_profile, profile_names
from sextant.shared.robot.stability import centre_of_mass, resting_centre_of_mass, support_margin

SQUARE = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])


def reference(feet: Array, centre: Array) -> float:
    """Return the least distance to a supporting line over all directions.

    The support function is sampled finely.
    """
    angles = np.linspace(0.0, 2 * np.pi, 7200, endpoint=False)
    outward = np.stack([np.cos(angles), np.sin(angles)])
    return float(((feet - centre) @ outward).max(axis=0).min())


@pytest.mark.parametrize(("centre", "margin"), [((0, 0), 1.0), ((0.5, 0), 0.5), ((1, 0), 0.0), ((1.5, 0.2), -0.5)])
def test_margin_of_square_support(centre: tuple[float, float], margin: float) -> None:
    assert support_margin(SQUARE, np.array(centre)) == pytest.approx(margin)


@given(st.integers(0, 2**32 - 1), st.integers(3, 6))
@settings(max_examples=60)
def test_margin_inside_is_distance_to_hull(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    feet = rng.uniform(-0.3, 0.3, (n, 2))
    centre = rng.dirichlet(np.ones(n)) @ feet
    assert support_margin(feet, centre) == pytest.approx(reference(feet, centre), abs=3e-4)
    assert support_margin(feet, centre) >= -1e-9


@given(st.integers(0, 2**32 - 1), st.integers(3, 6))
@settings(max_examples=60)
def test_margin_outside_is_negative_and_bounded_by_hull_distance(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    feet = rng.uniform(-0.3, 0.3, (n, 2))
    angle = rng.uniform(0.0, 2 * np.pi)
    outward = np.array([np.cos(angle), np.sin(angle)])
    centre = feet[np.argmax(feet @ outward)] + outward * rng.uniform(0.01, 0.5)
    margin = support_margin(feet, centre)
    assert margin < 0
    assert margin >= reference(feet, centre) - 3e-4


@given(st.integers(0, 2**32 - 1), st.floats(-3, 3), st.permutations(range(5)))
@settings(max_examples=40)
def test_margin_does_not_depend_on_frame_or_order(seed: int, angle: float, order: list[int]) -> None:
    rng = np.random.default_rng(seed)
    feet, centre, shift = rng.uniform(-0.3, 0.3, (5, 2)), rng.uniform(-0.2, 0.2, 2), rng.uniform(-5, 5, 2)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    there = support_margin(feet[order] @ R.T + shift, R @ centre + shift)
    assert there == pytest.approx(support_margin(feet, centre), abs=1e-6)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40)
def test_additional_foot_never_reduces_margin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    feet = rng.uniform(-0.3, 0.3, (6, 2))
    centre = rng.dirichlet(np.ones(5)) @ feet[:5]
    assert support_margin(feet, centre) >= support_margin(feet[:5], centre) - 1e-9


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 0, 2]])
@pytest.mark.parametrize("aside", [0.1, -0.1, 0.5, -0.5])
def test_collinear_feet_give_no_support(order: list[int], aside: float) -> None:
    line = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])[order]
    assert support_margin(line, np.array([1.0, 0.0])) <= 1e-9
    assert support_margin(line, np.array([1.0, aside])) == pytest.approx(-abs(aside))


def test_coincident_feet_give_no_support() -> None:
    assert support_margin(np.zeros((3, 2)), np.array([0.3, 0.4])) == pytest.approx(-0.5)


def test_two_feet_are_refused() -> None:
    with pytest.raises(ValueError, match="at least three standing feet expected, found 2"):
        support_margin(SQUARE[:2], np.zeros(2))


@pytest.mark.parametrize("name", profile_names())
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.05, -0.03, 0.02)])
def test_center_of_mass_at_rest_matches_support_tests(name: str, place: tuple[float, float, float]) -> None:
    profile = load_profile(name)
    profile = replace(profile, body=replace(profile.body, centre_of_mass=place))
    true = centre_of_mass(profile, body_inverse(profile, profile.rest_feet()))
    np.testing.assert_allclose(resting_centre_of_mass(profile)[:2], true[:2], atol=1e-3)
