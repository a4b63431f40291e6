import json
import re
from dataclasses import replace

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.evaluation.figures import run_figures
from sextant.evaluation.figures.comparison_table import comparison, markdown
from sextant.evaluation.figures.run_figures import FIGURES, RUN_COLORS
from sextant.evaluation.figures.summary import legend_handles

cv2 = pytest.importorskip("cv2")


@pytest.fixture
def good(story, heard):
    return heard("good", story(moved_leg=2, drift=0.02, bob=0.001))


@pytest.fixture
def fallen(story, heard):
    return heard("fallen", story(topple_s=4.0, bob=0.003))


def _share(path, color):
    wanted = [int(color[k : k + 2], 16) for k in (5, 3, 1)]
    return np.mean(np.all(np.abs(cv2.imread(str(path)).astype(int) - wanted) < 45, axis=-1))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["height", "tilt", "joints", "stability", "pose", "table"])
def test_several_runs_are_overlaid_in_different_colors(name, good, fallen, tmp_path):
    path = tmp_path / f"{name}.png"
    assert run_figures.draw(name, [good, fallen], path)
    for color in RUN_COLORS[:2]:
        assert _share(path, color) > 5e-5, color
    assert _share(path, RUN_COLORS[2]) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["foot", "feet", "footholds"])
def test_runs_that_cannot_be_overlaid_are_stacked(name, good, fallen, tmp_path):
    heights = []
    for runs in ([good], [good, fallen]):
        path = tmp_path / f"{name}{len(runs)}.png"
        assert run_figures.draw(name, runs, path)
        heights.append(cv2.imread(str(path)).shape[0])
    assert heights[1] > 1.5 * heights[0]


@pytest.mark.slow
def test_empty_figure_writes_no_file(story, heard, good, tmp_path):
    stood = heard("stood", story(moved_leg=2), until_s=0.8)
    assert not stood.trace.walking.any()
    drawn = {name for name in FIGURES if run_figures.draw(name, [stood], tmp_path / f"{name}.svg")}
    assert drawn == {"summary", "torque", "footholds", "layers"}
    assert {path.stem for path in tmp_path.iterdir()} == drawn
    assert not run_figures.draw("passage", [good], tmp_path / "passage.svg")
    assert not run_figures.draw("table", [good], tmp_path / "table.svg")


@pytest.mark.slow
def test_each_listed_figure_can_be_drawn(story, heard, good, fallen, tmp_path):
    crossed = replace(good, trace=replace(good.trace, sections=_sections(story)))
    for name in FIGURES:
        runs = {"passage": [crossed], "table": [good, fallen]}.get(name, [good])
        assert run_figures.draw(name, runs, tmp_path / f"{name}.png"), name
        assert cv2.imread(str(tmp_path / f"{name}.png")).std() > 5.0, name


def _sections(story):
    return story(sections=2).judged().trace.sections


@pytest.mark.slow
def test_run_summary_title_color_shows_known_result(story, heard, good, fallen, tmp_path):
    robot = heard("robot", story(moved_leg=2), truth=False)
    green, red = "#1a7f37", "#b3261e"
    shares = {}
    for run in (good, fallen, robot):
        path = tmp_path / f"{run.name}.png"
        assert run_figures.draw("summary", [run], path)
        title = cv2.imread(str(path))[:75]
        cv2.imwrite(str(path), title)
        shares[run.name] = (_share(path, green) > 5e-3, _share(path, red) > 5e-3)
    assert shares == {"good": (True, False), "fallen": (False, True), "robot": (False, False)}
    assert not np.isfinite(robot.trace.pose_error).any(), "nobody knows it"


def test_torque_figure_shows_stall_limit_of_each_robot(story, heard, good, tmp_path):
    strong = replace(good.trace.profile, servo=replace(good.trace.profile.servo, stall_torque=3.0))
    other = replace(good, report=replace(good.report, robot="other"), trace=replace(good.trace, profile=strong))
    figure = FIGURES["torque"].draw([good, other])
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts == [f"stall of {good.report.robot}", "stall of other"]
    assert figure.axes[0].get_ylim()[1] > 3.0


@pytest.mark.slow
def test_goal_is_drawn_only_if_known(story, heard, good, tmp_path):
    green = "#1a7f37"
    for run, has in ((good, True), (heard("robot", story(moved_leg=2), truth=False), False)):
        path = tmp_path / f"{run.name}.png"
        assert run_figures.draw("footholds", [replace(run, report=replace(run.report, success=False))], path)
        assert (_share(path, green) > 2e-4) == has


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["svg", "pdf", "png"])
def test_figure_file_is_deterministic(suffix, good, tmp_path):
    a, b = tmp_path / f"a.{suffix}", tmp_path / f"b.{suffix}"
    for path in (a, b):
        assert run_figures.draw("height", [good], path)
    assert a.read_bytes() == b.read_bytes()
    assert a.read_bytes()[:5] == {"svg": b"<?xml", "pdf": b"%PDF-", "png": b"\x89PNG\r"}[suffix]


def test_windowed_maximum_is_at_least_each_value():
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 10.0, 0.02)
    values = np.where(rng.random(len(t)) < 0.1, np.nan, rng.standard_normal(len(t)))
    worst = run_figures.worst(values, t)
    known = np.isfinite(values)
    np.testing.assert_array_equal(np.isfinite(worst), known)
    assert (worst[known] >= values[known]).all()
    for k in np.flatnonzero(known)[::17]:
        assert worst[k] == np.nanmax(values[np.abs(t - t[k]) < run_figures.WINDOW_S / 2 + 1e-9])


def test_comparison_table_shows_report_values_or_dash(good, fallen):
    header, *rows = comparison([good, fallen])
    assert header == ["", "good", "fallen"]
    found = {words: values for words, *values in rows}
    assert found["success"] == ["yes", "no"]
    assert found["falls"] == ["0", "1"]
    assert found["speed"][0] == f"{100 * good.numbers['speed_mps']:.1f} cm/s"
    assert found["map error, rmse"] == [f"{1000 * run.numbers['map_error_m']['rmse']:.1f} mm" for run in (good, fallen)]
    ruled = replace(good, numbers={**good.numbers, "plugins": {"foothold": "my_rules:level"}})
    assert comparison([good, ruled])[1] == ["plug-ins", "none", "foothold my_rules:level"]
    nothing = {**good.numbers, "min_stability_margin_m": None}
    rows = comparison([replace(good, numbers=nothing, name="a-name-that-is-much-too-long-for-a-column")])
    assert dict(rows[1:])["least stability margin"] == "–"
    assert len(rows[0][1]) == 24
    assert markdown([["", "a"], ["x", "1"]]) == "|  | a |\n|---|---|\n| x | 1 |"


@pytest.mark.slow
def test_figures_command_draws_requested_figures_and_comparison(story, kept, scenario, tmp_path, capsys):
    good, fallen = kept("good", story(moved_leg=2, drift=0.02, bob=0.001)), kept("fallen", story(topple_s=4.0, bob=0.003))
    out = ["--scenario", scenario, "--out", str(tmp_path / "plots")]
    assert (
        cli.main(["figures", "run", str(good), str(fallen), "--what", "height", "--what", "footholds", "--format", "pdf", *out])
        == 0
    )
    assert sorted(path.name for path in (tmp_path / "plots").iterdir()) == ["footholds.pdf", "height.pdf"]
    printed = capsys.readouterr()
    assert "|  | good | fallen |" in printed.out
    assert printed.err == ""
    assert cli.main(["figures", "run", str(good), "--what", "layers", "--json", *out]) == 0
    assert json.loads(capsys.readouterr().out)["good"]["scenario"] == "story"
    # An empty figure is a failure, and a truncated recording is drawn up to its end.
    assert cli.main(["figures", "run", str(good), "--what", "passage", *out]) == 1
    assert "no data for passage" in capsys.readouterr().err
    part = tmp_path / "part.mcap"
    whole = (good / "recording.mcap").read_bytes()
    part.write_bytes(whole[: len(whole) * 2 // 3])
    assert cli.main(["figures", "run", str(part), "--what", "torque", *out]) == 0
    assert "part.mcap is truncated; only its readable part is drawn" in capsys.readouterr().err


def test_figures_command_lists_figures(capsys):
    assert cli.main(["figures", "run", "--list"]) == 0
    listed = [re.split(r"\s{2,}", line) for line in capsys.readouterr().out.splitlines()]
    assert [name for name, _ in listed] == list(FIGURES)
    assert all(words == FIGURES[name].shows for name, words in listed)


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["figures", "run"], "the folder of a run expected, found none"),
        (["figures", "run", "nowhere.mcap"], "give the recording.mcap of a run's folder"),
        (["figures", "run", "nowhere", "--what", "table"], "table compares runs, at least 2 expected, found 1"),
        (["figures", "run", "nowhere", "anywhere", "--what", "summary"], "summary shows one run, found 2"),
        (["figures", "run", "nowhere", "--what", "heigth"], "no figure 'heigth'; did you mean 'height'"),
    ],
    ids=["none", "no such", "one run", "two runs", "no figure"],
)
def test_invalid_input_is_refused_with_hint(words, hint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 2
    assert hint in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_legend_names_every_mark_on_the_map(good):
    trace, count = good.trace, len(good.trace.touchdowns.t)
    far = replace(trace.touchdowns, chosen=trace.touchdowns.chosen + 0.1)
    extra = replace(trace, touchdowns=far, routes=(np.zeros((2, 2)),))
    plain, marked = ({handle.get_label() for handle in legend_handles([one])} for one in (trace, extra))
    assert count
    assert marked - plain == {"missed the chosen foothold", "planned paths"}
