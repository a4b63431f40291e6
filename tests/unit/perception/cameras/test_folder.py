"""Recorded folder as a camera: pace, loop and colour."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sextant.services.perception import tum
from sextant.services.perception.cameras.camera import CameraError, RecordingOverError
from sextant.services.perception.cameras.folder import FolderCamera

STAMPS = [5_000_000_000 + 33_000_000 * k for k in range(4)]


@pytest.fixture
def folder(tmp_path: Path, kit) -> Path:  # type: ignore[no-untyped-def]
    camera = kit.profile.camera
    with tum.RecordingWriter(tmp_path / "run", tum.Camera(camera.intrinsics, 1000.0, 30.0, None)) as writer:
        for k, stamp in enumerate(STAMPS):
            writer.add(stamp, kit.ground(k))
    return tmp_path / "run"


def add_color(folder: Path, shape: tuple[int, int, int] = (48, 64, 3)) -> None:
    (folder / "rgb").mkdir()
    lines = []
    for k, stamp in enumerate(STAMPS[:3]):  # the last picture has no colour
        image = np.full(shape, (30, 20, 10 + k), dtype=np.uint8)  # blue, green, red: the order of OpenCV
        cv2.imwrite(str(folder / "rgb" / f"{k}.png"), image)
        lines.append(f"{(stamp + 4_000_000) * 1e-9:.6f} rgb/{k}.png\n")
    (folder / "rgb.txt").write_text("# timestamp filename\n" + "".join(lines))


def test_images_are_played_at_recorded_rate_with_host_stamps(folder: Path, kit) -> None:  # type: ignore[no-untyped-def]
    began_ns = kit.clock()
    with FolderCamera(folder, kit.profile.camera, kit.clock) as camera:
        first = camera.read(False)
        assert first is not None
        assert first.stamp_ns == began_ns
        assert camera.read(False) is None, "the next is not due"
        kit.clock.pass_s(0.034)
        second = camera.read(False)
        assert second is not None
        assert second.stamp_ns == began_ns + 33_000_000
        np.testing.assert_array_equal(second.depth, kit.ground(1))
        kit.clock.pass_s(0.067)
        last = camera.read(False)
        assert last is not None
        np.testing.assert_array_equal(last.depth, kit.ground(3), "one was passed over, as a device drops it")


def test_recording_loops_or_ends(folder: Path, kit) -> None:  # type: ignore[no-untyped-def]
    again, once = (FolderCamera(folder, kit.profile.camera, kit.clock, loop=loop) for loop in (True, False))
    stamps = []
    for _ in range(40):
        frame = again.read(False)
        stamps += [frame.stamp_ns] if frame else []
        kit.clock.pass_s(0.01)
    assert len(stamps) > 8
    assert (np.diff(stamps) > 0).all()
    once.read(False)
    kit.clock.pass_s(1.0)
    assert once.read(False) is not None
    with pytest.raises(RecordingOverError, match="has ended"):
        once.read(False)


def read_all(camera: FolderCamera, kit, color: bool = False):  # type: ignore[no-untyped-def]
    """Return every picture of one loop, each read when it is due."""
    frames = []
    for before, stamp in zip([STAMPS[0], *STAMPS], STAMPS, strict=False):
        kit.clock.pass_s((stamp - before) * 1e-9)
        frames.append(camera.read(color))
    return frames


def test_color_is_paired_by_time_in_rgb_order(folder: Path, kit) -> None:  # type: ignore[no-untyped-def]
    add_color(folder)
    camera = FolderCamera(folder, kit.profile.camera, kit.clock)
    assert "with colour" in camera.description
    frames = read_all(camera, kit, color=True)
    assert [None if f is None or f.rgb is None else f.rgb[0, 0].tolist() for f in frames] == [
        [10, 20, 30],
        [11, 20, 30],
        [12, 20, 30],
        None,
    ]
    assert all(f.rgb is None for f in read_all(FolderCamera(folder, kit.profile.camera, kit.clock), kit)), "none was wanted"


def test_missing_folder_is_reported(folder: Path, tmp_path: Path, kit) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(CameraError, match="a folder with depth"):
        FolderCamera(tmp_path / "nothing", kit.profile.camera, kit.clock)


def test_unreadable_images_are_skipped_and_reported(folder: Path, kit) -> None:  # type: ignore[no-untyped-def]
    add_color(folder, (24, 32, 3))
    (folder / "depth" / f"{STAMPS[1] * 1e-9:.6f}.png").unlink()
    camera = FolderCamera(folder, kit.profile.camera, kit.clock)
    assert [frame is None for frame in read_all(camera, kit)] == [False, True, False, False]
    assert "1 images could not be read" in camera.description
    assert "no such file" in camera.description
    camera = FolderCamera(folder, kit.profile.camera, kit.clock)
    assert [frame is None for frame in read_all(camera, kit, color=True)] == [True, True, True, False]
    assert "a picture of 64x48 pixels expected, found 32x24" in camera.description


def test_recording_of_other_camera_is_refused(folder: Path, kit) -> None:  # type: ignore[no-untyped-def]
    text = (folder / "camera.toml").read_text()
    for old, new, words in (
        ("fx = 58.5", "fx = 52.5", "fx 58.5.*expected"),
        ("scale = 1000.0", "scale = 5000.0", "depth_scale"),
    ):
        (folder / "camera.toml").write_text(text.replace(old, new))
        with pytest.raises(CameraError, match=words):
            FolderCamera(folder, kit.profile.camera, kit.clock)
