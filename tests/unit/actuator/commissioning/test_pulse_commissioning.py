"""Commissioning of hobby servos on an emulated board, with a scripted operator."""

from contextlib import nullcontext
from dataclasses import replace
from datetime import date
from typing import NoReturn

import numpy as np
import pytest

from sextant.services.actuator.commissioning import pulse_commissioning
from sextant.services.actuator.commissioning.torque_off import torque_off
from sextant.services.actuator.servo_bus.pwm_servos import PwmServos
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.pulse_bench import PulseBench
from sextant.shared.robot.profile import Calibration, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo.pwm import Board
from sextant.shared.servo.servo_model import Register

TODAY = date(2026, 7, 30)


class Operator:
    """Person with prepared answers."""

    absent = False

    def __init__(self, answers: str = "", agrees: bool = True) -> None:
        self.answers = answers.split(",")
        self.agrees = agrees
        self.told: list[str] = []

    def say(self, text: str) -> None:
        self.told.append(text)

    def ask(self, question: str) -> str:
        self.told.append(question)
        return self.answers.pop(0)

    def agree(self, question: str) -> bool:
        self.told.append(question)
        return self.agrees


class Rig:
    """Robot on a workbench, in virtual time."""

    def __init__(self, board: Board) -> None:
        profile = load_profile("printed_ds3218")
        assert profile.servo.pulses is not None
        self.pulses = replace(profile.servo.pulses, board=board)
        self.profile: RobotProfile = replace(profile, servo=replace(profile.servo, pulses=self.pulses))
        self.bench = PulseBench(self.profile)
        self.now_ns = 0
        self.port = MemoryPort(self.bench, lambda: self.now_ns)
        self.servos = PwmServos(self.port, list(profile.servo_names), self.port.now_ns, self.pulses)

    def pause(self, seconds: float) -> None:
        self.now_ns = self.port.now_ns() + round(seconds * 1e9)

    @property
    def with_pulses(self) -> list[str]:
        return [one.joint for one in pulse_commissioning.channels(self.servos, self.profile) if one.width_us]


@pytest.fixture(params=["maestro", "pca9685"])
def rig(request: pytest.FixtureRequest) -> Rig:
    return Rig(request.param)


def test_channels_are_listed_with_their_pulses(rig: Rig) -> None:
    rig.servos.setup()
    channel = int(rig.profile.servo_ids[2, 1])
    rig.servos.write(channel, rig.servos.model.table.goal_position, rig.servos.model.units.centre)
    rig.servos.write(channel, rig.servos.model.table.torque_enable, 1)
    found = pulse_commissioning.channels(rig.servos, rig.profile)
    assert len(found) == 18
    one = found[channel]
    assert (one.number, one.joint) == (channel, "right middle femur")
    assert one.width_us == pytest.approx(1500.0, abs=3.0)
    assert sum(other.width_us > 0.0 for other in found) == 1
    assert pulse_commissioning.in_words(found).count("no pulses") == 17


def test_trims_are_the_typed_changes(rig: Rig) -> None:
    kept: list[Calibration] = []
    operator = Operator("2,0.5,,-3,,much,20,,")
    done = pulse_commissioning.calibrate(
        rig.servos, rig.profile, operator, kept.append, TODAY, legs=["left front"], pose_deg=(0.0, 0.0, 0.0)
    )
    assert done
    assert kept[0].leg == "left front"
    np.testing.assert_allclose(kept[0].trims_deg, (2.5, -3.0, 0.0), atol=0.05)
    assert any("degrees from -5 to 5 expected, found 'much'" in words for words in operator.told)
    assert any("found '20'" in words for words in operator.told)
    assert rig.with_pulses == []


def test_calibration_moves_nothing_unless_the_operator_agrees_and_ends_at_a_wish(rig: Rig) -> None:
    kept: list[Calibration] = []
    arguments = (rig.servos, rig.profile)
    for operator in (Operator(agrees=False), Operator("q")):
        done = pulse_commissioning.calibrate(
            *arguments, operator, kept.append, TODAY, legs=["left front"], pose_deg=(0.0, 0.0, 0.0)
        )
        assert not done
        assert not kept
        assert rig.with_pulses == []


def test_joint_test_stays_within_limits_that_exclude_straight_legs() -> None:
    rig = Rig("maestro")
    bent = [replace(leg, servo_limits_deg=((-60.0, 60.0), (-80.0, 80.0), (-80.0, 80.0))) for leg in rig.profile.legs]
    profile = replace(rig.profile, legs=tuple(bent), horn_offsets_deg=(0.0, -35.0, 115.0))
    sent: list[float] = []
    send = rig.servos.write

    def write(channel: int, register: Register, value: int) -> bool:
        if register == rig.servos.model.table.goal_position:
            sent.append(float(np.degrees(rig.servos.model.units.angle(value))))
        return send(channel, register, value)

    rig.servos.write = write  # type: ignore[method-assign]
    operator = Operator("y,y,y")
    assert pulse_commissioning.run_joint_test(rig.servos, profile, operator, rig.pause, legs=["left front"]) == []
    assert np.abs(sent).max() < 80.0
    assert "in the pose coxa 0, femur 0, tibia -115 deg" in operator.told[0]


def test_each_joint_is_moved_alone_and_torque_is_off_afterwards(rig: Rig) -> None:
    operator = Operator("y,y,r,w,y,a,y")
    wrong = pulse_commissioning.run_joint_test(rig.servos, rig.profile, operator, rig.pause, legs=["left front", "left rear"])
    assert wrong is not None
    reversed_one, exchanged = wrong
    assert reversed_one.startswith("left front tibia: turns the wrong way: change the sign of the tibia in the leg's")
    assert exchanged.startswith("left rear femur: another joint moved, which has channel ")
    assert sum("did the left front foot go" in words for words in operator.told) == 4
    assert rig.with_pulses == []
    operator.agrees = False
    assert pulse_commissioning.run_joint_test(rig.servos, rig.profile, operator, rig.pause, legs=["left front"]) is None


def test_torque_off_is_confirmed_by_the_board(rig: Rig) -> None:
    rig.servos.setup()
    rig.servos.write(3, rig.servos.model.table.torque_enable, 1)
    assert rig.with_pulses == ["right front coxa"]
    assert torque_off(rig.servos) == {}
    assert rig.with_pulses == []


@pytest.mark.parametrize("interrupted", [False, True])
def test_centre_sends_pulses_of_the_middle_to_one_channel_until_enter(rig: Rig, interrupted: bool) -> None:
    class Watching(Operator):
        def ask(self, question: str) -> str:
            (one,) = (one for one in pulse_commissioning.channels(rig.servos, rig.profile) if one.width_us)
            assert (one.number, one.angle_deg) == (4, pytest.approx(0.0, abs=0.5))
            if interrupted:
                raise KeyboardInterrupt
            return super().ask(question)

    operator = Watching()
    with pytest.raises(KeyboardInterrupt) if interrupted else nullcontext():
        assert pulse_commissioning.centre(rig.servos, rig.profile, 4, operator)
    assert rig.with_pulses == []
    assert operator.told[-1] == "its pulses have ended"


def test_one_servo_wiggles_about_its_middle_and_others_keep_their_pulses(rig: Rig) -> None:
    rig.servos.setup()
    rig.servos.write(9, rig.servos.model.table.torque_enable, 1)
    angles = list[float]()

    def pause(seconds: float) -> None:
        rig.pause(seconds)
        angles.append(pulse_commissioning.channels(rig.servos, rig.profile)[4].angle_deg)

    assert pulse_commissioning.wiggle(rig.servos, rig.profile, 4, Operator(), pause)
    assert [min(angles), max(angles)] == pytest.approx([-8.0, 8.0], abs=0.8)
    assert rig.with_pulses == [rig.profile.servo_names[9]]
    assert not pulse_commissioning.wiggle(rig.servos, rig.profile, 4, Operator(agrees=False), pause)


@pytest.mark.parametrize("job", ["calibrate", "test"])
def test_interrupted_job_says_that_torque_is_off(job: str) -> None:
    rig = Rig("maestro")

    def interrupted(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    def run() -> None:
        if job == "test":
            pulse_commissioning.run_joint_test(rig.servos, rig.profile, operator, interrupted, legs=["left front"])
        pose = (0.0, 0.0, 0.0)
        pulse_commissioning.calibrate(rig.servos, rig.profile, operator, interrupted, TODAY, legs=["left front"], pose_deg=pose)

    operator = Operator()
    operator.ask = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        run()
    assert operator.told[-1].endswith("torque is off")
    assert job == "calibrate" or operator.told[0].startswith("Each joint of the left front leg jumps")
