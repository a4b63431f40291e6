"""What the services said of themselves in a run: the states they were in, and the words in which they refused or complained."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from sextant.deploy.judging.heard import Heard
from sextant.shared.robot.profile import LEGS
from sextant.shared.wire.messages import ActuatorState, BodyPose, Mode, PlannerStatus

Speaker = Literal["planner", "actuator", "perception"]
SPEAKERS: tuple[Speaker, ...] = ("planner", "actuator", "perception")

_SILENT = 1.0  # [s] after which who has said nothing is not in a state any more
_ROUTINE = "plan of step # does not follow step #"  # of a plan that crossed the end of a step on its way
_LACKING = ("no fresh", "where the robot is", "the actuator is in mode", "the terrain map", "by touch: no pose")  # of a wait
_LONG = 0.3  # [s] that a planner waits or stands now and then without it meaning anything


@dataclass(frozen=True, slots=True)
class Spell:
    """A time through which a service said that it was in one state."""

    who: Speaker
    state: str
    begin: float  # [s]
    end: float  # [s] where it said something else, or fell silent


@dataclass(frozen=True, slots=True)
class Complaint:
    """Why something did not go on, in a service's own words, for as long as it said so."""

    who: Speaker
    begin: float  # [s]
    end: float  # [s]
    words: str  # the last of them: figures in them may change meanwhile
    leg: int = -1  # that has no foothold


_FIGURE = re.compile(r"[-+]?\d+(\.\d+)?")
_LEGS = re.compile(r"({0})((, | and )({0}))*".format("|".join(LEGS)))

Word = tuple[float, str, int]  # time [s], what was said, leg


def spells(heard: Heard) -> tuple[Spell, ...]:
    """The states of a run's services, one after the other for each."""
    found: list[Spell] = []
    for who in SPEAKERS:
        states = [(_seconds(heard, message.stamp_ns), _state(message)) for message in _of(heard, who)]
        for k, (t, state) in enumerate(states):
            following = states[k + 1][0] if k + 1 < len(states) else t
            end = following if following - t < _SILENT else t
            if found and found[-1].who == who and found[-1].state == state and t <= found[-1].end:
                found[-1] = Spell(who, state, found[-1].begin, end)
            else:
                found.append(Spell(who, state, t, end))
    return tuple(found)


def complaints(heard: Heard) -> tuple[Complaint, ...]:
    """Refusals and complaints of a run in order of time; what only differs in its figures is one."""
    begun = _seconds(heard, heard.first_step_ns) if heard.first_step_ns is not None else float("inf")
    statuses = [(_seconds(heard, status.stamp_ns), status) for status in heard.statuses]
    planner = _together("planner", ((t, *_refusal(status, t > begun)) for t, status in statuses))
    said = [c for c in planner if c.end - c.begin >= _LONG]
    timed = [(_seconds(heard, state.stamp_ns), state) for state in heard.states]
    said += [c for c in _together("actuator", ((t, s.refused, -1) for t, s in timed)) if kind_of(c.words) != _ROUTINE]
    said += _together("actuator", ((t, state.reason if state.mode is Mode.FAULT else "", -1) for t, state in timed))
    said += _together("actuator", ((t, "; ".join(state.warnings), -1) for t, state in timed))
    poses = [(_seconds(heard, pose.stamp_ns), pose) for pose in heard.poses]
    said += _together("perception", ((t, "" if pose.ok else pose.reason, -1) for t, pose in poses))
    return tuple(sorted(said, key=lambda c: c.begin))


def last_reason(heard: Heard) -> str:
    """Who stopped the walk last, and the reason: of planner and actuator, whichever complained last; empty if neither did."""
    found = [c for c in complaints(heard) if c.who != "perception"]
    if not found:
        return ""
    last = max(found, key=lambda complaint: complaint.end)
    return f"{last.who}, {last.begin:.0f} to {last.end:.0f} s: {last.words}"


def _seconds(heard: Heard, stamp_ns: int) -> float:
    return (stamp_ns - heard.begin_ns) * 1e-9


def _of(heard: Heard, who: Speaker) -> Sequence[PlannerStatus | ActuatorState | BodyPose]:
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
    """Words and leg of a planner that does not go on; before the first step, or to look around, it may wait."""
    stands = status.state == "blocked" or (walked and status.state == "waiting" and status.reason.startswith(_LACKING))
    return (status.reason, status.blocked_leg) if stands else ("", -1)


def _together(who: Speaker, words: Iterable[Word]) -> list[Complaint]:
    """What was said without a break, as one complaint each."""
    found: list[Complaint] = []
    running = ""
    for t, text, leg in words:
        if running and t - found[-1].end < _SILENT:  # it held until now
            found[-1] = Complaint(who, found[-1].begin, t, found[-1].words, found[-1].leg)
        kind = kind_of(text)
        if kind and kind == running and t - found[-1].end < _SILENT:
            found[-1] = Complaint(who, found[-1].begin, t, text, leg)
        elif kind:
            found.append(Complaint(who, t, t, text, leg))
        running = kind
    return found


def kind_of(words: str) -> str:
    """What words say apart from the figures and legs in them."""
    return _LEGS.sub("leg", _FIGURE.sub("#", words))
