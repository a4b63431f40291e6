"""The table of all terrains, from synthetic runs."""

import functools
import json
from dataclasses import replace

import pytest

from sextant.evaluation.report import HeightError, Report, Slip, Spread, Torque, as_table
from sextant.evaluation.trials import campaign, campaign_table, environment, results_store, summary, trials
from sextant.shared.scenario.loading import load_scenario


def _report(scenario, seed):
    good = not scenario.walk.blind or seed % 2 == 0
    return Report(
        scenario.name,
        seed,
        scenario.robot,
        "tripod",
        scenario.walk.blind,
        good,
        "goal reached" if good else "fell 0.40 m along",
        2.5,
        25.0,
        0.1,
        int(not good),
        0,
        200,
        tilt_deg=Spread(0.25, 1.0),
        torque_nm=Torque(0.8, 1.4, 0.7),
        body_height_error_m=HeightError(0.001, 0.002),
        slip_m_per_step=Slip(0.0015, 0.004),
        missteps=1,
        min_stability_margin_m=0.040,
    )


class Runner:
    def __init__(self, until=10**6):
        self.ran = []
        self.until = until

    def __call__(self, scenario, seed):
        if len(self.ran) == self.until:
            raise KeyboardInterrupt
        self.ran.append((scenario.name, scenario.walk.blind, scenario.robot, seed))
        return _report(scenario, seed)


def test_table_has_terrain_rows_with_blind_baseline_below(tmp_path):
    found = campaign.run_campaign(("flat", "stairs"), range(4), 1, tmp_path, blind=True, run=Runner())
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in campaign_table.markdown(found).splitlines()[:6]]
    assert len({len(row) for row in rows}) == 1
    assert [row[0] for row in rows[2:]] == ["`flat`", "`flat`, blind", "`stairs`", "`stairs`, blind"]
    seeing, blind = (dict(zip(rows[0], row, strict=True)) for row in rows[2:4])
    assert seeing["goal reached"] == "4 of 4 (51 to 100 %)"
    assert (blind["goal reached"], blind["falls"]) == ("2 of 4 (15 to 85 %)", "2")
    assert seeing["missteps per 100 steps"] == "0.50 (4 in 800)"
    assert seeing["height rms, mm"] == "2.0 (2.0)"
    assert seeing["least margin, mm"] == "40 (40)"
    assert "Together 8 of 8 (68 to 100 %) reached the goal" in campaign_table.markdown(found)
    table = json.loads(campaign_table.to_json(found))
    assert table["terrains"]["stairs"]["baseline"]["success"]["successes"] == 2


def test_rows_of_different_rules_are_labelled_and_not_pooled(tmp_path):
    entries = []
    for rule, seeds in (("", range(4)), ("my_rules:level", (0, 1, 3))):
        runs = [_report(load_scenario("flat"), seed) for seed in seeds]
        params = f"foothold {rule}, planner.costmap.max_step_m=0.05" if rule else ""
        batch = [results_store.Run.of(as_table(one), "f", "c", "2026-01-01T00:00:00+00:00", params=params) for one in runs]
        entries.append(campaign_table.Entry(summary.summarise(batch)))
    found = campaign_table.Campaign(tuple(entries), ())
    table = campaign_table.content(found, seeds=True)
    assert [row[0] for row in table.rows] == [
        "`flat`, Sextant's foothold rule",
        "`flat`, foothold my_rules:level, planner.costmap.max_step_m=0.05",
    ]
    assert [row[-1] for row in table.rows] == ["0 to 3", "0, 1, 3"]
    assert "Together" not in table.notes[0]
    assert table.notes[0].endswith(f"Seeds 0 to 3; 0, 1, 3 of {table.rows[1][0]}.")
    assert json.loads(campaign_table.to_json(found))["terrains"]["flat, Sextant's foothold rule"]["seeds"] == [0, 1, 2, 3]


def test_strewn_seeds_are_counted():
    assert results_store.in_ranges([*range(16), *range(17, 21)]) == "0 to 15, 17 to 20"
    assert results_store.in_ranges(range(7, 107, 5)) == "20 between 7 and 102"


def test_interrupted_campaign_resumes(tmp_path):
    first, second = Runner(until=5), Runner()
    with pytest.raises(KeyboardInterrupt):
        campaign.run_campaign(("flat", "stairs"), range(4), 1, tmp_path, run=first)
    # Completed runs are in the file already.
    assert "`flat`" in (tmp_path / "table.md").read_text()
    found = campaign.run_campaign(("flat", "stairs"), range(4), 1, tmp_path, run=second)
    assert [(name, seed) for name, _, _, seed in first.ran + second.ran] == [
        (n, s) for n in ("flat", "stairs") for s in range(4)
    ]
    assert [entry.seeing.success.n for entry in found.entries] == [4, 4]


def test_terrain_with_missing_files_is_skipped_and_reported(tmp_path, monkeypatch):
    monkeypatch.delenv("MY_MAPS", raising=False)
    lacking = tmp_path / "mapped.toml"
    part = 'kind = "height_map"\nfile = "$MY_MAPS/stairs.npy"\nresolution = 0.02\nxy = [0, 0]\n'
    lacking.write_text(f'name = "mapped"\n[goal]\ndistance = 1.0\n[[terrain]]\n{part}')
    runner = Runner()
    found = campaign.run_campaign((str(lacking), "flat"), range(1), 1, tmp_path / "out", run=runner)
    assert [name for name, *_ in runner.ran] == ["flat"]
    assert f"Left out: {lacking}: height map" in campaign_table.markdown(found)
    assert "MY_MAPS is not set" in found.left_out[0]


def test_robot_option_applies_to_every_terrain(tmp_path):
    runner = Runner()
    campaign.run_campaign(
        ("flat", "stairs"), range(1), 1, tmp_path, asked=lambda s: replace(s, robot="phantomx_mk2_rgbd"), run=runner
    )
    assert {robot for _, _, robot, _ in runner.ran} == {"phantomx_mk2_rgbd"}


def test_campaign_terrains_are_packaged_scenarios():
    assert [load_scenario(name).name for name in campaign_table.WALKED] == list(campaign_table.WALKED)


def _sorted_runs(ran):
    return sorted((name, blind, seed) for name, blind, _, seed in ran)


@pytest.mark.slow
@pytest.mark.parametrize("table", campaign_table.TABLES)
def test_table_from_stored_runs_equals_table_of_campaign(tmp_path, table):
    found = campaign.run_campaign(("stairs", "flat"), range(4), 1, tmp_path, blind=True, run=Runner())
    again = campaign_table.of_runs(results_store.read(tmp_path / "campaign.jsonl"))
    printed, ran = (campaign_table.markdown(one, table).splitlines() for one in (again, found))
    assert sorted(printed) == sorted(ran)
    assert printed[2].startswith("| `flat`"), "in the public table's order"


def test_results_from_two_machines_merge_into_one_table(tmp_path):
    ways = ("flat", "stairs")
    whole = campaign.run_campaign(ways, range(6), 1, tmp_path / "whole", blind=True, run=Runner())
    for part, seeds in (("here", range(3)), ("there", range(2, 6))):
        campaign.run_campaign(ways, seeds, 1, tmp_path / part, blind=True, run=Runner())
    runs = [run for path in results_store.files([tmp_path / "here", tmp_path / "there"]) for run in results_store.read(path)]
    together = campaign_table.of_runs(runs)
    assert [entry.seeing.success.n for entry in together.entries] == [6, 6], "a seed of both counts once"
    assert campaign_table.markdown(together) == campaign_table.markdown(whole)


def test_campaign_resumes_from_stored_file_in_another_folder(tmp_path):
    first, second = Runner(until=5), Runner()
    with pytest.raises(KeyboardInterrupt):
        campaign.run_campaign(("flat", "stairs"), range(4), 1, tmp_path / "here", blind=True, run=first)
    (tmp_path / "there").mkdir()
    lines = (tmp_path / "here" / "campaign.jsonl").read_text()
    (tmp_path / "there" / "campaign.jsonl").write_text(lines + '{"fingerprint":"cut o')
    found = campaign.run_campaign(("flat", "stairs"), range(4), 1, tmp_path / "there", blind=True, run=second)
    assert _sorted_runs(first.ran + second.ran) == sorted(
        (n, b, s) for n in ("flat", "stairs") for b in (False, True) for s in range(4)
    )
    again = campaign_table.of_runs(results_store.read(tmp_path / "there" / "campaign.jsonl"))
    assert campaign_table.markdown(again) == campaign_table.markdown(found)


def test_runs_of_earlier_program_are_excluded_and_counted(tmp_path, monkeypatch):
    for program, time, seeds in ((b"old", "2024-05-01T10:00:00+00:00", 5), (b"new", "2024-05-02T10:00:00+00:00", 3)):
        monkeypatch.setattr(environment, "_program", lambda program=program: program)
        monkeypatch.setattr(environment, "_begun_by", lambda program=program: (program, "abc1234"))
        monkeypatch.setattr(trials.provenance, "now", lambda time=time: time)
        campaign.run_campaign(("flat",), range(seeds), 1, tmp_path, run=Runner())
    found = campaign_table.of_runs(results_store.read(tmp_path / "campaign.jsonl"))
    assert found.entries[0].seeing.success.n == 3
    assert "Left out: 5 runs of an earlier program or scenario." in campaign_table.markdown(found)


def test_table_rows_name_robot_if_there_are_several(tmp_path):
    for robot in ("phantomx_mk2", "phantomx_mk2_rgbd"):
        campaign.run_campaign(
            ("flat",), range(2), 1, tmp_path / robot, asked=lambda s, robot=robot: replace(s, robot=robot), run=Runner()
        )
    runs = [
        run
        for path in results_store.files([tmp_path / "phantomx_mk2", tmp_path / "phantomx_mk2_rgbd"])
        for run in results_store.read(path)
    ]
    found = campaign_table.of_runs(runs)
    rows = campaign_table.markdown(found, "missteps").splitlines()[2:4]
    assert [row.split("|")[1].strip() for row in rows] == ["`flat`, phantomx_mk2", "`flat`, phantomx_mk2_rgbd"]
    assert len(json.loads(campaign_table.to_json(found))["terrains"]) == 2


def test_points_of_a_family_are_in_the_order_of_their_values(tmp_path):
    points = ["slope@30", "slope@5", "slope@10+x0.9", "slope@10", "riser@0.03"]
    campaign.run_campaign(points, range(2), 1, tmp_path, run=Runner())
    rows = campaign_table.markdown(campaign_table.of_runs(results_store.read(tmp_path / "campaign.jsonl")), "missteps")
    found = [row.split("|")[1].strip(" `") for row in rows.splitlines()[2:7]]
    assert found == ["riser@0.03", "slope@5", "slope@10", "slope@10+x0.9", "slope@30"]


def test_name_that_only_looks_like_a_point_is_sorted_as_text(tmp_path):
    names = ["mine@1.2.3", "mine@.", "mine@-", "mine@"]
    runner = Runner()
    for name in names:
        course = replace(load_scenario("flat"), name=name)
        campaign.run_campaign(["flat"], range(2), 1, tmp_path / "runs", asked=lambda _, course=course: course, run=runner)
    found = campaign_table.of_runs(results_store.read(tmp_path / "runs/campaign.jsonl"))
    assert [entry.seeing.scenario for entry in found.entries] == sorted(names)


def test_reached_table_has_blind_baseline_column(tmp_path):
    found = campaign.run_campaign(("flat", "stairs"), range(4), 1, tmp_path, blind=True, run=Runner())
    rows = campaign_table.markdown(found, "reached").splitlines()
    assert rows[2] == "| `flat`: level ground | 4 of 4 (51 to 100 %) | 2 of 4 (15 to 85 %) |"


def _stored_runs(scenario, blind, commit, reason="goal reached", seeds=4):
    scenario = load_scenario(scenario)
    scenario = replace(scenario, walk=replace(scenario.walk, blind=blind))
    reports = [replace(_report(scenario, seed), success=True, reason=reason) for seed in range(seeds)]
    time = "2024-05-01T10:00:00+00:00"
    return [results_store.Run.of(as_table(report), f"{scenario.name} {blind}", commit, time) for report in reports]


def test_table_names_commits_of_sighted_and_blind_walks():
    found = campaign_table.of_runs(_stored_runs("flat", False, "abc1234") + _stored_runs("flat", True, "def5678"))
    text = campaign_table.markdown(found)
    assert "Made at commit abc1234 on" in text
    assert "Made at commit def5678 on" in text


@pytest.mark.parametrize("table", campaign_table.TABLES)
def test_blind_only_campaign_has_no_summary_of_sighted_walks(table):
    text = campaign_table.markdown(campaign_table.of_runs(_stored_runs("flat", True, "abc1234")), table)
    assert "4 of 4" in text or table == "maps"
    assert "Together" not in text
    assert "Made at commit abc1234" in text


@pytest.mark.parametrize("table", ["walks", "reached", "missteps"])
def test_correct_refusal_is_not_counted_as_goal_reached(table):
    refusals = _stored_runs("no_way", False, "abc1234", "stood and reported why: no way past the wall")
    alone = campaign_table.markdown(campaign_table.of_runs(refusals), table)
    assert "| 4 of 4 (51 to 100 %), rightly refused |" in alone
    assert "reached the goal" not in alone
    beside = campaign_table.markdown(campaign_table.of_runs(refusals + _stored_runs("flat", False, "abc1234", seeds=3)), table)
    assert "Together 3 of 3 (44 to 100 %) reached the goal." in beside


def test_code_change_between_terrains_ends_campaign(tmp_path, monkeypatch):
    code = tmp_path / "evaluation" / "code.py"
    code.parent.mkdir()
    code.write_text("one = 1\n")
    monkeypatch.setattr(environment, "__file__", str(tmp_path / "evaluation" / "trials" / "environment.py"))
    monkeypatch.setattr(environment, "_begun_by", functools.cache(environment._begun_by.__wrapped__))
    monkeypatch.setattr(trials.provenance, "commit", lambda: "abc1234")
    runner = Runner()

    def changing(scenario, seed):
        code.write_text("one = 2\n")
        return runner(scenario, seed)

    for run in (changing, runner):
        with pytest.raises(environment.ChangedError, match="start a new one, or restore commit abc1234"):
            campaign.run_campaign(("flat", "stairs"), range(2), 1, tmp_path / "out", run=run)
    assert _sorted_runs(runner.ran) == [("flat", False, 0), ("flat", False, 1)]
    code.write_text("one = 1\n")
    campaign.run_campaign(("flat", "stairs"), range(2), 1, tmp_path / "out", run=runner)
    assert _sorted_runs(runner.ran) == [(name, False, seed) for name in ("flat", "stairs") for seed in range(2)]


def test_terrains_share_their_processes(tmp_path, monkeypatch):
    shared, said = [], []

    def share_out(work, tasks, jobs, in_order):
        shared.append(jobs)
        return iter([work(*task) for task in (tasks[0], tasks[2], tasks[1], tasks[3])])  # a late walk of the first terrain

    monkeypatch.setattr(trials, "share_out", share_out)
    found = campaign.run_campaign(("flat", "stairs"), range(2), 2, tmp_path, say=said.append, run=Runner())
    assert shared == [2]
    assert [(entry.seeing.scenario, entry.seeing.seeds) for entry in found.entries] == [("flat", (0, 1)), ("stairs", (0, 1))]
    assert [line.partition("[")[0] for line in said if "took" in line] == ["", "stairs: ", "", ""]
    assert [line.partition(":")[0] for line in said if "a line follows" in line] == ["flat", "stairs"]
