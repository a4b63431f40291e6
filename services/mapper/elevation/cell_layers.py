"""What the height map keeps of each cell of its circular buffer."""

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

ESTABLISHED = 3  # scans behind a height, after which it counts as where the ground was first seen


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Layers (nx, ny) in the order of the buffer."""

    height: NDArray[np.float32]  # [m] believed in, NaN where never seen
    variance: NDArray[np.float32]  # [m^2] of it
    support: NDArray[np.uint8]  # scans behind it, at most 255
    assumed: NDArray[np.uint8]  # 1 where it is a seeded plane and nothing was measured yet
    rival: NDArray[np.float32]  # [m] another height that was measured
    rival_variance: NDArray[np.float32]  # [m^2] of that
    votes: NDArray[np.uint8]  # scans for the rival less scans against it
    first: NDArray[np.float32]  # [m] the height as it was established, NaN before
    through: NDArray[np.uint8]  # scans that looked through the cell since it was last measured
    fell: NDArray[np.uint8]  # 1 where something stood that is gone
    face: NDArray[np.uint8]  # 1 where a face was seen, which is at least so high
    below: NDArray[np.uint8]  # of a face, a bit for each side on which ground was seen below it since it last was seen

    @classmethod
    def unseen(cls, shape: tuple[int, int]) -> Self:
        """A buffer of which nothing is known."""
        # np.full, not np.zeros: pages that are touched for the first time inside the hot loop are slow.
        measured: Any = {name: np.full(shape, np.nan, dtype=np.float32) for name in _MEASURED}
        counted: Any = {f.name: np.full(shape, 0, dtype=np.uint8) for f in fields(cls) if f.name not in _MEASURED}
        return cls(**measured, **counted)

    def forget(self, axis: int, first: int, number: int) -> None:
        """Make rows (axis 0) or columns (1) unseen, which go on at the buffer's border with its other side.

        What a first measurement overwrites anyway is left as it is.
        """
        n = self.height.shape[axis]
        for begin, end in ((first, min(first + number, n)), (0, first + number - n)):
            lines: Any = slice(begin, end) if axis == 0 else (slice(None), slice(begin, end))
            if begin < end:
                self.height[lines] = self.variance[lines] = self.first[lines] = np.nan
                self.assumed[lines] = self.fell[lines] = 0


_MEASURED = ("height", "variance", "rival", "rival_variance", "first")
