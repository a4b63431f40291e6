"""Picture of the terminal during a walk."""

import io
import re
from pathlib import Path

import pytest
from rich.console import Console

from sextant.deploy.terminal.progress import table
from sextant.evaluation.lockstep.lockstep_run import LockstepRun
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario

pytestmark = pytest.mark.slow
WIDTH = 100  # [characters]
WALKED_S = 14.0  # [s] simulated time; the robot is among the blocks


def test_terminal_shows_what_each_service_does(tmp_path: Path, pytestconfig: pytest.Config) -> None:
    """Draw the terminal's picture of the docs.

    pytest tests/walk/test_terminal.py --pictures docs
    """
    scenario = load_scenario("steps")
    run = LockstepRun(scenario, 7, load_profile(scenario.robot), every_frame=False)
    run.run(round(WALKED_S * 1e9))
    console = Console(file=io.StringIO(), width=WIDTH, record=True, force_terminal=True, highlight=False)
    console.print(table(run.attendance.monitor.view))
    lines = console.export_text(clear=False).splitlines()
    folder = Path(pytestconfig.getoption("--pictures") or tmp_path)
    picture = console.export_svg(title="sextant run steps --lockstep --seed 7", unique_id="terminal")
    picture = re.sub(r"@font-face \{.*?\}\s*", "", picture, flags=re.DOTALL)  # it would be fetched from the network
    (folder / "terminal.svg").write_text(picture, encoding="utf-8")
    assert max(map(len, lines)) <= WIDTH
    assert "m/s" in lines[0]
    assert "m to the goal" in lines[0]
    named = {line.split()[0] for line in lines[2:]}
    assert named == {"actuator", "perception", "mapper", "planner", "simulator"}
    assert "url(http" not in picture
