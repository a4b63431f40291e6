"""Standing up: from wherever the feet are to rest, without a leap, the load taken up only as the body rises."""

import numpy as np
import pytest

from services.actuator.stand_up import StandUp
from shared.geometry import Array
from shared.robot import load_profile

PROFILE = load_profile("phantomx_mk2")
REST = PROFILE.rest_feet()
FOLDED = PROFILE.rest_feet(0.02) * [0.7, 0.7, 1.0]
DURATION = 2.5


def stand_up(feet: Array, dt: float = 0.02) -> tuple[Array, Array]:
    """Feet (n, 6, 3) and shares (n, 6) until it is done."""
    act, targets = StandUp(PROFILE, feet, DURATION), []
    while not act.done:
        targets.append(act.update(dt))
    return np.array([t.feet for t in targets]), np.array([t.share for t in targets])


STARTS = [FOLDED, REST + np.array([0.01, -0.01, 0.005]), REST * [1.2, 1.2, 0.5]]


@pytest.mark.parametrize("feet", STARTS)
def test_it_ends_at_rest_under_full_load(feet: Array) -> None:
    way, shares = stand_up(feet)
    np.testing.assert_allclose(way[-1], REST, atol=1e-12)
    np.testing.assert_array_equal(shares[-1], np.ones(6))


@pytest.mark.parametrize("feet", STARTS)
@pytest.mark.parametrize("dt", [0.02, 0.013])
def test_it_begins_where_the_feet_are_and_never_leaps(feet: Array, dt: float) -> None:
    way, shares = stand_up(feet, dt)
    steps = np.linalg.norm(np.diff(np.concatenate([feet[None], way]), axis=0), axis=2)
    whole = np.linalg.norm(feet - REST, axis=1).max() + 0.1
    assert steps.max() <= 4.0 * whole * dt / DURATION
    jumps = np.diff(np.concatenate([np.zeros((1, 6)), shares]), axis=0)  # the goals it starts from hold the sag already
    assert np.abs(jumps).max() <= 4.0 * dt / DURATION


def test_a_lying_robot_places_its_feet_before_it_pushes() -> None:
    way, shares = stand_up(FOLDED)
    placing = shares[:, 0] == 0.0
    assert placing.any()
    # While nothing is carried the feet stay over the ground on which the belly lies.
    ground = -PROFILE.body.size[2] / 2
    assert (way[placing][-1][:, 2] - PROFILE.foot.radius > ground - 1e-9).all()
    # While it rises the feet go straight down in the body's frame: they do not scrape.
    rising = way[~placing]
    np.testing.assert_allclose(rising[..., :2], np.broadcast_to(REST[:, :2], rising[..., :2].shape), atol=1e-3)


def test_a_standing_robot_does_not_lie_down_first() -> None:
    way, _ = stand_up(REST + np.array([0.0, 0.01, 0.01]))
    assert way[..., 2].max() <= REST[0, 2] + 0.01 + 1e-12
