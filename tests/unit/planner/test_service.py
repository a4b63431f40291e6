"""Planner service: required inputs, status and plans."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.params import RevisionParams
from sextant.services.planner.locomotion.step_planner import SHARES, NoStep, StepPlanner
from sextant.services.planner.navigation.path_follower import MotionCommand, PathFollower
from sextant.services.planner.navigation.path_planner import NoPath
from sextant.services.planner.service import Planner
from sextant.services.planner.terrain import Terrain, flat_terrain
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation, yaw_of
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import (
    BodyPose,
    CameraState,
    Goal,
    Message,
    Mode,
    PlannerStatus,
    PostureCommand,
    ScanReceipt,
    StepPlan,
    TerrainMap,
    VelocityCommand,
)
from tests.support.states import actuator_state
from tests.unit.planner.conftest import terrain_of

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.11
MS = 1_000_000
REST = PROFILE.rest_feet(HEIGHT)
FLAT = flat_terrain(0, np.zeros(2), 0.0, half_size=2.0).map
NO_SWING = np.zeros(6, dtype=bool)
Maker = Callable[..., Terrain]


def standing(x: float = 0.0) -> Array:
    return from_xyz_rpy((x, 0.0, HEIGHT), np.zeros(3))


class Rig:
    """A planner and a robot that follows its plans exactly."""

    def __init__(self, settings: Settings | None = None) -> None:
        self.planner = Planner(PROFILE, settings or Settings())
        self.inbox = Inbox([self.planner.trigger, *self.planner.subscribes], self.planner.stages)
        self.now_ns = 1_000 * MS
        self.terrain: TerrainMap | None = FLAT
        self.pose: BodyPose | None = BodyPose(0, np.eye(4), np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))
        self.command: VelocityCommand | None = VelocityCommand(0, np.array([0.06, 0.0]), 0.0, HEIGHT, 0.04)
        self.posture: PostureCommand | None = None
        self.goal: Goal | None = None
        self.asked_ago_ns = 0  # [ns] by which the stamps of `command` and `goal` lie back
        self.running: StepPlan | None = None
        self.state = actuator_state(PROFILE, reason="standing", feet=REST, T_odom_body=standing(), body_ref=standing())

    def cycle(self, **state: Any) -> list[Message]:
        """Advance by one actuator state and publish all available inputs again."""
        self.now_ns += 20 * MS
        self.inbox.now_ns = self.now_ns
        for message in (self.terrain, self.pose, self.command, self.posture, self.goal):
            if message is not None:
                asked = isinstance(message, VelocityCommand | PostureCommand | Goal)
                fresh = replace(message, stamp_ns=self.now_ns - self.asked_ago_ns * asked)
                self.inbox.receive(topics.OF_TYPE[type(fresh)], codec.encode(fresh), self.now_ns)
        self.state = replace(self.state, stamp_ns=self.now_ns, **state)
        return list(self.planner.step(self.state, self.inbox))

    def plans(self, cycles: int = 1, **state: Any) -> list[StepPlan]:
        """Return the new plans, without the repeated ones of the running step."""
        made = [m for _ in range(cycles) for m in self.cycle(**state) if isinstance(m, StepPlan)]
        return [plan for plan in made if not self._renews(plan)]

    def _renews(self, plan: StepPlan) -> bool:
        running = self.running
        if running is None or plan.step != running.step:
            return False
        now, then = (apply(inverse(p.T_world_odom), p.touchdown) for p in (plan, running))
        return bool(np.abs(now - then).max() < 1e-9)

    def status(self) -> PlannerStatus:
        """Return the next status, within a tenth of a second."""
        return next(m for _ in range(10) for m in self.cycle() if isinstance(m, PlannerStatus))

    def begin(self, plan: StepPlan) -> None:
        """Let the actuator begin to walk a plan."""
        self.running = plan
        self.state = replace(self.state, mode=Mode.WALK, step=plan.step, phase=0.0, swing=plan.swing, plan_ns=plan.stamp_ns)

    def finish(self, plan: StepPlan) -> None:
        """Let the actuator complete a plan."""
        feet = apply(inverse(plan.body_goal), plan.touchdown)
        body = inverse(plan.T_world_odom) @ plan.body_goal
        self.state = replace(
            self.state, mode=Mode.HOLD, phase=1.0, swing=NO_SWING, feet=feet, body_ref=body, T_odom_body=body, step=plan.step
        )


def test_planner_steps_with_all_inputs() -> None:
    rig = Rig()
    (plan,) = rig.plans()
    assert plan.step == 1
    assert plan.stamp_ns == rig.state.stamp_ns
    assert plan.swing.sum() == 3
    assert plan.body_goal[0, 3] == pytest.approx(0.06 * PROFILE.stance.step_s)
    status = rig.status()
    assert status.state == "stepping"
    assert rig.planner.status().startswith("stepping")


def test_time_from_depth_image_to_executed_plan_is_a_stage() -> None:
    rig = Rig()
    (plan,) = rig.plans()
    assert "capture to plan" not in rig.planner.stages.percentiles()
    rig.cycle()
    rig.begin(plan)
    rig.cycle()
    assert rig.planner.stages.percentiles()["capture to plan"] == pytest.approx((40.0, 40.0))


def test_standing_robot_takes_a_posture_without_a_map() -> None:
    rig = Rig()
    rig.command, rig.terrain = None, None
    rig.posture = PostureCommand(0, np.array([0.0, 0.01, 0.02]), np.array([0.05, 0.1, 0.0]))
    (plan,) = rig.plans()
    assert not plan.swing.any()
    assert plan.stop
    np.testing.assert_allclose(plan.body_goal[:3, 3] - standing()[:3, 3], [0.0, 0.01, 0.02], atol=1e-9)
    rig.begin(plan)
    assert rig.plans(3) == []
    rig.finish(plan)
    assert rig.plans(3) == []
    assert rig.status().state == "arrived"


def test_posture_that_the_actuator_refuses_is_blocked_with_its_reason() -> None:
    rig = Rig()
    rig.command, rig.posture = None, PostureCommand(0, np.array([0.0, 0.0, 0.3]), np.zeros(3))
    for _ in range(2):
        plan = rig.plans(20)[0]
        rig.cycle(refused_plan_ns=plan.stamp_ns, plan_refusal="out of reach")
    said = [(m.state, m.reason) for _ in range(30) for m in rig.cycle() if isinstance(m, PlannerStatus)]
    assert said[-1] == ("blocked", "posture: out of reach")
    rig.posture = replace(rig.posture, place=np.array([0.0, 0.0, 0.02]))
    assert rig.plans(3), "another posture is tried at once"


def test_reduced_servo_pace_shortens_step() -> None:
    rig = Rig()
    rig.state = replace(rig.state, speed_scale=0.5)
    (plan,) = rig.plans()
    assert plan.body_goal[0, 3] == pytest.approx(0.03 * PROFILE.stance.step_s)


@pytest.mark.parametrize(
    ("missing", "words"),
    [("terrain", "no fresh terrain map"), ("pose", "no fresh pose"), ("command", "no fresh velocity command")],
)
@pytest.mark.parametrize("ever", [True, False])
def test_missing_or_stale_input_is_waited_for_and_named(missing: str, words: str, ever: bool) -> None:
    rig = Rig()
    if ever:
        rig.plans()
    kept = getattr(rig, missing)
    setattr(rig, missing, None)
    rig.plans(60)  # the inputs become stale
    assert rig.plans(20) == []
    status = rig.status()
    assert status.state in ("waiting", "resting")
    assert words in status.reason
    setattr(rig, missing, kept)
    assert rig.plans()


@pytest.mark.parametrize("missing", ["terrain", "pose"])
def test_camera_fault_is_named_when_map_or_pose_is_missing(missing: str) -> None:
    rig = Rig()
    setattr(rig, missing, None)
    rig.plans(60)
    for ok, named in ((False, True), (True, False)):
        state = CameraState(rig.now_ns, device="openni2", ok=ok, reason="" if ok else "no device found; plug it in")
        rig.inbox.receive(topics.CAMERA_STATE, codec.encode(state), rig.now_ns)
        assert ("the camera sends no images: no device found" in rig.status().reason) is named
    rig.plans(50)
    assert "camera" not in rig.status().reason, "no message for a second"


def unusable_maps(map_: TerrainMap) -> dict[str, TerrainMap]:
    """Return maps that are well formed but not usable."""
    shape, cells = map_.elevation.shape, ("elevation", "variance", "score", "assumed", "evaluation")
    unknown, rng = np.full(shape, np.nan, np.float32), np.random.default_rng(0)
    return {
        "not seen": replace(map_, elevation=unknown, score=unknown),
        "(113 cells": replace(map_, elevation=np.full(shape, np.inf, np.float32)),
        "left front leg": replace(map_, elevation=rng.normal(0.0, 1.0, shape).astype(np.float32)),
        "found 0 m": replace(map_, resolution=0.0),
        "found -0.01 m": replace(map_, resolution=-0.01),
        "found 1e-300 m": replace(map_, resolution=1e-300),
        "found 1e+09 m": replace(map_, resolution=1e9),
        "found none": replace(map_, **{name: getattr(map_, name)[:0, :0] for name in cells}),
        "an origin within": replace(map_, origin=np.full(2, 1e9)),
        "differences of the legs of at most 0.05 m expected": replace(
            map_, leg_heights=np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0])
        ),
    }


@pytest.mark.slow
@pytest.mark.parametrize("words", unusable_maps(FLAT))
def test_unusable_map_is_refused_and_next_valid_map_is_used(words: str) -> None:
    rig = Rig()
    rig.terrain, kept = unusable_maps(FLAT)[words], rig.terrain
    assert rig.plans(30) == []
    assert words in rig.status().reason
    rig.terrain = kept
    assert rig.plans(30)


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.STAND, Mode.FAULT])
def test_planner_waits_for_walkable_actuator_mode(mode: Mode) -> None:
    rig = Rig()
    rig.state = replace(rig.state, mode=mode, reason="a servo reports overload")
    assert rig.plans(10) == []
    assert mode in rig.status().reason
    assert "a servo reports overload" in rig.status().reason


def test_zero_velocity_gives_no_step() -> None:
    rig = Rig()
    rig.command = VelocityCommand(0, np.zeros(2), 0.0, HEIGHT, 0.04)
    assert rig.plans(20) == []
    assert rig.status().state == "resting"
    rig.command = VelocityCommand(0, np.zeros(2), 0.3, HEIGHT, 0.04)  # turning on the spot is a motion, too
    assert rig.plans(20)


def test_planner_is_blocked_on_unseen_ground_until_map_arrives(make_terrain: Maker) -> None:
    rig = Rig()
    rig.terrain = make_terrain(lambda x, y: np.full_like(x, np.nan), lambda x, y: np.full_like(x, np.nan)).map
    assert rig.plans(30) == []
    status = rig.status()
    assert status.state == "blocked"
    assert "not seen" in status.reason
    assert status.blocked_leg in range(6)
    rig.terrain = FLAT
    assert rig.plans(10)
    assert rig.status().state == "stepping"
    assert rig.status().blocked_leg == -1


def test_blind_mode_steps_at_foot_height_without_map() -> None:
    rig = Rig(Settings(blind=True))
    rig.terrain = None
    (plan,) = rig.plans()
    np.testing.assert_allclose(plan.touchdown[plan.swing, 2], PROFILE.foot.radius, atol=1e-6)


def test_walk_alternates_tripods_and_advances() -> None:
    rig, sets, reached = Rig(), [], []
    for number in range(1, 6):
        plan = rig.plans(10)[-1]
        assert plan.step == number
        rig.begin(plan)
        rig.plans(1, phase=0.1)
        rig.finish(plan)
        sets.append(plan.swing)
        reached.append(plan.body_goal[0, 3])
    for before, after in pairwise(sets):
        np.testing.assert_array_equal(after, ~before)
    np.testing.assert_allclose(np.diff(reached), 0.06 * PROFILE.stance.step_s, atol=1e-6)


def test_next_step_starts_from_end_of_running_step() -> None:
    rig = Rig()
    first = rig.plans(10)[-1]
    rig.begin(first)
    assert rig.plans(3, phase=0.2) == []  # no new plan
    second = rig.plans(10, phase=0.8)[-1]
    assert second.step == 2
    np.testing.assert_array_equal(second.swing, ~first.swing)
    np.testing.assert_allclose(second.touchdown[first.swing], first.touchdown[first.swing], atol=1e-9)
    assert second.body_goal[0, 3] - first.body_goal[0, 3] == pytest.approx(first.body_goal[0, 3], abs=1e-6)


def test_plan_of_running_step_is_republished() -> None:
    rig = Rig()
    first = rig.plans(10)[-1]
    rig.begin(first)
    assert rig.pose is not None
    turned = from_xyz_rpy((0.01, -0.02, 0.003), np.array([0.0, 0.0, 0.01]))
    rig.pose = replace(rig.pose, T_world_odom=turned)  # the current estimate of the world
    sent: list[StepPlan] = []
    for k in range(45):
        made = [m for m in rig.cycle(phase=min(0.02 * k, 0.9)) if isinstance(m, StepPlan)]
        sent += made
        rig.state = replace(rig.state, plan_ns=next((m.stamp_ns for m in made if m.step == first.step), rig.state.plan_ns))
    stamps = [plan.stamp_ns for plan in sent]
    assert max(np.diff(stamps)) <= 100 * MS
    renewed = [plan for plan in sent if plan.step == first.step and rig._renews(plan)]
    assert len(renewed) > 5
    for plan in renewed:
        np.testing.assert_allclose(inverse(plan.T_world_odom) @ plan.body_goal, first.body_goal, atol=1e-9)
    rig.finish(first)
    rig.command = None
    rig.plans(60)
    assert rig.plans(60) == []  # a step that has ended is not renewed


def test_plan_revisions_and_stamps_increase() -> None:
    rig = Rig()
    maps = rig.plans(3)
    assert len(maps) == 3, "each map leads to a plan"
    rig.terrain = None  # no newer map
    plans = maps[-1:] + rig.plans(35)
    assert len(plans) > 2
    assert [p.revision for p in plans] == list(range(3, len(plans) + 3))
    assert {p.step for p in plans} == {1}
    gaps = np.diff([p.stamp_ns for p in plans])
    assert (gaps >= round(rig.planner._settings.revision.interval_s * 1e9)).all()


def test_newer_map_retargets_touchdowns_of_running_step(make_terrain: Maker) -> None:
    rig = Rig()
    first = rig.plans(10)[-1]
    rig.begin(first)
    leg = int(np.flatnonzero(first.swing)[0])
    bad = first.touchdown[leg, :2]
    rig.terrain = make_terrain(score=lambda x, y: np.where(np.hypot(x - bad[0], y - bad[1]) < 0.02, 9.0, 0.0)).map
    (revised,) = rig.plans(phase=0.2)
    rig.begin(revised)
    assert (revised.step, revised.revision) == (first.step, first.revision + 1)
    np.testing.assert_array_equal(revised.swing, first.swing)
    np.testing.assert_array_equal(revised.body_goal, first.body_goal)
    moved = np.abs(revised.touchdown - first.touchdown).max(axis=1) > 1e-6
    np.testing.assert_array_equal(np.flatnonzero(moved), [leg])
    assert rig.plans(3, phase=0.3) == []  # sent once


def test_revision_after_pose_correction_matches_actuator_goal(make_terrain: Maker) -> None:
    rig = Rig()
    first = rig.plans(10)[-1]
    rig.begin(first)
    T = from_xyz_rpy((0.02, -0.01, 0.0), (0.0, 0.0, 0.03))
    assert rig.pose is not None
    rig.pose = replace(rig.pose, T_world_body=T @ rig.pose.T_world_body, T_world_odom=T)
    assert rig.plans(3, phase=0.1) == []  # on level ground all places are equal
    leg = int(np.flatnonzero(first.swing)[0])
    bad = apply(T, first.touchdown)[leg, :2]
    rig.terrain = make_terrain(score=lambda x, y: np.where(np.hypot(x - bad[0], y - bad[1]) < 0.02, 9.0, 0.0)).map
    (revised,) = rig.plans(phase=0.2)
    # The actuator applies the correction to the body's goal and leaves standing feet where they are.
    np.testing.assert_allclose(revised.body_goal, T @ first.body_goal, atol=1e-9)
    standing_still = ~revised.swing
    np.testing.assert_allclose(revised.touchdown[standing_still], apply(T, first.touchdown)[standing_still], atol=1e-9)


def test_infeasible_command_is_refused_with_reason() -> None:
    rig = Rig()
    assert rig.command is not None
    rig.command = replace(rig.command, body_height=0.25)
    assert rig.plans(3) == []
    assert rig.status().reason == "a body height of 0.085 to 0.15 m expected, 0.25 m commanded"


def test_revision_in_reverse_order_is_refused() -> None:
    with pytest.raises(ValueError, match="retarget_until_phase: less than plan_from_phase expected, found"):
        RevisionParams(retarget_until_phase=0.6, plan_from_phase=0.5)


def test_nearly_complete_step_is_not_revised(make_terrain: Maker) -> None:
    rig = Rig()
    first = rig.plans(10)[-1]
    rig.begin(first)
    rig.plans(1, phase=0.1)
    rig.terrain = make_terrain(score=lambda x, y: np.full_like(x, 0.9), height=lambda x, y: np.full_like(x, 0.02)).map
    between = (rig.planner._settings.revision.retarget_until_phase + rig.planner._settings.revision.plan_from_phase) / 2
    assert rig.plans(5, phase=between) == []


def test_restarted_planner_waits_for_end_of_unknown_step() -> None:
    old = Rig()
    first = old.plans(10)[-1]
    new = Rig()
    new.begin(replace(first, step=7))
    assert new.plans(10, phase=0.2) == []
    assert new.plans(10, phase=0.8) == []
    assert "unknown step in progress" in new.status().reason
    new.finish(replace(first, step=7))
    assert {p.step for p in new.plans(10)} == {8}


def test_actuator_restart_resets_step_number() -> None:
    rig = Rig()
    for _ in range(3):
        plan = rig.plans(10)[-1]
        rig.begin(plan)
        rig.plans(1, phase=0.1)
        rig.finish(plan)
    rig.state = replace(rig.state, step=0, phase=1.0, swing=NO_SWING, plan_ns=-1)
    plans = rig.plans(10)
    assert {p.step for p in plans} == {1}


def test_pose_correction_during_step_keeps_plan_fixed_in_odom() -> None:
    """Check that a plan stays fixed in {odom} when the world slides under it."""
    rig = Rig()
    first = rig.plans(10)[-1]
    rig.begin(first)
    shift = from_xyz_rpy((0.01, -0.02, 0.0), (0.0, 0.0, 0.05))
    assert rig.pose is not None
    rig.pose = replace(rig.pose, T_world_odom=shift)
    second = rig.plans(10, phase=0.8)[-1]
    there = apply(inverse(second.T_world_odom), second.touchdown)[first.swing]
    np.testing.assert_allclose(there, first.touchdown[first.swing], atol=1e-9)


@pytest.mark.parametrize("posture", [None, PostureCommand(0, np.array([0.0, 0.0, 0.02]), np.zeros(3))])
def test_blocked_planner_limits_its_search_rate(make_terrain: Maker, posture: PostureCommand | None) -> None:
    rig = Rig()
    rig.posture = posture  # the velocity command overrides it
    rig.terrain = make_terrain(score=lambda x, y: np.full_like(x, 9.0)).map
    rig.plans(50)
    searches = rig.planner.stages.runs("plan step")
    assert searches <= 1 + 1.0 / rig.planner._settings.revision.interval_s


def refused(rig: Rig, cycles: int, why: str = "out of reach", until: int = 1000) -> list[StepPlan]:
    """Return the plans sent to an actuator that refuses all but the last.

    The rig stops once `until` plans have come.
    """
    plans: list[StepPlan] = []
    for _ in range(cycles):
        if len(plans) == until:
            break
        newest = plans[-1].stamp_ns if plans else -1
        plans += rig.plans(plan_refusal=why if plans else "", refused_plan_ns=newest)
    return plans


def test_refused_step_is_shortened_then_tried_with_other_legs() -> None:
    """Check the order of attempts: newer estimates, shorter steps, then other legs.

    At the end the planner reports that no step is accepted.
    """
    rig = Rig()
    first, again, *others = refused(rig, 150)
    np.testing.assert_array_equal(again.touchdown, first.touchdown)
    travel = [p.body_goal[0, 3] for p in (again, *others)]
    other_legs = [bool((p.swing != first.swing).any()) for p in (again, *others)]
    turn = other_legs.index(True)
    assert all(other_legs[turn:])
    for part in (travel[:turn], travel[turn:]):
        assert len(part) > 1
        assert (np.diff(part) < 0).all()
    assert rig.status().state == "blocked"
    assert rig.status().reason == "the actuator refuses every feasible step: out of reach"


def test_planner_retries_occasionally_after_all_steps_were_refused() -> None:
    rig = Rig()
    assert len(refused(rig, 130)) <= 2 * len(SHARES) + 1
    plan = next(p for _ in range(110) for p in rig.plans())
    assert rig.status().state == "blocked"
    rig.begin(plan)
    rig.plans(1, phase=0.1)
    rig.finish(plan)
    assert rig.plans(10)
    assert rig.status().state == "stepping"


def test_other_legs_are_tried_when_shorter_steps_have_no_foothold(make_terrain: Maker) -> None:
    rig = Rig()
    (first,) = rig.plans()
    near = first.touchdown[first.swing, :2]

    def only_there(x: Array, y: Array) -> Array:  # only the first choice carries the tripod that is due
        at = (np.hypot(x[..., None] - near[:, 0], y[..., None] - near[:, 1]) < 0.005).any(axis=-1)
        theirs = (np.hypot(x[..., None] - near[:, 0], y[..., None] - near[:, 1]) < 0.12).any(axis=-1)
        return np.where(theirs & ~at, 9.0, 0.0)

    rig = Rig()
    rig.terrain = make_terrain(score=only_there).map
    plans = refused(rig, 60)
    assert any((p.swing != first.swing).any() for p in plans)


def test_blocked_robot_gathers_its_feet_and_then_walks_on() -> None:
    rig = Rig()
    rig.command = VelocityCommand(0, np.array([0.11, 0.0]), 0.0, HEIGHT, 0.04)
    behind = 1e-3 * np.array([[-47, 16], [-66, 0], [11, 1], [-38, 2], [12, 1], [-41, -1]])
    rig.state = replace(rig.state, feet=REST + np.column_stack([behind, np.zeros(6)]))
    (plan,) = rig.plans()
    np.testing.assert_allclose(plan.body_goal[:2, 3], 0.0, atol=1e-9)
    status = rig.status()
    assert status.state == "blocked", "the step does not lead on"
    assert status.reason.startswith("moving the feet back under the body: ")
    assert "out of reach" in status.reason
    rig.begin(plan)
    rig.cycle()
    rig.finish(plan)
    (onward,) = rig.plans()
    assert onward.body_goal[0, 3] > 0.01
    assert rig.status().state == "stepping"


def test_refused_step_towards_goal_is_not_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check two commands, the first of which the ground forbids.

    All ways are tried with the second, though the planner considers both each time.
    """
    rig = Rig()
    rig.command, rig.goal = None, towards((1.0, 0.0))
    straight = VelocityCommand(0, np.array([0.06, 0.0]), 0.0, HEIGHT, 0.04)
    turning = replace(straight, yaw_rate=0.3)
    choose = StepPlanner.choose
    blocked = NoStep("the ground forbids it")
    monkeypatch.setattr(
        StepPlanner, "choose", lambda self, at, *more: (blocked, 0) if at[0].command.yaw_rate else choose(self, at, *more)
    )
    monkeypatch.setattr(PathFollower, "lead", lambda *_: MotionCommand((turning, straight), "to a goal"))
    first, again, *others = refused(rig, 150)
    np.testing.assert_array_equal(again.touchdown, first.touchdown)
    assert len(others) > 3
    assert any((plan.swing != first.swing).any() for plan in others)
    status = rig.status()
    assert status.state == "blocked"
    assert "the actuator refuses every feasible step" in status.reason


@pytest.mark.parametrize(
    "change",
    [
        {"velocity": np.array([-0.06, 0.0])},
        {"yaw_rate": 0.2},
        {"body_height": HEIGHT - 0.02},
        {"lift": 0.06},
    ],
)
def test_changed_command_is_tried_immediately_after_refusals(change: dict[str, Any]) -> None:
    rig = Rig()
    refused(rig, 150)
    assert rig.status().state == "blocked"
    assert rig.command is not None
    rig.command = replace(rig.command, **change)
    rig.planner._due_ns = 0
    assert rig.plans(2)
    assert rig.status().state == "stepping"


def test_zero_command_resets_refusals() -> None:
    rig = Rig()
    refused(rig, 150)
    asked, rig.command = rig.command, VelocityCommand(0, np.zeros(2), 0.0, HEIGHT, 0.04)
    rig.plans(110)
    rig.command = asked
    assert rig.plans(12)
    assert rig.status().state == "stepping"


def test_plan_refused_for_mode_is_repeated_unchanged() -> None:
    rig = Rig()
    plans = rig.plans(100, plan_refusal="plan of step 1 refused: the mode is hold, not ordered to walk")
    assert len(plans) > 5
    np.testing.assert_array_equal(plans[-1].body_goal, plans[0].body_goal)


def test_accepted_step_resets_refusals() -> None:
    rig = Rig()
    plan = refused(rig, 100, until=4)[-1]
    rig.begin(plan)
    rig.plans(1, phase=0.1, plan_refusal="")
    rig.finish(plan)
    assert rig.plans(10)[-1].body_goal[0, 3] - plan.body_goal[0, 3] == pytest.approx(0.06 * PROFILE.stance.step_s, abs=1e-6)


def towards(*waypoints: tuple[float, float]) -> Goal:
    return Goal(0, np.array(waypoints), 0.03, 0.10, HEIGHT, 0.04)


def rig_with_goal(*waypoints: tuple[float, float]) -> Rig:
    """Return a rig with a goal and no velocity command."""
    rig = Rig()
    rig.command, rig.goal = None, towards(*waypoints)
    return rig


@pytest.mark.parametrize(("ago_ms", "words"), [(2_001, "2.0 s old"), (60_000, "60.0 s old"), (-2_001, "stamped 2.0 s ahead")])
@pytest.mark.parametrize("what", ["velocity command", "goal"])
def test_command_or_goal_with_stale_or_future_stamp_is_refused(what: str, ago_ms: int, words: str) -> None:
    rig = rig_with_goal((1.0, 0.0)) if what == "goal" else Rig()
    rig.now_ns += 100_000 * MS
    rig.asked_ago_ns = ago_ms * MS
    assert rig.plans(20) == []
    assert rig.status().reason.startswith(f"the {what} is {words} by the robot's clock, at most 2 s allowed")
    rig.asked_ago_ns = (2_000 if ago_ms > 0 else -2_000) * MS
    assert rig.plans(20), "two seconds may be between them"


def take_steps(rig: Rig, most: int) -> list[Array]:
    """Walk until no step comes; return the body's place (3,) [m] {world} after each."""
    reached: list[Array] = []
    for _ in range(most):
        plans = rig.plans(15)
        if not plans:
            break
        rig.begin(plans[-1])
        rig.plans(1, phase=0.1)
        rig.finish(plans[-1])
        assert rig.pose is not None
        rig.pose = replace(rig.pose, T_world_body=plans[-1].body_goal)
        reached.append(plans[-1].body_goal[:3, 3])
    return reached


def test_goal_is_reached_through_its_waypoints() -> None:
    rig = rig_with_goal((0.4, 0.2), (0.6, 0.0))
    reached = take_steps(rig, 60)
    assert min(np.linalg.norm(p[:2] - (0.4, 0.2)) for p in reached) < 0.10
    assert np.linalg.norm(reached[-1][:2] - (0.6, 0.0)) <= 0.03
    status = rig.status()
    assert (status.state, status.reason) == ("arrived", "at the goal (0.6, 0.0)")
    assert status.path.tolist() == [[0.6, 0.0]], "arrived at this goal, not at another"
    assert rig.plans(50) == []


def test_robot_has_arrived_once_all_legs_rest_at_the_goal() -> None:
    rig = rig_with_goal((0.05, 0.0))
    plan = rig.plans(15)[-1]
    rig.begin(plan)
    rig.plans(15, phase=0.9)
    status = rig.status()
    assert (status.state, status.reason) == ("stepping", "the running step ends at the goal (0.1, 0.0)")
    assert not len(status.path)
    short = plan.body_goal.copy()
    short[0, 3] = 0.005  # the feet are set down early, as under load
    rig.finish(replace(plan, body_goal=short))
    assert rig.pose is not None
    rig.pose = replace(rig.pose, T_world_body=short)
    plan = rig.plans(15)[-1]
    assert plan.body_goal[0, 3] > 0.02
    rig.begin(plan)
    rig.plans(1, phase=0.1)
    rig.finish(plan)
    rig.pose = replace(rig.pose, T_world_body=plan.body_goal)
    assert rig.plans(15) == []
    assert rig.status().state == "arrived"


def test_status_contains_current_path() -> None:
    rig = rig_with_goal((0.6, 0.0))
    rig.plans(3)
    status = rig.status()
    assert status.state == "stepping"
    assert status.reason.startswith("0.6 m of path left to (0.6, 0.0)")
    np.testing.assert_allclose(status.path[[0, -1]], [[0.0, 0.0], [0.6, 0.0]], atol=1e-9)


def test_velocity_command_has_priority_over_goal() -> None:
    rig = rig_with_goal((0.6, 0.0))
    rig.command = VelocityCommand(0, np.zeros(2), 0.0, HEIGHT, 0.04)
    assert rig.plans(20) == []
    assert rig.status().reason == "the commanded velocity is zero"
    assert not len(rig.status().path)
    rig.command = None
    assert rig.plans(30)
    rig.goal = None
    rig.plans(60)
    assert rig.plans(20) == []
    assert rig.status().reason == "no fresh velocity command and no goal"


def by_touch() -> Rig:
    """Return a rig without map and pose whose operator requests blind walking."""
    rig = Rig()
    rig.cycle()
    rig.pose = rig.terrain = None
    assert rig.command is not None
    rig.command = replace(rig.command, blind_walking=True)
    rig.now_ns += 5_000 * MS
    return rig


def test_blind_walking_without_pose_and_map_is_slow_with_high_lift() -> None:
    rig = by_touch()
    (plan,) = rig.plans(10)[:1]
    params = Settings().blind_walking
    assert plan.stop
    assert plan.duration == params.step_s
    assert np.linalg.norm(plan.body_goal[:2, 3]) <= params.stride_m + 1e-9
    low = plan.touchdown[plan.swing, 2] - PROFILE.foot.radius
    assert low.max() <= -0.03, "feet are sent below the ground"
    assert low.min() >= -0.05 - 1e-9
    assert (plan.clearance[plan.swing] >= params.lift_m - 1e-9).all()
    np.testing.assert_allclose(plan.touchdown[~plan.swing], apply(standing(), REST)[~plan.swing], atol=1e-9)
    assert "by touch" in rig.status().reason


def test_no_blind_walking_with_servos_that_measure_nothing() -> None:
    rig = by_touch()
    rig.planner = Planner(load_profile("printed_ds3218"), Settings())
    assert not rig.plans(20)
    assert rig.status().state == "blocked"
    assert "measure nothing" in rig.status().reason


def test_no_blind_walking_without_operator_request() -> None:
    rig = by_touch()
    assert rig.command is not None
    rig.command = replace(rig.command, blind_walking=False)
    assert not rig.plans(20)
    assert rig.status().state == "waiting"
    assert "no fresh pose" in rig.status().reason


def test_blind_walking_waits_until_all_feet_stand() -> None:
    rig = by_touch()
    plan = rig.plans(10)[0]
    rig.begin(plan)
    assert not rig.plans(20, phase=0.5)
    assert not rig.plans(20, phase=0.9)
    rig.finish(plan)
    following = rig.plans(20)[0]
    assert following.step == plan.step + 1
    np.testing.assert_array_equal(following.swing, ~plan.swing)


def test_blind_walking_assumes_ground_is_foot_plane() -> None:
    """Check that on a slope the feet are sent along it."""
    rig = by_touch()
    slope = np.tan(np.radians(6.0))
    feet = REST.copy()
    feet[:, 2] += slope * REST[:, 0]
    plan = rig.plans(10, feet=feet)[0]
    depth = plan.touchdown[:, 2] - PROFILE.foot.radius - slope * plan.touchdown[:, 0]
    # They go to one of the depths that legs can reach. Along level ground the rear feet would be 4 cm off.
    np.testing.assert_allclose(depth[plan.swing], depth[plan.swing][0], atol=0.012)
    assert -0.051 < depth[plan.swing][0] < -0.02
    nose_up = -rpy_from_rotation(plan.body_goal[:3, :3])[1]
    assert 0.0 < nose_up < np.radians(6.0), "the body follows the ground, a part of the way in each step"


def test_blind_walking_needs_at_least_one_pose() -> None:
    rig = Rig()
    rig.pose = rig.terrain = None
    assert rig.command is not None
    rig.command = replace(rig.command, blind_walking=True)
    assert not rig.plans(20)
    assert "no pose from perception yet" in rig.status().reason


def test_blind_walking_rests_at_zero_velocity() -> None:
    rig = by_touch()
    assert rig.command is not None
    rig.command = replace(rig.command, velocity=np.zeros(2))
    assert not rig.plans(20)
    assert rig.status().state == "resting"


@pytest.mark.slow
@pytest.mark.parametrize(("velocity", "side"), [((0.0, 0.06), "left"), ((0.0, -0.06), "right"), ((-0.06, -0.01), "right")])
def test_step_into_unseen_ground_is_blocked_with_advice_to_turn(
    velocity: tuple[float, float], side: str, make_terrain: Maker
) -> None:
    rig = Rig()

    def lane(x: Array, y: Array) -> Array:
        return np.where((np.abs(y) < 0.28) & (np.abs(x) < 0.28), 0.0, np.nan)

    rig.terrain = make_terrain(lane, lane).map
    rig.command = VelocityCommand(0, np.array(velocity), 0.0, HEIGHT, 0.04)
    take_steps(rig, 10)
    assert rig.status().state == "blocked"
    assert rig.status().reason.endswith(f"; the ground there is unseen: turn {side} first to see it")
    rig.command = VelocityCommand(0, np.array([0.06, 0.0]), 0.0, HEIGHT, 0.04)
    take_steps(rig, 10)
    assert rig.status().state == "blocked"
    assert "not seen" in rig.status().reason
    assert "to see it" not in rig.status().reason, "it is in view"


@pytest.mark.slow
def test_robot_turns_on_the_spot_on_mapped_ground() -> None:
    rig = Rig()
    rig.command = VelocityCommand(0, np.zeros(2), 0.2, HEIGHT, 0.04)
    reached = take_steps(rig, 40)
    assert len(reached) == 40
    assert np.abs(np.array(reached)[:, :2]).max() < 1e-6
    assert rig.pose is not None
    a_step = np.radians(Settings().step.max_turn_deg)
    assert yaw_of(rig.pose.T_world_body) == pytest.approx((40 * a_step + np.pi) % (2 * np.pi) - np.pi)


def reason_before_goal(hold_up: Callable[["Rig", int], None]) -> str:
    """Return the last reason of a planner whose robot never moves.

    It has a goal on level ground. `hold_up` delays each cycle.
    """
    rig = Rig()
    rig.command, rig.goal = None, GOAL
    for cycle in range(500):
        hold_up(rig, cycle)
        rig.cycle()
    hold_up(rig, 0)
    return rig.status().reason


GOAL = Goal(0, np.array([[1.0, 0.0]]), 0.03, 0.06, HEIGHT, 0.04)
DATA = {"terrain": FLAT, "pose": Rig().pose}


@pytest.mark.slow
@pytest.mark.parametrize("name", DATA)
def test_late_data_do_not_count_as_stall(name: str) -> None:
    def hold_up(rig: Rig, cycle: int) -> None:
        setattr(rig, name, DATA[name] if cycle % 100 < 30 else None)  # no data for 1.4 s out of 2 s

    assert "stuck" not in reason_before_goal(hold_up)


@pytest.mark.slow
def test_late_plans_do_not_count_as_stall() -> None:
    assert "stuck" not in reason_before_goal(lambda *_: None), "they neither walk a plan nor refuse it"


@pytest.mark.slow
def test_planner_delay_does_not_count_as_stall() -> None:
    def hold_up(rig: Rig, cycle: int) -> None:
        rig.now_ns += 2_000 * MS * (cycle % 25 == 0)

    assert "stuck" not in reason_before_goal(hold_up)


@pytest.mark.slow
def test_repeated_refusals_by_actuator_count_as_stall() -> None:
    def refuse(rig: Rig, _: int) -> None:
        newest = max((m.stamp_ns for m in sent), default=-1)
        rig.state = replace(rig.state, refused_plan_ns=newest, plan_refusal="the foot would be out of reach")

    rig, sent = Rig(), list[StepPlan]()
    rig.command, rig.goal = None, GOAL
    for cycle in range(1000):
        refuse(rig, cycle)
        sent += [m for m in rig.cycle() if isinstance(m, StepPlan)]
    assert "stuck" in rig.planner.status()


def test_view_pose_is_robot_pose_at_map_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, seen = Rig(), list[tuple[int, float]]()
    rig.command, rig.goal = None, GOAL

    def lead(
        _: PathFollower, _goal: Goal, _terrain: Terrain, looked: Array, _body: Array, now_ns: int, _resting: bool
    ) -> NoPath:
        seen.append((now_ns, float(looked[0, 3])))
        return NoPath("looking")

    monkeypatch.setattr(PathFollower, "lead", lead)
    begun_ns = rig.now_ns + 20 * MS
    for cycle in range(40):
        assert rig.pose is not None
        rig.pose = replace(rig.pose, T_world_body=standing(0.01 * cycle))
        rig.now_ns += 20 * MS
        pose = replace(rig.pose, stamp_ns=rig.now_ns)
        map_ = replace(FLAT, stamp_ns=rig.now_ns - 200 * MS)
        rig.inbox.now_ns = rig.now_ns
        for message in (pose, map_, replace(GOAL, stamp_ns=rig.now_ns)):
            rig.inbox.receive(topics.OF_TYPE[type(message)], codec.encode(message), rig.now_ns)
        rig.state = replace(rig.state, stamp_ns=rig.now_ns)
        list(rig.planner.step(rig.state, rig.inbox))
    now_ns, x = seen[-1]
    assert x == pytest.approx(0.01 * ((now_ns - begun_ns) // (20 * MS) - 10)), "0.2 s are ten cycles"


def partly_unseen_map(seen: Callable[[Array, Array], NDArray[np.bool_]]) -> TerrainMap:
    """Return level ground that is unknown except where it is seen."""

    def height(x: Array, y: Array) -> Array:
        return np.where(seen(x, y), 0.0, np.nan)

    return terrain_of(height, height, half=2.0).map


def test_without_touch_unseen_start_counts_as_level_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    monkeypatch.setattr(rig.planner._steps._by_touch, "has_touch", False)
    rig.terrain = partly_unseen_map(lambda x, y: x > 0.5)
    plan = rig.plans(15)[-1]
    np.testing.assert_allclose(plan.touchdown[:, 2], PROFILE.foot.radius, atol=1e-6)
    assert "as on level ground" in rig.status().reason


@pytest.mark.rare
def test_robot_leaves_unseen_start_by_blind_walking_onto_seen_ground() -> None:
    rig = Rig()
    rig.terrain = partly_unseen_map(lambda x, y: x > 0.5)
    by_touch, legs_seen = 0, 0
    for _ in range(40):
        plan = rig.plans(15)[-1]
        feels = (plan.touchdown[plan.swing, 2] < PROFILE.foot.radius - 0.01).all()
        assert plan.stop == feels
        on_seen = (plan.touchdown[plan.swing, 0] > 0.5).all()
        by_touch, legs_seen = by_touch + feels, legs_seen + on_seen
        if not feels:
            assert on_seen, "no foot goes onto unseen ground but by touch"
        rig.begin(plan)
        rig.plans(5, phase=0.5)
        rig.finish(replace(plan, touchdown=np.maximum(plan.touchdown, [-9.0, -9.0, PROFILE.foot.radius])))  # ground stops feet
        assert rig.pose is not None
        rig.pose = replace(rig.pose, T_world_body=rig.state.T_odom_body)
        if rig.state.T_odom_body[0, 3] > 0.9:
            break
    assert by_touch > 4
    assert rig.state.T_odom_body[0, 3] > 0.9
    assert rig.status().state == "stepping"


@pytest.mark.slow
@pytest.mark.parametrize(
    "seen", [lambda x, y: x < -9.0 + 0.0 * y, lambda x, y: x < -0.5 + 0.0 * y], ids=["nothing", "what lies behind"]
)
def test_blind_start_is_refused_without_seen_ground_ahead(
    seen: Callable[[Array, Array], NDArray[np.bool_]],
) -> None:
    rig = Rig()
    rig.terrain = partly_unseen_map(seen)
    assert rig.plans(40) == []
    assert rig.status().state == "blocked"
    assert "not seen" in rig.status().reason


def test_planner_started_after_first_step_does_not_start_blind() -> None:
    rig = Rig()
    rig.terrain = partly_unseen_map(lambda x, y: x > 0.5)
    rig.state = replace(rig.state, step=7)
    assert rig.plans(40) == []
    assert "not seen" in rig.status().reason


def test_other_legs_step_first_after_reversed_step() -> None:
    rig = Rig()
    first = rig.plans(10)[-1]
    rig.begin(first)
    rig.plans(5, phase=0.4)
    rig.plans(30, phase=0.5, plan_ns=-1, reason="an obstacle blocks the left front foot; the step is reversed")
    rig.state = replace(rig.state, mode=Mode.HOLD, phase=1.0, swing=NO_SWING)
    again = rig.plans(10)[-1]
    assert again.step == first.step + 1
    np.testing.assert_array_equal(again.swing, ~first.swing)
    rig.begin(again)
    rig.plans(5, phase=0.4)
    rig.finish(again)
    np.testing.assert_array_equal(rig.plans(10)[-1].swing, first.swing)


@pytest.mark.slow
def test_blind_walking_continues_when_no_other_step_is_possible(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check feet that found ground by touch, where no other step can follow."""
    rig = Rig()
    rig.terrain = partly_unseen_map(lambda x, y: x > 0.5)
    for _ in range(3):
        plan = rig.plans(40)[-1]
        rig.begin(plan)
        rig.plans(5, phase=0.5)
        rig.finish(replace(plan, touchdown=np.maximum(plan.touchdown, [-9.0, -9.0, PROFILE.foot.radius])))
        assert rig.pose is not None
        rig.pose = replace(rig.pose, T_world_body=rig.state.T_odom_body)
    stretched = NoStep("right rear leg: its foot would be out of reach at the end of the step")
    choose = StepPlanner.choose
    by_touch = Settings().blind_walking.step_s
    monkeypatch.setattr(
        StepPlanner,
        "choose",
        lambda self, at, *more: choose(self, at, *more) if self.duration(at[0].command) == by_touch else (stretched, 0),
    )
    sent = rig.plans(40)
    assert sent, rig.status().reason
    assert sent[-1].stop
    assert rig.status().reason.startswith("walking by touch")


@pytest.mark.parametrize("refused", ["", "the camera shows the ground 9 cm below the map"])
def test_missing_map_names_refusal_of_mapper(refused: str) -> None:
    rig = Rig()
    rig.terrain = None  # type: ignore[assignment]
    rig.plans(60)
    rig.inbox.receive(topics.SCAN_RECEIPT, codec.encode(ScanReceipt(rig.now_ns, refused)), rig.now_ns)
    words = f"no fresh terrain map; the mapper refuses scans: {refused}" if refused else "no fresh terrain map"
    assert rig.status().reason == words
