"""What is live keeps its times only once everything is compiled."""

import io

import pytest

from sextant.deploy.commands.common import warm_up
from sextant.deploy.progress import progress_for


@pytest.fixture(scope="session", autouse=True)
def _compiled() -> None:
    warm_up(progress_for(io.StringIO()))
