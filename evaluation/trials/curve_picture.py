"""Picture of difficulty curves: success rate above, outcome of the walks below."""

import textwrap
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sextant.evaluation.trials.curve import Curve, causes
from sextant.shared.files import whole_files

_COLORS = ("#0072b2", "#8a6d00")  # with a map, without one
_REACHED, _OTHER = "#cfe3d6", "#b9bec4"
_CAUSES = ("#d55e00", "#56b4e9", "#cc79a7", "#e6c229", "#7a5195")  # of failures, the most frequent first
_MUTED, _LIMIT = "#5f6368", "#b3261e"
_SIZE_IN = (7.0, 6.0)
_FINE = 200  # points of the fitted curves
_WIDEST = 0.08  # [1] of the range of values: width of a bar
_WRAP = 62  # [characters] of a line of the legend


def draw_curves(curves: Sequence[Curve], stem: Path) -> None:
    """Draw curves of one family, the first with its outcomes, as STEM.png and STEM.svg.

    The same curves give the same SVG, byte for byte.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    look: Any = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "sextant"}
    with rc_context(look):
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for curve, color in zip(curves, _COLORS, strict=False):
            _success(above, curve, color, alone=len(curves) == 1)
        _legs(above, curves[0])
        _outcomes(below, curves[0])
        first = curves[0]
        family, n = first.family.family, first.points[0].trials.success.n
        unit = f" [{family.unit}]" if family.unit else ""
        below.set_xlabel(f"{family.parameter}{unit}")
        above.set_title(f"{family.about}: {first.robot}, {n} walks a point", fontsize=10, loc="left")
        if first.points[0].value > first.points[-1].value:
            below.invert_xaxis()  # difficulty rises to the right
        whole_files.make_folder(stem.parent)
        whole_files.write_by_name(stem.with_suffix(".svg"), partial(figure.savefig, metadata={"Date": None}))
        whole_files.write_by_name(stem.with_suffix(".png"), partial(figure.savefig, dpi=200))


def _success(axes: Any, curve: Curve, color: str, alone: bool) -> None:
    """Draw the success rates with Wilson's intervals, the fit with its band, and where success falls to half."""
    scale = curve.family.family.scale
    values = np.array([point.value for point in curve.points])
    rates = [point.trials.success for point in curve.points]
    fine = np.linspace(values[0], values[-1], _FINE)
    fit = curve.fit(fine.tolist())
    name = "without a map" if curve.points[0].trials.blind else "with a map"
    axes.fill_between(scale * fine, fit.low, fit.high, color=color, alpha=0.13, lw=0)
    axes.plot(scale * fine, fit.rate, color=color, lw=1.6, label="logistic fit, 95 % band" if alone else name)
    bars = [[max(rate.rate - rate.low, 0.0) for rate in rates], [max(rate.high - rate.rate, 0.0) for rate in rates]]
    label = "success rate, 95 % interval" if alone else None
    axes.errorbar(
        scale * values, [rate.rate for rate in rates], yerr=bars, fmt="o", ms=4.5, lw=1.0, capsize=2.5, color=color, label=label
    )
    middle, low, high = (scale * value for value in fit.half)
    ends = sorted((scale * values[0], scale * values[-1]))
    if ends[0] <= middle <= ends[1]:
        axes.plot([max(low, ends[0]), min(high, ends[1])], [0.5, 0.5], color="#111111", lw=2.2, solid_capstyle="butt", zorder=4)
        label = f"half at {middle:.3g} ({low:.3g} to {high:.3g}) {curve.family.family.unit}".rstrip()
        axes.plot(middle, 0.5, "D", ms=5.5, color="#111111", markerfacecolor="white", zorder=5, label=label)
    axes.axhline(0.5, color=_MUTED, lw=0.6, ls=(0, (4, 4)), zorder=0)
    axes.set_ylim(-0.04, 1.04)
    axes.set_ylabel("goal reached [share]")


def _legs(axes: Any, curve: Curve) -> None:
    """Draw the limit of the legs as a line."""
    if curve.legs is not None:
        at = curve.family.family.scale * curve.legs.passed
        axes.axvline(at, color=_LIMIT, lw=1.2, ls="--", label=f"the legs alone pass {at:.3g} {curve.family.family.unit}")
    axes.legend(frameon=False, fontsize=8, loc="best")


def _outcomes(axes: Any, curve: Curve) -> None:
    """Draw the shares of walks that reached the goal, and of each cause of failure."""
    scale = curve.family.family.scale
    values = scale * np.array([point.value for point in curve.points])
    width = min(0.62 * float(np.abs(np.diff(values)).min()), _WIDEST * float(np.ptp(values)))
    found = [causes(point.trials) for point in curve.points]
    total: Counter[str] = sum((Counter(one) for one in found), Counter())
    named = [cause for cause, _ in total.most_common(len(_CAUSES))]
    shares = {"goal reached": np.array([point.trials.success.rate for point in curve.points])}
    for cause in named:
        shares[cause] = np.array([one.get(cause, 0) / p.trials.success.n for one, p in zip(found, curve.points, strict=True)])
    rest = 1.0 - np.sum(list(shares.values()), axis=0)
    if np.any(rest > 1e-9):
        shares["other causes"] = rest
    bottom = np.zeros(len(values))
    for (name, share), color in zip(shares.items(), (_REACHED, *_CAUSES[: len(named)], _OTHER), strict=False):
        axes.bar(values, share, width, bottom, color=color, label=textwrap.fill(name, _WRAP), edgecolor="white", lw=0.5)
        bottom = bottom + share
    axes.set_ylim(0.0, 1.0)
    axes.set_ylabel("walks [share]")
    axes.legend(frameon=False, fontsize=7.5, loc="upper left", bbox_to_anchor=(0.0, -0.26), handlelength=1.0, labelspacing=0.3)
