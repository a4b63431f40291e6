"""Hobby servos behind a microcontroller with PCA9685 or a Maestro: the driver, the firmware and the boards at their bytes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError
from sextant.services.actuator.servo_bus.pulse_bridge import PulseBridge
from sextant.services.actuator.servo_bus.servo_interface import on_port
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.shared.servo import maestro, pca9685
from sextant.shared.servo.bridge_protocol import Instruction, Limits, Mode, Refusal, Result
from sextant.shared.servo.bus_fault import BusFault, FaultKind
from sextant.shared.servo.firmware.pulses import LEG_US
from sextant.shared.servo.pwm import TABLE, Pulses
from tests.support.pulse_bridge_rig import BOARDS, CENTRE, NEAR_TICKS, PERIOD_NS, PULSES, Rig


@BOARDS
@pytest.mark.parametrize("spread", [False, True])
@pytest.mark.parametrize("torque", [True, False])
def test_setup_adopts_the_pulses_and_changes_none(pulses: Pulses, torque: bool, spread: bool) -> None:
    rig = Rig(pulses, torque, spread)
    before = rig.goals
    rig.driver.setup()
    rig.cycle(10)
    assert rig.mode is (Mode.HOLDING if torque else Mode.OFF)
    assert rig.torque == 18 * torque
    assert (rig.goals == before).all()
    channel = rig.channels[12]
    assert rig.driver.read(channel, TABLE.torque_enable) == torque
    goal = rig.driver.read(channel, TABLE.goal_position)
    assert goal is not None
    assert abs(goal - (CENTRE + 100 if torque else CENTRE)) <= NEAR_TICKS
    condition = TABLE.condition
    found = rig.driver.read_bytes(channel, condition.address, condition.size)
    assert found is not None
    assert condition.unpack(found) == (1, torque, goal, 1, 0, 0)


@BOARDS
def test_pulses_beyond_the_range_are_adopted_as_its_end(pulses: Pulses) -> None:
    rig = Rig(pulses, torque=True)
    wide = pca9685.frame(pca9685.write(0x40, pca9685.LED0 + 4 * 5, (0, 0, 0xFF, 0x0F)))
    rig.chips.receive(maestro.set_target(5, maestro.MAX_TARGET) if pulses.board == "maestro" else wide, 0)
    rig.driver.setup()
    rig.cycle(5)
    assert rig.mode is Mode.HOLDING
    goal = rig.driver.read(5, TABLE.goal_position)
    assert goal is not None
    assert abs(goal - CENTRE - 4 * pulses.range_us) <= NEAR_TICKS
    rig.cycle(300, CENTRE)
    assert (rig.mode, rig.torque) == (Mode.ON, 18)
    assert np.abs(rig.goals - CENTRE).max() <= NEAR_TICKS


@BOARDS
def test_what_servos_do_not_measure_is_never_returned(pulses: Pulses) -> None:
    rig = Rig(pulses, torque=True)
    assert rig.driver.newest_age_s == math.inf
    rig.driver.setup()
    rig.cycle(5)
    assert all(rig.driver.read(3, register) is None for register in TABLE.measured)
    assert rig.driver.missed.tolist() == [0] * 18
    assert rig.driver.newest_age_s < 0.05
    assert not rig.driver.trouble


@BOARDS
@pytest.mark.parametrize("spread", [False, True])
def test_torque_comes_leg_by_leg_at_the_goals_sent_before(pulses: Pulses, spread: bool) -> None:
    rig = Rig(pulses, spread=spread)
    rig.driver.setup()
    rig.cycle(3, CENTRE + 200)
    assert rig.torque == 0
    for _ in range(2):  # as the actuator orders it
        rig.driver.set_torque(True)
    assert rig.driver.read(rig.channels[0], TABLE.torque_enable) is None, "not obeyed yet"
    leg_cycles = LEG_US * 1000 // PERIOD_NS
    rig.cycle(leg_cycles // 2, CENTRE + 200)
    for leg in range(6):
        assert rig.torque == 3 * (leg + 1)
        assert rig.mode is Mode.CATCHING_UP
        assert rig.driver.read(rig.channels[17], TABLE.torque_enable) == 1, "it waits for its first pulses"
        assert f"{leg + 1} of 6" in rig.driver.trouble or leg == 5
        rig.cycle(leg_cycles, CENTRE + 200)
    assert rig.mode is Mode.ON
    assert rig.most_at_once == 3
    assert np.abs(rig.goals - CENTRE - 200).max() <= NEAR_TICKS
    rig.cycle(5, CENTRE - 40)
    assert np.abs(rig.goals - CENTRE + 40).max() <= NEAR_TICKS


@BOARDS
def test_torque_off_ends_all_pulses_in_any_state(pulses: Pulses) -> None:
    rig = Rig(pulses, torque=True)
    rig.driver.set_torque(False)  # without a session
    rig.cycle(2)
    assert rig.torque == 0
    rig = Rig(pulses).on()
    rig.driver.set_torque(False)
    rig.cycle(2, CENTRE)
    assert (rig.torque, rig.mode) == (0, Mode.OFF)
    assert rig.driver.read(4, TABLE.torque_enable) == 0
    assert rig.driver.write(4, TABLE.torque_enable, 0)
    rig.cycle(5, CENTRE)
    assert rig.torque == 0, "goals do not turn it on"
    rig.driver.set_torque(True)
    rig.cycle(30, CENTRE)
    assert 0 < rig.torque < 18
    rig.driver.set_torque(False)
    rig.cycle(100, CENTRE)
    assert rig.torque == 0, "the other legs get none, either"


@BOARDS
def test_no_register_write_turns_torque_on_or_moves_a_servo(pulses: Pulses) -> None:
    rig = Rig(pulses)
    rig.driver.setup()
    rig.cycle(3, CENTRE)
    assert not rig.driver.write(2, TABLE.torque_enable, 1)
    assert not rig.driver.write(2, TABLE.goal_position, CENTRE)
    for instruction in Instruction:
        answer = rig.driver.answer(rig.driver.ask(2, instruction, 6, 4))
        assert answer is not None
        assert answer.result is Result.REFUSED
    rig.driver._send(Limits(*rig.driver._head(), (0,) * 18))
    rig.cycle(3)
    assert rig.driver.state is not None
    assert rig.driver.state.refusal is Refusal.QUESTION
    assert rig.torque == 0


@BOARDS
def test_torque_on_needs_goals_near_the_pulses_that_are_there(pulses: Pulses) -> None:
    rig = Rig(pulses, torque=True)
    rig.driver.setup()
    rig.driver.set_torque(True)
    rig.cycle(8)
    assert rig.driver.state is not None
    assert rig.driver.state.refusal is Refusal.NO_GOALS
    rig = Rig(pulses, torque=True)
    rig.driver.setup()
    rig.driver.sync_write_goals([CENTRE + 900] * 18)
    rig.driver.set_torque(True)
    rig.now_ns = rig.port.now_ns()
    rig.cycle(2)
    assert rig.driver.state is not None
    assert rig.driver.state.refusal is Refusal.FAR


@BOARDS
def test_pulses_stay_while_the_host_is_silent_and_distant_goals_are_caught_up(pulses: Pulses) -> None:
    rig = Rig(pulses).on()
    rig.cycle(20)
    assert (rig.mode, rig.torque) == (Mode.HOLDING, 18)
    before, took = rig.goals, 0
    while rig.mode is not Mode.ON or took < 3:
        rig.cycle(1, CENTRE + 800)
        took += 1
        assert np.abs(rig.goals - before).max() <= 80, "30 deg/s, or the last 1.8 deg"
        before = rig.goals
    assert took > 30
    rig.cycle(1, CENTRE + 800)
    assert np.abs(rig.goals - CENTRE - 800).max() <= NEAR_TICKS


@BOARDS
def test_a_host_that_is_silent_while_legs_get_their_torque_delays_the_others(pulses: Pulses) -> None:
    rig = Rig(pulses)
    rig.driver.setup()
    rig.cycle(3, CENTRE)
    rig.driver.set_torque(True)
    rig.cycle(10, CENTRE)
    assert rig.torque == 3
    rig.cycle(100)
    assert (rig.torque, rig.mode) == (3, Mode.HOLDING)
    rig.cycle(200, CENTRE)
    assert rig.torque == 18
    assert rig.most_at_once == 3


@BOARDS
def test_speed_limits_move_pulses_step_by_step(pulses: Pulses) -> None:
    rig = Rig(pulses).on()
    speed = 10  # 1000 ticks/s
    rig.cycle(1, CENTRE, speed)
    before = rig.goals
    for k in range(10):
        rig.cycle(1, CENTRE + 150, speed)
        assert (np.abs(rig.goals - before) <= 20 * k + 30).all()
    rig.cycle(5, CENTRE + 150, speed)
    assert np.abs(rig.goals - CENTRE - 150).max() <= NEAR_TICKS


@BOARDS
def test_chips_that_lose_their_power_give_no_torque_by_themselves(pulses: Pulses) -> None:
    rig = Rig(pulses, spread=True).on()
    rig.chips.restart(rig.now_ns)
    rig.cycle(50, CENTRE)
    assert (rig.torque, rig.mode) == (0, Mode.OFF)
    assert "the pulses of 18 servos are lost, as after a restart of their board" in rig.driver.trouble
    assert rig.driver.read(3, TABLE.torque_enable) == 0
    rig.driver.set_torque(True)
    rig.cycle(round(7 * LEG_US * 1000 / PERIOD_NS), CENTRE)
    assert (rig.torque, rig.mode, rig.driver.trouble) == (18, Mode.ON, "")


@BOARDS
def test_one_channel_without_pulses_stops_the_others_where_they_are(pulses: Pulses) -> None:
    rig = Rig(pulses).on()
    rig.cycle(15)  # the board holds, and no goals give the channel its pulses again
    end = pca9685.frame(pca9685.write(0x40, pca9685.LED0 + 4 * 5, (0, 0, 0, pca9685.FULL)))
    rig.chips.receive(maestro.set_target(5, maestro.OFF) if pulses.board == "maestro" else end, rig.now_ns)
    rig.cycle(10)
    rig.cycle(10, CENTRE + 100)
    assert (rig.torque, rig.mode) == (17, Mode.OFF)
    assert "the pulses of 1 servos are lost" in rig.driver.trouble
    assert np.abs(np.delete(rig.goals, 5) - CENTRE).max() <= NEAR_TICKS
    assert [rig.driver.read(channel, TABLE.torque_enable) for channel in (4, 5)] == [1, 0]
    rig.driver.sync_write_goals([CENTRE] * 18)
    rig.driver.set_torque(True)
    rig.cycle(100, CENTRE)
    assert (rig.torque, rig.mode, rig.driver.trouble) == (18, Mode.ON, "")


@BOARDS
def test_a_restart_of_the_microcontroller_changes_no_pulses(pulses: Pulses) -> None:
    rig = Rig(pulses).on(CENTRE + 200)
    rig.board.restart(rig.port.now_ns())
    rig.cycle(60, CENTRE + 200)
    assert (rig.driver.restarts, rig.mode, rig.torque) == (1, Mode.ON, 18)
    assert np.abs(rig.goals - CENTRE - 200).max() <= NEAR_TICKS
    rig.plug_in()
    rig.driver.setup()
    assert (rig.mode, rig.torque) == (Mode.HOLDING, 18)


@BOARDS
@pytest.mark.parametrize("kind", ["silent", "garbage"])
def test_silent_boards_are_reported_and_their_pulses_go_on(pulses: Pulses, kind: FaultKind) -> None:
    rig = Rig(pulses).on()
    rig.faults.inject(BusFault("bus", kind, 0.0, 0.6), rig.now_ns)
    rig.cycle(20, CENTRE)
    assert "the board of the servos has been silent for" in rig.driver.trouble
    assert rig.driver.lost["bridge: no answer"] + rig.driver.lost["bridge: garbled packet"] > 0
    assert rig.torque == 18
    rig.cycle(30, CENTRE + 30)
    assert rig.driver.trouble == ""
    assert np.abs(rig.goals - CENTRE - 30).max() <= NEAR_TICKS


@BOARDS
def test_broken_answers_end_no_pulses(pulses: Pulses) -> None:
    rig = Rig(pulses).on()
    rng, receive = np.random.default_rng(1000), rig.chips.receive

    def spoil(data: bytes, now_ns: int) -> list[Reply]:
        return [
            reply._replace(data=bytes(byte ^ int(rng.integers(256)) if rng.random() < 0.02 else byte for byte in reply.data))
            for reply in receive(data, now_ns)
        ]

    rig.chips.receive = spoil  # type: ignore[method-assign]
    for k in range(100):
        rig.cycle(1, CENTRE + k)
        assert rig.torque == 18
    assert rig.driver.lost["bridge: garbled packet"] > 0


@BOARDS
def test_board_with_other_pulses_is_refused(pulses: Pulses) -> None:
    rig = Rig(pulses)
    there = "Maestro" if pulses.board == "maestro" else "50 Hz"
    driver = PulseBridge(rig.port, rig.channels, rig.port.now_ns, replace(pulses, us_per_rad=636.6))
    words = f"drives servos PWM 424400 1500 1000 us {there}, the profile has PWM 636600 1500 1000 us {there}; set SERVO"
    with pytest.raises(BusSetupError, match=words):
        driver.setup()


def test_microcontroller_with_another_sender_is_refused() -> None:
    rig = Rig(PULSES["pca9685"])
    driver = PulseBridge(rig.port, rig.channels, rig.port.now_ns, PULSES["maestro"])
    words = r"has PWM 424400 1500 1000 us Maestro; set SERVO = .PWM. and PULSES = \('Maestro', 424400, 1500, 1000, 50, 0\)"
    with pytest.raises(BusSetupError, match=words):
        driver.setup()


@BOARDS
def test_setting_bridge_selects_the_driver(pulses: Pulses) -> None:
    rig = Rig(pulses)
    assert isinstance(on_port(rig.own, Settings(bridge=True), rig.port, rig.port.now_ns), PulseBridge)


@BOARDS
def test_torque_off_is_not_confirmed_by_silent_boards(pulses: Pulses) -> None:
    rig = Rig(pulses, torque=True)
    rig.faults.inject(BusFault("bus", "silent", 0.0, 60.0), 0)
    rig.driver.set_torque(False)
    name = "Pololu Maestro" if pulses.board == "maestro" else "PCA9685"
    with pytest.raises(BusSetupError, match=f"does not tell which pulses the {name} behind it sends"):
        rig.driver.open_session()
    rig = Rig(pulses).on()
    rig.faults.inject(BusFault("bus", "silent", 0.0, 0.4), rig.now_ns)
    rig.cycle(2)
    rig.driver.set_torque(False)
    rig.cycle(5, CENTRE)
    assert rig.driver.read(4, TABLE.torque_enable) == 1
    assert rig.torque == 18
    rig.cycle(20, CENTRE)
    assert rig.driver.read(4, TABLE.torque_enable) == rig.torque == 0


@BOARDS
def test_torque_off_is_confirmed_at_any_time_of_adopting(pulses: Pulses) -> None:
    for ms in range(0, 60, 3):
        rig = Rig(pulses, torque=True)
        rig.driver._session = 7
        rig.driver._greet()
        rig.now_ns = ms * 1_000_000
        rig.board.advance(rig.now_ns)
        rig.driver.set_torque(False)
        rig.cycle(20)
        found = [rig.driver.read(channel, TABLE.torque_enable) for channel in rig.channels]
        assert (rig.torque, rig.mode, found) == (0, Mode.OFF, [0] * 18)


@BOARDS
def test_boards_that_are_silent_when_a_session_begins_get_pulses_later(pulses: Pulses) -> None:
    rig = Rig(pulses)
    rig.faults.inject(BusFault("bus", "silent", 0.0, 0.8), 0)
    rig.driver.setup()
    rig.cycle(60, CENTRE)
    assert (rig.torque, rig.mode) == (0, Mode.OFF)
    rig.driver.set_torque(True)
    rig.cycle(round(7 * LEG_US * 1000 / PERIOD_NS), CENTRE)
    assert (rig.torque, rig.mode, rig.driver.trouble) == (18, Mode.ON, "")
