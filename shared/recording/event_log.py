"""Event log of a run: changes of state that the services report.

It has no clock; times are arguments.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from sextant.shared.wire.messages import ActuatorState, BodyPose, CameraState, Health, Mode, PassagePlan, PlannerStatus

KEPT = 300  # entries
_SILENT_NS = 3_000_000_000  # [ns] without health after which a service is logged as silent


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of the log."""

    at_ns: int
    who: str
    words: str
    bad: bool  # whether it reports a problem


class EventLog:
    """Event log; adds an entry when a message of a service reports something new."""

    def __init__(self) -> None:
        self.entries: deque[Entry] = deque(maxlen=KEPT)
        self.count = 0  # of all entries so far
        self._told: dict[str, str] = {}  # last logged text, by subject
        self._warnings: frozenset[str] = frozenset()
        self._silent: set[str] = set()
        self._slow = False  # last logged state of the computer
        self._refusals: dict[str, str] = {}  # last logged refusal, by service

    def note(self, at_ns: int, who: str, words: str, bad: bool = False) -> None:
        """Add an entry."""
        self.entries.append(Entry(at_ns, who, words, bad))
        self.count += 1

    def legs(self, now_ns: int, state: ActuatorState | None) -> None:
        """Log changes of the actuator's state; None if it has been silent for a while."""
        if state is None:
            self._if_new(now_ns, "actuator", "mode", "no message from the actuator", True, unless="")
            return
        self._if_new(now_ns, "actuator", "mode", f"{state.mode}: {state.reason}", state.mode is Mode.FAULT)
        self._if_new(now_ns, "actuator", "refused", state.plan_refusal, False)  # the planner plans again
        self._if_new(now_ns, "actuator", "lease", f"{state.lease or 'no client'} is in control", False)
        warnings = frozenset(state.warnings)
        for words in state.warnings:
            if words not in self._warnings:
                self.note(now_ns, "actuator", words, True)
        self._warnings = warnings

    def planner(self, now_ns: int, status: PlannerStatus | None) -> None:
        """Log changes of the planner's status.

        The reason is omitted while the robot steps, because it changes with every step.
        """
        if status is None:
            return
        words = status.state if status.state == "stepping" else f"{status.state}: {status.reason}"
        self._if_new(now_ns, "planner", "status", words, status.state == "blocked")

    def perception(self, now_ns: int, pose: BodyPose) -> None:
        """Log whether the pose of the robot is known."""
        known = "the pose of the robot is known"
        self._if_new(now_ns, "perception", "pose", known if pose.ok else pose.reason, not pose.ok, unless=known)

    def camera(self, now_ns: int, state: CameraState | None) -> None:
        """Log changes of the camera's state."""
        if state is not None:
            self._if_new(now_ns, "camera", "state", "images are received" if state.ok else state.reason, not state.ok)

    def calibration(self, now_ns: int, running: bool, refusal: str) -> None:
        """Log the beginning and the result of a calibration."""
        words = "a calibration runs" if running else f"no new calibration: {refusal}" if refusal else "the robot is calibrated"
        self._if_new(now_ns, "camera", "calibration", words, bool(refusal))

    def computer(self, now_ns: int, too_slow: str) -> None:
        """Log when the computer becomes too slow, or fast enough again.

        Changing numbers are not logged.
        """
        if bool(too_slow) != self._slow:
            self._slow = bool(too_slow)
            self.note(now_ns, "console", too_slow or "all services are fast enough again", self._slow)

    def passage(self, now_ns: int, plan: PassagePlan) -> None:
        """Log the plan of a section of a passage."""
        self.note(
            now_ns, "planner", f"gap crossing, section {plan.section}: {plan.state}: {plan.reason}", plan.state == "no way"
        )

    def services(self, now_ns: int, heard: Mapping[str, tuple[Health, int]]) -> None:
        """Log services that become silent, return, or refuse a message.

        Services that are not in `heard` are forgotten.
        """
        self._silent &= heard.keys()
        self._refusals = {name: words for name, words in self._refusals.items() if name in heard}
        for name, (word, at_ns) in heard.items():
            if now_ns - at_ns > _SILENT_NS and name not in self._silent:
                self._silent.add(name)
                self.note(now_ns, name, f"silent for {_SILENT_NS * 1e-9:.0f} s", True)
            elif now_ns - at_ns <= _SILENT_NS and name in self._silent:
                self._silent.discard(name)
                self.note(now_ns, name, "responds again")
            if word.last_refusal and word.last_refusal != self._refusals.get(name):
                self._refusals[name] = word.last_refusal
                self.note(now_ns, name, word.last_refusal, True)

    def _if_new(self, now_ns: int, who: str, subject: str, words: str, bad: bool, unless: str | None = None) -> None:
        key = f"{who} {subject}"
        before = self._told.get(key, unless)
        if words == before:
            return
        self._told[key] = words
        if words:
            self.note(now_ns, who, words, bad)
