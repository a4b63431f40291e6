"""Times from a depth image to the legs, over live walks: intervals over the walks, and what is kept."""

import json
import math
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import cli
from benchmarks.robot import latency
from benchmarks.robot.latency import TimedWalk, WalkError, mean_interval

WALKS = tuple(TimedWalk(1000 + k, k != 2, "maps are old" * (k == 1), 280, 42.0 + k, 60.0, 101.0, 0.5 * k) for k in range(3))


@given(st.lists(st.floats(0.0, 1e3), min_size=2, max_size=40), st.floats(0.1, 10.0), st.floats(-100.0, 100.0))
def test_interval_contains_mean_and_follows_shift_and_scale(values: list[float], scale: float, shift: float) -> None:
    mean, low, high = mean_interval(values)
    assert low <= mean <= high
    moved = mean_interval([scale * value + shift for value in values])
    assert moved == pytest.approx((scale * mean + shift, scale * low + shift, scale * high + shift), abs=1e-6)


@pytest.mark.parametrize("count", [3, 5, 12, 30])
def test_interval_covers_the_true_mean_in_95_of_100_cases(count: int) -> None:
    rng = np.random.default_rng(0)
    cases = [mean_interval(rng.normal(50.0, 7.0, count).tolist()) for _ in range(2000)]
    assert np.mean([low <= 50.0 <= high for _, low, high in cases]) == pytest.approx(0.95, abs=0.015)


def test_a_single_walk_has_no_interval() -> None:
    mean, low, high = mean_interval([42.0])
    assert mean == 42.0
    assert math.isnan(low)
    assert math.isnan(high)


def test_walks_are_kept_and_described() -> None:
    assert latency.from_json(latency.to_json("steps", WALKS)) == WALKS
    words = latency.in_words(WALKS)
    assert "| median | 43 | 41 to 45 | 42 to 44 | 60 |" in words
    assert "3 walks, 2 at the goal, 840 images, at a load of 0.0 to 1.0 processes; in 1 the computer was too slow." in words


def test_latency_command_times_live_walks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command runs each seed live and keeps its percentiles; another test runs a live walk."""
    seeds: list[str] = []

    def run(words: tuple[str, ...], **_: object) -> SimpleNamespace:
        assert words[2:5] == ("sextant.deploy.cli", "run", "steps")
        seeds.append(words[6])
        out = Path(words[-1])
        out.mkdir()
        times = {"p50": 42.04, "p90": 61.0, "p99": 101.0, "images": 281}
        report = {"success": True, "too_slow": "", "capture_to_plan_ms": times}
        (out / "report.json").write_text(json.dumps(report), encoding="utf-8")
        return SimpleNamespace(stderr="")

    monkeypatch.setattr("benchmarks.commands.benches.warm_up", lambda _: None)
    monkeypatch.setattr(subprocess, "run", run)
    assert cli.main(["latency", "--runs", "2", "--seed", "1003", "--out", str(tmp_path)]) == 0
    assert seeds == ["1003", "1004"]
    kept = latency.from_json((tmp_path / "latency.json").read_text(encoding="utf-8"))
    assert [(walk.seed, walk.p50_ms, walk.images) for walk in kept] == [(1003, 42.04, 281), (1004, 42.04, 281)]


def test_walk_without_report_is_an_error_with_its_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(stderr="sextant: no mujoco\n"))
    with pytest.raises(WalkError, match="no mujoco"):
        latency.measure("steps", [1000], tmp_path, print)
