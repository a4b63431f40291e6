"""Limits of services that depend on each other: one side's number suits the other side's.

Services do not import each other, so nothing else keeps these pairs in step.
"""

import pytest

from sextant.evaluation.video import sinking
from sextant.services.actuator.config import Settings as ActuatorSettings
from sextant.services.actuator.locomotion import swing_trajectory
from sextant.services.actuator.safety import plan_validation
from sextant.services.actuator.safety.command_arbiter import LEASE_NS
from sextant.services.actuator.safety.command_ordering import ORDER_AGE_NS
from sextant.services.actuator.safety.guard import DEADLINE_NS
from sextant.services.console.web import command_repeater
from sextant.services.mapper import service as mapper
from sextant.services.mapper.config import Settings as MapperSettings
from sextant.services.perception import service as perception
from sextant.services.perception.config import Settings as PerceptionSettings
from sextant.services.planner import operator_request
from sextant.services.planner import service as planner
from sextant.services.planner.config import Settings as PlannerSettings
from sextant.services.planner.locomotion import plan_tracking
from sextant.services.planner.locomotion.gait import GAITS
from sextant.services.planner.locomotion.swing_clearance import LEVEL
from sextant.services.simulator.physics import world
from sextant.shared.robot.profile import LONGEST_STEP_S, SHORTEST_STEP_S
from sextant.shared.robot.profiles import load_profile, profile_names

ACTUATOR, MAPPER, PERCEPTION, PLANNER = ActuatorSettings(), MapperSettings(), PerceptionSettings(), PlannerSettings()


@pytest.mark.parametrize("robot", profile_names())
def test_guard_admits_the_steps_that_a_profile_asks_for(robot: str) -> None:
    stance = load_profile(robot).stance
    low, high = SHORTEST_STEP_S, LONGEST_STEP_S
    assert all(low <= stance.step_s * gait.pace <= high for gait in GAITS.values())
    assert low <= PLANNER.blind_walking.step_s <= high
    assert low <= PLANNER.step.shift_s <= high


def test_feet_stand_in_a_planned_step_as_long_as_the_actuator_takes() -> None:
    assert PLANNER.step.handover_s == pytest.approx(ACTUATOR.unload_s + ACTUATOR.load_s)


def test_swing_is_level_at_the_same_height_for_all() -> None:
    assert LEVEL == swing_trajectory._LEVEL_SHARE == plan_validation.FLIES_AT


def test_scans_reach_as_far_as_the_mapper_assumes() -> None:
    assert (MAPPER.scan_range, MAPPER.resolution) == (PERCEPTION.scan_range, PERCEPTION.scan_resolution)


def test_input_that_the_next_service_would_ignore_is_not_processed() -> None:
    assert PLANNER.revision.pose_age_s > perception._MAX_FRAME_AGE_S
    assert PLANNER.revision.map_age_s > mapper._MAX_SCAN_AGE_S
    assert ACTUATOR.plan_age_s > planner._MAX_STATE_AGE_S


def test_repeated_messages_arrive_several_times_within_their_limits() -> None:
    for period_ns, limit_ns in ((plan_tracking._RENEW_NS, DEADLINE_NS), (command_repeater._REPEAT_NS, LEASE_NS)):
        assert 4 * period_ns < limit_ns


def test_console_repeats_a_command_as_long_as_the_actuator_accepts_it() -> None:
    assert command_repeater._RECEIVED_NS == ORDER_AGE_NS
    assert operator_request._MAX_STAMP_DIFFERENCE_S == 1e-9 * ORDER_AGE_NS


def test_weak_ground_sinks_in_the_video_as_in_the_simulator() -> None:
    assert sinking._SPEED == world._SINKING
