"""Read a compose file as the launcher's commands, to start it without containers."""

import re
from collections.abc import Mapping
from typing import Any

import yaml

from sextant.deploy.launch.process_table import Command

_FOR_EVER = 99


def services_of(text: str, variables: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the services of a compose file by name, with variables substituted."""
    services = yaml.safe_load(_interpolated(text, variables or {}))["services"]
    assert isinstance(services, dict)
    return services


def commands_of(
    text: str, variables: Mapping[str, str] | None = None, mounts: Mapping[str, str] | None = None
) -> tuple[Command, ...]:
    """Return the commands, environments, restarts and dependencies of a compose file.

    Args:
        text: Content of the file.
        variables: Environment of the shell that starts compose.
        mounts: Path as a container sees it -> this machine's; `NAME` in the latter is the service's name.
    """
    found = []
    for name, service in services_of(text, variables).items():

        def seen(word: str, name: str = name) -> str:
            for inside, outside in (mounts or {}).items():
                word = word.replace(inside, outside.replace("NAME", name))
            return word

        interpreter, *arguments = service["command"]
        assert interpreter == "python"
        restarts = re.fullmatch(r"on-failure:(\d+)", service["restart"])
        probe = re.search(r"--port (\d+)", " ".join(service.get("healthcheck", {}).get("test", [])))
        found.append(
            Command(
                name,
                tuple(seen(word) for word in arguments),
                {key: seen(value) for key, value in service["environment"].items()},
                restarts=int(restarts[1]) if restarts else _FOR_EVER if service["restart"] == "unless-stopped" else 0,
                after=tuple(service.get("depends_on", {})),
                ready_port=int(probe[1]) if probe else 0,
                memory_mb=int(service["mem_limit"].removesuffix("m")),
            )
        )
    return tuple(found)


def _interpolated(text: str, variables: Mapping[str, str]) -> str:
    """Substitute ${NAME:-default} and ${NAME:?message}.

    As in compose, the second form raises an error if the variable has no value.
    """

    def value(found: re.Match[str]) -> str:
        name, kind, rest = found.groups()
        if kind == ":?" and name not in variables:
            raise KeyError(f"{name}: {rest}")
        return variables.get(name, rest)

    return re.sub(r"\$\{(\w+)(:[-?])([^}]*)\}", value, "\n".join(_code(line) for line in text.splitlines()))


def _code(line: str) -> str:
    return "" if line.startswith("#") else line
