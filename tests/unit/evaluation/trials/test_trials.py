import importlib
import itertools
import json
import os
import textwrap
from dataclasses import replace

import pytest

from sextant.evaluation import report as reports
from sextant.evaluation.provenance import Made
from sextant.evaluation.report import CourseMap, HeightError, PoseError, Report, Spread, Warned
from sextant.evaluation.trials import campaign_table, environment, summary, trials
from sextant.evaluation.trials.results_store import Run
from sextant.shared.files.config import ConfigError
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import HeightMap, Plane, Rubble

SCENARIO = Scenario("made up", (Plane(),), Goal(2.5))


def _report(scenario, seed):
    """Return a report: odd seeds fall, seed 6 loses a servo, all others arrive.

    A blind robot arrives only for multiples of ten.
    """
    good = seed % 10 == 0 if scenario.walk.blind else seed % 2 == 0 and seed != 6
    fall = not good and seed != 6
    reason = "goal reached" if good else f"fell {seed / 10:.2f} m along" if fall else "servo shut down: left rear femur"
    return Report(
        scenario.name,
        seed,
        scenario.robot,
        "tripod",
        scenario.walk.blind,
        good,
        reason,
        2.5,
        25.0,
        0.1 + 0.001 * seed,
        int(fall),
        int(seed == 6),
        40,
        tilt_deg=Spread(float(seed), 10.0),
        raised_block_touchdowns=12 + seed,
        missteps=seed // 5,
        body_height_error_m=HeightError(-0.001 * seed, 0.01),
        body_height_oscillation_m=0.001,
        min_stability_margin_m=0.01 if seed == 3 else 0.046,
        pose_error_m=PoseError(0.01, float("nan") if seed == 1 else 0.02),
        course_map_m=CourseMap(0.01, 0.001, -0.002 * seed, 0.008, 0.9 + 0.01 * seed),
        real_time_factor=3.0,
    )


def table_of(summaries, name):
    campaign = campaign_table.Campaign(tuple(map(campaign_table.Entry, summaries)), ())
    return campaign_table.markdown(campaign, name)


class Runner:
    def __init__(self, until=100):
        self.seeds = []
        self.until = until

    def __call__(self, scenario, seed):
        if len(self.seeds) == self.until:
            raise KeyboardInterrupt
        self.seeds.append(seed)
        return _report(scenario, seed)


def test_batch_summary(tmp_path):
    said = []
    result = trials.run_trials(SCENARIO, range(10), 1, tmp_path, say=said.append, run=Runner())
    assert (result.success.successes, result.success.n) == (4, 10)
    assert result.map_bias_m.worst == pytest.approx(0.018)
    assert (result.map_rmse_m.median, result.map_coverage.worst) == (0.01, 0.9)
    assert (result.falls, result.runs_with_shutdown) == (5, 1)
    assert result.failed_seeds == (1, 3, 5, 6, 7, 9)
    assert result.failures == {"fell # m along": 5, "servo shut down: left rear femur": 1}
    assert result.mean_speed_mps == pytest.approx(0.1 + 0.001 * (0 + 2 + 4 + 8) / 4)
    assert result.block_touchdowns == summary.Figure(16.5, 12.0)
    assert result.missteps == summary.Figure(0.5, 1.0)
    assert (result.all_missteps, result.all_steps) == (5, 400)
    assert "missteps 5 in 400 steps" in summary.words(result)
    assert "pillar" not in summary.words(result)
    assert result.height_rms_m == summary.Figure(0.01, 0.01)
    assert result.stability_margin_m == summary.Figure(0.046, 0.01)
    assert result.tilt_p95_deg == summary.Figure(4.5, 9.0)
    assert (result.height_error_m.median, result.height_error_m.worst) == pytest.approx((0.0045, 0.009))
    assert (result.final_pose_error.median, result.final_pose_error.worst) == pytest.approx((0.02 / 2.5,) * 2)
    assert "touchdowns on blocks 16 (12)" in summary.words(result)
    assert said[0] == "made up: 10 walks, 1 at a time; a line follows for each walk that ends"
    assert len(said) == 11
    assert all(" took 0 s, some 0 s to go" in line for line in said[1:-1])
    assert said[-1].endswith("took 0 s")
    assert "seed   3  FAIL" in said[4]
    assert "(4 of 10)" in said[-1]


def test_warnings_count_once_a_walk_with_any_numbers(tmp_path):
    def run(scenario, seed):
        told = [Warned(1.0, 2, f"the camera looks {seed}.5 deg lower")] * (seed > 0)
        told += [Warned(2.0, 3, "slipping: left front"), Warned(2.1, 3, "slipping: left front, right rear")] * (seed == 2)
        return replace(_report(scenario, seed), warnings=tuple(told))

    result = trials.run_trials(SCENARIO, range(3), 1, tmp_path, run=run)
    assert result.with_warnings == 2
    assert list(result.warnings.items()) == [("the camera looks # deg lower", 2), ("slipping", 1)]
    assert "2 x warning: the camera looks # deg lower" in summary.words(result)
    table = table_of([result], "warnings")
    assert "| 2 of 3 | the camera looks # deg lower (2) |" in table
    assert "Warnings in 2 of 3 walks" in table
    assert "Median" not in table


def test_warnings_of_older_lines_are_unknown(tmp_path):
    runs = [replace(Run.read({"report": reports.as_table(_report(SCENARIO, seed))}), warnings=None) for seed in (0, 2)]
    result = summary.summarise([runs[0], replace(runs[1], warnings=())])
    assert result.with_warnings is None
    assert "| - | - |" in table_of([result], "warnings")


def test_interrupted_batch_resumes(tmp_path):
    first = Runner(until=4)
    with pytest.raises(KeyboardInterrupt):
        trials.run_trials(SCENARIO, range(10), 1, tmp_path, run=first)
    with (tmp_path / "trials.jsonl").open("a") as lines:
        lines.write('{"fingerprint": "cut o')
    second = Runner()
    result = trials.run_trials(SCENARIO, range(10), 1, tmp_path, run=second)
    assert first.seeds + second.seeds == list(range(10))
    anew = trials.run_trials(SCENARIO, range(10), 1, tmp_path / "anew", run=Runner())
    assert repr(replace(result, made=anew.made)) == repr(anew), "compared as text: what was not measured is NaN"
    # Only the requested seeds count, not all in the file.
    assert trials.run_trials(SCENARIO, [2, 4], 1, tmp_path, run=Runner(until=0)).success.n == 2


def test_lines_of_another_program_are_ignored(tmp_path):
    runner = Runner()
    with (tmp_path / "trials.jsonl").open("wb") as lines:
        lines.write(b'{"fingerprint": "of long ago", "report": {"seed": 1}}\n')
        lines.write('{"fingerprint": "a line\u2028cut in a letter: \u00fc'.encode()[:-1])
    trials.run_trials(SCENARIO, range(3), 1, tmp_path, run=runner)
    assert runner.seeds == [0, 1, 2]
    trials.run_trials(SCENARIO, range(3), 1, tmp_path, run=Runner(until=0))


def test_seed_with_line_without_newline_is_not_repeated(tmp_path):
    trials.run_trials(SCENARIO, range(3), 1, tmp_path, run=Runner())
    path = tmp_path / "trials.jsonl"
    path.write_bytes(path.read_bytes()[:-1])
    runner = Runner()
    trials.run_trials(SCENARIO, range(5), 1, tmp_path, run=runner)
    assert runner.seeds == [3, 4]
    assert trials.run_trials(SCENARIO, range(5), 1, tmp_path, run=Runner(until=0)).success.n == 5


def test_changed_scenario_is_run_again(tmp_path):
    trials.run_trials(SCENARIO, range(3), 1, tmp_path, run=Runner())
    faster, moved = replace(SCENARIO, time_limit_s=1.0), replace(SCENARIO, folder="/elsewhere")
    runner = Runner()
    trials.run_trials(faster, range(3), 1, tmp_path, run=runner)
    assert runner.seeds == [0, 1, 2]
    trials.run_trials(moved, range(3), 1, tmp_path, run=Runner(until=0))


def test_fingerprint_depends_on_program_and_height_map(tmp_path, monkeypatch):
    ground = replace(SCENARIO, terrain=(HeightMap("ground.npy", 0.01, (0.0, 0.0)),), folder=str(tmp_path))
    (tmp_path / "ground.npy").write_bytes(b"one")
    before = trials.fingerprint(ground)
    assert before == trials.fingerprint(ground)
    (tmp_path / "ground.npy").write_bytes(b"another")
    changed = trials.fingerprint(ground)
    monkeypatch.setattr(environment, "_begun_by", lambda: (b"another version", "abc1234"))
    assert len({before, changed, trials.fingerprint(ground)}) == 3


def test_blind_baseline_is_separate_and_compared(tmp_path):
    seeing = trials.run_trials(SCENARIO, range(0, 80, 2), 1, tmp_path, run=Runner())
    blind = trials.run_trials(SCENARIO, range(0, 80, 2), 1, tmp_path, blind=True, run=Runner())
    assert blind.blind
    assert not seeing.blind
    compared = summary.compare(seeing, blind)
    assert compared.difference == pytest.approx(39 / 40 - 8 / 40)
    assert compared.disjoint
    table = json.loads(summary.to_json(seeing, blind))
    assert table["baseline"]["success"]["successes"] == 8
    assert table["compared"]["disjoint"] is True
    text = summary.words(seeing, blind)
    assert "made up: 39 of 40" in text
    assert "made up, blind: 8 of 40" in text
    assert "disjoint" in text


def test_json_of_batch_without_success_has_no_nan(tmp_path):
    result = trials.run_trials(SCENARIO, [1], 1, tmp_path, run=Runner())
    table = json.loads(summary.to_json(result), parse_constant=lambda name: pytest.fail(name))
    assert table["mean_speed_mps"] is None
    assert table["final_pose_error"] == {"median": None, "worst": None}
    assert table["failed_seeds"] == [1]


def test_invalid_batch_arguments_are_refused(tmp_path):
    with pytest.raises(ValueError, match="0 seeds"):
        trials.run_trials(SCENARIO, [], 1, tmp_path)
    with pytest.raises(ValueError, match="0 jobs"):
        trials.run_trials(SCENARIO, [1], 0, tmp_path)
    (tmp_path / "trials.jsonl").write_text('{"seed": 3}\n')
    with pytest.raises(ValueError, match=r"line 1.*remove the line"):
        trials.run_trials(SCENARIO, [1], 1, tmp_path)


def test_batch_reports_commits_and_dates(tmp_path, monkeypatch):
    for commit, time, seeds in (("abc1234", "2024-05-01T10:00:00+00:00", 2), ("def5678+", "2024-05-03T09:00:00+00:00", 4)):
        monkeypatch.setattr(trials.provenance, "commit", lambda commit=commit: commit)
        monkeypatch.setattr(trials.provenance, "now", lambda time=time: time)
        result = trials.run_trials(SCENARIO, range(seeds), 1, tmp_path, run=Runner())
    assert result.made == Made(("abc1234", "def5678+"), "2024-05-01T10:00:00+00:00", "2024-05-03T09:00:00+00:00")
    assert "made at commit abc1234, def5678+ on 2024-05-01 to 2024-05-03" in summary.words(result)
    assert json.loads(summary.to_json(result))["made"]["commits"] == ["abc1234", "def5678+"]


def test_each_stored_line_holds_complete_report(tmp_path):
    trials.run_trials(SCENARIO, range(5), 1, tmp_path, run=Runner())
    for line in (tmp_path / "trials.jsonl").read_text().splitlines():
        assert reports.check(json.loads(line)["report"]) == []


@pytest.mark.slow
def test_worker_processes_use_one_thread_each(tmp_path, monkeypatch):
    module = tmp_path / "one_run_in_a_process.py"
    module.write_text(
        textwrap.dedent(
            """
            import os
            from sextant.evaluation.report import Report

            def run(scenario, seed):
                threads = int(os.environ["OMP_NUM_THREADS"])
                return Report(scenario.name, seed, "r", "tripod", False, True, str(os.getpid()), 0.0, 1.0, 0.1, 0, 0, threads)
            """
        )
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    run = importlib.import_module(module.stem).run
    result = trials.run_trials(SCENARIO, range(4), 2, tmp_path / "out", run=run)
    assert result.success.successes == 4
    done = [json.loads(line)["report"] for line in (tmp_path / "out" / "trials.jsonl").read_text().splitlines()]
    assert sorted(t["seed"] for t in done) == [0, 1, 2, 3]
    assert {t["steps"] for t in done} == {1}
    assert str(os.getpid()) not in {t["reason"] for t in done}


def test_full_disk_warns_and_batch_continues(tmp_path):
    told = []

    def run(scenario, seed):
        if seed == 1:
            (tmp_path / "trials.jsonl").rename(tmp_path / "kept.jsonl")
            (tmp_path / "trials.jsonl").symlink_to("/dev/full")
        return _report(scenario, seed)

    ran = trials.run_trials(SCENARIO, range(4), 1, tmp_path, say=told.append, run=run)
    assert ran.success.n == 4
    assert len((tmp_path / "kept.jsonl").read_text(encoding="utf-8").splitlines()) == 1
    warnings = [line for line in told if line.startswith("warning: ")]
    assert warnings == 3 * [f"warning: {tmp_path / 'trials.jsonl'} cannot be written: the disk is full; free some space"]


def test_seed_without_ground_is_named_before_the_first_walk(tmp_path):
    rubble = Rubble((0.0, 0.9), (-0.4, 0.4), 14, (0.12, 0.2), (0.02, 0.04))  # seed 4 finds no room for them
    tight, runner = replace(SCENARIO, terrain=(Plane(), rubble)), Runner()
    with pytest.raises(ConfigError) as refused:
        trials.run_trials(tight, range(3, 6), 1, tmp_path, run=runner)
    words = str(refused.value)
    assert "no ground for seed 4, so no walk was started" in words
    assert "terrain[1]: room for 14 blocks of rubble expected" in words
    assert not runner.seeds


def test_walks_that_wait_for_other_work_are_reported(tmp_path, monkeypatch):
    times = itertools.count(step=10_000_000_000)
    monkeypatch.setattr(trials, "stopwatch_ns", lambda: next(times))
    said = []
    trials.run_trials(SCENARIO, range(3), 1, tmp_path, say=said.append, run=Runner())
    assert said[1].endswith("took 10 s, some 20 s to go")
    assert said[-1].startswith("a walk took 10 s, of which 0 s of CPU time: the machine was busy with other work")
