"""The same driver with servos of every family, against their byte-level emulators."""

from dataclasses import replace
from itertools import permutations
from random import Random

import numpy as np
import pytest

from sextant.services.actuator.servo_bus import shutdown
from sextant.services.actuator.servo_bus.bus_driver import BusSetupError
from sextant.services.actuator.servo_bus.bus_scan import prepare, scan_servo
from sextant.services.actuator.servo_bus.servo_health import error_of
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.shared.servo.dynamixel2 import Instruction
from sextant.shared.servo.models import MODELS
from sextant.shared.servo.servo_model import Recovery, ServoError, ServoModel
from tests.support.families import FAMILIES, MIXED, Bench

ALL = [model.name for model in MODELS if model.commands is None]  # others: test_command_bus.py
_BUDGET_NS = 40_000_000


@pytest.mark.parametrize("name", ALL)
def test_set_up_servos_report_the_state_of_their_joints(name: str) -> None:
    bench = Bench(name)
    bench.bus.setup()
    angles = np.array([-0.7, 0.02, 1.1])
    bench.pass_time(0.02, angles)
    readings = bench.bus.poll(_BUDGET_NS)
    assert [one.servo_id for one in readings] == [1, 2, 3]
    np.testing.assert_allclose([one.position for one in readings], angles, atol=bench.model.units.tick_rad)
    assert {one.error for one in readings} == {ServoError.NONE}
    assert all(abs(one.voltage - bench.servos.voltage) < 0.06 and one.temperature == 25.0 for one in readings)


@pytest.mark.parametrize("name", ALL)
def test_load_and_speed_keep_size_and_sign(name: str) -> None:
    bench = Bench(name, 2)
    zero, speeds, shares = np.zeros(2), np.array([-1.5, 2.5]), np.array([0.3, -0.45])
    bench.servos.set_joint_state(zero, speeds, shares * bench.servos.motor.stall_torque)
    bench.servos.advance(0.002)
    readings = bench.bus.poll(_BUDGET_NS)
    units = bench.model.units
    np.testing.assert_allclose([one.speed for one in readings], speeds, atol=units.speed_rad_s)
    np.testing.assert_allclose([one.load for one in readings], shares, atol=units.load)


@pytest.mark.parametrize("name", ALL)
def test_goals_and_speed_limits_reach_the_servos(name: str) -> None:
    bench = Bench(name)
    table, units = bench.model.table, bench.model.units
    angles = [-0.5, 0.0, 0.9]
    bench.bus.set_torque(True)  # which makes the present position the goal
    bench.bus.sync_write_goals([units.ticks(angle) for angle in angles], [0, 40, 0])
    bench.pass_time(0.01)
    assert bench.servos.column(table.goal_position).tolist() == [units.ticks(angle) for angle in angles]
    assert bench.servos.column(table.goal_speed).tolist() == [0, 40, 0]
    assert (bench.command.torque_limit > 0.0).all(), "torque is on"
    bench.bus.set_torque(False)
    bench.pass_time(0.01)
    assert not bench.command.torque_limit.any(), "a broadcast turns it off"


@pytest.mark.parametrize("name", [*FAMILIES, *MIXED])
def test_no_wrong_position_is_believed_among_broken_bytes(name: str) -> None:
    """Spoil one bit of every fourth read."""
    rng, n = Random(7), 600

    def spoil(data: bytes) -> bytes:
        if not data or rng.random() > 0.25:
            return data
        at = rng.randrange(len(data))
        return data[:at] + bytes((data[at] ^ 1 << rng.randrange(8),)) + data[at + 1 :]

    bench, asked, wrong, believed = Bench(name, 3, spoil), 0, [], 0
    q = np.array([0.2, -0.3, 0.4])
    goals = bench.ticks(q)
    while asked < n:
        bench.bus.sync_write_goals(goals)
        bench.pass_time(0.02, q)
        readings = bench.bus.poll(_BUDGET_NS)
        asked += 3
        believed += len(readings)
        wrong += [one for one in readings if abs(one.position - q[one.index]) > bench.tick_rad]
    assert believed > n / 2
    assert not wrong


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("error", [ServoError.OVERHEATING, ServoError.OVERLOAD])
def test_shutdown_is_reported_and_ends_only_on_order(name: str, error: ServoError) -> None:
    bench = Bench(name, 2)
    model, table, units = bench.model, bench.model.table, bench.model.units
    bench.bus.sync_write_goals([units.centre] * 2)
    bench.bus.set_torque(True)
    if error is ServoError.OVERHEATING:
        bench.servos.temperature[0] = 120.0
    stalled = np.array([bench.servos.motor.stall_torque, 0.0])
    for _ in range(120):
        bench.pass_time(0.02, torque=stalled if error is ServoError.OVERLOAD else None)
    assert bench.command.torque_limit[0] == 0.0 < bench.command.torque_limit[1]
    bench.bus.poll(_BUDGET_NS)
    bench.bus.poll(_BUDGET_NS)  # a change of error bits is believed at the second reading
    assert bench.bus.errors.tolist() == [error, 0]
    bench.servos.temperature[0] = 25.0
    bench.pass_time(1.0)
    assert bench.command.torque_limit[0] == 0.0, "it does not come back by itself"

    ended = shutdown.end(bench.bus, 1, units.centre, table.torque_limit.max, lambda: True)
    assert ended == (model.recovery is not Recovery.REBOOT)
    bench.pass_time(0.02)
    assert (bench.command.torque_limit[0] > 0.0) == ended


@pytest.mark.parametrize("name", ["AX-12A", "STS3215"])
@pytest.mark.parametrize("lost", range(4))
def test_one_lost_acknowledgement_does_not_leave_a_servo_without_torque(name: str, lost: int) -> None:
    answers = -1

    def lose(data: bytes) -> bytes:
        nonlocal answers
        answers += bool(data)
        return b"" if answers == lost else data

    bench = Bench(name, 2, lose)
    model = bench.model
    bench.servos.temperature[0] = 120.0
    bench.pass_time(0.02)
    bench.servos.temperature[0] = 25.0
    assert shutdown.end(bench.bus, 1, model.units.centre, model.table.torque_limit.max, lambda: True)
    bench.bus.set_torque(True)
    bench.pass_time(0.02)
    assert bench.command.torque_limit[0] > 0.0


@pytest.mark.parametrize("name", ["XL430-W250", "STS3215"])
def test_old_answer_among_those_of_several_servos_is_not_believed(name: str) -> None:
    """Replace an answer by an old one of another servo, which comes before or after it."""
    bench, q = Bench(name, 3), np.array([0.2, -0.3, 0.4])
    receive, old = bench.emulator.receive, dict[int, Reply]()
    spoilt, other = 0, 0

    def swap(data: bytes, now_ns: int) -> list[Reply]:
        replies = receive(data, now_ns)
        if len(replies) < 3:
            return replies
        sent = [one._replace(data=old[other].data) if old and one.servo_id == spoilt else one for one in replies]
        old.update({one.servo_id: one for one in replies})
        return sent

    bench.emulator.receive = swap  # type: ignore[method-assign]
    for spoilt, other in [(0, 0), *permutations((1, 2, 3), 2)]:
        q = q + 0.03
        bench.bus.sync_write_goals([bench.model.units.ticks(angle) for angle in q])
        bench.pass_time(0.02, q)
        readings = bench.bus.poll(_BUDGET_NS)
        assert all(abs(one.position - q[one.index]) <= bench.model.units.tick_rad for one in readings), (spoilt, other)
        assert len(readings) == 3, "it is read again"


def test_rebooted_servo_is_silent_then_answers_without_torque() -> None:
    bench = Bench("XL430-W250", 2)
    bench.bus.set_torque(True)
    bench.servos.temperature[0] = 120.0
    bench.pass_time(0.02)
    assert not shutdown.end(bench.bus, 1, 2048, 885, lambda: True)
    bench.servos.temperature[0] = 25.0
    bench.pass_time(0.02)
    assert bench.bus.ping(1) is None
    bench.pass_time(0.5)
    assert bench.bus.ping(1) is ServoError.NONE
    assert bench.bus.read(1, bench.model.table.torque_enable) == 0
    assert bench.bus.read(2, bench.model.table.torque_enable) == 1


def test_eeprom_of_x_series_is_written_only_without_torque() -> None:
    bench = Bench("XM430-W350", 1)
    table = bench.model.table
    bench.bus.set_torque(True)
    assert not bench.bus.write(1, table.return_delay, 10)
    found = scan_servo(bench.bus, 1)
    assert found is not None
    assert "sextant servos off" in prepare(bench.bus, found, lock=True)
    bench.bus.set_torque(False)
    assert bench.bus.write(1, table.return_delay, 10)


@pytest.mark.parametrize("name", ALL)
def test_model_number_and_name_are_scanned(name: str) -> None:
    bench = Bench(name, 1)
    found = scan_servo(bench.bus, 1)
    assert found is not None
    assert (found.number, found.model) == (bench.model.number, name)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_registers_of_a_table_do_not_overlap(model: ServoModel) -> None:
    table = model.table
    used: set[int] = set()
    for register in table.registers:
        addresses = set(range(register.address, register.address + register.size))
        assert not used & addresses, register.name
        assert max(addresses) < table.size
        assert register.min <= model.default(register) <= register.max, register.name
        used |= addresses
    roles = [value for value in vars(table).values() if isinstance(value, type(table.id))]
    assert set(roles) - model.lacks <= set(table.registers)
    assert len({register.name for register in table.registers}) == len(table.registers)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_settings_and_overrides_name_registers(model: ServoModel) -> None:
    names = {register.name for register in model.table.registers}
    assert set(model.settings) | set(model.overrides) <= names
    assert all(register.min <= value <= register.max for register, value in model.joint_settings.items())
    assert model.rates[model.rate_code(model.bus_rate)] == model.bus_rate


SYNC = [model.name for model in MODELS if model.sync_read is not None]


@pytest.mark.parametrize("name", SYNC)
def test_one_request_reads_all_servos_in_the_time_of_a_cycle(name: str) -> None:
    bench = Bench(name, 18)
    bench.bus.setup()
    bench.pass_time(0.02)
    before, start = bench.emulator.counts.instructions.total(), bench.port.now_ns()
    readings = bench.bus.poll(9_000_000)
    assert [one.servo_id for one in readings] == list(range(1, 19))
    assert bench.emulator.counts.instructions.total() == before + 1
    assert bench.port.now_ns() - start <= 9_000_000


@pytest.mark.parametrize("name", SYNC)
def test_silent_servo_is_asked_again_alone_and_then_seldom(name: str) -> None:
    bench = Bench(name, 6)
    bench.bus.setup()
    bench.pass_time(0.02)
    assert len(bench.bus.poll(9_000_000)) == 6
    bench.emulator.cut_off(frozenset((2,)))
    turns = []
    for turn in range(30):
        bench.pass_time(0.02)
        before = bench.emulator.counts.unanswered
        lost = (4, 5, 6) if turn == 0 and bench.model.fast_firmware else ()  # a fast answer ends with the silent servo
        assert {one.servo_id for one in bench.bus.poll(9_000_000)} == {1, 2, 4, 5, 6}.difference(lost)
        turns.append(bench.emulator.counts.unanswered - before)
    assert bench.bus.missed.tolist() == [0, 0, bench.bus.missed[2], 0, 0, 0]
    assert sum(turns[:3]) == 3
    assert sum(turns[10:]) <= 4
    bench.emulator.cut_off(frozenset())
    for _ in range(9):
        bench.pass_time(0.02)
        readings = bench.bus.poll(9_000_000)
    assert len(readings) == 6
    assert not bench.bus.missed.any()


def test_later_errors_of_an_alert_are_found_and_other_reads_keep_them() -> None:
    bench = Bench("XM430-W350", 2)
    bench.bus.set_torque(True)
    bench.servos.charge = 0.0
    bench.servos.supply = replace(bench.servos.supply, empty_voltage=9.0)  # below the servo's minimum: an alert, no shutdown
    for _ in range(20):
        bench.pass_time(0.02)
        bench.bus.poll(_BUDGET_NS)
    assert bench.bus.errors.tolist() == [ServoError.INPUT_VOLTAGE] * 2
    bench.servos.temperature[0] = 120.0
    for _ in range(20):
        bench.pass_time(0.02)
        bench.bus.poll(_BUDGET_NS)
    assert bench.bus.errors.tolist() == [ServoError.INPUT_VOLTAGE | ServoError.OVERHEATING, ServoError.INPUT_VOLTAGE]
    assert bench.bus.read(1, bench.model.table.torque_enable) == 0
    assert bench.bus.errors[0] & ServoError.OVERHEATING


def test_alerts_of_all_servos_do_not_overrun_the_cycle() -> None:
    bench = Bench("XL430-W250", 18)
    bench.bus.setup()
    bench.bus.poll(9_000_000)
    bench.servos.charge = 0.0
    bench.servos.supply = replace(bench.servos.supply, empty_voltage=5.0)
    for _ in range(40):
        bench.pass_time(0.02)
        start = bench.port.now_ns()
        assert len(bench.bus.poll(9_000_000)) == 18 or not bench.bus.errors.all()
        assert bench.port.now_ns() - start < 11_000_000
    assert (bench.bus.errors == int(ServoError.INPUT_VOLTAGE)).all()


def test_scan_reports_the_hardware_error_of_an_x430() -> None:
    bench = Bench("XL430-W250", 1)
    bench.bus.set_torque(True)
    bench.servos.temperature[0] = 120.0
    bench.pass_time(0.02)
    bench.servos.temperature[0] = 25.0
    bench.pass_time(0.02)
    found = scan_servo(bench.bus, 1)
    assert found is not None
    assert error_of(found) == "overheating"


def test_position_beyond_the_range_counts_as_silence() -> None:
    bench = Bench("XL430-W250", 3)
    bench.bus.setup()
    bench.bus.poll(9_000_000)
    measured = bench.servos._write_measured

    def beyond(after_ns: int) -> None:
        measured(after_ns)
        bench.servos.column(bench.model.table.present_position)[1] = 2**32 - 10  # -10

    bench.servos._write_measured = beyond  # type: ignore[method-assign]
    for _ in range(10):
        bench.pass_time(0.02)
        bench.bus.poll(9_000_000)
    assert bench.bus.missed[1] >= 4
    assert bench.bus.missed[[0, 2]].tolist() == [0, 0]
    assert bench.model.position(2**32 - 10) == -10


@pytest.mark.parametrize("name", SYNC)
def test_servos_behind_a_silent_one_are_read_singly_if_they_do_not_answer(name: str) -> None:
    bench = Bench(name, 6)
    bench.emulator.breaks_off = True
    bench.bus.setup()
    bench.pass_time(0.02)
    assert len(bench.bus.poll(9_000_000)) == 6
    bench.emulator.cut_off(frozenset((0,)))
    heard = set()
    for _ in range(30):
        bench.pass_time(0.02)
        heard |= {one.servo_id for one in bench.bus.poll(9_000_000)}
    assert heard == {2, 3, 4, 5, 6}
    assert not bench.bus.missed[1:].any()


def instructions(bench: Bench, turns: int) -> list[int]:
    """Return which instruction read the servos in each turn, -1 for several."""
    found = []
    for _ in range(turns):
        bench.pass_time(0.02)
        before = bench.emulator.counts.instructions.copy()
        bench.bus.poll(9_000_000)
        sent = bench.emulator.counts.instructions - before
        found.append(next(iter(sent)) if sent.total() == 1 else -1)
    return found


def servos_in_a_cycle(name: str, firmware: int) -> tuple[int, float]:
    """Return how many servos of 40 are read in 9 ms, and the time [ms] for the first 18."""
    bench = Bench(name, 40)
    bench.servos.column(bench.model.table.firmware)[:] = firmware
    bench.bus.setup()
    bench.pass_time(0.02)
    count, eighteen = len(bench.bus.poll(9_000_000)), Bench(name, 18)
    eighteen.servos.column(bench.model.table.firmware)[:] = firmware
    eighteen.bus.setup()
    start = eighteen.port.now_ns()
    assert len(eighteen.bus.poll(9_000_000)) == 18
    return count, (eighteen.port.now_ns() - start) * 1e-6


def test_fast_read_reads_more_servos_in_less_time() -> None:
    (plain, slow_ms), (fast, fast_ms) = (servos_in_a_cycle("XL430-W250", firmware) for firmware in (44, 45))
    assert (plain, fast) == (25, 31)
    assert fast_ms < slow_ms - 1.0


@pytest.mark.parametrize("name", ["XL430-W250", "XM430-W350"])
def test_x430_is_read_fast_unless_its_firmware_is_old(name: str) -> None:
    for firmware, instruction in ((47, Instruction.FAST_SYNC_READ), (44, Instruction.SYNC_READ)):
        bench = Bench(name, 6)
        bench.servos.column(bench.model.table.firmware)[3] = firmware
        bench.bus.setup()
        assert set(instructions(bench, 5)) == {instruction}


def test_servos_that_do_not_answer_a_fast_read_are_read_plainly() -> None:
    """A reopened bus has no setup, so it does not know the firmware."""
    bench = Bench("XL430-W250", 6)
    bench.servos.column(bench.model.table.firmware)[:] = 44
    turns = instructions(bench, 250)
    assert 3 <= turns.count(-1) <= 6, "a fast read, then servos alone, three times in all"
    assert bench.emulator.counts.instructions[Instruction.FAST_SYNC_READ] == 3
    assert set(turns[150:]) == {Instruction.SYNC_READ}
    assert not bench.bus.missed.any()


def test_silent_servo_is_not_among_those_read_fast() -> None:
    bench = Bench("XL430-W250", 6)
    bench.bus.setup()
    assert instructions(bench, 1) == [Instruction.FAST_SYNC_READ]
    bench.emulator.cut_off(frozenset((2,)))
    assert Instruction.FAST_SYNC_READ not in instructions(bench, 100)[1:]
    bench.emulator.cut_off(frozenset())
    assert instructions(bench, 100)[-1] == Instruction.FAST_SYNC_READ
    assert not bench.bus.missed.any()


def test_spoilt_part_of_a_fast_answer_is_not_believed() -> None:
    rng, spoilt = Random(5), 0

    def spoil(data: bytes) -> bytes:
        nonlocal spoilt
        if len(data) < 60 or rng.random() > 0.5:
            return data
        at, spoilt = rng.randrange(len(data)), spoilt + 1
        return data[:at] + rng.randbytes(1) + data[at + 1 :]

    bench = Bench("XL430-W250", 6, spoil)
    bench.bus.setup()
    q, fast, read = np.linspace(-0.4, 0.4, 6), 0, 0
    for _ in range(2000):
        bench.bus.sync_write_goals([bench.model.units.ticks(angle) for angle in q])
        bench.pass_time(0.02, q)
        before = bench.emulator.counts.instructions[Instruction.FAST_SYNC_READ]
        readings = bench.bus.poll(9_000_000)
        fast += bench.emulator.counts.instructions[Instruction.FAST_SYNC_READ] - before
        assert all(abs(one.position - q[one.index]) <= bench.model.units.tick_rad for one in readings)
        read += len(readings)
    assert read > 0.95 * 6 * 2000, "what is lost is read again"
    assert fast > 3
    assert spoilt > 100


def test_small_read_budget_reads_one_servo() -> None:
    bench = Bench("STS3215", 18)
    assert len(bench.bus.poll(500_000)) == 1
    assert bench.bus.poll(0) == []


@pytest.mark.parametrize(
    ("name", "register", "value", "words"),
    [
        ("STS3215", "phase", 8, "phase of 8"),
        ("STS3215", "phase", 0x8C, "phase of 140"),
        ("MX-28", "resolution divider", 2, "resolution divider of 2"),
        ("MX-28", "cw angle limit", 4095, "wheel mode"),
    ],
)
def test_servo_whose_positions_mean_something_else_is_refused(name: str, register: str, value: int, words: str) -> None:
    bench = Bench(name, 2)
    bench.bus.setup()
    (found,) = (one for one in bench.model.table.registers if one.name == register)
    bench.servos.column(found)[1] = value
    with pytest.raises(BusSetupError, match=words):
        bench.bus.setup()


@pytest.mark.parametrize("name", ["XL430-W250", "STS3215"])
def test_settings_of_a_joint_are_made_at_setup(name: str) -> None:
    bench = Bench(name, 1)
    for register in bench.model.joint_settings:
        bench.servos.column(register)[:] = register.max
    bench.servos.column(bench.model.table.status_return_level)[:] = bench.model.table.status_return_level.max
    bench.bus.setup()
    bench.pass_time(0.02)
    for register, value in bench.model.joint_settings.items():
        assert bench.servos.column(register)[0] == value, register.name


def test_servo_gets_no_torque_if_off_is_ordered_during_its_reset() -> None:
    bench = Bench("STS3215", 1)
    table = bench.model.table
    bench.bus.set_torque(True)
    bench.servos.temperature[0] = 120.0
    bench.pass_time(0.02)
    bench.servos.temperature[0] = 25.0
    bench.pass_time(0.02)
    assert not shutdown.end(bench.bus, 1, 2048, table.torque_limit.max, lambda: False)
    bench.pass_time(0.02)
    assert bench.bus.read(1, table.torque_enable) == 0
    assert bench.command.torque_limit[0] == 0.0
