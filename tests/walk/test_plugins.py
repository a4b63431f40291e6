"""The example package of plug-ins, installed and walked."""

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.plugins import ElevationMap
from sextant.shared.plugins.loading import Plugin
from sextant.shared.robot.profiles import load_profile
from tests.support.commands import write_course

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples/plugin"
NAMES = {"planner": "nearest", "foothold": "relief", "registration": "odometry"}


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install the example as pip does: its package, and metadata with its entry points."""
    site = tmp_path / "site"
    shutil.copytree(EXAMPLE / "hexapod_rules", site / "hexapod_rules")
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = site / f"hexapod_rules-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = [f"[{group}]\n{_lines(entries)}" for group, entries in project["entry-points"].items()]
    (info / "entry_points.txt").write_text("\n".join(groups))
    monkeypatch.syspath_prepend(site)
    return site


def _lines(entries: dict[str, str]) -> str:
    return "".join(f"{name} = {target}\n" for name, target in entries.items())


@pytest.mark.slow
def test_example_plugins_walk_to_the_goal(installed, tmp_path, capsys):
    out = tmp_path / "run"
    chosen = [word for kind, name in NAMES.items() for word in (f"--{kind}", name)]
    course = str(write_course(tmp_path, "short", 0.4))
    assert cli.main(["run", course, "--lockstep", "--seed", "1000", "--out", str(out), *chosen]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["success"]
    assert report["plugins"] == NAMES
    assert cli.main(["recording", "replay", str(out / "recording.mcap")]) == 2
    assert "walked with the plug-ins planner nearest, foothold relief, registration odometry" in capsys.readouterr().err


@pytest.mark.slow
def test_published_baseline_walks_to_the_goal_by_its_own_map(tmp_path):
    course = str(write_course(tmp_path, "short", 0.4))
    chosen = ["--planner", "sextant.evaluation.baselines.lotriet:Steps", "--foothold", "lotriet"]
    assert cli.main(["run", course, "--lockstep", "--seed", "1000", "--out", str(tmp_path / "run"), *chosen]) == 0
    report = json.loads((tmp_path / "run/report.json").read_text())
    assert report["plugins"] == dict(zip(("planner", "foothold"), chosen[1::2], strict=True))


@pytest.mark.slow
def test_failing_plugin_ends_the_run_with_its_name(tmp_path, capsys):
    out = tmp_path / "run"
    name = "tests.support.plugins:failing"
    assert cli.main(["run", "flat", "--lockstep", "--seed", "1000", "--out", str(out), "--foothold", name]) == 1
    report = json.loads((out / "report.json").read_text())
    assert report["reason"].startswith(f"mapper failed: plug-in {name} failed: KeyError: 'a name' (plugins.py:")
    told = capsys.readouterr()
    assert "Traceback" not in told.out + told.err, "the reason says all"
    assert "Traceback" in (out / "crash.txt").read_text(encoding="utf-8")


def test_documented_rule_scores_slopes_and_keeps_unknown_cells(tmp_path, monkeypatch):
    (code,) = re.findall(
        r"^```python\n(.*?)^```$", (ROOT / "docs/foothold_rule.md").read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    (tmp_path / "my_rules.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    profile = load_profile("phantomx_mk2")
    rise = np.tan(np.radians(20.0)) * 0.01 * np.arange(6.0)
    elevation = np.array([np.zeros(6), np.zeros(6), np.zeros(6)], dtype=np.float32)
    ramp = (np.zeros((3, 1)) + rise).astype(np.float32)
    ramp[0, 0] = np.nan
    rule = Plugin.make("foothold", "my_rules:level", profile)
    level, steep = (
        rule.call(lambda score, h=h: score(ElevationMap(h, h, np.zeros(2), 0.01, profile.foot.radius)))
        for h in (elevation, ramp)
    )
    assert (level == 0.0).all()
    assert np.isnan(steep[0, 0])
    assert steep[2, 3] == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("command", ["run flat --lockstep", "trials flat --seeds 1000:1001", "run flat"])
def test_unknown_plugin_is_refused_before_the_walk(command, tmp_path, capsys):
    assert cli.main([*command.split(), "--out", str(tmp_path), "--planner", "tests.support.plugins:Idl"]) == 2
    assert "did you mean 'Idle'?" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
