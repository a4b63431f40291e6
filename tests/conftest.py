"""Inputs are the same in every test run, and a busy machine causes no failure."""

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.support.idle import give_way_to, is_giving_way

# One thread per process, as in the services: parallel processes whose threads wait for each other need a third more time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_WALKS = Path(__file__).parent / "walk"

# A busy machine makes examples slowly; that is no fault of a test.
settings.register_profile("seeded", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("seeded")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add options for the docs' pictures and for giving way to other work."""
    parser.addoption("--pictures", default="", metavar="DIR", help="folder for the docs' pictures of the page")
    parser.addoption("--give-way", default="", metavar="FILE", help="workers compute little while this file exists")


def pytest_configure(config: pytest.Config) -> None:
    """Make workers give way; let programs under test receive the signals that a background job and `nohup` ignore."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: None)  # a program that is started has the default again
    if hasattr(config, "workerinput") and config.getoption("--give-way"):
        give_way_to(Path(config.getoption("--give-way")))


def pytest_runtest_setup() -> None:
    """Check before each test whether there is still a reason to give way."""
    is_giving_way()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark walks, live and rare tests as slow; run slow files first.

    So no worker runs a long file alone at the end.
    """
    slow_files = set()
    for item in items:
        if item.path.parent == _WALKS or item.get_closest_marker("live") or item.get_closest_marker("rare"):
            item.add_marker(pytest.mark.slow)
        if item.get_closest_marker("slow"):
            slow_files.add(item.path)
    items.sort(key=lambda item: (item.path.parent != _WALKS, item.path not in slow_files))


@pytest.fixture(autouse=True)
def _no_modules_of_other_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Forget the modules that a test imported from its folder: the next test may write others of the same name."""
    before = set(sys.modules)
    yield
    folder = str(tmp_path_factory.getbasetemp())
    for name in sys.modules.keys() - before:
        if str(getattr(sys.modules[name], "__file__", None)).startswith(folder):
            del sys.modules[name]
