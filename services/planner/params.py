"""Parameters of footholds."""

from dataclasses import dataclass

from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class FootholdParams(Params):
    """Which of the cells that carry a foot suit best."""

    room_m: float = ranged(0.01, 0.0, 0.1)  # [m] around a good foothold that also carries; nine of ten feet land within it
    firm_m: float = ranged(0.03, 0.0, 0.3)  # [m] from the ground's end, from where Masri's evaluation function is good
