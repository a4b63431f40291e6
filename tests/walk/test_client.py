"""A program leads the robot through the public face; here its commands reach a robot in lockstep."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sextant
from sextant.client import Client, Commander, Status
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire.messages import Goal, Mode, PostureCommand, VelocityCommand

ROOT = Path(__file__).parents[2]
FLAT = load_scenario("flat")
S = 1_000_000_000


class Led:
    """A robot in lockstep and what commands it."""

    def __init__(self) -> None:
        self.commander = Commander("tester")
        profile = sextant.load_profile(FLAT.robot)
        around = {"operator": lambda _: self.commander}
        self.run = LockstepRun(FLAT, 1000, profile, around=around, stop_port="test client")

    @property
    def status(self) -> Status:
        assert self.commander.newest is not None
        return self.commander.newest

    def until(self, mode: Mode, within_s: float) -> None:
        end = self.run.now_ns() + round(within_s * S)
        while self.commander.newest is None or self.status.actuator.mode is not mode:
            assert self.run.now_ns() < end, self.commander.newest
            self.run.run(self.run.now_ns() + S // 20)

    def place(self) -> np.ndarray:
        assert self.status.pose is not None
        return np.array(self.status.pose.T_world_body[:2, 3])


def test_client_stands_walks_reaches_goal_and_stops() -> None:
    led = Led()
    led.run.run(2 * S)
    led.commander.give("stand")
    led.until(Mode.STAND, 2.0)
    led.until(Mode.HOLD, 20.0)
    assert led.status.actuator.lease == "tester"
    led.run.run(led.run.now_ns() + 2 * S)
    led.commander.move(VelocityCommand(0, np.array([0.08, 0.0]), 0.0, 0.11, 0.04))
    led.commander.give("walk")
    begin = led.place()
    led.until(Mode.WALK, 5.0)
    led.run.run(led.run.now_ns() + 5 * S)
    assert led.place()[0] - begin[0] > 0.15
    goal = led.place() + np.array([0.3, 0.0])
    led.commander.move(Goal(0, goal[None], 0.03, 0.1, 0.11, 0.04))
    end = led.run.now_ns() + 30 * S
    while led.status.planner is None or led.status.planner.state != "arrived":
        assert led.run.now_ns() < end, led.status.planner
        led.run.run(led.run.now_ns() + S // 20)
    assert np.linalg.norm(led.place() - goal) < 0.035, "the tolerance, and a correction of the pose"
    assert led.status.planner is not None
    np.testing.assert_array_equal(led.status.planner.path, [goal])
    feet = []
    for left in (0.0, 0.02):
        led.commander.move(PostureCommand(0, np.array([0.0, left, 0.0]), np.zeros(3)))
        led.run.run(led.run.now_ns() + 3 * S)
        assert led.status.planner.reason == "the body is in the commanded posture"
        feet.append(led.status.actuator.feet)
    np.testing.assert_allclose(feet[0] - feet[1], np.tile([0.0, 0.02, 0.0], (6, 1)), atol=0.003)
    led.commander.give("stop")
    led.until(Mode.HOLD, 5.0)


def test_invalid_endpoint_raises_error() -> None:
    with pytest.raises(ValueError, match="nowhere"):
        Client("nowhere")


def test_package_import_loads_no_heavy_libraries() -> None:
    code = "import sextant, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert not set(done.stdout.split()) & {"numpy", "zenoh", "numba", "cv2", "mujoco"}


def test_public_names_exist() -> None:
    for name in sextant.__all__:
        assert getattr(sextant, name) is not None
    assert set(sextant.__all__) <= set(dir(sextant))
    with pytest.raises(AttributeError, match="no attribute 'Sextant'"):
        _ = sextant.Sextant
