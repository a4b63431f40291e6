import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sextant.deploy import cli
from sextant.evaluation.observers.progress import Silent
from sextant.evaluation.observers.run_observers import about
from sextant.evaluation.replay import sequence as replay
from sextant.evaluation.replay.error import ReplayError
from sextant.evaluation.replay.sequence import HandHeld, Player
from sextant.evaluation.replay.walk import in_words, map_difference, problem_of, replay_recording
from sextant.services.mapper.config import Settings
from sextant.services.mapper.service import Mapper
from sextant.services.perception import tum
from sextant.services.planner.locomotion.plan_tracking import UNKNOWN_STEP
from sextant.shared.geometry import exp_se3, from_xyz_rpy, transform
from sextant.shared.recording.writer import Recorder
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic, Inbox, ServiceRunner, Stages
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.scenario.scenario import MapOptions
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose, ColorImage, DepthImage, Odometry, Scan, TerrainMap, Tick

S = 1_000_000_000
INTRINSICS = Intrinsics(8, 6, 7.0, 7.0, 3.5, 2.5)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write five pictures at 30 Hz, beginning at 100 s.

    The camera looks 40 degrees down and 5 degrees to the side.
    """
    camera = tum.Camera(INTRINSICS, 1000.0, 30.0, np.array([0.0, 0.0, -1.0]))
    with tum.RecordingWriter(tmp_path / "sequence", camera) as writer:
        for i in range(5):
            writer.add(100 * S + i * S // 30, np.full((6, 8), 1000 + i, np.uint16), tilted_camera_pose(i))
    return tmp_path / "sequence"


def tilted_camera_pose(i: int) -> np.ndarray:
    mounted = load_profile("phantomx_mk2").camera.T_body_camera
    return np.asarray(from_xyz_rpy((0.1 * i, 0.0, 1.0), np.radians((5.0, 10.0, 30.0))) @ mounted)


def test_hand_held_camera_body_frame_is_level(folder: Path) -> None:
    sequence = tum.read_recording(folder)
    assert sequence.truth is not None
    T_body_camera = replay.profile_for(sequence).camera.T_body_camera
    R = T_body_camera[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3))
    assert np.isclose(np.linalg.det(R), 1.0)
    down = tilted_camera_pose(0)[:3, :3].T @ [0.0, 0.0, -1.0]
    assert np.allclose(R @ down, [0.0, 0.0, -1.0]), "gravity is straight down in the body"
    assert R[0, 2] > 0, "the camera looks ahead"
    assert abs(R[1, 2]) < 1e-9, "and to neither side"


def test_hand_held_camera_without_roll_equals_mounted_one() -> None:
    mounted = load_profile("phantomx_mk2").camera
    down = mounted.T_body_camera[:3, :3].T @ [0.0, 0.0, -1.0]
    held = HandHeld(mounted.intrinsics, mounted.sensor, mounted.mount_xyz, 0.0, down=tuple(down))
    assert np.allclose(held.T_body_camera, mounted.T_body_camera)


def test_downward_camera_has_valid_body_frame() -> None:
    mounted = load_profile("phantomx_mk2").camera
    R = HandHeld(mounted.intrinsics, mounted.sensor, (0.0, 0.0, 0.0), 0.0, down=(0.0, 0.0, 1.0)).T_body_camera[:3, :3]
    assert np.allclose(R @ [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    assert np.isclose(np.linalg.det(R), 1.0)


def test_player_publishes_each_picture_once_and_not_early(folder: Path) -> None:
    player = Player(tum.read_recording(folder), DepthSensor())
    inbox = Inbox((), Stages())
    played: list[DepthImage] = []
    for beat in range(40):
        made = [m for m in player.step(Tick(beat * 5_000_000), inbox) if isinstance(m, DepthImage)]
        assert all(m.stamp_ns <= beat * 5_000_000 for m in made)
        played += made
    assert player.finished
    assert [m.depth[0, 0] for m in played] == [1000, 1001, 1002, 1003, 1004]
    assert played[0].stamp_ns == 0


def test_color_is_paired_with_nearest_depth_frame(folder: Path) -> None:
    (folder / "rgb").mkdir()
    lines = []
    for i, second in enumerate(("100.004", "100.130", "100.500")):
        cv2.imwrite(str(folder / "rgb" / f"{i}.png"), np.full((6, 8, 3), (10 * i, 100, 200), np.uint8))  # blue first
        lines.append(f"{second} rgb/{i}.png")
    (folder / "rgb.txt").write_text("\n".join(lines), encoding="utf-8")
    sequence = tum.read_recording(folder)
    colors = [sequence.color(index) for index in range(5)]
    assert [c is None for c in colors] == [False, True, True, True, False]
    assert colors[0] is not None
    np.testing.assert_array_equal(colors[0][0, 0], [200, 100, 0])
    assert replay.profile_for(sequence).camera.color
    made = list(Player(sequence, DepthSensor()).step(Tick(S), Inbox((), Stages())))
    assert [m.stamp_ns for m in made if isinstance(m, ColorImage)] == [0], "at most five a second"
    (folder / "rgb" / "0.png").write_bytes(b"nothing")
    with pytest.raises(ReplayError, match="a PNG or JPEG picture expected"):
        list(Player(sequence, DepthSensor()).step(Tick(0), Inbox((), Stages())))


def test_missing_camera_file_is_reported(folder: Path, tmp_path: Path) -> None:
    (folder / "camera.toml").unlink()
    with pytest.raises(ReplayError, match=r"camera\.toml: no such file"):
        replay.replay_folder(folder, tmp_path, Silent())


def test_missing_depth_image_is_reported(folder: Path) -> None:
    sequence = tum.read_recording(folder)
    (folder / sequence.files[0]).unlink()
    with pytest.raises(ReplayError, match="no such file"):
        list(Player(sequence, DepthSensor()).step(Tick(0), Inbox((), Stages())))


def terrain(elevation: np.ndarray) -> TerrainMap:
    layer = elevation.astype(np.float32)
    flags, cells = np.zeros(layer.shape, dtype=np.bool_), np.zeros(layer.shape, dtype=np.int8)
    return TerrainMap(0, 0.01, np.zeros(2), layer, layer, layer, flags, cells)


def test_map_difference_of_equal_shifted_and_partial_maps() -> None:
    rng = np.random.default_rng(0)
    heights = rng.normal(size=(20, 30))
    heights[:5] = np.nan
    same = map_difference([(terrain(heights), terrain(heights))])
    assert same == {"rmse": 0.0, "bias": 0.0, "p95": 0.0, "coverage": 1.0}
    higher = map_difference([(terrain(heights), terrain(heights + 0.01))])
    assert higher["bias"] == higher["rmse"] == higher["p95"] == 0.01
    half = heights.copy()
    half[:, ::2] = np.nan
    assert map_difference([(terrain(heights), terrain(half))])["coverage"] == 0.5
    assert map_difference([])["rmse"] is None


def scan(stamp_ns: int, rng: np.random.Generator) -> Scan:
    points = np.column_stack([rng.integers(300, 900, (400, 2)), rng.integers(-5, 5, 400)]).astype(np.int16)
    count, spread = np.full(400, 9, np.uint8), np.full(400, 2, np.uint8)
    return Scan(stamp_ns, np.zeros(3), points, count, spread, np.array([0.1, 0.0, 0.2]), 1e-6 * np.eye(6))


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Record a run of thirty scans through the mapper."""
    return record(tmp_path, {}, Settings())


def record(tmp_path: Path, about: dict[str, str], settings: Settings) -> Path:
    path, rng, now_ns = tmp_path / "recording.mcap", np.random.default_rng(1), [0]
    with Recorder(path, {"scenario": "made up", "robot": "phantomx_mk2", **about}) as recorder:
        mapper = ServiceRunner(Mapper(load_profile("phantomx_mk2"), settings), recorder.write, lambda: now_ns[0])
        for i in range(30):
            now_ns[0] = i * S // 5
            pose = BodyPose(now_ns[0], np.eye(4), np.eye(4), np.zeros((6, 6)), 1.0, True, "", np.zeros((0, 6)))
            for message in (pose, scan(now_ns[0], rng)):
                topic: AnyTopic = topics.OF_TYPE[type(message)]
                frame = codec.encode(message)
                recorder.write(topic, frame, now_ns[0])
                mapper.inbox.receive(topic, frame, now_ns[0])
            mapper.arrived()
    return path


@pytest.mark.slow
def test_replayed_run_reproduces_recorded_maps(recorded: Path, tmp_path: Path) -> None:
    table = replay_recording(recorded, tmp_path, Silent())
    assert table["complete"]
    assert table["topics"]["perception/scan"] == 30
    assert 2 <= table["maps"]["compared"] == table["maps"]["recorded"] < table["maps"]["made"]
    assert table["map_error_m"]["rmse"] == 0.0
    assert table["map_error_m"]["coverage"] == 1.0
    assert "differ by 0.00 mm" in in_words(table)


@pytest.mark.slow
def test_replay_command_accepts_recording_or_its_folder(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert cli.main(["recording", "replay", str(recorded), "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["map_error_m"]["rmse"] == 0.0
    assert cli.main(["recording", "replay", str(recorded.parent), "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["map_error_m"]["rmse"] == 0.0
    assert cli.main(["recording", "replay", str(recorded), "--only", "perception/pose", "--out", str(out), "--json"]) == 1
    found = capsys.readouterr()
    assert "nothing was compared: 6 maps" in found.err
    assert json.loads(found.out)["evidence"]["problem"] in found.err
    assert cli.main(["recording", "replay", str(recorded), "--only", "perception/skan", "--out", str(out)]) == 2
    assert "did you mean 'perception/scan'" in capsys.readouterr().err


def replay_table(**changed: Any) -> dict[str, Any]:
    """Return the result of an exact replay of a lockstep run, with changed entries."""
    error = {"rmse": 0.0, "bias": 0.0, "p95": 0.0, "coverage": 1.0}
    off = {"touchdown_p50": 0.0, "touchdown_p95": 0.0, "touchdown_max": 0.0, "body_max": 0.0}
    counts = {"made": 20, "recorded": 10, "compared": 10}
    maps, said = counts | {"coverage_at_start": 1.0}, {"stepping": 9}
    of_run = {"about": {"run": "lockstep"}, "said": said}
    whole = of_run | {"maps": maps, "plans": counts, "map_error_m": error, "plan_error_m": off}
    return {key: {**value, **changed.get(key, {})} for key, value in whole.items()}


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({}, ""),
        ({"maps": {"compared": 0}, "plans": {"compared": 0}}, "nothing was compared"),
        ({"maps": {"compared": 0}}, "no map was compared: 10 were recorded, 20 made"),
        ({"plans": {"compared": 0}}, "no plan was compared"),
        ({"plans": {"compared": 0, "recorded": 0}}, ""),
        (
            {"plans": {"compared": 0, "made": 0}, "said": {f"waiting: {UNKNOWN_STEP}": 62}},
            "no plan was compared: 10 were recorded, 0 made now, because the recording begins during a step.*robot stands",
        ),
        (
            {"about": {"run": "live"}, "maps": {"coverage_at_start": 0.4}, "map_error_m": {"coverage": 0.6}},
            "only 60.0% of the recorded cells .* had mapped ground before the recording began; begin .* before its first walk",
        ),
        ({"map_error_m": {"rmse": 0.0004}}, "maps are 0.4 mm rms off"),
        ({"map_error_m": {"coverage": 0.99}}, "only 99.0% of the recorded cells"),
        ({"map_error_m": {"rmse": None, "coverage": None}}, r"only 0.0% of the recorded cells"),
        ({"plan_error_m": {"touchdown_max": 0.003}}, "touchdowns are 3.0 mm off the recorded ones at most"),
        ({"about": {"run": "live"}, "map_error_m": {"rmse": 0.004, "coverage": 0.95}}, ""),
        ({"about": {"run": "live"}, "map_error_m": {"rmse": 0.02}}, "maps are 20.0 mm rms off"),
        ({"about": {"run": "live"}, "plan_error_m": {"touchdown_max": 0.5}}, ""),
        ({"about": {"run": "live"}, "plan_error_m": {"touchdown_p50": 0.05}}, "in the median, 20 mm allowed"),
    ],
)
def test_replay_mismatch_with_recording_is_reported(changed: dict[str, Any], problem: str) -> None:
    found = problem_of(replay_table(**changed))
    assert re.search(problem, found) if problem else found == ""


def test_partial_replay_skips_checks_of_other_topics() -> None:
    assert problem_of(replay_table(plans={"compared": 0}, map_error_m={"rmse": 0.004}), everything=False) == ""


@pytest.mark.slow
def test_run_with_custom_map_size_is_reproduced(tmp_path: Path) -> None:
    scenario = replace(load_scenario("flat"), map=MapOptions(cells=120, cells_y=100, resolution=0.02))
    path = record(tmp_path, about(scenario, 0, "live"), Settings(cells=120, cells_y=100, resolution=0.02))
    table = replay_recording(path, tmp_path, Silent())
    assert table["maps"]["compared"] >= 2
    assert table["map_error_m"]["rmse"] == 0.0


def test_map_size_mismatch_is_refused(tmp_path: Path) -> None:
    path = record(tmp_path, {}, Settings(cells=120, cells_y=100, resolution=0.02))
    with pytest.raises(ReplayError, match=r"120x100 cells of 0\.02 m.* recorded.*256x256 cells of 0\.01 m.* made"):
        replay_recording(path, tmp_path, Silent())
    with pytest.raises(ReplayError, match="are invalid"):
        replay_recording(record(tmp_path, {"map.cells": "many"}, Settings()), tmp_path, Silent())


@pytest.mark.slow
def test_truncated_recording_is_replayed_up_to_its_end(recorded: Path, tmp_path: Path) -> None:
    data = recorded.read_bytes()
    recorded.write_bytes(data[: len(data) - 40])
    table = replay_recording(recorded, tmp_path, Silent())
    assert not table["complete"]
    assert table["topics"]["perception/scan"] == 30
    recorded.write_bytes(data[:100])
    with pytest.raises(ReplayError, match="no messages"):
        replay_recording(recorded, tmp_path, Silent())


def test_sequence_profile_changes_only_camera(folder: Path) -> None:
    default = load_profile("phantomx_mk2")
    found = replay.profile_for(tum.read_recording(folder))
    assert found.camera.intrinsics == INTRINSICS
    assert replace(found, camera=default.camera) == default


def test_constant_velocity_guess_predicts_steady_motion_exactly() -> None:
    """Guess the next true pose together with perception.

    Perception composes its correction with the guess, so both together must give the next true pose.
    """
    guess = replay.ConstantVelocity(S // 30)
    inbox = Inbox((), Stages())
    step = exp_se3(np.array([0.01, -0.004, 0.002, 0.01, 0.02, -0.03]))
    rng = np.random.default_rng(0)
    T = np.eye(4)
    for i in range(6):
        T_world_odom = exp_se3(rng.normal(0.0, 0.1, 6))  # accumulated correction by registration
        pose = BodyPose(i * S // 30, T, T_world_odom, np.zeros((6, 6)), 1.0, True, "", np.zeros((0, 6)))
        (said,) = guess.step(pose, inbox)
        assert isinstance(said, Odometry)
        assert said.reliable is (i > 0), "one pose shows no velocity"
        assert abs(said.stamp_ns - (i + 1) * S / 30) <= 2
        if i:
            assert np.allclose(T_world_odom @ said.T_odom_body, T @ step, atol=1e-8)
        T = T @ step
    assert guess.status().startswith("predicting")


@pytest.mark.slow
def test_simulated_sequence_replay_matches_ground_truth(tmp_path: Path) -> None:
    """Replay a camera that moves steadily past a wall with a step and over a floor.

    The depth frames are drawn by the rays of their pixels.
    """
    profile = load_profile("phantomx_mk2")
    camera = tum.Camera(Intrinsics(640, 480, 570.0, 570.0, 319.5, 239.5), 1000.0, 30.0, np.array([0.0, 0.0, -1.0]))
    with tum.RecordingWriter(tmp_path / "sequence", camera) as writer:
        for i in range(12):
            T = from_xyz_rpy((0.004 * i, 0.003 * i, 0.45), (0.0, 0.0, 0.003 * i)) @ transform(
                profile.camera.T_body_camera[:3, :3], np.zeros(3)
            )
            writer.add(i * S // 30, corner_depth_mm(camera.intrinsics, T), T)
    table = replay.replay_folder(tmp_path / "sequence", tmp_path, Silent())
    assert table["poses"] == 12
    assert table["poses_not_ok"] == 0
    assert table["pose_error_m"]["rms"] < 0.005
    assert (tmp_path / "map.png").stat().st_size > 1000
    assert (tmp_path / "layers.png").stat().st_size > 1000
    written = tum.read_trajectory(tmp_path / "trajectory.txt")
    assert len(written.stamps_ns) == 12
    assert set(table["stages_ms"]) >= {"perception", "perception.registration", "mapper"}


def corner_depth_mm(intrinsics: Intrinsics, T_world_camera: np.ndarray) -> np.ndarray:
    """Return the depth [mm] of a floor at z = 0 with a block, and of two walls.

    The walls are at x = 1.6 and y = 0.9.
    """
    rays = intrinsics.points(np.ones((intrinsics.height, intrinsics.width))) @ T_world_camera[:3, :3].T
    p = T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(rays[..., 2] < 0, -p[2] / rays[..., 2], np.inf)
        for axis, at in ((0, 1.6), (1, 0.9)):
            depth = np.minimum(depth, np.where(rays[..., axis] > 0, (at - p[axis]) / rays[..., axis], np.inf))
        top = (0.08 - p[2]) / rays[..., 2]
        hit = p + top[..., None] * rays
        on_block = (rays[..., 2] < 0) & (np.abs(hit[..., 0] - 1.0) < 0.15) & (np.abs(hit[..., 1]) < 0.2)
    depth = np.where(on_block, np.minimum(depth, top), depth)
    return np.where((depth > 0.5) & (depth < 3.5), depth * 1000, 0).round().astype(np.uint16)
