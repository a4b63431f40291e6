"""Inventory of Lotriet's figures and tables."""

from functools import partial

from sextant.evaluation.theses import lotriet_walks as walks
from sextant.evaluation.theses.inventory import Entry, Thesis, numbers

LOTRIET = Thesis(
    "lotriet",
    "A. P. Lotriet, Foot Placement Planning of a Hexapod Robot Moving Over Uneven Terrain, Stellenbosch 2024",
    (
        Entry(
            "8.2",
            "level ground: body height, tilt and one foot",
            partial(walks.draw_walk, scenario="lotriet_flat"),
            printed=numbers(*walks.printed("lotriet_flat")),
            walks=("lotriet_flat",),
            size=(7.0, 5.4),
            ours="walk over `lotriet_flat`",
        ),
    ),
)
