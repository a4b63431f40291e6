"""Set the ids of new servos, on emulated servos at packet level.

The tests cover the scan, naming and set-up of servos, and the refusals.
"""

import re
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from sextant.services.actuator.commissioning import bus_survey, set_ids
from sextant.services.actuator.commissioning.bus_survey import Line
from sextant.services.actuator.commissioning.set_ids import OtherServosError
from sextant.services.actuator.servo_bus.bus_driver import BAUD_RATE, ServoBus
from sextant.services.actuator.servo_bus.command_bus import bus_of
from sextant.services.actuator.servo_bus.triage import Opener, all_rates, other_family, usual_rates
from sextant.services.simulator.servo_bus.host_link import Reply
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.servo_model import Register, ServoError, ServoModel
from tests.support.builder import Answer, Builder
from tests.support.desk import PHANTOMX, Desk
from tests.support.families import robot_with

RX = load_profile("lotriet_rx64")
SET = (dxl.RETURN_DELAY, 0), (dxl.STATUS_RETURN_LEVEL, 2), (dxl.BAUD_RATE, 1)


def line(desk: Desk, rates_of: Callable[[ServoModel], tuple[int, ...]] = usual_rates) -> Line:
    def at(rate: int) -> ServoBus:
        names = desk.profile.servo_names
        return ServoBus(desk.open(rate), list(names), desk.clock, names=names, model=desk.profile.servo_model)

    return Line(at, rates_of(desk.profile.servo_model))


def plug(desk: Desk, count: int = 1, answer: str = "") -> Callable[[], str]:
    """Return an action that plugs in the next `count` servos, then presses Enter."""

    def act() -> str:
        desk.bench.plug(desk.bench.unplugged[:count])
        return answer

    return act


def ids(desk: Desk) -> list[int]:
    return desk.tables[:, dxl.ID.address].tolist()


def assert_set_up(desk: Desk) -> None:
    desk.settle()
    assert sorted(ids(desk)) == sorted(desk.profile.servo_names)
    for register, value in SET:
        assert (desk.tables[:, register.address] == value).all(), register.name
    assert not desk.tables[:, dxl.TORQUE_ENABLE.address].any()


# ---------------------------------------------------------------------------------------------------------------- scan


def test_scan_of_healthy_robot_lists_servos_without_problems() -> None:
    desk = Desk()
    found = bus_survey.scan(line(desk))
    assert [one.seen.servo_id for one in found] == sorted(PHANTOMX.servo_names)
    assert {one.rate for one in found} == {BAUD_RATE}
    assert desk.rates == list(usual_rates(desk.profile.servo_model))
    assert bus_survey.verdict(found, PHANTOMX) == []
    table = bus_survey.in_words(found, PHANTOMX).splitlines()
    assert len(table) == 19
    assert table[9].split() == ["9", "1000000", "AX-12A", "24", "12.5", "V", "25", "deg", "C", "left", "rear", "femur"]


def test_scan_writes_no_register() -> None:
    desk = Desk(fresh=True)
    desk.bench.plug(range(3))
    before = desk.tables[:, :36].copy()
    bus_survey.scan(line(desk))
    assert (desk.tables[:, :36] == before).all()
    assert not desk.bench.counts.instructions[dxl.Instruction.WRITE]


def test_scan_problems_name_leg_and_joint_with_advice() -> None:
    desk = Desk()
    desk.bench.unplug([desk.row(12)])
    desk.tables[desk.row(16), dxl.MODEL_NUMBER.address] = 64
    desk.change(7, dxl.ID, 200)
    wrong = {problem.words: problem.advice for problem in bus_survey.verdict(bus_survey.scan(line(desk)), PHANTOMX)}
    assert all(wrong.values())
    assert set(wrong) == {
        "servo 12 (right rear tibia) does not answer",
        "servo 16 (right middle femur) is model 64 (RX-64), expected 12 (AX-12A)",
        "servo 7 (left rear coxa) does not answer, but the servo behind it does",
        "servo 200 is not one of the robot's servos",
    }


def test_voltage_heat_and_latched_overload_are_named() -> None:
    desk = Desk()
    desk.bench._servos.charge = 0.1
    desk.bench._servos.temperature[desk.row(6)] = 64.0
    desk.bench._servos._latched_errors[desk.row(17)] = ServoError.OVERLOAD
    words = [problem.words for problem in bus_survey.verdict(bus_survey.scan(line(desk)), PHANTOMX)]
    assert len(words) == 3
    assert "each of the 18 servos has 10.1 V, at least 10.5 V expected: charge the battery" in words
    assert any(one.startswith("servo 6 (right front tibia)") and "64 deg C hot, its limit is 70" in one for one in words)
    assert any(one.startswith("servo 17 (left middle tibia) reports overload") for one in words)


def test_reset_rx_64_is_found_at_factory_baud_rate() -> None:
    desk = Desk(RX)
    lost = RX.legs[3].servo_ids[1]
    desk.reset(lost)
    words = [problem.words for problem in bus_survey.verdict(bus_survey.scan(line(desk)), RX)]
    assert f"servo {lost} (right rear femur) does not answer, but the servo behind it does" in words
    reset = f"servo 1 answers at 57143 baud, 1000000 expected; a reset sets id 1: this may be servo {lost} (right rear femur)"
    assert reset in words


@pytest.mark.parametrize(("code", "rate", "command"), [(34, 57_143, "set-id"), (9, 200_000, "set-id --all-rates")])
def test_servos_at_another_rate_are_one_problem(code: int, rate: int, command: str) -> None:
    desk, at = Desk(), f"at {rate} baud, 1000000 expected"
    for row in range(18):
        desk.bench._servos.write(row, dxl.BAUD_RATE.address, bytes([code]))
    for each in (True, False):
        found = bus_survey.scan(line(desk, all_rates), PHANTOMX.servo_names)
        (problem,) = bus_survey.verdict(found, PHANTOMX, each=each)
        assert problem == (f"each of the 18 servos answers {at}", f"`sextant servos {command}` sets the rate")

    for servo_id in PHANTOMX.servo_names.keys() - {4, 6}:
        desk.change(servo_id, dxl.BAUD_RATE, 1)
    found = bus_survey.scan(line(desk, all_rates), PHANTOMX.servo_names)
    assert [one.words for one in bus_survey.verdict(found, PHANTOMX)] == [f"servo {i} answers {at}" for i in (4, 6)]


# -------------------------------------------------------------------------------------------------------------- set-id


@pytest.mark.parametrize("profile", [PHANTOMX, RX], ids=lambda profile: profile.name)
def test_ids_of_18_new_servos_are_set(profile: RobotProfile) -> None:
    desk = Desk(profile, fresh=True)
    builder = Builder([plug(desk)] * 18)
    assert set_ids.set_ids(line(desk), desk.profile, builder)
    assert_set_up(desk)
    factory = [name for i, name in desk.profile.servo_names.items() if i == 1]
    assert all(name in builder.asked[-1] for name in factory)  # they come last: new servos have this id
    assert [i for i in ids(desk) if i != 1] == [i for i in desk.profile.servo_names if i != 1]


def test_ids_can_be_set_with_one_servo_at_a_time_on_the_bus() -> None:
    desk = Desk(fresh=True)

    def swap() -> str:
        desk.bench.unplug(list(desk.bench._plugged))
        fresh = [row for row in range(18) if desk.tables[row, dxl.RETURN_DELAY.address] == 250]
        desk.bench.plug(fresh[:1])
        return ""

    assert set_ids.set_ids(line(desk), PHANTOMX, Builder([swap] * 18))
    assert_set_up(desk)


@pytest.mark.slow
@pytest.mark.parametrize("done", [0, 1, 7, 17])
def test_interrupted_id_setup_resumes_with_missing_servos(done: int) -> None:
    desk = Desk(fresh=True)
    left = Builder([*[plug(desk)] * done, "q"])
    assert not set_ids.set_ids(line(desk), PHANTOMX, left)
    assert "for the remaining servos" in left.told[-1]
    again = Builder([plug(desk)] * (18 - done))
    assert set_ids.set_ids(line(desk), PHANTOMX, again)
    assert f"{done} of 18 servos have their ids" in again.told
    assert_set_up(desk)


@pytest.mark.slow
@pytest.mark.parametrize("after", range(1, 12))
@pytest.mark.parametrize("profile", [PHANTOMX, RX], ids=lambda profile: profile.name)
def test_interrupt_at_any_write_is_recovered_by_second_run(profile: RobotProfile, after: int) -> None:
    """Interrupt the n-th write of a servo register; a second run sets all servos up."""
    desk = Desk(profile, fresh=True)
    writes = 0
    receive = desk.bench.receive

    def interrupted(data: bytes, now_ns: int) -> list[object]:
        nonlocal writes
        writes += data[4:5] == bytes([dxl.Instruction.WRITE])
        if writes == after:
            writes += 1
            raise KeyboardInterrupt
        return receive(data, now_ns)  # type: ignore[return-value]

    desk.bench.receive = interrupted  # type: ignore[method-assign,assignment]
    with pytest.raises(KeyboardInterrupt):
        set_ids.set_ids(line(desk), desk.profile, Builder([plug(desk)] * 18))
    answers: list[Answer] = ["", *[plug(desk)] * 18]
    set_ids.set_ids(line(desk), desk.profile, builder := Agreeing(answers))
    assert "all 18 servos have their ids" in builder.told[-1]
    assert_set_up(desk)


class Agreeing(Builder):
    """A builder that agrees to every question."""

    def agree(self, question: str) -> bool:
        self.asked.append(question)
        return True


def test_two_new_servos_at_once_are_refused_unchanged() -> None:
    desk = Desk(fresh=True)

    def one_out() -> str:
        desk.bench.unplug([1])
        return ""

    builder = Builder([plug(desk, 2), one_out, "q"])
    assert not set_ids.set_ids(line(desk), PHANTOMX, builder)
    assert "two or more servos have id 1: none of them can be set" in builder.all_told
    assert sorted(ids(desk)) == [*[1] * 17, 3]
    assert desk.tables[1, dxl.RETURN_DELAY.address] == 250


def test_first_servo_of_another_model_means_another_robot() -> None:
    desk = Desk(fresh=True)
    desk.tables[0, dxl.MODEL_NUMBER.address] = 64
    words = "servo 1 is RX-64, AX-12A expected for the left front femur: it is unchanged\n  -> give --robot your_robot.toml"
    with pytest.raises(OtherServosError, match=re.escape(words)):
        set_ids.set_ids(line(desk), PHANTOMX, builder := Builder([plug(desk)]))
    assert builder.asked[0].startswith("Plug in the AX-12A of the left front femur of phantomx_mk2 (future id 3), ")
    assert ids(desk) == [1] * 18


def test_later_servo_of_another_model_is_refused() -> None:
    desk = Desk(fresh=True)
    desk.tables[1, dxl.MODEL_NUMBER.address] = 64
    builder = Builder([plug(desk), plug(desk), "q"])
    assert not set_ids.set_ids(line(desk), PHANTOMX, builder)
    assert "it is unchanged; plug in another one" in builder.all_told
    assert ids(desk) == [3] + [1] * 17


@pytest.mark.parametrize("there", ["XL430-W250", "STS3215", "LX-16A"])
def test_first_servo_of_another_family_means_another_robot(there: str) -> None:
    desk = Desk(robot_with(there), fresh=True)
    model = PHANTOMX.servo_model

    def at(rate: int, asked: ServoModel = model) -> ServoBus:
        return bus_of(asked)(desk.open(rate), list(PHANTOMX.servo_names), desk.clock, names=PHANTOMX.servo_names, model=asked)

    foreign = partial(other_family, Opener(at, "/dev/ttyUSB0", has_rates=True), model, PHANTOMX.servo_names)
    with pytest.raises(OtherServosError, match=rf"servo 1 is {there}.*, AX-12A expected.*\n  -> give --robot your_robot.toml"):
        set_ids.set_ids(Line(at, usual_rates(model)), PHANTOMX, builder := Builder([plug(desk)]), foreign)
    assert "searching" not in builder.all_told


def test_used_servo_with_any_id_can_be_assigned_to_named_joint() -> None:
    desk = Desk(fresh=True)
    desk.tables[0, [dxl.ID.address, dxl.STATUS_RETURN_LEVEL.address]] = 77, 0
    desk.tables[0, dxl.CCW_ANGLE_LIMIT.address : dxl.CCW_ANGLE_LIMIT.address + 2] = 0  # it was in wheel mode
    builder = Builder([plug(desk, answer="left  Rear femur"), "left knee", "q"])
    set_ids.set_ids(line(desk), PHANTOMX, builder)
    assert desk.tables[0, dxl.ID.address] == 9
    assert desk.tables.view("<u2")[0, dxl.CCW_ANGLE_LIMIT.address // 2] == 1023
    assert "searching all ids" in builder.all_told
    assert "found 'left knee'; one of left front coxa" in builder.all_told


def test_no_new_servo_and_several_are_reported_differently() -> None:
    desk = Desk(fresh=True)
    desk.tables[:2, dxl.ID.address] = 50, 60
    set_ids.set_ids(line(desk), PHANTOMX, builder := Builder(["", plug(desk, 2), "q"]))
    assert "no new servo answers" in builder.all_told
    assert "one new servo expected, found 2 (ids 50, 60)" in builder.all_told
    assert set(ids(desk)) == {1, 50, 60}


def test_locked_servo_is_reported() -> None:
    desk = Desk(fresh=True)

    def plug_locked() -> str:
        desk.bench.plug([0])
        desk.tables[0, dxl.LOCK.address] = 1
        return ""

    set_ids.set_ids(line(desk), PHANTOMX, builder := Builder([plug_locked, "q"]))
    assert "switch its power off and on, then try again" in builder.all_told
    assert np.all(desk.tables[:, dxl.ID.address] == 1)


@pytest.mark.parametrize("agreed", [False, True])
def test_configured_servo_is_reassigned_only_after_confirmation(agreed: bool) -> None:
    """Check that a configured servo alone on the bus is reassigned only after a yes.

    The builder names the next joint, but forgets to plug in its servo.
    """
    desk = Desk(fresh=True)
    femur, tibia = (i for i, name in PHANTOMX.servo_names.items() if name in ("left front femur", "left front tibia"))
    builder = Builder([plug(desk, answer="left front femur"), "left front tibia", agreed, "q"])
    assert not set_ids.set_ids(line(desk), desk.profile, builder)
    desk.settle()
    assert (tibia in ids(desk), femur in ids(desk)) == (agreed, not agreed)
    assert "is the only servo that answers, and is already set. Make it the left front tibia?" in builder.asked[2]
    assert "2 of 18" not in builder.all_told


def joint(name: str) -> int:
    return {known: i for i, known in PHANTOMX.servo_names.items()}[name]


def plug_used(desk: Desk, row: int, servo_id: int, **registers: int) -> Callable[[], str]:
    """Return an action that plugs in a servo set up elsewhere, then presses Enter."""

    def act() -> str:
        table = {dxl.ID: servo_id, dxl.RETURN_DELAY: 0}
        for register, value in (table | {getattr(dxl, name): value for name, value in registers.items()}).items():
            desk.bench._servos.write(row, register.address, register.encode(value))
        desk.bench.plug([row])
        return ""

    return act


def test_id_of_connected_servo_is_not_assigned_again() -> None:
    desk = Desk(fresh=True)
    builder = Builder([plug(desk), plug(desk, answer="left front femur"), "q"])
    set_ids.set_ids(line(desk), PHANTOMX, builder)
    assert "servo 3 (left front femur) is already plugged in: unplug it first, or type another joint" in builder.told
    assert sorted(ids(desk)) == [*[1] * 17, 3]


@pytest.mark.parametrize("agreed", [False, True])
@pytest.mark.parametrize("delay", [0, 250], ids=["set up", "not set up"])
def test_used_servo_with_id_of_another_joint_is_recognised_as_new(agreed: bool, delay: int) -> None:
    desk = Desk(fresh=True)
    builder = Builder([plug(desk), plug_used(desk, 5, 9, RETURN_DELAY=delay), agreed, "q"])
    set_ids.set_ids(line(desk), PHANTOMX, builder)
    assert builder.asked[2] == "servo 9 (left rear femur by its id) appeared; make it the left front tibia?"
    assert desk.tables[5, dxl.ID.address] == (joint("left front tibia") if agreed else 9)
    assert "no new servo answers" not in builder.all_told


def test_used_servo_with_wanted_id_is_configured() -> None:
    desk = Desk(fresh=True)
    builder = Builder([plug_used(desk, 0, 3, RETURN_DELAY=100, STATUS_RETURN_LEVEL=1), plug_used(desk, 1, 5), "q"])
    set_ids.set_ids(line(desk), PHANTOMX, builder)
    assert "servo 3 (left front femur) is set and verified" in builder.all_told
    assert "servo 5 (left front tibia) is set and verified" in builder.all_told
    assert desk.tables[0, [dxl.RETURN_DELAY.address, dxl.STATUS_RETURN_LEVEL.address]].tolist() == [0, 2]


def test_configured_servos_plugged_in_together_are_accepted_by_id() -> None:
    desk = Desk(fresh=True)

    def both() -> str:
        return plug_used(desk, 0, 3)() + plug_used(desk, 1, 5)()

    builder = Builder([both, "q"])
    set_ids.set_ids(line(desk), PHANTOMX, builder)
    assert "servo 3 (left front femur), servo 5 (left front tibia) appeared, and all of them are set" in builder.all_told
    assert "2 of 18 servos have their ids" in builder.told


@pytest.mark.parametrize("agreed", [False, True])
def test_servo_with_id_set_but_incomplete_registers_is_completed(agreed: bool) -> None:
    """Check that a servo is completed if power failed right after its id was set.

    The servo has its id, but is still in wheel mode with the factory's return delay.
    """
    desk = Desk(fresh=True)
    plug_used(desk, 0, 9, RETURN_DELAY=250, CCW_ANGLE_LIMIT=0)()
    plug_used(desk, 1, 3)()
    builder = Builder([agreed, "q"])
    assert not set_ids.set_ids(line(desk), PHANTOMX, builder)
    assert builder.asked[0].startswith("The id of servo 9 (left rear femur) is set, but not all other registers")
    assert f"{1 + agreed} of 18 servos have their ids" in builder.told
    words = desk.tables.view("<u2")
    assert words[0, dxl.CCW_ANGLE_LIMIT.address // 2] == 1023 * agreed
    assert desk.tables[0, dxl.RETURN_DELAY.address] == (0 if agreed else 250)


@pytest.mark.parametrize("level", [0, 1])
def test_intermittent_servo_is_unchanged_and_retry_is_advised(level: int, monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk(fresh=True)
    receive = desk.bench.receive

    def loose(data: bytes, now_ns: int) -> list[Reply]:
        reads = data[4:5] == bytes([dxl.Instruction.READ])
        return [] if reads and (level == 0 or data[6] > 2) else receive(data, now_ns)

    monkeypatch.setattr(desk.bench, "receive", loose)
    set_ids.set_ids(line(desk), PHANTOMX, builder := Builder([plug(desk), "q"]))
    assert ": it is unchanged; try again" in builder.all_told
    assert "plug in another" not in builder.all_told


def test_servo_at_any_rate_is_set_with_all_rates() -> None:
    desk = Desk(fresh=True)

    def plug_slow_one() -> str:
        plug(desk)()
        desk.change(1, dxl.BAUD_RATE, 9)
        return ""

    builder = Builder([plug_slow_one, "q"])
    assert not set_ids.set_ids(line(desk), PHANTOMX, builder)
    assert "no new servo answers" in builder.all_told
    assert "--all-rates asks at all rates" in builder.all_told
    builder = Builder(["", "q"])
    set_ids.set_ids(line(desk, all_rates), PHANTOMX, builder)
    assert "is set and verified" in builder.all_told
    assert bus_survey.scan(line(desk), PHANTOMX.servo_names)[0].rate == BAUD_RATE


# ---------------------------------------------------------------------------------------------------------- protection

HARMFUL = [
    (dxl.CW_ANGLE_LIMIT, 400, "turns from tick 400 to 1023 only, 157 to 860 needed"),
    (dxl.CCW_ANGLE_LIMIT, 600, "turns from tick 0 to 600 only"),
    (dxl.TEMPERATURE_LIMIT, 50, "shuts down at 50 deg C, 70 expected"),
    (dxl.TEMPERATURE_LIMIT, 99, "shuts down at 99 deg C, 70 expected"),
    (dxl.MAX_TORQUE, 300, "gives 30 % of its torque at most"),
    (dxl.SHUTDOWN, 0, "does not shut down for overheating, overload"),
    (dxl.SHUTDOWN, 0x04, "does not shut down for overload"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("register", "value", "words"), HARMFUL, ids=lambda value: getattr(value, "name", None))
def test_unsafe_limits_and_protections_are_named_and_restored(register: Register, value: int, words: str) -> None:
    desk = Desk()
    desk.change(9, register, value)
    found = bus_survey.scan(line(desk))
    (problem,) = bus_survey.verdict(found, PHANTOMX)
    assert problem.words.startswith(f"servo 9 (left rear femur) {words}")
    assert "set-id` with this servo alone on the bus and type its leg and joint to restore safe values" in problem.advice
    desk.bus().setup()  # the set-up by an actuator does not change it

    others = [row for row in range(18) if row != desk.row(9)]
    desk.bench.unplug(others)
    set_ids.set_ids(line(desk), PHANTOMX, Builder(["left rear femur", "q"]))
    desk.bench._plugged.update(others)
    desk.bench._find_listeners()
    assert bus_survey.verdict(bus_survey.scan(line(desk)), PHANTOMX) == []


def test_sufficient_angle_limits_and_extra_shutdown_bits_are_accepted() -> None:
    desk = Desk()
    for register, value in ((dxl.CW_ANGLE_LIMIT, 100), (dxl.CCW_ANGLE_LIMIT, 900), (dxl.SHUTDOWN, 0x25)):
        desk.change(9, register, value)
    assert bus_survey.verdict(bus_survey.scan(line(desk)), PHANTOMX) == []


@pytest.mark.parametrize("profile", [PHANTOMX, RX], ids=lambda profile: profile.name)
def test_data_sheet_registers_give_no_problems(profile: RobotProfile) -> None:
    assert bus_survey.verdict(bus_survey.scan(line(Desk(profile))), profile) == []


def test_servos_outside_scan_range_are_not_reported_missing() -> None:
    desk = Desk()
    desk.bench.unplug([desk.row(i) for i in (9, 11)])
    asked = range(5, 12)
    found = bus_survey.scan(line(desk), asked)
    assert [one.words for one in bus_survey.verdict(found, PHANTOMX, asked)] == [
        "servo 9 (left rear femur) and servo 11 (left rear tibia) do not answer"
    ]


def new_servo_at_joint_one(*others: int) -> Desk:
    """Return a robot of which only a new servo and these are plugged in."""
    desk = Desk()
    left = [desk.row(i) for i in (1, *others)]
    desk.reset(1)
    desk.bench.unplug([row for row in range(18) if row not in left])
    return desk


@pytest.mark.parametrize("others", [(), (3, 5)])
def test_new_servo_is_not_taken_for_the_joint_with_its_id(others: tuple[int, ...]) -> None:
    desk = new_servo_at_joint_one(*others)
    found = bus_survey.scan(line(desk))
    (one,) = [problem for problem in bus_survey.verdict(found, PHANTOMX) if problem.words.startswith("servo 1 ")]
    assert one.words.startswith("servo 1 (left front coxa) has factory settings, so it may be a new servo of another joint")
    assert one.advice.endswith("type the leg and joint where it is mounted")
    assert re.search(r"^  1 .* left front coxa\?$", bus_survey.in_words(found, PHANTOMX), re.MULTILINE)


def test_servo_with_factory_settings_is_that_of_its_joint_if_all_answer() -> None:
    desk = Desk()
    desk.change(1, dxl.RETURN_DELAY, 250)
    found = bus_survey.scan(line(desk))
    assert bus_survey.verdict(found, PHANTOMX) == []
    assert "left front coxa?" not in bus_survey.in_words(found, PHANTOMX)


def test_return_delay_tells_nothing_if_another_program_has_set_up_the_servos() -> None:
    desk = Desk()
    for i in desk.profile.servo_names:
        desk.change(i, dxl.RETURN_DELAY, 250)
    desk.bench.unplug([desk.row(11)])
    words = [problem.words for problem in bus_survey.verdict(bus_survey.scan(line(desk)), PHANTOMX)]
    assert words == ["servo 11 (left rear tibia) does not answer"]


def test_all_servos_missing_is_one_problem_besides_unknown_ids() -> None:
    desk = Desk()
    desk.change(9, dxl.ID, 200)
    desk.bench.unplug([row for row in range(18) if row != desk.row(200)])
    told = [one.words for one in bus_survey.verdict(bus_survey.scan(line(desk)), PHANTOMX, each=False)]
    assert told == ["none of 18 servos answers", "servo 200 is not one of the robot's servos"]
