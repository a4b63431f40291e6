"""Walking tests of Lotriet 2024, chapter 8, compared with a run.

The data behind his plots are not available, so the values are those that the text of sections 8.1 to 8.3 reports.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType

import numpy as np

from sextant.evaluation.trace.trace import Trace


@dataclass(frozen=True, slots=True)
class Published:
    """Reported values of one test; None where the text gives no figure."""

    section: str
    height_error_m: float | None = None  # constant, of the body
    oscillation_m: float | None = None  # largest amplitude of the body height
    tilt_deg: float | None = None  # roll and pitch mostly stay below this
    jumps_deg: float | None = None  # they occasionally approach this
    stride_m: float | None = None  # from touchdown to touchdown
    step_height_m: float | None = None


TESTS: Mapping[str, Published] = MappingProxyType(
    {
        "lotriet_flat": Published("8.1", -0.010, 0.009, 0.5, None, 0.15, 0.10),
        "lotriet_stairs": Published("8.2", -0.010, None, 1.0, 2.0, 0.15, None),
        "lotriet_organic": Published("8.3", -0.010, None, 1.0, 2.0, 0.15, None),  # "more severe" than these, without figures
    }
)


@dataclass(frozen=True, slots=True)
class Measured:
    """The same quantities of a run, while walking."""

    height_error_m: float
    oscillation_m: float  # half the range from the 2.5th to the 97.5th percentile of the height error
    tilt_deg: float  # 95th percentile of the larger of roll and pitch, against level
    jumps_deg: float  # the largest
    off_command_deg: float  # 95th percentile, against the commanded attitude
    stride_m: float  # median
    step_height_m: float  # median, above the higher of both ends

    @staticmethod
    def of(trace: Trace) -> "Measured":
        """Measure a run that has walked."""
        walking = trace.walking
        off = (trace.p_true[:, 2] - trace.height_reference)[walking]
        low, high = np.nanpercentile(off, [2.5, 97.5])
        tilt = np.degrees(np.abs(trace.attitude[walking]).max(axis=1))
        strides, heights = _steps(trace)
        return Measured(
            height_error_m=float(np.nanmean(off)),
            oscillation_m=float(high - low) / 2,
            tilt_deg=float(np.percentile(tilt, 95)),
            jumps_deg=float(tilt.max()),
            off_command_deg=float(np.degrees(np.percentile(trace.tilt[walking], 95))),
            stride_m=float(np.median(strides)) if strides else np.nan,
            step_height_m=float(np.median(heights)) if heights else np.nan,
        )


def side_by_side(published: Published, measured: Measured) -> list[tuple[str, str, str]]:
    """Return rows of name, thesis and run; a dash where the thesis gives no figure."""
    rows = (
        ("body height error, mean", published.height_error_m, measured.height_error_m, 1e3, "mm"),
        ("height oscillation, amplitude", published.oscillation_m, measured.oscillation_m, 1e3, "mm"),
        ("tilt, mostly below (95 %)", published.tilt_deg, measured.tilt_deg, 1.0, "deg"),
        ("tilt, jumps", published.jumps_deg, measured.jumps_deg, 1.0, "deg"),
        ("tilt off the command (95 %)", None, measured.off_command_deg, 1.0, "deg"),
        ("stride", published.stride_m, measured.stride_m, 1e2, "cm"),
        ("step height", published.step_height_m, measured.step_height_m, 1e2, "cm"),
    )
    return [
        (name, "-" if theirs is None else f"{scale * theirs:.3g} {unit}", f"{scale * ours:.2f} {unit}")
        for name, theirs, ours, scale, unit in rows
    ]


def _steps(trace: Trace) -> tuple[list[float], list[float]]:
    """Return step lengths, and step heights above the higher end, all [m]."""
    downs = trace.touchdowns
    strides, heights = [], []
    for leg in range(6):
        mine = np.flatnonzero(downs.leg == leg)
        for before, after in pairwise(mine):
            begin, end = np.searchsorted(trace.t, [downs.t[before], downs.t[after]])
            strides.append(float(np.linalg.norm((downs.p[after] - downs.p[before])[:2])))
            heights.append(float(trace.feet[begin : end + 1, leg, 2].max() - max(downs.p[before, 2], downs.p[after, 2])))
    return strides, heights
