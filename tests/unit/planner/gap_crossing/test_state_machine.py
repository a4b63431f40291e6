"""Gap crossing, stage by stage: the robot follows its plans on prescribed maps."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.planner.config import Settings
from sextant.services.planner.gap_crossing.outcome import CannotCross, Completed, NextStep, Outcome, Wait
from sextant.services.planner.gap_crossing.section_search import PLANNINGS
from sextant.services.planner.gap_crossing.state_machine import GapCrossing
from sextant.services.planner.gap_crossing.strip_survey import STRIP, TURNING_WIDTH
from sextant.services.planner.roadmap.roadmap import ATTEMPTS, NoSection, PassageStep, SectionPlan, Stance
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.services.planner.robot_estimate import WorldStance
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, yaw_of
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import UNKNOWN, Mode, PassageMap
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.10
MS = 1_000_000
GOAL = np.array([1.9, 0.0])
GAP = (1.1, 1.9)  # [m] {strip} begin and end of the gap
_ALL = (1 + PLANNINGS) * ATTEMPTS  # number of attempts before a refusal: straight on once, then with turns of the body
NX = round(STRIP[0] / 0.01)


class ScriptedRoadmap:
    """A substitute for the roadmap that returns prescribed results after a while."""

    def __init__(self, *found: SectionPlan | NoSection) -> None:
        self.found = list(found)
        self.begun: list[tuple[StripMap, Stance, float, int]] = []
        self.turning: list[bool] = []
        self.inward: list[int | None] = []
        self.wide = False
        self.grown = 0
        self.edges: Array = np.zeros((3, 2, 3))

    def attempts(self, field: StripMap) -> tuple[int | None, ...]:
        return (*((1, 0) if self.wide else ()), *(None,) * ATTEMPTS)

    def begin(self, field: StripMap, stance: Stance, goal_x: float, seed: int, turning: bool, inward: int | None) -> None:
        self.begun.append((field, stance, goal_x, seed))
        self.turning.append(turning)
        self.inward.append(inward)
        self.grown = 0

    def grow(self, expansions: int) -> SectionPlan | NoSection | None:
        assert expansions > 0
        self.grown += 1
        return self.found.pop(0) if self.grown == 3 else None


class Robot:
    """A robot that walks as the crossing requests and provides a map twice a second."""

    def __init__(
        self, sections: ScriptedRoadmap, looks: int = 0, gap: bool = True, yielded: Sequence[Array] = (), refused: str = ""
    ) -> None:
        self.T = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
        self.feet = apply(self.T, PROFILE.rest_feet(HEIGHT))
        self.sections, self.looks, self.gap = sections, looks, gap
        self.crossing = GapCrossing(PROFILE, Settings(), sections, self.standing, GOAL, list(yielded), refused)
        self.state = actuator_state(PROFILE, T_odom_body=self.T, body_ref=self.T)
        self.now_ns = 0
        self.map: PassageMap | None = None
        self.maps, self.moves, self.wait_messages = True, list[NextStep](), list[str]()
        self.refuse, self.narrow = "", False

    @property
    def standing(self) -> WorldStance:
        return WorldStance(self.T, self.feet)

    def tick(self) -> Outcome:
        self.now_ns += 40 * MS
        self.state = replace(self.state, stamp_ns=self.now_ns)
        if self.maps and self.now_ns % (480 * MS) == 0:
            self.map = self.look()
        outcome = self.crossing.advance(self.state, self.standing, self.map, self.refuse)
        if isinstance(outcome, Wait):
            self.wait_messages.append(outcome.words)
        if isinstance(outcome, NextStep) and not self.refuse:
            self.walk(outcome)
        return outcome

    def walk(self, move: NextStep) -> None:
        """Execute a step; it has ended at the next tick."""
        self.moves.append(move)
        self.T = move.stride.body_goal
        self.feet = np.where(move.stride.swing[:, None], move.stride.touchdown, self.feet)
        self.looks -= not move.stride.swing.any()
        self.state = replace(self.state, step=move.number)

    def look(self) -> PassageMap:
        (request,) = [r for r in [self.crossing.request(self.now_ns + 10**9)] if r is not None]
        size = NX, round(request.width / 0.01)
        heights = np.zeros(size, dtype=np.float32)
        evaluation = np.full(size, -9, dtype=np.int8)
        if self.narrow:
            evaluation[round(GAP[0] * 100) : round(GAP[1] * 100), np.abs(np.arange(size[1]) + 0.5 - size[1] / 2) > 18] = 5
        if self.gap:
            evaluation[round(GAP[0] * 100) : round(GAP[1] * 100)] = 5
        shows = np.zeros(size, dtype=np.bool_)
        shows[150:170, 40:60] = self.looks > 0
        raised = self.T.copy()
        raised[2, 3] += 0.07
        T = from_xyz_rpy((*request.origin, 0.0), (0.0, 0.0, request.heading))
        return PassageMap(
            self.now_ns, 0.01, apply(T, np.array([0.005, 0.005 - request.width / 2, 0.0]))[:2], request.heading, heights,
            np.zeros((*size, 3), np.int16), heights, np.zeros(size, np.bool_), evaluation, 0.1, "", raised, shows,
        )  # fmt: skip

    def until(self, done: Callable[[], bool]) -> None:
        for _ in range(2000):
            if done():
                return
            self.tick()
        raise AssertionError(f"waited in vain: {self.wait_messages[-3:]}")

    def until_end(self, ticks: int = 2000) -> Completed | CannotCross:
        for _ in range(ticks):
            outcome = self.tick()
            if isinstance(outcome, Completed | CannotCross):
                return outcome
        raise AssertionError(f"no end after {ticks} ticks: {self.wait_messages[-3:]}")


def section(x: float, to: float, count: int = 6) -> SectionPlan:
    """Return `count` steps that move body and legs equally far, in {strip}.

    The strip begins 0.5 m behind the robot's first place.
    """
    rest = PROFILE.rest_feet(HEIGHT)
    bodies = [np.array([0.5 + x + (to - x) * (k + 1) / count, 0.0, HEIGHT]) for k in range(count)]
    feet = rest + np.array([0.5 + to, 0.0, HEIGHT])
    steps = tuple(PassageStep(k, feet[k], 0.03, bodies[k], 0.05) for k in range(count))
    return SectionPlan(steps, True, "at the goal", 9, 4, Stance(bodies[-1], feet))


def no_way(reason: str = "nothing carries") -> NoSection:
    return NoSection(reason, False, Stance(np.array([0.6, 0.0, HEIGHT]), np.zeros((6, 3))), 5, 5, {})


def test_crossing_surveys_plans_walks_and_ends_behind_gap() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 0.9), section(0.9, 1.85)), looks=2)
    assert robot.until_end() == Completed("no gap ahead of the robot")
    raised, higher, back, *steps = robot.moves
    assert [m.stride.swing.any() for m in (raised, higher, back)] == [False] * 3
    assert raised.stride.body_goal[2, 3] == pytest.approx(HEIGHT + 0.07)
    np.testing.assert_allclose(back.stride.body_goal, from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3)), atol=1e-9)
    assert [int(np.flatnonzero(m.stride.swing)[0]) for m in steps] == [*range(6)] * 2
    assert [m.number for m in robot.moves] == list(range(1, 16))
    assert [m.stop for m in steps] == ([False] * 5 + [True]) * 2
    np.testing.assert_allclose(robot.T[:3, 3], [1.85, 0.0, HEIGHT], atol=1e-9)


def test_section_is_planned_from_current_stance_to_behind_gap() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85)))
    robot.until_end()
    (field, stance, goal, _), *_ = robot.sections.begun
    np.testing.assert_allclose(stance.body, [0.5, 0.0, HEIGHT], atol=1e-9)
    np.testing.assert_allclose(apply(field.T_strip_world, robot.moves[0].stride.start), stance.feet, atol=1e-9)
    assert goal == pytest.approx(GAP[1] + 0.40, abs=0.011)


def test_planning_report_is_returned_once() -> None:
    robot = Robot(ScriptedRoadmap(*[no_way()] * ATTEMPTS))
    reports = []
    while not reports:
        robot.tick()
        reports += [r for r in [robot.crossing.report] if r is not None]
    assert robot.crossing.report is None
    (report,) = reports
    assert (report.state, report.section, report.generated_nodes, report.expanded_nodes) == ("no way", 1, 5, 5)


def test_robot_approaches_unknown_ground_only_without_other_path() -> None:
    closer = replace(section(0.0, 0.2), complete=False)
    none = replace(no_way("cells ahead are unknown"), unseen=True, closer=closer)
    robot = Robot(ScriptedRoadmap(*[none] * (ATTEMPTS + 1), section(0.2, 1.85)))
    robot.until(lambda: bool(robot.moves))
    assert len(robot.sections.begun) == ATTEMPTS, "not before other samples have found nothing either"
    assert robot.until_end() == Completed("no gap ahead of the robot")
    assert [m.stride.body_goal[0, 3] for m in robot.moves][5] == pytest.approx(0.2)
    found = Robot(ScriptedRoadmap(none, section(0.0, 1.85)))
    found.until_end()
    assert len(found.moves) == 6, "a way across is better"


@pytest.mark.parametrize("leg", [2, 6])
def test_failure_report_has_path_to_furthest_stance_and_failed_leg(leg: int) -> None:
    steps = section(0.0, 0.2).steps
    body = steps[-1].body + np.array([0.02, 0.0, 0.0])
    leant = PassageStep(-1, body, 0.0, body, 0.04)
    furthest = Stance(leant.body, np.array([step.touchdown for step in steps]))
    found = replace(no_way(), furthest=furthest, steps=(*steps, leant), leg=leg)
    robot = Robot(ScriptedRoadmap(*[found] * ATTEMPTS))
    report = None
    while report is None:
        robot.tick()
        report = robot.crossing.report
    assert report.state == "no way"
    assert report.leg.tolist() == [*range(6), 6]
    (field, *_), *_ = robot.sections.begun
    np.testing.assert_allclose(apply(field.T_strip_world, report.body[-1]), leant.body, atol=1e-9)
    (stopped,) = apply(field.T_strip_world, report.failure_point)
    np.testing.assert_allclose(stopped, leant.body if leg == 6 else furthest.feet[leg], atol=1e-9)
    assert report.furthest == leant.body[0]


def test_success_report_has_no_failed_leg() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85)))
    report = None
    while report is None:
        robot.tick()
        report = robot.crossing.report
    assert (report.state, len(report.failure_point), report.leg.tolist()) == ("complete", 0, [*range(6)])


def test_crossing_is_refused_with_planner_reason_after_all_attempts() -> None:
    robot = Robot(ScriptedRoadmap(*[no_way("all")] * (_ALL - 1), no_way("left front leg: out of reach")))
    refused = CannotCross("straight on: all; with turns up to 45 deg: left front leg: out of reach")
    assert robot.until_end(3000) == refused
    assert len({seed for *_, seed in robot.sections.begun}) == _ALL


def test_feet_are_tried_in_the_middle_of_ground_first_in_each_section() -> None:
    robot = Robot(ScriptedRoadmap(*[no_way()] * 4, replace(section(0.0, 0.9), complete=False), section(0.9, 1.85)))
    robot.sections.wide = True
    robot.until_end()
    assert robot.sections.inward[:6] == [1, 0, None, None, None, 1]
    seeds = [seed for *_, seed in robot.sections.begun]
    assert len(set(seeds)) == len(seeds)


def test_narrow_ground_is_crossed_like_a_gap_to_its_end() -> None:
    robot = Robot(ScriptedRoadmap(replace(section(0.0, 0.9), complete=False), section(0.9, 1.85)), gap=False)
    robot.narrow = True
    assert robot.until_end() == Completed("no gap ahead of the robot")
    assert robot.crossing.walked
    assert len(robot.sections.begun) == 2


def test_body_turns_only_after_straight_sections_are_refused() -> None:
    robot = Robot(ScriptedRoadmap(*[no_way("all")] * ATTEMPTS, section(0.0, 1.85)))
    assert robot.until_end() == Completed("no gap ahead of the robot")
    assert robot.sections.turning == [False] * ATTEMPTS + [True]
    widths = [field.evaluation.shape[1] * field.resolution for field, *_ in robot.sections.begun]
    assert widths == pytest.approx([STRIP[1]] * ATTEMPTS + [TURNING_WIDTH])
    assert "surveying the gap again: no section leads straight on: all" in robot.wait_messages


def test_body_turns_at_once_where_straight_sections_were_refused_before() -> None:
    robot = Robot(ScriptedRoadmap(*[no_way("stuck")] * (PLANNINGS * ATTEMPTS)), refused="all")
    assert robot.crossing.straight_refusal == "all"
    assert robot.until_end(3000) == CannotCross("straight on: all; with turns up to 45 deg: stuck")
    assert robot.sections.turning == [True] * (PLANNINGS * ATTEMPTS)
    assert {field.evaluation.shape[1] for field, *_ in robot.sections.begun} == {round(TURNING_WIDTH / 0.01)}


def test_section_that_turns_is_planned_and_walked_with_the_yaw_of_the_body() -> None:
    turned = section(0.0, 0.3)
    turned = replace(turned, steps=tuple(replace(step, yaw=0.1 * k) for k, step in enumerate(turned.steps)), complete=False)
    robot = Robot(ScriptedRoadmap(*[no_way("all")] * ATTEMPTS, turned, section(0.3, 1.85)))
    assert robot.until_end() == Completed("no gap ahead of the robot")
    assert [yaw_of(move.stride.body_goal) for move in robot.moves[:6]] == pytest.approx([0.1 * k for k in range(6)])
    assert robot.sections.begun[-1][1].yaw == pytest.approx(0.5)


def test_failed_planning_is_repeated_on_newer_map() -> None:
    robot = Robot(ScriptedRoadmap(*[no_way("all")] * ATTEMPTS, section(0.0, 1.85)))
    assert robot.until_end() == Completed("no gap ahead of the robot")
    maps = [field for field, *_ in robot.sections.begun]
    assert maps[ATTEMPTS] is not maps[ATTEMPTS - 1]


def test_step_not_executed_is_repeated() -> None:
    """Check a leg that first had to search for ground before another leg could lift.

    The actuator has counted the step, but its leg has not moved.
    """
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85)))
    robot.until(lambda: len(robot.moves) == 2)
    lost = robot.moves.pop()
    robot.feet = np.where(lost.stride.swing[:, None], lost.stride.start, robot.feet)
    robot.T = robot.moves[-1].stride.body_goal
    robot.until(lambda: len(robot.moves) == 6)
    assert [int(np.flatnonzero(m.stride.swing)[0]) for m in robot.moves] == [*range(6)]
    assert len(robot.sections.begun) == 1


def test_continuous_ground_completes_without_planning() -> None:
    robot = Robot(ScriptedRoadmap(), gap=False)
    assert robot.until_end() == Completed("no gap ahead of the robot")
    assert robot.sections.begun == []


def test_map_is_requested_repeatedly_until_timeout() -> None:
    robot = Robot(ScriptedRoadmap())
    robot.maps = False
    asked = 0
    for _ in range(100):
        robot.tick()
        asked += robot.crossing.request(robot.now_ns) is not None
    assert 9 <= asked <= 11
    assert robot.until_end() == CannotCross("no valid map of the gap received from the mapper")


def test_map_older_than_standstill_is_ignored() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85)))
    for _ in range(16):  # 0.64 s
        assert isinstance(robot.tick(), Wait)
    assert robot.sections.begun == []


def test_foot_off_planned_foothold_triggers_replanning() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85), section(0.3, 1.85)))
    robot.until(lambda: len(robot.moves) == 2)
    robot.feet[0, 2] -= 0.05
    robot.until(lambda: len(robot.sections.begun) == 2)
    assert len(robot.moves) == 2
    assert any("left front foot is 5 cm from its planned foothold" in words for words in robot.wait_messages)


def test_foothold_that_did_not_carry_is_excluded_from_planning() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85), section(0.3, 1.85)))
    robot.until(lambda: len(robot.moves) == 1)
    gone = np.array([0.45, 0.2, -0.03])
    touch, carries, touch_ns = np.zeros((6, 3)), np.ones(6, dtype=np.bool_), np.full(6, -1, dtype=np.int64)
    touch[0], carries[0], touch_ns[0] = gone, False, robot.now_ns
    robot.state = replace(robot.state, touchdown_point=touch, touchdown_contact=carries, touchdown_ns=touch_ns)
    robot.until(lambda: len(robot.sections.begun) == 2)
    field = robot.sections.begun[1][0]
    x, y, _ = apply(inverse(field.T_world_strip), gone)
    i, j = round((x - field.first_cell[0]) / 0.01), round((y - field.first_cell[1]) / 0.01)
    assert (field.evaluation[i - 3 : i + 4, j - 3 : j + 4] > 0).all()
    assert field.evaluation[i - 15, j] < 0


def test_refused_steps_trigger_new_survey_and_finally_refusal() -> None:
    robot = Robot(ScriptedRoadmap(*[section(0.0, 1.85)] * 5))
    robot.until(lambda: bool(robot.sections.begun))
    robot.refuse = "out of reach"
    end = robot.until_end()
    assert isinstance(end, CannotCross)
    assert "made no progress" in end.reason


def test_refusal_without_progress_names_each_heading_that_was_tried() -> None:
    robot = Robot(ScriptedRoadmap(*[no_way("all")] * ATTEMPTS, *[section(0.0, 1.85)] * 5))
    robot.until(lambda: len(robot.sections.begun) > ATTEMPTS)
    robot.refuse = "out of reach"
    end = robot.until_end(3000)
    assert isinstance(end, CannotCross)
    assert end.reason.startswith("straight on: all; with turns up to 45 deg: the robot made no progress")


def test_refused_view_pose_is_skipped() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85)), looks=5)
    robot.refuse = "the body would turn too far"
    robot.until(lambda: bool(robot.sections.begun))
    assert robot.moves == []


def test_section_goal_is_not_behind_unknown_ground() -> None:
    """Check that the goal is not behind ground that was not seen."""
    robot = Robot(ScriptedRoadmap(*[no_way()] * _ALL))
    look = robot.look

    def short() -> PassageMap:
        map_ = look()
        evaluation = map_.evaluation.copy()
        evaluation[150:] = UNKNOWN
        return replace(map_, evaluation=evaluation)

    robot.look = short  # type: ignore[method-assign]
    robot.until_end()
    assert robot.sections.begun[0][2] == pytest.approx(1.5 + 0.40, abs=0.011)


def test_actuator_restart_during_section_triggers_new_survey() -> None:
    """Check that a look or section ends when the actuator counts steps from 0 again."""
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85), section(0.1, 1.85)))
    robot.until(lambda: len(robot.moves) == 3)
    robot.state = replace(robot.state, step=0)
    robot.until(lambda: len(robot.sections.begun) == 2)
    assert any("the actuator has restarted" in words for words in robot.wait_messages)
    robot.until(lambda: len(robot.moves) == 4)
    assert robot.moves[-1].number == 1


def test_actuator_restart_during_planning_replans_from_new_stance() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85), section(0.0, 1.85)))
    robot.state = replace(robot.state, step=5)
    robot.until(lambda: robot.sections.grown == 1)
    robot.state = replace(robot.state, step=0)
    robot.T = robot.T @ from_xyz_rpy((0.02, 0.0, 0.0), np.zeros(3))
    robot.until(lambda: bool(robot.moves))
    assert len(robot.sections.begun) == 2
    assert robot.sections.begun[1][1].body[0] == pytest.approx(robot.sections.begun[0][1].body[0] + 0.02, abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"heading": 1.0}, "another strip"),
        ({"origin": np.array([3.0, 1.0])}, "another strip"),
        ({"resolution": 0.5}, "cells of 0.002 to 0.1 m expected"),
        ({"T_world_next_view": np.zeros((4, 4))}, "not a rigid transform"),
    ],
)
def test_map_of_other_strip_or_invalid_map_is_refused(changes: dict[str, object], words: str) -> None:
    robot = Robot(ScriptedRoadmap())
    look = robot.look
    robot.look = lambda: replace(look(), **changes)  # type: ignore[arg-type, method-assign]
    end = robot.until_end()
    assert isinstance(end, CannotCross)
    assert words in end.reason
    assert robot.sections.begun == []


def test_distant_view_pose_is_not_taken() -> None:
    robot = Robot(ScriptedRoadmap(*[no_way()] * _ALL), looks=5)
    look = robot.look
    robot.look = lambda: replace(look(), T_world_next_view=from_xyz_rpy((0.0, 0.0, 0.9), np.zeros(3)))  # type: ignore[method-assign]
    robot.until_end()
    assert robot.moves == []


def test_no_step_is_sent_while_actuator_walks() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85)))
    robot.until(lambda: len(robot.moves) == 2)
    robot.state = replace(robot.state, mode=Mode.WALK)
    for _ in range(50):
        assert isinstance(robot.tick(), Wait)
    robot.state = replace(robot.state, mode=Mode.HOLD)
    robot.until(lambda: len(robot.moves) == 6)


def test_unseen_ground_is_surveyed_again_before_refusal() -> None:
    blind = replace(no_way("ground unknown"), unseen=True)
    robot = Robot(ScriptedRoadmap(*[blind] * ATTEMPTS, section(0.0, 1.85)))
    robot.until(lambda: bool(robot.moves))
    assert len(robot.sections.begun) == ATTEMPTS + 1


def test_dead_end_is_left_by_backtracking() -> None:
    robot = Robot(ScriptedRoadmap(section(0.0, 0.6), *[no_way("stuck")] * (2 * ATTEMPTS), section(0.4, 1.85)))
    assert robot.until_end() == Completed("no gap ahead of the robot")
    assert [int(np.flatnonzero(m.stride.swing)[0]) for m in robot.moves] == [*range(6), 5, 4, *range(6)]
    assert any("backtracking 2 steps to find another path: stuck" in words for words in robot.wait_messages)
    assert [m.words for m in robot.moves[6:8]] == [f"gap crossing, backtracking in section 3: step {k} of 2" for k in (1, 2)]
    first, again = robot.sections.begun[0][1], robot.sections.begun[2 * ATTEMPTS + 1][1]
    assert again.body[0] == pytest.approx(first.body[0] + 0.4)
    np.testing.assert_allclose(again.feet[4:], first.feet[4:], atol=1e-9)
    assert (again.feet[:4, 0] > first.feet[:4, 0] + 0.5).all()


def test_crossing_is_refused_after_backtracking_fails() -> None:
    end = Robot(ScriptedRoadmap(section(0.0, 0.6), *[no_way("stuck")] * ((2 + PLANNINGS) * ATTEMPTS))).until_end(3000)
    assert end == CannotCross("straight on: stuck; with turns up to 45 deg: stuck")


def test_reason_states_that_no_better_view_is_available() -> None:
    blind = replace(no_way("cells ahead are unknown"), unseen=True)
    end = Robot(ScriptedRoadmap(*[blind] * (_ALL + ATTEMPTS))).until_end(3000)
    assert isinstance(end, CannotCross)
    assert end.reason.endswith("cells ahead are unknown; no better view is available")


def test_sunk_ground_is_lowered_to_standing_foot() -> None:
    sole = apply(from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3)), PROFILE.rest_feet(HEIGHT))[0] - [0.0, 0.0, PROFILE.foot.radius]
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85)), yielded=[sole + np.array([0.02, 0.0, -0.01])])  # first reported place
    robot.feet[0, 2] -= 0.04
    robot.until(lambda: bool(robot.sections.begun))
    field, stance, _, _ = robot.sections.begun[0]
    i, j = np.rint((stance.feet[0, :2] - field.first_cell) / field.resolution).astype(int)
    around = field.elevation[i - 2 : i + 3, j - 2 : j + 3]
    np.testing.assert_allclose(around, stance.feet[0, 2] - PROFILE.foot.radius, atol=1e-6)
    assert (field.evaluation[i - 2 : i + 3, j - 2 : j + 3] >= 0).all()
    assert np.nanmax(field.elevation) == 0.0


@pytest.mark.parametrize(("lower", "gone"), [(0.008, False), (0.02, True)])
def test_low_standing_foot_marks_sunk_ground(lower: float, gone: bool) -> None:
    """Check that a low foot shows sunk ground, although no contact was reported.

    The camera does not see the ground under a foot.
    """
    robot = Robot(ScriptedRoadmap(section(0.0, 1.85)))
    robot.feet[0, 2] -= lower
    robot.until(lambda: bool(robot.sections.begun))
    field, stance, _, _ = robot.sections.begun[0]
    i, j = np.rint((stance.feet[0, :2] - field.first_cell) / field.resolution).astype(int)
    assert (field.evaluation[i, j] >= 0) == gone
    assert field.elevation[i, j] == pytest.approx(-lower if gone else 0.0, abs=1e-6)
    assert (field.evaluation[:100] >= 0).any() == gone, "ground under the other feet carries"


def test_crossing_is_refused_when_robot_is_off_centre_line() -> None:
    robot = Robot(ScriptedRoadmap())
    robot.T = from_xyz_rpy((0.0, 0.5, HEIGHT), np.zeros(3))
    end = robot.until_end()
    assert isinstance(end, CannotCross)
    assert "0.50 m and 0 deg off the centre line" in end.reason


def test_map_with_future_stamp_is_ignored() -> None:
    robot = Robot(ScriptedRoadmap())
    look = robot.look
    robot.look = lambda: replace(look(), stamp_ns=robot.now_ns + 10**10)  # type: ignore[method-assign]
    assert robot.until_end() == CannotCross("no valid map of the gap received from the mapper")
