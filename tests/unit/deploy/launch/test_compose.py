import json
import re
import shutil
import subprocess
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from sextant import deploy
from sextant.deploy import cli
from sextant.deploy.launch.compose import (
    KEYS,
    NOTIFY_SOCKET,
    WARM_UP,
    compose_commands,
    compose_yaml,
    offboard_commands,
    offboard_yaml,
)
from sextant.deploy.launch.process_table import TABLE
from sextant.deploy.terminal.arguments import parse
from sextant.shared.files.config import ConfigError
from sextant.shared.wire.access import AUTHORITY, CERTIFICATE, KEY, ROLE
from tests.support.composed import commands_of, services_of

DEPLOY = Path(deploy.__file__).resolve().parent
ROOT = DEPLOY.parent
VARIABLES = {"SEXTANT_ROBOT": "tls/robot.local:7448", "SEXTANT_KEYS": "/home/me/keys/base"}
MADE = {"compose.yaml": compose_yaml("steps", 3), "compose.offboard.yaml": offboard_yaml()}
COMMANDS = {"compose.yaml": compose_commands("steps", 3), "compose.offboard.yaml": offboard_commands()}


@pytest.fixture(params=sorted(MADE))
def file(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_committed_compose_file_equals_generated_one(file: str) -> None:
    option = " --offboard" if "offboard" in file else ""
    assert (DEPLOY / file).read_text() == MADE[file], f"run `sextant service compose{option} > deploy/{file}`"


def test_compose_services_match_process_table(file: str) -> None:
    composed = yaml.safe_load(MADE[file])["services"]
    assert list(composed) == [c.name for c in COMMANDS[file]]
    for command in COMMANDS[file]:
        service = composed[command.name]
        assert service["command"] == ["python", *command.arguments]
        assert service["environment"] == dict(command.environment)
        assert service["network_mode"] == "host"
        assert set(service.get("depends_on", {})) == set(command.after)
        assert service["mem_limit"] == f"{command.memory_mb}m"


def test_offboard_file_has_only_off_robot_processes() -> None:
    offboard = {p.name for p in TABLE if p.side in ("either", "page")}
    assert {c.name for c in offboard_commands()} == offboard | {"router"}


def test_commands_parsed_from_file_match_table_without_watchdog() -> None:
    unwatched = tuple(replace(command, watchdog_s=0.0) for command in compose_commands("flat", 5))
    assert commands_of(compose_yaml("flat", 5)) == unwatched


def test_each_dependency_has_healthcheck(file: str) -> None:
    services = services_of(MADE[file], VARIABLES)
    for service in services.values():
        for name, wanted in service.get("depends_on", {}).items():
            if name == WARM_UP:
                assert wanted == {"condition": "service_completed_successfully"}
            else:
                assert wanted == {"condition": "service_healthy"}
                assert services[name]["healthcheck"]["test"][0] == "CMD"


def test_watchdog_timeouts_match_process_table(file: str) -> None:
    patience = {p.name: p.watchdog_s for p in TABLE}
    for name, service in services_of(MADE[file], VARIABLES).items():
        if name not in patience:
            continue
        assert service["environment"]["NOTIFY_SOCKET"] == NOTIFY_SOCKET
        assert int(service["environment"]["WATCHDOG_USEC"]) == patience[name] * 1e6
        assert service["healthcheck"]["test"][:4] == ["CMD", "python", "-m", "sextant.deploy.launch.healthcheck"]
        assert float(service["healthcheck"]["timeout"].removesuffix("s")) > patience[name]


def test_containers_have_minimal_privileges(file: str) -> None:
    for service in services_of(MADE[file], VARIABLES).values():
        assert service["read_only"]
        assert service["cap_drop"] == ["ALL"]
        assert not service["user"].startswith("0")
        assert service["tmpfs"] == ["/tmp:mode=1777"], "where its health check listens"
        assert service["pids_limit"] > 0
        assert "ulimits" not in service, "no real-time priority in simulation"


def test_only_router_receives_certificates_as_secrets() -> None:
    services, secrets = services_of(MADE["compose.offboard.yaml"], VARIABLES), _top("secrets")
    given = services.pop("router")["secrets"]
    assert {secret["target"] for secret in given} == {f"{KEYS}/{name}" for name in (AUTHORITY, CERTIFICATE, KEY, ROLE)}
    assert all(secrets[secret["source"]]["file"].endswith(Path(secret["target"]).name) for secret in given)
    assert not any("secrets" in service for service in services.values())


def test_container_volumes_are_declared(file: str) -> None:
    volumes = yaml.safe_load(MADE[file])["volumes"]
    for service in services_of(MADE[file], VARIABLES).values():
        named = [volume.partition(":")[0] for volume in service.get("volumes", ()) if isinstance(volume, str)]
        assert set(named) <= set(volumes)


def test_missing_compose_variables_are_named() -> None:
    for name in VARIABLES:
        with pytest.raises(KeyError, match=name):
            services_of(MADE["compose.offboard.yaml"], {k: v for k, v in VARIABLES.items() if k != name})


def test_all_services_connect_to_started_router(file: str) -> None:
    words = {name: s["command"] for name, s in services_of(MADE[file], VARIABLES).items() if name != WARM_UP}
    (listen,) = [word for word in words.pop("router") if word.startswith("tcp/")]
    assert all(listen in command for command in words.values())


def test_each_service_image_is_a_dockerfile_target(file: str) -> None:
    services, targets = services_of(MADE[file], VARIABLES), _targets()
    build = services["router"]["build"]
    assert (DEPLOY / build["context"] / build["dockerfile"]).resolve() == DEPLOY / "Dockerfile"
    assert build["target"] in targets
    assert {service["image"] for service in services.values()} == {f"sextant-{build['target']}"}


def test_images_install_pinned_wheels_of_their_extra() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    targets = _targets()
    assert set(targets) == {"base", "wheel", "actuator", "onboard", "offboard", "simulator", "all", "demo"}
    for name in set(targets) - {"base", "wheel", "demo"}:
        assert name in extras
        (install,) = [line for line in targets[name].splitlines() if "pip install" in line]
        assert install.endswith(f'sextant-*.whl)[{name}]"')
        assert "--no-index --find-links /wheels" in install
        assert "USER 1000:1000" in targets[name].splitlines()
    (download,) = [line for line in targets["wheel"].splitlines() if "pip download" in line]
    for option in ("--require-hashes", "--only-binary :all:", "--requirement /requirements.txt", "--dest /wheels"):
        assert option in download
    command = json.loads(targets["demo"].removeprefix("CMD "))
    assert parse(cli.sextant, "sextant", command[1:]).path == "sextant demo"
    assert not re.search(r"gcc|build-essential|g\+\+", "".join(targets.values()))
    assert re.search(r"^FROM python:\d+\.\d+\.\d+-slim-\w+ AS base$", (DEPLOY / "Dockerfile").read_text(), re.MULTILINE)


def test_dockerignore_admits_all_copied_paths() -> None:
    sent = re.findall(r"^!(.+)$", (DEPLOY / "Dockerfile.dockerignore").read_text(), re.MULTILINE)
    copied = re.findall(r"^COPY (.+) \S+$", (DEPLOY / "Dockerfile").read_text(), re.MULTILINE)
    copied += re.findall(r"source=(\w\S+?),", (DEPLOY / "Dockerfile").read_text())
    assert {word for words in copied for word in words.split()} == set(sent)
    assert all((ROOT / name).exists() for name in sent)


def test_scenario_outside_containers_is_refused() -> None:
    for path in ("/tmp/mine.toml", "/tmp/mine.toml+sun", "/tmp/family.toml@0.05"):
        with pytest.raises(ConfigError, match="containers cannot read"):
            compose_yaml(path, 3)
    with pytest.raises(ConfigError, match="no scenario 'nope'"):
        compose_yaml("nope", 3)


def test_docker_compose_accepts_file(file: str) -> None:
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "compose", "version"], capture_output=True, check=False).returncode:
        pytest.skip("docker has no `compose` here, so it is not asked whether it takes the file; install docker-compose-plugin")
    words = [docker, "compose", "--file", str(DEPLOY / file), "config", "--quiet"]
    done = subprocess.run(words, env=VARIABLES, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def _top(key: str) -> dict[str, Any]:
    table = yaml.safe_load(MADE["compose.offboard.yaml"])[key]
    assert isinstance(table, dict)
    return table


def _targets() -> dict[str, str]:
    """Return the text of each target of the Dockerfile."""
    parts = re.split(r"^FROM \S+ AS (\w+)\n", (DEPLOY / "Dockerfile").read_text(), flags=re.MULTILINE)[1:]
    return {name: text.strip() for name, text in zip(parts[::2], parts[1::2], strict=True)}
