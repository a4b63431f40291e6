"""Chart of timings.

The length of a method's bar is its time relative to that of Sextant.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.peers.timing import Timing, machine_in_words
from sextant.shared.files import whole_files

_WIDTH, _DPI, _FONT = 12.0, 100, 11
_BAR, _GAP, _HEAD = 0.30, 0.42, 1.1  # [inch] height of a bar, of the gap between two groups, and of the title
_OURS, _PEER, _PART = "#2a7f62", "#8fa3b5", ("#2a7f62", "#58a882", "#93c7ad", "#c5d9cf", "#8fa3b5", "#b9c5d0", "#dde3e8")


def draw(
    path: Path, title: str, timings: Sequence[Timing], missing: Sequence[str], parts: Mapping[str, float] | None = None
) -> None:
    """Write the chart.

    Args:
        path: Output file; its suffix determines the format.
        title: Title of the chart.
        timings: Timings of all methods; jobs with only one method are not drawn.
        missing: Methods that were not measured, as text.
        parts: Times [ms] that make up a total, drawn as one bar below.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    jobs: dict[tuple[str, str], list[Timing]] = {}
    for timing in timings:
        jobs.setdefault((timing.stage, timing.case), []).append(timing)
    jobs = {job: rows for job, rows in jobs.items() if len(rows) > 1}
    bars = sum(len(rows) for rows in jobs.values())
    tall = _BAR * bars + _GAP * len(jobs)
    below = 1.7 if parts else 0.0
    height = _HEAD + tall + 0.7 + below + 0.25 * len(missing)
    with rc_context({"font.size": _FONT, "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, facecolor="white")
        figure.text(0.02, 1 - 0.35 / height, title, size=16, weight="bold", va="center")
        words = f"{machine_in_words()}; bars: median of the time relative to Sextant, lines: 10th to 90th percentile"
        figure.text(0.02, 1 - 0.75 / height, words, size=_FONT, color="#444444", va="center")
        bottom = (0.7 + below + 0.25 * len(missing)) / height
        if jobs:
            _draw_ratios(figure.add_axes((0.30, bottom, 0.66, tall / height)), jobs)
        if parts:
            axes = figure.add_axes((0.30, (0.85 + 0.25 * len(missing)) / height, 0.66, 0.45 / height))
            _draw_parts(axes, parts)
        for k, line in enumerate(missing):
            figure.text(0.02, (0.12 + 0.25 * k) / height, f"not measured: {line}", size=10, color="#444444")
        whole_files.write_by_name(path, figure.savefig)


def _draw_ratios(axes: Any, jobs: Mapping[tuple[str, str], list[Timing]]) -> None:
    y, ticks, names = 0.0, [], []
    reach = max(t.ratio.p90 for rows in jobs.values() for t in rows)
    for (stage, case), rows in jobs.items():
        axes.text(
            -0.02, y + 0.62, f"{stage}, {case}", transform=axes.get_yaxis_transform(), weight="bold", ha="right", va="center"
        )
        y += _GAP / _BAR
        for t in rows:
            r = t.ratio
            axes.barh(y, r.median, height=0.8, color=_OURS if t.method.startswith(rows[0].method) else _PEER)
            axes.plot([r.p10, r.p90], [y, y], color="#222222", linewidth=1.2, marker="|", markersize=7)
            axes.text(1.08 * max(r.p90, 1.0), y, f"{r.median:.3g} x   {t.ms.median:.3g} ms", va="center", size=10)
            ticks.append(y)
            names.append(t.method)
            y += 1.0
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlim(min(0.5, *(0.8 * t.ratio.p10 for rows in jobs.values() for t in rows)), 4.5 * reach)
    axes.set_ylim(y - 0.4, 0.0)
    axes.set_yticks(ticks, names)
    axes.tick_params(axis="y", length=0)
    axes.axvline(1.0, color="#222222", linewidth=0.8)
    axes.set_xlabel("time relative to Sextant")


def _draw_parts(axes: Any, parts: Mapping[str, float]) -> None:
    at = 0.0
    for k, (name, ms) in enumerate(parts.items()):
        axes.barh(0, ms, left=at, color=_PART[k % len(_PART)], label=f"{name} {ms:.2f}")
        at += ms
    axes.set_yticks([0], [f"frame to layers\n{at:.2f} ms"])
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel("ms")
    axes.legend(loc="lower left", bbox_to_anchor=(-0.25, 1.0), ncols=6, frameon=False, fontsize=9, columnspacing=1.2)
