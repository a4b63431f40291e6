"""The long walk, for half a minute."""

from pathlib import Path

import pytest

from benchmarks.robot import soak
from sextant.deploy.launch.process_table import rows
from tests.support.commands import Command

pytestmark = [pytest.mark.live, pytest.mark.rare]


def test_soak_measures_memory_of_processes_and_age_of_topics(tmp_path: Path) -> None:
    with Command("soak", "--minutes", "0.5", "--out", str(tmp_path), cwd=tmp_path, module="benchmarks") as bench:
        assert bench.status() in (0, 1), bench.text()  # in half a minute memory may well grow
        bench.gone()
    assert "written to" in bench.text()
    found = soak.from_json((tmp_path / "soak.json").read_text(encoding="utf-8"))
    assert found.legs >= 1
    assert found.ended == []
    assert set(found.refused.values()) == {0}
    services = {row.name for row in rows("all", simulated=True, page=True)}
    assert set(found.memory_mb) == services | {"router", "tap"}
    assert all(soak.ends(parts)[1] > 1.0 for parts in found.memory_mb.values())
    assert all(0.0 <= soak.ends(parts)[1] < 1000.0 for parts in found.age_p50_ms.values())
    assert len(found.age_p50_ms) == 7
    assert soak.in_words(found) in bench.text()
