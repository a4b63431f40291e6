import time

import pytest

from sextant.deploy.launch.process_age import process_age_s


def test_age_of_process_counts_from_its_start(monkeypatch: pytest.MonkeyPatch) -> None:
    began_s = time.monotonic()
    first = process_age_s()
    assert first > 0.0
    assert 0.0 <= process_age_s() - first <= time.monotonic() - began_s + 0.02
    monkeypatch.delattr(time, "CLOCK_BOOTTIME")
    assert 0.0 <= process_age_s() <= first + 60.0
