"""`sextant doctor` in a test: few control cycles are timed, and what does not depend on the robot runs once."""

from functools import cache

import pytest

from sextant.deploy.doctor import machine_checks

_once = cache(cache)  # the same cached check in all tests


def make_doctor_quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time few control cycles, and reuse the results of one robot's walk and of Zenoh's round trip."""
    monkeypatch.setattr(machine_checks, "_CYCLES", 5)
    chain = _once(machine_checks.chain)
    monkeypatch.setattr(machine_checks, "chain", lambda _robot: chain("phantomx_mk2"))
    monkeypatch.setattr(machine_checks, "zenoh_round_trip", _once(machine_checks.zenoh_round_trip))
