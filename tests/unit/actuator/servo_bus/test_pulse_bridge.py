"""Hobby servos behind a microcontroller with PCA9685 or a Maestro: the driver, the firmware and the boards at their bytes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.config import Settings
from sextant.services.actuator.servo_bus.bridge_link import READ_NS
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError
from sextant.services.actuator.servo_bus.pulse_bridge import PulseBridge
from sextant.services.actuator.servo_bus.servo_interface import on_port
from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.pulse_board import MaestroEmulator, make_board
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import maestro, pca9685
from sextant.shared.servo.bridge_protocol import Instruction, Limits, Mode, Refusal, Result
from sextant.shared.servo.bus_fault import BusFault, FaultKind
from sextant.shared.servo.firmware.pulse_senders import MAESTRO_RATES
from sextant.shared.servo.firmware.pulses import LEG_US
from sextant.shared.servo.pwm import TABLE, Pulses
from sextant.shared.servo.pwm import Board as PulseBoard

PERIOD_NS, BUDGET_NS = 20_000_000, 6_500_000
CENTRE, NEAR_TICKS = 4000, 10  # a count of a PCA9685 is 4.9 us, 20 ticks
PROFILE = load_profile("printed_ds3218")
assert PROFILE.servo.pulses is not None
PULSES: dict[PulseBoard, Pulses] = {
    "pca9685": replace(PROFILE.servo.pulses, board="pca9685"),
    "maestro": replace(PROFILE.servo.pulses, board="maestro"),
}
BOARDS = pytest.mark.parametrize("pulses", PULSES.values(), ids=PULSES)


class Rig:
    """18 servos at two PCA9685 or a Maestro in virtual time, with a microcontroller, and a driver."""

    def __init__(
        self, pulses: Pulses, torque: bool = False, spread: bool = False, start: int | np.ndarray = CENTRE + 100
    ) -> None:
        self.channels = (*range(9), *range(15, 24)) if spread else tuple(range(18))
        self.pulses, self.own = pulses, replace(PROFILE, servo=replace(PROFILE.servo, pulses=pulses))
        self.bank = make_servo_bank(self.own.servo, self.channels, np.zeros(18))
        self.bank.column(TABLE.torque_enable)[:] = torque
        self.bank.column(TABLE.goal_position)[:] = start
        self.chips = make_board(self.bank, pulses, on_uart=True)
        self.faults = BusFaults(self.chips, self.bank)
        self.board = Board(self.faults, model=self.bank.model, pulses=pulses)
        self.now_ns = 0
        self.most_at_once = 0  # servos that got torque in one cycle
        self.plug_in()

    def plug_in(self) -> None:
        """Connect a new driver to a new port."""
        self.port = MemoryPort(self.board, lambda: self.now_ns, READ_NS * 1e-9)
        self.driver = PulseBridge(self.port, self.channels, self.port.now_ns, self.pulses)

    def cycle(self, count: int = 1, goals: int | np.ndarray | None = None, speed: int = 0) -> None:
        """Run control cycles of an actuator: read, and send goals [ticks] if any."""
        for _ in range(count):
            before = self.torque
            self.now_ns = max(self.now_ns + PERIOD_NS, self.port.now_ns())
            self.board.advance(self.now_ns)
            self.most_at_once = max(self.most_at_once, self.torque - before)
            assert self.driver.poll(BUDGET_NS) == []
            if goals is not None:
                self.driver.sync_write_goals(np.broadcast_to(goals, (18,)), speed)

    def on(self, goals: int = CENTRE) -> "Rig":
        self.driver.setup()
        self.cycle(3, goals)
        self.driver.set_torque(True)
        self.cycle(round(7 * LEG_US * 1000 / PERIOD_NS), goals)
        assert (self.mode, self.torque, self.driver.trouble) == (Mode.ON, 18, "")
        return self

    @property
    def torque(self) -> int:
        return int(self.bank.column(TABLE.torque_enable).sum())

    @property
    def goals(self) -> np.ndarray:
        return self.bank.column(TABLE.goal_position).astype(int)

    @property
    def mode(self) -> Mode:
        assert self.driver.state is not None
        return self.driver.state.mode


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


# --------------------------------------------------------------------------------------------------------------- Maestro


def of_maestro(torque: bool = False, **changes: object) -> Rig:
    return Rig(replace(PULSES["maestro"], **changes), torque)  # type: ignore[arg-type]


def test_device_number_selects_the_pololu_protocol() -> None:
    rig = of_maestro(device=17).on(CENTRE + 50)
    assert rig.bank.column(TABLE.goal_position).tolist() == [CENTRE + 50] * 18


@pytest.mark.parametrize("rate", MAESTRO_RATES)
def test_torque_off_is_confirmed_at_the_lowest_and_at_the_highest_rate_of_a_maestro(rate: int) -> None:
    rig = of_maestro(torque=True)
    assert isinstance(rig.chips, MaestroEmulator)
    rig.chips._byte_ns = 10_000_000_000 // rate
    rig.board = Board(rig.faults, model=replace(rig.bank.model, bus_rate=rate), pulses=rig.pulses)
    rig.plug_in()
    rig.driver.setup()
    rig.cycle(5, CENTRE + 100)
    rig.driver.set_torque(False)
    rig.cycle(30, CENTRE)
    assert [rig.driver.read(channel, TABLE.torque_enable) for channel in rig.channels] == [0] * 18


def test_limits_of_a_maestro_are_removed_before_its_first_pulses() -> None:
    rig = of_maestro()
    seen: list[bytes] = []
    rig.chips.overhear = lambda data, now_ns: seen.append(data)
    rig.on()
    parser = maestro.CommandParser()
    kinds = [packet.command for data in seen for packet in parser.feed(data)]
    first = kinds.index(maestro.Command.SET_MULTIPLE_TARGETS)
    for command in (maestro.Command.SET_SPEED, maestro.Command.SET_ACCELERATION):
        assert kinds[:first].count(command) >= 18


def test_errors_of_a_maestro_are_counted_and_named() -> None:
    rig = of_maestro().on()
    rig.chips.receive(b"\x84\x01\x84\x00\x70\x2e", rig.now_ns)
    rig.cycle(5, CENTRE)
    assert rig.driver.lost["Maestro: serial protocol error"] == 1
    assert isinstance(rig.chips, MaestroEmulator)
    for bit in maestro.BoardError:
        if bit:
            rig.chips._parser.errors |= bit
            rig.cycle(5, CENTRE)
    named = {words: count for words, count in rig.driver.lost.items() if words.startswith("Maestro")}
    assert named == {
        "Maestro: serial signal error": 1,
        "Maestro: serial overrun": 1,
        "Maestro: serial buffer full": 1,
        "Maestro: wrong CRC": 1,
        "Maestro: serial protocol error": 2,
        "Maestro: serial timeout": 1,
        "Maestro: script stack error": 3,  # one bit stands for all errors of its script
    }
    assert not rig.driver.errors.any()
    assert (rig.torque, rig.mode, rig.driver.trouble) == (18, Mode.ON, "")


def test_a_maestro_that_restarts_at_any_time_gets_no_pulses() -> None:
    """It takes a millisecond: a restart that begins and ends between a reading and the goals would not show."""
    for phase_us in range(0, 20_000, 1100):
        rig = of_maestro(torque=True)
        rig.driver.setup()
        rig.cycle(10, CENTRE + 100)
        assert rig.mode is Mode.ON
        receive, began_ns, restarted = rig.faults.receive, rig.now_ns + phase_us * 1000, False

        def restarting(data: bytes, now_ns: int) -> list[Reply]:
            nonlocal restarted
            if not restarted and now_ns >= began_ns:  # noqa: B023
                restarted = True
                rig.chips.restart(now_ns)  # noqa: B023
            return [] if began_ns <= now_ns < began_ns + 1_000_000 else receive(data, now_ns)  # noqa: B023

        rig.faults.receive = restarting  # type: ignore[method-assign]
        rig.cycle(25, CENTRE + 120)
        assert restarted
        assert (rig.torque, rig.mode) == (0, Mode.OFF)


@pytest.mark.parametrize("lost", range(1, 20))
def test_a_maestro_that_restarts_unnoticed_for_some_requests_gets_no_pulses(lost: int) -> None:
    rig = of_maestro().on()
    receive, requests = rig.faults.receive, 0
    rig.chips.restart(rig.now_ns)

    def booting(data: bytes, now_ns: int) -> list[Reply]:
        nonlocal requests
        requests += 1
        return receive(data, now_ns) if requests > lost else []

    rig.faults.receive = booting  # type: ignore[method-assign]
    rig.cycle(30, CENTRE + 20)
    assert (rig.torque, rig.mode) == (0, Mode.OFF)


def test_a_maestro_that_restarts_and_gives_impossible_answers_gets_no_pulses() -> None:
    rig = of_maestro(torque=True)
    rig.driver.setup()
    rig.cycle(10, CENTRE + 100)
    assert rig.mode is Mode.ON
    rig.chips.restart(rig.now_ns)
    receive = rig.chips.receive

    def impossible(data: bytes, now_ns: int) -> list[Reply]:
        replies = receive(data, now_ns)
        return [replies[0]._replace(data=b"\xff\xff"), *replies[1:]] if replies else []

    rig.chips.receive = impossible  # type: ignore[method-assign]
    rig.cycle(25, CENTRE + 120)
    assert rig.torque == 0
    rig.chips.receive = receive  # type: ignore[method-assign]
    rig.cycle(25, CENTRE + 120)
    assert (rig.torque, rig.mode) == (0, Mode.OFF)


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


def test_pulses_that_are_read_back_a_period_later_are_no_error() -> None:
    rig = of_maestro()
    assert isinstance(rig.chips, MaestroEmulator)
    execute, period_ns = rig.chips._execute, 20_000_000
    before: list[tuple[int, list[int]]] = [(0, [0] * 24)]

    def late(packet: maestro.Packet, now_ns: int) -> bytes:
        if packet.command is maestro.Command.GET_POSITION:
            seen = [targets for time_ns, targets in before if time_ns <= now_ns // period_ns * period_ns][-1]
            return seen[packet.data[0]].to_bytes(2, "little")
        found = execute(packet, now_ns)
        before.append((now_ns, list(rig.chips._targets)))
        return found

    rig.chips._execute = late  # type: ignore[method-assign]
    rig.on()
    for k in range(50):
        rig.cycle(1, CENTRE + 3 * k)
        assert rig.torque == 18
        assert rig.driver.newest_age_s < 0.08
    assert rig.driver.lost["bridge: garbled packet"] == 0
    rig.driver.set_torque(False)
    rig.cycle(5, CENTRE)
    assert rig.torque == rig.driver.read(17, TABLE.torque_enable) == 0


def test_coarse_limits_of_a_maestro_are_no_error() -> None:
    rig = of_maestro()
    assert isinstance(rig.chips, MaestroEmulator)
    execute = rig.chips._execute

    def limited(packet: maestro.Packet, now_ns: int) -> bytes:
        found = execute(packet, now_ns)
        return min(maestro.number(found), 9984).to_bytes(2, "little") if found else found  # 2496 us

    rig.chips._execute = limited  # type: ignore[method-assign]
    rig.on(2 * CENTRE)
    rig.cycle(20, 2 * CENTRE)
    assert (rig.driver.trouble, rig.driver.lost["bridge: garbled packet"]) == ("", 0)


@pytest.mark.parametrize("share", [0.02, 0.2])
def test_lost_answers_of_a_maestro_do_not_change_its_adopted_pulses(share: float) -> None:
    rng = np.random.default_rng(1000)
    for _ in range(10):
        rig = of_maestro(torque=True)
        receive = rig.chips.receive

        def lossy(data: bytes, now_ns: int) -> list[Reply]:
            return [reply for reply in receive(data, now_ns) if rng.random() > share]  # noqa: B023

        rig.chips.receive = lossy  # type: ignore[method-assign]
        rig.driver.setup()
        assert rig.mode is Mode.HOLDING
        rig.chips.receive = receive  # type: ignore[method-assign]
        assert (rig.goals == CENTRE + 100).all()
        rig.cycle(60, CENTRE + 160)
        assert (rig.mode, rig.torque) == (Mode.ON, 18)
        assert (rig.goals == CENTRE + 160).all()


def test_torque_off_that_a_maestro_has_not_received_is_repeated_and_not_confirmed() -> None:
    rig = of_maestro().on()
    receive = rig.faults.receive
    rig.faults.receive = lambda data, now_ns: [] if data[0] == 0x9F else receive(data, now_ns)  # type: ignore[method-assign]
    rig.driver.set_torque(False)
    rig.cycle(10, CENTRE)
    assert rig.torque == 18
    assert rig.mode is Mode.OFF
    assert rig.driver.read(3, TABLE.torque_enable) == 1
    rig.driver.sync_write_goals([CENTRE] * 18)
    rig.driver.set_torque(True)
    rig.cycle(2, CENTRE)
    assert rig.driver.state is not None
    assert rig.driver.state.refusal is Refusal.FAR, "some servos may still have pulses"
    rig.driver.set_torque(False)
    rig.faults.receive = receive  # type: ignore[method-assign]
    rig.cycle(5, CENTRE)
    assert rig.torque == rig.driver.read(3, TABLE.torque_enable) == 0


def byte_by_byte(reply: Reply) -> list[Reply]:
    """Return an answer as a UART receives it."""
    ends = [reply.due_ns - left * 86_805 for left in range(len(reply.data))]
    return [reply._replace(due_ns=end, data=bytes((byte,))) for end, byte in zip(reversed(ends), reply.data, strict=True)]


@pytest.mark.parametrize("kind", ["late", "longer", "shorter"])
def test_answers_of_a_maestro_are_those_of_their_requests_after_a_wrong_one(kind: str) -> None:
    for wrong in range(1, 37, 6):
        rig = Rig(PULSES["maestro"], torque=True, start=(start := CENTRE + 40 * np.arange(18)))
        receive, answers = rig.chips.receive, 0

        def spoil(data: bytes, now_ns: int) -> list[Reply]:
            nonlocal answers
            replies = receive(data, now_ns)  # noqa: B023
            answers += bool(replies)
            if replies and answers == wrong + 1:  # noqa: B023
                if kind == "late":
                    replies = [reply._replace(due_ns=reply.due_ns + 7_000_000) for reply in replies]
                else:
                    first = replies[0].data
                    replies[0] = replies[0]._replace(data=b"\0" + first if kind == "longer" else first[1:])
            return [part for reply in replies for part in byte_by_byte(reply)]

        rig.chips.receive = spoil  # type: ignore[method-assign]
        rig.driver.setup()
        assert rig.mode is Mode.HOLDING
        for _ in range(20):
            rig.cycle(1, start + 20)
            assert np.abs(rig.goals - start).max() <= 20
        assert (rig.mode, rig.torque, rig.goals.tolist()) == (Mode.ON, 18, (start + 20).tolist())


def test_pulses_of_a_maestro_that_always_answers_late_are_not_adopted() -> None:
    rig = Rig(PULSES["maestro"], torque=True, start=(start := CENTRE + 40 * np.arange(18)))
    receive = rig.chips.receive
    rig.chips.receive = lambda data, now_ns: [  # type: ignore[method-assign]
        reply._replace(due_ns=reply.due_ns + 7_000_000) for reply in receive(data, now_ns)
    ]
    rig.driver.setup()
    rig.cycle(50, start + 20)
    assert (rig.mode, rig.torque, rig.goals.tolist()) == (Mode.OFF, 18, start.tolist())
