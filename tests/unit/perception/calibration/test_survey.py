"""Motion of a calibration: when it begins, goes on and ends."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.services.perception.calibration.calibration_client import CalibrationClient
from sextant.services.perception.calibration.floor_view import block_centres
from sextant.services.perception.calibration.survey import POSTURES, Survey
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    FloorView,
    Imu,
    Message,
    Mode,
    ModeCommand,
    PlannerStatus,
    PostureCommand,
    Tick,
)
from tests.support.states import actuator_state
from tests.unit.perception.calibration.measurements import PROFILE

S = 1_000_000_000
POSE = BodyPose(0, np.eye(4), np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))
BLOCKS = len(block_centres(PROFILE.camera.intrinsics)[0])
BLIND = FloorView(0, np.full(BLOCKS, np.nan))


class Rig:
    """A survey, or a client that has one, and a robot with a planner, which the test plays."""

    def __init__(self, client: CalibrationClient | None = None) -> None:
        self.survey: Any = client or Survey(PROFILE, "me")
        self.inbox = Inbox(self.survey.subscribes, self.survey.stages)
        self.now_ns = 1_000 * S
        self.state: ActuatorState | None = actuator_state(
            PROFILE, mode=Mode.HOLD, reason="standing", lease="me", epoch=7, feet=PROFILE.rest_feet()
        )
        self.view: FloorView | None = BLIND
        self.planner: PlannerStatus | None = PlannerStatus(0, "arrived", "the body is in the commanded posture", 0, 0, -1)

    def run(self, seconds: float) -> list[Message]:
        """Advance time in tenths of a second; return what the survey publishes."""
        said: list[Message] = []
        for _ in range(round(10 * seconds)):
            self.now_ns += S // 10
            self.inbox.now_ns = self.now_ns
            for message in (self.state, POSE, self.planner, self.view):
                if message is not None:
                    fresh = replace(message, stamp_ns=self.now_ns)
                    self.inbox.receive(topics.OF_TYPE[type(fresh)], codec.encode(fresh), self.now_ns)
            said += self.survey.step(Tick(self.now_ns), self.inbox)
        return said

    def set(self, **state: Any) -> None:
        """Change the state of the actuator."""
        assert self.state is not None
        self.state = replace(self.state, **state)

    def plan(self, **status: Any) -> None:
        """Change the status of the planner."""
        assert self.planner is not None
        self.planner = replace(self.planner, **status)


def test_robot_stands_first_and_then_takes_each_posture() -> None:
    rig = Rig()
    rig.set(mode=Mode.STAND)
    first = rig.run(3.0)
    assert {m.mode for m in first if isinstance(m, ModeCommand)} == {"stand"}
    assert not [m for m in first if isinstance(m, PostureCommand)]
    rig.set(mode=Mode.HOLD)
    said = rig.run(100.0)
    assert rig.survey.reason == "all postures measured"
    assert rig.survey.reached == POSTURES + 1
    assert "walk" in {m.mode for m in said if isinstance(m, ModeCommand)}
    commanded = [tuple(np.concatenate([m.place, m.rpy])) for m in said if isinstance(m, PostureCommand)]
    assert len(dict.fromkeys(commanded)) == POSTURES + 1
    assert commanded[-1] == (0.0,) * 6
    assert rig.survey.recording() is not None


def test_robot_that_stands_already_begins_after_the_order_was_executed() -> None:
    rig = Rig()
    rig.run(0.5)
    rig.set(epoch=8)  # {odom} starts again when the robot stands up
    rig.run(3.0)
    assert rig.survey.status().startswith("posture")


def test_posture_that_the_legs_refuse_is_left_out_with_its_reason() -> None:
    rig = Rig()
    rig.plan(state="blocked", reason="posture: out of reach")
    rig.run(100.0)
    assert rig.survey.finished
    assert rig.survey.reached == 0
    assert rig.survey.refusal == "posture: out of reach"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lease": "another"}, "the robot was interrupted: another leads it"),
        ({"epoch": 9}, "the robot was interrupted: the actuator is in mode"),
        ({"plan_refusal": "the mode is hold, not ordered to walk"}, "the robot was interrupted: the mode is hold, not ordered"),
    ],
)
def test_interrupted_motion_ends_without_a_recording(change: dict[str, Any], words: str) -> None:
    rig = Rig()
    rig.run(10.0)
    rig.set(**change)
    rig.run(0.2)
    assert rig.survey.finished
    assert rig.survey.reason.startswith(words)
    assert rig.survey.recording() is None


def test_robot_that_never_stands_or_never_moves_ends_the_survey() -> None:
    rig = Rig()
    rig.set(lease="another")
    rig.run(31.0)
    assert rig.survey.reason.startswith("the robot is not ready: another leads it")
    deaf = Rig()
    deaf.view = deaf.planner = None
    deaf.run(31.0)
    assert "no view of the floor and no message of the planner arrives here; of two machines" in deaf.survey.reason
    stuck = Rig()
    stuck.plan(state="waiting", reason="no fresh pose")
    stuck.run(20.0)
    assert stuck.survey.reason == "posture 1 is not reached: no fresh pose"
    (stop,) = stuck.survey.withdraw()
    assert isinstance(stop, ModeCommand)
    assert (stop.mode, stop.holder) == ("stop", "me")
    assert Survey(PROFILE).withdraw() == ()


def test_perception_with_another_profile_ends_the_survey() -> None:
    rig = Rig()
    rig.view = FloorView(0, np.full(BLOCKS - 1, np.nan))
    rig.run(10.0)
    assert (
        rig.survey.reason == f"{BLOCKS} blocks of an image expected, found {BLOCKS - 1}: perception runs with another profile"
    )
    assert rig.survey.recording() is None


def test_readings_of_the_imu_are_kept_in_order() -> None:
    rig = Rig()
    rig.run(1.0)
    assert rig.survey.imu() is None
    for stamp_ns in (5, 7, 6, 8):
        message = Imu(stamp_ns, gyro=np.zeros(3), specific_force=np.array([0.0, 0.0, float(stamp_ns)]))
        rig.inbox.receive(topics.IMU, codec.encode(message), rig.now_ns)
        rig.run(0.1)
    track = rig.survey.imu()
    assert track.stamp_ns.tolist() == [5, 7, 8]
    assert track.specific_force[:, 2].tolist() == [5.0, 7.0, 8.0]
