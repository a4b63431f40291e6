"""Changes of a robot's own file keep everything else."""

from datetime import date
from pathlib import Path

import pytest

from sextant.shared.files import config
from sextant.shared.robot import profile_file
from sextant.shared.robot.profile import Calibration
from sextant.shared.robot.profiles import load_profile

TABLES: dict[str, profile_file.Values] = {
    "camera": {"mount_xyz": (0.1, 0.002, 0.149), "roll_deg": -1.25, "depth_error": 0.011},
    "camera.intrinsics": {"fx": 581.5},
}
LEG = Calibration("left front", date(2026, 7, 30), (1.0, -2.0, 0.5))


def test_new_file_has_the_values_and_extends_its_base(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    robot = profile_file.change(own, "phantomx_mk2", TABLES, (LEG,))
    assert robot == load_profile(str(own))
    assert robot.camera.mount_xyz == (0.1, 0.002, 0.149)
    assert (robot.camera.roll_deg, robot.camera.depth_error, robot.camera.intrinsics.fx) == (-1.25, 0.011, 581.5)
    assert robot.camera.intrinsics.fy == load_profile("phantomx_mk2").camera.intrinsics.fy
    assert robot.calibration == (LEG,)


def test_values_are_replaced_where_they_stand_and_comments_stay(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(
        'extends = "phantomx_mk2"  # mine\n\n[camera]\nroll_deg = 3.0  # by eye\ncolor = false\n\n[stance]\nbody_height = 0.1\n'
    )
    profile_file.change(own, "", TABLES, (LEG,))
    robot = profile_file.change(own, "", {"camera": {"roll_deg": 2.0}})
    text = own.read_text()
    assert "roll_deg = 2.0  # by eye\n" in text
    assert text.startswith('extends = "phantomx_mk2"  # mine\n')
    assert text.count("roll_deg") == 1
    assert (robot.camera.roll_deg, robot.camera.color, robot.stance.body_height) == (2.0, False, 0.1)
    assert robot.calibration == (LEG,)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('extends = "phantomx_mk2"\ncamera = { roll_deg = 1.0 }\n', "expected, found another notation; nothing was changed"),
        ('extends = "phantomx_mk2"\n[camera]\nmount_xyz = [\n  0.1,\n  0.0, 0.1]\n', "nothing was changed"),
    ],
)
def test_other_notation_is_refused_and_the_file_stays(text: str, words: str, tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text(text)
    with pytest.raises(config.ConfigError, match=words):
        profile_file.change(own, "", TABLES)
    assert own.read_text() == text
    assert list(tmp_path.iterdir()) == [own]


def test_value_that_no_robot_has_is_refused(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match="depth_error"):
        profile_file.change(tmp_path / "mine.toml", "phantomx_mk2", {"camera": {"depth_error": 3.0}})
    assert not list(tmp_path.iterdir())
