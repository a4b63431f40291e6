"""Parameters of the control of body height, roll and pitch."""

from dataclasses import dataclass

from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class PostureParams(Params):
    """Integrator that commands each standing foot lower where the body sags."""

    gain: float = ranged(6.0, 0.0, 50.0)  # [1/s] of the integrator that holds height, roll and pitch
    limit_m: float = ranged(0.025, 0.0, 0.1)  # [m] by which a foot is commanded lower at most
    release_s: float = ranged(0.1, 0.01, 5.0)  # [s] time constant in which the offset of an unloaded foot decays
