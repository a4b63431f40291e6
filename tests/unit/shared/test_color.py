import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sextant.shared.color import NO_COLOR, codes, from_codes, rgb_from_ycocg, ycocg_from_rgb

PICTURES = arrays(np.uint8, st.tuples(st.integers(1, 30), st.just(3)))


@given(PICTURES)
def test_colors_survive_round_trip(rgb: np.ndarray) -> None:
    np.testing.assert_array_equal(rgb_from_ycocg(ycocg_from_rgb(rgb)), rgb)


@given(PICTURES)
def test_codes_are_exact_to_half_a_step(rgb: np.ndarray) -> None:
    color = ycocg_from_rgb(rgb)
    back = from_codes(codes(color))
    # Half a step, except at the ends: the darkest luma code means no colour, and the purest orange has no code.
    assert np.all(np.abs(back - color) <= np.where(np.abs(color) > 240, 7.0, 4.0))
    np.testing.assert_array_equal(codes(back), codes(color))


def test_missing_color_stays_missing() -> None:
    color = np.array([[np.nan, 0.0, 0.0], [100.0, 0.0, np.nan], [100.0, 0.0, 0.0]], dtype=np.float32)
    code = codes(color)
    np.testing.assert_array_equal(code[:, 0] == NO_COLOR, [True, True, False])
    np.testing.assert_array_equal(np.isnan(from_codes(code)).all(axis=1), [True, True, False])


def test_grey_has_zero_chroma_and_blue_opposes_orange() -> None:
    y, co, cg = ycocg_from_rgb(np.array([[90, 90, 90], [60, 80, 140]], dtype=np.uint8)).T
    np.testing.assert_array_equal([y[0], co[0], cg[0]], [90, 0, 0])
    assert co[1] == -80
    assert cg[1] == -20
