"""Each command of docs/deployment.md is run by a test, or listed there as not run."""

import re
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.deploy.launch.process_table import TABLE, router_command
from tests.test_readme import commands

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "deployment.md").read_text(encoding="utf-8")
COMMANDS = list(commands(PAGE))
NOT_RUN = set(re.findall(r"^\| `(\S+)` \| \S.*\|$", PAGE.partition("Not run, and why:")[2], re.MULTILINE))
RUN_BY = {
    "doctor": "tests/unit/deploy/test_cli.py::test_the_doctor_fails_when_a_check_does",
    "keys new": "tests/live/test_live_walk.py::"
    "test_what_compose_offboard_yaml_starts_walks_a_robot_by_certificates_and_each_of_its_services_is_healthy",
    "service install": "tests/live/test_services.py::"
    "test_what_the_units_start_is_ready_in_order_gives_signs_of_life_and_ends_when_asked",
    "service uninstall": "tests/unit/deploy/launch/test_units.py::test_the_command_writes_prints_what_is_next_and_removes",
    "up offboard": "tests/live/test_live_walk.py::test_two_machines_walk_together_whichever_is_there_first",
    "order stand": "tests/live/test_live_walk.py::test_services_that_are_up_walk_for_whoever_joins_them",
    "order walk": "tests/live/test_live_walk.py::test_services_that_are_up_walk_for_whoever_joins_them",
    "order sit": "tests/live/test_live_walk.py::test_services_that_are_up_walk_for_whoever_joins_them",
}


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_command_is_run_by_a_test_or_named_as_not_run(words: list[str]) -> None:
    if words[0] != "sextant":
        assert words[0] in NOT_RUN
        return
    assert callable(cli.parse(words[1:]).command)
    way = " ".join(words[1:3]) if " ".join(words[1:3]) in RUN_BY else words[1]
    file, _, name = RUN_BY[way].partition("::")
    assert re.search(rf"^def {name}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), f"{name} is not there"


def test_nothing_is_named_as_not_run_that_is_not_there() -> None:
    assert {words[0] for words in COMMANDS} - {"sextant"} == NOT_RUN


def test_the_limits_are_those_of_the_table_and_leave_room_over_what_was_measured() -> None:
    limits = {p.name: p.memory_mb for p in TABLE if p.side != "device"}
    limits["router"] = router_command("tcp/127.0.0.1:7447").memory_mb
    rows = re.findall(r"^\| (\w+) \| (\d+) \| \d+ \| (\d+) \|$", PAGE, re.MULTILINE)
    assert {name: int(limit) for name, _, limit in rows} == limits
    assert all(2 * int(measured) < int(limit) for _, measured, limit in rows)
