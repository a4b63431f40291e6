"""TUM recordings: round trip, and errors that name the faulty place."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.perception.tum import (
    Camera,
    RecordingWriter,
    Trajectory,
    read_recording,
    read_trajectory,
    write_trajectory,
)
from sextant.shared.files.input_file import FileError
from sextant.shared.files.whole_files import WriteError
from sextant.shared.geometry import from_xyz_rpy
from sextant.shared.robot.camera import Intrinsics

CAMERA = Camera(Intrinsics(32, 24, 30.0, 31.0, 15.5, 11.5), 1000.0, 15.0, np.array([0.0, 0.0, -1.0]))


def random_poses(n, seed=0):
    rng = np.random.default_rng(seed)
    return from_xyz_rpy(rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))


@pytest.fixture
def recorded(tmp_path):
    rng = np.random.default_rng(1)
    images = rng.integers(0, 65536, (4, 24, 32), dtype=np.uint16)
    poses = random_poses(4)
    stamps = [1_700_000_000_123_456_000 + 66_667_000 * i for i in range(4)]
    with RecordingWriter(tmp_path / "run", CAMERA) as writer:
        for stamp, image, T in zip(stamps, images, poses, strict=True):
            writer.add(stamp, image, T)
    return tmp_path / "run", stamps, images, poses


def test_recording_round_trip(recorded):
    folder, stamps, images, poses = recorded
    recording = read_recording(folder)
    assert recording.camera.intrinsics == CAMERA.intrinsics
    assert (recording.camera.depth_scale, recording.camera.rate_hz) == (1000.0, 15.0)
    np.testing.assert_array_equal(recording.camera.gravity_world, CAMERA.gravity_world)
    assert recording.stamps_ns.tolist() == stamps
    for (stamp, image), expected_stamp, expected, T in zip(recording.frames(), stamps, images, poses, strict=True):
        assert stamp == expected_stamp
        np.testing.assert_array_equal(image, expected)
        np.testing.assert_allclose(recording.truth.at(stamp), T, atol=1e-7)


def test_recording_without_ground_truth_is_read(tmp_path):
    with RecordingWriter(tmp_path, CAMERA) as writer:
        writer.add(0, np.zeros((24, 32), np.uint16))
    recording = read_recording(tmp_path)
    assert len(recording) == 1
    assert recording.truth is None


@settings(max_examples=60, deadline=None)
@given(name=st.sampled_from(["depth.txt", "groundtruth.txt", "camera.toml"]), garbage=st.binary(max_size=80))
def test_invalid_file_is_refused_by_name(tmp_path_factory, name, garbage):
    folder = tmp_path_factory.mktemp("garbage")
    with RecordingWriter(folder, CAMERA) as writer:
        writer.add(0, np.zeros((24, 32), np.uint16), np.eye(4))
    (folder / name).write_bytes(garbage)
    with pytest.raises(ValueError, match=name):
        read_recording(folder)


def test_ground_truth_is_interpolated_but_not_extrapolated():
    poses = random_poses(3, 2)
    truth = Trajectory(np.array([0, 50_000_000, 900_000_000]), poses)
    np.testing.assert_allclose(truth.at(25_000_000)[:3, 3], poses[:2, :3, 3].mean(axis=0))
    assert truth.at(-1) is None
    assert truth.at(900_000_001) is None
    assert truth.at(500_000_000) is None  # in a gap


def test_trajectory_round_trip(tmp_path):
    trajectory = Trajectory(np.array([0, 1_000, 33_333_000]), random_poses(3, 3))
    write_trajectory(tmp_path / "t.txt", trajectory)
    again = read_trajectory(tmp_path / "t.txt")
    assert again.stamps_ns.tolist() == trajectory.stamps_ns.tolist()
    np.testing.assert_allclose(again.T_world_camera, trajectory.T_world_camera, atol=1e-7)


@pytest.mark.parametrize("name", ["depth.txt", "camera.toml"])
def test_missing_file_is_reported(recorded, name):
    (recorded[0] / name).unlink()
    with pytest.raises(FileError, match=name):
        read_recording(recorded[0])


def test_missing_folder_or_image_is_reported(recorded, tmp_path):
    with pytest.raises(FileError, match="nowhere"):
        read_recording(tmp_path / "nowhere")
    recording = read_recording(recorded[0])
    (recorded[0] / recording.files[2]).unlink()
    with pytest.raises(FileError, match=r"depth\.txt of the recording names it"):
        recording.depth(2)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("depth.txt", "# nothing\n", "at least one"),
        ("depth.txt", "0.0 a.png b.png\n", r"depth\.txt:1: 2 fields expected, found 3"),
        ("depth.txt", "0.0 a.png\nsoon b.png\n", r"depth\.txt:2: a number expected, found 'soon'"),
        ("depth.txt", "1.0 a.png\n0.5 b.png\n", r"depth\.txt:2: ascending times"),
        ("depth.txt", "-1.0 a.png\n", r"depth\.txt:1: a time in seconds"),
        ("groundtruth.txt", "0.0 0 0 0 0 0 0\n", r"groundtruth\.txt:1: 8 fields expected"),
        ("groundtruth.txt", "0.0 0 0 0 0 0 0 0\n", "unit quaternion"),
        ("groundtruth.txt", "0.0 nan 0 0 0 0 0 1\n", "finite"),
        ("camera.toml", "width = ", r"camera\.toml: no valid TOML"),
        ("camera.toml", "width = 640\n", "height: missing; a whole number is needed"),
        ("camera.toml", "width = 6.5\nheight = 4\n", "width: a whole number expected, found 6.5"),
    ],
)
def test_malformed_line_is_reported(recorded, name, text, message):
    (recorded[0] / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        read_recording(recorded[0])


def test_gravity_must_be_unit_vector(recorded):
    path = recorded[0] / "camera.toml"
    path.write_text(path.read_text().replace("[0.0, 0.0, -1.0]", "[0.0, 0.0, -9.81]"))
    with pytest.raises(ValueError, match="unit vector"):
        read_recording(recorded[0])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("min_rage = 0.3", "min_rage: unknown key; did you mean 'min_range'?"),
        ("k1 = -0.28", r"k1: 0 \(distortion is not corrected here.* expected, found -0.28"),
        ("max_range = 0.2", "min_range: min_range below max_range expected"),
        ("cells = 4", "cells: unknown key"),
    ],
)
def test_invalid_camera_toml_is_refused(recorded, line, message):
    path = recorded[0] / "camera.toml"
    text = path.read_text()
    kept = [old for old in text.splitlines() if old.split(" =")[0] != line.split(" =")[0]]
    path.write_text("\n".join([line, *kept]))
    with pytest.raises(ValueError, match=message):
        read_recording(recorded[0])
    path.write_text("k1 = 0.0\n" + text)  # a file may state that there is no distortion
    assert len(read_recording(recorded[0])) == 4


def test_sensor_range_is_written_and_read(tmp_path):
    camera = replace(CAMERA, min_range=0.15, max_range=1.5)
    with RecordingWriter(tmp_path, camera) as writer:
        writer.add(0, np.zeros((24, 32), np.uint16))
    sensor = read_recording(tmp_path).camera.sensor
    assert (sensor.min_range, sensor.max_range, sensor.depth_scale) == (0.15, 1.5, 1000.0)


def test_non_png_image_is_refused(recorded):
    recording = read_recording(recorded[0])
    (recorded[0] / recording.files[0]).write_bytes(b"no picture")
    with pytest.raises(ValueError, match="a PNG picture expected, found something else"):
        recording.depth(0)


def test_writer_refuses_invalid_frames_and_existing_folder(recorded, tmp_path):
    with pytest.raises(FileExistsError, match="another folder"):
        RecordingWriter(recorded[0], CAMERA)
    with RecordingWriter(tmp_path / "other", CAMERA) as writer:
        image = np.zeros((24, 32), np.uint16)
        writer.add(1000, image, np.eye(4))
        with pytest.raises(ValueError, match="1 us after"):
            writer.add(1999, image, np.eye(4))
        with pytest.raises(ValueError, match="uint16 depth image"):
            writer.add(5000, image.astype(np.float32), np.eye(4))
    assert len(read_recording(tmp_path / "other")) == 1


def test_failed_frame_write_leaves_recording_unchanged(tmp_path):
    with RecordingWriter(tmp_path / "run", CAMERA) as writer:
        shape = (CAMERA.intrinsics.height, CAMERA.intrinsics.width)
        writer.add(10**9, np.full(shape, 700, dtype=np.uint16), np.eye(4))
        (tmp_path / "run" / "depth").rename(tmp_path / "gone")
        with pytest.raises(WriteError, match="its folder does not exist"):
            writer.add(2 * 10**9, np.full(shape, 700, dtype=np.uint16), np.eye(4))
    (tmp_path / "gone").rename(tmp_path / "run" / "depth")
    assert len(read_recording(tmp_path / "run")) == 1
