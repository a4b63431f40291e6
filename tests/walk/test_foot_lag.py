"""Lag of feet that nothing holds: far below the limits from which an actuator takes a foot for held."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.services.actuator.locomotion import foot_relief, held_feet
from sextant.services.actuator.locomotion.foot_relief import FootRelief
from sextant.services.actuator.locomotion.held_feet import HeldFeet
from sextant.shared.geometry import Array
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import Goal
from tests.support.walks import S

CYCLE_S = 0.02


def lasting(lags: list[Array], seconds: float) -> float:
    """Return the largest lag [m] that a foot has for so long."""
    windows = np.lib.stride_tricks.sliding_window_view(np.array(lags), round(seconds / CYCLE_S), axis=0)
    return float(windows.min(axis=-1).max())


@pytest.mark.parametrize(("robot", "course", "lowest"), [("phantomx_mk2", "rubble", False), ("printed_sts3215", "flat", True)])
def test_feet_that_nothing_holds_stay_near_their_goals(
    robot: str, course: str, lowest: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check the softest servos on the roughest ground, and those whose torque suffices least for the speed of their feet."""
    lags: dict[type, list[Array]] = {HeldFeet: [], FootRelief: []}

    def listen(kind: type) -> None:
        usual: Callable[..., Any] = kind.update  # type: ignore[attr-defined]

        def update(watched: Any, legs: Array, goals: Array, felt: FootContact, dt: float) -> Any:
            lags[kind].append(np.where(legs & felt.known, np.linalg.norm(felt.feet - goals, axis=1), 0.0))
            return usual(watched, legs, goals, felt, dt)

        monkeypatch.setattr(kind, "update", update)

    listen(HeldFeet)
    listen(FootRelief)
    scenario, profile = load_scenario(course), load_profile(robot)
    height = profile.stance.body_height_range[0] if lowest else scenario.walk.body_height
    scenario = replace(scenario, robot=robot, goal=Goal(1.0), walk=replace(scenario.walk, body_height=height))
    run = LockstepRun(scenario, 1000, profile, lambda *_: None, every_frame=False)
    while not run.attendance.over():
        run.run(run.now_ns() + S // 2)
    assert run.attendance.judge(1.0, in_a_hurry=True).success
    assert 0.003 < lasting(lags[HeldFeet], held_feet._LAG_S) < 0.65 * held_feet._LAG_M
    assert 0.005 < lasting(lags[FootRelief], foot_relief._HELD_S) < 0.8 * foot_relief._HELD_M
