from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy import report as reports
from deploy.walk_metrics import (
    angle_between,
    debounced,
    is_foothold,
    rubbing,
    runs,
    slip_per_step,
    stability_margin,
    touchdowns,
    walked_into,
)
from services.simulator.terrain import build_terrain
from shared.geometry import from_xyz_rpy
from shared.messages import TerrainMap
from shared.robot import load_profile
from shared.scenario import Box, Goal, Hole, Plane, Scenario, Slope, Stairs

STEPS = Scenario(
    "blocks",
    (
        Plane(),
        Box(xy=(0.5, 0.25), size=(0.3, 0.3), top=0.03),
        Box(xy=(0.5, -0.25), size=(0.3, 0.3), top=0.02),
        Stairs(xy=(0.9, 0.0), riser=0.03, tread=0.3, count=2, width=1.5),
    ),
    Goal(1.2),
)


def test_a_perfect_walk_has_no_errors(story):
    scorer = story().judged()
    result = scorer.result()
    assert scorer.finished
    assert result.success
    assert result.reason == scorer.reason == "goal reached"
    assert result.falls == result.missteps == result.raised_touchdowns == result.shutdowns == 0
    zeros = (
        result.tilt_deg.max,
        result.commanded_tilt_deg.max,
        result.body_height_error_m.mean,
        result.body_height_error_m.rms,
        result.body_height_oscillation_m,
        result.slip_m_per_step.p95,
        result.pose_error_m.rms,
        result.pose_error_m.final,
        result.map_error_m.rmse,
        result.map_error_m.bias,
        result.course_map_m.rmse,
        result.course_map_m.off_edges,
        result.course_map_m.bias,
    )
    np.testing.assert_allclose(zeros, 0.0, atol=1e-6)
    assert result.steps == 10
    assert result.touchdowns == 10 * 3
    assert result.speed_mps == pytest.approx(0.1, rel=0.01)
    assert result.duration_s == pytest.approx(5.0, abs=0.02)
    assert result.distance_m == pytest.approx(0.6, abs=1e-6)
    assert result.torque_nm.max == pytest.approx(0.6)
    assert result.torque_nm.rms_worst_joint == pytest.approx(0.6)
    assert result.min_stability_margin_m > 0.01


def test_the_heading_of_the_start_changes_nothing_but_the_course(story):
    straight, turned = (story(heading_deg=h).judged().result() for h in (0.0, 180.0))
    a, b = reports.as_table(straight), reports.as_table(turned)
    for key in ("success", "steps", "touchdowns", "missteps", "tilt_deg", "slip_m_per_step"):
        assert a[key] == b[key], key
    assert b["pose_error_m"]["rms"] < 1e-6
    assert b["map_error_m"]["rmse"] < 1e-6
    assert b["distance_m"] == pytest.approx(a["distance_m"])


@pytest.mark.parametrize(
    ("wrong", "read", "expected"),
    [
        ({"tilt_deg": 2.0}, lambda r: r.tilt_deg.p95, 2.0),
        ({"sag": 0.006}, lambda r: r.body_height_error_m.mean, -0.006),
        ({"sag": 0.006}, lambda r: r.body_height_error_m.rms, 0.006),
        ({"drift": 0.01}, lambda r: r.pose_error_m.final, 0.006),
        ({"map_bias": 0.004}, lambda r: r.map_error_m.bias, 0.004),
        ({"map_bias": -0.004}, lambda r: r.map_error_m.p95, 0.004),
        ({"map_bias": -0.004}, lambda r: r.course_map_m.bias, -0.004),
        ({"map_bias": 0.004}, lambda r: r.course_map_m.off_edges, 0.004),
    ],
)
def test_what_is_wrong_is_measured(story, wrong, read, expected):
    assert read(story(**wrong).judged().result()) == pytest.approx(expected, rel=0.03)


def test_bobbing_and_slipping_show(story):
    result = story(bob=0.005, slip=0.003).judged().result()
    assert 0.009 < result.body_height_oscillation_m <= 0.010
    assert result.slip_m_per_step.p50 == pytest.approx(0.003, rel=0.1)
    # The stance rms of a sine of that amplitude.
    assert result.body_height_error_m.rms == pytest.approx(0.005 / np.sqrt(2), rel=0.1)


def test_coverage_is_the_known_share_of_the_strip_ahead(story):
    assert story().judged().result().map_error_m.coverage == pytest.approx(1.0)


def test_the_map_of_the_course_is_judged_as_in_the_bench(story):
    high = Scenario("high", (Plane(), Box(xy=(0.905, 0.005), size=(0.3, 0.4), top=0.05)), Goal(0.2))
    course = story(scenario=high).judged().result().course_map_m
    assert 0.8 < course.coverage < 1.0  # the story's maps end 0.6 m aside, the camera sees further
    assert course.rmse < 1e-6
    assert course.edge <= 0.006  # where they are, but for the cell


@pytest.mark.parametrize(
    "odd", [{"resolution": 0.0}, {"resolution": -0.01}, {"resolution": 1e-9}, {"origin": np.full(2, 1e200)}]
)
def test_a_map_that_makes_no_sense_does_not_end_the_judging(story, odd):
    scorer = story().judged()
    before = scorer.result()
    n = np.zeros((4, 4), np.float32)
    flags, depth = np.zeros((4, 4), np.bool_), np.zeros((4, 4), np.int8)
    terrain = TerrainMap(0, 0.01, np.zeros(2), n, n, n, flags, depth)
    scorer._look_at(replace(terrain, **odd))
    assert reports.as_table(scorer.result()) == reports.as_table(before)


def test_a_fall_is_a_fall(story):
    toppled = story(topple_s=4.0).judged()
    assert toppled.finished
    assert toppled.result().falls == 1
    assert not toppled.result().success
    assert "tilted" in toppled.result().reason
    sunk = story(sink_s=4.0).judged()
    assert sunk.result().falls == 1
    assert "touched the ground" in sunk.result().reason
    # A fall after the goal is a fall too.
    late = story(topple_s=6.4).judged().result()
    assert (late.falls, late.success) == (1, False)


def test_a_servo_that_shut_down_is_named_and_ends_the_run(story):
    scorer = story(shutdown_s=3.0).judged()
    result = scorer.result()
    assert scorer.finished
    assert not result.success
    assert (result.shutdowns, result.falls) == (1, 0)
    assert "right middle femur" in result.reason


def test_the_time_limit_counts_by_the_stamps(story):
    limited = Scenario("slow", (Plane(),), Goal(0.5), time_limit_s=5.0)
    scorer = story(scenario=limited).judged()
    assert scorer.finished
    assert not scorer.result().success
    assert "time limit of 5 s" in scorer.result().reason
    assert scorer.result().duration_s == pytest.approx(4.0, abs=0.02)


def test_a_stop_before_the_goal_is_no_success_and_the_reason_given_is_kept(story):
    scorer = story(beyond=-0.2).judged()
    assert not scorer.finished
    result = scorer.result(reason="the planner has been blocked for 20 s")
    assert not result.success
    assert "blocked for 20 s" in result.reason
    assert f"{scorer.trace.p_true[-1, 0]:.2f} of 0.50 m" in result.reason


REFUSED = Scenario("refused", (Plane(),), Goal(0.5, route=True, expect="refusal"))


def test_a_refusal_with_its_reason_is_a_success_where_it_is_right(story):
    scorer = story(scenario=REFUSED, beyond=-0.2, refusal="a wall", tail_s=14.0).judged()
    assert scorer.finished
    assert scorer.result().success
    assert scorer.result().reason == "stood and said why: a wall"


@pytest.mark.parametrize(
    "otherwise",
    [
        {"refusal": ""},  # it stood and did not say why
        {"tail_s": 3.0},  # it has hardly stood yet
        {"beyond": 0.06},  # it went there all the same
        {"topple_s": 8.0},
        {"shutdown_s": 3.0},
        {"scenario": replace(REFUSED, goal=Goal(0.5, route=True))},
    ],
)
def test_a_refusal_is_none_without_its_reason_or_where_it_is_wrong(story, otherwise):
    wrong = {"scenario": REFUSED, "beyond": -0.2, "refusal": "a wall", "tail_s": 14.0} | otherwise
    assert not story(**wrong).judged().result().success


def test_on_a_route_it_is_no_success_to_walk_into_something(story):
    reach = float(load_profile("phantomx_mk2").rest_feet()[:, 1].max())
    wall = (Plane(), Box(xy=(0.52, reach + 0.1), size=(0.1, 0.2), top=0.3))
    result = story(scenario=Scenario("wall", wall, Goal(0.5, route=True))).judged().result()
    assert not result.success
    assert result.collisions > 0
    assert result.reason == f"walked into something {result.collisions} times"


def test_what_is_walked_into_is_counted_and_a_step_is_not():
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


def test_touchdowns_on_blocks_and_stairs_are_counted(story):
    scorer = story(scenario=STEPS).judged()
    result = scorer.result()
    assert result.raised_touchdowns > result.raised_block_touchdowns > 0
    downs = scorer.trace.touchdowns
    on_stairs = downs.p[:, 0] > 0.9
    assert result.raised_touchdowns - result.raised_block_touchdowns == np.count_nonzero(on_stairs)
    assert np.all(downs.raised[on_stairs])


def test_contact_that_flickers_is_no_touchdown(story):
    calm, flickering = (story(flicker=f).judged().result() for f in (False, True))
    assert flickering.touchdowns == calm.touchdowns
    assert flickering.min_stability_margin_m == pytest.approx(calm.min_stability_margin_m)


def test_moved_footholds_are_found(story):
    scorer = story(moved_leg=2).judged()
    downs = scorer.trace.touchdowns
    np.testing.assert_array_equal(downs.moved, downs.leg == 2)


def test_one_story_makes_one_report(story):
    first, second = story(scenario=STEPS).judged().result(), story(scenario=STEPS).judge().result()
    assert reports.to_json(first) == reports.to_json(second)
    assert reports.check(reports.as_table(first)) == []


def test_nothing_heard_is_a_failure_with_a_reason(story):
    scorer = story().scorer()
    result = scorer.result()
    assert not result.success
    assert "simulator" in result.reason
    assert len(scorer.trace.t) == len(scorer.trace.touchdowns.t) == 0


def test_runs_and_debounce():
    flags = np.array([1, 1, 0, 1, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1], dtype=bool)
    np.testing.assert_array_equal(runs(flags), [[0, 2], [3, 6], [10, 11], [14, 17]])
    clean = debounced(flags[:, None], 2)[:, 0]
    np.testing.assert_array_equal(runs(clean), [[0, 6], [14, 17]])


def test_a_touch_on_the_way_and_a_foot_that_drags_are_no_touchdowns():
    swing = np.zeros((100, 1), dtype=bool)
    swing[20:50] = True
    contact = ~swing
    contact[30:34] = True  # brushes an edge
    np.testing.assert_array_equal(touchdowns(contact, swing), [[50, 0]])
    early = contact.copy()
    early[45:50] = True  # lands before its time, on a block
    np.testing.assert_array_equal(touchdowns(early, swing), [[45, 0]])
    assert len(touchdowns(np.ones_like(contact), swing)) == 0


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 6))
def test_stability_margin_is_the_least_distance_to_the_hull(seed, count):
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


def test_stability_margin_of_few_feet():
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


def test_a_foot_that_rolls_does_not_rub_and_one_that_slides_does():
    """A wheel without slip moves by its radius times its turn; whatever it moves more than that is slip."""
    radius, n = 0.01, 200
    angle = np.linspace(0.3, -0.4, n)  # of the shank off the vertical, as the body passes over the foot
    for heading in (0.0, 2.0):
        ahead = np.array([np.cos(heading), np.sin(heading)])
        shanks = np.column_stack([np.sin(angle)[:, None] * ahead, np.cos(angle)])[:, None]
        rolled = radius * (angle - angle[0])[:, None] * ahead
        slid = np.linspace(0.0, 0.003, n)[:, None] * [1.0, 0.0]
        for slide in (np.zeros((n, 2)), slid):
            np.testing.assert_allclose(rubbing((rolled + slide)[:, None], shanks, radius)[:, 0], slide, atol=1e-6)


def test_footholds_end_at_edges_and_steep_ground():
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
