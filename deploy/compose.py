"""compose.yaml of a local launch, made from the process table: the same commands and environments, a container each.

YAML is written by hand, its scalars as JSON, which YAML contains: the one thing to write does not need a library.
"""

import json
from dataclasses import replace

from deploy.process_table import ENVIRONMENT, ROUTER_ENDPOINT, Choices, Command, choices, commands, router_command, rows
from shared.config import ConfigError
from shared.scenario import load_scenario
from shared.transport import Endpoints

NAMESPACE = "sextant"
_HEAD = """\
# Made by `sextant compose`; change deploy/process_table.py and make it again.
# docker compose up --build --exit-code-from operator
name: sextant

x-image: &image
  image: sextant
  network_mode: host
  init: true
  environment:
{environment}

services:
"""
_BUILD = """\
    build:
      context: ..
      dockerfile_inline: |
        FROM python:3.12-slim
        WORKDIR /sextant
        COPY . .
        RUN pip install --no-cache-dir '.[all]'
"""
_LATCHED = ("actuator", "stop")  # they share the file that says that torque is to be off
_VOLUMES = """\

volumes:
  latch: {driver_opts: {type: tmpfs, device: tmpfs}}
"""
_PROBE = "import sys; from deploy.launcher import port_taken; sys.exit(not port_taken({port}))"


def compose_commands(scenario: str, seed: int) -> tuple[Command, ...]:
    """What compose starts: the router, the services, and an operator that runs the scenario on them."""
    if scenario.endswith(".toml"):
        raise ConfigError(
            "scenario", ["the name of a scenario that comes with sextant expected: containers do not see the file"]
        )
    chosen: Choices = choices(load_scenario(scenario), scenario, seed)
    endpoints = Endpoints((ROUTER_ENDPOINT,), namespace=NAMESPACE)
    services = commands(rows("all", simulated=True), chosen, endpoints)
    operator = Command(
        "operator",
        (
            *("-m", "deploy.cli", "run", scenario, "--seed", str(seed)),
            *("--connect", ROUTER_ENDPOINT, "--namespace", NAMESPACE, "--out", "runs/compose"),
        ),
        ENVIRONMENT,
        after=("router",),
    )
    return (
        router_command(ROUTER_ENDPOINT),
        *(replace(command, after=("router", *command.after)) for command in services),
        operator,
    )


def compose_yaml(scenario: str, seed: int) -> str:
    """The text of compose.yaml.

    Raises:
        ConfigError: No such scenario.
    """
    environment = "\n".join(f"    {key}: {json.dumps(value)}" for key, value in ENVIRONMENT.items())
    return _HEAD.format(environment=environment) + "\n".join(_service(c) for c in compose_commands(scenario, seed)) + _VOLUMES


def _service(command: Command) -> str:
    lines = [f"  {command.name}:", "    <<: *image"]
    if command.name == "router":
        lines += _BUILD.rstrip("\n").split("\n")
    lines += [f"    command: {json.dumps(['python', *command.arguments])}"]
    lines += [f"    restart: {json.dumps(f'on-failure:{command.restarts}' if command.restarts else 'no')}"]
    if command.after:
        lines += ["    depends_on:"]
        lines += [f"      {name}: {{condition: service_healthy}}" for name in command.after]
    if command.ready_port:
        probe = json.dumps(["CMD", "python", "-c", _PROBE.format(port=command.ready_port)])
        lines += ["    healthcheck:", f"      test: {probe}", "      interval: 1s", "      retries: 60"]
    if "--urgent" in command.arguments:
        lines += ["    ulimits: {rtprio: 10}"]
    if command.name in _LATCHED:
        lines += ['    volumes: ["latch:/tmp"]']
    if command.name == "operator":
        lines += ['    volumes: ["../runs:/sextant/runs"]']
    return "\n".join(lines) + "\n"
