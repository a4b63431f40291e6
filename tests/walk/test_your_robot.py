"""A robot from a TOML file alone, as docs/your_robot.md shows it.

It walks, and its errors are reported as shown there.
"""

import json
import re
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profiles import load_profile
from tests.support.commands import write_course

DOC = (Path(__file__).parents[2] / "docs" / "your_robot.md").read_text(encoding="utf-8")


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    (text,) = re.findall(r"^```toml\n(.*?)^```$", DOC, re.DOTALL | re.MULTILINE)
    path = tmp_path / "small_hexapod.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_robot_of_documentation_walks(profile: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "run")
    course = str(write_course(tmp_path, "level", 0.4))
    assert cli.main(["run", course, "--lockstep", "--seed", "1000", "--robot", str(profile), "--json", "--out", out]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["robot"] == "small_hexapod"
    assert report["missteps"] == 0
    assert report["tilt_deg"]["p95"] < 1.0


def test_documented_robot_is_smaller_than_phantomx_and_lifts_its_feet(profile: Path) -> None:
    small, phantom = load_profile(str(profile)), load_profile("phantomx_mk2")
    assert small.body.total_mass < phantom.body.total_mass
    assert small.links.tibia < phantom.links.tibia
    lifted = small.rest_feet()
    lifted[:, 2] += 0.04
    assert within_limits(small, body_inverse(small, lifted)).all()


def test_profile_errors_match_documentation(
    profile: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = profile.read_text(encoding="utf-8")
    for right, wrong in (
        ("tibia = 0.110", "shin = 0.110"),
        ("size = [0.190, 0.100, 0.040]", "size = [0.190, 0.100, -0.040]"),
        ("servo_ids = [13, 14, 15]", "servo_ids = [10, 14, 15]"),
    ):
        assert right in text
        text = text.replace(right, wrong)
    profile.write_text(text, encoding="utf-8")
    monkeypatch.chdir(profile.parent)
    assert cli.main(["run", "flat", "--lockstep", "--robot", profile.name]) == 2
    told = capsys.readouterr().err.strip().replace(f"{profile.parent.resolve()}/", "")
    *_, shown = re.findall(r"^```text\n(.*?)^```$", DOC, re.DOTALL | re.MULTILINE)
    assert told == shown.strip()
