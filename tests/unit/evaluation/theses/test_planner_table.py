"""Table 6.1 again: sections are counted as Masri counts, and the table is the same after it was kept."""

from pathlib import Path

import numpy as np
import pytest

from sextant.evaluation.baselines.masri_planner import SECTIONS
from sextant.evaluation.theses import planner_table
from sextant.evaluation.theses.planner_table import MASRI, PLANNERS, SEXTANT, Planned, content, read, task_of, to_json
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import Roadmap
from sextant.shared.files.config import ConfigError
from sextant.shared.robot.profiles import load_profile


def planned(planner: str, seed: int = 0, **other) -> Planned:
    known = {"crossed": True, "generated": (100, 200, 300), "expanded": (10, 20, 30), "ms": (1.0, 2.0, 30.0), "steps": 90}
    known = {**known, **other}
    return Planned("passage1", seed, planner, **{"margin_m": 0.03 if known["crossed"] else np.nan, **known})


def test_table_has_printed_numbers_in_their_own_column() -> None:
    found = [planned(MASRI), planned(MASRI, 1, margin_m=-0.02), planned(MASRI, 2, crossed=False, generated=(7,))]
    rows = {(k // 6, row[1]): row[2:] for k, row in enumerate(content([*found, planned(SEXTANT)]).rows)}
    assert rows[0, "crossings"] == ["3 of 3", "2 of 3", "1 of 1", "0 of 0"]
    assert rows[0, "n_g of each section"][:2] == ["1111, 776, 644", "100, 200, 300"]
    assert rows[2, "t, ms of each section"][0] == "117, 743, 1151"
    assert rows[0, "least support margin, cm"] == ["-", "-2.0", "3.0", "-"]
    assert rows[0, "centre of mass leaves its feet"] == ["-", "in 1 of 2", "in 0 of 1", "in 0 of 0"]


def test_kept_crossings_give_the_same_table(tmp_path: Path) -> None:
    found = [planned(MASRI), planned(SEXTANT, crossed=False)]
    (tmp_path / "kept.json").write_text(to_json(found, "today"))
    kept, made = read(tmp_path / "kept.json")
    assert (content(kept), made) == (content(found), "today")
    assert [one.generated for one in kept] == [one.generated for one in found]
    (tmp_path / "kept.json").write_text('{"made": "today", "crossings": [{"layout": "passage1"}]}')
    with pytest.raises(ConfigError, match="seed"):
        read(tmp_path / "kept.json")


@pytest.mark.slow
def test_both_planners_cross_a_layout_in_sections() -> None:
    found = planner_table.measure([0])
    assert [one.planner for one in found] == list(PLANNERS) * 3
    for one in found:
        assert len(one.generated) == len(one.expanded) == len(one.ms)
        assert all(0 < e <= g for g, e in zip(one.generated, one.expanded, strict=True))
        if one.planner == SEXTANT and one.crossed:
            assert len(one.generated) >= SECTIONS
            assert one.margin_m > 0.0


@pytest.mark.slow
def test_each_expanded_node_counts_once() -> None:
    task = task_of("passage1", 0)
    roadmap = Roadmap(load_profile("phantomx_mk2"), PassageSettings(body_height=float(task.stance.body[2])))
    roadmap.begin(task.field, task.stance, task.goal_x, seed=1)
    counts = []
    while roadmap.grow(50) is None:
        counts.append((roadmap.expanded_nodes, roadmap.expanded, roadmap.generated))
    nodes, expanded, generated = np.array(counts).T
    assert (nodes <= expanded + 1).all()
    assert (nodes <= generated).all()
    assert (np.diff(nodes) >= 0).all()
