"""Metrics of a walk from recorded truth, with synthetic feet."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.evaluation.metrics.walk_metrics import (
    angle_between,
    debounced,
    in_the_way,
    is_foothold,
    rubbing,
    runs,
    slip_per_step,
    stability_margin,
    touchdowns,
)
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Box, Hole, Plane, Slope


def walked_into(height_at, feet, bodies, radius, size):
    return len(runs(in_the_way(height_at, feet, bodies, radius, size).any(axis=1)))


def test_collisions_are_counted_and_steps_are_not():
    profile = load_profile("phantomx_mk2")
    feet = profile.rest_feet() + np.array([0.0, 0.0, profile.stance.body_height])

    def times(terrain, x):
        ground = build_terrain(Scenario("s", terrain, Goal(1.0)), np.random.default_rng(0))
        T = np.array([from_xyz_rpy((at, 0.0, profile.stance.body_height), np.zeros(3)) for at in x])
        moved = feet + T[:, None, :3, 3] * [1.0, 1.0, 0.0]
        return walked_into(ground.height_at, moved, T, profile.foot.radius, profile.body.size)

    reach = feet[:, 0].max() + profile.foot.radius
    there_and_back = [0.0, 0.5, 0.5 - reach + 0.002, 0.5 - reach - 0.01, 0.0, 0.5 - reach + 0.002, 0.0]
    assert times((Plane(), Box((1.0, 0.0), (1.0, 2.0), 0.3)), there_and_back) == 2
    assert times((Plane(), Box((1.0, 0.0), (1.0, 2.0), 0.05)), there_and_back) == 0
    assert times((Plane(), Box((0.2, 0.0), (0.1, 0.1), 0.2)), [0.0, 0.1, 0.5]) == 1, "the body goes no higher than it is"
    hanging = feet - [[0.0, 0.0, 0.1]] + 0.1 * (np.arange(6) > 0)[:, None] * [0.0, 0.0, 1.0]
    body = from_xyz_rpy((0.0, 0.0, profile.stance.body_height), np.zeros(3))
    ground = build_terrain(Scenario("h", (Plane(), Hole((0.22, 0.16), (0.1, 0.1), 0.3)), Goal(1.0)), np.random.default_rng(0))
    assert walked_into(ground.height_at, hanging[None], body[None], profile.foot.radius, profile.body.size) == 1
    assert walked_into(ground.height_at, feet[None], body[None], profile.foot.radius, profile.body.size) == 0
    below = build_terrain(Scenario("b", (Plane(height=-0.1),), Goal(1.0)), np.random.default_rng(0))
    assert walked_into(below.height_at, hanging[None], body[None], profile.foot.radius, profile.body.size) == 0, "it stands"


def test_foot_on_a_low_pillar_does_not_hang_next_to_its_edge():
    profile = load_profile("phantomx_mk2")
    feet = profile.rest_feet() + np.array([0.0, 0.0, profile.stance.body_height])
    feet[0, 2] -= 0.1
    x, y = feet[0, :2]
    body = from_xyz_rpy((0.0, 0.0, profile.stance.body_height), np.zeros(3))

    def hangs(off):
        gap, pillar = Hole((x, y), (0.2, 0.2), 0.4), Box((x + off, y), (0.1, 0.1), -0.1, depth=0.3)
        ground = build_terrain(Scenario("p", (Plane(), gap, pillar), Goal(1.0)), np.random.default_rng(0))
        return walked_into(ground.height_at, feet[None], body[None], profile.foot.radius, profile.body.size) > 0

    assert not hangs(0.0)
    assert not hangs(0.048), "its edge is 2 mm from the middle of the foot"
    assert hangs(0.06), "it is next to the pillar"


def test_runs_and_debounce():
    flags = np.array([1, 1, 0, 1, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1], dtype=bool)
    np.testing.assert_array_equal(runs(flags), [[0, 2], [3, 6], [10, 11], [14, 17]])
    clean = debounced(flags[:, None], 2)[:, 0]
    np.testing.assert_array_equal(runs(clean), [[0, 6], [14, 17]])


def test_brushed_edge_and_dragged_foot_are_no_touchdowns():
    swing = np.zeros((100, 1), dtype=bool)
    swing[20:50] = True
    contact = ~swing
    contact[30:34] = True  # brushes an edge
    np.testing.assert_array_equal(touchdowns(contact, swing), [[50, 0]])
    early = contact.copy()
    early[45:50] = True  # lands early, on a block
    np.testing.assert_array_equal(touchdowns(early, swing), [[45, 0]])
    assert len(touchdowns(np.ones_like(contact), swing)) == 0


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 6))
def test_stability_margin_is_distance_to_support_polygon(seed, count):
    rng = np.random.default_rng(seed)
    feet = rng.uniform(-0.2, 0.2, (1, 6, 2))
    carrying = np.zeros((1, 6), dtype=bool)
    carrying[0, rng.permutation(6)[:count]] = True
    body = rng.uniform(-0.2, 0.2, (1, 2))
    # The support function: the hull in direction u ends at the highest foot.
    angle = np.linspace(0.0, 2 * np.pi, 20001)
    u = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    support = (feet[0, carrying[0]] @ u.T).max(axis=0) - u @ body[0]
    margin = stability_margin(feet, carrying, body)[0]
    assert np.sign(margin) == np.sign(support.min()) or abs(margin) < 1e-4
    if margin > 0:
        assert margin == pytest.approx(support.min(), abs=1e-4)


def test_stability_margin_with_fewer_than_three_feet():
    feet = np.zeros((3, 6, 2))
    feet[:, 0], feet[:, 1] = (1.0, 0.0), (1.0, 1.0)
    carrying = np.zeros((3, 6), dtype=bool)
    carrying[0, :2] = True
    carrying[1, 0] = True
    margin = stability_margin(feet, carrying, np.zeros((3, 2)))
    np.testing.assert_allclose(margin, [-1.0, -1.0, np.nan])


def test_slip_counts_only_while_planted():
    feet = np.zeros((20, 6, 2))
    feet[:, 0, 0] = np.arange(20) * 0.001
    planted = np.zeros((20, 6), dtype=bool)
    planted[5:15, 0] = True
    step = np.repeat([1, 2], 10)
    np.testing.assert_allclose(slip_per_step(feet, planted, step), [0.004, 0.004])
    assert len(slip_per_step(feet[:1], planted[:1], step[:1])) == 0


def test_sliding_foot_slips_and_rolling_foot_does_not():
    """Count only motion beyond that of a rolling wheel as slip.

    A wheel without slip moves by its radius times its rotation.
    """
    radius, n = 0.01, 200
    angle = np.linspace(0.3, -0.4, n)  # of the tibia off the vertical, as the body passes over the foot
    for heading in (0.0, 2.0):
        ahead = np.array([np.cos(heading), np.sin(heading)])
        shanks = np.column_stack([np.sin(angle)[:, None] * ahead, np.cos(angle)])[:, None]
        rolled = radius * (angle - angle[0])[:, None] * ahead
        slid = np.linspace(0.0, 0.003, n)[:, None] * [1.0, 0.0]
        for slide in (np.zeros((n, 2)), slid):
            np.testing.assert_allclose(rubbing((rolled + slide)[:, None], shanks, radius)[:, 0], slide, atol=1e-6)


def test_edges_and_steep_ground_are_no_footholds():
    ground = (Plane(), Box(xy=(1.0, 0.0), size=(0.4, 0.4), top=0.03), Box(xy=(2.0, 0.0), size=(0.4, 0.4), top=0.007))
    terrain = build_terrain(Scenario("edges", ground, Goal(1.0)), np.random.default_rng(0))
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [0.805, 0.0], [0.795, 0.0], [0.78, 0.0], [0.82, 0.0], [1.805, 0.0]])
    np.testing.assert_array_equal(is_foothold(terrain.height_at, xy), [True, True, False, False, True, True, True])
    for angle, carries in ((30.0, True), (34.0, True), (36.0, False), (45.0, False)):
        slope = Scenario("slope", (Slope(xy=(0.0, 0.0), angle_deg=angle, length=1.0, width=1.0),), Goal(1.0))
        height_at = build_terrain(slope, np.random.default_rng(0)).height_at
        assert bool(is_foothold(height_at, np.array([[0.5, 0.0]]))[0]) is carries
        assert not is_foothold(height_at, np.array([[0.5, 5.0]]))[0]  # an abyss


def test_angles_between_verticals():
    a = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    b = np.array([[0.0, np.sin(1e-6), np.cos(1e-6)], [-1.0, 0.0, 0.0]])
    np.testing.assert_allclose(angle_between(a, b), [1e-6, np.pi], rtol=1e-9)
