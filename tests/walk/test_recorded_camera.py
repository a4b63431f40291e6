"""A recorded folder as the camera of the whole chain, in lockstep.

It is mapped, its loss is reported, and it is mapped again.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.evaluation.replay.tum_recording import record_tum
from sextant.services.mapper.config import Settings as MapperSettings
from sextant.services.mapper.service import Mapper
from sextant.services.perception.cameras.config import Settings as CameraSettings
from sextant.services.perception.cameras.service import CameraService
from sextant.services.perception.config import Settings as PerceptionSettings
from sextant.services.perception.service import Perception
from sextant.services.planner.config import Settings as PlannerSettings
from sextant.services.planner.service import Planner
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.lockstep import Lockstep
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Message, Odometry, Tick, VelocityCommand
from tests.support.states import actuator_state
from tests.support.walks import Heard, flat

S = 1_000_000_000
PROFILE = load_profile("phantomx_mk2")
T_BODY = from_xyz_rpy((0.0, 0.0, PROFILE.stance.body_height), np.zeros(3))


class WorldStance:
    """Standing legs, and an operator that wants them to walk."""

    name = "legs"
    trigger = Every.hz(50.0)
    subscribes: tuple[AnyTopic, ...] = ()
    publishes: tuple[AnyTopic, ...] = (topics.ODOMETRY, topics.ACTUATOR_STATE, topics.VELOCITY)

    def __init__(self) -> None:
        self.stages = Stages()

    def status(self) -> str:
        return "standing"

    def step(self, tick: Tick, inbox: Inbox) -> Iterable[Message]:
        yield Odometry(tick.stamp_ns, T_BODY.copy(), 0.0, 0.0, np.ones(6, dtype=bool), True)
        yield actuator_state(PROFILE, stamp_ns=tick.stamp_ns, T_odom_body=T_BODY.copy(), body_ref=T_BODY.copy())
        yield VelocityCommand(tick.stamp_ns, np.array([0.1, 0.0]), 0.0, PROFILE.stance.body_height, 0.04)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record one second of level ground before the robot walks."""
    made = tmp_path_factory.mktemp("recorded") / "ground"
    record_tum(flat(1.0), 1000, made, 1.0)
    return made


def test_recorded_folder_is_mapped_reported_missing_and_mapped_again(folder: Path) -> None:
    heard = Heard((topics.DEPTH, topics.CAMERA_STATE, topics.SCAN, topics.TERRAIN, topics.PLANNER_STATUS, topics.HEALTH))
    run: Lockstep | None = None

    def clock() -> int:
        return 0 if run is None else run.now_ns

    camera = CameraService(PROFILE, CameraSettings(device=str(folder)), None, clock)
    run = Lockstep(
        {
            "legs": WorldStance,
            "camera": lambda: camera,
            "perception": lambda: Perception(PROFILE, PerceptionSettings()),
            "mapper": lambda: Mapper(PROFILE, MapperSettings()),
            "planner": lambda: Planner(PROFILE, PlannerSettings()),
        },
        heard.tap,
    )
    # 1. The ground is mapped as level, and the planner steps.
    run.run(4 * S)
    assert len(heard.of(topics.DEPTH)) == pytest.approx(4 * 30, abs=4)
    terrain = heard.of(topics.TERRAIN)[-1]
    measured = np.isfinite(terrain.elevation) & ~terrain.assumed
    assert measured.sum() > 3000
    assert np.abs(terrain.elevation[measured]).max() < 0.03
    assert heard.of(topics.PLANNER_STATUS)[-1].state == "stepping"
    # 2. The folder is gone: no scan, no map, and the planner states the reason.
    folder.rename(folder.with_name("elsewhere"))
    run.run(12 * S)
    assert not heard.of(topics.DEPTH, 4.2)
    assert not heard.of(topics.TERRAIN, 4.5)
    (reason,) = {state.reason for state in heard.of(topics.CAMERA_STATE, 6.0)}
    assert "ground" in reason
    assert not any(state.ok for state in heard.of(topics.CAMERA_STATE, 4.2))
    status = heard.of(topics.PLANNER_STATUS)[-1]
    assert status.state == "waiting"
    assert reason in status.reason
    said = [health.status for health in heard.of(topics.HEALTH, 6.0) if health.service == "camera"]
    assert said
    assert all(reason in words for words in said)
    # 3. The folder is back.
    folder.with_name("elsewhere").rename(folder)
    run.run(24 * S)
    assert heard.of(topics.CAMERA_STATE)[-1].ok
    after = heard.of(topics.TERRAIN)[-1]
    assert after.stamp_ns > 23 * S
    assert heard.of(topics.PLANNER_STATUS)[-1].state == "stepping"
    both = np.isfinite(after.elevation) & np.isfinite(terrain.elevation)
    assert np.abs(after.elevation - terrain.elevation)[both].max() < 0.03


def test_recording_of_other_camera_is_refused_with_reason(folder: Path) -> None:
    wide = replace(PROFILE, camera=replace(PROFILE.camera, intrinsics=replace(PROFILE.camera.intrinsics, fx=500.0)))
    heard = Heard((topics.DEPTH, topics.CAMERA_STATE))
    run = Lockstep({"camera": lambda: CameraService(wide, CameraSettings(device=str(folder)), None, lambda: 0)}, heard.tap)
    run.run(S)
    assert not heard.of(topics.DEPTH)
    assert "fx 500.0" in heard.of(topics.CAMERA_STATE)[-1].reason
    assert codec.encode(heard.of(topics.CAMERA_STATE)[-1])
