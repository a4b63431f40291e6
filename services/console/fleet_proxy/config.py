"""Settings of the fleet proxy: its address, and the consoles behind it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from sextant.services.console import config as console
from sextant.shared.files import config

_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9_-]{0,30}[A-Za-z0-9])?")


def is_name(text: str) -> bool:
    """Return whether a text is a valid robot name, as a part of URLs and Zenoh keys."""
    return _NAME.fullmatch(text) is not None


@dataclass(frozen=True, slots=True)
class Settings:
    """Address and token of the proxy, and the ports of the consoles."""

    host: str = "127.0.0.1"  # to listen on, with the rules of the console's setting
    port: int = 8080
    token: str = ""  # token of browsers, the same as in the settings of all consoles
    robots: dict[str, int] = field(default_factory=dict)  # robot name -> port of its console on 127.0.0.1

    checks = (
        config.Check(("robots",), lambda robots: _misfits(robots)),
        config.together("robots", lambda robots: len(robots) > 0, "at least one robot, name = port,"),
    )

    def __post_init__(self) -> None:
        config.verify(self)
        self.web_settings()

    def web_settings(self) -> console.Settings:
        """Return console settings with the same address and token."""
        return console.Settings(host=self.host, port=self.port, token=self.token)


def _misfits(robots: Mapping[str, int]) -> list[config.Misfit]:
    expected = "letters, digits, - and _ as a name, and a TCP port from 1 to 65535"
    return [
        config.Misfit(f"robots.{name}", expected, repr(port))
        for name, port in robots.items()
        if not (is_name(name) and isinstance(port, int) and 1 <= port <= 65535)
    ]
