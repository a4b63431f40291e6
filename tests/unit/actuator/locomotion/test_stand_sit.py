"""Standing up and lying down.

The feet move from any position to rest without a jump. The legs take up load only as the body rises.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.services.actuator.locomotion.stand_sit import LieDown, StandUp, ground_relief
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profiles import load_profile

PROFILE = load_profile("phantomx_mk2")
REST = PROFILE.rest_feet()
OUT = np.column_stack([PROFILE.T_body_coxa[:, :2, 0], np.zeros(6)])
FOLDED = PROFILE.rest_feet(0.02) + 0.05 * OUT
DURATION = 2.5
ALL = np.ones(6, dtype=np.bool_)
NONE = np.zeros(6, dtype=bool)


def stand_up(feet: Array, dt: float = 0.02) -> tuple[Array, Array]:
    """Return feet (n, 6, 3) and load shares (n, 6) until the motion is done."""
    act, targets = StandUp(PROFILE, feet, DURATION), []
    while not act.done:
        targets.append(act.update(dt))
    return np.array([t.feet for t in targets]), np.array([t.share for t in targets])


STARTS = [FOLDED, REST + np.array([0.01, -0.01, 0.005]), REST * [1.2, 1.2, 0.4]]


@pytest.mark.parametrize("feet", STARTS)
def test_stand_up_ends_at_rest_height_with_full_load(feet: Array) -> None:
    way, shares = stand_up(feet)
    np.testing.assert_allclose(way[-1][:, 2], REST[:, 2], atol=1e-12)
    np.testing.assert_array_equal(shares[-1], np.ones(6))
    # The feet end in the resting stance, or only as far outside it as needed to reach both the lying and standing place.
    further = ((way[-1] - REST) * OUT).sum(axis=1)
    np.testing.assert_allclose(way[-1] - REST, further[:, None] * OUT, atol=1e-12)
    assert within_limits(PROFILE, body_inverse(PROFILE, way[-1])).all()
    if np.abs(feet - REST).max() < 0.03:
        np.testing.assert_allclose(further, 0.0, atol=1e-12)
    for leg in np.flatnonzero(further > 0.006):
        nearer = way[-1] - 0.006 * OUT
        nearer[:, 2] = PROFILE.foot.radius - PROFILE.body.size[2] / 2 + 0.005
        assert not within_limits(PROFILE, body_inverse(PROFILE, nearer))[leg].all()


@pytest.mark.parametrize("feet", STARTS)
@pytest.mark.parametrize("dt", [0.02, 0.013])
def test_stand_up_starts_at_current_feet_without_jumps(feet: Array, dt: float) -> None:
    way, shares = stand_up(feet, dt)
    steps = np.linalg.norm(np.diff(np.concatenate([feet[None], way]), axis=0), axis=2)
    whole = np.linalg.norm(feet - REST, axis=1).max() + 0.1
    assert steps.max() <= 4.0 * whole * dt / DURATION
    jumps = np.diff(np.concatenate([np.zeros((1, 6)), shares]), axis=0)  # the initial goals already include the sag
    assert np.abs(jumps).max() <= 4.0 * dt / DURATION


def test_lying_robot_places_its_feet_before_loading_them() -> None:
    way, shares = stand_up(FOLDED)
    placing = shares[:, 0] == 0.0
    assert placing.any()
    # While the legs carry nothing, the feet stay above the ground on which the belly lies.
    ground = -PROFILE.body.size[2] / 2
    assert (way[placing][-1][:, 2] - PROFILE.foot.radius > ground - 1e-9).all()
    # While the body rises, the feet go straight down in {body}: they do not scrape.
    rising = way[~placing]
    np.testing.assert_allclose(rising[..., :2], np.broadcast_to(way[-1][:, :2], rising[..., :2].shape), atol=1e-3)
    assert within_limits(PROFILE, np.array([body_inverse(PROFILE, feet) for feet in rising])).all()


def test_stand_up_of_standing_robot_does_not_lower_the_body() -> None:
    way, _ = stand_up(REST + np.array([0.0, 0.01, 0.01]))
    assert way[..., 2].max() <= REST[0, 2] + 0.01 + 1e-12


def over_plane(feet: Array) -> Array:
    """Return heights (6,) [m] of feet over the plane through all six."""
    rows = np.column_stack([feet[:, :2], np.ones(6)])
    return np.asarray(feet[:, 2] - rows @ np.linalg.lstsq(rows, feet[:, 2])[0])


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_stand_up_on_uneven_ground_keeps_heights_of_carrying_feet(tilt: float) -> None:
    feet = REST + np.outer(REST[:, 0] * tilt, [0.0, 0.0, 1.0])
    feet[0, 2] += 0.03  # on a block
    act = StandUp(PROFILE, feet, DURATION, ground_relief(feet, ALL, NONE))
    ends = act.update(DURATION).feet
    np.testing.assert_allclose(over_plane(ends), over_plane(feet), atol=1e-3)
    rows = np.column_stack([ends[:, :2], np.ones(6)])
    np.testing.assert_allclose(np.linalg.lstsq(rows, ends[:, 2])[0], [0.0, 0.0, REST[0, 2]], atol=3e-3)  # the body is level


def test_stand_up_lowers_hanging_foot_and_levels_small_differences() -> None:
    hanging, sagging = REST.copy(), REST.copy()
    hanging[0, 2] += 0.03
    sagging[0, 2] += 0.003
    for feet, carrying in ((hanging, np.arange(6) > 0), (sagging, ALL)):
        ends = StandUp(PROFILE, feet, DURATION, ground_relief(feet, carrying, NONE)).update(DURATION).feet
        np.testing.assert_allclose(ends, REST, atol=1e-12)


@pytest.mark.parametrize("height", [0.03, -0.05], ids=["on a block", "in a hole"])
def test_foot_that_was_set_down_keeps_its_height_and_does_not_move_the_others(height: float) -> None:
    feet = REST.copy()
    feet[0, 2] += height
    ends = StandUp(PROFILE, feet, DURATION, ground_relief(feet, np.arange(6) > 0, ALL)).update(DURATION).feet
    np.testing.assert_allclose(ends[1:] - ends[1], REST[1:] - REST[1], atol=1e-3)
    assert ends[0, 2] - ends[1, 2] == pytest.approx(height, abs=1e-3)


# ------------------------------------------------------------------------------------------------------------ lying down

GROUND = PROFILE.foot.radius - PROFILE.body.size[2] / 2  # [m] {body} height of feet on the ground on which the belly lies
RISEN = stand_up(FOLDED)[0][-1]
TILTED = RISEN + np.array([0.0, 0.0, 0.01]) * np.sign(REST[:, 1:2])
STANCES = [REST, RISEN, RISEN + 0.02 * OUT, PROFILE.rest_feet(0.14), TILTED, REST + np.array([0.02, 0.01, 0.0])]


def lie_down(feet: Array, dt: float = 0.02) -> tuple[Array, Array]:
    """Return feet (n, 6, 3) and load shares (n, 6) until the motion is done."""
    act, targets = LieDown(PROFILE, feet, DURATION), []
    while not act.done:
        targets.append(act.update(dt))
        np.testing.assert_array_equal(targets[-1].R_level_body, np.eye(3))
    return np.array([t.feet for t in targets]), np.array([t.share for t in targets])


@given(st.integers(0, 1 << 32), st.floats(0.06, 0.12))
def test_stand_up_after_aborted_step_keeps_feet_positions(seed: int, height: float) -> None:
    """Check that the robot rises over feet that a broken-off step left far from rest.

    If all feet moved to rest at once, the body would drop.
    """
    feet = PROFILE.rest_feet(height)
    feet[:, :2] += np.random.default_rng(seed).uniform(-0.05, 0.05, (6, 2))
    way, _ = stand_up(feet)
    off = np.abs(feet - REST).max() >= 0.03
    if off:
        np.testing.assert_allclose(way[:, :, :2], np.broadcast_to(feet[:, :2], way[:, :, :2].shape), atol=1e-12)
    low, high = np.minimum(feet[:, 2], REST[:, 2]), np.maximum(feet[:, 2], REST[:, 2])
    assert ((way[..., 2] >= low - 1e-9) & (way[..., 2] <= high + 1e-9)).all(), "the belly does not come down"
    np.testing.assert_allclose(way[-1][:, 2], REST[:, 2])


def test_feet_hanging_far_from_rest_are_moved_to_rest() -> None:
    dangling = REST + np.array([0.0, 0.0, -0.03]) - 0.1 * OUT
    assert np.linalg.norm((stand_up(dangling)[0][-1] - REST)[:, :2], axis=1).max() < 0.05


@pytest.mark.parametrize("feet", STANCES)
def test_lie_down_ends_on_belly_with_unloaded_legs(feet: Array) -> None:
    way, shares = lie_down(feet)
    assert np.median(way[-1][:, 2]) == pytest.approx(GROUND, abs=1e-3)
    np.testing.assert_allclose(way[-1][:, 2] - feet[:, 2], GROUND - np.median(feet[:, 2]), atol=1e-3)
    np.testing.assert_array_equal(shares[-1], np.zeros(6))
    assert (np.diff(shares, axis=0) <= 0.0).all()
    assert within_limits(PROFILE, np.array([body_inverse(PROFILE, feet) for feet in way])).all()


@pytest.mark.parametrize("feet", STANCES)
def test_lie_down_slides_feet_only_if_out_of_reach(feet: Array) -> None:
    way, _ = lie_down(feet)
    below = feet.copy()
    below[:, 2] = way[-1][:, 2]
    reached = within_limits(PROFILE, body_inverse(PROFILE, below)).all(axis=1)
    slid = way[-1][:, :2] - feet[:, :2]
    np.testing.assert_allclose(slid[reached], 0.0, atol=1e-6)
    further = (slid * OUT[:, :2]).sum(axis=1)
    np.testing.assert_allclose(slid, further[:, None] * OUT[:, :2], atol=1e-9)
    assert ((further >= 0.0) & (further < 0.08)).all()
    for leg in np.flatnonzero(~reached):
        nearer = way[-1] - 0.006 * OUT
        assert not within_limits(PROFILE, body_inverse(PROFILE, nearer))[leg].all(), "and no further than it must"


def test_lie_down_after_stand_up_moves_feet_vertically() -> None:
    way, _ = lie_down(RISEN)
    np.testing.assert_allclose(way[..., :2], np.broadcast_to(RISEN[:, :2], way[..., :2].shape), atol=1e-6)
    assert within_limits(PROFILE, np.array([body_inverse(PROFILE, feet) for feet in way])).all()


@pytest.mark.parametrize("feet", STANCES)
@pytest.mark.parametrize("dt", [0.02, 0.013])
def test_lie_down_starts_at_current_feet_without_jumps(feet: Array, dt: float) -> None:
    way, shares = lie_down(feet, dt)
    steps = np.linalg.norm(np.diff(np.concatenate([feet[None], way]), axis=0), axis=2)
    whole = np.linalg.norm(way[-1] - feet, axis=1).max()
    assert steps.max() <= 1.6 * whole * dt / DURATION
    assert np.abs(np.diff(np.concatenate([np.ones((1, 6)), shares]), axis=0)).max() <= 1.6 * dt / DURATION
    assert len(way) == int(np.ceil(DURATION / dt - 1e-9))


def test_lie_down_of_lying_robot_moves_nothing() -> None:
    lying = stand_up(FOLDED)[0]
    lying = lying[np.abs(lying[..., 2] - GROUND).max(axis=1).argmin()]
    lying[:, 2] += GROUND - np.median(lying[:, 2]) + 1e-3
    way, _ = lie_down(lying)
    np.testing.assert_allclose(way, np.broadcast_to(lying, way.shape), atol=2e-3)
