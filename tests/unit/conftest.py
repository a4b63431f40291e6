"""What no unit test touches."""

from collections.abc import Iterator

import pytest

from sextant.services.actuator.safety import torque_off_latch, walk_authorization


@pytest.fixture(autouse=True, scope="session")
def _latches_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No test closes the latch of a robot that this machine may have, nor leaves one behind."""
    folders = (tmp_path_factory.mktemp("run"),)
    with pytest.MonkeyPatch.context() as patched:
        for module in (torque_off_latch, walk_authorization):
            patched.setattr(module, "FOLDERS", folders)
        yield
