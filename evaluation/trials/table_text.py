"""Tables of text as Markdown, CSV or LaTeX.

A cell may hold names in backticks, which Markdown shows as code; LaTeX sets them in typewriter type, CSV leaves them plain.
"""

import csv
import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

_CODE = re.compile(r"`([^`]*)`")
_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "–": "--",
    **{character: f"\\{character}" for character in "&%$#_{}"},
}


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text with notes below it."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()


def markdown(table: Table) -> str:
    """Format a table in Markdown; its notes are lines below it."""
    lines = [f"| {' | '.join(cells)} |" for cells in table.rows]
    head = [f"| {' | '.join(table.headings)} |", "|---" * len(table.headings) + "|"]
    return "\n".join([*head, *lines, "", *table.notes]) + "\n"


def comma_separated(table: Table) -> str:
    """Format a table as CSV (RFC 4180) without its notes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([_CODE.sub(r"\1", cell) for cell in cells] for cells in (table.headings, *table.rows))
    return text.getvalue()


def latex(table: Table) -> str:
    """Format a table as a LaTeX tabular with the rules of booktabs; its notes are comments."""
    head, *rows = [" & ".join(map(_in_latex, cells)) + r" \\" for cells in (table.headings, *table.rows)]
    columns = "l" + "r" * (len(table.headings) - 1)
    return (
        "\n".join(
            [
                r"% \usepackage{booktabs}",
                *(f"% {note}" for note in table.notes),
                rf"\begin{{tabular}}{{{columns}}}",
                r"\toprule",
                head,
                r"\midrule",
                *rows,
                r"\bottomrule",
                r"\end{tabular}",
            ]
        )
        + "\n"
    )


def _in_latex(cell: str) -> str:
    """Return a cell with LaTeX's special characters escaped."""
    plain_and_code = _CODE.split(cell)  # every second part is code
    escaped = ["".join(_LATEX.get(character, character) for character in part) for part in plain_and_code]
    return "".join(rf"\texttt{{{part}}}" if k % 2 else part for k, part in enumerate(escaped))


FORMATS: Mapping[str, Callable[[Table], str]] = {"markdown": markdown, "csv": comma_separated, "latex": latex}
