"""Calibration of misaligned horns, by careful and by careless operators.

The result is kept in the robot's own TOML file.
"""

from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.actuator.commissioning import calibration
from sextant.services.actuator.commissioning.calibration import calibrate, implausible, trims_deg
from sextant.services.actuator.commissioning.limited_motion import ServoNotRespondingError
from sextant.shared.files import config
from sextant.shared.robot import profile_file
from sextant.shared.robot.profile import LEGS, Calibration, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl
from tests.support.builder import Answer, Builder
from tests.support.desk import PHANTOMX, Desk

TORQUE_LIMIT, MOVING_SPEED = 300, 30  # 30 % of the torque, 20 deg/s

TODAY = date(2026, 7, 30)
RX = load_profile("lotriet_rx64")


def bend(desk: Desk, leg: str, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), answer: str = "") -> Callable[[], str]:
    def act() -> str:
        desk.bench.bend(LEGS.index(leg), np.radians(pose))
        return answer

    return act


def run_calibration(desk: Desk, answers: list[Answer], **options: object) -> tuple[bool, list[Calibration], Builder]:
    kept: list[Calibration] = []
    builder = Builder(answers)
    done = calibrate(desk.bus(), desk.profile, builder, kept.append, TODAY, **options)  # type: ignore[arg-type]
    return done, kept, builder


def assert_torque_off_and_registers_restored(desk: Desk) -> None:
    desk.settle()
    words = desk.tables.view("<u2")
    assert not desk.tables[:, dxl.TORQUE_ENABLE.address].any()
    assert (words[:, dxl.TORQUE_LIMIT.address // 2] == 1023).all()
    assert (words[:, dxl.MOVING_SPEED.address // 2] == 0).all()


@pytest.mark.parametrize("profile", [PHANTOMX, RX], ids=lambda profile: profile.name)
@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (10.0, 30.0, -60.0)])
def test_trims_of_all_legs_are_measured(profile: RobotProfile, pose: tuple[float, float, float]) -> None:
    desk = Desk(profile)
    answers = [answer for leg in LEGS for answer in (bend(desk, leg, pose), "")]
    done, kept, _ = run_calibration(desk, answers, pose_deg=pose)
    assert done
    assert [entry.leg for entry in kept] == list(LEGS)
    assert {entry.date for entry in kept} == {TODAY}
    robot = replace(profile, calibration=tuple(kept))
    tick_deg = np.degrees(dxl.TICK_RAD)
    np.testing.assert_allclose(robot.trims, desk.bench.robot.trims, atol=np.radians(tick_deg))
    assert_torque_off_and_registers_restored(desk)


def test_check_holds_leg_at_limited_torque_then_turns_torque_off() -> None:
    desk = Desk()
    row = desk.row(PHANTOMX.legs[0].servo_ids[1])
    seen: list[tuple[int, ...]] = []

    def scan_servo() -> str:
        desk.settle()
        words = desk.tables.view("<u2")
        seen.append((desk.tables[row, 24], words[row, 17], words[row, 16], desk.tables[:, 24].sum()))
        return ""

    _, kept, _ = run_calibration(desk, [bend(desk, LEGS[0]), "h", scan_servo, "b", bend(desk, LEGS[0]), ""], legs=LEGS[:1])
    assert seen == [(1, TORQUE_LIMIT, MOVING_SPEED, 3)]
    assert len(kept) == 1
    assert_torque_off_and_registers_restored(desk)


@pytest.mark.parametrize("end", [KeyboardInterrupt, ServoNotRespondingError])
def test_torque_is_off_after_interrupt_or_error(end: type[BaseException]) -> None:
    desk = Desk()

    def go() -> str:
        raise end

    builder = Builder([bend(desk, LEGS[0]), "h", go])
    with pytest.raises(end):
        calibrate(desk.bus(), desk.profile, builder, lambda _: None, TODAY)
    assert_torque_off_and_registers_restored(desk)
    assert builder.told[-1] == "torque is off"


def test_skipped_legs_do_not_discard_calibrated_ones() -> None:
    desk = Desk()
    done, kept, builder = run_calibration(desk, [bend(desk, LEGS[0]), "", bend(desk, LEGS[1]), "s", *["s"] * 4])
    assert not done
    assert [entry.leg for entry in kept] == [LEGS[0]]
    assert "1 of 6 legs calibrated; torque is off" in builder.told


def test_quitting_keeps_calibrated_legs() -> None:
    desk = Desk()
    done, kept, builder = run_calibration(desk, [bend(desk, LEGS[0]), "", bend(desk, LEGS[1], answer="Q")])
    assert not done
    assert [entry.leg for entry in kept] == [LEGS[0]]
    assert builder.told[-1] == "1 of 6 legs calibrated; torque is off"
    done, kept, _ = run_calibration(desk, [bend(desk, LEGS[0]), "q"])
    assert not done
    assert not kept


@pytest.mark.parametrize("word", ["quit", "h", "b", "y"])
def test_invalid_answer_is_asked_again_without_measuring(word: str) -> None:
    desk = Desk()
    done, kept, builder = run_calibration(desk, [word, "S"], legs=LEGS[:1])
    assert not done
    assert not kept
    assert builder.told[0] == f"Enter or one of s, q expected, found '{word}'"
    assert "trims" not in builder.all_told
    _, kept, builder = run_calibration(desk, [bend(desk, LEGS[0]), "x", ""], legs=LEGS[:1])
    assert "Enter or one of b, h, s, q expected, found 'x'" in builder.told
    assert len(kept) == 1


def test_leg_outside_reference_pose_is_refused_and_repeated() -> None:
    desk = Desk()
    _, kept, builder = run_calibration(desk, [bend(desk, LEGS[0], (0.0, 45.0, 0.0)), bend(desk, LEGS[0]), ""], legs=LEGS[:1])
    assert "trims of at most 20 deg either way expected, found femur" in builder.told[0]
    assert len(kept) == 1
    assert "its horn is not mounted at its angle: `sextant servos centre ID --robot FILE` states it" in builder.all_told


def test_moving_leg_is_not_measured() -> None:
    desk = Desk()
    read = desk.bench.receive

    def shaken(data: bytes, now_ns: int) -> list[object]:
        desk.bench._q[:] += 0.02
        return read(data, now_ns)  # type: ignore[return-value]

    def shake() -> str:
        desk.bench.receive = shaken  # type: ignore[method-assign,assignment]
        return ""

    def still() -> str:
        desk.bench.receive = read  # type: ignore[method-assign]
        return bend(desk, LEGS[0])()

    _, _, builder = run_calibration(desk, [shake, still, ""], legs=LEGS[:1])
    assert builder.told[0] == "the leg moves; hold it still"


def test_reference_pose_beyond_joint_limits_is_refused() -> None:
    with pytest.raises(ValueError, match=r"found tibia 90 deg, not -147 to 9 deg"):
        run_calibration(Desk(), [], pose_deg=(0.0, 0.0, 90.0))


@pytest.mark.parametrize("agreed", [True, False])
def test_torque_is_turned_off_only_after_confirmation(agreed: bool) -> None:
    desk = Desk()
    desk.bus().set_torque(True)
    done, kept, builder = run_calibration(desk, [agreed, bend(desk, LEGS[0]), ""] if agreed else [False], legs=LEGS[:1])
    assert done is agreed
    desk.settle()
    assert desk.tables[:, dxl.TORQUE_ENABLE.address].all() == (not agreed)
    assert "The torque of 18 servos is on" in builder.asked[0]
    assert len(kept) == agreed


def test_calibration_is_refused_with_faulty_servos() -> None:
    desk = Desk()
    desk.bench.unplug([desk.row(9)])
    done, _, builder = run_calibration(desk, [])
    assert not done
    assert "servo 9 (left rear femur) does not answer, but the servo behind it does: the chain is intact" in builder.all_told


def test_error_names_servo_that_stops_responding() -> None:
    desk = Desk()

    def pull() -> str:
        desk.bench.unplug([desk.row(3)])
        return ""

    with pytest.raises(ServoNotRespondingError, match=r"servo 3 \(left front femur\) did not answer"):
        run_calibration(desk, [pull], legs=LEGS[:1])


def test_servo_lost_during_check_is_named_and_others_are_restored() -> None:
    desk = Desk()

    def pull() -> str:
        desk.bench.unplug([desk.row(1)])
        return ""

    advice = r"servo 1 \(left front coxa\) .* `sextant servos off`, then switch its power off and on again"
    with pytest.raises(ServoNotRespondingError, match=advice):
        run_calibration(desk, [bend(desk, LEGS[0]), "h", pull], legs=LEGS[:1])
    desk.bench._plugged.add(desk.row(1))  # its power stayed on
    desk.bench._find_listeners()
    desk.settle()
    limits = desk.tables.view("<u2")[:, dxl.TORQUE_LIMIT.address // 2]
    assert limits[[desk.row(3), desk.row(5)]].tolist() == [1023, 1023]
    done, _, builder = run_calibration(desk, [True] if desk.tables[desk.row(1), 24] else [])
    assert not done
    assert "servo 1 (left front coxa) reports a torque limit of 30 %; switch its power off and on again" in builder.all_told


@given(st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3), st.lists(st.floats(-40.0, 8.0), min_size=3, max_size=3))
def test_computed_trims_match_applied_trims(trims: list[float], pose: list[float]) -> None:
    for leg, name in enumerate(LEGS):
        robot = replace(PHANTOMX, calibration=(Calibration(name, TODAY, (trims[0], trims[1], trims[2])),))
        servo = robot.servo_angles(np.tile(np.radians(pose), (6, 1)))[leg]
        np.testing.assert_allclose(trims_deg(PHANTOMX, leg, servo, pose), trims, atol=1e-9)
        np.testing.assert_allclose(trims_deg(robot, leg, servo, pose), trims, atol=1e-9)  # measured again, not added up
    assert implausible(np.array(trims)) == ""
    assert "coxa" in implausible(np.add(trims, [41.0, 0.0, 0.0]))


# ------------------------------------------------------------------------------------------------------------ the file

numbers = st.floats(-20.0, 20.0).map(lambda value: round(value, 2))
entries = st.builds(Calibration, st.sampled_from(LEGS), st.dates(), st.tuples(numbers, numbers, numbers))


@given(st.lists(entries, min_size=1, max_size=12))
@settings(deadline=None, max_examples=25)
def test_file_keeps_last_calibration_per_leg_and_other_content(wild: list[Calibration]) -> None:
    import tomllib

    text = 'extends = "phantomx_mk2"  # mine\n\n[stance]\nbody_height = 0.1  # higher\n'
    start = text
    for entry in wild:
        text = profile_file.with_calibration(text, entry)
    last = {entry.leg: config.as_table(entry) for entry in wild}
    table = tomllib.loads(text)
    assert {one["leg"]: one for one in table["calibration"]} == last
    assert len(table["calibration"]) == len(last)
    assert text.startswith(start)


def test_calibration_file_is_created_then_updated(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    first, second = Calibration(LEGS[0], TODAY, (1.0, 2.0, 3.0)), Calibration(LEGS[4], TODAY, (-1.0, 0.25, 19.99))
    profile_file.change(own, "phantomx_mk2", legs=(first,))
    own.write_text(own.read_text() + "\n[stance]\nbody_height = 0.1  # mine\n[servo]  # none\n")
    robot = profile_file.change(own, "lotriet_rx64", legs=(second,))
    assert robot == load_profile(str(own))
    assert robot.calibration == (first, second)
    assert robot.stance.body_height == 0.1
    assert "# mine" in own.read_text()
    straight = replace(first, trims_deg=(0.0, 0.0, 0.0))
    assert profile_file.change(own, "", legs=(straight,)).calibration[1] == straight
    assert list(tmp_path.iterdir()) == [own]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            'extends = "phantomx_mk2"\ncalibration = []\n',
            "expected, found another notation; nothing was",
        ),
        ("extends = \n", "no valid TOML: "),
        ('extends = "phantomx_mk2"\n[links]\nshin = 1.0\n', "links.shin: unknown key"),
    ],
)
def test_file_that_cannot_be_edited_safely_is_unchanged(text: str, words: str, tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(text)
    with pytest.raises(config.ConfigError, match=words):
        profile_file.change(own, "phantomx_mk2", legs=(Calibration(LEGS[0], TODAY, (1.0, 2.0, 3.0)),))
    assert own.read_text() == text
    assert list(tmp_path.iterdir()) == [own]


def test_unwritable_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match="cannot be written: No such file or directory; give another file with --out"):
        profile_file.change(tmp_path / "nowhere" / "mine.toml", "phantomx_mk2")


def test_straight_out_pose_is_valid_for_each_bundled_profile() -> None:
    from sextant.shared.robot.profiles import profile_names

    for name in profile_names():
        for leg in LEGS:
            calibration.see_pose(load_profile(name), leg, calibration.STRAIGHT_OUT)
