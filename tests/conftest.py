"""Made-up inputs are the same in every run, and a busy machine is no failure."""

import pytest
from hypothesis import settings

settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Where pictures go that tests make for the docs."""
    parser.addoption("--pictures", default="", metavar="DIR", help="folder for the docs' pictures of the page")
