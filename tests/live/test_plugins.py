"""A plug-in in a live walk: it is loaded by its service's process, and its failure reaches the report."""

import json
from pathlib import Path

import pytest

from sextant.deploy import cli

pytestmark = pytest.mark.live
COURSE = 'name = "short"\n[goal]\ndistance = 0.5\n[[terrain]]\nkind = "plane"\n'


def test_failing_plugin_ends_live_run_with_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    (tmp_path / "short.toml").write_text(COURSE)
    name = "tests.support.plugins:failing"
    words = ["run", str(tmp_path / "short.toml"), "--foothold", name, "--out", str(tmp_path / "run")]
    assert cli.main(words) == 1
    report = json.loads((tmp_path / "run/report.json").read_text())
    assert f"mapper: plug-in {name} failed: KeyError: 'a name' (plugins.py:" in report["reason"]
    assert report["plugins"] == {"foothold": name}
