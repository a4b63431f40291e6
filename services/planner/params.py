"""Parameters of footholds."""

from dataclasses import dataclass

from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class FootholdParams(Params):
    """Which cells of the map carry a foot, and which of them suit best."""

    max_score: float = ranged(1.0, 0.05, 10.0)  # [1] highest score of a cell that carries a foot; Lotriet 2024, section 6.4
    room_m: float = ranged(0.01, 0.0, 0.1)  # [m] around a good foothold that also carries; nine of ten feet land within it
    firm_m: float = ranged(0.03, 0.0, 0.3)  # [m] from the ground's end, from where Masri's evaluation function is good
