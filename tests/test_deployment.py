"""Each command of docs/deployment.md is run by a test, or listed there as not run."""

import re
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.deploy.launch.process_table import TABLE, router_command
from sextant.deploy.terminal.arguments import parse
from tests.test_readme import commands

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "deployment.md").read_text(encoding="utf-8")
COMMANDS = list(commands(PAGE))
NOT_RUN = set(re.findall(r"^\| `(\S+)` \| \S.*\|$", PAGE.partition("Not run, and why:")[2], re.MULTILINE))
RUN_BY = {
    "doctor": "tests/unit/deploy/test_cli.py::test_doctor_exit_code_follows_failed_checks",
    "keys new": "tests/live/test_live_walk.py::test_offboard_compose_services_walk_secured_robot",
    "service install": "tests/live/test_services.py::test_systemd_units_start_in_order_pulse_and_stop",
    "service uninstall": "tests/unit/deploy/launch/test_units.py::"
    "test_service_command_installs_prints_next_step_and_uninstalls",
    "up offboard": "tests/live/test_live_walk.py::test_onboard_and_offboard_start_in_either_order",
    "order stand": "tests/live/test_live_walk.py::test_attached_run_walks_with_running_services",
    "order walk": "tests/live/test_live_walk.py::test_attached_run_walks_with_running_services",
    "order sit": "tests/live/test_live_walk.py::test_attached_run_walks_with_running_services",
}


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_deployment_command_is_tested_or_listed_as_not_run(words: list[str]) -> None:
    if words[0] != "sextant":
        assert words[0] in NOT_RUN
        return
    assert parse(cli.sextant, "sextant", words[1:]).path.startswith("sextant ")
    way = " ".join(words[1:3]) if " ".join(words[1:3]) in RUN_BY else words[1]
    file, _, name = RUN_BY[way].partition("::")
    assert re.search(rf"^def {name}\(", (ROOT / file).read_text(encoding="utf-8"), re.MULTILINE), f"{name} is not there"


def test_commands_listed_as_not_run_are_on_page() -> None:
    assert {words[0] for words in COMMANDS} - {"sextant"} == NOT_RUN


def test_memory_limits_match_table_with_factor_two_margin() -> None:
    limits = {p.name: p.memory_mb for p in TABLE if p.side != "device"}
    limits["router"] = router_command("tcp/127.0.0.1:7447").memory_mb
    rows = re.findall(r"^\| (\w+) \| (\d+) \| \d+ \| (\d+) \|$", PAGE, re.MULTILINE)
    assert {name: int(limit) for name, _, limit in rows} == limits
    assert all(2 * int(measured) < int(limit) for _, measured, limit in rows)
