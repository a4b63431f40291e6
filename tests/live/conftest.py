"""Compile everything before live tests, so that their times are kept."""

import io

import pytest

from sextant.deploy.commands.common import warm_up
from sextant.deploy.terminal.progress import progress_for


@pytest.fixture(scope="session", autouse=True)
def _compiled() -> None:
    warm_up(progress_for(io.StringIO()))
