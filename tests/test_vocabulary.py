"""Text of the project uses the field's terms: docstrings, comments, messages and documentation."""

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CODE = sorted(
    path
    for folder in ("benchmarks", "deploy", "docs", "evaluation", "services", "sextant", "shared", "tests")
    for path in (ROOT / folder).rglob("*.py")
    if path != Path(__file__)
)
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
INSTEAD = {
    r"\banew\b": "again, or from the start",
    r"\blikewise\b": "also",
    r"\bbeside\b": "next to, or besides",
    r"\b(?:who|what|which)ever\b": "any client, each, or all",
    r"\b(?:no|some|any|every)body\b": "no client, the operator, any client",
    r"\blet(?:s|ting)? go\b": "turn torque off, or release",
    r"\bin words\b": "as text, or nothing",
}
BANNED = re.compile("|".join(INSTEAD), re.IGNORECASE)


def texts(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of each docstring, comment and string of at least four words."""
    source = path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value.split()) >= 4:
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def advice(text: str) -> str:
    """Return a banned word of a text with its replacement, or an empty text; constants in capitals are names."""
    found = next((match for match in BANNED.finditer(text) if not match[0].isupper()), None)
    if found is None:
        return ""
    instead = next(words for pattern, words in INSTEAD.items() if re.fullmatch(pattern, found[0], re.IGNORECASE))
    return f"{found[0]!r}: write {instead}"


@pytest.mark.slow
def test_code_uses_standard_terms() -> None:
    found = [(path, line, advice(text)) for path in CODE for line, text in texts(path)]
    assert [f"{path.relative_to(ROOT)}:{line}: {words}" for path, line, words in found if words] == []


def test_documentation_uses_standard_terms() -> None:
    """Rows of tables are left out: some are results of the past, with the messages of that time."""
    lines = [(path, i, line) for path in PAGES for i, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)]
    lines = [(path, i, line) for path, i, line in lines if not line.startswith("|")]
    assert [f"{path.relative_to(ROOT)}:{i}: {words}" for path, i, line in lines if (words := advice(line))] == []


def test_banned_word_is_reported_with_replacement() -> None:
    assert advice("Let Go of the legs") == "'Let Go': write turn torque off, or release"
    assert advice("the besides and nobodies of it") == ""
