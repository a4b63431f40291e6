from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.observers.operator import Operator
from sextant.shared.geometry import from_xyz_rpy, rotation_z, yaw_of
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Plane
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose, Mode, ModeCommand, PlannerStatus, Tick, VelocityCommand
from sextant.shared.wire.messages import Goal as GoalMessage
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")

SCENARIO = Scenario("straight", (Plane(),), Goal(1.5))
PERIOD_NS = 50_000_000


class Robot:
    """A robot that follows commands at once, and an operator that commands it."""

    def __init__(self, y=0.0, yaw=0.0, side_slip=0.0, scenario=SCENARIO):
        self.operator = Operator(load_profile(scenario.robot), scenario)
        self.goals = []
        self.arrived = self.waits = False
        self.elsewhere_m = 0.0  # by which the goal at which it arrives is another one
        self.inbox = Inbox(self.operator.subscribes, self.operator.stages)
        self.now = 0
        self.T = from_xyz_rpy((0.0, y, 0.1), (0, 0, yaw))
        self.side_slip = side_slip
        self.mode = Mode.OFF
        self.reason = ""
        self.may_walk = False
        self.orders, self.velocities = [], []
        self.pose_comes = True
        self.rising = 0
        self.blocked = self.deaf = ""

    def hear(self, message):
        self.inbox.receive(topics.OF_TYPE[type(message)], codec.encode(message), self.now)

    def beat(self):
        self.inbox.now_ns = self.now
        self.hear(
            actuator_state(PROFILE, stamp_ns=self.now, mode=self.mode, reason=self.reason, T_odom_body=self.T, body_ref=self.T)
        )
        if self.pose_comes:
            self.hear(BodyPose(self.now, self.T, np.eye(4), np.eye(6), 1.0, True, "", np.zeros((0, 6))))
        state = (
            "waiting"
            if self.waits
            else "arrived"
            if self.arrived
            else "blocked"
            if self.blocked
            else "stepping"
            if self.mode is Mode.WALK and not self.deaf
            else "resting"
        )
        path = self.goals[-1].waypoints[-1:] if self.arrived and self.goals else np.zeros((0, 2))
        self.hear(PlannerStatus(self.now, state, self.blocked or self.deaf, 0, 0, -1, path + self.elsewhere_m))
        for made in self.operator.step(Tick(self.now), self.inbox):
            if isinstance(made, ModeCommand):
                self.orders.append((self.now, made))
                self.obey(made)
            elif isinstance(made, GoalMessage):
                self.goals.append(made)
                self.mode = Mode.WALK if not self.arrived else Mode.HOLD
            else:
                assert isinstance(made, VelocityCommand)
                self.velocities.append(made)
                self.move(made)
        self.rising -= 1
        if self.mode is Mode.STAND and self.rising < 0:
            self.mode = Mode.HOLD
        self.now += PERIOD_NS

    def obey(self, order):
        if order.mode == "stand" and self.mode is Mode.OFF:
            self.mode, self.rising = Mode.STAND, 20
        self.may_walk |= order.mode == "walk"

    def move(self, command):
        moving = bool(np.any(command.velocity)) and not (self.blocked or self.deaf)
        if self.may_walk and self.mode in (Mode.HOLD, Mode.WALK):
            self.mode = Mode.WALK if moving else Mode.HOLD
        if self.mode is Mode.WALK:
            dt = PERIOD_NS * 1e-9
            self.T[:2, 3] += dt * (self.T[:2, :2] @ command.velocity + [0.0, self.side_slip])
            self.T[:3, :3] = self.T[:3, :3] @ rotation_z(dt * command.yaw_rate)

    def run(self, beats=2000):
        for _ in range(beats):
            if self.operator.finished:
                return self
            self.beat()
        return self


def test_operator_repeats_stand_order_after_interrupted_rise():
    robot = Robot()
    for _ in range(5):
        robot.beat()
    assert robot.mode is Mode.STAND
    robot.mode = Mode.READY  # a fault that is over
    first = {order.sequence for _, order in robot.orders}
    for _ in range(60):
        if {order.sequence for _, order in robot.orders} != first and robot.mode is Mode.READY:
            robot.mode, robot.rising = Mode.STAND, 5
        robot.beat()
    stands = sorted({order.sequence for _, order in robot.orders if order.mode == "stand"})
    assert len(stands) == 2
    robot.run()
    assert robot.operator.reason == "at the goal according to the estimated pose"
    walk = {order.sequence for _, order in robot.orders if order.mode == "walk"}
    assert min(walk) > max(stands)


def test_operator_joining_walking_robot_orders_stand_again():
    robot = Robot()
    robot.mode, robot.pose_comes = Mode.WALK, False
    robot.beat()
    robot.mode, robot.pose_comes = Mode.HOLD, True  # it took the order to stand as a stop
    for _ in range(60):
        stands = sorted({order.sequence for _, order in robot.orders if order.mode == "stand"})
        if len(stands) > 1 and robot.mode is Mode.HOLD and not robot.may_walk:
            robot.mode, robot.rising = Mode.STAND, 5
        robot.beat()
    assert len(stands) == 2
    assert robot.run().operator.reason == "at the goal according to the estimated pose"
    assert min(order.sequence for _, order in robot.orders if order.mode == "walk") > max(stands)


def test_operator_orders_stand_then_walk_and_repeats_orders():
    robot = Robot().run()
    modes = [order.mode for _, order in robot.orders]
    assert modes == sorted(modes)  # "stand" before "walk"
    first = {mode: next((at, order) for at, order in robot.orders if order.mode == mode) for mode in ("stand", "walk")}
    assert set(modes) == {"stand", "walk"}
    assert len({order.sequence for _, order in robot.orders}) == 2
    for _, order in first.values():
        assert 0 <= order.stamp_ns - order.sequence <= PERIOD_NS, "its sequence says when it was given"
    walks = [at for at, order in robot.orders if order.mode == "walk"]
    assert np.diff(walks).max() <= 500_000_000
    first_velocity = robot.velocities[0].stamp_ns
    assert first_velocity >= walks[0] >= 1_000_000_000  # the robot had risen


def test_operator_commands_height_of_stance_if_robot_does_not_reach_that_of_scenario():
    walk = replace(SCENARIO.walk, body_height=0.2)
    operator = Operator(PROFILE, replace(SCENARIO, walk=walk))
    assert operator._walk == replace(walk, body_height=PROFILE.stance.body_height)


def test_operator_walks_robot_to_goal_and_stops():
    robot = Robot().run()
    assert robot.operator.finished
    assert "at the goal" in robot.operator.reason
    assert 1.5 * 1.03 <= robot.T[0, 3] < 1.61, "the body passes the line even if the estimated way is 3 % too long"
    assert not np.any(robot.velocities[-1].velocity)
    assert robot.mode is Mode.HOLD
    robot.beat()  # the operator keeps sending the command to rest
    assert not np.any(robot.velocities[-1].velocity)
    speeds = [np.linalg.norm(v.velocity) for v in robot.velocities]
    assert max(speeds) == pytest.approx(SCENARIO.walk.speed)
    assert {(v.body_height, v.lift) for v in robot.velocities} == {(SCENARIO.walk.body_height, SCENARIO.walk.lift)}
    assert robot.velocities[1].stamp_ns - robot.velocities[0].stamp_ns == PERIOD_NS


@pytest.mark.parametrize(("y", "yaw", "side_slip"), [(0.1, 0.0, 0.0), (-0.1, 0.3, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.01)])
def test_operator_steers_robot_back_to_line(y, yaw, side_slip):
    robot = Robot(y, yaw, side_slip).run()
    assert robot.operator.finished
    steady = side_slip / (2.0 * SCENARIO.walk.speed)  # offset at which the course compensates the slip
    assert abs(robot.T[1, 3]) < abs(y) * 0.12 + 0.02 + steady
    assert abs(yaw_of(robot.T)) < 0.02
    assert max(abs(v.yaw_rate) for v in robot.velocities) <= 0.15
    assert all(np.linalg.norm(v.velocity) <= SCENARIO.walk.speed + 1e-12 for v in robot.velocities)


def test_operator_course_stays_within_25_degrees_of_line():
    robot = Robot(y=2.0)
    for _ in range(60):
        robot.beat()
    course = [np.arctan2(*v.velocity[::-1]) for v in robot.velocities if np.any(v.velocity)]
    assert max(np.abs(course)) == pytest.approx(np.radians(25.0))


def test_operator_gives_up_if_planner_stays_blocked():
    robot = Robot()
    for _ in range(60):
        robot.beat()
    robot.blocked = "no foothold for the left front leg"
    began = robot.now
    robot.run()
    assert robot.now - began == pytest.approx(20e9, abs=2 * PERIOD_NS)
    assert "20 s" in robot.operator.reason
    assert "left front" in robot.operator.reason


def test_planner_progress_resets_operator_timeout():
    robot = Robot()
    for k in range(1000):
        robot.blocked = "no foothold" if k > 60 and k % 300 > 10 else ""
        robot.beat()
    assert "blocked" not in robot.operator.reason


def test_operator_gives_up_if_planner_receives_no_command():
    robot = Robot()
    for _ in range(60):
        robot.beat()
    robot.deaf = "no fresh velocity command and no goal"
    began = robot.now
    robot.run()
    assert robot.now - began == pytest.approx(10e9, abs=2 * PERIOD_NS)
    assert "received no command from here: no fresh velocity command" in robot.operator.reason


def test_operator_sends_zero_velocity_and_gives_up_without_pose():
    robot = Robot()
    for _ in range(60):
        robot.beat()
    assert np.any(robot.velocities[-1].velocity)
    robot.pose_comes = False
    began = robot.now
    robot.run()
    gap = [v for v in robot.velocities if v.stamp_ns >= began + topics.BODY_POSE.fresh_for_ns]
    assert gap
    assert not any(np.any(v.velocity) for v in gap)
    assert "no pose" in robot.operator.reason
    assert robot.now - began == pytest.approx(5e9, abs=topics.BODY_POSE.fresh_for_ns + 4 * PERIOD_NS)


@pytest.mark.parametrize("mode", [Mode.FAULT, Mode.OFF])
def test_operator_does_not_reorder_failed_robot(mode):
    robot = Robot()
    for _ in range(60):
        robot.beat()
    robot.mode, robot.reason = mode, "femur servo reports overload"
    robot.run()
    assert robot.operator.finished
    assert "overload" in robot.operator.reason
    assert len({order.sequence for _, order in robot.orders}) <= 2


def test_operator_status_shows_awaited_event():
    robot = Robot()
    operator = robot.operator
    assert "waiting for the actuator" in operator.status()
    list(operator.step(Tick(0), Inbox(operator.subscribes, operator.stages)))
    robot.run(5)
    assert "standing up" in operator.progress
    robot.run(100)
    assert "of 1.50 m" in operator.progress


def test_operator_gives_up_without_actuator_messages():
    operator = Operator(load_profile(SCENARIO.robot), replace(SCENARIO))
    inbox = Inbox(operator.subscribes, operator.stages)
    for now in range(0, 61_000_000_000, 1_000_000_000):
        list(operator.step(Tick(now), inbox))
    assert operator.finished
    assert "within 60 s" in operator.reason


@pytest.mark.parametrize("route", [False, True])
def test_operator_that_leaves_the_speed_to_the_planner_asks_for_all_of_it(route: bool) -> None:
    auto = replace(SCENARIO, goal=Goal(1.5, route=route), walk=replace(SCENARIO.walk, gait="auto", speed=0.03, auto_speed=True))
    robot = Robot(scenario=auto).run(400)
    sent = robot.goals if route else robot.velocities
    assert {(request.gait, request.auto_speed) for request in sent} == {("auto", True)}
    fastest = load_profile(SCENARIO.robot).stance.max_speed
    assert (sent[-1].speed if route else max(np.linalg.norm(v.velocity) for v in sent)) == pytest.approx(fastest)


def test_operator_publishes_route_goal_without_velocities():
    route = replace(SCENARIO, goal=Goal(1.5, route=True, waypoints=((0.5, 0.2),)))
    robot = Robot(scenario=route).run(400)
    assert not robot.velocities
    goal = robot.goals[-1]
    np.testing.assert_allclose(goal.waypoints, [[0.5, 0.2], [1.605, 0.0]])
    assert (goal.speed, goal.body_height, goal.lift) == (route.walk.speed, route.walk.body_height, route.walk.lift)
    assert np.diff([goal.stamp_ns for goal in robot.goals]).max() <= topics.GOAL.fresh_for_ns / 3
    assert not robot.operator.finished
    robot.arrived, robot.elsewhere_m = True, 0.1
    robot.run(100)
    assert not robot.operator.finished, "it has arrived at another goal"
    robot.elsewhere_m = 0.0
    robot.run(100)
    assert robot.operator.finished
    assert "at the goal" in robot.operator.reason


@pytest.mark.parametrize("allowed", [True, False])
def test_blind_walking_is_requested_only_if_scenario_allows(allowed):
    robot = Robot(scenario=replace(SCENARIO, walk=replace(SCENARIO.walk, by_touch=allowed)))
    for _ in range(60):
        robot.beat()
    assert not robot.velocities[-1].blind_walking
    robot.pose_comes, robot.waits = False, True
    began = robot.now
    robot.run(160)
    asked = [v.stamp_ns - began for v in robot.velocities if v.blind_walking]
    assert bool(asked) == allowed
    if allowed:
        assert min(asked) == pytest.approx(2e9, abs=4 * PERIOD_NS)
        assert np.any(robot.velocities[-1].velocity)
    else:
        assert "no pose" in robot.operator.reason
