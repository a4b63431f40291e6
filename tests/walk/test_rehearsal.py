"""Services compile everything during their warm-up; a walk after it adds nothing."""

import subprocess
import sys
from pathlib import Path

import pytest

SELDOM = (
    "services.perception.registration.relocalization_map._score_places",
    "services.mapper.passage_map.voxel_cloud._merge",
    "services.mapper.passage_map.next_best_view._sights",
    "services.planner.roadmap.roadmap_search.grow",
    "shared.rendering.rasterizer.draw_capsules",
)
PATIENCE_S = 300.0  # [s], if nothing has been compiled yet


@pytest.mark.parametrize(
    ("scenario", "until_s"),
    [
        ("steps", 5.0),
        pytest.param("cobbles", 2.0, marks=pytest.mark.rare),
        pytest.param("puddle", 3.0, marks=pytest.mark.rare),
    ],
)
def test_walk_compiles_no_function_after_warm_up(scenario: str, until_s: float) -> None:
    command = [sys.executable, "-m", "tests.support.compiled", scenario, str(until_s)]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    rehearsed, *new = done.stdout.strip().splitlines()
    assert {f"sextant.{name}" for name in SELDOM} <= set(rehearsed.split())
    assert not new
