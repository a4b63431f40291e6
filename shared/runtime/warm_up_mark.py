"""Mark that a warm-up leaves: what it has compiled, and whether that still holds.

The mark holds in any folder, so a wheel contains it with the compiled code.
"""

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from sextant.shared.files import whole_files

_PACKAGE = Path(__file__).parents[2]
MARK = Path(__file__).parent / "__pycache__" / "warm_up.txt"  # fingerprint of the last warm-up, and the files that it left
_SEARCH = "roadmap_search.grow-"  # begin of the name of the compiled search of gap crossings


def write() -> None:
    """Write the mark; without it, the next warm-up looks at every function again."""
    with suppress(OSError):
        whole_files.make_folder(MARK.parent)
        files = (str(path.relative_to(_PACKAGE)) for path in _files(".nbi"))
        whole_files.write_text(MARK, "\n".join((_fingerprint(), *files)))


def is_complete(whole: bool) -> bool:
    """Return whether nothing has changed since the last warm-up: source, compiled code, versions and processor.

    `whole` is whether it must have included the search of gap crossings.
    """
    if "NUMBA_CACHE_DIR" in os.environ:  # the compiled code is not next to its source
        return False
    with suppress(OSError):
        mark, *files = MARK.read_text(encoding="utf-8").split("\n")
        searched = any(Path(name).name.startswith(_SEARCH) for name in files)
        return mark == _fingerprint() and (searched or not whole) and all((_PACKAGE / name).exists() for name in files)
    return False


def _fingerprint() -> str:
    """Return a digest of all that decides whether Numba finds its compiled code."""
    from sextant.shared.runtime.compiled import processor

    digest = hashlib.blake2s(repr((sys.implementation.cache_tag, version("numba"), processor())).encode())
    for path in _files(".py"):
        digest.update(repr((str(path.relative_to(_PACKAGE)), path.read_bytes())).encode())
    return digest.hexdigest()


def _files(suffix: str) -> Iterator[Path]:
    """Yield the files of the package with a suffix, in a fixed order."""
    for folder, folders, names in os.walk(_PACKAGE, followlinks=True):
        folders.sort()
        yield from (Path(folder, name) for name in sorted(names) if name.endswith(suffix))
