"""Masri 2016, chapter 6: the three layouts, the maps, the crossings and the planning times."""

from typing import Any

from sextant.evaluation.theses import planner_table
from sextant.evaluation.theses.data import Data


def draw_table(figure: Any, data: Data) -> list[str]:
    """Draw Table 6.1: his printed numbers, his planner here, and ours."""
    table = planner_table.content(*data.planned())
    axes = figure.subplots()
    axes.set_axis_off()
    rows = [[cell.strip("`") for cell in row] for row in table.rows]
    drawn = axes.table(
        [list(table.headings), *rows],
        loc="center",
        cellLoc="left",
        edges="horizontal",
        colWidths=(0.09, 0.23, 0.19, *3 * (0.163,)),
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(7.5)
    for (row, _), cell in drawn.get_celld().items():
        cell.set_height(1.0 / (len(rows) + 1))
        cell.set_linewidth(0.9 if row == 0 or (row - 1) % 6 == 5 else 0.15)
        if row == 0:
            cell.get_text().set_weight("bold")
    axes.set_title(table.notes[0], fontsize=7.5, y=-0.06)
    return []
