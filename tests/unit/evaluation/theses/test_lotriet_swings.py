"""Lotriet's flow function as published: his paths arrive, and its parameters do what his text says."""

import numpy as np
import pytest

from sextant.evaluation.theses.lotriet_swings import our_path, published_path, sigmoid

START, TARGET = (0.0, 0.0), (150.0, 0.0)


def test_sigmoid_goes_from_minus_one_to_zero() -> None:
    y = np.linspace(-200.0, 200.0, 400)
    values = sigmoid(y, 14.0)
    assert (np.diff(values) > 0).all()
    assert values[0] == pytest.approx(-1.0, abs=0.03)
    assert values[-1] == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("rise", [-50.0, 0.0, 50.0])
def test_published_path_arrives(rise: float) -> None:
    path = published_path(START, (150.0, rise), 2.0, 20.0)
    np.testing.assert_allclose(path[-1], (150.0, rise))
    assert np.linalg.norm(path[-1] - path[-2]) < 5.0
    assert (np.diff(path[:, 0]) > 0).all()


def test_step_height_parameter_of_section_8_1_gives_his_step_height() -> None:
    """He set Ch = 2.0, q = 14.0 and a stride of 15 cm, and measured steps of roughly 10 cm."""
    top = published_path(START, TARGET, 2.0, 14.0)[:, 1].max()
    assert 90.0 < top < 160.0


def test_q_lengthens_the_vertical_rise_and_ch_raises_the_step() -> None:
    def height_after(ahead: float, v_h: float, q: float) -> float:
        path = published_path(START, TARGET, v_h, q)
        return float(path[np.argmax(path[:, 0] >= ahead), 1])

    assert height_after(2.0, 2.0, 40.0) > height_after(2.0, 2.0, 20.0) > height_after(2.0, 2.0, 0.0)
    low, high = (published_path(START, TARGET, v_h, 0.0)[:, 1].max() for v_h in (1.0, 2.0))
    assert high > 1.5 * low


def test_q_has_almost_no_effect_on_a_lowered_target() -> None:
    tops = [published_path(START, (150.0, -50.0), 2.0, q)[:, 1].max() for q in (0.0, 40.0)]
    assert abs(tops[0] - tops[1]) < 0.1 * tops[0]


def test_our_path_reaches_the_newest_target() -> None:
    path = our_path(START, [TARGET, (190.0, 20.0)], 100.0)
    np.testing.assert_allclose(path[0], START, atol=1e-9)
    np.testing.assert_allclose(path[-1], (190.0, 20.0), atol=1e-6)
