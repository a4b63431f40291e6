"""Made-up inputs are the same in every run, and a busy machine is no failure."""

import os

import pytest
from hypothesis import settings

from tests.support.idle import weigh_little

settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Where pictures go that tests make for the docs, and who waits for whom."""
    parser.addoption("--pictures", default="", metavar="DIR", help="folder for the docs' pictures of the page")
    parser.addoption("--idle", action="store_true", help="compute only while nobody else wants to")


def pytest_configure(config: pytest.Config) -> None:
    """Workers inherit how this process is scheduled; each makes a session of its own."""
    if config.getoption("--idle"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        if hasattr(config, "workerinput"):
            os.setsid()
            weigh_little(os.getpid())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Whole walks first: at the end there is to be nothing long that one worker alone has left."""
    items.sort(key=lambda item: "walk" not in item.path.parts)
