"""Score one injection: arrays in, numbers out.

A time is NaN if its event did not happen.
"""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, inf, nan

import numpy as np

from benchmarks.faults.bus_log import Goals, Role
from benchmarks.faults.cases import Case
from benchmarks.faults.timeline import STALE_S, Timeline, Truth, Word
from sextant.evaluation.metrics.walk_metrics import Flags, debounced, stability_margin
from sextant.evaluation.scoring.scorer import FALL_TILT_DEG
from sextant.evaluation.trace.status_log import kind_of
from sextant.services.actuator.safety.health_monitor import LATE
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import LEGS, RobotProfile
from sextant.shared.robot.stability import centre_of_mass
from sextant.shared.servo.servo_model import Recovery
from sextant.shared.wire.messages import Mode

_MARGIN_S = 3.0  # [s] in which the stability margin is evaluated
_STILL_S = 0.2  # [s] minimum time without motion of a robot at rest
_STILL = 0.02  # [m/s] of the body, and of each foot
_DOWN_BY = 0.010  # [m] above level ground: a foot below this is down, although it may hang if the body leans
_HANGING = 0.003  # [m] a foot this close above level ground supports the body after a tilt of one degree
_CYCLE_S = 0.02  # [s] period of the actuator
_SPRINGS_S = 0.2  # [s] interval for the speed of a joint
_SERVO = re.compile(r"servo of the (\w+ \w+) leg \(id (\d+)\)")  # in a sentence that names a servo that lies
_SOME_LEG = re.compile(r"((?:\w+ \w+ or )*\w+ \w+) leg: a horn")  # in one that names legs
_DEBOUNCE = 1  # samples of truth, 20 ms
_TWICE_S = 0.002  # [s] goals within this time belong to one cycle: they are sent twice while replies are lost
_MISSED_S = LATE * _CYCLE_S  # [s] a longer cycle counts as missed
_CLEARANCE = 0.005  # [m] a lower body underside is a fall, unless the robot was to lie down
_NOT_AS_PLANNED = re.compile("^(?!walking$)")  # reasons of a robot that walks, but stops or is about to
_STOOD_S = 1.0  # [s] of standing that has a reason
_DOWN = (Mode.OFF, Mode.SIT, Mode.READY)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one injection; times in seconds."""

    decided_s: float  # until the actuator reports that it stops
    named: bool  # whether it reported the reason
    rest_s: float  # until the robot stands still
    margin_m: float  # minimum stability margin over the three seconds after
    falls: int
    again_s: float  # until it walks again, from the fault's end
    jump_deg: float  # largest change of a joint, or of its goal, in 20 ms, from the fault's end until it walks again
    lunge_dps: float  # [deg/s] of a joint over 0.2 s, from the reset of its shutdown until the robot walks again; 0 without
    switched: bool  # whether the host sent a command that switches torque
    off_s: float  # until all reachable servos have received torque off; see `off_time`
    goals_before_off: int  # goals sent after the order, or the bus' return, and before torque off
    on_again: bool  # whether torque was ordered off, but a servo is enabled at the end
    stops: int  # number of stops
    seated_s: float  # until it sits with torque off
    cut_off: bool  # whether a servo shut down, or the battery was empty, before that
    outside: int  # goals outside the joints' limits
    plans: int  # number of fuzzed plans
    reason: str  # the actuator's reason for the last stop
    cycle_s: float = nan  # p99 of the interval between sync writes of goals during the fault
    missed: int = 0  # most cycles in a row that took more than one and a half periods
    lost_s: float = nan  # duration missing at the end of a recording, before its recorder was killed
    stuck: str = ""  # why it did not walk on afterwards, or empty
    goal_dps: float = nan  # [deg/s] of the fastest goal from one cycle to the next during the fault
    walked: int = 0  # minimum number of executed fuzzed plans
    named_s: float = nan  # until it named a servo or legs that lie, also as a warning
    named_as: str = ""  # how: "servo", "leg", "legs" with the right one among them, or "wrong"
    unnamed_margin_m: float = nan  # minimum stability margin until then
    misheard: bool = False  # whether a servo switched torque without a command: some corrupted bytes pass the checksum
    place_m: float = nan  # change of the error of the estimated position, on a course
    ended: str = ""  # "walks", "arrived", "stands" or "fell", on a course
    stood: tuple[str, ...] = ()  # reasons with which it stood for more than a second, on a course
    unnamed: str = ""  # the first of them that does not name the fault


def score(line: Timeline, case: Case, profile: RobotProfile) -> Outcome:
    """Compute the outcome of an injection."""
    since = [word for word in line.words if word.t_s > line.begin_s]
    pattern = re.compile(case.limits.named.format(servo=line.servo)) if case.limits.named else None
    decided = next((w.t_s for w in since if w.mode is not Mode.WALK or _names(pattern, w)), nan)
    # An actuator that is not received may have stopped; then only the plain reason shows that it walks again.
    away, stopping = (decided, pattern) if np.isfinite(decided) else (_unheard(line.words), _NOT_AS_PLANNED)
    again = _again(since, max(line.end_s, away), stopping) if np.isfinite(away) else nan
    quiet = (line.end_s, min(again - _CYCLE_S, line.words[-1].t_s))  # its state follows the first goals of the step
    reset = next((s.t_s for s in line.switches if s.heard and s.role is Role.RESET and s.t_s > line.begin_s), inf)
    # After another kind of reset, the host turns torque on.
    recovery = profile.servo_models.get(line.servo, profile.servo_model).recovery
    stays_s = inf if recovery is Recovery.TORQUE_LIMIT else reset
    stopped = [w for w in since if w.mode is not Mode.WALK]
    off_s, before = off_time(line)
    seated = next((w.t_s for w in since if w.mode is Mode.OFF), nan)
    switches = [s.heard for s in line.switches if s.role is Role.TORQUE and line.begin_s < s.t_s < stays_s]
    cycle_s, missed = cycles(line)
    stood = tuple(_stood(line))
    named_s, named_as = _name_of_lie(since, line.servo, profile) if case.lies else (nan, "")
    watched_s = case.for_s if case.lies else _MARGIN_S
    return Outcome(
        decided_s=decided - line.begin_s,
        named=any(_names(pattern, w) for w in since),
        rest_s=_at_rest(line.truth, decided, _broken_leg(line, profile), profile) - line.begin_s,
        margin_m=_margin(line.truth, line.begin_s, watched_s, profile),
        falls=int(_falls(line, profile)),
        again_s=again - line.end_s,
        jump_deg=_jump(line, *quiet, profile) if np.isfinite(away) else 0.0,
        lunge_dps=_fastest(line, reset, again if np.isfinite(again) else inf, profile),
        switched=not all(switches),
        off_s=off_s,
        goals_before_off=before,
        on_again=bool(np.isfinite(line.ordered_s) and line.pulls.any()),
        stops=_stops(line.words),
        seated_s=seated - line.begin_s,
        cut_off=_cut_off(line, seated),
        outside=len(line.outside),
        plans=line.plans,
        walked=line.walked,
        goal_dps=_goal_speed(line, profile),
        reason=stopped[-1].reason if stopped else "",
        lost_s=line.lost_s,
        stuck=line.stuck,
        cycle_s=cycle_s,
        missed=missed,
        named_s=named_s - line.begin_s,
        named_as=named_as,
        unnamed_margin_m=_margin(line.truth, line.begin_s, float(np.fmin(named_s - line.begin_s, watched_s)), profile),
        misheard=bool(switches) and all(switches),
        place_m=line.place_m,
        ended=line.ended,
        stood=stood,
        unnamed=next((words for words in stood if not re.search(case.limits.reasons, words)), ""),
    )


def _stood(line: Timeline) -> Iterator[str]:
    """Yield the planner's longest-lasting reason of each time that the robot stood for long, unless it had arrived."""
    since = nan
    for before, word in pairwise((*line.words, *line.words[-1:])):
        stands = before.mode is not Mode.WALK
        since = before.t_s if stands and np.isnan(since) else since if stands else nan
        over = word.mode is Mode.WALK or word is before
        if stands and over and word.t_s - since >= _STOOD_S:
            said = [s.reason for s in line.statuses if since <= s.t_s <= word.t_s and s.state in ("waiting", "blocked")]
            kinds = Counter(map(kind_of, said))
            if said or line.ended != "arrived":
                longest = max(kinds, key=kinds.__getitem__, default="")
                yield next((reason for reason in reversed(said) if kind_of(reason) == longest), "nothing was said")


def _names(pattern: re.Pattern[str] | None, word: Word) -> bool:
    return pattern is not None and pattern.search(word.reason) is not None


def _name_of_lie(since: list[Word], servo: int, profile: RobotProfile) -> tuple[float, str]:
    """Return when [s] a lie was named first, as a reason or a warning, and how; NaN and an empty string if it was not."""
    leg = LEGS[int(np.flatnonzero((profile.servo_ids == servo).any(axis=1))[0])]
    for word in since:
        for words in (word.reason, *word.warnings):
            one, some = _SERVO.search(words), _SOME_LEG.search(words)
            if one is not None:
                return word.t_s, "servo" if int(one[2]) == servo else "leg" if one[1] == leg else "wrong"
            if some is not None:
                legs = some[1].split(" or ")
                return word.t_s, "wrong" if leg not in legs else "leg" if len(legs) == 1 else "legs"
    return nan, ""


def _again(since: list[Word], after_s: float, stopping: re.Pattern[str] | None) -> float:
    """Return when it walks again, or NaN.

    A robot that reports why it stops does not count as walking.
    """
    return next((w.t_s for w in since if w.t_s > after_s and w.mode is Mode.WALK and not _names(stopping, w)), nan)


def _unheard(words: tuple[Word, ...]) -> float:
    """Return the time of the last message before the first gap, or NaN."""
    return next((before.t_s for before, word in pairwise(words) if word.t_s - before.t_s > STALE_S), nan)


def _stops(words: tuple[Word, ...]) -> int:
    walking = [word.mode is Mode.WALK for word in words]
    return sum(before and not now for before, now in pairwise(walking))


def off_time(line: Timeline) -> tuple[float, int]:
    """Return the time [s] until torque off at all servos, and the goals sent before.

    It counts from the order, or from when bus and actuator were available again, if later. Unreachable servos do not count,
    nor do the goals of the cycle in which the order arrives.
    """
    if not np.isfinite(line.ordered_s):
        return nan, 0
    begin = np.fmax(line.ordered_s, line.returned_s)
    offs = [s for s in line.switches if s.role is Role.TORQUE and not any(s.values.values()) and len(s.values) == 18]
    heard = next((s.t_s for s in offs if s.heard and s.t_s >= line.ordered_s), nan)
    sent = next((s.t_s for s in offs if not s.heard and s.t_s >= begin), inf)
    first = min(heard, sent) if np.isfinite(heard) else sent
    away = line.returned_s > line.ordered_s
    since = max(begin, line.ordered_s + _CYCLE_S)
    before = [goals for goals in line.goals if since < goals.t_s < first] if away else []
    return float(max(heard - begin, 0.0)), len(before)


def cycles(line: Timeline) -> tuple[float, int]:
    """Return the 99th percentile [s] of the cycle times, and the most missed in a row.

    Cycles are measured by the goals sent during the fault.
    """
    spans = np.diff([goals.t_s for goals in _cycle_goals(line)])
    if not len(spans):
        return nan, 0
    longest = max(len(run) for run in "".join("x" if span > _MISSED_S else " " for span in spans).split(" "))
    return float(np.sort(spans)[ceil(0.99 * len(spans)) - 1]), longest


def _cycle_goals(line: Timeline) -> list[Goals]:
    """Return the goals sent during the fault, one per cycle."""
    sent = [goals for goals in line.goals if line.begin_s <= goals.t_s <= line.end_s]
    apart = np.diff([goals.t_s for goals in sent], prepend=-inf) > _TWICE_S
    return [goals for goals, first in zip(sent, apart, strict=True) if first]


def _goal_speed(line: Timeline, profile: RobotProfile) -> float:
    """Return the speed [deg/s] of the fastest goal, without one tick of rounding.

    Cycles are taken as even, whenever their packets are sent.
    """
    sent = _cycle_goals(line)
    if len(sent) < 2:
        return nan
    beyond = np.abs(np.diff([goals.ticks for goals in sent], axis=0)) - 1
    took = _CYCLE_S * np.maximum(np.rint(np.diff([goals.t_s for goals in sent]) / _CYCLE_S), 1.0)
    return float(np.degrees(profile.servos.tick_rad.ravel() * beyond / took[:, None]).max(initial=0.0))


def carrying(truth: Truth, profile: RobotProfile) -> Flags:
    """Return the feet (n, 6) that support the body on level ground.

    Feet that would support it after a slight tilt are included.
    """
    low = truth.feet[..., 2] - profile.foot.radius < _HANGING
    return np.asarray(debounced(truth.contact, _DEBOUNCE) | low)


def _margin(truth: Truth, begin_s: float, length_s: float, profile: RobotProfile) -> float:
    rows = (truth.t >= begin_s) & (truth.t <= begin_s + length_s)
    if not rows.any():
        return nan
    body = truth.body[rows]
    centre = body[:, :3, 3] + (body[:, :3, :3] @ centre_of_mass(profile, truth.q[rows])[..., None])[..., 0]
    margin = stability_margin(truth.feet[rows, :, :2], carrying(truth, profile)[rows], centre[:, :2])
    return float(np.nanmin(margin)) if np.isfinite(margin).any() else nan


def _falls(line: Timeline, profile: RobotProfile) -> bool:
    truth = line.truth
    rows = truth.t >= line.begin_s
    tilted = truth.body[rows, 2, 2] < np.cos(np.radians(FALL_TILT_DEG))
    low = truth.body[rows, 2, 3] < profile.body.size[2] / 2 + _CLEARANCE
    may_lie = any(w.mode in _DOWN for w in line.words) or np.isfinite(line.ordered_s)
    return bool(tilted.any() or (low.any() and not may_lie))


def _broken_leg(line: Timeline, profile: RobotProfile) -> Flags:
    """Return the leg (6,) with the faulty servo: without torque, its foot may hang."""
    return np.asarray((profile.servo_ids == line.servo).any(axis=1))


def _at_rest(truth: Truth, decided_s: float, broken: Flags, profile: RobotProfile) -> float:
    """Return when the robot came to rest, or NaN.

    All feet are down and nothing moves for a while. The feet of broken legs (6,) may sink.
    """
    if not np.isfinite(decided_s) or len(truth.t) < 3:
        return nan
    down = truth.contact | broken | (truth.feet[..., 2] - profile.foot.radius < _DOWN_BY)
    still = down.all(axis=1) & (_speeds(truth.body[:, None, :3, 3], truth.t).max(axis=1) < _STILL)
    still &= _speeds(truth.feet[:, ~broken], truth.t).max(axis=1, initial=0.0) < _STILL
    samples = max(1, round(_STILL_S / float(np.median(np.diff(truth.t)))))
    for i in np.flatnonzero(still & (truth.t >= decided_s)).tolist():
        if i + samples <= len(still) and still[i : i + samples].all():
            return float(truth.t[i])
    return nan


def _speeds(points: Array, t: Array) -> Array:
    """Return speeds (n, k) [m/s] of points (n, k, 3), over two samples."""
    return np.asarray(np.linalg.norm(np.gradient(points, t, axis=0), axis=-1))


def _jump(line: Timeline, from_s: float, until_s: float, profile: RobotProfile) -> float:
    """Return the largest change [deg] of a joint in one sample, or between two goals.

    Goals of a faulty servo are excluded. If a goal has a moving speed, its change is limited to what the servo can reach until
    the next goal.
    """
    rows = (line.truth.t >= from_s) & (line.truth.t <= until_s)
    joints = np.degrees(np.abs(np.diff(line.truth.q[rows], axis=0))).max(initial=0.0)
    recent = [goals for goals in line.goals if goals.t_s <= until_s]
    first = max(sum(goals.t_s < from_s for goals in recent) - 1, 0)  # the goals before `from_s` are the current command
    ticks = np.array([goals.ticks for goals in recent[first:]]).reshape(-1, 18)
    speeds = np.array([goals.speeds for goals in recent[first:]]).reshape(-1, 18)
    speed_units = np.array([model.units.speed_rad_s for model in profile.servos.models])
    most = np.where(speeds > 0, speeds * speed_units * _CYCLE_S, np.inf)
    whole = profile.servo_ids.ravel() != line.servo
    goals = np.degrees(np.minimum(profile.servos.tick_rad.ravel() * np.abs(np.diff(ticks, axis=0)), most[1:]))[:, whole].max(
        initial=0.0
    )
    return float(max(joints, goals))


def _fastest(line: Timeline, from_s: float, until_s: float, profile: RobotProfile) -> float:
    """Return the highest speed [deg/s] of the reset joint over a fifth of a second.

    Over less time, the elastic motion of a loaded leg dominates.
    """
    rows = (line.truth.t >= from_s) & (line.truth.t <= until_s)
    t, q = line.truth.t[rows], line.truth.q[rows][:, profile.servo_ids == line.servo]
    if len(t) < 2 or not q.size:
        return 0.0
    apart = min(max(1, round(_SPRINGS_S / float(np.median(np.diff(t))))), len(t) - 1)
    way = np.abs(q[apart:] - q[:-apart]) / (t[apart:] - t[:-apart])[:, None]
    return float(np.degrees(way).max())


def _cut_off(line: Timeline, seated_s: float) -> bool:
    until = seated_s if np.isfinite(seated_s) else inf
    rows = (line.truth.t >= line.begin_s) & (line.truth.t <= until)
    return bool(line.truth.shutdown[rows].any() or line.empty_s <= until)
