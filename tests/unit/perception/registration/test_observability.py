"""Names of unobservable directions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.perception.registration.observability import AXES, unobservable_directions


@pytest.mark.parametrize(
    ("twists", "names"),
    [
        (np.zeros((0, 6)), ()),
        (np.eye(6)[[5, 0, 1]], ("x", "y", "yaw")),
        (np.eye(6), AXES),
        (np.array([[1.0, 1.0, 0.0, 0.0, 0.0, 0.0]]) / np.sqrt(2.0), ("x+y",)),
        (np.array([[1.0, -1.0, 0.0, 0.0, 0.0, 0.0]]) / np.sqrt(2.0), ("x-y",)),
        (np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [0.7, 0.0, 0.0, 0.0, 0.0, 0.7]]), ("z", "x+yaw")),
        (np.array([[0.95, 0.3, 0.0, 0.0, 0.0, 0.0]]), ("x",)),
    ],
)
def test_unobservable_directions_are_named_by_axes(twists: np.ndarray, names: tuple[str, ...]) -> None:
    assert unobservable_directions(twists) == names


@given(st.integers(0, 6), st.integers(0, 2**32 - 1))
def test_one_name_per_independent_direction(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    twists = basis[:count]
    names = unobservable_directions(twists)
    assert len(names) == count
    assert len(unobservable_directions(np.vstack([twists, rng.normal(size=(2, count)) @ twists]))) == count, "not independent"
