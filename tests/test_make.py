"""The Makefile and the tests run offline and with foreign pytest plugins."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OFFLINE = (
    "WARNING: Retrying (Retry(total=0)) after connection broken by 'NewConnectionError': /simple/setuptools/",
    "ERROR: Could not find a version that satisfies the requirement setuptools>=77 (from versions: none)",
)
ALONE = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL")}
CONFLICT = ("ERROR: Cannot install numpy==1.0 and numpy==2.0 because these package versions have conflicting dependencies.",)


@pytest.mark.parametrize(
    ("pip", "said"),
    [(OFFLINE, ["No package index is reachable, so "]), (CONFLICT, [CONFLICT[0]])],
    ids=["offline", "another error"],
)
def test_make_reports_unreachable_package_index_in_one_line(tmp_path: Path, pip: tuple[str, ...], said: list[str]) -> None:
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\n" + "".join(f'echo "{line}" >&2\n' for line in pip) + "exit 1\n")
    python.chmod(0o755)
    make = ["make", "--no-print-directory", "demo"]
    done = subprocess.run(make, cwd=tmp_path, env=ALONE, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    *lines, last = done.stderr.splitlines()
    assert last.startswith("make: ***")
    assert len(lines) == len(said)
    for line, begin in zip(lines, said, strict=True):
        assert line.startswith(begin)
    assert not (tmp_path / ".venv" / ".installed-all").exists()


def test_foreign_pytest_plugin_is_not_loaded(tmp_path: Path) -> None:
    """Install a plugin that warns on import, as another package may bring one."""
    (tmp_path / "warning_plugin.py").write_text("import warnings\nwarnings.warn('from a plugin', DeprecationWarning)\n")
    about = tmp_path / "warning_plugin-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: warning-plugin\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[pytest11]\nwarning_plugin = warning_plugin\n")
    test = tmp_path / "test_nothing.py"
    test.write_text("import sys\n\n\ndef test_nothing():\n    assert 'warning_plugin' not in sys.modules\n")
    words = [sys.executable, "-m", "pytest", "-q", "-c", str(ROOT / "pyproject.toml"), "--rootdir", str(tmp_path), str(test)]
    around = {"PYTHONPATH": str(tmp_path), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(words, cwd=tmp_path, env=around, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def test_make_live_names_every_file_with_live_tests() -> None:
    (named,) = re.findall(r"^LIVE := (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    files = [path.relative_to(ROOT) for path in (ROOT / "tests").rglob("test_*.py")]
    marked = {path for path in files if re.search(r"\bmark\.live\b", (ROOT / path).read_text(encoding="utf-8"))}
    assert marked == {path for path in files if any(path.is_relative_to(place) for place in named.split())}


@pytest.mark.parametrize(
    ("found", "status", "left"),
    [
        ('{"name": "a", "version": "1", "vulns": []}', 0, "audit.json"),
        ('{"name": "a", "version": "1", "vulns": [{"id": "CVE-1"}]}', 1, "audit.json"),
        ('{"name": "a", "skip_reason": "not found"}', 0, "audit.txt"),
        ("", 1, "audit.txt"),  # the tool failed, as without a network
    ],
    ids=["nothing known", "vulnerable", "no data", "no network"],
)
def test_audit_fails_for_a_vulnerability_and_says_so_without_data(tmp_path: Path, found: str, status: int, left: str) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    tools = tmp_path / "tools"
    tools.mkdir()
    write = f"""printf '%s' '{{"dependencies": [{found}]}}' > dist/audit.json\n""" if found else ""
    (tools / "pip-audit").write_text(f"#!/bin/sh\n{write}exit {status}\n")
    (tools / "pip-audit").chmod(0o755)
    (tools / "uv").touch()
    make = ["make", "--no-print-directory", "audit", f"TOOLS={tools}"]
    done = subprocess.run(make, cwd=tmp_path, env=ALONE, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode != 0) == ("CVE-1" in found), done.stdout + done.stderr
    assert [path.name for path in (tmp_path / "dist").iterdir()] == [left]
    assert ("Not audited" in done.stdout) == (left == "audit.txt")


@pytest.mark.parametrize("end", ["exit 0", "exit 1", "kill -TERM $PPID; exec sleep 0.1"])
def test_live_marker_file_is_removed_after_any_exit(tmp_path: Path, end: str) -> None:
    (tmp_path / "bin").mkdir()
    python = tmp_path / "bin" / "python"
    python.write_text(f"#!/bin/sh\n{end}\n")
    python.chmod(0o755)
    for name in (".installed-all", ".installed-dev", ".live"):
        (tmp_path / name).touch()
    done = subprocess.run(
        ["make", "live", f"VENV={tmp_path}"], cwd=ROOT, env=ALONE, capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode == 0) == (end == "exit 0"), done.stdout + done.stderr
    assert not (tmp_path / ".live").exists()
