"""`sextant plan` on a map file: a picture, a JSON file, and the exit status of the plan."""

import json
from pathlib import Path

import numpy as np
import pytest

import sextant
from sextant.deploy import cli


@pytest.fixture
def ground(tmp_path: Path) -> Path:
    heights = np.zeros((260, 160), dtype=np.float32)
    heights[150:] = 0.05
    np.save(tmp_path / "map.npy", heights)
    return tmp_path / "map.npy"


def test_plan_is_written_printed_and_the_same_in_python(ground: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ground.parent / "out"
    words = ["plan", str(ground), "--goal", "2.0,0.8", "--start", "0.6,0.8,0", "--resolution", "0.01", "--out", str(out)]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "goal reached: at the goal (2.0, 0.8)"
    assert printed[1].endswith("0 of them across a gap")
    written = json.loads((out / "plan.json").read_text())
    assert (written["robot"], written["reached"]) == ("phantomx_mk2", True)
    assert (out / "plan.png").stat().st_size > 10_000
    found = sextant.plan_on_map(
        sextant.load_profile("phantomx_mk2"), np.load(ground), 0.01, goal=(2.0, 0.8), start=(0.6, 0.8, 0.0)
    )
    assert found.summary()["moves"] == written["moves"]


def test_unreachable_goal_has_a_reason_and_status_1(ground: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(ground.parent / "out")
    words = ["plan", str(ground), "--goal", "5.0,0.8", "--start", "0.6,0.8", "--resolution", "0.01", "--out", out, "--json"]
    assert cli.main(words) == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["reached"] is False
    assert "without measurements" in printed["reason"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--goal", "1"), "--goal: two lengths X,Y"),
        (("--goal", "1,nan"), "--goal: two lengths X,Y"),
        (("--goal", "1,1", "--start", "0,0,0,0"), "--start: X,Y or X,Y,YAW"),
        (("--goal", "1,1"), "the resolution of the cells in metres expected"),
        (("--goal", "1,1", "--resolution", "0.01"), "known ground under each foot at the start expected"),
        ((), "--goal"),
    ],
)
def test_wrong_input_is_named(ground: Path, more: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plan", str(ground), *more]) == 2
    assert words in capsys.readouterr().err
