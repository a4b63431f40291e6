"""The bench of unauthorized clients.

A base and a restarted actuator connect while such clients connect.
"""

import json
from pathlib import Path

import pytest

from benchmarks import cli
from benchmarks.access import strangers

pytestmark = [pytest.mark.live, pytest.mark.rare]


def test_base_and_actuator_connect_among_unauthorized_clients(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["strangers", "--cuts", "2", "--rate", "200", "--restarts", "1", "--silent", "500", "--out", str(tmp_path)]
    assert cli.main(words) in (0, 1), "1 where a base was late, which is up to the machine"
    assert "| time from | n |" in capsys.readouterr().out
    found = strangers.from_json((tmp_path / "strangers.json").read_text(encoding="utf-8"))
    assert len(found.back_s) == 2, "it was back each time"
    assert len(found.alone_s) == len(found.joined_s) == 1
    assert min(found.strangers.values()) > 50
    for kind in ("a client that does not speak TLS", "a certificate of a foreign authority", "a client that hung up"):
        assert kind in found.refused
    assert json.loads((tmp_path / "strangers.json").read_text(encoding="utf-8"))["machine"]
