"""Robots with servos of each family walk, with the same actuator on the bytes of their buses."""

from dataclasses import replace

import pytest

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.shared.robot.new_profile import Measures, new_profile
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scale import leg_scale
from tests.support.families import FAMILIES, mixed_robot, robot_with

_LOOK_NS = 500_000_000
_TROUBLE_NS = 100_000_000  # [ns] of simulated time, for which the actuator states a trouble at least
STRONG = [name for name in FAMILIES if name not in ("XL-320", "SCS0009")]  # 0.39 and 0.23 N m are too weak for 2.4 kg
LIGHTEST = Measures(0.03, 0.045, 0.075, 0.06, 0.03, 0.05, 0.5, "SCS0009")
SMALLEST = Measures(0.03, 0.045, 0.075, 0.07, 0.035, 0.06, 0.75, "XL-320")  # 16.7 g a servo, a Raspberry Pi Zero and two cells


@pytest.mark.parametrize(
    ("name", "terrain", "distance"),
    [
        ("STS3215", "flat", 0.4),
        ("XL430-W250", "flat", 0.4),
        ("LX-16A", "flat", 0.4),
        *(pytest.param(name, "steps", load_scenario("steps").goal.distance, marks=pytest.mark.rare) for name in STRONG),
    ],
)
def test_robot_walks_to_its_goal(name: str, terrain: str, distance: float) -> None:
    walk(robot_with(name), terrain, distance)


@pytest.mark.parametrize(
    ("name", "terrain", "distance"),
    [
        ("XL430-W250", "flat", 0.4),
        ("LX-16A", "flat", 0.4),
        *(
            pytest.param(name, "steps", load_scenario("steps").goal.distance, marks=pytest.mark.rare)
            for name in ("AX-12A", "MX-28", "XL430-W250", "XM430-W350", "STS3215", "LX-16A")  # XL-320 fails: docs/firmware.md
        ),
    ],
)
def test_robot_walks_with_a_microcontroller_between(name: str, terrain: str, distance: float) -> None:
    walk(robot_with(name), terrain, distance, bridge=True)


@pytest.mark.parametrize(
    ("terrain", "distance"),
    [("flat", 0.4), pytest.param("steps", load_scenario("steps").goal.distance, marks=pytest.mark.rare)],
)
def test_robot_with_other_registers_in_its_femurs_walks(terrain: str, distance: float) -> None:
    walk(mixed_robot("AX-12A", "MX-28", "AX-12A"), terrain, distance)


@pytest.mark.rare
@pytest.mark.parametrize("terrain", ["flat", "steps", "stairs"])
@pytest.mark.parametrize("measures", [SMALLEST, LIGHTEST], ids=["XL-320", "SCS0009"])
def test_robot_of_the_smallest_servos_walks_over_courses_of_its_size(measures: Measures, terrain: str) -> None:
    robot = new_profile("smallest", measures)
    course = load_scenario(terrain).scaled(leg_scale(robot))
    walk(robot, course.name, course.goal.distance)


@pytest.mark.rare
def test_robot_of_the_lightest_servos_walks_with_a_microcontroller_between() -> None:
    robot = new_profile("smallest", LIGHTEST)
    course = load_scenario("steps").scaled(leg_scale(robot))
    walk(robot, course.name, course.goal.distance, bridge=True)


def test_robot_lighter_than_a_kilogram_feels_level_ground_and_walks() -> None:
    robot = new_profile("smallest", SMALLEST)
    walk(robot, "flat", 0.3)


@pytest.mark.rare
@pytest.mark.parametrize(("name", "bridge"), [("jethexa_hx35h", False), ("jethexa_hx35h", True), ("small_sts3215", False)])
def test_robot_walks_over_steps_of_its_size(name: str, bridge: bool) -> None:
    robot = load_profile(name)
    course = load_scenario("steps").scaled(leg_scale(robot))
    walk(robot, course.name, course.goal.distance, bridge)


def walk(profile: RobotProfile, terrain: str, distance: float, bridge: bool = False) -> None:
    """Walk to the goal."""
    scenario = load_scenario(terrain)
    scenario = replace(scenario, goal=replace(scenario.goal, distance=distance), bridge=bridge)
    run = LockstepRun(scenario, 1000, profile)
    while not run.attendance.over():
        run.run(run.now_ns() + _LOOK_NS)
    report = run.attendance.judge(1.0, in_a_hurry=True)
    assert report.success, report.reason
    assert report.falls == 0


@pytest.mark.parametrize("name", ["STS3215", "XM430-W350"])
def test_light_robot_with_strong_servos_feels_level_ground(name: str) -> None:
    robot = new_profile("light", Measures(0.045, 0.08, 0.12, 0.1, 0.06, 0.09, 2.2, name))
    flat = load_scenario("flat")
    run = LockstepRun(replace(flat, goal=replace(flat.goal, distance=1.0)), 1000, robot)
    while not run.attendance.over():
        run.run(run.now_ns() + _LOOK_NS)
    report = run.attendance.judge(1.0, in_a_hurry=True)
    assert report.success, report.reason
    assert report.speed_mps > 0.75 * robot.stance.max_speed


@pytest.mark.parametrize(("name", "pace"), [("STS3215", 0.76), ("LX-16A", 1.0)])
def test_small_robot_with_stiff_servos_does_not_miss_level_ground(name: str, pace: float) -> None:
    """Check the measures of docs/your_robot.md, at a pace that the servos bear.

    Its legs take up less than a millimetre, and its feet are near their femur axes.
    """
    robot = new_profile("small", Measures(0.045, 0.06, 0.11, 0.085, 0.045, 0.07, 1.6, name))
    stance = robot.stance
    slower = {"step_s": stance.step_s / pace, "foot_speed": pace * stance.foot_speed, "max_speed": pace * stance.max_speed}
    robot = replace(robot, stance=replace(stance, **slower))
    flat = load_scenario("flat")
    run = LockstepRun(replace(flat, goal=replace(flat.goal, distance=0.9)), 1000, robot)
    said = set()
    while not run.attendance.over():
        run.run(run.now_ns() + _TROUBLE_NS)
        said.add(run.service("actuator").status())
    assert run.attendance.judge(1.0, in_a_hurry=True).success
    assert not [words for words in said if "ground" in words or "off by" in words]
