"""The fault grid: valid faults, and rejection of invalid ones with all reasons."""

from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.files import config
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.servo.bus_fault import GRID, BusFault
from sextant.shared.wire import codec
from sextant.shared.wire.messages import FaultCommand, FaultKind, FaultTarget

KINDS, TARGETS = get_args(FaultKind), get_args(FaultTarget)


def fault(target: FaultTarget, kind: FaultKind) -> BusFault:
    """Return the simplest fault of a cell."""
    return BusFault(target, kind, 1.0, servo=5 if GRID[target, kind].needs_servo else -1)


def test_grid_has_every_kind_for_every_target() -> None:
    six = ("silent", "stuck", "garbage", "wrong", "slow", "intermittent")
    assert {(target, kind) for target in ("bytes", "packets", "servo", "bus") for kind in six} <= GRID.keys()
    assert {target for target, _ in GRID} == set(TARGETS)
    assert {kind for _, kind in GRID} == set(KINDS)


@pytest.mark.parametrize("cell", GRID, ids=" ".join)
def test_every_fault_is_set_by_file_and_by_message(cell: tuple[FaultTarget, FaultKind]) -> None:
    made = fault(*cell)
    assert config.build(config.as_table(made), BusFault) == made
    message, _ = codec.decode(codec.encode(made.command(7)), FaultCommand, 2048)
    assert message.stamp_ns == 7
    assert BusFault.of(message) == made
    assert " ".join(cell) in str(made)


@given(target=st.sampled_from(TARGETS), kind=st.sampled_from(KINDS), servo=st.integers(-2, 255), share=st.floats(-1, 2))
@settings(derandomize=True)
def test_fault_outside_grid_is_refused(target: FaultTarget, kind: FaultKind, servo: int, share: float) -> None:
    cell = GRID.get((target, kind))
    of_servo = servo == -1 if cell is None or "servo" not in cell.takes else -1 <= servo <= 253
    of_servo = of_servo and not (cell is not None and cell.needs_servo and servo == -1)
    of_share = share == 0.01 if cell is None or "share" not in cell.takes else 0 < share <= 1
    if cell is not None and of_servo and of_share:
        BusFault(target, kind, 0.0, servo=servo, share=share)
    else:
        with pytest.raises(ValueError, match="expected, found"):
            BusFault(target, kind, 0.0, servo=servo, share=share)


def test_all_errors_are_reported_together() -> None:
    table = {"target": "bus", "kind": "silent", "at_s": -1, "for_s": 0, "volts": 3.0, "off_ms": -1.0}
    with pytest.raises(config.ConfigError) as refusal:
        config.build(table, BusFault)
    told = str(refusal.value)
    for place in ("at_s: a time from 0", "for_s: more than 0", "off_ms: more than 0"):
        assert place in told
    with pytest.raises(ValueError, match=r"volts: none for bus silent expected, found 3\.0"):
        BusFault("bus", "silent", 0.0, volts=3.0)
    with pytest.raises(ValueError, match=r"kind: one of silent.*gone for target = 'bus' expected, found 'heat'"):
        BusFault("bus", "heat", 0.0)
    with pytest.raises(ValueError, match="servo: the bus id of a servo"):
        BusFault("servo", "stuck", 0.0)


def test_scenario_contains_bus_faults() -> None:
    table = {
        "name": "mine",
        "terrain": [{"kind": "plane"}],
        "goal": {"distance": 1.0},
        "bus_faults": [{"target": "packets", "kind": "silent", "at_s": 2, "share": 0.1}],
    }
    assert config.build(table, Scenario).bus_faults == (BusFault("packets", "silent", 2.0, share=0.1),)
    table["bus_faults"] = [{"target": "packets", "kind": "sileny", "at_s": 2}]
    with pytest.raises(config.ConfigError, match=r"bus_faults\[0\].kind: one of"):
        config.build(table, Scenario)


def test_documented_table_equals_grid() -> None:
    text = (Path(__file__).parents[4] / "docs" / "actuator.md").read_text(encoding="utf-8")
    rows = [
        f"| {target} {kind} | {cell.means} | {', '.join(f'`{name}`' for name in cell.takes)} |"
        for (target, kind), cell in GRID.items()
    ]
    assert "\n".join(rows) in text
