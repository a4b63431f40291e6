"""Split of a long reference page into several pages; links follow their sections."""

import re
from collections.abc import Mapping
from typing import NamedTuple


class Part(NamedTuple):
    """Page that takes sections of a longer one."""

    title: str
    about: str  # text before the sections
    sections: tuple[str, ...]  # titles without backticks; each brings the sections inside it


def split(name: str, text: str, parts: Mapping[str, Part], index: Mapping[str, str]) -> dict[str, str]:
    """Return the pages that a long page becomes, by their names.

    Args:
        name: Of the long page. It keeps the sections that no part takes.
        text: The long page in Markdown. Of two sections with the same title a part takes the first.
        parts: Name of a page -> the part. Headings of its sections begin at the second level.
        index: Title of a section -> its meaning. The rows of a table with links, in place of the first section that moves.

    Raises:
        ValueError: A part names a section that the page does not have, or the index one that no part takes.
    """
    note = f"*`python -m docs.reference {name}` makes this page; a test checks that it is up to date.*"
    pages = {name: [], **{one: [f"# {part.title}", "", note, "", part.about, ""] for one, part in parts.items()}}
    taken = {title: one for one, part in parts.items() for title in part.sections}
    page_of: dict[str, str] = {}  # of each title
    page, top, fenced, place = name, 0, False, None
    for line in text.splitlines():
        fenced ^= line.startswith("```")
        if not fenced and (heading := re.match(r"(#+) (.*)", line)):
            level, title = len(heading[1]), heading[2].strip("`")
            if title in taken:
                page, top = taken.pop(title), level
                place = len(pages[name]) if place is None else place
            elif level <= top:
                page, top = name, 0
            page_of.setdefault(title, page)
            line = f"{'#' * (level - top + 2)} {heading[2]}" if top else line
        pages[page].append(line)
    if taken:
        raise ValueError(f"docs/{name}.md has no sections {', '.join(taken)}")
    if left := [title for title in index if page_of.get(title, name) == name]:
        raise ValueError(f"no part of docs/{name}.md takes {', '.join(left)}: add it to a Part of docs/reference")
    if index:
        rows = (f"| [`{title}`]({page_of[title]}.md#{anchor(title)}) | {meaning} |" for title, meaning in index.items())
        pages[name][place:place] = ["| name | meaning |", "|---|---|", *rows, ""]
    at = {anchor(title): page for title, page in page_of.items()}
    return {page: _relink("\n".join(lines), page, at) for page, lines in pages.items()}


def anchor(title: str) -> str:
    """Return the anchor of a heading, as GitHub and MyST make it."""
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")


def _relink(text: str, page: str, at: Mapping[str, str]) -> str:
    """Return the text with the name of the page in each link to a section that is on another one."""
    return re.sub(r"\]\(#([\w-]+)\)", lambda link: link[0] if at[link[1]] == page else f"]({at[link[1]]}.md#{link[1]})", text)
