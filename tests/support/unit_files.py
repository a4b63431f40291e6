"""Read systemd units as systemd does."""

import re


def read_unit(text: str) -> dict[str, dict[str, list[str]]]:
    """Return section -> key -> values, in their order."""
    found: dict[str, dict[str, list[str]]] = {}
    section: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line.startswith("["):
            section = found.setdefault(line.strip("[]"), {})
        elif line and not line.startswith(("#", ";")):
            key, equals, value = line.partition("=")
            assert equals, line
            section.setdefault(key, []).append(value)
    return found


def words_of(value: str) -> list[str]:
    """Return the words of a command line or of an Environment=.

    They are those that the process receives, by systemd.service(5), "Command lines".
    """
    words = []
    for quoted, bare in re.findall(r'"((?:[^"\\]|\\.)*)"|(\S+)', value):
        word = re.sub(r"\\(.)", lambda found: {"n": "\n", "t": "\t"}.get(found[1], found[1]), quoted) if quoted else bare
        words.append(word.replace("%%", "%").replace("$$", "$"))
    return words
