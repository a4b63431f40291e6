"""Driver for hobby servos, against emulated boards at their bytes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sextant.services.actuator.servo_bus.bus_driver import BusDisconnectedError, BusSetupError
from sextant.services.actuator.servo_bus.pwm_servos import LEG_S, PwmServos
from sextant.services.simulator.servo_bus.bus_faults import BusFaults
from sextant.services.simulator.servo_bus.memory_port import MemoryPort
from sextant.services.simulator.servo_bus.pulse_board import make_board
from sextant.services.simulator.servo_bus.servo_bank import make_servo_bank
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo.bus_fault import BusFault
from sextant.shared.servo.pwm import TABLE, Board

PERIOD_NS = 20_000_000
CENTRE = 4000
BOARDS: tuple[Board, ...] = ("maestro", "pca9685")


class Rig:
    """18 servos at a board in memory, in virtual time."""

    def __init__(self, board: Board, torque: bool = False, spread: bool = False, device: int = 0) -> None:
        profile = load_profile("printed_ds3218")
        assert profile.servo.pulses is not None
        pulses = replace(profile.servo.pulses, board=board, device=device)
        channels = (*range(9), *range(16, 25)) if spread else tuple(range(18))
        self.bank = make_servo_bank(replace(profile.servo, pulses=pulses), channels, np.zeros(18))
        self.bank.column(TABLE.torque_enable)[:] = torque
        self.bank.column(TABLE.goal_position)[:] = CENTRE + 100
        self.board = make_board(self.bank, pulses)
        self.faults = BusFaults(self.board, self.bank)
        self.now_ns = 0
        self.port = MemoryPort(self.faults, lambda: self.now_ns)
        self.servos = PwmServos(self.port, channels, self.port.now_ns, pulses)

    def cycle(self, goals: int | np.ndarray | None = None, count: int = 1, speed: int = 0) -> None:
        """Run control cycles: ask the board, send goals [ticks] if any, and let 20 ms pass."""
        for _ in range(count):
            self.servos.poll(9_000_000)
            if goals is not None:
                self.servos.sync_write_goals(np.broadcast_to(goals, (18,)), speed)
            self.now_ns = max(self.now_ns + PERIOD_NS, self.port.now_ns())
            self.faults.advance(self.now_ns)

    @property
    def torque(self) -> list[int]:
        return self.bank.column(TABLE.torque_enable).tolist()  # type: ignore[no-any-return]

    @property
    def goals(self) -> list[int]:
        return self.bank.column(TABLE.goal_position).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("torque", [True, False])
def test_setup_adopts_the_pulses_and_changes_none(board: Board, torque: bool) -> None:
    rig = Rig(board, torque)
    rig.servos.setup()
    rig.cycle(count=3)
    assert rig.torque == [int(torque)] * 18
    assert rig.servos.read(3, TABLE.torque_enable) == torque
    goal = rig.servos.read(3, TABLE.goal_position)
    assert goal is not None
    assert abs(goal - (CENTRE + 100 if torque else CENTRE)) <= 10, "a count of a PCA9685 is 4.9 us"


@pytest.mark.parametrize("board", BOARDS)
def test_what_servos_do_not_measure_is_never_returned(board: Board) -> None:
    rig = Rig(board, torque=True)
    rig.servos.setup()
    assert rig.servos.poll(9_000_000, first=(1, 2)) == []
    for register in TABLE.measured:
        assert rig.servos.read(0, register) is None
    assert rig.servos.newest_age_s < 0.1


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("spread", [False, True])
def test_goals_become_pulses_within_two_periods(board: Board, spread: bool) -> None:
    if board == "maestro" and spread:
        pytest.skip("it has 24 channels")
    rig = Rig(board, torque=True, spread=spread)
    rig.servos.setup()
    goals = CENTRE + 50 * np.arange(18)
    rig.cycle(goals, count=2)
    np.testing.assert_allclose(rig.goals, goals, atol=10)


@pytest.mark.parametrize(("board", "device"), [("maestro", 12), ("maestro", 30), ("pca9685", 0x42)])
def test_boards_with_other_numbers_are_driven(board: Board, device: int) -> None:
    rig = Rig(board, torque=True, device=device)
    rig.servos.setup()
    rig.cycle(CENTRE - 200, count=2)
    np.testing.assert_allclose(rig.goals, CENTRE - 200, atol=10)
    assert not rig.servos.lost


@pytest.mark.parametrize("board", BOARDS)
def test_a_new_session_adopts_the_pulses(board: Board) -> None:
    rig = Rig(board, torque=True)
    rig.servos.open_session()
    rig.cycle(CENTRE, count=2)
    np.testing.assert_allclose(rig.goals, CENTRE, atol=10)
    assert all(rig.torque)


@pytest.mark.parametrize("board", BOARDS)
def test_torque_comes_leg_by_leg_and_the_operator_is_told(board: Board) -> None:
    rig = Rig(board)
    rig.servos.setup()
    rig.cycle(CENTRE, count=3)
    assert not any(rig.torque), "goals alone give no torque"
    rig.servos.set_torque(True)
    seen = []
    while rig.servos.trouble:
        assert "one after another" in rig.servos.trouble
        rig.cycle(CENTRE)
        seen.append(sum(rig.torque) // 3)
    assert sorted(set(seen)) == [1, 2, 3, 4, 5, 6]
    assert len(seen) * PERIOD_NS * 1e-9 == pytest.approx(6 * LEG_S, abs=0.1)
    assert seen == sorted(seen)


@pytest.mark.parametrize("board", BOARDS)
def test_torque_off_ends_all_pulses_at_once_also_during_power_up(board: Board) -> None:
    rig = Rig(board)
    rig.servos.setup()
    rig.servos.set_torque(True)
    rig.cycle(CENTRE, count=60)
    assert 3 < sum(rig.torque) < 18
    rig.servos.set_torque(False)
    rig.cycle(CENTRE, count=100)
    assert not any(rig.torque)
    assert rig.servos.trouble == ""


@pytest.mark.parametrize("board", BOARDS)
def test_torque_does_not_return_by_itself_after_a_restart_of_the_board(board: Board) -> None:
    rig = Rig(board, torque=True)
    rig.servos.setup()
    rig.cycle(CENTRE, count=5)
    assert all(rig.torque)
    rig.board.restart(rig.now_ns)
    rig.cycle(CENTRE, count=50)
    assert not any(rig.torque)
    assert "restart" in rig.servos.trouble
    rig.servos.set_torque(True)
    rig.cycle(CENTRE, count=200)
    assert all(rig.torque)


def test_only_servos_of_the_board_that_restarts_lose_their_torque() -> None:
    rig = Rig("pca9685", torque=True)
    rig.servos.setup()
    rig.cycle(CENTRE, count=5)
    rig.board._chips[0x41].power_on()  # type: ignore[union-attr]
    rig.servos._next = 16  # the next channel is that of the second board
    rig.cycle(CENTRE, count=30)
    assert "the pulses of 2 servos are lost" in rig.servos.trouble
    assert rig.servos.read(5, TABLE.torque_enable) == 1
    assert rig.servos.read(17, TABLE.torque_enable) == 0
    rig.servos.set_torque(True)
    rig.cycle(CENTRE, count=60)
    assert rig.servos.trouble == ""
    assert rig.servos.read(17, TABLE.torque_enable) == 1


@pytest.mark.parametrize("board", BOARDS)
def test_a_speed_limit_spreads_the_way_to_the_goal(board: Board) -> None:
    rig = Rig(board, torque=True)
    rig.servos.setup()
    rig.cycle(CENTRE, count=3)
    rig.cycle(CENTRE + 200, speed=1, count=51)  # 100 ticks in a second
    assert abs(rig.goals[0] - (CENTRE + 100)) <= 15


@pytest.mark.parametrize("board", BOARDS)
def test_a_silent_board_is_reported_and_nothing_is_raised(board: Board) -> None:
    rig = Rig(board, torque=True)
    rig.servos.setup()
    rig.cycle(CENTRE, count=3)
    rig.faults.inject(BusFault("bus", "silent", at_s=0.0, for_s=1.0), rig.now_ns)
    rig.cycle(CENTRE, count=10)
    assert "silent" in rig.servos.trouble
    assert rig.servos.newest_age_s > 0.1
    rig.cycle(CENTRE, count=60)
    assert rig.servos.trouble == ""
    assert all(rig.torque)


@pytest.mark.parametrize("board", BOARDS)
def test_a_lost_port_is_raised(board: Board) -> None:
    rig = Rig(board, torque=True)
    rig.servos.setup()
    rig.faults.inject(BusFault("bus", "gone", at_s=0.0, for_s=1.0), rig.now_ns)
    rig.now_ns += PERIOD_NS
    with pytest.raises(BusDisconnectedError):
        rig.servos.poll(9_000_000)
    with pytest.raises(BusDisconnectedError):
        rig.servos.sync_write_goals(np.full(18, CENTRE))


def test_setup_says_which_board_does_not_answer() -> None:
    rig = Rig("pca9685")
    rig.board._chips.pop(0x41)  # type: ignore[union-attr]
    with pytest.raises(BusSetupError, match="no PCA9685 answers at address 0x41"):
        rig.servos.setup()
    assert math.isfinite(rig.servos.newest_age_s) is False


@pytest.mark.parametrize("board", BOARDS)
@pytest.mark.parametrize("torque", [True, False])
@pytest.mark.parametrize("spoilt", range(8))
def test_one_broken_answer_is_not_believed_at_opening(board: Board, torque: bool, spoilt: int) -> None:
    """Answers have no checksum: pulses that were not ordered count once two answers agree."""
    rig, count = Rig(board, torque), 0
    read = rig.port.read

    def broken(size: int = 1) -> bytes:
        nonlocal count
        count += 1
        data = read(size)
        return data[:-1] + bytes((data[-1] ^ 0x10,)) if count == spoilt + 1 else data

    rig.port.read = broken  # type: ignore[method-assign]
    try:
        rig.servos.setup()
    except BusSetupError:
        assert spoilt < 4, "the board itself is not recognised, or its rate"
        return
    rig.port.read = read  # type: ignore[method-assign]
    for channel in range(3):
        assert rig.servos.read(channel, TABLE.torque_enable) == torque
        assert abs(rig.servos.read(channel, TABLE.goal_position) - (CENTRE + 100 if torque else CENTRE)) <= 10
    rig.cycle(count=3)
    assert rig.torque == [int(torque)] * 18
