"""Installed distributions that requirements need."""

import importlib.metadata
from collections.abc import Iterable

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def closure(wanted: Iterable[str]) -> set[str]:
    """Return the names of all distributions that the requirements need here."""
    found: dict[str, set[str]] = {}  # names with the extras that are already resolved
    waiting = [Requirement(text) for text in wanted]
    while waiting:
        one = waiting.pop()
        extras, name = {"", *one.extras}, canonicalize_name(one.name)
        if one.marker is not None and not one.marker.evaluate():
            continue
        new = extras - found.setdefault(name, set())
        found[name] |= new
        for text in importlib.metadata.requires(name) or []:
            inner = Requirement(text)
            if any(inner.marker is None or inner.marker.evaluate({"extra": extra}) for extra in new):
                inner.marker = None
                waiting.append(inner)
    return set(found)
