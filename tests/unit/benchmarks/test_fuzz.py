"""Fuzzing: broken messages reach their targets, and failures are found.

No target fails.
"""

import struct
import subprocess
import sys
from pathlib import Path
from random import Random

import pytest

from benchmarks import cli
from benchmarks.fuzz import fuzzing, table
from benchmarks.fuzz.mutators import broken, odd
from benchmarks.fuzz.target import Target
from benchmarks.fuzz.targets import targets
from sextant.shared.wire.topics import TOPICS

MESSAGES = 200  # for each target


@pytest.fixture(scope="module")
def fuzz_targets() -> dict[str, Target]:
    return {target.name: target for target in targets(Random(1))}


def test_each_topic_is_a_fuzz_target(fuzz_targets: dict[str, Target]) -> None:
    assert {topic.key for topic in TOPICS} < set(fuzz_targets)


def test_valid_examples_are_accepted(fuzz_targets: dict[str, Target]) -> None:
    for target in fuzz_targets.values():
        expected = {"bridge, host": 3, "bridge, board": 6}.get(
            target.name, len(target.examples) / 2
        )  # each bridge target receives one direction only
        assert sum(map(target.take, target.examples)) >= expected, target.name


@pytest.mark.slow
def test_broken_messages_are_accepted_or_refused_without_error(tmp_path: Path) -> None:
    found = table.table([fuzzing.fuzz(MESSAGES * len(fuzzing.names()), 1, (), tmp_path / "newest")])
    assert found.findings == ()
    for outcome in found.outcomes:
        assert outcome.messages == MESSAGES
        assert 0 < outcome.taken < MESSAGES, f"{outcome.target}: what is broken is broken enough, and not too much"


def test_mutations_are_deterministic_for_seed(fuzz_targets: dict[str, Target]) -> None:
    examples = fuzz_targets["planner/step"].examples
    for seed in range(50):
        assert broken(examples[0], examples, Random(seed)) == broken(examples[0], examples, Random(seed))
        assert odd([1, [2, "a"]], Random(seed)).__repr__() == odd([1, [2, "a"]], Random(seed)).__repr__()


def test_failure_is_reported_once_with_its_message(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def take(data: bytes) -> bool:
        return data[40] > 0  # raises IndexError for short data

    faulty = Target("faulty", (bytes(60),), lambda data, rng: data[: rng.randrange(60)], take)
    monkeypatch.setattr(fuzzing, "targets", lambda rng: (faulty,))
    found = table.table([fuzzing.fuzz(300, 1, (), tmp_path / "newest"), fuzzing.fuzz(300, 2, (), tmp_path / "newest")])
    (finding,) = found.findings
    assert finding.error.startswith("IndexError in test_fuzz.py, take, line ")
    assert len(finding.data) <= 40
    assert not found.passed
    assert "faulty: IndexError" in table.markdown(found)
    assert table.markdown(table.from_json(table.to_json(found))) == table.markdown(found)


def test_message_that_ends_process_is_saved(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    class Ended(BaseException):
        pass

    given = []

    def take(data: bytes) -> bool:
        given.append(data)
        raise Ended

    deadly = Target("deadly", (b"some bytes",), lambda data, rng: data, take)
    monkeypatch.setattr(fuzzing, "targets", lambda rng: (deadly,))
    with pytest.raises(Ended):
        fuzzing.fuzz(1, 1, (), tmp_path / "newest")
    name, _, rest = (tmp_path / "newest").read_bytes().partition(b"\n")
    (length,) = struct.unpack_from("<I", rest)
    assert name == b"deadly"
    assert rest[4 : 4 + length] == given[0]


@pytest.mark.rare
def test_fuzz_command_reports_findings_and_repeats_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [sys.executable, "-m", "benchmarks", "fuzz", "--messages", "20000", "--jobs", "2", "--out", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=300.0)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "20,000 messages; memory of the process that grew most" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"fuzz.json"}
    given = tmp_path / "given"
    given.write_bytes(b"no frame")
    assert cli.main(["fuzz", "--only", "imu", "--give", str(given)]) == 0
    assert capsys.readouterr().out == "imu: refused\n"
    assert cli.main(["fuzz", "--list"]) == 0
    assert "page, socket" in capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--only", "camera/dept"], "did you mean 'camera/depth'?"),
        (["--give", "none", "--only", "imu"], "cannot read none: No such file"),
        (["--give", "none"], "one --only expected"),
    ],
)
def test_invalid_fuzz_arguments_are_refused_with_hint(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fuzz", *words]) == 2
    assert said in capsys.readouterr().err
