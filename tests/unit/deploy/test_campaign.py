"""The table of all terrains, from made-up runs."""

import json
from dataclasses import replace

import pytest

from deploy import campaign
from deploy.report import HeightError, Report, Slip, Spread, Torque
from shared.scenario import load_scenario


def _report(scenario, seed):
    good = not scenario.walk.blind or seed % 2 == 0
    return Report(
        scenario.name,
        seed,
        scenario.robot,
        "tripod",
        scenario.walk.blind,
        good,
        "goal reached" if good else "fell 0.40 m along",
        2.5,
        25.0,
        0.1,
        int(not good),
        0,
        200,
        tilt_deg=Spread(0.25, 1.0),
        torque_nm=Torque(0.8, 1.4, 0.7),
        body_height_error_m=HeightError(0.001, 0.002),
        slip_m_per_step=Slip(0.0015, 0.004),
        missteps=1,
        min_stability_margin_m=0.040,
    )


class Runner:
    def __init__(self, until=10**6):
        self.ran = []
        self.until = until

    def __call__(self, scenario, seed):
        if len(self.ran) == self.until:
            raise KeyboardInterrupt
        self.ran.append((scenario.name, scenario.walk.blind, scenario.robot, seed))
        return _report(scenario, seed)


def test_one_table_has_a_row_per_terrain_and_its_blind_baseline_below(tmp_path):
    found = campaign.run_campaign(("flat", "stairs"), range(4), 1, tmp_path, blind=True, run=Runner())
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in campaign.markdown(found).splitlines()[:6]]
    assert len({len(row) for row in rows}) == 1
    assert [row[0] for row in rows[2:]] == ["`flat`", "`flat`, blind", "`stairs`", "`stairs`, blind"]
    seeing, blind = (dict(zip(rows[0], row, strict=True)) for row in rows[2:4])
    assert seeing["goal reached"] == "4 of 4 (51 to 100 %)"
    assert (blind["goal reached"], blind["falls"]) == ("2 of 4 (15 to 85 %)", "2")
    assert seeing["missteps of steps, %"] == "0.50"
    assert seeing["height rms, mm"] == "2.0 (2.0)"
    assert seeing["least margin, mm"] == "40 (40)"
    assert "Together 8 of 8 (68 to 100 %) reached the goal" in campaign.markdown(found)
    table = json.loads(campaign.to_json(found))
    assert table["terrains"]["stairs"]["baseline"]["success"]["successes"] == 2


def test_a_campaign_that_was_stopped_goes_on_where_it_was(tmp_path):
    first, second = Runner(until=5), Runner()
    with pytest.raises(KeyboardInterrupt):
        campaign.run_campaign(("flat", "stairs"), range(4), 1, tmp_path, run=first)
    # What is done is on file already.
    assert "`flat`" in (tmp_path / "table.md").read_text()
    found = campaign.run_campaign(("flat", "stairs"), range(4), 1, tmp_path, run=second)
    assert [(name, seed) for name, _, _, seed in first.ran + second.ran] == [
        (n, s) for n in ("flat", "stairs") for s in range(4)
    ]
    assert [entry.seeing.success.n for entry in found.entries] == [4, 4]


def test_a_terrain_whose_files_are_elsewhere_is_left_out_and_said(tmp_path, monkeypatch):
    monkeypatch.delenv("SEXTANT_DATA", raising=False)
    runner = Runner()
    found = campaign.run_campaign(("stair_map", "flat"), range(1), 1, tmp_path, run=runner)
    assert [name for name, *_ in runner.ran] == ["flat"]
    assert "Left out: stair_map: height map" in campaign.markdown(found)
    assert "SEXTANT_DATA expected" in found.left_out[0]


def test_another_robot_walks_every_terrain(tmp_path):
    runner = Runner()
    campaign.run_campaign(
        ("flat", "stairs"), range(1), 1, tmp_path, asked=lambda s: replace(s, robot="phantomx_mk2_rgbd"), run=runner
    )
    assert {robot for _, _, robot, _ in runner.ran} == {"phantomx_mk2_rgbd"}


def test_what_is_walked_comes_with_sextant():
    assert [load_scenario(name).name for name in campaign.WALKED] == list(campaign.WALKED)
