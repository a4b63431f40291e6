"""One table for the faults of several robots."""

from dataclasses import replace

import pytest

from benchmarks.faults import overview
from benchmarks.faults.cases import BY_NAME
from benchmarks.faults.table import row
from sextant.shared.robot.profiles import load_profile
from tests.support.families import robot_with
from tests.unit.benchmarks.faults.test_batch import GOOD, KILLED, SAG


def test_each_robot_has_a_row_and_each_missed_limit_a_line() -> None:
    killed, sag = row(KILLED, [GOOD] * 3, ("aaaaaaa",)), row(SAG, [GOOD] * 2, ("bbbbbbb",))
    assert (killed.missed, bool(sag.missed)) == ((), True)
    *head, first, second, _, line = overview.markdown({"one": [killed], "two": [killed, sag]}).splitlines()
    assert len(head) == 2
    assert first.startswith("| `one` | 1 | 3 | 1 | 0 |")
    assert second.startswith("| `two` | 2 | 2 to 3 | 1 | 0 |")
    assert second.endswith("| aaaaaaa, bbbbbbb |")
    assert line == f"- `two`, sag: {'; '.join(sag.missed)}"


def test_robot_without_any_figure_has_dashes() -> None:
    (line,) = overview.markdown({"one": [row(BY_NAME["off"], [])]}).splitlines()[2:3]
    assert "| - | - | - |" in line


def test_robot_of_the_x430_faults_has_the_servos_of_its_data_sheet() -> None:
    robot, same = load_profile("benchmarks/faults/xl430.toml"), robot_with("XL430-W250")
    assert robot.servo.no_load_speed == pytest.approx(same.servo.no_load_speed)
    assert robot.servo.stiffness == pytest.approx(same.servo.stiffness)
    given = replace(robot.servo, no_load_speed=same.servo.no_load_speed, stiffness=same.servo.stiffness)
    assert (given, robot.battery, robot.legs) == (same.servo, same.battery, same.legs)
