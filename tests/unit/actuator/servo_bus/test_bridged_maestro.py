"""Hobby servos at a Maestro behind a microcontroller: its errors, restarts, and answers that are lost, late or wrong."""

from dataclasses import replace

import numpy as np
import pytest

from sextant.services.simulator.servo_bus.bridge_board import Board
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.services.simulator.servo_bus.pulse_board import MaestroEmulator
from sextant.shared.servo import maestro
from sextant.shared.servo.bridge_protocol import Mode, Refusal
from sextant.shared.servo.firmware.pulse_senders import MAESTRO_RATES
from sextant.shared.servo.pwm import TABLE
from tests.support.pulse_bridge_rig import CENTRE, PULSES, Rig


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


def byte_by_byte(reply: Reply) -> list[Reply]:
    """Return an answer as a UART receives it."""
    ends = [reply.due_ns - left * 86_805 for left in range(len(reply.data))]
    return [reply._replace(due_ns=end, data=bytes((byte,))) for end, byte in zip(reversed(ends), reply.data, strict=True)]
