"""Figures of the theses: the inventory is whole, each figure is drawn, the index tells the rest."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from sextant.deploy import cli
from sextant.evaluation.theses import data, gallery
from sextant.evaluation.theses.data import Data
from sextant.evaluation.theses.inventory import Entry, Thesis, numbers
from sextant.evaluation.theses.lotriet import LOTRIET
from sextant.evaluation.theses.masri import MASRI
from sextant.shared.scenario.loading import load_scenario

THESES = (MASRI, LOTRIET)
COMPUTED = [(thesis, entry) for thesis in THESES for entry in thesis.entries if entry.draw is not None and not entry.walks]


def line(figure, data: Data) -> list[str]:
    figure.subplots().plot([0, 1], [0, data.seed])
    return ["0.5 cm"]


THESIS = Thesis(
    "x",
    "X",
    (
        Entry("1.2", "a line", line, printed=numbers(("length", "1 cm")), ours="computed"),
        Entry("Table 3.4", "a photograph", why_not="a photograph"),
    ),
)


@pytest.mark.parametrize("thesis", THESES, ids=lambda thesis: thesis.name)
def test_each_entry_is_drawn_or_says_why_not(thesis: Thesis) -> None:
    names = [entry.number for entry in thesis.entries]
    assert len(set(names)) == len(names)
    for entry in thesis.entries:
        assert re.fullmatch(r"(Table )?([1-9A-B]\.)?\d+", entry.number)
        assert bool(entry.why_not) == (entry.draw is None), entry.number
        assert bool(entry.ours) == (entry.draw is not None), entry.number
        for walk in entry.walks:
            assert load_scenario(walk).name == walk


def test_folder_holds_both_pictures_the_index_and_the_numbers(tmp_path: Path) -> None:
    gallery.draw_all(THESIS, THESIS.entries, tmp_path, Data(tmp_path))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["README.md", "figure_1_2.png", "figure_1_2.svg", "figures.json"]
    first, second = json.loads((tmp_path / "figures.json").read_text())["figures"]
    assert first["files"] == ["figure_1_2.png", "figure_1_2.svg"]
    assert first["numbers"] == [{"quantity": "length", "thesis": "1 cm", "here": "0.5 cm"}]
    assert (second["files"], second["why_not"]) == ([], "a photograph")
    index = (tmp_path / "README.md").read_text()
    assert "| Figure 1.2 | length | 1 cm | 0.5 cm |" in index
    assert "| Table 3.4 | a photograph | - | a photograph |" in index


def test_index_keeps_figures_that_are_not_drawn_again(tmp_path: Path) -> None:
    data = Data(tmp_path)
    assert gallery.draw_all(THESIS, THESIS.entries, tmp_path, data) == 1
    before = (tmp_path / "README.md").read_text()
    assert gallery.draw_all(THESIS, THESIS.entries[1:], tmp_path, data) == 0
    assert (tmp_path / "README.md").read_text() == before
    (tmp_path / "figure_1_2.svg").unlink()
    gallery.draw_all(THESIS, [], tmp_path, data)
    assert "| Figure 1.2 | a line | - | computed |" in (tmp_path / "README.md").read_text()


def test_same_data_give_the_same_picture(tmp_path: Path) -> None:
    for name in ("a", "b"):
        gallery.draw_all(THESIS, THESIS.entries, tmp_path / name, Data(tmp_path))
    for file in ("figure_1_2.svg", "figure_1_2.png"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize(("thesis", "entry"), COMPUTED, ids=[f"{thesis.name} {entry.number}" for thesis, entry in COMPUTED])
def test_each_computed_figure_is_drawn(thesis: Thesis, entry: Entry, tmp_path: Path) -> None:
    ours = gallery.draw(entry, tmp_path, Data(tmp_path, crossings=1))
    assert len(ours) == len(entry.printed)
    assert all(ours)
    assert (tmp_path / f"{entry.name}.png").stat().st_size > 5000
    assert (tmp_path / f"{entry.name}.svg").stat().st_size > 5000


@pytest.mark.slow
def test_command_draws_table_6_1_and_its_index(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["figures", "masri", "--only", "Table 6.1", "--crossings", "1", "--out", str(tmp_path)]
    assert cli.main(words) == 0
    capsys.readouterr()
    kept = (tmp_path / "table_6_1.json").read_bytes()
    assert cli.main([*words, "--json"]) == 0
    assert (tmp_path / "table_6_1.json").read_bytes() == kept  # a folder that is given again keeps its plans
    figures = {one["number"]: one for one in json.loads(capsys.readouterr().out)["figures"]}
    assert figures["Table 6.1"]["files"] == ["table_6_1.png", "table_6_1.svg"]


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["figures", "masri", "--only", "Tabel 6.1"], "no figure 'Tabel 6.1'; did you mean 'Table 6.1'"),
        (["figures", "lotriet", "--only", "9.9"], "no figure '9.9'"),
    ],
)
def test_unknown_figure_is_refused_with_hint(words: list[str], hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 2
    assert hint in capsys.readouterr().err


def test_list_names_each_figure(capsys: pytest.CaptureFixture[str]) -> None:
    for thesis in THESES:
        assert cli.main(["figures", thesis.name, "--list"]) == 0
        assert len(capsys.readouterr().out.splitlines()) == len(thesis.entries)


def test_walk_of_another_version_is_walked_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    walked: list[Path] = []
    monkeypatch.setattr(data, "run_lockstep", lambda scenario, seed, place: walked.append(place) or SimpleNamespace(reason=""))
    place = tmp_path / "walks" / "flat-0"
    place.mkdir(parents=True)
    (place / "made.json").write_text("{}")
    (place / "report.json").write_text('{"scenario": "flat"}')
    Data(tmp_path).prepare([("flat", 0)], 1)
    assert walked == [place]
