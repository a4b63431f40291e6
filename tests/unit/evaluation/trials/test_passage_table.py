"""Masri's Table 6.1, and the table of all passages, from synthetic runs."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.report import ARRIVED, FootholdEdge, Passage, Report, Section, as_table
from sextant.evaluation.trials import campaign_table, passage_table, results_store, summary
from sextant.evaluation.trials.passage_table import THESIS
from sextant.evaluation.trials.results_store import Run
from sextant.shared.scenario.loading import load_scenario


def section(seed, number, state="partial"):
    return Section(state, "", 1000 + 10 * seed + number, 100 + number, 4.0 + number, 20)


def run(name, seed, sections=3, success=True, time="2024-05-01T10:00:00+00:00", fingerprint="", **passage):
    made = Passage(30, FootholdEdge(0.020 + 0.001 * seed, 0.040 + 0.001 * seed), 0, None, ())
    made = replace(made, sections=tuple(section(seed, k) for k in range(1, sections + 1)), **passage)
    report = Report(
        name, seed, "phantomx_mk2", "tripod", False, success, ARRIVED if success else "fell", 2.3, 90.0, 0.02, 0, 0, 60
    )
    return Run.of(as_table(replace(report, passage=made)), fingerprint or name, "abc1234", time, "a fast machine")


def cells(text):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]


def test_each_section_row_shows_thesis_values():
    rows = cells(passage_table.markdown([run(name, seed) for name in THESIS for seed in (1003, 1001, 1002, 1004)]))
    assert [row[:2] for row in rows[2:]] == [[str(trial), str(k)] for trial in (1, 2, 3) for k in (1, 2, 3)]
    assert rows[0][2:5] == ["`passage1` n_g", "`passage1` n_e", "`passage1` t, s"]
    assert rows[2][2:5] == ["11011 (1111)", "101 (71)", "0.005 (0.117)"]  # trials by seed
    assert rows[10][8:] == ["11033 (1083)", "103 (457)", "0.007 (0.214)"]
    assert {len(row) for row in rows} == {11}


def test_missing_sections_are_shown_as_dashes():
    rows = cells(passage_table.markdown([run("passage1", 1000, sections=4), run("passage3", 1000, sections=1)]))
    assert [row[:2] for row in rows[2:6]] == [["1", "1"], ["1", "2"], ["1", "3"], ["1", "4"]]
    assert rows[5][2:5] == ["11004 (-)", "104 (-)", "0.008 (-)"]
    assert rows[3][8] == "- (1267)"
    assert rows[6][2] == "- (1184)"


def test_table_names_machines_commit_and_seeds():
    text = passage_table.markdown([run("passage2", 1000), run("passage2", 1001, success=False)])
    assert "Odroid U3" in text
    assert "one core of a fast machine" in text
    assert "seeds of passage2 1000, 1001 (failed)" in text
    assert "Made at commit abc1234" in text
    assert passage_table.markdown([]).count("\n") > 10, "the thesis' figures stand alone"


def test_table_uses_only_passage_runs_of_newest_program():
    old = [run("passage1", seed, fingerprint="old") for seed in range(3)]
    new = [run("passage1", seed, time="2024-06-01T10:00:00+00:00") for seed in (7, 8)]
    text = passage_table.markdown([*old, *new, run("flat", 1)])
    assert "passage1 7, 8." in text


def test_thesis_values_cover_three_sections_trials_and_scenarios():
    """All sections take less than a second, except two of the third scenario.

    The thesis states this.
    """
    sections = {name: [section for trial in published for section in trial] for name, published in THESIS.items()}
    assert [len(s) for s in sections.values()] == [9, 9, 9]
    assert sum(section.seconds > 1.0 for some in sections.values() for section in some) == 2
    assert all(section.expanded <= section.generated for some in sections.values() for section in some)


def test_passage_summary_of_batch():
    runs = [run("passage1", seed, feet_off=int(seed == 3)) for seed in range(10)]
    found = summary.summarise(runs).passages
    assert (found.feet_off, found.pillar_touchdowns) == (1, 300)
    assert (found.foothold_edge_m.median, found.foothold_edge_m.worst) == pytest.approx((0.0445, 0.040))
    assert found.stops == summary.Figure(3.0, 3.0)
    assert (found.planning_p50_ms, found.planning_p99_ms) == pytest.approx((6.0, 7.0))
    assert found.expansions_per_s == pytest.approx(102 / 6e-3)
    assert (found.passable, found.impassable, found.entered_in_vain, found.undecided) == (0, 0, 0, 0)
    assert "feet off a pillar 1, touchdowns on pillars 300" in summary.words(summary.summarise(runs))


def test_summary_counts_crossed_and_wrongly_entered_gaps():
    runs = [
        run("pillar_field", 0, passable=True),
        run("pillar_field", 1, passable=False, pillar_touchdowns=0, success=False),
        run("pillar_field", 2, passable=False, success=False),
        run("pillar_field", 3, passable=None),
        run("pillar_field", 4, passable=True, success=False),
    ]
    found = summary.summarise(runs).passages
    assert (found.passable, found.crossed, found.impassable, found.entered_in_vain, found.undecided) == (2, 1, 2, 1, 1)
    assert "passable 2, of which crossed 1; impassable 2, of which entered 1; undecided 1" in summary.words(
        summary.summarise(runs)
    )


def test_walk_without_pillars_has_no_passage_figures():
    plain = run("flat", 0, sections=0, pillar_touchdowns=0, foothold_edge_m=FootholdEdge())
    found = summary.summarise([plain])
    assert found.passages is None
    row = cells(campaign_table.markdown(campaign_table.of_runs([plain]), "passages"))[2]
    assert row[3:] == ["-"] * 9


def test_passages_table_has_rows_in_fixed_order(tmp_path):
    runs = [run(name, seed) for name in reversed(campaign_table.PASSAGES) for seed in range(4)]
    results_store.keep(tmp_path / "campaign.jsonl", runs)
    again = campaign_table.of_runs(results_store.read(tmp_path / "campaign.jsonl"))
    rows = cells(campaign_table.markdown(again, "passages"))
    assert [row[0] for row in rows[2:]] == [f"`{name}`" for name in campaign_table.PASSAGES]
    first = dict(zip(rows[0], rows[2], strict=True))
    assert first["goal reached"] == "4 of 4 (51 to 100 %)"
    assert first["feet off"] == "0 of 120"
    assert first["from the edge, mm"] == "42 (40)"
    assert first["planning p50, ms"] == "6.0"
    assert np.isfinite(float(first["expansions/s"]))


def test_table_passages_are_packaged_scenarios():
    assert [load_scenario(name).name for name in campaign_table.PASSAGES] == list(campaign_table.PASSAGES)
    assert set(THESIS) <= set(campaign_table.PASSAGES)
