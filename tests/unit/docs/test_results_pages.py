"""Tables of results in README and docs/ are those that the kept data give."""

from pathlib import Path

import pytest

from docs.reference import __main__ as reference
from docs.reference import results_pages

ROOT = Path(__file__).parents[3]
KEPT = {path.name for pattern in ("*.json", "*.jsonl") for path in (ROOT / "docs").glob(pattern)}


@pytest.mark.slow
def test_tables_are_those_of_the_kept_data() -> None:
    for path, text in results_pages.pages().items():
        assert text == path.read_text(encoding="utf-8"), f"{path.name}: run python -m docs.reference results"


def test_each_kept_file_has_a_table() -> None:
    pages = [path.read_text(encoding="utf-8") for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))]
    marks = [words for text in pages for _, words, _ in results_pages._MARK.findall(text)]
    without = {name for name in KEPT if not any(name in words.split() for words in marks)}
    assert without == {"roles.json", "soak.json"}  # whose pages describe them in text


def test_numbers_of_a_page_are_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("no table\n")
    page = tmp_path / "docs" / "results.md"
    page.write_text("# Title\n\n<!-- table: by_touch.jsonl --of walks -->\n| 1 |\n<!-- end of table -->\nend\n")
    monkeypatch.setattr(reference, "FOLDER", tmp_path / "docs")
    assert reference.main(["results"]) == 0
    text = page.read_text()
    assert text.startswith("# Title\n\n<!-- table: by_touch.jsonl --of walks -->\n\n| terrain |")
    assert text.endswith("\n\n<!-- end of table -->\nend\n")
    assert "| 1 |" not in text
    assert "Made at commit" in text
    assert results_pages.filled(text) == text


@pytest.mark.parametrize("words", ["nothing.jsonl", "--of walks"])
def test_mark_without_data_is_refused(words: str) -> None:
    with pytest.raises(ValueError, match="a file in docs/ expected in a mark of a table"):
        results_pages.filled(f"<!-- table: {words} -->\n<!-- end of table -->")
