"""compose.yaml read back as the launcher's commands, so that a test can start exactly what it says without containers."""

import re

import yaml

from deploy.process_table import Command


def commands_of(text: str) -> tuple[Command, ...]:
    """The commands, environments, restarts and dependencies of a compose file."""
    found = []
    for name, service in yaml.safe_load(text)["services"].items():
        interpreter, *arguments = service["command"]
        assert interpreter == "python"
        restarts = re.fullmatch(r"on-failure:(\d+)", service["restart"])
        probe = re.search(r"port_taken\((\d+)\)", " ".join(service.get("healthcheck", {}).get("test", [])))
        found.append(
            Command(
                name,
                tuple(arguments),
                service["environment"],
                restarts=int(restarts[1]) if restarts else 0,
                after=tuple(service.get("depends_on", {})),
                ready_port=int(probe[1]) if probe else 0,
            )
        )
    return tuple(found)
