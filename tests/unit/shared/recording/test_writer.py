import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.recording.layout import RecordingError, describe
from sextant.shared.recording.reader import Recording, read
from sextant.shared.recording.writer import Recorder
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose, DepthImage, Health, Message, Mode, Scan
from tests.support.frames import of_another_version
from tests.support.recorded import S, some_messages, terrain, velocity

PAGE = Path(__file__).parents[4] / "docs" / "recordings.md"
ABOUT = {"scenario": "steps", "seed": "3"}


def write(path: Path, messages: list[tuple[AnyTopic, Message, int]], **options: Any) -> None:
    with Recorder(path, ABOUT, **options) as recorder:
        for topic, message, at_ns in messages:
            recorder.write(topic, codec.encode(message), at_ns)


def same(a: Message, b: Message) -> bool:
    return codec.encode(a) == codec.encode(b)


def test_messages_are_read_back_in_order(tmp_path: Path) -> None:
    written = some_messages()
    write(tmp_path / "r.mcap", written)
    found = list(read(tmp_path / "r.mcap"))
    assert [(t, at) for t, _, at in found] == [(t, at) for t, _, at in written]
    assert all(same(a, b) for (_, a, _), (_, b, _) in zip(found, written, strict=True))
    assert [t for t, _, _ in read(tmp_path / "r.mcap", [topics.MODE])] == [topics.MODE] * 40


def test_python_in_docs_reads_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert '"runs/RUN/recording.mcap"' in code
    T_world_body = from_xyz_rpy((1.0, 0.5, 0.11), np.zeros(3))
    pose = BodyPose(2 * S, T_world_body, np.eye(4), np.zeros((6, 6)), 1.0, True, "", np.zeros((0, 6)))
    write(tmp_path / "r.mcap", [*some_messages(), (topics.BODY_POSE, pose, 2 * S)])
    exec(code.replace("runs/RUN/recording.mcap", str(tmp_path / "r.mcap")), {})
    assert capsys.readouterr().out.endswith("2.00 s: the body is at 1.000, 0.500, 0.110 m in {world}\n")


def test_recording_without_role_keys_is_read_as_robot(tmp_path: Path) -> None:
    nothing = np.zeros(0)
    message = Health(1, "actuator", "holding", 0, 0, 0, "", (), nothing, nothing)
    write(tmp_path / "r.mcap", [(replace(topics.HEALTH, key="health"), message, 1)])
    ((topic, found, _),) = read(tmp_path / "r.mcap")
    assert topic is topics.HEALTH_OF["robot"]
    assert same(found, message)


def test_same_messages_give_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(tmp_path / name, some_messages())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    write(tmp_path / "c", some_messages(seed=1))
    assert (tmp_path / "a").read_bytes() != (tmp_path / "c").read_bytes()


def test_images_are_omitted_and_maps_thinned_by_default(tmp_path: Path) -> None:
    written: list[tuple[AnyTopic, Message, int]] = []
    for i in range(30):
        at_ns = i * S // 10
        written += [
            (topics.DEPTH, DepthImage(at_ns, np.zeros((2, 3), np.uint16)), at_ns),
            (topics.TERRAIN, terrain(at_ns), at_ns),
        ]
    write(tmp_path / "r", written)
    assert Recording(tmp_path / "r").counts() == {"mapper/terrain": 3}
    write(tmp_path / "all", written, left_out=(), thinned_ns={})
    assert Recording(tmp_path / "all").counts() == {"camera/depth": 30, "mapper/terrain": 30}


def test_recording_is_standard_mcap_with_metadata(tmp_path: Path) -> None:
    write(tmp_path / "r.mcap", some_messages())
    with (tmp_path / "r.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert {c.topic: c.message_encoding for c in summary.channels.values()} == {
            "operator/velocity": "sextant",
            "operator/mode": "sextant",
        }
        assert {s.name: s.encoding for s in summary.schemas.values()} == {
            "VelocityCommand": "sextant",
            "ModeCommand": "sextant",
        }
        assert summary.statistics is not None
        assert summary.statistics.message_count == 80
        (metadata,) = reader.iter_metadata()
        assert metadata.metadata.items() >= ABOUT.items()
    recording = Recording(tmp_path / "r.mcap")
    assert sum(1 for _ in recording.frames()) == 80
    assert recording.complete
    assert recording.about.items() >= ABOUT.items()


@pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda t: t.key)
def test_schema_describes_every_field(topic: AnyTopic) -> None:
    described = json.loads(describe(topic.type))
    assert described["schema"] == codec.schema_id(topic.type)
    assert [f["name"] for f in described["fields"]] == list(topic.type.__dataclass_fields__)
    assert all(f["type"] for f in described["fields"])


def test_schema_gives_shapes_types_and_meaning() -> None:
    fields = {f["name"]: f for f in json.loads(describe(Scan))["fields"]}
    assert fields["points_mm"] == {
        "name": "points_mm",
        "type": "array",
        "dtype": "<i2",
        "shape": ["n", 3],
        "finite": True,
        "packed": True,
    }
    assert fields["pose_covariance"]["shape"] == [6, 6]
    assert fields["p_world_camera"]["dtype"] == "<f8"
    state = {f["name"]: f for f in json.loads(describe(topics.ACTUATOR_STATE.type))["fields"]}
    assert state["mode"]["one_of"] == [str(mode) for mode in Mode]
    assert state["warnings"]["type"] == "list of str"


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.75, 0.999])
def test_truncated_file_is_read_up_to_cut(tmp_path: Path, share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sextant.shared.recording.writer._CHUNK_BYTES", 2000)
    written = some_messages(n=400)
    write(tmp_path / "whole", written)
    data = (tmp_path / "whole").read_bytes()
    (tmp_path / "cut").write_bytes(data[: int(share * len(data))])
    recording = Recording(tmp_path / "cut")
    found = list(recording.messages())
    assert not recording.complete
    assert len(found) <= len(written)
    assert all(same(a, b) for (_, a, _), (_, b, _) in zip(found, written, strict=False))
    assert len(found) > 0.5 * share * len(written) - 100


def test_unclosed_recording_is_read_up_to_last_half_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sextant.shared.recording.writer._CHUNK_BYTES", 2000)
    written = some_messages(n=400)  # two frames per second
    recorder = Recorder(tmp_path / "r", ABOUT)
    for topic, message, at_ns in written:
        recorder.write(topic, codec.encode(message), at_ns)
    recording = Recording(tmp_path / "r")  # as a process that is killed now leaves it
    found = list(recording.messages())
    assert not recording.complete
    assert recording.about.items() >= ABOUT.items()
    assert all(same(a, b) for (_, a, _), (_, b, _) in zip(found, written, strict=False))
    assert len(found) >= len(written) - 3, "what came since the last flush"
    recorder.close()


def test_messages_of_undeclared_channel_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / "odd.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        writer.add_message(channel_id=7, log_time=0, data=b"", publish_time=0)
        writer.finish()
    recording = Recording(path)
    assert list(recording.frames()) == []
    assert recording.undeclared == 1
    assert not recording.complete


def test_reading_continues_after_damaged_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sextant.shared.recording.writer._CHUNK_BYTES", 2000)
    write(tmp_path / "r", some_messages(n=400))
    with (tmp_path / "r").open("r+b") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        chunk = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
        file.seek(chunk.chunk_start_offset + chunk.chunk_length - 20)
        file.write(bytes(8))
    recording = Recording(tmp_path / "r")
    found = list(recording.messages())
    assert 400 < len(found) < 800
    assert found[-1][2] == 399_000_000_005, "the last one is there"
    assert not recording.complete


def test_non_recording_is_refused_with_advice(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("hello, this is text")
    for name in ("text", "missing", "."):
        with pytest.raises(RecordingError, match=r"recording\.mcap"):
            Recording(tmp_path / name)


def test_frames_of_other_version_are_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path / "r", ABOUT) as recorder:
        recorder.write(topics.VELOCITY, of_another_version(velocity(0, np.random.default_rng(0))), 0)
    with pytest.raises(RecordingError, match="the same version"):
        list(read(tmp_path / "r"))
