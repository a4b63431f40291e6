"""Tables as Markdown, CSV and LaTeX have the same cells."""

import csv
import io
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.deploy import cli
from sextant.evaluation.trials import results_store
from sextant.evaluation.trials.campaign_table import TABLES, content, of_runs
from sextant.evaluation.trials.passage_table import content as sections
from sextant.evaluation.trials.table_text import Table, comma_separated, latex, markdown

DOCS = Path(__file__).parents[4] / "docs"
WALKS = results_store.read(DOCS / "campaign.jsonl")
cells = st.text(st.characters(min_codepoint=32, max_codepoint=126, exclude_characters="`"), max_size=12)


def plain(cell: str) -> str:
    return cell.replace("`", "")


@given(st.lists(st.tuples(cells, cells, cells), min_size=1, max_size=5))
def test_csv_reads_back_as_written(rows: list[tuple[str, str, str]]) -> None:
    text = comma_separated(Table(("a", "`b`", "c"), rows, ("a note",)))
    assert [tuple(row) for row in csv.reader(io.StringIO(text, newline=""))] == [("a", "b", "c"), *rows]


@given(st.lists(st.tuples(cells, cells), min_size=1, max_size=5))
def test_latex_escapes_whatever_a_cell_holds(rows: list[tuple[str, str]]) -> None:
    lines = latex(Table(("a", "b"), rows)).splitlines()
    for line in lines[lines.index(r"\midrule") + 1 : lines.index(r"\bottomrule")]:
        bare = re.sub(r"\\text[a-z]+\{\}|\\[&%$#_{}]", "", line.removesuffix(r" \\"))
        assert bare.count("&") == 1, "one column separator that is not escaped"
        assert not set(bare) & set("%$#_{}~^\\")


@pytest.mark.parametrize("name", TABLES)
def test_formats_of_a_campaign_have_the_same_cells(name: str) -> None:
    table = content(of_runs(WALKS), name)
    read = list(csv.reader(io.StringIO(comma_separated(table))))
    assert read == [[plain(cell) for cell in row] for row in (table.headings, *table.rows)]
    assert [f"| {' | '.join(row)} |" for row in table.rows] == markdown(table).splitlines()[2 : 2 + len(table.rows)]
    assert latex(table).count(r" \\") == 1 + len(table.rows)


def test_intervals_in_latex_are_those_of_markdown() -> None:
    text = latex(content(of_runs(WALKS), "reached"))
    assert r"\texttt{ditch}: 8 to 12 cm wide & 98 of 100 (93 to 99 \%) & 0 of 10 (0 to 28 \%) \\" in text
    assert r"\texttt{stepping\_stones}" in text
    assert [text.count(rule) for rule in (r"\toprule", r"\midrule", r"\bottomrule")] == [1, 1, 1]


@pytest.mark.slow
def test_table_command_prints_each_format(capsys: pytest.CaptureFixture[str]) -> None:
    passages = results_store.read(DOCS / "passages.jsonl")
    for name, form in (("markdown", markdown), ("csv", comma_separated), ("latex", latex)):
        reached = content(of_runs(passages), "reached", seeds=name == "csv")
        for of, table in (("reached", reached), ("sections", sections(passages))):
            words = ["trials", "table", str(DOCS / "passages.jsonl"), "--of", of, "--format", name]
            assert cli.main(words) == 0
            assert capsys.readouterr().out == form(table).rstrip("\n") + "\n"


def test_table_command_prints_selected_columns(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["trials", "table", str(DOCS / "by_touch.jsonl"), "--columns", "seeds,tilt p95", "--format", "csv"]) == 0
    assert capsys.readouterr().out == 'terrain,seeds,"tilt p95, deg"\nnight,0 to 99,1.84 (3.90)\n'


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--columns", "tilt"], "no column 'tilt'; did you mean 'tilt p95'?"),
        (["--columns", "falls", "--json"], "one of --json and --columns expected, found both"),
        (["--format", "tex"], "--format: unknown 'tex'"),
        (["--format", "csv", "--json"], "one of --json and --format csv expected, found both"),
    ],
)
def test_wrong_format_is_refused(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["trials", "table", str(DOCS / "campaign.jsonl"), *words]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1
