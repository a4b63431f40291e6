"""The generated pages of docs/ are up to date, and describe everything that a file may hold."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import cv2
import numpy as np
import pytest

from docs.reference import __main__ as reference
from docs.reference import terrain_pictures
from docs.reference.__main__ import PAGES, texts_of
from docs.reference.parts import Part, split
from docs.reference.schema_tables import tables_of
from sextant.evaluation.report import Report
from sextant.shared.field_comments import comments_of, parse
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.scenario.course import Course
from sextant.shared.scenario.scenario import Scenario

DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.parametrize("kind", PAGES)
def test_pages_are_up_to_date(kind: str) -> None:
    stored = {path.stem: path.read_text(encoding="utf-8") for path in (DOCS / f"{kind}.md", *DOCS.glob(f"{kind}_*.md"))}
    assert texts_of(kind) == stored, f"run: python -m docs.reference {kind}, and remove pages that it no longer writes"


def test_command_writes_named_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reference, "FOLDER", tmp_path)
    assert reference.main(["profiles", "report"]) == 0
    assert capsys.readouterr().out == "docs/profiles.md\ndocs/profiles_servos.md\ndocs/report.md\n"
    assert {path.name for path in tmp_path.iterdir()} == {"profiles.md", "profiles_servos.md", "report.md"}
    assert reference.main(["nonsense"]) == 2
    assert "unknown 'nonsense'; known: keys, parameters," in capsys.readouterr().err


def schemas(kind: type[Any]) -> Iterator[type[Any]]:
    """Yield a dataclass and those of its fields, to any depth."""
    yield kind
    hints = get_type_hints(kind)
    for one in dataclasses.fields(kind):
        for inner in tables_of(hints[one.name])[0]:
            yield from schemas(inner)


@pytest.mark.parametrize("kind", sorted({*schemas(Scenario), *schemas(RobotProfile)}, key=lambda kind: kind.__name__))
def test_each_field_of_a_file_has_a_meaning(kind: type[Any]) -> None:
    said, hints = comments_of(kind), get_type_hints(kind)
    values = [f.name for f in dataclasses.fields(kind) if f.name != "kind" and not tables_of(hints[f.name])[0]]
    if kind.__name__ != "Plugins":  # which no file has
        assert [name for name in values if not parse(said.get(name, "")).what] == []


@pytest.mark.parametrize("kind", sorted(set(schemas(Report)), key=lambda kind: kind.__name__))
def test_each_field_of_a_report_has_a_meaning_and_each_number_a_unit(kind: type[Any]) -> None:
    said, hints = comments_of(kind), get_type_hints(kind)
    meanings = {f.name: parse(said.get(f.name, "")) for f in dataclasses.fields(kind)}
    assert [name for name, meaning in meanings.items() if not meaning.what] == []
    numbers = [name for name in meanings if hints[name] in (int, float, dict[str, int], dict[str, float])]
    assert [name for name in numbers if not meanings[name].unit] == []


def test_each_kind_of_terrain_has_an_example() -> None:
    terrain, stretches = get_type_hints(Scenario)["terrain"], get_type_hints(Course)["stretches"]
    kinds = [get_type_hints(kind)["kind"] for hint in (terrain, stretches) for kind in tables_of(hint)[0]]
    names = [get_args(kind)[0] for kind in kinds]
    assert names == list(terrain_pictures.EXAMPLES), "EXAMPLES of terrain_pictures.py has each kind, in the order of `Terrain`"


@pytest.mark.slow
@pytest.mark.parametrize("kind", terrain_pictures.EXAMPLES)
def test_picture_shows_example(kind: str) -> None:
    path = DOCS / "terrain" / f"{kind}.webp"
    assert path.stat().st_size < 30_000
    stored = cv2.imread(str(path))
    assert stored is not None
    error = np.abs(stored[..., ::-1].astype(float) - terrain_pictures.draw(kind)).mean()
    assert error < 4.0, "make it again: python -m docs.reference scenarios"


def test_split_page_keeps_order_levels_and_links() -> None:
    text = "# All\n\n## A\n\n[b](#b)\n\n### `B`\n\n```sh\n# no heading\n```\n\n#### Inner\n\n[a](#a)\n\n### C\n\n## B\n"
    pages = split("all", text, {"all_b": Part("Of B", "Text.", ("B",))}, {"B": "second letter"})
    assert pages["all"].endswith(
        "## A\n\n[b](all_b.md#b)\n\n| name | meaning |\n|---|---|\n| [`B`](all_b.md#b) | second letter |\n\n### C\n\n## B"
    )
    assert pages["all_b"].endswith("\n\nText.\n\n## `B`\n\n```sh\n# no heading\n```\n\n### Inner\n\n[a](all.md#a)\n")
    with pytest.raises(ValueError, match="has no sections D"):
        split("all", text, {"all_d": Part("Of D", "", ("D",))}, {})
    with pytest.raises(ValueError, match="takes C"):
        split("all", text, {}, {"C": "third letter"})
