"""Command repeater: commands are repeated until they have taken effect."""

from typing import Any

import pytest

from sextant.services.console.web.command_repeater import CommandRepeater
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire.messages import ActuatorState, Mode
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
MS = 1_000_000
HOLDER = "console 1 at home:8080"


def state(now_ms: int, mode: Mode = Mode.WALK, lease: str = HOLDER, **changes: Any) -> ActuatorState:
    return actuator_state(PROFILE, stamp_ns=now_ms * MS, mode=mode, lease=lease, **changes)


@pytest.fixture
def commands() -> CommandRepeater:
    return CommandRepeater()


def sent_ms(commands: CommandRepeater, until_ms: int, mode: Mode = Mode.WALK, lease: str = HOLDER) -> list[int]:
    """Return when commands are sent, beat by beat of 50 ms."""
    return [t for t in range(0, until_ms, 50) for _ in commands.drain(t * MS, state(t, mode, lease))]


def test_command_is_sent_at_once_and_then_twice_a_second(commands: CommandRepeater) -> None:
    commands.order(1, HOLDER, "walk", 0)
    assert sent_ms(commands, 2000) == [0, 500, 1000, 1500]


def test_torque_off_is_urgent_until_torque_is_off(commands: CommandRepeater) -> None:
    commands.order(1, HOLDER, "off", 0)
    assert sent_ms(commands, 400) == [0, 100, 200, 300]
    commands.order(1, HOLDER, "off", 0)
    assert sent_ms(commands, 400, Mode.OFF) == [0]


def test_repetition_ends_two_seconds_after_torque_off(commands: CommandRepeater) -> None:
    commands.order(1, HOLDER, "off", 0)
    assert max(sent_ms(commands, 5000, Mode.OFF)) == 2000


def test_torque_off_is_not_repeated_after_torque_was_turned_on_again(commands: CommandRepeater) -> None:
    commands.order(1, HOLDER, "off", 0)
    commands.drain(50 * MS, state(50, Mode.OFF))
    assert commands.drain(600 * MS, state(600, Mode.READY)) == []
    assert commands.drain(1200 * MS, state(1200, Mode.READY)) == []


def test_stop_ends_where_another_client_leads(commands: CommandRepeater) -> None:
    commands.order(1, HOLDER, "stop", 0)
    assert max(sent_ms(commands, 5000, Mode.HOLD, "somewhere else")) == 2000


def test_ended_command_is_not_repeated(commands: CommandRepeater) -> None:
    commands.order(1, HOLDER, "walk", 0)
    commands.drain(0, None)
    commands.end(1)
    assert commands.drain(10_000 * MS, None) == []


def test_sequences_increase_over_pages_and_follow_a_clock_that_was_set_back(commands: CommandRepeater) -> None:
    for page, now_ms in ((1, 5000), (2, 5000), (1, 4999), (1, 10)):
        commands.order(page, HOLDER, "stop", now_ms * MS)
    sequences = [command.sequence for command in commands.drain(0, None)]
    assert sequences == [5000 * MS, 5000 * MS + 1, 5000 * MS + 2, 10 * MS]
