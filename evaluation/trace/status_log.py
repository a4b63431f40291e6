"""The services' own reports in a run: their states, refusals and complaints."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from sextant.evaluation.trace.run_log import RunLog
from sextant.shared.robot.profile import LEGS
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode, PlannerStatus

Speaker = Literal["planner", "actuator", "perception"]
SPEAKERS: tuple[Speaker, ...] = ("planner", "actuator", "perception")

_SILENT = 1.0  # [s] without a message after which a service's state ends
_ROUTINE = "plan of step # does not follow step #"  # from a plan that crossed the end of a step in transit
# First words of the reasons for waiting.
_LACKING = ("no fresh", "the robot's pose", "the actuator is in mode", "the terrain map", "by touch: no pose")
_LONG = 0.3  # [s] minimum duration of a planner's wait or stop that matters


@dataclass(frozen=True, slots=True)
class StatusInterval:
    """An interval in which a service reported one state."""

    who: Speaker
    state: str
    begin: float  # [s]
    end: float  # [s] the state changed, or the service went silent


@dataclass(frozen=True, slots=True)
class StatusEvent:
    """A service's reason for not going on, with the interval in which it was reported."""

    who: Speaker
    begin: float  # [s]
    end: float  # [s]
    words: str  # the newest wording: its numbers may change in the meantime
    leg: int = -1  # the leg that has no foothold


_FIGURE = re.compile(r"[-+]?\d+(\.\d+)?")
_LEGS = re.compile(r"({0})((, | and )({0}))*".format("|".join(LEGS)))

Word = tuple[float, str, int]  # time [s], reason, leg


def spells(heard: RunLog) -> tuple[StatusInterval, ...]:
    """Return the states of a run's services, in sequence for each service."""
    found: list[StatusInterval] = []
    for who in SPEAKERS:
        states = [(_seconds(heard, message.stamp_ns), _state(message)) for message in _of(heard, who)]
        for k, (t, state) in enumerate(states):
            following = states[k + 1][0] if k + 1 < len(states) else t
            end = following if following - t < _SILENT else t
            if found and found[-1].who == who and found[-1].state == state and t <= found[-1].end:
                found[-1] = StatusInterval(who, state, found[-1].begin, end)
            else:
                found.append(StatusInterval(who, state, t, end))
    return tuple(found)


def complaints(heard: RunLog) -> tuple[StatusEvent, ...]:
    """Return refusals and complaints of a run in order of time.

    Reasons that differ only in their numbers count as one.
    """
    begun = _seconds(heard, heard.first_step_ns) if heard.first_step_ns is not None else float("inf")
    statuses = [(_seconds(heard, status.stamp_ns), status) for status in heard.statuses]
    planner = _together("planner", ((t, *_refusal(status, t > begun)) for t, status in statuses))
    said = [c for c in planner if c.end - c.begin >= _LONG]
    timed = [(_seconds(heard, state.stamp_ns), state) for state in heard.states]
    said += [c for c in _together("actuator", ((t, s.plan_refusal, -1) for t, s in timed)) if kind_of(c.words) != _ROUTINE]
    said += _together("actuator", ((t, state.reason if state.mode is Mode.FAULT else "", -1) for t, state in timed))
    said += _together("actuator", ((t, "; ".join(state.warnings), -1) for t, state in timed))
    poses = [(_seconds(heard, pose.stamp_ns), pose) for pose in heard.poses]
    said += _together("perception", ((t, "" if pose.ok else pose.reason, -1) for t, pose in poses))
    return tuple(sorted(said, key=lambda c: c.begin))


def last_reason(heard: RunLog, since_s: float) -> str:
    """Return the service that stopped the walk last, `since_s` [s] or later, with its reason, or "".

    The service is the planner or the actuator: the one with the newest complaint.
    """
    found = [c for c in complaints(heard) if c.who != "perception" and c.end >= since_s]
    if not found:
        return ""
    last = max(found, key=lambda complaint: complaint.end)
    begin, end = f"{last.begin:.0f}", f"{last.end:.0f}"
    return f"{last.who}, {f'at {end}' if begin == end else f'{begin} to {end}'} s: {last.words}"


def _seconds(heard: RunLog, stamp_ns: int) -> float:
    return (stamp_ns - heard.begin_ns) * 1e-9


def _of(heard: RunLog, who: Speaker) -> Sequence[PlannerStatus | ActuatorState | BodyPose]:
    said: dict[Speaker, Sequence[PlannerStatus | ActuatorState | BodyPose]] = {
        "planner": heard.statuses,
        "actuator": heard.states,
        "perception": heard.poses,
    }
    return said[who]


def _state(message: PlannerStatus | ActuatorState | BodyPose) -> str:
    match message:
        case PlannerStatus():
            return message.state
        case ActuatorState():
            return str(message.mode)
        case BodyPose():
            return "registered" if message.ok else "legs alone"


def _refusal(status: PlannerStatus, walked: bool) -> tuple[str, int]:
    """Return the reason and the leg of a planner that does not go on.

    It may wait before the first step, or to look around.
    """
    stands = status.state == "blocked" or (walked and status.state == "waiting" and status.reason.startswith(_LACKING))
    return (status.reason, status.blocked_leg) if stands else ("", -1)


def _together(who: Speaker, words: Iterable[Word]) -> list[StatusEvent]:
    """Merge the same reason, reported without a break, into one complaint."""
    found: list[StatusEvent] = []
    running = ""
    for t, text, leg in words:
        if running and t - found[-1].end < _SILENT:  # it lasted until now
            found[-1] = StatusEvent(who, found[-1].begin, t, found[-1].words, found[-1].leg)
        kind = kind_of(text)
        if kind and kind == running and t - found[-1].end < _SILENT:
            found[-1] = StatusEvent(who, found[-1].begin, t, text, leg)
        elif kind:
            found.append(StatusEvent(who, t, t, text, leg))
        running = kind
    return found


def kind_of(words: str) -> str:
    """Return a text without its numbers and legs."""
    return _LEGS.sub("leg", _FIGURE.sub("#", words))
