"""Attacks with well-formed but extreme messages on a robot in lockstep."""

import json
from pathlib import Path
from random import Random

import pytest

from benchmarks import cli
from benchmarks.access import role_attack
from benchmarks.access.extreme_values import worst
from benchmarks.access.role_attack import Row
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec
from sextant.shared.wire.access import ROLE_NAMED
from sextant.shared.wire.messages import Mode, PlannerStatus, schema
from sextant.shared.wire.topics import TOPICS
from tests.support.states import actuator_state

NOW_NS = 10_000_000_000


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
def test_attack_messages_pass_schema_and_vary(topic: AnyTopic) -> None:
    rng = Random(topic.key)
    made = [worst(topic, (), NOW_NS, rng) for _ in range(30)]
    for message in made:
        again, _ = codec.decode(codec.encode(message, codec.Timing(NOW_NS, NOW_NS)), topic.type, topic.max_bytes)
        assert type(again) is topic.type
    assert len({codec.encode(message) for message in made}) > 5 or len(schema(topic.type)) == 1


@pytest.mark.slow
def test_attacker_publishes_only_topics_of_its_role() -> None:
    for role in role_attack.ROLE_NAMES:
        attacker = role_attack.Attacker(role, 1)
        assert {attacker.next(NOW_NS)[0].key for _ in range(300)} <= {topic.key for topic in ROLE_NAMED[role].publishes}


def test_row_passes_without_exit_or_growth_and_with_timely_torque_off() -> None:
    good = Row("viewer", 10, 1.0, (), (31.0,))
    assert good.passed
    assert not Row("viewer", 10, 1.0, (), (61.0,)).passed
    assert not Row("viewer", 10, 1.0, (), ()).passed, "it was never ordered"
    assert not Row("viewer", 10, 1.0, (), (31.0,), ended=("planner ended",)).passed
    assert not Row("viewer", 10, 1.0, (), (31.0,), growth_mb={"console": 50.0}).passed
    assert not Row("viewer", 10, 1.0, (), (31.0,), taken_mb={"console": 70.0}).passed
    assert Row("viewer", 10, 1.0, (), (31.0,), afterwards="right rear leg: no foothold").passed
    assert not Row("viewer", 10, 1.0, (), (31.0,), afterwards="").passed, "it stands without a reason"
    assert "| `viewer` | 10 | 100 % |" in role_attack.in_words([good])
    assert '"passed": true' in role_attack.to_json([good])


@pytest.mark.parametrize(
    ("mode", "planner", "reason"),
    [
        (Mode.HOLD, "blocked", "no foothold"),
        (Mode.HOLD, "waiting", "no foothold"),
        (Mode.HOLD, "stepping", ""),
        (Mode.WALK, "resting", ""),
        (Mode.FAULT, "stepping", "fault: a servo is silent"),
        (Mode.STAND, "resting", ""),
    ],
)
def test_standing_reason_is_empty_for_robot_that_can_walk(mode: Mode, planner: str, reason: str) -> None:
    state = actuator_state(load_profile("phantomx_mk2"), mode=mode, reason="a servo is silent")
    assert role_attack.why_it_stands(state, PlannerStatus(0, planner, "no foothold", 0, 0, -1)) == reason
    assert role_attack.why_it_stands(None, None) == ""


@pytest.mark.slow
def test_lockstep_walk_withstands_attack_with_robot_certificate() -> None:
    row = role_attack.in_lockstep("robot", 150, 1)
    assert row.ended == ()
    assert row.passed, role_attack.in_words([row])


@pytest.mark.slow
def test_roles_command_writes_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--messages", "100", "--only", "console", "--out", str(tmp_path)]
    assert cli.main(["roles", "--lockstep", *words]) == 0
    assert "| `console` | 100 |" in capsys.readouterr().out
    (row,) = json.loads((tmp_path / "roles.json").read_text())
    assert row["passed"]
    assert max(row["off_ms"]) <= 60.0
    assert cli.main(["roles", "--only", "king", "--out", str(tmp_path)]) == 2
    assert "one of the roles robot, base, console, viewer, site expected, found king" in capsys.readouterr().err
