"""What a process asks of its host."""

import gc
import weakref
from collections.abc import Iterator

import pytest

from shared.host import spare_collector


@pytest.fixture(autouse=True)
def collector_as_before() -> Iterator[None]:
    before = gc.get_threshold()
    yield
    gc.set_threshold(*before)
    gc.unfreeze()


class Run:
    """Something that refers to itself, as runs do."""

    def __init__(self) -> None:
        self.itself = self


def test_what_an_earlier_run_left_behind_goes_when_the_next_one_begins() -> None:
    run = Run()
    left = weakref.ref(run)
    spare_collector()
    del run
    assert left() is not None
    spare_collector()
    assert left() is None
