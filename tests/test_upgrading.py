"""The page on the change from 0.1 names what the program has, and the program's errors name what the page says."""

import re
from pathlib import Path

import pytest

from sextant.deploy import cli
from sextant.evaluation import params
from sextant.evaluation.report import Report
from sextant.services.actuator.config import ActuatorParams
from sextant.services.planner.config import PlannerParams
from sextant.shared.files.config import ConfigError, as_table
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import messages, topics

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "upgrading.md").read_text(encoding="utf-8")
ROWS = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in PAGE.splitlines() if line.startswith("| ")]
SETTINGS = {row[0].strip("`"): row[1].split("`")[1] for row in ROWS if re.match(r"`(planner|actuator)\.", row[0])}
RENAMED = {
    f"{service}.{old}": f"{service}.{new}"
    for service, schema in (("planner", PlannerParams), ("actuator", ActuatorParams))
    for old, new in schema.renamed.items()
}
FIELDS = [row for row in ROWS if hasattr(messages, row[0]) and row[1]]
MODULES = sorted(set(re.findall(r"`(sextant\.(?:shared|evaluation)\.[a-z_.]+)`", PAGE)))


def names(cell: str) -> list[str]:
    return re.findall(r"`(\w+)`", cell.partition(";")[0].partition(":")[0])


def test_page_has_every_renamed_setting() -> None:
    assert SETTINGS == RENAMED


@pytest.mark.parametrize("old", sorted(RENAMED))
def test_error_of_an_old_setting_names_the_new_one(old: str) -> None:
    table = as_table(params.DEFAULTS)
    for part in RENAMED[old].split("."):
        table = table[part]
    with pytest.raises(ConfigError, match=rf"{old}: unknown key; it is now '{RENAMED[old].partition('.')[2]}'"):
        params.assigned(load_scenario("flat"), [f"{old}=1"])


@pytest.mark.parametrize("row", FIELDS, ids=lambda row: row[0])
def test_message_has_new_fields_and_no_old_ones(row: list[str]) -> None:
    present = set(getattr(messages, row[0]).__dataclass_fields__)
    assert set(names(row[2])) <= present
    assert names(row[1])
    assert not set(names(row[1])) & present


@pytest.mark.parametrize("old", sorted(topics.RENAMED))
def test_error_of_an_old_key_names_the_new_one(old: str) -> None:
    assert any(row[0] == f"`{old}`" for row in ROWS)
    with pytest.raises(ValueError, match=f"no topic '{old}'; did you mean '{topics.RENAMED[old]}'"):
        topics.topic_named(old)


@pytest.mark.parametrize("old", sorted(cli._MOVED))
def test_page_has_every_command_that_moved(old: str, capsys: pytest.CaptureFixture[str]) -> None:
    new = " ".join(cli._MOVED[old])
    (row,) = [row for row in ROWS if re.search(rf"`(sextant )?{old}`", row[0])]
    assert cli._MOVED[old][-1] in row[1]
    assert cli.main([old, "--help"]) == 0
    assert f"`sextant {old}` is now `sextant {new}`" in capsys.readouterr().err


@pytest.mark.parametrize("old", sorted(cli._TO_BENCHMARKS))
def test_page_has_every_command_that_moved_to_the_benchmarks(old: str) -> None:
    assert any(f"`sextant {old}" in row[0] and "python -m benchmarks" in row[1] for row in ROWS)


@pytest.mark.parametrize("words", sorted(set(re.findall(r"`sextant ([a-z]+(?: [a-z0-9]+)?)", PAGE))))
def test_named_command_exists_in_0_1_or_now(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    old = any(f"`sextant {words}" in row[0] for row in ROWS)
    assert old or cli.main([*words.split(), "--help"]) == 0, capsys.readouterr().err


@pytest.mark.parametrize("module", MODULES)
def test_named_module_exists(module: str) -> None:
    place = ROOT.joinpath(*module.split(".")[1:])
    assert place.is_dir() or place.with_suffix(".py").is_file() or "SextantError" in module


def test_named_keys_of_the_report_exist() -> None:
    (text,) = re.findall(r"New ones are ([^(]*)\(", PAGE)
    assert {name for name in re.findall(r"`([\w.]+)`", text) if "." not in name} <= set(Report.__dataclass_fields__)
