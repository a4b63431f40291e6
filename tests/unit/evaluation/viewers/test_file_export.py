"""Trajectories in the TUM format and maps as .npy, read back by the readers of both."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from sextant.deploy import cli
from sextant.evaluation.viewers.file_export import export_map, export_trajectories, merged
from sextant.services.perception.tum import read_trajectory
from sextant.services.simulator.physics.terrain import build_terrain
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.recording.layout import RecordingError
from sextant.shared.recording.writer import Recorder
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose, GroundTruth, Message, TerrainMap

S = 1_000_000_000


def recording(path: Path, messages: Sequence[Message]) -> Path:
    with Recorder(path, {"robot": "phantomx_mk2"}, thinned_ns={}) as recorder:
        for message in messages:
            recorder.write(topics.OF_TYPE[type(message)], codec.encode(message), message.stamp_ns)
    return path


def pose(stamp_ns: int, T: Array) -> BodyPose:
    return BodyPose(stamp_ns, T, np.eye(4), np.eye(6), 1.0, True, "", np.zeros((0, 6)))


def truth(stamp_ns: int, T: Array) -> GroundTruth:
    flags, joints = np.zeros(6, dtype=bool), np.zeros((6, 3))
    return GroundTruth(stamp_ns, T, joints, joints, joints, flags, flags, joints.astype(bool), 12.0, 30.0, "flat", 0, "r")


def terrain(stamp_ns: int, origin: tuple[float, float], heights: Array) -> TerrainMap:
    h = heights.astype(np.float32)
    none = np.zeros(h.shape, dtype=bool)
    return TerrainMap(stamp_ns, 0.01, np.array(origin), h, h, h, none, none.astype(np.int8))


def poses(seed: int, n: int = 20) -> list[tuple[int, Array]]:
    rng = np.random.default_rng(seed)
    return [(S + k * S // 10, from_xyz_rpy(rng.normal(size=3), rng.uniform(-1, 1, 3))) for k in range(n)]


def test_estimated_and_true_trajectory_read_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    estimated, true = poses(1), poses(2)
    messages = [pose(*one) for one in estimated] + [truth(*one) for one in true]
    source = recording(tmp_path / "r.mcap", sorted(messages, key=lambda m: m.stamp_ns))
    assert cli.main(["recording", "export", str(source), "--tum", str(tmp_path / "walk.txt")]) == 0
    assert capsys.readouterr().out == f"{tmp_path}/walk.txt: 20 poses\n{tmp_path}/walk_true.txt: 20 poses\n"
    for name, expected in (("walk.txt", estimated), ("walk_true.txt", true)):
        found = read_trajectory(tmp_path / name)
        assert found.stamps_ns.tolist() == [stamp_ns for stamp_ns, _ in expected]
        np.testing.assert_allclose(found.T_world_camera, [T for _, T in expected], atol=1e-8)


def test_without_truth_there_is_one_file_and_equal_times_count_once(tmp_path: Path) -> None:
    (first, T0), (_, T1) = poses(3, 2)
    source = recording(tmp_path / "r.mcap", [pose(first, T0), pose(first + 10, T1)])
    assert export_trajectories(source, tmp_path / "walk.txt") == {tmp_path / "walk.txt": 1}
    np.testing.assert_allclose(read_trajectory(tmp_path / "walk.txt").T_world_camera[0], T1, atol=1e-8)


def test_merged_map_has_the_newest_height_of_each_cell() -> None:
    old = terrain(0, (0.0, 0.0), np.zeros((4, 4)))
    new = terrain(S, (0.02, -0.01), np.array([[1.0, np.nan], [2.0, 3.0]]))
    heights, origin = merged([old, new])
    np.testing.assert_allclose(origin, (0.0, -0.01))
    expected = np.full((4, 5), np.nan)
    expected[:, 1:] = 0.0
    expected[2, 0], expected[3, 0], expected[3, 1] = 1.0, 2.0, 3.0
    np.testing.assert_array_equal(heights, expected)


def test_exported_map_is_ground_of_a_scenario(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    heights = np.random.default_rng(0).uniform(0, 0.05, (30, 20))
    source = recording(tmp_path / "r.mcap", [terrain(0, (-0.1, -0.05), heights), terrain(2 * S, (-0.1, -0.05), heights)])
    assert cli.main(["recording", "export", str(source), "--map", str(tmp_path / "map.npy")]) == 0
    assert "30 x 20 heights" in capsys.readouterr().out
    about = json.loads((tmp_path / "map.json").read_text())
    course = f"""name = "again"
[goal]
distance = 0.1
[[terrain]]
kind = "height_map"
file = "map.npy"
resolution = {about["resolution_m"]}
xy = {about["origin_m"]}
"""
    (tmp_path / "again.toml").write_text(course)
    ground = build_terrain(load_scenario(str(tmp_path / "again.toml")), np.random.default_rng(0))
    ij = np.random.default_rng(1).integers(1, 19, (50, 2))
    xy = np.array(about["origin_m"]) + about["resolution_m"] * ij
    np.testing.assert_allclose(ground.height_at(xy), heights[ij[:, 0], ij[:, 1]], atol=1e-6)


def test_exported_grid_map_is_ground(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    heights = np.random.default_rng(0).uniform(0, 0.05, (30, 20)).astype(np.float32)
    source = recording(tmp_path / "r.mcap", [terrain(2 * S, (-0.1, -0.05), heights)])
    target = tmp_path / "map.mcap"
    assert cli.main(["recording", "export", str(source), "--grid-map", str(target)]) == 0
    assert "a GridMap of 30 x 20 heights on /terrain" in capsys.readouterr().out
    with AnyReader([target]) as reader:  # by the definitions in the file
        ((channel, _, data),) = reader.messages()
        message: Any = reader.deserialize(data, channel.msgtype)
    assert (channel.topic, message.layers, message.info.length_x) == ("/terrain", ["elevation"], pytest.approx(0.3))
    stored = message.data[0].data.reshape(20, 30).T  # column by column, from the largest x and y on
    np.testing.assert_array_equal(stored[::-1, ::-1], heights)
    (tmp_path / "again.toml").write_text(
        'name = "again"\n[goal]\ndistance = 0.1\n[[terrain]]\nkind = "height_map"\nfile = "map.mcap"\n'
    )
    ground = build_terrain(load_scenario(str(tmp_path / "again.toml")), np.random.default_rng(0))
    ij = np.random.default_rng(1).integers(1, 19, (50, 2))
    xy = np.array([-0.1, -0.05]) + 0.01 * ij
    np.testing.assert_allclose(ground.height_at(xy), heights[ij[:, 0], ij[:, 1]], atol=1e-6)


def test_grid_map_does_not_replace_its_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = recording(tmp_path / "r.mcap", [terrain(0, (0.0, 0.0), np.zeros((4, 4)))])
    before = source.read_bytes()
    assert cli.main(["recording", "export", str(source), "--grid-map", str(source)]) == 2
    assert "--grid-map: a file other than the recording's expected" in capsys.readouterr().err
    assert source.read_bytes() == before


def test_recording_without_poses_or_maps_is_refused(tmp_path: Path) -> None:
    source = recording(tmp_path / "r.mcap", [truth(*poses(1, 1)[0])])
    with pytest.raises(RecordingError, match="no pose of perception/pose"):
        export_trajectories(source, tmp_path / "walk.txt")
    with pytest.raises(RecordingError, match="no map of mapper/terrain"):
        export_map(source, tmp_path / "map.npy")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "at least one of --rerun, --tum, --map, --grid-map expected, found none"),
        (["--tum", "walk.csv"], "--tum: a file that ends in .txt expected, found walk.csv"),
        (["--map", "map.png"], "--map: a file that ends in .npy expected, found map.png"),
        (["--tum", "walk.txt"], "gone.mcap"),
    ],
)
def test_wrong_input_is_refused(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["recording", "export", "gone.mcap", *words]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1
