from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sextant.evaluation.scoring.failure_analysis import MISSED, decisive_moment, missed_by, refusal, signs
from sextant.evaluation.trace.status_log import kind_of
from sextant.shared.robot.profile import LEGS
from sextant.shared.wire.messages import Mode


def _decisive_moment(scorer):
    return decisive_moment(scorer.result(), scorer.trace)


def test_successful_or_empty_run_has_no_decisive_moment(story):
    assert _decisive_moment(story(moved_leg=2).judged()) is None
    assert _decisive_moment(story().scorer()) is None


@pytest.mark.slow
@pytest.mark.parametrize("how", ["topple_s", "sink_s", "shutdown_s"])
def test_decisive_moment_has_time_and_place_of_failure(story, how):
    scorer = story(**{how: 4.0}).judged()
    moment, trace = _decisive_moment(scorer), scorer.trace
    assert 4.0 - 0.011 <= moment.t <= trace.t[-1]
    if how == "shutdown_s":
        assert moment.t == pytest.approx(4.0, abs=0.011)
        assert moment.leg == 2
        assert moment.words == "right middle femur shut down"
    else:
        assert moment.words == "fell"
        assert moment.t == trace.t[-1]
    k = int(np.searchsorted(trace.t, moment.t))
    np.testing.assert_allclose(moment.p, trace.p_true[min(k, len(trace.t) - 1), :2], atol=1e-9)


@pytest.mark.slow
def test_recovered_servo_remains_cause_of_failure(story):
    told = story(shutdown_s=4.0)
    healed = type(told)(shutdown_s=4.0, tail_s=1.5)
    whole = healed.truth
    object.__setattr__(healed, "truth", lambda ms: _healed(whole(ms), ms))
    scorer = healed.judge()
    assert scorer.result().reason == "servo shut down: right middle femur"
    assert scorer.result().shutdowns == 1
    assert _decisive_moment(scorer).leg == 2


def _healed(truth, ms):
    return replace(truth, shutdown=np.zeros((6, 3), dtype=bool)) if ms > 4500 else truth


@pytest.mark.slow
def test_refusal_moment_is_end_of_walking(story):
    scorer = story(
        scenario=_scenario_expecting_refusal(), refusal="right rear leg: no foothold within 12 cm", tail_s=12.0, beyond=-0.2
    ).judged()
    moment, trace = _decisive_moment(scorer), scorer.trace
    stood = trace.t[np.flatnonzero(trace.walking)[-1]]
    assert refusal(trace).words.startswith("right rear leg")
    assert moment.words == "stopped"
    assert LEGS[moment.leg] == "right rear"
    assert abs(moment.t - stood) < 0.6


def _scenario_expecting_refusal():
    from tests.unit.evaluation.conftest import FLAT

    return replace(FLAT, goal=replace(FLAT.goal, expect="refusal"))


def test_touchdown_error_is_distance_to_chosen_foothold(story):
    trace = story(moved_leg=2).judged().trace
    assert np.nanmax(missed_by(trace)) < 1e-3
    downs = trace.touchdowns
    shifted = downs.chosen + np.where(np.arange(len(downs.t)) == 4, 0.05, 0.0)[:, None] * [0.6, 0.8, 0.0]
    moved = missed_by(replace(trace, touchdowns=replace(downs, chosen=shifted)))
    assert moved[4] == pytest.approx(0.05, abs=1e-3)
    assert np.nanmax(np.delete(moved, 4)) < MISSED
    lost = replace(trace, t_estimate=trace.t_estimate[:3], p_estimate=trace.p_estimate[:3])
    assert np.isnan(missed_by(lost)[4:]).all(), "the pose of that time is unknown"


def test_precursors_are_ordered_before_failure_and_name_leg(story):
    scorer = story(topple_s=4.0).judged()
    trace, moment = scorer.trace, _decisive_moment(scorer)
    late = int(np.flatnonzero(trace.touchdowns.t < moment.t)[-1])
    mistaken = np.arange(len(trace.touchdowns.t)) == late
    torque = trace.torque.copy()
    pulling = (trace.t > moment.t - 0.5) & (trace.t < moment.t - 0.2)
    torque[pulling, 4, 2] = trace.profile.servo.stall_torque
    trace = replace(trace, touchdowns=replace(trace.touchdowns, misstep=mistaken), torque=torque)
    found = signs(trace, moment)
    assert [sign.t for sign in found] == sorted(sign.t for sign in found)
    assert all(moment.t - 4.0 <= sign.t <= moment.t for sign in found)
    missteps = [sign for sign in found if "carries no foot" in sign.words]
    assert [(sign.t, sign.leg) for sign in missteps] == [(trace.touchdowns.t[late], trace.touchdowns.leg[late])]
    leans = [sign.t for sign in found if "tilted by 10 deg" in sign.words]
    assert leans == pytest.approx([4.0 + np.radians(10.0)], abs=0.02)
    pulls = [sign for sign in found if "highest torque" in sign.words]
    assert [(sign.leg, sign.words) for sign in pulls] == [(4, "left rear tibia at its highest torque for 0.3 s")]
    assert pulls[0].t == pytest.approx(moment.t - 0.5, abs=0.02)


def test_service_that_stops_publishing_is_precursor(story):
    scorer = story(topple_s=4.0).judge()
    scorer._heard.poses = [pose for pose in scorer._heard.poses if pose.stamp_ns < 3_000_000_000]
    scorer._walk = scorer._trace = None
    trace = scorer.trace
    silent = [sign for sign in signs(trace, _decisive_moment(scorer)) if sign.words == "perception stopped publishing"]
    assert [sign.t for sign in silent] == pytest.approx([3.0], abs=0.05)
    assert max(spell.end for spell in trace.spells if spell.who == "perception") < 3.0


def test_state_intervals_are_contiguous_and_match_messages(story):
    trace = story(moved_leg=2).judged().trace
    for who in ("planner", "actuator", "perception"):
        own = [spell for spell in trace.spells if spell.who == who]
        assert own
        assert all(a.end == b.begin and a.state != b.state for a, b in pairwise(own))
    walks = [(s.begin, s.end) for s in trace.spells if s.state == Mode.WALK]
    walked = trace.t[trace.walking]
    assert walks[0][0] == pytest.approx(walked[0], abs=0.03)
    assert walks[-1][1] == pytest.approx(walked[-1], abs=0.05)


def test_reasons_differing_in_numbers_and_legs_have_one_kind():
    assert kind_of("slipping: left front, right rear and left rear by 3.2 mm") == kind_of("slipping: right middle by -12 mm")
    assert kind_of("no foothold") != kind_of("no pose")


def test_service_that_never_published_is_no_precursor(story):
    scorer = story(sink_s=4.0).judged()
    moment, trace = _decisive_moment(scorer), scorer.trace
    unheard = replace(trace, spells=tuple(spell for spell in trace.spells if spell.who != "planner"))
    assert not [sign for sign in signs(unheard, moment) if sign.words.startswith("planner")]
