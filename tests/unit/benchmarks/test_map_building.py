"""Benchmark of map building: both maps come from the same frames, and are judged by the true ground."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import cli
from benchmarks.peers import map_building
from benchmarks.peers.map_building import MASRI, SEXTANT, Built, carries, from_json, in_words, to_json


def test_ground_next_to_a_step_carries_no_foot() -> None:
    z = np.zeros((20, 20))
    z[10:] = 0.05
    z += 0.005 * np.arange(20)  # a slope of 27 deg
    good = carries(z)
    assert not good[9:11, 1:-1].any()
    assert good[:9].all()
    assert good[11:].all()


def test_table_has_median_and_worst_of_the_seeds() -> None:
    built = [
        Built("flat", method, seed, 0.001 * seed, 0.002, 0.001, 0.9 - 0.1 * seed, 0.01, 0.8, 50.0)
        for method in (MASRI, SEXTANT)
        for seed in (1, 2, 3)
    ]
    row = in_words(built).splitlines()[2]
    assert row.startswith("| flat | Masri 2016 | 2.0 (3.0) | 2.0 (2.0) |")
    assert "| 70 (60) |" in row
    assert from_json(to_json(built)) == built


@pytest.mark.slow
def test_both_methods_map_the_same_ride() -> None:
    masri, ours = map_building.measure([1000], frames=16, names=["boxes"])
    assert (masri.method, ours.method) == (MASRI, SEXTANT)
    for one in (masri, ours):
        assert 0.2 < one.known <= 1.0
        assert 0.0 <= one.wrong < 0.3
        assert one.found > 0.5
        assert one.ms > 0.0
    assert ours.interior_m < 0.005


@pytest.mark.slow
def test_maps_command_writes_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["maps", "--frames", "6", "--seeds", "1000:1001", "--out", str(tmp_path)]) == 0
    assert "| mixed | Sextant |" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "maps.json").read_text())) == 2 * len(map_building.SCENES)
