"""Suggest the known name that a mistyped one is nearest to."""

import difflib
from collections.abc import Iterable


def nearest(word: str, known: Iterable[str]) -> str:
    """The known name that a word resembles most, whatever its case; empty where it resembles none."""
    names = {name.lower(): name for name in reversed(list(known))}
    near = difflib.get_close_matches(word.lower(), names, n=1)
    return names[near[0]] if near else ""


def hint(word: str, known: Iterable[str], which: str = "known") -> str:
    """What to write in place of an unknown name: the nearest one, or else one of all.

    Args:
        word: As it was written.
        known: All names.
        which: What they are called, as in "known keys".
    """
    names = list(known)
    near = nearest(word, names)
    return f"did you mean {near!r}?" if near else f"{which}: {', '.join(names)}"
