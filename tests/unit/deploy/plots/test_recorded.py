import shutil
from dataclasses import replace

import numpy as np
import pytest

from deploy import report as reports
from deploy.plots.recorded import recorded_run
from services.console.recording.layout import RecordingError
from shared.config import ConfigError


def test_a_run_that_is_heard_again_is_the_run_that_was_judged(story, kept, scenario):
    told = story(moved_leg=2, drift=0.02)
    was = told.judged()
    run = recorded_run(kept("good", told), scenario)
    n = len(was.trace.t)
    for name in ("t", "walking", "p_true", "height_reference", "tilt", "feet", "ground", "torque_worst"):
        np.testing.assert_array_equal(getattr(run.trace, name)[:n], getattr(was.trace, name), err_msg=name)
    for name in ("t", "leg", "p", "moved", "misstep"):
        np.testing.assert_array_equal(getattr(run.trace.touchdowns, name), getattr(was.trace.touchdowns, name), err_msg=name)
    assert (run.report.success, run.report.reason, run.report.steps) == (True, "goal reached", was.result().steps)
    assert run.numbers == reports.as_table(was.result())
    assert run.name == "good"
    assert not run.cut_off
    # The least margin of the walk is the report's, and nothing is said of how it stood.
    walking = run.trace.walking
    assert np.nanmin(run.margin) == pytest.approx(was.result().min_stability_margin_m)
    assert np.isnan(run.margin[~walking]).all()
    # Femurs bear twice of what the other joints do.
    np.testing.assert_allclose(run.torque_rms, np.tile([0.3, 0.6, 0.3], (6, 1)))


def test_the_recording_alone_does_and_what_is_lost_of_its_end_is_said(story, kept, scenario, tmp_path):
    whole = kept("good", story(moved_leg=2, drift=0.02)) / "recording.mcap"
    by_file = recorded_run(whole, scenario)
    assert by_file.name == "good"
    part = tmp_path / "part.mcap"
    part.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    run = recorded_run(part, scenario)
    assert run.cut_off
    assert not by_file.cut_off
    n = len(run.trace.t)
    assert 50 < n < len(by_file.trace.t)
    np.testing.assert_array_equal(run.trace.p_true, by_file.trace.p_true[:n])


def test_the_verdict_is_the_one_of_the_run_itself(story, kept, scenario, tmp_path):
    shutil.copytree(kept("good", story(moved_leg=2, drift=0.02)), tmp_path / "stopped")
    stopped = replace(story(moved_leg=2, drift=0.02).judged().result(), success=False, reason="stopped by the operator")
    reports.write(stopped, tmp_path / "stopped")
    assert recorded_run(tmp_path / "stopped", scenario).report.reason == "stopped by the operator"


def test_what_is_no_run_is_refused_with_what_would_be(story, kept, scenario, tmp_path):
    good = kept("good", story(moved_leg=2, drift=0.02))
    with pytest.raises(RecordingError, match="no recordings in this folder"):
        recorded_run(tmp_path)
    with pytest.raises(RecordingError, match="not of a simulation; give the folder of a `sextant run`"):
        recorded_run(kept("robot", story(), truth=False))
    with pytest.raises(ConfigError, match="no scenario 'story'"):
        recorded_run(good)
    with pytest.raises(RecordingError, match="a run of story, not of flat"):
        recorded_run(good, "flat")
    shutil.copytree(good, tmp_path / "bad")
    (tmp_path / "bad" / "report.json").write_text('{"scenario": 3}')
    with pytest.raises(RecordingError, match="not a report: scenario: str expected"):
        recorded_run(tmp_path / "bad", scenario)
