"""Foothold feedback: one touch per stance, measured under load."""

from dataclasses import replace

import numpy as np

from sextant.services.mapper.footholds.foothold_feedback import FirstStanceDetector, StanceResult
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import ActuatorState, BodyPose
from tests.unit.mapper.test_service import legs

PROFILE = load_profile("phantomx_mk2")
T = from_xyz_rpy((0.4, -0.1, 0.1), (0.0, 0.0, 0.3))
POSE = BodyPose(0, T, T, np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))
ODD, EVEN = np.array([True, False] * 3), np.array([False, True] * 3)


def walk(watch: FirstStanceDetector, steps: int, **changes: object) -> list[list[StanceResult]]:
    """Return the touches of each step; the legs swing in turn."""
    found = []
    for step in range(steps):
        swing = ODD if step % 2 == 0 else EVEN
        here = []
        for phase in np.linspace(0.0, 1.0, 11):
            state: ActuatorState = replace(legs(swing if phase < 1.0 else ~(ODD | EVEN)), step=step, phase=float(phase))
            here += watch.update(replace(state, **{k: v for k, v in changes.items() if step}), POSE)  # type: ignore[arg-type]
        found.append(here)
    return found


def test_each_stance_gives_one_result_after_its_swing() -> None:
    found = walk(FirstStanceDetector(PROFILE.foot.radius), 5)
    assert [len(touches) for touches in found] == [0, 3, 3, 3, 3]
    feet = T[:3, :3] @ PROFILE.rest_feet(0.1).T + T[:3, 3:]
    for touches, swung in zip(found[1:], (ODD, EVEN) * 2, strict=True):
        assert all(touch.carries for touch in touches)
        np.testing.assert_allclose([t.p_world for t in touches], feet.T[swung] - [0, 0, PROFILE.foot.radius], atol=1e-12)


def test_unloaded_foot_is_reported_as_not_carrying() -> None:
    contact = np.ones(6, dtype=bool)
    contact[0] = False
    touches = walk(FirstStanceDetector(PROFILE.foot.radius), 2, contact=contact)[1]
    assert [touch.carries for touch in touches] == [False, True, True]


def test_standing_robot_gives_no_stance_result() -> None:
    watch = FirstStanceDetector(PROFILE.foot.radius)
    for phase in np.linspace(0, 1, 11):
        assert watch.update(replace(legs(), phase=float(phase)), POSE) == []
