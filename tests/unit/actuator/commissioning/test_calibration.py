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

from sextant.services.actuator.commissioning import calibration, calibration_file
from sextant.services.actuator.commissioning.calibration import calibrate, implausible, trims_deg
from sextant.services.actuator.commissioning.limited_motion import MOVING_SPEED, TORQUE_LIMIT, ServoNotRespondingError
from sextant.shared.files import config
from sextant.shared.robot.profile import LEGS, Calibration, RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo import dynamixel as dxl
from tests.support.builder import Answer, Builder
from tests.support.desk import PHANTOMX, Desk

TODAY = date(2026, 7, 30)
RX = load_profile("lotriet_rx64")


def bend(desk: Desk, leg: str, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), answer: str = "") -> Callable[[], str]:
    def act() -> str:
        desk.bench.bend(LEGS.index(leg), np.radians(pose))
        return answer

    return act


def measured(desk: Desk, answers: list[Answer], **options: object) -> tuple[bool, list[Calibration], Builder]:
    kept: list[Calibration] = []
    builder = Builder(answers)
    done = calibrate(desk.bus(), desk.profile, builder, kept.append, TODAY, **options)  # type: ignore[arg-type]
    return done, kept, builder


def assert_limp_and_as_before(desk: Desk) -> None:
    desk.settle()
    words = desk.tables.view("<u2")
    assert not desk.tables[:, dxl.TORQUE_ENABLE.address].any()
    assert (words[:, dxl.TORQUE_LIMIT.address // 2] == 1023).all()
    assert (words[:, dxl.MOVING_SPEED.address // 2] == 0).all()


@pytest.mark.parametrize("profile", [PHANTOMX, RX], ids=lambda profile: profile.name)
@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (10.0, 30.0, -60.0)])
def test_the_horns_of_every_leg_are_found(profile: RobotProfile, pose: tuple[float, float, float]) -> None:
    desk = Desk(profile)
    answers = [answer for leg in LEGS for answer in (bend(desk, leg, pose), "")]
    done, kept, _ = measured(desk, answers, pose_deg=pose)
    assert done
    assert [entry.leg for entry in kept] == list(LEGS)
    assert {entry.date for entry in kept} == {TODAY}
    robot = replace(profile, calibration=tuple(kept))
    tick_deg = np.degrees(dxl.TICK_RAD)
    np.testing.assert_allclose(robot.trims, desk.bench.robot.trims, atol=np.radians(tick_deg))
    assert_limp_and_as_before(desk)


def test_a_leg_that_is_held_to_be_checked_is_held_gently_and_let_go() -> None:
    desk = Desk()
    row = desk.row(PHANTOMX.legs[0].servo_ids[1])
    seen: list[tuple[int, ...]] = []

    def scan_servo() -> str:
        desk.settle()
        words = desk.tables.view("<u2")
        seen.append((desk.tables[row, 24], words[row, 17], words[row, 16], desk.tables[:, 24].sum()))
        return ""

    _, kept, _ = measured(desk, [bend(desk, LEGS[0]), "h", scan_servo, "b", bend(desk, LEGS[0]), ""], legs=LEGS[:1])
    assert seen == [(1, TORQUE_LIMIT, MOVING_SPEED, 3)]
    assert len(kept) == 1
    assert_limp_and_as_before(desk)


@pytest.mark.parametrize("end", [KeyboardInterrupt, ServoNotRespondingError])
def test_however_it_ends_the_torque_is_off(end: type[BaseException]) -> None:
    desk = Desk()

    def go() -> str:
        raise end

    builder = Builder([bend(desk, LEGS[0]), "h", go])
    with pytest.raises(end):
        calibrate(desk.bus(), desk.profile, builder, lambda _: None, TODAY)
    assert_limp_and_as_before(desk)
    assert builder.told[-1] == "torque is off"


def test_legs_that_were_kept_before_it_was_left_are_kept() -> None:
    desk = Desk()
    done, kept, builder = measured(desk, [bend(desk, LEGS[0]), "", bend(desk, LEGS[1]), "s", *["s"] * 4])
    assert not done
    assert [entry.leg for entry in kept] == [LEGS[0]]
    assert "1 of 6 legs calibrated; torque is off" in builder.told


def test_it_can_be_left_and_what_is_kept_is_kept() -> None:
    desk = Desk()
    done, kept, builder = measured(desk, [bend(desk, LEGS[0]), "", bend(desk, LEGS[1], answer="Q")])
    assert not done
    assert [entry.leg for entry in kept] == [LEGS[0]]
    assert builder.told[-1] == "1 of 6 legs calibrated; torque is off"
    done, kept, _ = measured(desk, [bend(desk, LEGS[0]), "q"])
    assert not done
    assert not kept


@pytest.mark.parametrize("word", ["quit", "h", "b", "y"])
def test_what_is_no_answer_is_asked_again_and_nothing_is_measured(word: str) -> None:
    desk = Desk()
    done, kept, builder = measured(desk, [word, "S"], legs=LEGS[:1])
    assert not done
    assert not kept
    assert builder.told[0] == f"Enter or one of s, q expected, found '{word}'"
    assert "trims" not in builder.all_told
    _, kept, builder = measured(desk, [bend(desk, LEGS[0]), "x", ""], legs=LEGS[:1])
    assert "Enter or one of b, h, s, q expected, found 'x'" in builder.told
    assert len(kept) == 1


def test_a_leg_that_is_not_in_the_pose_is_refused_and_bent_again() -> None:
    desk = Desk()
    _, kept, builder = measured(desk, [bend(desk, LEGS[0], (0.0, 45.0, 0.0)), bend(desk, LEGS[0]), ""], legs=LEGS[:1])
    assert "trims of at most 20 deg either way expected, found femur" in builder.told[0]
    assert len(kept) == 1


def test_a_leg_that_moves_is_not_measured() -> None:
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

    _, _, builder = measured(desk, [shake, still, ""], legs=LEGS[:1])
    assert builder.told[0] == "the leg moves; hold it still"


def test_a_pose_beyond_the_limits_is_refused_before_anything_is_asked() -> None:
    with pytest.raises(ValueError, match=r"found tibia 90 deg, not -147 to 9 deg"):
        measured(Desk(), [], pose_deg=(0.0, 0.0, 90.0))


@pytest.mark.parametrize("agreed", [True, False])
def test_torque_that_is_on_goes_off_only_with_a_yes(agreed: bool) -> None:
    desk = Desk()
    desk.bus().set_torque(True)
    done, kept, builder = measured(desk, [agreed, bend(desk, LEGS[0]), ""] if agreed else [False], legs=LEGS[:1])
    assert done is agreed
    desk.settle()
    assert desk.tables[:, dxl.TORQUE_ENABLE.address].all() == (not agreed)
    assert "The torque of 18 servos is on" in builder.asked[0]
    assert len(kept) == agreed


def test_servos_that_are_not_in_order_are_named_and_nothing_is_asked() -> None:
    desk = Desk()
    desk.bench.unplug([desk.row(9)])
    done, _, builder = measured(desk, [])
    assert not done
    assert "servo 9 (left rear femur) does not answer: check its cable" in builder.all_told


def test_a_servo_that_falls_silent_is_named() -> None:
    desk = Desk()

    def pull() -> str:
        desk.bench.unplug([desk.row(3)])
        return ""

    with pytest.raises(ServoNotRespondingError, match=r"servo 3 \(left front femur\) did not answer"):
        measured(desk, [pull], legs=LEGS[:1])


def test_where_one_falls_silent_while_held_the_others_are_as_before_and_it_is_named() -> None:
    desk = Desk()

    def pull() -> str:
        desk.bench.unplug([desk.row(1)])
        return ""

    advice = r"servo 1 \(left front coxa\) .* `sextant servos off`, then switch its power off and on again"
    with pytest.raises(ServoNotRespondingError, match=advice):
        measured(desk, [bend(desk, LEGS[0]), "h", pull], legs=LEGS[:1])
    desk.bench._plugged.add(desk.row(1))  # its power stayed on
    desk.bench._find_listeners()
    desk.settle()
    limits = desk.tables.view("<u2")[:, dxl.TORQUE_LIMIT.address // 2]
    assert limits[[desk.row(3), desk.row(5)]].tolist() == [1023, 1023]
    done, _, builder = measured(desk, [True] if desk.tables[desk.row(1), 24] else [])
    assert not done
    assert "servo 1 (left front coxa) reports a torque limit of 30 %; switch its power off and on again" in builder.all_told


@given(st.lists(st.floats(-20.0, 20.0), min_size=3, max_size=3), st.lists(st.floats(-40.0, 8.0), min_size=3, max_size=3))
def test_trims_are_what_turned_the_servos(trims: list[float], pose: list[float]) -> None:
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
def test_each_leg_has_its_last_calibration_and_the_rest_of_the_file_stays(wild: list[Calibration]) -> None:
    import tomllib

    text = 'extends = "phantomx_mk2"  # mine\n\n[stance]\nbody_height = 0.1  # higher\n'
    start = text
    for entry in wild:
        text = calibration_file.with_entry(text, entry)
    last = {entry.leg: config.as_table(entry) for entry in wild}
    table = tomllib.loads(text)
    assert {one["leg"]: one for one in table["calibration"]} == last
    assert len(table["calibration"]) == len(last)
    assert text.startswith(start)


def test_a_file_is_made_and_then_changed(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    first, second = Calibration(LEGS[0], TODAY, (1.0, 2.0, 3.0)), Calibration(LEGS[4], TODAY, (-1.0, 0.25, 19.99))
    calibration_file.keep(own, first, "phantomx_mk2")
    own.write_text(own.read_text() + "\n[stance]\nbody_height = 0.1  # mine\n[servo]  # none\n")
    robot = calibration_file.keep(own, second, "lotriet_rx64")
    assert robot == load_profile(str(own))
    assert robot.calibration == (first, second)
    assert robot.stance.body_height == 0.1
    assert "# mine" in own.read_text()
    assert calibration_file.keep(own, replace(first, trims_deg=(0.0, 0.0, 0.0)), "").calibration[1].trims_deg == (0.0, 0.0, 0.0)
    assert list(tmp_path.iterdir()) == [own]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            'extends = "phantomx_mk2"\ncalibration = []\n',
            "expected, found another notation; nothing was",
        ),
        ("extends = \n", "TOML expected, found"),
        ('extends = "phantomx_mk2"\n[links]\nshin = 1.0\n', "links.shin: unknown key"),
    ],
)
def test_a_file_that_cannot_be_changed_without_harm_stays(text: str, words: str, tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(text)
    with pytest.raises(config.ConfigError, match=words):
        calibration_file.keep(own, Calibration(LEGS[0], TODAY, (1.0, 2.0, 3.0)), "phantomx_mk2")
    assert own.read_text() == text
    assert list(tmp_path.iterdir()) == [own]


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match="cannot be written: No such file or directory; give another file with --out"):
        calibration_file.keep(tmp_path / "nowhere" / "mine.toml", Calibration(LEGS[0], TODAY, (1.0, 2.0, 3.0)), "phantomx_mk2")


def test_straight_out_is_a_pose_of_every_profile_that_comes_along() -> None:
    from sextant.shared.robot.profiles import profile_names

    for name in profile_names():
        for leg in LEGS:
            calibration.see_pose(load_profile(name), leg, calibration.STRAIGHT_OUT)
