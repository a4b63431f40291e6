from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

import deploy
from deploy.compose import compose_commands, compose_yaml
from shared.config import ConfigError
from tests.support.composed import commands_of

COMMITTED = Path(deploy.__file__).parent / "compose.yaml"


@pytest.fixture(scope="module")
def composed() -> dict[str, Any]:
    table = yaml.safe_load(compose_yaml("steps", 3))
    assert isinstance(table, dict)
    return table


def test_the_committed_file_is_the_generated_one() -> None:
    assert COMMITTED.read_text() == compose_yaml("steps", 3), "run `sextant compose > deploy/compose.yaml`"


def test_it_starts_exactly_the_table(composed: dict[str, Any]) -> None:
    made = compose_commands("steps", 3)
    assert list(composed["services"]) == [c.name for c in made]
    for command in made:
        service = composed["services"][command.name]
        assert service["command"] == ["python", *command.arguments]
        assert service["environment"] == dict(command.environment)
        assert service["network_mode"] == "host"
        assert set(service.get("depends_on", {})) == set(command.after)


def test_commands_read_back_from_the_file_are_those_of_the_table_but_that_containers_are_not_watched() -> None:
    unwatched = tuple(replace(command, watchdog_s=0.0) for command in compose_commands("flat", 5))
    assert commands_of(compose_yaml("flat", 5)) == unwatched


def test_what_is_waited_for_can_become_healthy(composed: dict[str, Any]) -> None:
    for service in composed["services"].values():
        for name, wanted in service.get("depends_on", {}).items():
            assert wanted == {"condition": "service_healthy"}
            assert composed["services"][name]["healthcheck"]["test"][0] == "CMD"


def test_all_meet_at_the_router_it_starts(composed: dict[str, Any]) -> None:
    words = {name: service["command"] for name, service in composed["services"].items()}
    (listen,) = [word for word in words.pop("router") if word.startswith("tcp/")]
    assert all(listen in command for command in words.values())


def test_a_scenario_that_containers_cannot_see_is_refused() -> None:
    with pytest.raises(ConfigError, match="containers do not see"):
        compose_yaml("/tmp/mine.toml", 3)
    with pytest.raises(ConfigError, match=r"known: .*flat"):
        compose_yaml("nope", 3)
