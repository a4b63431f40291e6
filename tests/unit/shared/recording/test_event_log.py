"""The event log: one text per event, when it occurs."""

from dataclasses import replace

import numpy as np

from sextant.shared.recording.event_log import KEPT, EventLog
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import CameraState, Health, Mode, PlannerStatus
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
S = 1_000_000_000


def said(event_log: EventLog) -> list[str]:
    return [f"{e.who}: {e.words}" for e in event_log.entries]


def health(service: str, refusal: str = "") -> Health:
    return Health(0, service, "at work", 1, 0, 0, refusal, (), np.zeros(0), np.zeros(0))


def test_mode_change_is_logged_and_problems_are_marked() -> None:
    event_log, state = EventLog(), actuator_state(PROFILE, reason="standing", lease="")
    for k in range(5):
        event_log.legs(k * S, state)
    assert said(event_log) == ["actuator: hold: standing", "actuator: no client is in control"]
    event_log.legs(
        9 * S, replace(state, mode=Mode.FAULT, reason="a servo is silent", warnings=("it is hot",), lease="console 1")
    )
    assert said(event_log)[2:] == [
        "actuator: fault: a servo is silent",
        "actuator: console 1 is in control",
        "actuator: it is hot",
    ]
    assert [e.bad for e in event_log.entries] == [False, False, True, False, True]


def test_silent_actuator_is_logged_once_per_silence() -> None:
    event_log = EventLog()
    event_log.legs(0, None)
    assert said(event_log) == ["actuator: no message from the actuator"]
    event_log.legs(S, actuator_state(PROFILE, reason="standing"))
    for k in range(4):
        event_log.legs((2 + k) * S, None)
    assert said(event_log).count("actuator: no message from the actuator") == 2


def test_planner_state_is_logged_once_despite_changing_reason() -> None:
    event_log = EventLog()
    for k in range(9):
        event_log.planner(k, PlannerStatus(k, "stepping", f"{k} of 3 footholds moved", k, 0, -1))
    event_log.planner(10, PlannerStatus(10, "blocked", "no foothold for the left front leg", 9, 0, 0))
    assert said(event_log) == ["planner: stepping", "planner: blocked: no foothold for the left front leg"]
    assert event_log.entries[-1].bad


def test_lost_and_returned_camera_and_services_are_logged() -> None:
    event_log = EventLog()
    event_log.camera(0, CameraState(0, "a camera", True, ""))
    event_log.camera(S, CameraState(0, "a camera", False, "it is covered"))
    heard = {"mapper": (health("mapper"), 0), "planner": (health("planner", "StepPlan: too long"), 0)}
    event_log.services(S, heard)
    event_log.services(4 * S, heard)
    event_log.services(5 * S, heard)
    heard["mapper"] = (health("mapper"), 6 * S)
    event_log.services(6 * S, heard)
    assert said(event_log) == [
        "camera: images are received",
        "camera: it is covered",
        "planner: StepPlan: too long",
        "mapper: silent for 3 s",
        "planner: silent for 3 s",
        "mapper: responds again",
    ]


def test_log_length_is_bounded_and_all_lines_counted() -> None:
    event_log = EventLog()
    for k in range(2 * KEPT):
        event_log.note(k, "console", str(k))
    assert (len(event_log.entries), event_log.count, event_log.entries[-1].words) == (KEPT, 2 * KEPT, str(2 * KEPT - 1))


def test_slow_computer_is_logged_once_and_at_its_end() -> None:
    event_log = EventLog()
    for age in ("", "maps are 1.6 s old", "maps are 1.7 s old", "", ""):
        event_log.computer(S, f"the robot's computer is too slow: {age}" if age else "")
    assert said(event_log) == [
        "console: the robot's computer is too slow: maps are 1.6 s old",
        "console: all services are fast enough again",
    ]
    assert [e.bad for e in event_log.entries] == [True, False]


def test_refused_plan_and_torque_off_are_normal_events() -> None:
    event_log, state = EventLog(), actuator_state(PROFILE, reason="torque off as ordered", mode=Mode.OFF)
    event_log.legs(0, replace(state, plan_refusal="a foot is out of reach"))
    assert "actuator: a foot is out of reach" in said(event_log)
    assert not any(entry.bad for entry in event_log.entries)
