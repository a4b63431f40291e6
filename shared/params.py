"""Base of parameters: frozen dataclasses that a user may tune.

Each algorithm declares its parameters in the `params.py` of its folder. The comment of a field states unit, meaning and source;
`ranged` declares default and allowed range. `docs/parameters.md` leads to all of them.
"""

from sextant.shared.files import config


class Params:
    """Base of a parameter table; making one checks the ranges of its fields and its `checks`."""

    __slots__ = ()

    def __post_init__(self) -> None:
        config.verify(self)
