"""A recorded depth camera, replayed through perception and mapper.

The recording of a walk is in the TUM RGB-D layout.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from sextant.deploy import cli
from sextant.evaluation.replay.tum_recording import record_tum
from sextant.services.perception import tum
from sextant.shared.geometry import apply
from sextant.shared.robot.profiles import load_profile
from sextant.shared.scenario.loading import load_scenario

ROOT = Path(__file__).parents[2]
WALKED_S = 7.0  # [s] the robot stands up for two and a half
STEPS = load_scenario("steps")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record the beginning of a walk over the steps course."""
    folder = tmp_path_factory.mktemp("recorded") / "sequence"
    record_tum(STEPS, 1000, folder, WALKED_S)
    return folder


def test_recorded_walk_has_true_pose_for_every_image(recorded: Path) -> None:
    sequence = tum.read_recording(recorded)
    camera = load_profile(STEPS.robot).camera
    assert abs(len(sequence) - WALKED_S * camera.sensor.rate_hz) <= 2
    assert sequence.camera.intrinsics == camera.intrinsics
    assert sequence.truth is not None
    way = np.array([sequence.truth.at(int(stamp)) for stamp in sequence.stamps_ns])
    assert way.shape == (len(sequence), 4, 4)
    assert np.abs(np.diff(way[:, :3, 3], axis=0)).max() < 0.02, "without jumps"
    assert way[-1, 0, 3] - way[0, 0, 3] > 0.2, "it walked ahead"
    # Pitched down and level: the optical axis points ahead and down, the picture's right is the robot's right.
    ahead, down = np.cos(np.radians(camera.pitch_down_deg)), np.sin(np.radians(camera.pitch_down_deg))
    assert np.allclose(way[0, :3, 2], [ahead, 0.0, -down], atol=0.02)
    assert np.allclose(way[0, :3, 0], [0.0, -1.0, 0.0], atol=0.02)
    # In the first picture the points before the first block lie at the true ground's height.
    depth = sequence.depth(0) / camera.sensor.depth_scale
    points = apply(way[0], sequence.camera.intrinsics.points(depth)[depth > 0])
    ground = points[points[:, 0] < 0.75]
    assert len(ground) > 1000
    assert abs(np.median(ground[:, 2])) < 0.005


def test_existing_recording_is_not_overwritten(recorded: Path) -> None:
    with pytest.raises(FileExistsError, match="already contains a recording"):
        record_tum(STEPS, 1000, recorded, 0.1)


def test_replay_command_matches_ground_truth_and_prints_json(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["recording", "replay", str(recorded), "--out", str(tmp_path), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    assert table["poses"] == table["frames"]
    assert table["pose_error_m"]["rms"] <= 0.015
    assert (tmp_path / "map.png").stat().st_size > 1000
    assert len(tum.read_trajectory(tmp_path / "trajectory.txt").stamps_ns) == table["poses"]
    assert set(table) >= {"pose_error_m", "map_error_m", "stages_ms"}
    assert {path.name for path in tmp_path.iterdir()} == {"layers.png", "map.png", "replay.json", "trajectory.txt"}
