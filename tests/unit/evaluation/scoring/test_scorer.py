import re
from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation import report as reports
from sextant.evaluation.trace.status_log import complaints, last_reason
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Box, Plane, Stairs
from sextant.shared.wire.messages import TerrainMap

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


@pytest.mark.slow
def test_result_does_not_depend_on_start_heading(story):
    straight, turned = (story(heading_deg=h).judged().result() for h in (0.0, 180.0))
    a, b = reports.as_table(straight), reports.as_table(turned)
    for key in ("success", "steps", "touchdowns", "missteps", "tilt_deg", "slip_m_per_step"):
        assert a[key] == b[key], key
    assert b["pose_error_m"]["rms"] < 1e-6
    assert b["map_error_m"]["rmse"] < 1e-6
    assert b["distance_m"] == pytest.approx(a["distance_m"])


@pytest.mark.slow
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
def test_injected_errors_are_measured(story, wrong, read, expected):
    assert read(story(**wrong).judged().result()) == pytest.approx(expected, rel=0.03)


def test_body_oscillation_and_foot_slip_are_measured(story):
    result = story(bob=0.005, slip=0.003).judged().result()
    assert 0.009 < result.body_height_oscillation_m <= 0.010
    assert result.slip_m_per_step.p50 == pytest.approx(0.003, rel=0.1)
    # The RMS over the stance of a sine of that amplitude.
    assert result.body_height_error_m.rms == pytest.approx(0.005 / np.sqrt(2), rel=0.1)


def test_map_coverage_is_known_share_of_strip_ahead(story):
    assert story().judged().result().map_error_m.coverage == pytest.approx(1.0)


def test_course_map_metrics_match_benchmark_definition(story):
    high = Scenario("high", (Plane(), Box(xy=(0.905, 0.005), size=(0.3, 0.4), top=0.05)), Goal(0.2))
    course = story(scenario=high).judged().result().course_map_m
    assert 0.8 < course.coverage < 1.0  # the synthetic maps end 0.6 m to the side; the camera sees further
    assert course.rmse < 1e-6
    assert course.edge <= 0.006  # edges are right to within a cell


@pytest.mark.slow
@pytest.mark.parametrize(
    "odd", [{"resolution": 0.0}, {"resolution": -0.01}, {"resolution": 1e-9}, {"origin": np.full(2, 1e200)}]
)
def test_invalid_map_is_ignored(story, odd):
    scorer = story().judged()
    before = scorer.result()
    n = np.zeros((4, 4), np.float32)
    flags, depth = np.zeros((4, 4), np.bool_), np.zeros((4, 4), np.int8)
    terrain = TerrainMap(0, 0.01, np.zeros(2), n, n, n, flags, depth)
    scorer._look_at(replace(terrain, **odd))
    assert reports.as_table(scorer.result()) == reports.as_table(before)


@pytest.mark.slow
def test_topple_and_sinking_are_falls_even_after_goal(story):
    toppled = story(topple_s=4.0).judged()
    assert toppled.finished
    assert toppled.result().falls == 1
    assert not toppled.result().success
    assert "tilted" in toppled.result().reason
    sunk = story(sink_s=4.0).judged()
    assert sunk.result().falls == 1
    assert "touched the ground" in sunk.result().reason
    # A robot that lies down has not fallen; the reason is its own.
    lying = story(sink_s=4.0, sit="the battery is low: 9.8 V").judged().result()
    assert (lying.falls, lying.success) == (0, False)
    assert "lay down at " in lying.reason
    assert lying.reason.endswith("the battery is low: 9.8 V")
    # A fall after the goal is a fall too.
    late = story(topple_s=6.4).judged().result()
    assert (late.falls, late.success) == (1, False)


def test_servo_shutdown_ends_run_and_names_servo(story):
    scorer = story(shutdown_s=3.0).judged()
    result = scorer.result()
    assert scorer.finished
    assert not result.success
    assert (result.shutdowns, result.falls) == (1, 0)
    assert "right middle femur" in result.reason


@pytest.mark.slow
def test_time_limit_uses_message_stamps(story):
    limited = Scenario("slow", (Plane(),), Goal(0.5), time_limit_s=5.0)
    scorer = story(scenario=limited).judged()
    assert scorer.finished
    assert not scorer.result().success
    assert "time limit of 5 s" in scorer.result().reason
    assert scorer.result().duration_s == pytest.approx(4.0, abs=0.02)


def test_time_limit_reason_includes_last_planner_reason(story):
    limited = Scenario("slow", (Plane(),), Goal(0.5), time_limit_s=6.0)
    words = "no foothold for the left front leg"
    reason = story(scenario=limited, beyond=-0.2, refusal=words, tail_s=5.0).judged().result().reason
    assert re.fullmatch(rf"planner, 4 to 6 s: {words}; time limit of 6 s, 0\.\d\d of 0\.50 m done", reason)


def test_last_reason_is_one_that_still_held_in_the_end(story):
    words = "no foothold for the left front leg"
    heard = story(beyond=-0.2, refusal=words, tail_s=5.0).judged()._heard
    (complaint,) = (one for one in complaints(heard) if one.who == "planner")
    assert last_reason(heard, complaint.end - 0.1) == f"planner, {complaint.begin:.0f} to {complaint.end:.0f} s: {words}"
    assert last_reason(heard, complaint.end + 0.1) == ""


def test_stop_before_goal_fails_with_given_reason(story):
    scorer = story(beyond=-0.2).judged()
    assert not scorer.finished
    result = scorer.result(reason="the planner has been blocked for 20 s")
    assert not result.success
    assert "blocked for 20 s" in result.reason
    assert f"{scorer.trace.p_true[-1, 0]:.2f} of 0.50 m" in result.reason


def test_goal_counts_once_all_waypoints_are_passed(story):
    def route(*waypoints: tuple[float, float]) -> Scenario:
        return Scenario("route", (Plane(),), Goal(0.5, route=True, waypoints=waypoints))

    passed = story(scenario=route((0.2, 0.1), (0.4, 0.0))).judged().result()
    straight = story(scenario=Scenario("route", (Plane(),), Goal(0.5, route=True))).judged().result()
    assert passed.success
    assert passed.distance_m == pytest.approx(straight.distance_m, abs=0.01)
    assert passed.speed_mps == pytest.approx(straight.speed_mps, rel=0.03)
    scorer = story(scenario=route((0.2, 0.0), (0.4, 1.0))).judged()
    assert not scorer.finished
    assert scorer.result().reason == "stopped at 1 of 2 waypoints"


REFUSED = Scenario("refused", (Plane(),), Goal(0.5, route=True, expect="refusal"))


@pytest.mark.slow
def test_expected_refusal_with_reason_is_success(story):
    scorer = story(scenario=REFUSED, beyond=-0.2, refusal="a wall", tail_s=14.0).judged()
    assert scorer.finished
    assert scorer.result().success
    assert scorer.result().reason == "stood and reported why: a wall"


@pytest.mark.slow
@pytest.mark.parametrize(
    "otherwise",
    [
        {"refusal": ""},  # it stood and gave no reason
        {"tail_s": 3.0},  # it stood only briefly
        {"beyond": 0.06},  # it walked past the goal nevertheless
        {"topple_s": 8.0},
        {"shutdown_s": 3.0},
        {"scenario": replace(REFUSED, goal=Goal(0.5, route=True))},
    ],
)
def test_refusal_without_reason_or_unexpected_is_failure(story, otherwise):
    wrong = {"scenario": REFUSED, "beyond": -0.2, "refusal": "a wall", "tail_s": 14.0} | otherwise
    assert not story(**wrong).judged().result().success


def test_collision_on_route_is_failure(story):
    reach = float(load_profile("phantomx_mk2").rest_feet()[:, 1].max())
    wall = (Plane(), Box(xy=(0.52, reach + 0.1), size=(0.1, 0.2), top=0.3))
    result = story(scenario=Scenario("wall", wall, Goal(0.5, route=True))).judged().result()
    assert not result.success
    assert result.collisions > 0
    assert result.reason == f"hit obstacles {result.collisions} times"


def test_touchdowns_on_blocks_and_stairs_are_counted(story):
    scorer = story(scenario=STEPS).judged()
    result = scorer.result()
    assert result.raised_touchdowns > result.raised_block_touchdowns > 0
    downs = scorer.trace.touchdowns
    on_stairs = downs.p[:, 0] > 0.9
    assert result.raised_touchdowns - result.raised_block_touchdowns == np.count_nonzero(on_stairs)
    assert np.all(downs.raised[on_stairs])


def test_flickering_contact_is_not_counted_as_touchdown(story):
    calm, flickering = (story(flicker=f).judged().result() for f in (False, True))
    assert flickering.touchdowns == calm.touchdowns
    assert flickering.min_stability_margin_m == pytest.approx(calm.min_stability_margin_m)


def test_footholds_moved_by_planner_are_detected(story):
    scorer = story(moved_leg=2).judged()
    downs = scorer.trace.touchdowns
    np.testing.assert_array_equal(downs.moved, downs.leg == 2)


@pytest.mark.slow
def test_same_messages_give_same_report(story):
    first, second = story(scenario=STEPS).judged().result(), story(scenario=STEPS).judge().result()
    assert reports.to_json(first) == reports.to_json(second)
    assert reports.check(reports.as_table(first)) == []


@pytest.mark.parametrize("other", [{"scenario": "another"}, {"seed": 8}, {"robot": "lotriet_rx64"}])
def test_mismatched_simulator_ends_run_and_is_named(story, other):
    told = story()
    scorer = told.scorer()
    list(scorer.step(replace(told.truth(0), **other), Inbox([scorer.trigger, *scorer.subscribes], scorer.stages)))
    assert scorer.finished
    assert not scorer.result().success
    assert str(*other.values()) in scorer.result().reason
    assert "start another" in scorer.result().reason


def test_no_messages_is_failure_with_reason(story):
    scorer = story().scorer()
    result = scorer.result()
    assert not result.success
    assert "simulator" in result.reason
    assert len(scorer.trace.t) == len(scorer.trace.touchdowns.t) == 0
