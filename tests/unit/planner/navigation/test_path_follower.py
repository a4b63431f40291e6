"""Path follower: it follows and faces its path, and looks at unseen ground.

It gives up a path on which it makes no progress.
"""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.services.planner.config import PlannerParams
from sextant.services.planner.navigation.path_follower import MotionCommand, PathFollower
from sextant.services.planner.navigation.path_planner import NoPath
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, from_xyz_rpy, rotation_z, yaw_of
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import MAX_WAYPOINTS, Goal, VelocityCommand

PROFILE = load_profile("phantomx_mk2")
STEP_S = PROFILE.stance.step_s
S = 1_000_000_000
Maker = Callable[..., Terrain]


def goal(*waypoints: tuple[float, float]) -> Goal:
    return Goal(0, np.array(waypoints), 0.03, 0.10, 0.10, 0.04)


class Robot:
    """A robot that executes the first command that its feet can follow.

    The ground is known as in the map. The robot can be held in place.
    """

    def __init__(
        self,
        terrain: Terrain,
        x: float = 0.0,
        y: float = 0.0,
        yaw: float = 0.0,
        stands: Callable[[Array], bool] = lambda T: True,
    ) -> None:
        self.pilot = PathFollower(PROFILE, PlannerParams())
        self.terrain = terrain
        self.T = from_xyz_rpy((x, y, 0.1), (0.0, 0.0, yaw))
        self.now_ns = 0
        self.held = False
        self.stands = stands
        self.track: list[Array] = []
        self.words: list[str] = []
        self.ended = False

    def step(self, to: Goal) -> MotionCommand | NoPath:
        self.now_ns += round(STEP_S * S)
        self.terrain = Terrain(self.terrain.map.__class__(**{**_fields(self.terrain), "stamp_ns": self.now_ns}))
        found = self.pilot.lead(to, self.terrain, self.T, self.T, self.now_ns)
        if isinstance(found, MotionCommand):
            self.words.append(found.words)
            places = [] if self.held else [self.after(command) for command in found.commands]
            self.T = next((T for T in places if self.stands(T)), self.T)
        else:
            self.words.append(found.reason)
        self.track.append(self.T[:3, 3].copy())
        return found

    def after(self, command: VelocityCommand) -> Array:
        T = self.T.copy()
        T[:2, 3] += STEP_S * (T[:2, :2] @ command.velocity)
        T[:3, :3] = T[:3, :3] @ rotation_z(STEP_S * command.yaw_rate)
        return T

    def walk(self, to: Goal, steps: int = 150) -> "Robot":
        for _ in range(steps):
            found = self.step(to)
            self.ended = isinstance(found, NoPath) or not found.commands
            if self.ended:
                break
        return self


def _fields(terrain: Terrain) -> dict[str, object]:
    return {name: getattr(terrain.map, name) for name in terrain.map.__dataclass_fields__}


def walled(x: Array, y: Array) -> Array:
    """Return a wall across the way at x = 0.8 m, from y = -0.9 m to 0.3 m."""
    return np.where((np.abs(x - 0.8) < 0.1) & (y > -0.9) & (y < 0.3), 0.3, 0.0)


def edge_score(height: Callable[[Array, Array], Array]) -> Callable[[Array, Array], Array]:
    def score(x: Array, y: Array) -> Array:
        around = np.array([height(x + dx, y + dy) for dx in (-0.02, 0.02) for dy in (-0.02, 0.02)])
        return np.where(np.ptp(around, axis=0) > 0.01, 9.0, 0.0)

    return score


def test_straight_walk_ends_within_goal_tolerance(make_terrain: Maker) -> None:
    robot = Robot(make_terrain(half=1.28)).walk(goal((0.7, 0.3)))
    assert robot.words[-1] == "at the goal (0.7, 0.3)"
    assert np.linalg.norm(robot.T[:2, 3] - (0.7, 0.3)) <= 0.03
    line = np.array([0.7, 0.3]) / np.hypot(0.7, 0.3)
    off = np.array(robot.track)[:, :2] @ [-line[1], line[0]]
    assert np.abs(off).max() < 0.02
    assert robot.pilot.path.tolist() == [[0.7, 0.3]], "arrived at this goal"


def test_robot_stays_at_reached_goal(make_terrain: Maker) -> None:
    robot = Robot(make_terrain(half=1.28)).walk(goal((0.3, 0.0)))
    robot.T[:2, 3] += (0.02, 0.01)  # the estimate moves a little
    assert robot.step(goal((0.3, 0.0))).commands == ()  # type: ignore[union-attr]
    robot.walk(goal((0.6, 0.0)))
    assert robot.words[-1] == "at the goal (0.6, 0.0)"


def test_robot_walks_around_wall_with_clearance(make_terrain: Maker) -> None:
    robot = Robot(make_terrain(walled, edge_score(walled), half=1.6)).walk(goal((1.4, 0.0)))
    assert robot.words[-1].startswith("at the goal")
    track = np.array(robot.track)[:, :2]
    reach = np.linalg.norm(PROFILE.rest_feet()[:, :2], axis=1).max()
    nearest = np.maximum(np.abs(track - (0.8, -0.3)) - (0.1, 0.6), 0.0)
    assert np.linalg.norm(nearest, axis=1).min() > reach
    moves = np.diff(track, axis=0)
    assert (moves[:, 1] > 0).any(), "it went the short way around"


def test_missing_path_is_reported_immediately_and_robot_stands(make_terrain: Maker) -> None:
    def pen(x: Array, y: Array) -> Array:
        off = np.maximum(np.abs(x), np.abs(y))
        return np.where(off < 0.8, 0.0, np.where(off < 0.9, 0.3, np.nan))

    robot = Robot(make_terrain(pen, half=1.28))
    for _ in range(5):
        found = robot.step(goal((2.0, 0.0)))
        assert isinstance(found, NoPath)
        assert found.reason.startswith("no path to (2.0, 0.0): blocked by a step of more than 6.5 cm")
        assert found.reason.endswith("there is no opening")
    np.testing.assert_array_equal(robot.T, from_xyz_rpy((0.0, 0.0, 0.1), np.zeros(3)))
    robot.terrain = make_terrain(half=1.28)
    robot.walk(goal((0.9, 0.0)))
    assert robot.words[-1].startswith("at the goal"), "it tries again when the map changes"


@pytest.mark.slow
def test_stalled_robot_takes_other_path(make_terrain: Maker) -> None:
    robot = Robot(make_terrain(half=1.28))
    robot.walk(goal((1.2, 0.0)), steps=3)
    robot.held = True
    for _ in range(8):
        robot.step(goal((1.2, 0.0)))
        robot.pilot.note("left front leg: it does not like it there")
    robot.held = False
    at = robot.T[0, 3]
    robot.walk(goal((1.2, 0.0)))
    assert robot.words[-1].startswith("at the goal")
    passing = [p[1] for p in robot.track if at + 0.3 < p[0] < at + 0.5]
    assert min(np.abs(passing)) > 0.2


@pytest.mark.slow
@pytest.mark.parametrize("edge", [0.4, 0.63, 1.2])
def test_oscillating_walk_is_reported_as_stuck(edge: float, make_terrain: Maker) -> None:
    to = replace(goal((1.4, 0.0)), speed=0.12)
    robot = Robot(make_terrain(half=1.9), stands=lambda T: bool(T[0, 3] < edge)).walk(to, steps=300)
    assert robot.ended
    assert "the robot got stuck before: no " in robot.words[-1]


@pytest.mark.slow
def test_oscillating_turn_is_reported_as_stuck(make_terrain: Maker) -> None:
    def seen(x: Array, y: Array) -> Array:
        return np.where(np.hypot(x, y) < 0.58, 0.0, np.nan)

    def stands(T: Array) -> bool:
        return bool(yaw_of(T) < np.radians(-60.0) and not T[:2, 3].any())

    robot = Robot(make_terrain(seen, seen, half=1.28), yaw=np.radians(-90.0), stands=stands).walk(goal((1.2, 0.0)), steps=300)
    assert robot.ended
    assert "the robot got stuck before: no " in robot.words[-1]


def test_stuck_reason_is_that_of_last_stall(make_terrain: Maker) -> None:
    robot = Robot(make_terrain(half=1.28))
    robot.step(goal((1.2, 0.0)))
    robot.pilot.note("left front leg: long ago")
    robot.walk(goal((1.2, 0.0)), steps=4)
    robot.held = True
    assert robot.walk(goal((1.2, 0.0)), steps=200).ended
    assert robot.words[-1].endswith("the robot got stuck before: no motion for 4 s")


def test_robot_turns_to_face_unseen_ground_before_walking(make_terrain: Maker) -> None:
    def seen(x: Array, y: Array) -> Array:
        return np.where(np.hypot(x, y) < 0.58, 0.0, np.nan)

    robot = Robot(make_terrain(seen, half=1.28), yaw=np.radians(-90.0))
    found = robot.step(goal((1.2, 0.0)))
    assert isinstance(found, MotionCommand)
    assert not found.commands[0].velocity.any()
    assert found.commands[0].yaw_rate > 0
    yaws = [yaw_of(robot.walk(goal((1.2, 0.0)), steps=1).T) for _ in range(3)]
    assert (np.diff(yaws) > 0.1).all()
    assert not robot.T[:2, 3].any()


def test_robot_walks_on_seen_ground_while_turning_to_unseen_ground(make_terrain: Maker) -> None:
    def seen(x: Array, y: Array) -> Array:
        return np.where(x < 0.9, 0.0, np.nan)

    robot = Robot(make_terrain(seen, half=1.28), yaw=np.radians(-170.0))
    found = robot.step(goal((1.2, 0.0)))
    assert isinstance(found, MotionCommand)
    assert found.commands[0].velocity[0] < 0.0, "backward"
    assert abs(found.commands[0].yaw_rate) > 0.0


@pytest.mark.parametrize(("yaw", "left"), [(30.0, False), (150.0, True)])
def test_robot_turns_first_to_nearer_unseen_part_of_path(yaw: float, left: bool, make_terrain: Maker) -> None:
    def height(x: Array, y: Array) -> Array:
        """Return a wall across the straight way, with unseen ground at its left end.

        The path leads around the wall by the left. The ground behind the wall is unseen, too.
        """
        wall = (x > -0.4) & (y > -0.6) & (y < -0.5)
        return np.where((x < -0.7) | (y < -0.9), np.nan, np.where(wall, 0.3, 0.0))

    robot = Robot(make_terrain(height, edge_score(height), half=1.9), yaw=np.radians(yaw))
    robot.walk(goal((0.5, -1.1)), steps=4)
    assert robot.pilot.path[:, 0].min() < -0.6, "around the wall"
    turned = np.degrees(yaw_of(robot.T)) - yaw
    assert (turned % 360.0 - 180.0 < 0.0) == left
    assert min(turned % 360.0, -turned % 360.0) > 10.0


@pytest.mark.parametrize("yaw", [-40.0, 40.0])
def test_unseen_path_nearest_to_heading_is_preferred(yaw: float, make_terrain: Maker) -> None:
    def height(x: Array, y: Array) -> Array:
        wall = (x > 0.8) & (x < 0.9) & (np.abs(y) < 0.6)
        return np.where(np.abs(y) > 0.6, np.nan, np.where(wall, 0.3, 0.0))

    robot = Robot(make_terrain(height, edge_score(height), half=1.9), yaw=np.radians(yaw))
    for _ in range(2):  # after a third look the ground would count as a hole
        robot.step(goal((1.8, 0.0)))
        way = robot.pilot.path
        assert way[np.argmax(np.abs(way[:, 1])), 1] * yaw > 0.0


@pytest.mark.parametrize("speed", [0.03, 0.5])
def test_speed_is_limited_by_goal_and_robot(speed: float, make_terrain: Maker) -> None:
    robot = Robot(make_terrain(half=1.28))
    to = Goal(0, np.array([[1.0, 0.0]]), 0.03, speed, 0.10, 0.04)
    found = robot.step(to)
    assert isinstance(found, MotionCommand)
    fastest = max(float(np.linalg.norm(command.velocity)) for command in found.commands)
    assert fastest == pytest.approx(min(speed, PROFILE.stance.max_speed))


@pytest.mark.parametrize(
    ("odd", "words"),
    [({"tolerance": 0.0}, "tolerance"), ({"speed": -0.1}, "speed"), ({"waypoints": np.full((1, 2), 1e300)}, "within")],
)
def test_invalid_goal_is_refused_with_reason(odd: dict[str, Any], words: str, make_terrain: Maker) -> None:
    found = Robot(make_terrain(half=1.28)).step(replace(goal((0.5, 0.0)), **odd))
    assert isinstance(found, NoPath)
    assert words in found.reason
    assert "expected, found" in found.reason


def test_goal_inside_wall_is_refused_with_reason(make_terrain: Maker) -> None:
    robot = Robot(make_terrain(walled, edge_score(walled), half=1.6))
    found = robot.step(goal((0.8, -0.3)))
    assert isinstance(found, NoPath)
    assert found.reason.startswith("no path to (0.8, -0.3): a step of more than 6.5 cm")
    assert found.reason.endswith("is too close to the goal")
    assert isinstance(robot.step(goal((0.0, -0.3))), MotionCommand), "another goal is another matter"


@pytest.mark.slow
def test_goals_behind_robot_and_outside_map_are_approached(make_terrain: Maker) -> None:
    robot = Robot(make_terrain(half=1.28)).walk(goal((-0.6, 0.1)))
    assert robot.words[-1] == "at the goal (-0.6, 0.1)"
    robot = Robot(make_terrain(half=1.9, origin=(1.6, 0.0))).walk(goal((3.3, 0.0)))
    assert robot.words[-1] == "at the goal (3.3, 0.0)", "not where the ground that it keeps ended at first"
    robot = Robot(make_terrain(half=1.28)).walk(goal((50.0, 0.0)), steps=5)
    assert robot.T[0, 3] > 0.3
    assert abs(robot.T[1, 3]) < 0.05


def test_pose_jump_far_from_path_uses_bounded_memory(make_terrain: Maker) -> None:
    robot = Robot(make_terrain(half=1.28))
    robot.step(goal((1.0, 0.0)))
    robot.T = from_xyz_rpy((9e5, 0.0, 0.1), np.zeros(3))
    robot.now_ns -= round(STEP_S * S) - S // 10  # before it plans another path
    tracemalloc.start()
    robot.step(goal((1.0, 0.0)))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert robot.words[-1].startswith("899999.0 m of path left")
    assert most < 10e6


def test_max_number_of_waypoints_is_passed_in_order(make_terrain: Maker) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, MAX_WAYPOINTS)
    corners = [(0.5 * float(np.sin(a)), 0.5 - 0.5 * float(np.cos(a))) for a in angle]
    robot = Robot(make_terrain(half=1.6)).walk(goal(*corners), steps=300)
    assert robot.words[-1] == "at the goal (-0.0, 0.0)"
    track = np.array(robot.track)[:, :2]
    assert all(np.linalg.norm(track - corner, axis=1).min() < 0.13 for corner in corners)


def test_path_is_replanned_after_robot_was_moved_away(make_terrain: Maker) -> None:
    robot = Robot(make_terrain(half=1.28))
    robot.step(goal((1.0, 0.0)))
    robot.T = from_xyz_rpy((0.0, 5.0, 0.1), np.zeros(3))
    robot.terrain = make_terrain(half=1.28, origin=(0.0, 5.0))
    found = robot.step(goal((1.0, 0.0)))
    assert isinstance(found, MotionCommand)
    assert found.commands
