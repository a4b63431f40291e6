"""Settings of the lobby: where it listens, and whose pages it leads to."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from sextant.services.console import config as console
from sextant.shared.files import config

_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9_-]{0,30}[A-Za-z0-9])?")


def is_name(text: str) -> bool:
    """Whether a text may name a robot: it is a part of addresses of pages, and of keys."""
    return _NAME.fullmatch(text) is not None


@dataclass(frozen=True, slots=True)
class Settings:
    """Where the lobby is, and the consoles behind it."""

    host: str = "127.0.0.1"  # to listen on, as the console's
    port: int = 8080
    token: str = ""  # as the console's, which all behind it have, too
    robots: dict[str, int] = field(default_factory=dict)  # name of a robot -> port of 127.0.0.1 on which its console listens

    checks = (
        config.Check(("robots",), lambda robots: _misfits(robots)),
        config.together("robots", lambda robots: len(robots) > 0, "one robot at least, name = port,"),
    )

    def __post_init__(self) -> None:
        config.verify(self)
        self.door()

    def door(self) -> console.Settings:
        """The same, as the settings of a console that listens there."""
        return console.Settings(host=self.host, port=self.port, token=self.token)


def _misfits(robots: Mapping[str, int]) -> list[config.Misfit]:
    expected = "letters, digits, - and _ as a name, and a TCP port from 1 to 65535"
    return [
        config.Misfit(f"robots.{name}", expected, repr(port))
        for name, port in robots.items()
        if not (is_name(name) and isinstance(port, int) and 1 <= port <= 65535)
    ]
