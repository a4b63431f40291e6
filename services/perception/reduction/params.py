"""Parameters of the reduction of frames to scans."""

from dataclasses import dataclass

from sextant.shared.files.config import ranged
from sextant.shared.params import Params


@dataclass(frozen=True, slots=True)
class ReductionParams(Params):
    """Which of the pixels of a cell give its height where they belong to several surfaces."""

    jump_m: float = ranged(0.015, 0.0, 0.5)  # [m] depth step over two pixels, beyond noise and slope, between two surfaces
    surface_m: float = ranged(0.010, 0.0, 0.5)  # [m] height, beyond noise, within which points belong to the same surface
    noise_sigmas: float = ranged(3.0, 0.0, 20.0)  # [sigma] of the depth noise, added to both
    carrying_share: float = ranged(0.3, 0.0, 1.0)  # [1] share of pixels below which an upper surface is an adjacent cell's edge
    face_m: float = ranged(0.03, 0.0, 1.0)  # [m] from the lowest pixel to a lower surface's mean, from which it is a tall face
    rim_pixels: float = ranged(3.0, 0.0, 100.0)  # minimum number of pixels that show the height of a face
