"""Tests that are not live give way to those that are, and only while they run."""

import os
import subprocess
import sys
from pathlib import Path

_SCRIPT = """
import os, sys
from pathlib import Path
from tests.support.idle import give_way_to, is_giving_way
def weight():
    group = Path("/proc/self/autogroup")
    return group.read_text().split()[-1] if group.exists() and group.read_text() else str(os.nice(0))
file = Path(sys.argv[1])
give_way_to(file)
print(is_giving_way(), weight())
file.unlink(missing_ok=True)
print(is_giving_way(), weight())
"""


def _script_output(file: Path) -> list[str]:
    root = Path(__file__).parents[1]
    command = [sys.executable, "-c", _SCRIPT, str(file)]
    # Without the file the script stays in its session, which gets one here: this worker may give way itself.
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True, start_new_session=not file.exists())
    return done.stdout.split("\n")[:2]


def test_worker_lowers_priority_while_live_file_exists(tmp_path: Path) -> None:
    file = tmp_path / "live"
    file.touch()
    during, after = _script_output(file)
    assert during == "True 10"
    assert after.startswith("False")
    grouped = Path("/proc/self/autogroup").exists()
    assert after == ("False 0" if grouped or os.geteuid() == 0 else "False 10"), "a process may take back nothing but as root"


def test_worker_keeps_priority_without_live_file(tmp_path: Path) -> None:
    assert _script_output(tmp_path / "none")[0] == "False 0"
