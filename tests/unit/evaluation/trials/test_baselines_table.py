"""Table of all baselines: a row per course, a column per method."""

from dataclasses import replace
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.evaluation.trials import results_store
from sextant.evaluation.trials.baselines_table import BLIND, OURS, content

DOCS = Path(__file__).parents[4] / "docs"
WALKS = [run for run in results_store.read(DOCS / "campaign.jsonl") if run.scenario in ("flat", "ditch")]
LOTRIET = "planner lotriet, foothold lotriet"
THEIRS = [replace(run, params=LOTRIET, success=False) for run in WALKS if run.scenario == "ditch" and not run.blind][:5]


def test_each_method_has_a_column_and_each_course_a_row() -> None:
    table = content([*WALKS, *THEIRS])
    assert list(table.headings) == ["course", OURS, BLIND, LOTRIET]
    rows = {row[0].partition(":")[0]: row[1:] for row in table.rows}
    assert rows["`flat`"][2] == ""
    assert rows["`ditch`"][0] == "98 of 100 (93 to 99 %)"
    assert rows["`ditch`"][1].startswith("0 of 10")
    assert rows["`ditch`"][2].startswith("0 of 5")
    assert f"0 to 4 of {LOTRIET}" in table.notes[0]


@pytest.mark.slow
def test_command_prints_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["trials", "table", str(DOCS / "campaign.jsonl"), "--of", "baselines"]) == 0
    assert f"| course | {OURS} | {BLIND} |" in capsys.readouterr().out
