"""Hexapods of other people's descriptions: imported, checked, and walking on level ground, as a builder does it."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.shared.robot.profiles import load_profile
from tests.support.commands import write_course
from tests.support.described_robots import ROBOTS, DescribedRobot


@pytest.mark.parametrize("describe", ROBOTS, ids=lambda describe: describe.__name__)
def test_described_robot_is_imported_passes_its_check_and_walks(
    describe: Callable[[], DescribedRobot], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, profile = describe(), tmp_path / "robot.toml"
    assert cli.main(["robot", "import", *robot.write(tmp_path), "--out", str(profile)]) == 0, capsys.readouterr()
    links = load_profile(str(profile)).links
    assert (links.coxa, links.femur, links.tibia) == pytest.approx(robot.lengths, abs=1e-6)
    assert cli.main(["robot", "check", str(profile)]) == 0, capsys.readouterr()
    capsys.readouterr()
    course = str(write_course(tmp_path, "level", 0.4))
    words = ["--lockstep", "--seed", "1000", "--robot", str(profile), "--json", "--out", str(tmp_path / "run")]
    assert cli.main(["run", course, *words]) == 0, capsys.readouterr()
    report = json.loads(capsys.readouterr().out)
    assert report["success"]
    assert report["missteps"] == 0
