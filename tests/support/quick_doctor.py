"""`sextant doctor` in a test: few control cycles are timed, and what does not depend on the robot runs once."""

from functools import cache

import pytest

from sextant.deploy.doctor import machine_checks

_once = cache(cache)  # the same cached check in all tests


def make_doctor_quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time few control cycles, and reuse the results of the walk and of Zenoh's round trip."""
    monkeypatch.setattr(machine_checks, "_CYCLES", 5)
    for check in (machine_checks.chain, machine_checks.zenoh_round_trip):
        monkeypatch.setattr(machine_checks, check.__name__, _once(check))
