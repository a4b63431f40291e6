"""The event log: one text per event, when it occurs."""

from dataclasses import replace

import numpy as np

from sextant.shared.recording.event_log import KEPT, Diary
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import CameraState, Health, Mode, PlannerStatus
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
S = 1_000_000_000


def said(diary: Diary) -> list[str]:
    return [f"{e.who}: {e.words}" for e in diary.entries]


def health(service: str, refusal: str = "") -> Health:
    return Health(0, service, "at work", 1, 0, 0, refusal, (), np.zeros(0), np.zeros(0))


def test_a_mode_is_noted_when_it_changes_and_what_is_wrong_is_marked() -> None:
    diary, state = Diary(), actuator_state(PROFILE, reason="standing", lease="")
    for k in range(5):
        diary.legs(k * S, state)
    assert said(diary) == ["actuator: hold: standing", "actuator: nobody leads"]
    diary.legs(9 * S, replace(state, mode=Mode.FAULT, reason="a servo is silent", warnings=("it is hot",), lease="console 1"))
    assert said(diary)[2:] == ["actuator: fault: a servo is silent", "actuator: console 1 leads", "actuator: it is hot"]
    assert [e.bad for e in diary.entries] == [False, False, True, False, True]


def test_an_actuator_that_falls_silent_is_said_so_once_and_not_before_it_was_heard() -> None:
    diary = Diary()
    diary.legs(0, None)
    assert said(diary) == ["actuator: no word from the actuator"]
    diary.legs(S, actuator_state(PROFILE, reason="standing"))
    for k in range(4):
        diary.legs((2 + k) * S, None)
    assert said(diary).count("actuator: no word from the actuator") == 2


def test_a_planner_that_steps_is_noted_once_however_its_words_change() -> None:
    diary = Diary()
    for k in range(9):
        diary.planner(k, PlannerStatus(k, "stepping", f"{k} of 3 footholds moved", k, 0, -1))
    diary.planner(10, PlannerStatus(10, "blocked", "no foothold for the left front leg", 9, 0, 0))
    assert said(diary) == ["planner: stepping", "planner: blocked: no foothold for the left front leg"]
    assert diary.entries[-1].bad


def test_a_camera_and_services_that_go_and_come_back_are_noted() -> None:
    diary = Diary()
    diary.camera(0, CameraState(0, "a camera", True, ""))
    diary.camera(S, CameraState(0, "a camera", False, "it is covered"))
    heard = {"mapper": (health("mapper"), 0), "planner": (health("planner", "StepPlan: too long"), 0)}
    diary.services(S, heard)
    diary.services(4 * S, heard)
    diary.services(5 * S, heard)
    heard["mapper"] = (health("mapper"), 6 * S)
    diary.services(6 * S, heard)
    assert said(diary) == [
        "camera: pictures come",
        "camera: it is covered",
        "planner: StepPlan: too long",
        "mapper: silent for 3 s",
        "planner: silent for 3 s",
        "mapper: is back",
    ]


def test_it_keeps_so_many_lines_and_counts_all() -> None:
    diary = Diary()
    for k in range(2 * KEPT):
        diary.note(k, "console", str(k))
    assert (len(diary.entries), diary.count, diary.entries[-1].words) == (KEPT, 2 * KEPT, str(2 * KEPT - 1))


def test_a_computer_that_is_too_slow_is_noted_once_and_when_it_is_over() -> None:
    diary = Diary()
    for age in ("", "maps are 1.6 s old", "maps are 1.7 s old", "", ""):
        diary.computer(S, f"the robot's computer is too slow: {age}" if age else "")
    assert said(diary) == [
        "console: the robot's computer is too slow: maps are 1.6 s old",
        "console: the services keep up again",
    ]
    assert [e.bad for e in diary.entries] == [True, False]
