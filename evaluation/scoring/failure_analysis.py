"""Failure analysis: the decisive moment of a run, and the events that led to it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.metrics.walk_metrics import Flags, runs
from sextant.evaluation.report import ARRIVED, Report
from sextant.evaluation.trace.status_log import SPEAKERS, StatusEvent
from sextant.evaluation.trace.trace import Trace
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import JOINTS, LEGS

ENDED = "ended"  # the moment of a run that nothing else decided
MISSED = 0.02  # [m] a touchdown at least this far from the chosen foothold missed it
_BEFORE = 4.0  # [s] before the moment in which signs are searched
_LAST = 0.5  # [s] before the end of the last step in which the planner may have begun to refuse the next one
_SIGNS = 6  # maximum number of signs reported
_STILL = 2.0  # [s] of standing after which a run counts as stopped before it ended
_OUTSIDE = 0.04  # [s] minimum duration of the centre of mass outside the support polygon
_SATURATED = 0.98  # [1] of the stall torque
_PULLING = 0.1  # [s] minimum duration at that torque
_LEANING = float(np.radians(10.0))  # [rad] from the commanded attitude
_SUNK = 0.02  # [m] below the commanded height
_LOST = 0.03  # [m] error of the estimate
_STALE = 1.0  # [s] after which an estimate is not used any more
_SILENT = 0.6  # [s] without a message after which a service counts as silent
_NONE = -1


@dataclass(frozen=True, slots=True)
class FailureMoment:
    """When and where the run was decided, and how."""

    t: float  # [s]
    p: Array  # (2,) [m] {start} body
    words: str  # what happened, in two or three words
    leg: int = _NONE  # the leg concerned


@dataclass(frozen=True, slots=True)
class Precursor:
    """An event before the decisive moment that may have caused the failure."""

    weight: int  # higher for events that more easily bring a walk down
    t: float  # [s]
    words: str
    leg: int = _NONE


def decisive_moment(report: Report, trace: Trace) -> FailureMoment | None:
    """Return the moment that decided that a run would not arrive.

    This is a fall, a shutdown, a collision, a refusal, or the last step before the robot stood still.
    Return None for a run that arrived, and for a run without data.
    """
    if not len(trace.t) or (report.success and report.reason == ARRIVED):
        return None
    if report.falls:
        return _moment(trace, float(trace.t[-1]), "fell", _suspect(trace, float(trace.t[-1])))
    if trace.shutdown.any():
        k = int(np.argmax(trace.shutdown.any(axis=(1, 2))))
        leg, joint = np.argwhere(trace.shutdown[k])[0].tolist()
        return _moment(trace, float(trace.t[k]), f"{LEGS[leg]} {JOINTS[joint]} shut down", leg)
    if report.collisions and trace.routes and not report.success:
        k = int(np.argmax(trace.in_the_way.any(axis=1)))
        part = int(np.argmax(trace.in_the_way[k]))
        return _moment(trace, float(trace.t[k]), "hit an obstacle", part if part < len(LEGS) else _NONE)
    refused = refusal(trace)
    if refused is not None:
        named = [leg for leg, name in enumerate(LEGS) if name in refused.words]
        leg = refused.leg if refused.leg >= 0 or len(named) != 1 else named[0]
        return _moment(trace, refused.begin, "stopped", leg)
    walked = np.flatnonzero(trace.walking)
    if len(walked) and trace.t[-1] - trace.t[walked[-1]] > _STILL:
        return _moment(trace, float(trace.t[walked[-1]]), "stopped")
    return _moment(trace, float(trace.t[-1]), ENDED)


def refusal(trace: Trace) -> StatusEvent | None:
    """Return why the planner did not go on after the last step, or None.

    Of several reasons, this is the one reported for the longest time. None means that it did not refuse.
    """
    walking = np.flatnonzero(trace.walking)
    stood = trace.t[walking[-1]] - _LAST if len(walking) else 0.0
    if not len(trace.t) or trace.t[-1] - stood < _STILL:
        return None
    held = [c for c in trace.complaints if c.who == "planner" and c.end > stood + _LAST]
    return max(held, key=lambda c: c.end - c.begin) if held else None


def signs(trace: Trace, moment: FailureMoment) -> list[Precursor]:
    """Return the most important signs before a moment, in order of time.

    Signs are missed footholds, lost support, joints at their limit, and the like.
    """
    begin, end = moment.t - _BEFORE, moment.t + 1e-6
    found = [*_of_feet(trace), *_of_body(trace, moment.t), *_of_joints(trace, begin, end), *_of_services(trace)]
    near = [sign for sign in found if begin <= sign.t <= end]
    weighty = sorted(near, key=lambda sign: (sign.weight, sign.t))[-_SIGNS:]
    return sorted(weighty, key=lambda sign: sign.t)


def _moment(trace: Trace, t: float, words: str, leg: int = _NONE) -> FailureMoment:
    k = min(int(np.searchsorted(trace.t, t)), len(trace.t) - 1)
    return FailureMoment(t, trace.p_true[k, :2], words, leg)


def _suspect(trace: Trace, t: float) -> int:
    """Return the leg with the last bad touchdown before a fall, or -1."""
    bad = [sign for sign in _of_feet(trace) if t - _BEFORE <= sign.t <= t]
    return max(bad, key=lambda sign: sign.t).leg if bad else _NONE


def missed_by(trace: Trace) -> Array:
    """Return the distance (k,) [m] of each touchdown from the chosen foothold.

    The estimate's error is subtracted. NaN where the chosen foothold or the estimated pose is unknown.
    """
    downs = trace.touchdowns
    drift = _drift(trace, downs.t)
    return np.asarray(np.linalg.norm(downs.p[:, :2] - downs.chosen[:, :2] - drift, axis=1))


def _drift(trace: Trace, t: Array) -> Array:
    """Return the true minus the estimated position (k, 2) [m] at the given times.

    Each uses the newest estimate; NaN where that is old.
    """
    if not len(trace.t_estimate) or not len(trace.t):
        return np.full((len(t), 2), np.nan)
    k = np.clip(np.searchsorted(trace.t_estimate, t, side="right") - 1, 0, None)
    then = trace.t_estimate[k]
    true = np.stack([np.interp(then, trace.t, trace.p_true[:, axis]) for axis in range(2)], axis=1)
    fresh = (then <= t) & (t - then < _STALE)
    return np.where(fresh[:, None], true - trace.p_estimate[k, :2], np.nan)


def _of_feet(trace: Trace) -> list[Precursor]:
    found = []
    downs, beside = trace.touchdowns, missed_by(trace)
    for t, leg, misstep, off in zip(downs.t, downs.leg, downs.misstep, beside, strict=True):
        where = f", {1000 * off:.0f} mm off the chosen foothold" if off > MISSED else ""
        if misstep:
            found.append(
                Precursor(4, float(t), f"{LEGS[leg]} foot touched down where the ground carries no foot{where}", int(leg))
            )
        elif where:
            found.append(Precursor(3, float(t), f"{LEGS[leg]} foot touched down{where.removeprefix(',')}", int(leg)))
    for t, leg in zip(trace.no_ground.t, trace.no_ground.leg, strict=True):
        found.append(Precursor(4, float(t), f"{LEGS[leg]} foot found no ground", int(leg)))
    return found


def _of_body(trace: Trace, t: float) -> list[Precursor]:
    found = []
    outside = _last_run(trace, trace.margin < 0, t, _OUTSIDE)
    if outside is not None:
        least = float(trace.margin[outside].min())
        found.append(Precursor(5, float(trace.t[outside.start]), f"the body left its support, by {-1000 * least:.0f} mm"))
    leaning = _last_run(trace, trace.tilt > _LEANING, t)
    if leaning is not None:
        words = f"the body tilted by {np.degrees(_LEANING):.0f} deg and more off its command"
        found.append(Precursor(4, float(trace.t[leaning.start]), words))
    low = _last_run(trace, trace.height_reference - trace.p_true[:, 2] > _SUNK, t)
    if low is not None:
        found.append(Precursor(2, float(trace.t[low.start]), f"the body sank {1000 * _SUNK:.0f} mm below its command"))
    known = trace.pose_error > _LOST
    if known.any():
        first = float(trace.t_estimate[int(np.argmax(known))])
        found.append(Precursor(2, first, f"the estimate was {1000 * _LOST:.0f} mm off"))
    for part in np.flatnonzero(trace.in_the_way.any(axis=0)):
        name = f"{LEGS[part]} foot" if part < len(LEGS) else "body"
        k = int(np.argmax(trace.in_the_way[:, part]))
        found.append(Precursor(5, float(trace.t[k]), f"the {name} hit an obstacle", int(part) if part < len(LEGS) else _NONE))
    return found


def _of_joints(trace: Trace, begin: float, end: float) -> list[Precursor]:
    found = []
    period = float(np.median(np.diff(trace.t))) if len(trace.t) > 1 else np.inf
    window = (trace.t >= begin) & (trace.t <= end)
    pulling = (trace.torque >= _SATURATED * trace.profile.servos.stall_torque) & window[:, None, None]
    for leg, joint in np.argwhere(pulling.any(axis=0)).tolist():
        longest = max(runs(pulling[:, leg, joint]), key=lambda run: run[1] - run[0])
        lasted = period * float(longest[1] - longest[0])
        if lasted >= _PULLING:
            name = f"{LEGS[leg]} {JOINTS[joint]}"
            found.append(Precursor(1, float(trace.t[longest[0]]), f"{name} at its highest torque for {lasted:.1f} s", leg))
    for leg, joint in np.argwhere(trace.shutdown.any(axis=0)).tolist():
        k = int(np.argmax(trace.shutdown[:, leg, joint]))
        found.append(Precursor(6, float(trace.t[k]), f"{LEGS[leg]} {JOINTS[joint]} shut down", leg))
    return found


def _of_services(trace: Trace) -> list[Precursor]:
    """Return signs for silent services.

    The last message of planner and actuator is compared with the end of the run.
    """
    found = []
    for who in SPEAKERS:
        own = [spell for spell in trace.spells if spell.who == who]
        # A service that never published is not silent.
        following = [spell.begin for spell in own[1:]] + [float(trace.t[-1])] * bool(own)
        found += [
            Precursor(5, spell.end, f"{who} stopped publishing")
            for spell, begin in zip(own, following, strict=True)
            if begin - spell.end > _SILENT
        ]
    return found


def _last_run(trace: Trace, flags: NDArray[np.bool_], t: float, least: float = 0.0) -> slice | None:
    """Return the last interval up to `t` where a flag held for at least `least` [s]."""
    held: Flags = np.asarray(flags & (trace.t <= t))
    long = [run for run in runs(held) if trace.t[run[1] - 1] - trace.t[run[0]] >= least]
    return slice(int(long[-1][0]), int(long[-1][1])) if long else None
