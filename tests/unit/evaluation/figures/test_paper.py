"""Figures of the width of a column, and their data as CSV."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sextant.deploy import cli
from sextant.evaluation.figures.run_figures import FIGURES, draw

SCALED = [name for name, kind in FIGURES.items() if kind.scales]


@pytest.fixture
def good(story, heard):
    return heard("good", story(moved_leg=2, drift=0.02, bob=0.001))


@pytest.mark.slow
@pytest.mark.parametrize("name", SCALED)
def test_figure_has_the_asked_width_and_shows_something(name, good, tmp_path):
    for width in (3.5, 7.0):
        path = tmp_path / f"{name}.png"
        assert draw(name, [good], path, width)
        picture = cv2.imread(str(path))
        assert abs(picture.shape[1] - 100 * width) <= 1
        assert 0.3 < picture.shape[0] / picture.shape[1] < 1.2
        assert picture.std() > 5.0


def table(path: Path) -> dict[tuple[str, str], np.ndarray]:
    series: dict[tuple[str, str], list[list[float]]] = {}
    with path.open(newline="") as file:
        for row in csv.DictReader(file):
            series.setdefault((row["panel"], row["series"]), []).append([float(row["x"]), float(row["y"])])
    return {name: np.array(points) for name, points in series.items()}


def test_csv_has_the_plotted_data(good, tmp_path):
    assert draw("height", [good], tmp_path / "height.svg", 3.5, data=True)
    found = table(tmp_path / "height.csv")[("body height [cm]", "true")]
    since = good.trace.t - good.begin
    np.testing.assert_allclose(found, np.column_stack([since, 100 * good.trace.p_true[:, 2]]), rtol=1e-8, atol=1e-12)
    assert draw("pose", [good], tmp_path / "pose.svg", data=True)
    paths = {series: points for (_, series), points in table(tmp_path / "pose.csv").items()}
    np.testing.assert_allclose(paths["good, true"], good.trace.p_true[:, :2] * [1, 100], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(paths["good, estimated"], good.trace.p_estimate[:, :2] * [1, 100], rtol=1e-8, atol=1e-12)


def test_csv_of_bars_has_the_torque_of_each_joint(good, tmp_path):
    assert draw("joints", [good], tmp_path / "joints.svg", data=True)
    bars = [points for points in table(tmp_path / "joints.csv").values() if len(points) == 18]
    assert any(np.allclose(points[:, 1], good.torque_rms.ravel(), rtol=1e-8) for points in bars)


def test_panels_and_series_of_several_runs_have_their_names(good, heard, story, tmp_path):
    ruled = replace(good, name="ruled", numbers={**good.numbers, "plugins": {"foothold": "my_rules:level"}})
    assert draw("height", [good, ruled], tmp_path / "height.svg", data=True)
    assert {series for _, series in table(tmp_path / "height.csv")} == {
        *(f"{name}, commanded" for name in ("good", "ruled")), "good", "ruled",
    }  # fmt: skip
    assert draw("foot", [good, ruled], tmp_path / "foot.svg", data=True)
    panels = sorted({panel.split(", ", 1)[1] for panel, _ in table(tmp_path / "foot.csv")})
    assert [title.partition(":")[0] for title in panels] == ["good", "ruled"]
    assert ", foothold my_rules:level: goal reached" in panels[1]


@pytest.mark.slow
def test_data_of_every_figure_can_be_written(good, tmp_path):
    for name in FIGURES:
        if draw(name, [good], tmp_path / f"{name}.svg", data=True):
            assert (tmp_path / f"{name}.csv").read_text().startswith("panel,series,x,y\n")


@pytest.mark.slow
def test_command_draws_columns_and_writes_data(kept, story, scenario, tmp_path, capsys):
    run = str(kept("good", story(moved_leg=2, drift=0.02, bob=0.001)))
    out = tmp_path / "out"
    words = ["figures", "run", run, "--scenario", scenario, "--width", "89mm", "--csv", "--format", "png", "--out", str(out)]
    assert cli.main(words) == 0
    assert "height.png" in capsys.readouterr().out
    assert {path.stem for path in out.iterdir()} == set(SCALED)
    assert {path.suffix for path in out.iterdir()} == {".png", ".csv"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--width", "3.5"], "--width: 1in to 40in expected, found '3.5'"),
        (["--width", "3.5in", "--what", "footholds"], "--width: footholds has a fixed size"),
    ],
)
def test_wrong_width_is_refused(words, message, kept, story, scenario, capsys):
    run = str(kept("good", story(moved_leg=2, drift=0.02, bob=0.001)))
    assert cli.main(["figures", "run", run, "--scenario", scenario, *words]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1


def test_command_knows_which_figures_scale():
    from sextant.deploy.commands.figures import _SCALED

    assert list(_SCALED) == SCALED
