import resource
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from sextant.deploy import cli
from sextant.shared.files.whole_files import partial
from sextant.shared.recording.layout import RecordingError
from sextant.shared.recording.reader import Recording, newest_ns
from sextant.shared.recording.recovery import recover
from sextant.shared.recording.writer import Recorder
from tests.support.recorded import frames, some_messages

WRITTEN = frames(some_messages(n=200))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "recording.mcap"
    with Recorder(path, {"scenario": "steps"}) as recorder:
        for topic, frame, at_ns in WRITTEN:
            recorder.write(topic, frame, at_ns)
    return path


def read(path: Path) -> list[tuple[str, bytes, int]]:
    return list(Recording(path).frames())


EXPECTED = [(topic.key, frame, at_ns) for topic, frame, at_ns in WRITTEN]


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(share=st.floats(0.05, 0.99))
def test_truncated_file_recovers_all_remaining_messages(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, share: float
) -> None:
    folder, data = tmp_path_factory.mktemp("cut"), whole.read_bytes()
    (folder / "cut.mcap").write_bytes(data[: int(share * len(data))])
    before = read(folder / "cut.mcap")
    assert newest_ns(folder / "cut.mcap") == max((at_ns for _, _, at_ns in before), default=-1)
    if not before:
        with pytest.raises(RecordingError, match="no part of it is intact"):
            recover(folder / "cut.mcap", folder / "new.mcap")
        assert not (folder / "new.mcap").exists()
        return
    found = recover(folder / "cut.mcap", folder / "new.mcap")
    after = Recording(folder / "new.mcap")
    assert list(after.frames()) == before == EXPECTED[: len(before)]
    assert after.complete
    assert after.about["scenario"] == "steps"
    assert found.messages == len(before)
    with (folder / "new.mcap").open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(before), "it has an index now, by which tools find their way"


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(share=st.floats(0.05, 0.95), flips=st.integers(1, 255))
def test_damage_loses_only_affected_messages(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, share: float, flips: int
) -> None:
    folder, data = tmp_path_factory.mktemp("damaged"), bytearray(whole.read_bytes())
    data[int(share * len(data))] ^= flips
    (folder / "bad.mcap").write_bytes(data)
    try:
        found = recover(folder / "bad.mcap", folder / "new.mcap")
    except RecordingError:
        return  # the damage hit the declarations that all messages need
    after = read(folder / ("bad.mcap" if found.was_whole else "new.mcap"))  # an index of messages has no checksum
    assert after != []
    assert found.messages == len(after)
    of_old = iter(EXPECTED)
    assert all(any(one == old for old in of_old) for one in after), "in their order, and none that was not there"


def test_complete_file_is_recognized(whole: Path, tmp_path: Path) -> None:
    found = recover(whole, tmp_path / "new.mcap")
    assert found.was_whole
    assert (found.lost, found.messages) == ([], 400)
    assert list(tmp_path.iterdir()) == []


def test_recover_command_keeps_source_and_reports_losses(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = whole.read_bytes()
    (tmp_path / "recording-0001.mcap").write_bytes(data)
    (tmp_path / "recording-0002.mcap").write_bytes(data[: len(data) // 2])
    assert cli.main(["recording", "recover", str(tmp_path)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert "recording-0001.mcap: already complete, 400 messages over 199.0 s" in said[0]
    assert "recording-0002.recovered.mcap" in said[1]
    assert "bytes at the end" in said[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "recording-0001.mcap",
        "recording-0002.mcap",
        "recording-0002.recovered.mcap",
    ]
    parts = Recording(tmp_path)
    assert [path.name for path in parts.files] == ["recording-0001.mcap", "recording-0002.recovered.mcap"], "none is read twice"
    assert len(data) // 2 == (tmp_path / "recording-0002.mcap").stat().st_size
    assert cli.main(["recording", "recover", str(tmp_path)]) == 0
    assert "recording-0002.recovered.mcap: already recovered" in capsys.readouterr().out


def test_non_recording_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.mcap").write_text("hello, this is text")
    assert cli.main(["recording", "recover", str(tmp_path / "text.mcap")]) == 2
    assert cli.main(["recording", "info", str(tmp_path / "nowhere.mcap")]) == 2
    said = capsys.readouterr().err
    assert "not an MCAP file" in said
    assert "No such file" in said


def test_info_command_lists_content(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["recording", "info", str(whole)]) == 0
    said = capsys.readouterr().out
    assert "1 file" in said
    assert "scenario: steps" in said
    assert "operator/velocity    VelocityCommand                 200    1.0 Hz" in said


def recover_within(folder: Path, most_bytes: int) -> subprocess.CompletedProcess[str]:
    """Run `sextant recording recover` with a limit of bytes per file."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    return subprocess.run(
        [sys.executable, "-B", "-m", "sextant.deploy.cli", "recording", "recover", str(folder)],
        preexec_fn=limit,
        capture_output=True,
        text=True,
        check=False,
    )


def test_recovery_without_space_leaves_source_in_use(whole: Path, tmp_path: Path) -> None:
    (tmp_path / "r.mcap").write_bytes(whole.read_bytes()[:-50])
    ended = recover_within(tmp_path, 4000)
    assert ended.returncode == 1
    cause = "a file of this size is not allowed here; raise the limit (`ulimit -f`)"
    assert ended.stderr == f"sextant recording recover: {tmp_path / 'r.recovered.mcap'} cannot be written: {cause}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["r.mcap"]
    assert read(tmp_path) == EXPECTED
    assert cli.main(["recording", "recover", str(tmp_path)]) == 0
    assert read(tmp_path) == EXPECTED


def test_killed_recovery_is_repeated(whole: Path, tmp_path: Path) -> None:
    (tmp_path / "r.mcap").write_bytes(whole.read_bytes()[:-50])
    partial(tmp_path / "r.recovered.mcap").write_bytes(whole.read_bytes()[:500])  # as a killed process leaves it
    assert [path.name for path in Recording(tmp_path).files] == ["r.mcap"]
    assert cli.main(["recording", "recover", str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r.mcap", "r.recovered.mcap"]
    assert read(tmp_path) == EXPECTED


def test_unrecoverable_file_does_not_block_others_of_folder(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.mcap").write_text("no recording")
    (tmp_path / "b.mcap").write_bytes(whole.read_bytes()[:-50])
    assert cli.main(["recording", "recover", str(tmp_path)]) == 2
    assert "a.mcap: not an MCAP file" in capsys.readouterr().err
    assert (tmp_path / "b.recovered.mcap").exists()
