"""`sextant camera`: which robot a rehearsal simulates, and which one is refused."""

from pathlib import Path
from typing import Any

import pytest

from sextant.deploy import cli
from sextant.evaluation.lockstep import calibration_run
from sextant.shared.robot.profiles import base_profile
from sextant.shared.scenario.scenario import Scenario


class RehearsedError(Exception):
    """The rehearsal would have begun."""


@pytest.mark.parametrize(
    ("robot", "real"),
    [("phantomx_mk2", "phantomx_mk2"), ("printed_sts3215", "printed_sts3215"), ("mine.toml", "printed_sts3215")],
)
def test_rehearsal_simulates_the_robot_of_the_profile(
    robot: str, real: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rehearse(scenario: Scenario, *_: Any) -> None:
        assert (scenario.robot, scenario.real_robot) == (robot, real)
        raise RehearsedError

    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text('extends = "printed_sts3215"\n', encoding="utf-8")
    monkeypatch.setattr(calibration_run, "rehearse", rehearse)
    with pytest.raises(RehearsedError):
        cli.main(["camera", "calibrate", "--robot", robot, "--rehearse", "flat+harsh", "--out", "out.toml"])


def test_base_of_a_profile_is_the_end_of_its_chain(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "first.toml").write_text('extends = "phantomx_mk2"\n', encoding="utf-8")
    (tmp_path / "second.toml").write_text('extends = "inner/first.toml"\n', encoding="utf-8")
    assert base_profile(str(tmp_path / "second.toml")) == "phantomx_mk2"
    assert base_profile("printed_ds3218") == "printed_ds3218"
    with pytest.raises(ValueError, match="no such file"):
        base_profile(str(tmp_path / "none.toml"))


def test_robot_without_measured_angles_is_refused_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for words in ([], ["--rehearse", "flat+harsh"]):
        assert cli.main(["camera", "calibrate", "--robot", "printed_ds3218", *words]) == 2
        told = capsys.readouterr().err
        assert "a robot with measured joint angles expected, found printed_ds3218" in told
        assert len(told.splitlines()) == 1
