"""Profiles with several servo models and several buses."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sextant.shared.files.config import ConfigError
from sextant.shared.robot.joint_names import JOINT_NAMES, JOINTS, LEGS, SIDES, selected
from sextant.shared.robot.joint_servos import BusJoints, ServoGroup
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profile_text import profile_text
from sextant.shared.robot.profiles import load_profile
from sextant.shared.servo.models import XL430_W250, XM430_W350
from tests.support.families import LEFT_AND_RIGHT, command_robot

XM430 = """
model = "XM430-W350"
stall_torque = 4.1
no_load_speed = 4.8
stiffness = 18.9
position_gain = 800
armature = 0.028
friction = 0.05
temperature_limit = 80.0
"""
TIBIAS = """
[[servo_groups]]
joints = ["tibia"]
model = "XL430-W250"
stall_torque = 1.4
no_load_speed = 6.4
stiffness = 5.2
position_gain = 640
armature = 0.01
friction = 0.03
temperature_limit = 72.0
"""
MIXED = f"[servo]{XM430}{TIBIAS}"
AX = """model = "AX-12A"
stall_torque = 1.5
no_load_speed = 6.2
stiffness = 9.2
compliance_slope = 32
armature = 0.01
friction = 0.03
"""
BUSES = """
[[buses]]
name = "left"
joints = ["left"]
[[buses]]
name = "right"
joints = ["right"]
"""


def robot(tmp_path: Path, text: str) -> RobotProfile:
    path = tmp_path / "robot.toml"
    path.write_text(f'extends = "printed_sts3215"\nname = "robot"\n{text}', encoding="utf-8")
    return load_profile(str(path))


def test_words_select_joints() -> None:
    assert [sum(index in selected(words) for words in LEGS) for index in range(18)] == [1] * 18
    assert [sum(index in selected(words) for words in JOINTS) for index in range(18)] == [1] * 18
    assert sorted(index for words in SIDES for index in selected(words)) == list(range(18))
    assert [selected(name) for name in JOINT_NAMES] == [(index,) for index in range(18)]
    assert selected("left coxa") == selected("front") == selected("") == ()


def test_group_has_its_own_servos(tmp_path: Path) -> None:
    profile = robot(tmp_path, MIXED)
    assert profile.servos.models[::3] == (XM430_W350,) * 6
    assert profile.servos.models[2::3] == (XL430_W250,) * 6
    np.testing.assert_array_equal(profile.servos.stall_torque, [[4.1, 4.1, 1.4]] * 6)
    np.testing.assert_array_equal(profile.servos.temperature_limit, [[80.0, 80.0, 72.0]] * 6)
    assert profile.servo_models[3] is XL430_W250
    assert [bus.name for bus in profile.servos.buses] == [""]


def test_profile_without_groups_has_one_servo() -> None:
    profile = load_profile("phantomx_mk2")
    assert set(profile.servos.each) == {profile.servo}
    assert np.unique(profile.servos.stiffness).tolist() == [profile.servo.stiffness]
    assert profile.servos.buses[0].rows == tuple(range(18))


def test_buses_hold_all_joints(tmp_path: Path) -> None:
    left, right = robot(tmp_path, MIXED + BUSES).servos.buses
    assert left.rows == (0, 1, 2, 12, 13, 14, 15, 16, 17)
    assert right.rows == (3, 4, 5, 6, 7, 8, 9, 10, 11)


def test_profile_with_groups_and_buses_is_written_and_read_again(tmp_path: Path) -> None:
    profile = robot(tmp_path, MIXED + BUSES)
    path = tmp_path / "again.toml"
    path.write_text(profile_text(profile), encoding="utf-8")
    assert load_profile(str(path)) == profile


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            MIXED.replace('"tibia"', '"tibias"'),
            r"groups\[0\].joints\[0\]: a side, a leg, .* found 'tibias'",
        ),
        (MIXED + TIBIAS, r"servo_groups\[1\].joints: each joint in one group expected, found the left front tibia"),
        (
            MIXED + BUSES.replace('["right"]', '["right front"]'),
            "each joint on one bus expected, found none for the",
        ),
        (
            MIXED + BUSES.replace('["right"]', '["right", "left front"]'),
            "each joint in one group expected, found the left front",
        ),
        (MIXED + BUSES.split('[[buses]]\nname = "right')[0], "two buses or more, or no such table .* expected, found one"),
        (MIXED + BUSES.replace('"right"\n', '"left"\n'), "a different name for each expected, found left, left"),
        (
            f"{MIXED}[[servo_groups]]\njoints = ['coxa']\n{AX}",
            r"with one protocol and baud rate on one bus, .* expected, found AX-12A \(Dynamixel Protocol 1.0\) and XM430",
        ),
        (
            MIXED + BUSES + f"[[servo_groups]]\njoints = ['left front coxa']\n{AX}",
            r"buses\[0\]: servos with one protocol .* give each protocol a bus in \[\[buses\]\]",
        ),
        (
            MIXED.replace('"XL430-W250"', '"LX-16A"').replace("position_gain = 640\n", ""),
            r"a servo that measures the same as XM430-W350, which measures its load, expected, found LX-16A, which measures no",
        ),
        (MIXED.replace("joints", "legs"), r"servo_groups\[0\].legs: unknown key"),
        ("[servo]" + XM430 + BUSES.replace('"left"\nj', '"le ft"\nj'), "a name of letters and digits, as left, expected"),
    ],
)
def test_wrong_groups_and_buses_are_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        robot(tmp_path, text)


@pytest.mark.parametrize("buses", [(), LEFT_AND_RIGHT], ids=["one bus", "two"])
def test_servos_with_commands_are_mixed_on_one_bus_or_two(tmp_path: Path, buses: tuple[BusJoints, ...]) -> None:
    profile, path = command_robot(buses=buses), tmp_path / "robot.toml"
    path.write_text(profile_text(profile), encoding="utf-8")
    again = load_profile(str(path))
    assert again.servos.buses == profile.servos.buses
    assert [model.name for model in again.servos.models[:3]] == ["LX-16A", "HX-35H", "LX-16A"]
    assert len(again.servos.buses) == max(len(buses), 1)


def test_hobby_servos_are_alone_and_have_one_board() -> None:
    hobby = load_profile("printed_ds3218")
    with pytest.raises(
        ValueError, match=r"one model for all joints, as for all robots with hobby servos, expected, found AX-12A besides PWM$"
    ):
        replace(hobby, servo_groups=(ServoGroup(joints=("tibia",), **tomllib.loads(AX)),))
    with pytest.raises(ValueError, match="bus servos on several buses expected, found hobby servos, whose board has one port"):
        replace(hobby, buses=LEFT_AND_RIGHT)


def test_ids_of_two_buses_differ(tmp_path: Path) -> None:
    base = robot(tmp_path, MIXED + BUSES)
    text = profile_text(base).replace("servo_ids = [4, 5, 6]", "servo_ids = [1, 5, 6]")
    path = tmp_path / "twice.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="18 different servo ids expected, found 1"):
        load_profile(str(path))


def test_families_may_differ_between_buses(tmp_path: Path) -> None:
    right = f"[[servo_groups]]\njoints = ['right']\n{AX}"
    limits = "legs = []"
    with pytest.raises(ConfigError):  # the joints of this robot turn too far for an AX-12A only where they say so
        robot(tmp_path, f"[servo]{XM430}{right}{BUSES}{limits}")
    profile = robot(tmp_path, f"[servo]{XM430}{right}{BUSES}")
    assert {model.name for model in profile.servos.models} == {"XM430-W350", "AX-12A"}
