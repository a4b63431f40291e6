"""Compose files, made from the process table: one container per process.

Commands and environments are the same as everywhere else. `compose.yaml` is a local launch with a simulated robot.
`compose.offboard.yaml` holds the offboard processes, with a router chained to the robot's. The YAML is written by hand with
JSON scalars, which are valid YAML, so no library is needed.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from sextant.deploy.launch.process_table import (
    ENVIRONMENT,
    ROUTER_ENDPOINT,
    Choices,
    Command,
    choices,
    commands,
    router_command,
    rows,
)
from sextant.services.actuator.safety.torque_off_latch import SHARED
from sextant.shared.files.config import ConfigError
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY, ROLE
from sextant.shared.wire.transport import Endpoints

NAMESPACE = "sextant"
KEYS = "/run/secrets/sextant"  # where a container finds its machine's certificates
RECORDINGS = "/recordings"
CACHE = "/cache"  # for compiled code
NOTIFY_SOCKET = "/tmp/notify"  # signs of life arrive there while a health check listens
WARM_UP = "warm-up"  # ends once everything is compiled
_LATCHED = ("actuator", "stop")
PIDS = 128  # limit of processes and threads per container; the measured maximum is 55
_HANG_S = 5.0  # [s] a health check may take in addition to its wait for a sign of life
_HEAD = """\
# Made by `sextant service compose{option}`; change process_table.py or compose.py in deploy/launch, and make it again.
{usage}
name: {name}

x-image: &image
  image: sextant-{target}
  user: "${{SEXTANT_USER:-1000:1000}}"
  network_mode: host
  init: true
  read_only: true
  cap_drop: [ALL]
  security_opt: ["no-new-privileges:true"]
  tmpfs: ["/tmp:mode=1777"]

services:
"""
_USAGE = "# mkdir -p runs && docker compose -f deploy/compose.yaml up --build --exit-code-from operator"
_USAGE_OFFBOARD = """\
# SEXTANT_ROBOT=tls/robot.local:7448 SEXTANT_KEYS=$PWD/keys/base SEXTANT_USER=$(id -u):$(id -g) \\
#   docker compose -f deploy/compose.offboard.yaml up --build --detach"""
_ROBOT = "${SEXTANT_ROBOT:?the endpoint of the robot, tls/robot.local:7448}"
_KEY_FOLDER = "${SEXTANT_KEYS:?the folder keys/base of sextant keys new, by its whole path}"


@dataclass(frozen=True, slots=True)
class _Kind:
    """Common properties of the services of one compose file."""

    target: str  # target of the Dockerfile
    restart: str = ""  # restart policy that replaces the table's number of restarts
    secrets: Mapping[str, str] = field(default_factory=dict)  # file in the folder of keys -> mount path


_LOCAL = _Kind("all")
_OFFBOARD = _Kind(
    "offboard",
    restart="unless-stopped",
    secrets={file: f"{KEYS}/{file}" for file in (AUTHORITY, CERTIFICATE, KEY, ROLE)},
)


def compose_commands(scenario: str, seed: int) -> tuple[Command, ...]:
    """Return the commands of compose.yaml.

    They are the router, the services, and an operator that runs the scenario on them.
    """
    if ".toml" in scenario:
        raise ConfigError(
            "scenario", ["the name of a scenario that comes with sextant expected; containers cannot read a file"]
        )
    chosen: Choices = choices(load_scenario(scenario), scenario, seed)
    services = commands(rows("all", simulated=True), chosen, _ENDPOINTS)
    operator = Command(
        "operator",
        (
            *("-m", "sextant.deploy.cli", "run", scenario, "--seed", str(seed)),
            *("--connect", ROUTER_ENDPOINT, "--namespace", NAMESPACE, "--out", "runs/compose"),
        ),
        ENVIRONMENT,
        memory_mb=1024,
    )
    # The warm-up compiles once for all services; otherwise each would compile for itself at the same time.
    warm_up = Command(WARM_UP, ("-m", "sextant.deploy.launch.warm_up"), ENVIRONMENT, memory_mb=2048)
    waiting = [replace(command, after=(WARM_UP, *command.after)) for command in (*services, operator)]
    return _together(router_command(ROUTER_ENDPOINT), (warm_up, *waiting))


def offboard_commands() -> tuple[Command, ...]:
    """Return the commands of compose.offboard.yaml.

    They are a router chained to the robot's, and the processes of the role offboard.
    """
    chosen = Choices(recordings=RECORDINGS)
    processes = rows("offboard", simulated=False, page=True)
    services = commands(processes, chosen, _ENDPOINTS, elsewhere=True)
    words = ("--listen", ROUTER_ENDPOINT, "--connect", _ROBOT, "--namespace", NAMESPACE, "--keys", KEYS)
    return _together(router_command(ROUTER_ENDPOINT, words, "offboard", processes), services)


def compose_yaml(scenario: str, seed: int) -> str:
    """Return the text of compose.yaml.

    Raises:
        ConfigError: No such scenario.
    """
    option = "" if (scenario, seed) == ("steps", 3) else f" --scenario {scenario} --seed {seed}"
    head = _HEAD.format(option=option, usage=_USAGE, name="sextant", target=_LOCAL.target)
    volumes = ["cache: {}", 'latch: {driver_opts: {type: tmpfs, device: tmpfs, o: "mode=1777"}}']
    return head + _body(compose_commands(scenario, seed), _LOCAL, volumes)


def offboard_yaml() -> str:
    """Return the text of compose.offboard.yaml."""
    head = _HEAD.format(option=" --offboard", usage=_USAGE_OFFBOARD, name="sextant-offboard", target=_OFFBOARD.target)
    return head + _body(offboard_commands(), _OFFBOARD, ["cache: {}", "recordings: {}"])


_ENDPOINTS = Endpoints((ROUTER_ENDPOINT,), namespace=NAMESPACE)


def _together(router: Command, others: Sequence[Command]) -> tuple[Command, ...]:
    """Make all commands wait for the router and send signs of life.

    The health checks receive the signs of life.
    """
    return (_watched(router), *(_watched(replace(command, after=("router", *command.after))) for command in others))


def _watched(command: Command) -> Command:
    if not command.watchdog_s:
        return command
    told = {"NOTIFY_SOCKET": NOTIFY_SOCKET, "WATCHDOG_USEC": str(round(command.watchdog_s * 1e6))}
    return replace(command, environment={**command.environment, **told})


def _body(made: Sequence[Command], kind: _Kind, volumes: Sequence[str]) -> str:
    services = "\n".join(_service(command, kind) for command in made)
    lines = ["", "volumes:", *(f"  {volume}" for volume in volumes)]
    if kind.secrets:
        lines += [
            "",
            "secrets:",
            *(f"  {_secret(file)}: {{file: {json.dumps(f'{_KEY_FOLDER}/{file}')}}}" for file in kind.secrets),
        ]
    return services + "\n".join(lines) + "\n"


def _service(command: Command, kind: _Kind) -> str:
    lines = [f"  {command.name}:", "    <<: *image"]
    if command.name == "router":
        lines += [f"    build: {{context: .., dockerfile: deploy/Dockerfile, target: {kind.target}}}"]
    lines += [f"    command: {json.dumps(['python', *command.arguments])}"]
    lines += ["    environment:", *(f"      {key}: {json.dumps(value)}" for key, value in command.environment.items())]
    lines += [f"    restart: {json.dumps(_restart(command, kind))}"]
    if command.after:
        lines += ["    depends_on:"]
        lines += [f"      {name}: {{condition: {_condition(name)}}}" for name in command.after]
    lines += _health(command)
    lines += [f"    mem_limit: {command.memory_mb}m", f"    pids_limit: {PIDS}"]
    if found := _volumes(command):
        lines += ["    volumes:", *(f"      - {volume}" for volume in found)]
    if kind.secrets and KEYS in command.arguments:
        lines += ["    secrets:"]
        lines += [f"      - {{source: {_secret(file)}, target: {target}}}" for file, target in kind.secrets.items()]
    return "\n".join(lines) + "\n"


def _restart(command: Command, kind: _Kind) -> str:
    return kind.restart or (f"on-failure:{command.restarts}" if command.restarts else "no")


def _condition(name: str) -> str:
    return "service_completed_successfully" if name == WARM_UP else "service_healthy"


def _health(command: Command) -> list[str]:
    """Return the lines of a health check; it ends a hung process.

    It checks that the port is open and that signs of life arrive.
    """
    if not (command.ready_port or command.watchdog_s):
        return []
    port = ("--port", str(command.ready_port)) if command.ready_port else ()
    ends = ("--end-hung",) if command.watchdog_s else ()
    return [
        "    healthcheck:",
        f"      test: {json.dumps(['CMD', 'python', '-m', 'sextant.deploy.launch.healthcheck', *port, *ends])}",
        "      interval: 10s",
        f"      timeout: {round(command.watchdog_s + _HANG_S)}s",
        "      retries: 1",
        "      start_period: 600s",  # code may have to be compiled first
        "      start_interval: 1s",
    ]


def _volumes(command: Command) -> list[str]:
    """Return the volumes that a container shares with others or keeps."""
    found = [f"latch:{SHARED}"] if command.name in _LATCHED else []
    if command.name not in ("router", "actuator", "stop", "console", "recorder"):
        found += [f"cache:{CACHE}"]  # cache of compiled code
    if command.name == "recorder":
        found += [f"recordings:{RECORDINGS}"]
    if command.name == "operator":
        found += ["{type: bind, source: ../runs, target: /sextant/runs, bind: {create_host_path: false}}"]
    return found


def _secret(file: str) -> str:
    return file.partition(".")[0]
