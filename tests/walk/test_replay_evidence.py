"""`sextant recording replay` on synthetic sequences.

The exit status is 0 only if the pictures support the trajectory.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sextant.deploy import cli
from tests.support.depth_folders import RATE_HZ, room, write_folder
from tests.support.raycast import camera_pose

NOTHING = np.zeros((0, 6))


def replayed(folder: Path, out: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any], str]:
    """Return exit status, table and last line on stderr."""
    status = cli.main(["recording", "replay", str(folder), "--out", str(out), "--json"])
    found = capsys.readouterr()
    return status, json.loads(found.out), found.err.splitlines()[-1]


def ahead(n: int, speed: float) -> np.ndarray:
    """Return the camera's pose after n pictures at a speed [m/s], 0.6 m high."""
    return np.asarray(camera_pose(speed * n / RATE_HZ, z=0.6))


def test_images_of_room_support_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "room", [ahead(n, 0.5) for n in range(30)], room())
    status, table, _ = replayed(folder, tmp_path, capsys)
    assert status == 0
    assert table["evidence"]["supported"]
    assert table["evidence"]["pictures_supporting"] == 29
    assert table["pose_error_m"]["rms"] < 0.01
    assert len(table["pictures"]) == 30
    assert all(picture["unobservable"] == [] for picture in table["pictures"][1:])
    assert 0.5 < table["evidence"]["depth_m"]["median"] < 2.5


def test_images_of_bare_floor_do_not_support_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "bare", [ahead(n, 0.5) for n in range(30)], NOTHING)
    status, table, error = replayed(folder, tmp_path, capsys)
    assert status == 1
    assert table["evidence"]["unobservable"] == {"x": 29, "y": 29, "yaw": 29}
    assert all(picture["unobservable"] == ["x", "y", "yaw"] for picture in table["pictures"][1:])
    assert "x, y, yaw unobservable" in error
    assert error.startswith("sextant recording replay: 0 of 29 pictures")


def test_wrong_depth_scale_is_reported_with_one_that_fits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "scale", [ahead(n, 0.5) for n in range(10)], room(), depth_scale=5000.0)
    status, table, error = replayed(folder, tmp_path, capsys)
    assert status == 1
    assert table["evidence"]["fitting_depth_scale"] == 1000.0
    assert "depth_scale = 1000 in camera.toml fits" in error


def test_near_surfaces_require_smaller_min_range(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Show boxes 0.35 to 0.48 m below a camera that looks down."""
    boxes = [[x, y, 0, x + 0.06, y + 0.06, h] for x, y, h in ((-0.1, -0.1, 0.1), (0.05, 0.0, 0.06), (0.0, 0.12, 0.03))]
    poses = [np.asarray(camera_pose(0.1 * n / RATE_HZ, z=0.48, pitch=np.pi / 2)) for n in range(10)]
    status, _, error = replayed(write_folder(tmp_path / "far", poses, np.array(boxes)), tmp_path, capsys)
    assert status == 1
    assert "set min_range and max_range in camera.toml" in error
    near = write_folder(tmp_path / "near", poses, np.array(boxes), min_range=0.2)
    status, table, _ = replayed(near, tmp_path, capsys)
    assert status == 0
    assert table["pose_error_m"]["rms"] < 0.01


def test_jump_to_similar_place_does_not_support_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Repeat the boxes every 0.45 m: after a cut of 3 m each picture registers at a wrong place."""
    corners = np.array([(0.45 * i, 0.4 * j) for i in range(1, 18) for j in range(-3, 4)])
    heights = np.array([0.06 + 0.05 * (i % 3) for i in range(len(corners))])
    boxes = np.column_stack([corners, np.zeros(len(corners)), corners + 0.15, heights])
    poses = [np.asarray(camera_pose(0.2 * n / RATE_HZ + (3.0 if n >= 10 else 0.0), z=0.6)) for n in range(16)]
    status, table, error = replayed(write_folder(tmp_path / "cut", poses, boxes, truth=False), tmp_path, capsys)
    assert table["evidence"]["pictures_supporting"] == 15
    assert (status, table["evidence"]["supported"]) == (1, False)
    assert "the trajectory jumps by" in error
    assert "from 0.30 to 0.33 s" in error
    assert "different places may look alike" in error
