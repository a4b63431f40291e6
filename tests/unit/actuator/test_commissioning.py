"""From a box of servos to a robot's bus, at the emulated servos' bytes: who is found, named and set, and what is refused."""

from collections.abc import Callable

import numpy as np
import pytest

from services.actuator import commissioning
from services.actuator.bus import BAUD_RATE, ServoBus
from services.actuator.commissioning import USUAL_RATES, Line
from shared import dynamixel as dxl
from shared.profiles import load_profile
from shared.robot import RobotProfile
from tests.support.builder import Answer, Builder
from tests.support.desk import PHANTOMX, Desk

RX = load_profile("lotriet_rx64")
SET = (dxl.RETURN_DELAY, 0), (dxl.STATUS_RETURN_LEVEL, 2), (dxl.BAUD_RATE, 1)


def line(desk: Desk) -> Line:
    def at(rate: int) -> ServoBus:
        names = desk.profile.servo_names
        return ServoBus(desk.open(rate), list(names), desk.clock, names=names, model=dxl.MODEL_NAMED[desk.profile.servo.model])

    return Line(at)


def plug(desk: Desk, count: int = 1, answer: str = "") -> Callable[[], str]:
    """Plug the next servos in, then press Enter."""

    def act() -> str:
        desk.bench.plug(desk.bench.boxed[:count])
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


def test_a_robot_in_order_is_listed_with_nothing_to_complain_about() -> None:
    desk = Desk()
    found = commissioning.scan(line(desk))
    assert [one.seen.servo_id for one in found] == sorted(PHANTOMX.servo_names)
    assert {one.rate for one in found} == {BAUD_RATE}
    assert desk.rates == list(USUAL_RATES)
    assert commissioning.verdict(found, PHANTOMX) == []
    table = commissioning.in_words(found, PHANTOMX).splitlines()
    assert len(table) == 19
    assert table[9].split() == ["9", "1000000", "AX-12A", "24", "12.5", "V", "25", "deg", "C", "left", "rear", "femur"]


def test_a_scan_changes_nothing() -> None:
    desk = Desk(fresh=True)
    desk.bench.plug(range(3))
    before = desk.tables[:, :36].copy()
    commissioning.scan(line(desk))
    assert (desk.tables[:, :36] == before).all()
    assert not desk.bench.counts.instructions[dxl.Instruction.WRITE]


def test_what_is_wrong_is_named_by_leg_and_joint_with_what_to_do() -> None:
    desk = Desk()
    desk.bench.unplug([desk.row(12)])
    desk.tables[desk.row(16), dxl.MODEL_NUMBER.address] = 64
    desk.change(7, dxl.ID, 200)
    wrong = {problem.words: problem.advice for problem in commissioning.verdict(commissioning.scan(line(desk)), PHANTOMX)}
    assert all(wrong.values())
    assert set(wrong) == {
        "servo 12 (right rear tibia) does not answer",
        "servo 16 (right middle femur) is model 64 (RX-64), expected 12 (AX-12A)",
        "servo 7 (left rear coxa) does not answer",
        "servo 200 is none of the robot's",
    }


def test_voltage_heat_and_latched_overload_are_named() -> None:
    desk = Desk()
    desk.bench._servos.charge = 0.1
    desk.bench._servos.temperature[desk.row(6)] = 64.0
    desk.bench._servos._faults[desk.row(17)] = dxl.ServoError.OVERLOAD
    words = [problem.words for problem in commissioning.verdict(commissioning.scan(line(desk)), PHANTOMX)]
    assert len(words) == 18
    assert all("V, at least 10.5 V expected: charge the battery" in one for one in words)
    assert any(one.startswith("servo 6 (right front tibia)") and "64 deg C warm, its limit is 70" in one for one in words)
    assert any(one.startswith("servo 17 (left middle tibia) reports overload") for one in words)


def test_a_reset_rx_64_is_found_at_the_rate_of_the_factory() -> None:
    desk = Desk(RX)
    lost = RX.legs[3].servo_ids[1]
    desk.reset(lost)
    words = [problem.words for problem in commissioning.verdict(commissioning.scan(line(desk)), RX)]
    assert f"servo {lost} (right rear femur) does not answer" in words
    reset = (
        f"servo 1 talks at 57143 baud, 1000000 expected; 1 is what a reset leaves: it may be servo {lost} (right rear femur)"
    )
    assert reset in words


# -------------------------------------------------------------------------------------------------------------- set-id


@pytest.mark.parametrize("profile", [PHANTOMX, RX], ids=lambda profile: profile.name)
def test_a_box_of_new_servos_becomes_a_robots(profile: RobotProfile) -> None:
    desk = Desk(profile, fresh=True)
    builder = Builder([plug(desk)] * 18)
    assert commissioning.set_ids(line(desk), desk.profile, builder)
    assert_set_up(desk)
    factory = [name for i, name in desk.profile.servo_names.items() if i == 1]
    assert all(name in builder.asked[-1] for name in factory)  # comes last: new servos have its id
    assert [i for i in ids(desk) if i != 1] == [i for i in desk.profile.servo_names if i != 1]


def test_one_at_a_time_alone_on_the_bus_does_as_well() -> None:
    desk = Desk(fresh=True)

    def swap() -> str:
        desk.bench.unplug(list(desk.bench._plugged))
        fresh = [row for row in range(18) if desk.tables[row, dxl.RETURN_DELAY.address] == 250]
        desk.bench.plug(fresh[:1])
        return ""

    assert commissioning.set_ids(line(desk), PHANTOMX, Builder([swap] * 18))
    assert_set_up(desk)


@pytest.mark.parametrize("done", [0, 1, 7, 17])
def test_it_can_be_left_and_goes_on_with_what_is_missing(done: int) -> None:
    desk = Desk(fresh=True)
    left = Builder([*[plug(desk)] * done, "q"])
    assert not commissioning.set_ids(line(desk), PHANTOMX, left)
    assert "goes on with what is missing" in left.told[-1]
    again = Builder([plug(desk)] * (18 - done))
    assert commissioning.set_ids(line(desk), PHANTOMX, again)
    assert f"{done} of 18 servos have their ids" in again.told
    assert_set_up(desk)


@pytest.mark.parametrize("after", range(1, 12))
@pytest.mark.parametrize("profile", [PHANTOMX, RX], ids=lambda profile: profile.name)
def test_interrupted_between_any_two_packets_nothing_is_lost(profile: RobotProfile, after: int) -> None:
    """Ctrl-C falls on the nth write of a servo's setting; the next sitting brings all to their ends."""
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
        commissioning.set_ids(line(desk), desk.profile, Builder([plug(desk)] * 18))
    answers: list[Answer] = ["", *[plug(desk)] * 18]
    commissioning.set_ids(line(desk), desk.profile, builder := Builder(answers))
    assert "all 18 servos have their ids" in builder.told[-1]
    assert_ids_and_rates(desk)


def assert_ids_and_rates(desk: Desk) -> None:
    """The return delay of one that was interrupted is the actuator's to set, at its start."""
    assert sorted(ids(desk)) == sorted(desk.profile.servo_names)
    assert (desk.tables[:, dxl.BAUD_RATE.address] == 1).all()
    desk.bus().setup()
    assert_set_up(desk)


def test_two_new_servos_at_once_are_refused_and_left_as_they_are() -> None:
    desk = Desk(fresh=True)

    def one_out() -> str:
        desk.bench.unplug([1])
        return ""

    builder = Builder([plug(desk, 2), one_out, "q"])
    assert not commissioning.set_ids(line(desk), PHANTOMX, builder)
    assert "two servos or more answer as 1: neither can be set" in builder.all_told
    assert sorted(ids(desk)) == [*[1] * 17, 3]
    assert desk.tables[1, dxl.RETURN_DELAY.address] == 250


def test_a_servo_of_another_model_is_refused() -> None:
    desk = Desk(fresh=True)
    desk.tables[0, dxl.MODEL_NUMBER.address] = 64
    builder = Builder([plug(desk), "q"])
    assert not commissioning.set_ids(line(desk), PHANTOMX, builder)
    assert "a servo AX-12A expected, but it is an RX-64: left as it is" in builder.all_told
    assert ids(desk) == [1] * 18


def test_a_servo_may_be_named_and_a_used_one_has_any_id() -> None:
    desk = Desk(fresh=True)
    desk.tables[0, [dxl.ID.address, dxl.STATUS_RETURN_LEVEL.address]] = 77, 0
    desk.tables[0, dxl.CCW_ANGLE_LIMIT.address : dxl.CCW_ANGLE_LIMIT.address + 2] = 0  # it was a wheel
    builder = Builder([plug(desk, answer="left  Rear femur"), "left knee", "q"])
    commissioning.set_ids(line(desk), PHANTOMX, builder)
    assert desk.tables[0, dxl.ID.address] == 9
    assert desk.tables.view("<u2")[0, dxl.CCW_ANGLE_LIMIT.address // 2] == 1023
    assert "looking for it at all ids" in builder.all_told
    assert "found 'left knee'; one of left front coxa" in builder.all_told


def test_nobody_and_several_are_told_apart() -> None:
    desk = Desk(fresh=True)
    desk.tables[:2, dxl.ID.address] = 50, 60
    commissioning.set_ids(line(desk), PHANTOMX, builder := Builder(["", plug(desk, 2), "q"]))
    assert "no new servo answers" in builder.all_told
    assert "one new servo expected, found 2 (ids 50, 60)" in builder.all_told
    assert set(ids(desk)) == {1, 50, 60}


def test_a_locked_servo_is_told() -> None:
    desk = Desk(fresh=True)

    def plug_locked() -> str:
        desk.bench.plug([0])
        desk.tables[0, dxl.LOCK.address] = 1
        return ""

    commissioning.set_ids(line(desk), PHANTOMX, builder := Builder([plug_locked, "q"]))
    assert "switch its power off and on and try again" in builder.all_told
    assert np.all(desk.tables[:, dxl.ID.address] == 1)


@pytest.mark.parametrize("agreed", [False, True])
def test_a_servo_that_is_done_becomes_another_joints_only_with_a_yes(agreed: bool) -> None:
    """Whoever names the next joint and forgets to plug its servo in has but the last one on the bus."""
    desk = Desk(fresh=True)
    femur, tibia = (i for i, name in PHANTOMX.servo_names.items() if name in ("left front femur", "left front tibia"))
    builder = Builder([plug(desk, answer="left front femur"), "left front tibia", agreed, "q"])
    assert not commissioning.set_ids(line(desk), desk.profile, builder)
    desk.settle()
    assert (tibia in ids(desk), femur in ids(desk)) == (agreed, not agreed)
    assert "is the only one that answers, and is set already. Make it the left front tibia?" in builder.asked[2]
    assert "2 of 18" not in builder.all_told
