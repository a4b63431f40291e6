import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.evaluation import report as reports
from sextant.evaluation.figures.recorded_ground import WORDS, MappedGround
from sextant.evaluation.figures.recorded_run import recorded_run, recorded_runs
from sextant.evaluation.observers.run_observers import about
from sextant.evaluation.walked_scenario import walked_scenario
from sextant.shared.files.config import ConfigError
from sextant.shared.recording.layout import RecordingError
from sextant.shared.recording.reader import Recording
from sextant.shared.recording.writer import Recorder
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose, TerrainMap

_MEASURED = '[[terrain]]\nkind = "height_map"\nfile = "ground.npy"\nresolution = 0.01\nxy = [-1.0, -1.0]\n'


@pytest.mark.slow
def test_replayed_recording_reproduces_live_evaluation(story, kept, scenario):
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
    # The least margin of the walk equals the report's; there is none while the robot stands.
    walking = run.trace.walking
    assert np.nanmin(run.margin) == pytest.approx(was.result().min_stability_margin_m)
    assert np.isnan(run.margin[~walking]).all()
    # Femurs bear twice the torque of the other joints.
    np.testing.assert_allclose(run.torque_rms, np.tile([0.3, 0.6, 0.3], (6, 1)))


def test_truncated_recording_is_read_and_marked(story, kept, scenario, tmp_path):
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


def test_stored_report_overrides_recomputed_result(story, kept, scenario, tmp_path):
    shutil.copytree(kept("good", story(moved_leg=2, drift=0.02)), tmp_path / "stopped")
    stopped = replace(story(moved_leg=2, drift=0.02).judged().result(), success=False, reason="stopped by the operator")
    reports.write(stopped, tmp_path / "stopped")
    assert recorded_run(tmp_path / "stopped", scenario).report.reason == "stopped by the operator"


def test_run_without_truth_uses_own_estimate_and_map(story, heard):
    told = story(moved_leg=2)
    run, true = heard("robot", told, truth=False), told.judged().trace
    assert run.own_words
    assert run.report.reason == WORDS
    assert not run.trace.touchdowns.misstep.any()
    assert all(run.numbers[name] is None for name in ("scenario", "seed", "success", "missteps"))
    assert set(run.numbers["pose_error_m"].values()) == {None}
    # Without truth, the body pose is the estimate and the ground is the map; both are exact in this walk.
    at = np.searchsorted(true.t, run.trace.t[run.trace.t <= true.t[-1]])
    np.testing.assert_allclose(run.trace.p_true[: len(at)], true.p_true[at], atol=1e-9)
    np.testing.assert_array_equal(run.trace.walking[: len(at)], true.walking[at])
    known = np.isfinite(run.trace.ground)
    assert known.mean() > 0.5
    np.testing.assert_allclose(run.trace.ground[known], 0.0, atol=1e-6)


def test_ground_height_is_from_newest_map_that_knows_cell(story):
    old, new = [m for m in story().messages() if isinstance(m, TerrainMap)][:2]
    new = replace(new, elevation=new.elevation + np.float32(0.1))
    seen = new.origin + new.resolution * np.array([[12, 20]])
    for maps, height in (([old, new], 0.1), ([new, old], 0.0)):
        assert MappedGround(maps).height_at(seen) == pytest.approx(height, abs=1e-6)
    # An older map fills the cells that the newest does not know; the others stay unknown.
    unknown = replace(new, elevation=np.full_like(new.elevation, np.nan))
    assert MappedGround([old, unknown]).height_at(seen) == pytest.approx(0.0, abs=1e-6)
    for maps in ([], [unknown], [old, new]):
        assert np.isnan(MappedGround(maps).height_at(np.array([[100.0, 0.0]]))).all()


def test_invalid_run_is_refused_with_hint(story, kept, scenario, tmp_path):
    good = kept("good", story(moved_leg=2, drift=0.02))
    with pytest.raises(RecordingError, match="no recordings in this folder"):
        recorded_run(tmp_path)
    with Recorder(tmp_path / "old.mcap", {"robot": "phantomx_mk2"}) as recorder:
        recorder.write(topics.TRUTH, b"not a frame", 0)
    with pytest.raises(RecordingError, match="read it with the version that wrote it"):
        recorded_run(tmp_path / "old.mcap")
    with Recorder(tmp_path / "silent.mcap", {"robot": "phantomx_mk2"}) as recorder:
        recorder.write(topics.BODY_POSE, codec.encode(next(m for m in story().messages() if isinstance(m, BodyPose))), 0)
    with pytest.raises(RecordingError, match=r"no actuator messages in it, .* give the folder of a `sextant run`"):
        recorded_run(tmp_path / "silent.mcap")
    with pytest.raises(RecordingError, match="'story', which does not come with Sextant; give its file with --scenario"):
        recorded_run(good)
    with pytest.raises(ConfigError, match="no scenario 'nowhere'"):
        recorded_run(good, "nowhere")
    with pytest.raises(RecordingError, match="a run of story, not of flat"):
        recorded_run(good, "flat")
    shutil.copytree(good, tmp_path / "bad")
    (tmp_path / "bad" / "report.json").write_text('{"scenario": 3}')
    with pytest.raises(RecordingError, match="not a report: scenario: str expected"):
        recorded_run(tmp_path / "bad", scenario)


def test_recorded_scenario_is_drawn_and_another_one_is_refused(story, scenario, tmp_path):
    np.save(tmp_path / "ground.npy", np.zeros((300, 200)))
    course = tmp_path / "story.toml"
    course.write_text(Path(scenario).read_text() + _MEASURED)
    walked = load_scenario(str(course))
    told = story(scenario=walked)
    with Recorder(tmp_path / "run.mcap", about(walked, told.seed, "live"), thinned_ns={}) as recorder:
        for message in told.messages():
            recorder.write(topics.OF_TYPE[type(message)], codec.encode(message), message.stamp_ns)
    run = recorded_run(tmp_path / "run.mcap", str(course))
    course.write_text(course.read_text().replace("distance = 0.5", "distance = 0.4"))
    assert recorded_run(tmp_path / "run.mcap").numbers == run.numbers
    with pytest.raises(ConfigError, match=r"differs from the scenario that .* holds in goal; leave --scenario out"):
        recorded_run(tmp_path / "run.mcap", str(course))
    np.save(tmp_path / "ground.npy", np.ones((300, 200)))
    with pytest.raises(ConfigError, match=r"ground\.npy: this file of the recorded scenario has changed since the run"):
        recorded_run(tmp_path / "run.mcap")
    (tmp_path / "ground.npy").unlink()
    with pytest.raises(ConfigError, match=r"ground\.npy: this file of the recorded scenario is missing"):
        recorded_run(tmp_path / "run.mcap")


def test_runs_of_folders_with_one_name_are_named_by_their_paths(story, kept, scenario, tmp_path):
    good = kept("good", story(moved_leg=2, drift=0.02))
    shutil.copytree(good, tmp_path / "good")
    assert [run.name for run in recorded_runs([good, tmp_path / "good"], scenario)] == [str(good), str(tmp_path / "good")]


def test_damaged_recorded_scenario_is_refused(tmp_path):
    for text in ("{", "[]", '{"scenario": {}, "files": {}}', '{"scenario": 3, "files": {}}'):
        recording = Recording(kept_message(tmp_path / "run.mcap", {"scenario.json": text}))
        assert len(list(recording.frames())) == 1
        with pytest.raises(ConfigError, match="read it with the version that wrote it"):
            walked_scenario(recording)


def kept_message(path: Path, about: dict[str, str]) -> Path:
    with Recorder(path, about) as recorder:
        recorder.write(topics.TRUTH, b"not a frame", 0)
    return path
