"""What came of one injection: arrays in, numbers out. A time is NaN where what it is of did not happen."""

import re
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, inf, nan

import numpy as np

from sextant.deploy.faults.cases import Case
from sextant.deploy.faults.timeline import STALE_S, Timeline, Truth, Word
from sextant.deploy.faults.wire import Goals
from sextant.deploy.judging.scorer import FALL_TILT_DEG
from sextant.deploy.judging.walk_metrics import Flags, debounced, stability_margin
from sextant.services.actuator.safety.health_monitor import LATE
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.stability import centre_of_mass
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.wire.messages import Mode

_MARGIN_S = 3.0  # [s] over which the stability margin is looked at
_STILL_S = 0.2  # [s] for which a robot that is at rest has been so
_STILL = 0.02  # [m/s] of the body, and of each foot
_DOWN_BY = 0.010  # [m] over level ground: a foot of a body that leans may hang, and is down
_HANGING = 0.003  # [m] a foot so far over level ground catches the body after a degree of tilt
_CYCLE_S = 0.02  # [s] of the actuator
_SPRINGS_S = 0.2  # [s]
_DEBOUNCE = 1  # samples of truth, 20 ms
_TWICE_S = 0.002  # [s] within which goals are those of one cycle: they are sent twice while answers get lost
_MISSED_S = LATE * _CYCLE_S  # [s] what takes a cycle longer has missed a beat
_CLEARANCE = 0.005  # [m] the body's underside this near the ground is a fall, unless it was to come down
_NOT_AS_PLANNED = re.compile("^(?!walking$)")  # reasons of one that walks, but stops or is about to
_DOWN = (Mode.OFF, Mode.SIT, Mode.READY)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of one injection; times in seconds."""

    decided_s: float  # until the actuator says that it stops
    named: bool  # whether it has said why
    rest_s: float  # until the robot stands still
    margin_m: float  # least stability margin over the three seconds after
    falls: int
    again_s: float  # until it walks again, from the fault's end on
    jump_deg: float  # largest change of a joint, or of its goal, in 20 ms, from the fault's end until it walks again
    lunge_dps: float  # [deg/s] of a joint over 0.2 s, from the reset of its shutdown until the robot walks again; 0 without
    switched: bool  # whether the host sent that torque be switched
    off_s: float  # until all servos that hear have heard that torque is off; see `off_time`
    goals_before_off: int  # sent after the order, or the bus' return, and before torque was
    on_again: bool  # whether torque was ordered off and yet a servo pulls in the end
    stops: int  # times that it stopped
    seated_s: float  # until it has lain down and let go
    cut_off: bool  # whether a servo shut down, or the battery was empty, before that
    outside: int  # goals outside of the joints' limits
    plans: int  # fuzzed
    reason: str  # of the last stop, in the actuator's words
    cycle_s: float = nan  # p99 of the time from one sync write of goals to the next, while the fault lasted
    missed: int = 0  # most cycles in a row that took more than a period and a half
    lost_s: float = nan  # of a recording, before its recorder was killed
    stuck: str = ""  # why it did not walk on for long afterwards, in words, or nothing
    goal_dps: float = nan  # [deg/s] of the fastest goal from one cycle to the next, while the fault lasted
    walked: int = 0  # of the fuzzed plans, at least
    misheard: bool = False  # whether a servo heard so though nobody had sent it: of broken bytes, some pass its checksum


def score(line: Timeline, case: Case, profile: RobotProfile) -> Outcome:
    """What came of an injection."""
    since = [word for word in line.words if word.t_s > line.begin_s]
    pattern = re.compile(case.limits.named.format(servo=line.servo)) if case.limits.named else None
    decided = next((w.t_s for w in since if w.mode is not Mode.WALK or _names(pattern, w)), nan)
    # Who is not heard may have stopped; then only plain words say that it walks again.
    away, stopping = (decided, pattern) if np.isfinite(decided) else (_unheard(line.words), _NOT_AS_PLANNED)
    again = _again(since, max(line.end_s, away), stopping) if np.isfinite(away) else nan
    quiet = (line.end_s, min(again - _CYCLE_S, line.words[-1].t_s))  # it says that it walks after the first goals of the step
    reset = next((s.t_s for s in line.switches if s.heard and s.register == dxl.TORQUE_LIMIT and s.t_s > line.begin_s), inf)
    stopped = [w for w in since if w.mode is not Mode.WALK]
    off_s, before = off_time(line)
    seated = next((w.t_s for w in since if w.mode is Mode.OFF), nan)
    switches = [s.heard for s in line.switches if s.register == dxl.TORQUE_ENABLE and s.t_s > line.begin_s]
    cycle_s, missed = cycles(line)
    return Outcome(
        decided_s=decided - line.begin_s,
        named=any(_names(pattern, w) for w in since),
        rest_s=_at_rest(line.truth, decided, _broken_leg(line, profile), profile) - line.begin_s,
        margin_m=_margin(line.truth, line.begin_s, profile),
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
        goal_dps=_goal_speed(line),
        reason=stopped[-1].reason if stopped else "",
        lost_s=line.lost_s,
        stuck=line.stuck,
        cycle_s=cycle_s,
        missed=missed,
        misheard=bool(switches) and all(switches),
    )


def _names(pattern: re.Pattern[str] | None, word: Word) -> bool:
    return pattern is not None and pattern.search(word.reason) is not None


def _again(since: list[Word], after_s: float, stopping: re.Pattern[str] | None) -> float:
    """When it walks again, NaN where it does not; one that says why it stops is not there yet."""
    return next((w.t_s for w in since if w.t_s > after_s and w.mode is Mode.WALK and not _names(stopping, w)), nan)


def _unheard(words: tuple[Word, ...]) -> float:
    """Since when nothing was heard of it, NaN where there were always words."""
    return next((before.t_s for before, word in pairwise(words) if word.t_s - before.t_s > STALE_S), nan)


def _stops(words: tuple[Word, ...]) -> int:
    walking = [word.mode is Mode.WALK for word in words]
    return sum(before and not now for before, now in pairwise(walking))


def off_time(line: Timeline) -> tuple[float, int]:
    """How long [s] it took until all servos heard that torque is off, and how many goals were sent before.

    From the order on; or from when bus and actuator were there again, if later. A servo that does not hear does not count.
    """
    if not np.isfinite(line.ordered_s):
        return nan, 0
    begin = np.fmax(line.ordered_s, line.returned_s)
    offs = [s for s in line.switches if s.register == dxl.TORQUE_ENABLE and not any(s.values.values()) and len(s.values) == 18]
    heard = next((s.t_s for s in offs if s.heard and s.t_s >= line.ordered_s), nan)
    sent = next((s.t_s for s in offs if not s.heard and s.t_s >= begin), inf)
    first = min(heard, sent) if np.isfinite(heard) else sent
    away = line.returned_s > line.ordered_s
    before = [goals for goals in line.goals if begin < goals.t_s < first] if away else []
    return float(max(heard - begin, 0.0)), len(before)


def cycles(line: Timeline) -> tuple[float, int]:
    """How long [s] 99 % of the cycles took at most while the fault lasted, by the goals sent, and most missed in a row."""
    spans = np.diff([goals.t_s for goals in _cycle_goals(line)])
    if not len(spans):
        return nan, 0
    longest = max(len(run) for run in "".join("x" if span > _MISSED_S else " " for span in spans).split(" "))
    return float(np.sort(spans)[ceil(0.99 * len(spans)) - 1]), longest


def _cycle_goals(line: Timeline) -> list[Goals]:
    """What was sent while the fault lasted, once of each cycle."""
    sent = [goals for goals in line.goals if line.begin_s <= goals.t_s <= line.end_s]
    apart = np.diff([goals.t_s for goals in sent], prepend=-inf) > _TWICE_S
    return [goals for goals, first in zip(sent, apart, strict=True) if first]


def _goal_speed(line: Timeline) -> float:
    """Speed [deg/s] of the fastest goal, a tick of rounding left out; cycles are even, whenever in them a packet is sent."""
    sent = _cycle_goals(line)
    if len(sent) < 2:
        return nan
    beyond = np.abs(np.diff([goals.ticks for goals in sent], axis=0)) - 1
    took = _CYCLE_S * np.maximum(np.rint(np.diff([goals.t_s for goals in sent]) / _CYCLE_S), 1.0)
    return float(np.degrees(dxl.TICK_RAD * beyond / took[:, None]).max(initial=0.0))


def carrying(truth: Truth, profile: RobotProfile) -> Flags:
    """Feet (n, 6) that carry on level ground, or would as soon as the body leaned on them."""
    low = truth.feet[..., 2] - profile.foot.radius < _HANGING
    return np.asarray(debounced(truth.contact, _DEBOUNCE) | low)


def _margin(truth: Truth, begin_s: float, profile: RobotProfile) -> float:
    rows = (truth.t >= begin_s) & (truth.t <= begin_s + _MARGIN_S)
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
    """The leg (6,) whose servo is broken: where that is limp, the foot may hang."""
    return np.asarray((profile.servo_ids == line.servo).any(axis=1))


def _at_rest(truth: Truth, decided_s: float, broken: Flags, profile: RobotProfile) -> float:
    """When all feet but those of broken legs (6,), which may sink, were down, and nothing else moved any more, for a while."""
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
    """Speeds (n, k) [m/s] of points (n, k, 3), over two samples."""
    return np.asarray(np.linalg.norm(np.gradient(points, t, axis=0), axis=-1))


def _jump(line: Timeline, from_s: float, until_s: float, profile: RobotProfile) -> float:
    """Largest change [deg] of a joint in one sample, or of its goal from one to the next, but of a broken servo.

    A goal that goes with a moving speed is as far as the servo gets at that speed until the next.
    """
    rows = (line.truth.t >= from_s) & (line.truth.t <= until_s)
    joints = np.degrees(np.abs(np.diff(line.truth.q[rows], axis=0))).max(initial=0.0)
    recent = [goals for goals in line.goals if goals.t_s <= until_s]
    first = max(sum(goals.t_s < from_s for goals in recent) - 1, 0)  # the last before is where the servos are told to be
    ticks = np.array([goals.ticks for goals in recent[first:]]).reshape(-1, 18)
    speeds = np.array([goals.speeds for goals in recent[first:]]).reshape(-1, 18)
    most = np.where(speeds > 0, speeds * dxl.SPEED_RAD_S * _CYCLE_S, np.inf)
    whole = profile.servo_ids.ravel() != line.servo
    goals = np.degrees(np.minimum(dxl.TICK_RAD * np.abs(np.diff(ticks, axis=0)), most[1:]))[:, whole].max(initial=0.0)
    return float(max(joints, goals))


def _fastest(line: Timeline, from_s: float, until_s: float, profile: RobotProfile) -> float:
    """Speed [deg/s] of the joint that is reset over any fifth of a second: for less than that a loaded leg springs back."""
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
