"""Inputs are the same in every test run, and a busy machine causes no failure."""

from pathlib import Path

import pytest
from hypothesis import settings

from tests.support.idle import give_way_to, is_giving_way

settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add options for the docs' pictures and for giving way to other work."""
    parser.addoption("--pictures", default="", metavar="DIR", help="folder for the docs' pictures of the page")
    parser.addoption("--give-way", default="", metavar="FILE", help="workers compute little while this file exists")


def pytest_configure(config: pytest.Config) -> None:
    """Make workers give way."""
    if hasattr(config, "workerinput") and config.getoption("--give-way"):
        give_way_to(Path(config.getoption("--give-way")))


def pytest_runtest_setup() -> None:
    """Check before each test whether there is still a reason to give way."""
    is_giving_way()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run whole walks first, so that no long test is left to one worker at the end."""
    items.sort(key=lambda item: "walk" not in item.path.parts)
