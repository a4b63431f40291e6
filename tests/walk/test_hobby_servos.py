"""A robot with hobby servos, which report nothing: it walks, and its torque comes leg by leg on an operator's order only."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.services.simulator.service import Simulator
from sextant.services.simulator.servo_bus.pulse_board import PulseBoardEmulator
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.servo.pwm import TABLE, Board
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, GroundTruth, Mode, ModeCommand
from tests.support.walks import Heard, S, flat

BOARDS: tuple[Board, ...] = ("maestro", "pca9685")
EACH_WAY: tuple[tuple[Board, bool], ...] = (("maestro", False), ("pca9685", False), ("pca9685", True))
WAY_NAMES = ("maestro", "pca9685", "pca9685 behind a bridge")
WAYS = pytest.mark.parametrize(("board", "bridge"), EACH_WAY, ids=WAY_NAMES)


def robot(board: Board) -> RobotProfile:
    """Return the robot with one of the boards."""
    profile = load_profile("printed_ds3218")
    assert profile.servo.pulses is not None
    return replace(profile, servo=replace(profile.servo, pulses=replace(profile.servo.pulses, board=board)))


class Walk:
    """A lockstep run of that robot on flat ground."""

    def __init__(self, board: Board, bridge: bool) -> None:
        self.heard = Heard((topics.ACTUATOR_STATE, topics.TRUTH))
        self.run = LockstepRun(flat(5.0, bridge=bridge), 1000, robot(board), self.heard.tap, every_frame=False)
        simulator = self.run.service("simulator")
        assert isinstance(simulator, Simulator)
        self.simulator = simulator

    def order(self, mode: str, seconds: float) -> ActuatorState:
        """Give an order, and return the state some time later."""
        now_ns = self.run.now_ns()
        self.run.say(ModeCommand(now_ns, mode, now_ns, "bench", take_over=True))  # type: ignore[arg-type]
        self.run.run(now_ns + round(seconds * S))
        return self.state

    @property
    def state(self) -> ActuatorState:
        return self.heard.of(topics.ACTUATOR_STATE)[-1]

    @property
    def truth(self) -> GroundTruth:
        return self.heard.of(topics.TRUTH)[-1]

    @property
    def torque(self) -> int:
        """Number of servos with torque."""
        return int(self.simulator.servos.column(TABLE.torque_enable).sum())


@pytest.mark.parametrize(
    ("board", "bridge", "terrain", "distance"),
    [
        ("maestro", False, "flat", 0.4),
        ("pca9685", False, "flat", 0.4),
        ("pca9685", True, "flat", 0.4),
        ("maestro", True, "flat", 0.4),
        *(
            pytest.param(board, False, name, load_scenario(name).goal.distance, marks=pytest.mark.rare)
            for board in BOARDS
            for name in ("steps", "stairs")
        ),
        pytest.param("pca9685", True, "steps", load_scenario("steps").goal.distance, marks=pytest.mark.rare),
    ],
)
def test_robot_walks_to_its_goal(board: Board, bridge: bool, terrain: str, distance: float) -> None:
    scenario = load_scenario(terrain)
    scenario = replace(scenario, goal=replace(scenario.goal, distance=distance), bridge=bridge)
    run = LockstepRun(scenario, 1000, robot(board))
    while not run.attendance.over():
        run.run(run.now_ns() + S // 2)
    report = run.attendance.judge(1.0, in_a_hurry=True)
    assert report.success, report.reason
    assert report.falls == 0


@WAYS
def test_torque_comes_leg_by_leg_after_the_operator_has_laid_the_robot_down(board: Board, bridge: bool) -> None:
    walk = Walk(board, bridge)
    walk.run.run(5 * S)
    assert walk.state.mode is Mode.WALK
    assert "no feedback: the angles of the joints are assumed" in walk.state.warnings
    assert not walk.state.load_nm.any()
    assert walk.state.voltage == walk.state.temperature == 0.0
    state = walk.order("sit", 5.0)
    assert state.mode is Mode.READY
    state = walk.order("off", 1.0)
    assert (state.mode, walk.torque) == (Mode.OFF, 0)
    state = walk.order("stand", 1.0)
    assert (state.mode, walk.torque) == (Mode.OFF, 0)
    assert any("lay the robot on its belly" in words for words in state.warnings)
    state = walk.order("ready", 1.0)
    assert state.mode is Mode.READY
    assert 0 < walk.torque < 18
    assert any("one after another" in words for words in state.warnings)
    state = walk.order("stand", 0.5)
    assert any("`stand` refused" in words for words in state.warnings)
    walk.run.run(walk.run.now_ns() + 4 * S)
    assert walk.torque == 18
    error = walk.truth.q - walk.state.q
    assert np.abs(error).max() < np.radians(6.0)
    state = walk.order("stand", 4.0)
    assert state.mode is Mode.HOLD
    assert walk.truth.T_world_body[2, 3] > 0.08
    state = walk.order("walk", 2.0)
    assert state.mode is Mode.WALK


@pytest.mark.parametrize(("board", "bridge"), [*EACH_WAY, ("maestro", True)], ids=[*WAY_NAMES, "maestro behind a bridge"])
def test_a_board_that_restarts_gives_no_torque_by_itself(board: Board, bridge: bool) -> None:
    walk = Walk(board, bridge)
    walk.run.run(5 * S)
    emulator = walk.simulator.bus._bus
    assert isinstance(emulator, PulseBoardEmulator)
    emulator.restart(walk.run.now_ns())
    walk.run.run(walk.run.now_ns() + 3 * S)
    assert walk.torque == 0
    assert walk.state.mode is Mode.FAULT
    assert "restart" in walk.state.reason
    state = walk.order("walk", 1.0)
    assert (state.mode, walk.torque) == (Mode.FAULT, 0)
    walk.order("ready", 6.0)
    assert walk.torque == 18
    assert walk.order("stand", 4.0).mode is Mode.HOLD


@WAYS
def test_torque_ordered_while_the_port_is_gone_stays_off_until_it_is_ordered_again(board: Board, bridge: bool) -> None:
    walk = Walk(board, bridge)
    walk.run.run(2 * S)
    walk.order("off", 1.0)
    walk.simulator.inject(BusFault("bus", "gone", 0.0, 1.0))
    walk.run.run(walk.run.now_ns() + S // 4)
    walk.order("ready", 4.0)
    assert walk.torque == 0
    walk.order("ready", 4.0)
    assert walk.torque == 18


@pytest.mark.parametrize(
    ("board", "bridge", "kind"),
    [
        *((board, bridge, kind) for board, bridge in EACH_WAY for kind in ("silent", "gone", "intermittent", "garbage")),
        ("maestro", True, "garbage"),
    ],
)
def test_a_board_that_is_away_stops_the_walk_and_it_goes_on_afterwards(board: Board, bridge: bool, kind: str) -> None:
    walk = Walk(board, bridge)
    walk.simulator.inject(BusFault("bus", kind, 6.0, 1.0, **({"off_ms": 300.0} if kind == "intermittent" else {})))  # type: ignore[arg-type]
    walk.run.run(6 * S + S * 4 // 5)
    assert walk.state.mode is Mode.FAULT
    assert walk.torque == 18
    walk.run.run(9 * S)
    x = walk.truth.T_world_body[0, 3]
    walk.run.run(12 * S)
    assert walk.state.mode is Mode.WALK
    assert walk.truth.T_world_body[0, 3] > x + 0.1
    assert min(one.T_world_body[2, 2] for one in walk.heard.of(topics.TRUTH)) > 0.98
