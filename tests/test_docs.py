"""The documentation builds without a warning, and each of its links resolves."""

import re
import subprocess
import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import sextant
from sextant import plugins

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
_LOADED = {"script": "src", "img": "src", "link": "href"}  # tags whose files the browser loads by itself


@dataclass
class Page(HTMLParser):
    """Links and anchors of a page."""

    ids: set[str] = field(default_factory=set)
    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value for name, value in attrs if value}
        self.ids |= {found[name] for name in ("id", "name") if name in found}
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        if _LOADED.get(tag) in found:
            self.loaded.append(found[_LOADED[tag]])


def test_pages_are_short() -> None:
    lines = {path.stem: len(path.read_text(encoding="utf-8").splitlines()) for path in DOCS.glob("*.md")}
    assert {name: count for name, count in lines.items() if count > 250} == {}
    assert lines["architecture"] <= 200


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Page]:
    """Build the site as `make docs` does, and parse its pages."""
    folder = tmp_path_factory.mktemp("site") / "html"
    words = ["-m", "sphinx", "--quiet", "--fail-on-warning", "--keep-going", "docs", str(folder)]
    built = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    assert (built.returncode, built.stderr.splitlines()) == (0, [])
    pages = {}
    for path in folder.rglob("*.html"):
        pages[path] = page = Page()
        page.feed(path.read_text(encoding="utf-8"))
    return pages


@pytest.mark.slow
def test_each_page_is_built_and_in_the_navigation(site: dict[Path, Page]) -> None:
    built = {path.name: page for path, page in site.items()}
    sources = {path.stem for path in DOCS.glob("*.md")}
    linked = {urlsplit(link).path for link in built["index.html"].links}
    assert {f"{name}.html" for name in sources} <= set(built)
    assert {f"{name}.html" for name in sources - {"index"}} <= linked


@pytest.mark.slow
def test_each_internal_link_resolves(site: dict[Path, Page]) -> None:
    missing = []
    for path, page in site.items():
        for link in (*page.links, *page.loaded):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchors = site[target].ids if target in site else set()
            if not target.is_file() or (target in site and parts.fragment and unquote(parts.fragment) not in anchors):
                missing.append(f"{path.name}: {link}")
    assert missing == []


@pytest.mark.slow
def test_pages_load_nothing_from_the_network(site: dict[Path, Page]) -> None:
    assert [link for page in site.values() for link in page.loaded if urlsplit(link).scheme in ("http", "https")] == []


@pytest.mark.slow
def test_each_public_name_is_described(site: dict[Path, Page]) -> None:
    (page,) = (page for path, page in site.items() if path.name == "api.html")
    elsewhere = {"RobotProfile", "TerrainMap"}  # of plugins: named there, described at their own places
    public = {f"sextant.{name}" for name in sextant.__all__}
    public |= {f"sextant.plugins.{name}" for name in plugins.__all__ if name not in elsewhere}
    assert public <= page.ids


def test_each_quoted_message_is_in_the_program() -> None:
    rows = re.findall(r"^\| `([^`]+)` \|", (DOCS / "troubleshooting.md").read_text(encoding="utf-8"), re.MULTILINE)
    folders = ("services", "shared", "evaluation", "deploy", "sextant")
    program = "".join(path.read_text(encoding="utf-8") for name in folders for path in sorted((ROOT / name).rglob("*.py")))
    program += (ROOT / "Makefile").read_text(encoding="utf-8")
    assert len(rows) >= 20
    assert [row for row in rows if row not in program] == []
