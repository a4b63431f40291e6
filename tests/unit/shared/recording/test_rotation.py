from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sextant.shared.recording.contents import contents
from sextant.shared.recording.reader import Recording
from sextant.shared.recording.rotation import FILE_NS, Rotation
from sextant.shared.recording.writer import Recorder
from tests.support.recorded import S, frames, some_messages

ABOUT = {"robot": "phantomx_mk2"}


def rotate(folder: Path, n: int, file_ns: int) -> Rotation:
    rotation = Rotation(folder, lambda path: Recorder(path, ABOUT), file_ns, reserve_bytes=0)
    for topic, frame, at_ns in frames(some_messages(n=n)):
        rotation.write(topic, frame, at_ns)
    rotation.close()
    return rotation


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(n=st.integers(1, 40), file_s=st.integers(1, 50))
def test_rotation_loses_no_message(tmp_path_factory: pytest.TempPathFactory, n: int, file_s: int) -> None:
    folder = tmp_path_factory.mktemp("rotated")
    rotation = rotate(folder, n, file_s * S)
    recording = Recording(folder)
    assert [path.name for path in recording.files] == [f"recording-{k + 1:04d}.mcap" for k in range((n - 1) // file_s + 1)]
    assert list(recording.messages()) != []
    assert [(key, at) for key, _, at in recording.frames()] == [(topic.key, at) for topic, _, at in some_messages(n=n)]
    assert recording.complete
    assert rotation.size == sum(path.stat().st_size for path in recording.files)


def test_each_rotated_file_is_complete(tmp_path: Path) -> None:
    rotate(tmp_path, 30, 10 * S)
    for path in Recording(tmp_path).files:
        found = contents(path)
        assert found.about["robot"] == "phantomx_mk2"
        assert {track.messages for track in found.tracks.values()} == {10}


def test_rotated_file_lasts_one_minute(tmp_path: Path) -> None:
    rotate(tmp_path, 150, FILE_NS)
    spans = [contents(path) for path in Recording(tmp_path).files]
    assert [round((c.ended_ns - c.began_ns) / S) for c in spans] == [59, 59, 29]
