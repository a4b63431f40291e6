"""Layers of the elevation map's circular buffer."""

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

ESTABLISHED = 3  # scans after which a height counts as the first seen height of the ground


@dataclass(frozen=True, slots=True, eq=False)
class CellLayers:
    """Layers (nx, ny) in the order of the buffer."""

    height: NDArray[np.float32]  # [m] current estimate, NaN where never seen
    variance: NDArray[np.float32]  # [m^2] of the height
    support: NDArray[np.uint8]  # scans that agree with it, at most 255
    assumed: NDArray[np.uint8]  # 1 where it is a seeded plane without a measurement
    rival: NDArray[np.float32]  # [m] another measured height
    rival_variance: NDArray[np.float32]  # [m^2] of the rival
    votes: NDArray[np.uint8]  # scans for the rival minus scans against it
    first: NDArray[np.float32]  # [m] the height when it was established, NaN before
    through: NDArray[np.uint8]  # scans with a ray through the cell since its last measurement
    fell: NDArray[np.uint8]  # 1 where an object was cleared
    face: NDArray[np.uint8]  # 1 where a face was seen, up to the height at least
    below: NDArray[np.uint8]  # one bit for each side of a face on which lower ground was seen since the face was last seen

    @classmethod
    def unseen(cls, shape: tuple[int, int]) -> Self:
        """Create a buffer with every cell unseen."""
        # np.full, not np.zeros: the first access to a memory page inside the hot loop would be slow.
        measured: Any = {name: np.full(shape, np.nan, dtype=np.float32) for name in _MEASURED}
        counted: Any = {f.name: np.full(shape, 0, dtype=np.uint8) for f in fields(cls) if f.name not in _MEASURED}
        return cls(**measured, **counted)

    def forget(self, axis: int, first: int, number: int) -> None:
        """Make rows (axis 0) or columns (axis 1) unseen; they wrap around at the border.

        Layers that the first measurement overwrites are not reset.
        """
        n = self.height.shape[axis]
        for begin, end in ((first, min(first + number, n)), (0, first + number - n)):
            lines: Any = slice(begin, end) if axis == 0 else (slice(None), slice(begin, end))
            if begin < end:
                self.height[lines] = self.variance[lines] = self.first[lines] = np.nan
                self.assumed[lines] = self.fell[lines] = 0


_MEASURED = ("height", "variance", "rival", "rival_variance", "first")
