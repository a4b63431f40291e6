"""Legs that lie: the robot names them and stands, and torque stays as it is until an order."""

import re

import pytest

from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.services.simulator.service import Simulator
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, GroundTruth, Mode, ModeCommand
from tests.support.walks import Heard, S, flat

COXA, FEMUR = 13, 15  # of the left middle leg


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        (BusFault("servo", "slipped", 8.0, 1000.0, servo=COXA), r"left middle leg.*horn has slipped by about \d+ deg"),
        (
            BusFault("servo", "bit", 8.0, 1000.0, servo=FEMUR),
            r"the femur servo of the left middle leg \(id 15\) is \d+ deg off",
        ),
    ],
    ids=["slipped horn", "stuck goal bit"],
)
def test_lying_leg_is_named_and_the_robot_stands_until_torque_is_ordered_off(fault: BusFault, named: str) -> None:
    heard = Heard((topics.ACTUATOR_STATE, topics.TRUTH))
    run = LockstepRun(flat(5.0), 1000, load_profile("phantomx_mk2"), heard.tap, every_frame=False)
    simulator = run.service("simulator")
    assert isinstance(simulator, Simulator)
    simulator.inject(fault)
    run.run(12 * S)
    before: list[ActuatorState] = heard.of(topics.ACTUATOR_STATE, 3.0, fault.at_s)
    assert all(state.mode is Mode.WALK and not state.warnings for state in before)
    state = heard.of(topics.ACTUATOR_STATE)[-1]
    assert state.mode is Mode.FAULT
    assert re.search(named, state.reason)
    truth: list[GroundTruth] = heard.of(topics.TRUTH, fault.at_s)
    assert min(one.T_world_body[2, 2] for one in truth) > 0.99
    assert (simulator.servos.tables[:, dxl.TORQUE_ENABLE.address] == 1).all()
    for order, mode, torque in (("walk", Mode.FAULT, 1), ("stand", Mode.FAULT, 1), ("off", Mode.OFF, 0)):
        run.say(ModeCommand(run.now_ns(), order, run.now_ns(), "bench", take_over=True))
        run.run(run.now_ns() + S)
        assert heard.of(topics.ACTUATOR_STATE)[-1].mode is mode
        assert (simulator.servos.tables[:, dxl.TORQUE_ENABLE.address] == torque).all()
