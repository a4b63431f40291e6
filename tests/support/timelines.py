"""Synthetic timelines of faults: a standing robot with scripted reports."""

from typing import Any

import numpy as np

from benchmarks.faults.timeline import Timeline, Truth, Word
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import Mode

PROFILE = load_profile("phantomx_mk2")
BEGIN_S, PERIOD_S = 10.0, 0.02
WALKING = Word(BEGIN_S - 0.01, Mode.WALK, "walking")


def standing(for_s: float = 4.0, **changes: Any) -> Truth:
    """Return the truth of a standing robot, starting one sample before the fault."""
    t = BEGIN_S - PERIOD_S + PERIOD_S * np.arange(round(for_s / PERIOD_S))
    n, height = len(t), PROFILE.stance.body_height
    body = np.tile(np.eye(4), (n, 1, 1))
    body[:, 2, 3] = height
    values: dict[str, Any] = {
        "t": t,
        "q": np.zeros((n, 6, 3)),
        "feet": np.tile(PROFILE.rest_feet() + np.array([0.0, 0.0, height]), (n, 1, 1)),
        "contact": np.ones((n, 6), dtype=np.bool_),
        "body": body,
        "shutdown": np.zeros((n, 6, 3), dtype=np.bool_),
    }
    return Truth(**(values | changes))


def timeline(*words: Word, **changes: Any) -> Timeline:
    """Return an injection into a standing robot, and the actuator's reports after it."""
    values: dict[str, Any] = {
        "begin_s": BEGIN_S,
        "end_s": BEGIN_S + 2.0,
        "servo": -1,
        "phase": 0.5,
        "words": (WALKING, *words),
        "truth": standing(),
        "goals": (),
        "switches": (),
        "outside": (),
        "pulls": np.ones(18, dtype=np.bool_),
    }
    return Timeline(**(values | changes))


def word(after_s: float, mode: Mode, reason: str = "") -> Word:
    """Return a report at this time [s] after the beginning."""
    return Word(BEGIN_S + after_s, mode, reason)
