"""A recording and a live robot in common viewers, if their packages are installed."""

import json
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.shared.recording.writer import Recorder
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire import codec, topics
from tests.support.recorded import scan, terrain
from tests.support.states import actuator_state

PROFILE = load_profile("phantomx_mk2")
S = 1_000_000_000


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    with Recorder(tmp_path / "r.mcap", {"robot": PROFILE.name}) as recorder:
        for k in range(50):
            at_ns = k * S // 25
            messages = [actuator_state(PROFILE, stamp_ns=at_ns), scan(at_ns), terrain(at_ns, (9, 9))]
            for message in messages:
                recorder.write(topics.OF_TYPE[type(message)], codec.encode(message), at_ns)
    return tmp_path / "r.mcap"


def test_recording_is_exported_to_rerun(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rerun", reason="rerun, of the extra of that name: pip install -e '.[rerun]'")
    assert cli.main(["recording", "export", str(recorded), "--rerun", str(tmp_path / "r.rrd")]) == 0
    assert "102 messages" in capsys.readouterr().out, "of the maps the recorder keeps one a second"
    assert (tmp_path / "r.rrd").read_bytes()[:4] in (b"RRF2", b"RRIO")


def test_export_to_wrong_suffix_is_refused(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["recording", "export", str(recorded), "--rerun", str(tmp_path / "r.mp4")]) == 2
    assert "ends in .rrd expected" in capsys.readouterr().err


def test_foxglove_server_advertises_channels_and_sends_subscribed() -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk, of the extra foxglove: pip install -e '.[foxglove]'")
    from websockets.sync.client import connect

    from sextant.evaluation.viewers.foxglove_server import FoxgloveServer

    with FoxgloveServer(PROFILE, "127.0.0.1", 0) as server:
        state = codec.encode(actuator_state(PROFILE, stamp_ns=7 * S))
        server.write(topics.ACTUATOR_STATE, state, 7 * S)
        with connect(server.target, subprotocols=["foxglove.sdk.v1"], open_timeout=10) as viewer:  # type: ignore[list-item]
            channels: dict[str, dict[str, object]] = {}
            while "/tf" not in channels:
                told = json.loads(viewer.recv(10))
                channels |= {channel["topic"]: channel for channel in told.get("channels", [])}
            assert channels["/tf"]["schemaName"] == "foxglove.FrameTransforms"
            assert channels["/tf"]["encoding"] == "protobuf"
            subscription = {"id": 5, "channelId": channels["/tf"]["id"]}
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
            frame: bytes | str = ""
            for k in range(200):  # messages before the server knows of the subscription are lost
                server.write(topics.ACTUATOR_STATE, state, 7 * S + k)
                try:
                    frame = viewer.recv(0.1)
                    break
                except TimeoutError:
                    continue
        assert isinstance(frame, bytes)
        assert frame[0] == 1
        assert int.from_bytes(frame[1:5], "little") == 5
        assert abs(int.from_bytes(frame[5:13], "little") - 7 * S) < 1000
        assert np.frombuffer(frame[13:], dtype=np.uint8).size > 50


def test_occupied_foxglove_port_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk, of the extra foxglove: pip install -e '.[foxglove]'")
    from sextant.evaluation.viewers.foxglove_server import FoxgloveServer

    with FoxgloveServer(PROFILE, "127.0.0.1", 0) as server:
        port = server.target.rpartition(":")[2]
        assert cli.main(["topics", "foxglove", "--port", port]) == 1
    assert "give another port with --port" in capsys.readouterr().err
