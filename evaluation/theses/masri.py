"""Inventory of Masri's figures and tables."""

from sextant.evaluation.theses import masri_crossings as crossings
from sextant.evaluation.theses.inventory import Entry, Thesis

MASRI = Thesis(
    "masri",
    "D. Masri, Terrain Modeling and Motion Planning for Hexapod Walking Robot Control, CTU Prague 2016",
    (
        Entry(
            "Table 6.1", "planning in three scenarios", crossings.draw_table, size=(7.6, 3.9), ours="plans on the true ground"
        ),
    ),
)
