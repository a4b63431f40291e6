"""Lotriet 2024, chapter 8: the walks over level ground, stairs and cobblestones, by his robot in the simulator."""

from dataclasses import replace
from typing import Any

import numpy as np

from sextant.evaluation.figures import walk_picture
from sextant.evaluation.figures.recorded_run import RecordedRun
from sextant.evaluation.figures.thesis_figures import TESTS, Measured, Published
from sextant.evaluation.theses.data import Data
from sextant.evaluation.theses.stills import draw_stills, stills
from sextant.evaluation.trace.trace import Trace

_THESIS = "#1a7f37"  # lines of the thesis' numbers
_SHARES = (0.05, 0.35, 0.65, 0.95)  # [1] of the walk, at which its pictures are
_SINCE = "simulated time since the first step [s]"


def trace_of(run: RecordedRun) -> Trace:
    """Return the trace of a run, whose time begins with the first step."""
    return replace(run.trace, t=run.trace.t - run.begin)


def draw_pictures(figure: Any, data: Data, scenario: str) -> list[str]:
    """Draw figures 8.1, 8.3 and 8.5: the robot along its walk."""
    run = data.run(scenario)
    last = float(run.trace.t[run.trace.walking][-1])
    times = [run.begin + share * (last - run.begin) for share in _SHARES]
    pictures = stills(data.recording(scenario), scenario, data.seed, times, (480, 360))
    draw_stills(figure.subplots(2, 2).ravel(), pictures, [f"{t - run.begin:.0f} s" for t in times])
    return []


def draw_walk(figure: Any, data: Data, scenario: str) -> list[str]:
    """Draw figures 8.2 and 8.4: body height, tilt and one foot."""
    run, published = data.run(scenario), TESTS[scenario]
    trace = trace_of(run)
    height, tilt, foot = figure.subplots(3, 1)
    _draw_height(height, trace, published)
    _draw_tilt(tilt, trace, published)
    walk_picture.draw_one_foot(foot, trace, walk_picture.steadiest_leg(trace))
    foot.set_ylabel("height [cm]")
    _legend(foot, 2)
    return _values(published, Measured.of(run.trace))


def draw_height_and_tilt(figure: Any, data: Data, scenario: str) -> list[str]:
    """Draw figure 8.7: body height and tilt."""
    run, published = data.run(scenario), TESTS[scenario]
    trace = trace_of(run)
    height, tilt = figure.subplots(2, 1)
    _draw_height(height, trace, published)
    _draw_tilt(tilt, trace, published)
    return _values(published, Measured.of(run.trace))


def draw_feet(figure: Any, data: Data, scenario: str) -> list[str]:
    """Draw figure 8.6: the feet from above and from the side."""
    trace = trace_of(data.run(scenario))
    above, aside = figure.subplots(2, 1, height_ratios=(1.6, 1.0))
    walk_picture.draw_from_above(above, trace)
    walk_picture.draw_from_aside(aside, trace)
    above.set_ylabel("left [m]")
    aside.set_ylabel("height [cm]")
    _legend(aside, 6)
    return []


def _draw_height(axes: Any, trace: Trace, published: Published) -> None:
    walk_picture.draw_height(axes, trace)
    if published.height_error_m is not None:
        level = 100 * (trace.height_reference + published.height_error_m)
        axes.plot(trace.t, level, color=_THESIS, lw=1.2, ls="--", label="with the thesis' constant error")
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, float(np.nanmin(level)) - 0.5), high)
    _legend(axes, 3)
    axes.tick_params(labelbottom=False)


def _draw_tilt(axes: Any, trace: Trace, published: Published) -> None:
    walk_picture.draw_tilt(axes, trace)
    for limit, style, label in ((published.tilt_deg, "--", "thesis: mostly"), (published.jumps_deg, ":", "thesis: jumps")):
        for sign in (-1, 1) if limit is not None else ():
            axes.axhline(sign * (limit or 0.0), color=_THESIS, lw=1.2, ls=style, label=label if sign > 0 else None)
    axes.set_xlabel(_SINCE)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.65 * (high - low))
    _legend(axes, 3)


def _legend(axes: Any, columns: int) -> None:
    """Draw a legend that takes no part in the layout."""
    axes.legend(loc="upper left", ncols=columns, columnspacing=1.0, handlelength=1.4, fontsize=7.5).set_in_layout(False)


def _values(published: Published, measured: Measured) -> list[str]:
    """Return our values of the numbers that the thesis gives, in the order of `printed`."""
    values = (
        (published.height_error_m, f"{1e3 * measured.height_error_m:.1f} mm"),
        (published.oscillation_m, f"{1e3 * measured.oscillation_m:.1f} mm"),
        (published.tilt_deg, f"{measured.tilt_deg:.2f} deg (95 % of the time)"),
        (published.jumps_deg, f"{measured.jumps_deg:.2f} deg"),
        (published.stride_m, f"{1e2 * measured.stride_m:.1f} cm"),
        (published.step_height_m, f"{1e2 * measured.step_height_m:.1f} cm"),
    )
    return [here for there, here in values if there is not None]


def printed(scenario: str) -> list[tuple[str, str]]:
    """Return the numbers that the text of a walk's section gives."""
    published = TESTS[scenario]
    rows = (
        ("body height error, mean", published.height_error_m, 1e3, "mm", "about "),
        ("body height oscillation, amplitude", published.oscillation_m, 1e3, "mm", "below "),
        ("roll and pitch, mostly", published.tilt_deg, 1.0, "deg", "below "),
        ("roll and pitch, jumps", published.jumps_deg, 1.0, "deg", "approach "),
        ("stride", published.stride_m, 1e2, "cm", "about "),
        ("step height", published.step_height_m, 1e2, "cm", "about "),
    )
    return [(what, f"{word}{scale * value:.3g} {unit}") for what, value, scale, unit, word in rows if value is not None]
