"""Suggestions for mistyped names."""

import difflib
from collections.abc import Iterable


def nearest(word: str, known: Iterable[str], likeness: float = 0.6) -> str:
    """Return the known name most similar to a word, or an empty text if none has this likeness (0 to 1).

    The case is ignored.
    """
    names = {name.lower(): name for name in reversed(list(known))}
    near = difflib.get_close_matches(word.lower(), names, n=1, cutoff=likeness)
    return names[near[0]] if near else ""


def hint(word: str, known: Iterable[str], which: str = "known", likeness: float = 0.6) -> str:
    """Return a hint for an unknown name: the most similar name, or all names.

    Args:
        word: The unknown name.
        known: All known names.
        which: Label of the list, such as "known keys".
        likeness: Least likeness of the name, 0 to 1.
    """
    names = list(known)
    near = nearest(word, names, likeness)
    return f"did you mean {near!r}?" if near else f"{which}: {', '.join(names)}"
