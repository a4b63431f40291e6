"""Made-up inputs are the same in every run, and a busy machine is no failure."""

from pathlib import Path

import pytest
from hypothesis import settings

from tests.support.idle import give_way_to, is_giving_way

settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Where pictures go that tests make for the docs, and to whom others give way."""
    parser.addoption("--pictures", default="", metavar="DIR", help="folder for the docs' pictures of the page")
    parser.addoption("--give-way", default="", metavar="FILE", help="workers compute little while this file exists")


def pytest_configure(config: pytest.Config) -> None:
    """Have workers give way."""
    if hasattr(config, "workerinput") and config.getoption("--give-way"):
        give_way_to(Path(config.getoption("--give-way")))


def pytest_runtest_setup() -> None:
    """See before each test whether there is still somebody to give way to."""
    is_giving_way()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whole walks first: at the end there is to be nothing long that one worker alone has left."""
    items.sort(key=lambda item: "walk" not in item.path.parts)
