"""Arrays of geometric primitives that make up terrain, robot and movers."""

from dataclasses import dataclass

import numpy as np

from sextant.shared.geometry import Array


@dataclass(frozen=True, slots=True)
class Boxes:
    """Oriented boxes."""

    centre: Array  # (n, 3) [m] {world}
    half: Array  # (n, 3) [m] half edge lengths
    R: Array  # (n, 3, 3) rotations R_world_box

    def __post_init__(self) -> None:
        n = len(self.centre)
        if self.centre.shape != (n, 3) or self.half.shape != (n, 3) or self.R.shape != (n, 3, 3):
            raise ValueError(
                f"(n, 3), (n, 3), (n, 3, 3) expected, found {self.centre.shape}, {self.half.shape}, {self.R.shape}"
            )
        if not np.all(self.half > 0):
            raise ValueError(f"boxes with positive edges expected, found half an edge of {self.half.min()} m")

    def __len__(self) -> int:
        return len(self.centre)


@dataclass(frozen=True, slots=True)
class Capsules:
    """Cylinders with hemispherical ends; a capsule with equal ends is a sphere."""

    start: Array  # (n, 3) [m] {world} centre of the first hemisphere
    end: Array  # (n, 3) [m] {world} centre of the second hemisphere
    radius: Array  # (n,) [m]

    def __post_init__(self) -> None:
        n = len(self.radius)
        if self.start.shape != (n, 3) or self.end.shape != (n, 3) or self.radius.shape != (n,):
            raise ValueError(f"(n, 3), (n, 3), (n,) expected, found {self.start.shape}, {self.end.shape}, {self.radius.shape}")

    def __len__(self) -> int:
        return len(self.radius)


@dataclass(frozen=True, slots=True)
class HeightField:
    """Grid of ground heights.

    Each cell is two triangles that share the diagonal from (i, j) to (i + 1, j + 1).
    """

    heights: Array  # (nx, ny) [m] {world}, rows along x
    resolution: float  # [m] grid spacing
    origin: tuple[float, float]  # [m] {world} position of grid point (0, 0)

    def __post_init__(self) -> None:
        if self.heights.ndim != 2 or min(self.heights.shape) < 2:
            raise ValueError(f"a grid of at least 2x2 heights expected, found {self.heights.shape}")
        if not np.all(np.isfinite(self.heights)):
            raise ValueError("finite heights expected, found NaN or infinity")
        if not self.resolution > 0:
            raise ValueError(f"positive resolution expected, found {self.resolution} m")

    def height_at(self, xy: Array) -> Array:
        """Return heights (n,) [m] at points (n, 2) [m] {world}; -inf outside the field."""
        nx, ny = self.heights.shape
        u, v = ((xy - np.array(self.origin)) / self.resolution).T
        inside = (u >= 0) & (u <= nx - 1) & (v >= 0) & (v <= ny - 1)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        i, j = np.minimum(u.astype(np.intp), nx - 2), np.minimum(v.astype(np.intp), ny - 2)
        u, v = u - i, v - j
        z = self.heights
        near, far = z[i, j], z[i + 1, j + 1]
        lower = near + u * (z[i + 1, j] - near) + v * (far - z[i + 1, j])
        upper = near + v * (z[i, j + 1] - near) + u * (far - z[i, j + 1])
        return np.where(inside, np.where(u >= v, lower, upper), -np.inf)
