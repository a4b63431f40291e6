"""A walk over time in strips: states and complaints, and quantities with limits."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.scoring.failure_analysis import FailureMoment
from sextant.evaluation.scoring.scorer import FALL_TILT_DEG
from sextant.evaluation.trace.status_log import SPEAKERS, StatusEvent, kind_of
from sextant.evaluation.trace.trace import Trace

TRUE, ESTIMATE, REFERENCE, BAD, MUTED = "#111111", "#d01c8b", "#7f7f7f", "#b3261e", "#5f6368"
_BLUE, _ORANGE = "#0072b2", "#d55e00"
_STATES = {  # of all services: pale for normal states, red for faults
    "stepping": "#bcd9c6",
    "walk": "#bcd9c6",
    "registered": "#bcd9c6",
    "arrived": "#5fa777",
    "resting": "#dfe5ea",
    "stand": "#dfe5ea",
    "hold": "#dfe5ea",
    "ready": "#dfe5ea",
    "sit": "#dfe5ea",
    "off": "#c3c7cb",
    "waiting": "#f5d98b",
    "legs alone": "#f5d98b",
    "blocked": "#ea9a8f",
    "fault": "#d9534a",
}
_OTHER = "#c9c3dd"
_CHARACTER = 0.0062  # [1] width of a state's letter, as a share of the figure's
_CURVES = 5
_GAP_S = 0.5  # [s] gap in the estimate that interrupts the line
_TOLD = 5  # complaints that are shown as text
_AFTERWARDS = 1.0  # [s] complaints this long after the decisive moment still belong to it
_BESIDE = 0.028  # [1] distance of two flags, as a share of the strip's width


def draw(
    figure: Any,
    box: tuple[float, float, float, float],
    trace: Trace,
    moment: FailureMoment | None,
    color: str,
    told: Sequence[StatusEvent],
    truth: bool = True,
) -> None:
    """Draw the strips into a part of a figure.

    Args:
        figure: Matplotlib figure.
        box: Left, bottom, width and height [1] of the figure.
        trace: The run.
        moment: The decisive moment, marked in all strips.
        color: Colour of that mark.
        told: Complaints that are shown as text elsewhere, numbered from 1.
        truth: Whether the "true" values are ground truth; else they are the robot's measurements.
    """
    left, bottom, width, height = box
    gap = 0.016 * 12 / figure.get_figheight()
    words = 0.19 * height
    row = (height - words - _CURVES * gap) / _CURVES
    top = figure.add_axes((left, bottom + height - words, width, words))
    _said(top, trace, told, width)
    rows = [figure.add_axes((left, bottom + k * (row + gap), width, row)) for k in reversed(range(_CURVES))]
    for axes, curve in zip(rows, (_height, _tilt, _margin, _torque, _pose_error), strict=True):
        curve(axes, trace)
    if not truth:
        for text in rows[0].get_legend().get_texts():
            text.set_text(text.get_text().replace("true", "by the legs"))
    end = max(float(trace.t[-1]) if len(trace.t) else 1.0, 1e-3)
    for axes in (top, *rows):
        axes.set_xlim(0.0, end)
        if moment is not None:
            axes.axvline(moment.t, color=color, lw=2.0, zorder=6)
        if axes is not top:
            axes.grid(alpha=0.25)
            for begin, until in walked(trace):
                axes.axvspan(begin, until, color=_BLUE, alpha=0.06, lw=0)
        if axes is not rows[-1]:
            axes.tick_params(labelbottom=False)
    rows[-1].set_xlabel("simulated time [s]", labelpad=2)
    if moment is not None:
        late = moment.t > 0.5 * end
        place: dict[str, Any] = {"textcoords": "offset points", "xycoords": ("data", "axes fraction"), "annotation_clip": False}
        words_at = f"{moment.words}, {moment.t:.1f} s"
        style = {"color": color, "weight": "bold", "size": 12, "ha": "right" if late else "left", "va": "bottom"}
        top.annotate(words_at, (moment.t, 1.0), (4, 3), **place, **style)


# -- states


def _said(axes: Any, trace: Trace, told: Sequence[StatusEvent], width: float) -> None:
    """Draw a line of states per service, with flags at its complaints.

    Complaints that are shown as text have their number.
    """
    axes.set_ylim(-0.55, len(SPEAKERS) - 0.4)
    axes.set_yticks(range(len(SPEAKERS)), SPEAKERS[::-1], size=12)
    axes.tick_params(axis="y", length=0)
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(axis="x", length=0)
    end = max(float(trace.t[-1]) if len(trace.t) else 1.0, 1e-3)
    row = {who: len(SPEAKERS) - 1 - k for k, who in enumerate(SPEAKERS)}
    for spell in trace.spells:
        y, begin, until = row[spell.who], max(spell.begin, 0.0), min(spell.end, end)
        if until <= begin:
            continue
        axes.broken_barh([(begin, until - begin)], (y - 0.36, 0.72), color=_STATES.get(spell.state, _OTHER), lw=0)
        if (until - begin) / end * width > _CHARACTER * (len(spell.state) + 1):
            axes.text(begin + 0.004 * end, y, spell.state, size=11, va="center", color="#222222", clip_on=True)
    for complaint in trace.complaints:
        y = row[complaint.who]
        axes.plot([complaint.begin] * 2, [y - 0.36, y + 0.36], color=BAD, lw=1.6, zorder=3)
    for who, y in row.items():
        own = [(number, complaint.begin) for number, complaint in enumerate(told, 1) if complaint.who == who]
        after = -np.inf
        for k, (number, begin) in enumerate(own):
            last = end - _BESIDE * end * (len(own) - 1 - k)  # leaves room for the flags after it
            at = max(min(begin, last), after + _BESIDE * end)
            flag(axes, (at, y), str(number))
            after = at


def flag(axes: Any, at: tuple[float, float], number: str) -> None:
    """Draw a flag with the number, or numbers, of complaints."""
    axes.annotate(
        number,
        at,
        ha="center",
        va="center",
        size=10,
        weight="bold",
        color="white",
        zorder=10,
        annotation_clip=False,
        bbox={"boxstyle": "round,pad=0.22,rounding_size=0.75", "fc": BAD, "ec": "white", "lw": 0.8},
    )


def told_in_words(trace: Trace, moment: FailureMoment | None) -> list[StatusEvent]:
    """Return the complaints to show as text, in order of time.

    Each kind appears once. Complaints near the decisive moment take precedence, then those of the planner, perception and
    actuator in this order, then newer ones.
    """
    latest = moment.t + _AFTERWARDS if moment is not None else np.inf
    kinds: dict[tuple[str, str], StatusEvent] = {}
    for complaint in trace.complaints:
        if complaint.begin <= latest:
            kinds[complaint.who, kind_of(complaint.words)] = complaint
    weight = {"actuator": 0, "perception": 1, "planner": 2}
    told = sorted(kinds.values(), key=lambda c: (c.begin >= latest - 2 * _AFTERWARDS, weight[c.who], c.begin))[-_TOLD:]
    return sorted(told, key=lambda c: c.begin)


# -- quantities


def _height(axes: Any, trace: Trace) -> None:
    axes.plot(trace.t, 100 * trace.height_reference, color=REFERENCE, lw=2.5, label="commanded")
    axes.plot(trace.t, 100 * trace.p_true[:, 2], color=TRUE, lw=1.2, label="true")
    if len(trace.t_estimate):
        axes.plot(
            *_broken(trace.t_estimate, 100 * trace.p_estimate[:, 2]), color=ESTIMATE, lw=1.0, ls=(0, (4, 2)), label="estimated"
        )
    zoom(axes, [100 * trace.height_reference, 100 * trace.p_true[:, 2]], least=2.0)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 0.93), ncols=3, frameon=False, fontsize=11, borderaxespad=0.0)
    axes.set_ylabel("body\nheight [cm]", size=11)


def _tilt(axes: Any, trace: Trace) -> None:
    axes.plot(trace.t, np.degrees(trace.tilt), color=_BLUE, lw=1.2)
    zoom(axes, [np.degrees(trace.tilt)], least=1.0, floor=0.0)
    _limit(axes, FALL_TILT_DEG, "a fall: {:.0f}°")
    axes.set_ylabel("tilt off\ncommand [°]", size=11)


def _margin(axes: Any, trace: Trace) -> None:
    axes.plot(trace.t, 1000 * trace.margin, color="#1b7f79", lw=1.0)
    zoom(axes, [1000 * trace.margin], least=20.0)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -5.0), high)
    _limit(axes, 0.0, "tips over: {:.0f} mm")
    axes.set_ylabel("stability\nmargin [mm]", size=11)


def _torque(axes: Any, trace: Trace) -> None:
    axes.plot(trace.t, trace.torque_worst, color=_ORANGE, lw=0.9)
    stall = float(trace.profile.servos.stall_torque.max())
    axes.set_ylim(0.0, 1.25 * stall)
    _limit(axes, stall, "stall: {:.2g} N m")
    axes.set_ylabel("highest\ntorque [N m]", size=11)


def _pose_error(axes: Any, trace: Trace) -> None:
    axes.plot(*_broken(trace.t_estimate, 1000 * trace.pose_error), color=ESTIMATE, lw=1.2)
    zoom(axes, [1000 * trace.pose_error], least=10.0, floor=0.0)
    axes.set_ylabel("pose\nerror [mm]", size=11)
    if not np.isfinite(trace.pose_error).any():
        axes.set_yticks([])
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", va="center", color=MUTED)


def _broken(t: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Insert NaN into a curve at long gaps, so that its line is interrupted."""
    at = np.flatnonzero(np.diff(t) > _GAP_S) + 1
    return np.insert(t, at, np.nan), np.insert(values, at, np.nan)


def _limit(axes: Any, value: float, words: str) -> None:
    """Draw a limit as a line, or as an arrow if it lies outside the axes."""
    low, high = axes.get_ylim()
    style: dict[str, Any] = {"color": BAD, "size": 11, "ha": "right"}
    if low <= value <= high:
        axes.axhline(value, color=BAD, lw=1.2, ls=":")
        above = value < high - 0.19 * (high - low)
        place = axes.annotate(words.format(value), (1.0, value), xycoords=("axes fraction", "data"), **style)
        place.set_va("bottom" if above else "top")
    else:
        axes.annotate(
            words.format(value) + (" ↑" if value > high else " ↓"), (1.0, 0.96), xycoords="axes fraction", va="top", **style
        )


def zoom(axes: Any, curves: list[NDArray[np.float64]], least: float, floor: float | None = None) -> None:
    """Set limits that show nearly all of the curves.

    Outliers, as of a fall, would otherwise hide the walk.
    """
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    if not len(values):
        return
    low, high = np.percentile(values, [0.5, 99.5]).tolist()
    low = low if floor is None else floor
    spare = max(least - (high - low), 0.0) / 2 + 0.08 * (high - low)
    axes.set_ylim(low - (spare if floor is None else 0.0), high + (spare if floor is None else 2 * spare))


def walked(trace: Trace) -> list[tuple[float, float]]:
    """Return the intervals [s] of walking; pauses below half a second do not count."""
    walking = np.flatnonzero(trace.walking)
    if not len(walking):
        return []
    breaks = np.flatnonzero(np.diff(trace.t[walking]) > 0.5)
    begins = walking[np.concatenate([[0], breaks + 1])]
    ends = walking[np.concatenate([breaks, [len(walking) - 1]])]
    return list(zip(trace.t[begins].tolist(), trace.t[ends].tolist(), strict=True))
