"""The scorer's log of messages, with any content."""

import numpy as np
import pytest

from sextant.evaluation.report import Warned
from sextant.evaluation.trace.run_log import RunLog, TruthLog
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox, Stages
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, CameraErrors, GroundTruth, Mode, StepPlan
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
LARGEST = (1 << 63) - 1


def ground_truth(stamp_ns: int, value: float = 0.0) -> GroundTruth:
    flags, joints = np.zeros(6, dtype=bool), np.full((6, 3), value)
    return GroundTruth(
        stamp_ns, np.eye(4), joints, joints, joints, flags, flags, joints > 0, 11.1, 30.0, "flat", 0, PROFILE.name
    )


def counted_steps(*steps: int) -> list[int]:
    """Return the steps of received states as a scorer counts them."""
    truth, heard, inbox = ground_truth(0), RunLog(), Inbox(topics.TOPICS, Stages())
    for step in steps:
        inbox.receive(topics.ACTUATOR_STATE, codec.encode(actuator_state(PROFILE, step=step, mode=Mode.WALK)), 0)
        heard.take_in(truth, inbox)
    for state in heard.states:
        codec.decode(codec.encode(state), ActuatorState)
    return [state.step for state in heard.states]


def test_step_count_continues_after_actuator_restart() -> None:
    assert counted_steps(0, 1, 2, 0, 1, 0) == [0, 1, 2, 2, 3, 3]


@pytest.mark.parametrize("claimed", [LARGEST, 1 << 62, -LARGEST])
def test_extreme_step_numbers_do_not_overflow_step_count(claimed: int) -> None:
    steps = counted_steps(3, claimed, 4, claimed, LARGEST, 5, 6)
    assert np.array(steps, dtype=np.int64).shape == (7,)
    assert steps[-1] == steps[-2] + 1, "later messages are counted separately"


def test_time_from_image_to_executed_plan_counts_each_map_once() -> None:
    flags, joints = np.zeros(6, dtype=bool), np.zeros((6, 3))
    truth, heard, inbox = ground_truth(0), RunLog(), Inbox(topics.TOPICS, Stages())
    maps = {100: 60, 140: 60, 200: 130, 240: -1, 280: 70}  # stamps of plans and of their maps
    for plan_ns, map_ns in maps.items():
        plan = StepPlan(plan_ns, 0, 1, 0, np.eye(4), flags, joints, np.zeros(6), np.eye(4), 1.0, False, map_ns)
        inbox.receive(topics.STEP_PLAN, codec.encode(plan), 0)
    for stamp_ns, plan_ns in ((90, -1), (120, 100), (160, 140), (220, 200), (260, 240), (300, 280), (320, 999)):
        state = actuator_state(PROFILE, stamp_ns=stamp_ns, plan_ns=plan_ns)
        inbox.receive(topics.ACTUATOR_STATE, codec.encode(state), 0)
        heard.take_in(truth, inbox)
    assert heard.capture_to_plan_ns == [60, 90], "renewals, older maps, and plans without a map do not count"


def test_each_warning_is_kept_once_with_its_first_step() -> None:
    heard, inbox = RunLog(), Inbox(topics.TOPICS, Stages())
    heard.take_in(ground_truth(1_000_000_000), inbox)
    for step, warnings in ((3, ("a horn is off by about 3 deg",)), (4, ("a horn is off by about 4 deg", "hot"))):
        state = actuator_state(PROFILE, stamp_ns=step * 1_000_000_000, step=step, warnings=warnings)
        inbox.receive(topics.ACTUATOR_STATE, codec.encode(state), 0)
        heard.take_in(ground_truth(step * 1_000_000_000), inbox)
    named = "the camera looks 2.9 deg (2.6 to 3.2) lower"
    for finding in (
        "",
        f"{named} and sits 9 mm (8 to 10) higher than its profile says: run `x`",
        f"{named} than its profile",
        "",
    ):
        errors = CameraErrors(5_000_000_000, np.zeros(6), np.ones(6), np.zeros(6), finding)
        inbox.receive(topics.CAMERA_ERRORS, codec.encode(errors), 0)
        heard.take_in(ground_truth(5_000_000_000), inbox)
    assert list(heard.warnings.values()) == [
        Warned(2.0, 3, "a horn is off by about 3 deg"),
        Warned(3.0, 4, "hot"),
        Warned(4.0, 4, named),
        Warned(4.0, 4, "the camera sits 9 mm (8 to 10) higher"),
    ]
    assert heard.camera_errors is not None
    assert heard.camera_errors.finding == "", "the newest one"


def test_number_of_kept_warnings_is_limited() -> None:
    heard, inbox = RunLog(), Inbox(topics.TOPICS, Stages())
    for number in range(300):
        state = actuator_state(PROFILE, warnings=("x" * number,))
        inbox.receive(topics.ACTUATOR_STATE, codec.encode(state), 0)
        heard.take_in(ground_truth(0), inbox)
    assert len(heard.warnings) == 100


def test_truth_is_kept_in_columns() -> None:
    log = TruthLog()
    assert len(log) == len(log["stamp_ns"]) == 0
    for k in range(2500):
        log.append(ground_truth(k, 0.1 * k))
    assert len(log) == 2500
    np.testing.assert_array_equal(log["stamp_ns"], np.arange(2500))
    np.testing.assert_array_equal(log["q"], np.tile(0.1 * np.arange(2500)[:, None, None], (1, 6, 3)))
    assert log["T_world_body"].shape == (2500, 4, 4)


def test_kept_states_share_equal_arrays_and_keep_different_ones() -> None:
    heard, inbox = RunLog(), Inbox(topics.TOPICS, Stages())
    for swing in (False, False, True):
        state = actuator_state(PROFILE, swing=np.full(6, swing))
        inbox.receive(topics.ACTUATOR_STATE, codec.encode(state), 0)
        heard.take_in(ground_truth(0), inbox)
    first, second, third = heard.states
    assert second.swing is first.swing
    assert second.touchdown_point is third.touchdown_point is first.touchdown_point
    assert third.swing.all()
    assert not first.swing.any()
