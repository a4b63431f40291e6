"""Recordings in the TUM RGB-D layout.

A recording is a folder with depth.txt, camera.toml, PNG depth images, and optionally groundtruth.txt and rgb.txt. In the text
files, `#` starts a comment.

depth.txt: `timestamp filename`.
groundtruth.txt: `timestamp tx ty tz qx qy qz qw` of the depth camera in the world.
rgb.txt: as depth.txt; each colour image is aligned pixel by pixel with the depth image nearest in time.
camera.toml: width, height, fx, fy, cx, cy [px], depth_scale (raw units per metre), and optionally rate_hz, min_range and
max_range [m], and gravity_world, the unit vector that points down in the world of groundtruth.txt.

Images must be free of lens distortion: coefficients other than 0 are refused.
(Sturm et al. 2012, A benchmark for the evaluation of RGB-D SLAM systems.)
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.shared.files import config, input_file, picture_file, whole_files
from sextant.shared.files.input_file import FileError
from sextant.shared.geometry import interpolate, quaternion_from_rotation, rotation_from_quaternion, transform
from sextant.shared.robot.camera import DepthSensor, Intrinsics

_DEFAULT_SENSOR = DepthSensor()
_MAX_PAIR_GAP_NS = 20_000_000  # [ns] longest time between the two images of a pair, as in the benchmark's tools
_DEPTH_FILE, _TRUTH_FILE = "depth.txt", "groundtruth.txt"
_DEPTH_HEADER = "# timestamp filename\n"
_TRUTH_HEADER = "# timestamp tx ty tz qx qy qz qw  (depth camera in world)\n"


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Contents of camera.toml."""

    intrinsics: Intrinsics
    depth_scale: float  # raw units per metre
    rate_hz: float  # [Hz]
    gravity_world: NDArray[np.float64] | None  # (3,) unit vector pointing down, None if unknown
    min_range: float = _DEFAULT_SENSOR.min_range  # [m] smaller depths are not used
    max_range: float = _DEFAULT_SENSOR.max_range  # [m]

    @property
    def sensor(self) -> DepthSensor:
        """Depth sensor with these parameters."""
        ranges = {"min_range": self.min_range, "max_range": self.max_range}
        return DepthSensor(rate_hz=self.rate_hz, depth_scale=self.depth_scale, **ranges)


@dataclass(frozen=True, slots=True)
class _CameraFile:
    """Keys of camera.toml."""

    width: int  # [px]
    height: int  # [px]
    fx: float  # [px]
    fy: float  # [px]
    cx: float  # [px]
    cy: float  # [px]
    depth_scale: float  # raw units per metre
    rate_hz: float = _DEFAULT_SENSOR.rate_hz  # [Hz]
    min_range: float = _DEFAULT_SENSOR.min_range  # [m]
    max_range: float = _DEFAULT_SENSOR.max_range  # [m]
    gravity_world: tuple[float, float, float] | None = None  # unit vector pointing down
    # Distortion coefficients of OpenCV's model, accepted only if they are 0.
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    checks = (
        *Intrinsics.checks,
        *DepthSensor.checks,
        config.together(
            "gravity_world", lambda down: down is None or abs(math.hypot(*down) - 1.0) < 1e-3, "a unit vector that points down"
        ),
        *config.each(
            "k1 k2 k3 k4 k5 k6 p1 p2",
            lambda coefficient: coefficient == 0,
            "0 (distortion is not corrected here; undistort the images and give their intrinsics)",
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time."""

    stamps_ns: NDArray[np.int64]  # (n,) [ns] ascending
    T_world_camera: NDArray[np.float64]  # (n, 4, 4)

    def at(self, stamp_ns: int, max_gap_ns: int = 100_000_000) -> NDArray[np.float64] | None:
        """Return the interpolated pose (4, 4) at a time.

        It is None outside the trajectory and inside a gap longer than max_gap_ns.
        """
        after = int(np.searchsorted(self.stamps_ns, stamp_ns))
        if after < len(self.stamps_ns) and self.stamps_ns[after] == stamp_ns:
            return np.asarray(self.T_world_camera[after])
        if after == 0 or after == len(self.stamps_ns):
            return None
        start, end = int(self.stamps_ns[after - 1]), int(self.stamps_ns[after])
        if end - start > max_gap_ns:
            return None
        share = (stamp_ns - start) / (end - start)
        return interpolate(self.T_world_camera[after - 1], self.T_world_camera[after], share)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Recording opened for reading; images are read on demand."""

    folder: Path
    camera: Camera
    stamps_ns: NDArray[np.int64]  # (n,) [ns] ascending
    files: tuple[str, ...]  # of the depth images, relative to folder
    truth: Trajectory | None  # None without groundtruth.txt
    colors: tuple[NDArray[np.int64], tuple[str, ...]] | None = (
        None  # stamps [ns] and files of rgb.txt, None if there is no such file
    )

    def __len__(self) -> int:
        return len(self.files)

    def depth(self, index: int) -> NDArray[np.uint16]:
        """Read a raw depth image (h, w).

        Raises:
            FileError: It is missing, or is not a 16-bit grey image of the camera's size.
        """
        path = self.folder / self.files[index]
        if not path.exists():
            raise FileError(path, "no such file, though depth.txt of the recording names it")
        return np.asarray(picture_file.read_grey(path, bits=(16,), size=self._size), dtype=np.uint16)

    def color(self, index: int) -> NDArray[np.uint8] | None:
        """Read the colour image (h, w, 3), R, G, B, that is nearest in time to a depth image.

        The result is None without a colour image within 20 ms.

        Raises:
            FileError: It is not a colour image of the camera's size.
        """
        if self.colors is None:
            return None
        stamps, files = self.colors
        nearest = int(np.abs(stamps - self.stamps_ns[index]).argmin())
        if abs(int(stamps[nearest] - self.stamps_ns[index])) > _MAX_PAIR_GAP_NS:
            return None
        return picture_file.read_color(self.folder / files[nearest], self._size)

    @property
    def _size(self) -> tuple[int, int]:
        """Width and height [px] of the images."""
        return self.camera.intrinsics.width, self.camera.intrinsics.height

    def frames(self) -> Iterator[tuple[int, NDArray[np.uint16]]]:
        """Iterate over stamps [ns] and raw depth images in order; errors as in `depth`."""
        for index, stamp_ns in enumerate(self.stamps_ns):
            yield int(stamp_ns), self.depth(index)


def read_recording(folder: Path) -> Recording:
    """Open a recording.

    Raises:
        FileError: The folder or a file is missing or malformed; the error names the line.
        ConfigError: camera.toml is invalid.
    """
    if not folder.is_dir():
        raise FileError(folder, "a folder with depth.txt and camera.toml expected, found none")
    camera = read_camera(folder / "camera.toml")
    stamps, files = read_images(folder / "depth.txt")
    truth_path = folder / "groundtruth.txt"
    truth = read_trajectory(truth_path) if truth_path.is_file() else None
    colors = read_images(folder / "rgb.txt") if (folder / "rgb.txt").is_file() else None
    return Recording(folder, camera, stamps, files, truth, colors)


def read_images(path: Path) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Read the stamps (n,) [ns], ascending, and image files of depth.txt or rgb.txt.

    Raises:
        FileError: The file is missing, a line is malformed, or there is no line.
    """
    rows = _rows(path, 2)
    if not rows:
        raise FileError(path, "at least one `timestamp filename` line expected, found none")
    return _stamps(path, rows), tuple(fields[1] for _, fields in rows)


def read_camera(path: Path) -> Camera:
    """Read camera.toml.

    Raises:
        FileError: The file is missing.
        ConfigError: It is not valid TOML, lacks a key, or has an unknown or invalid one.
    """
    if not path.exists():
        raise FileError(path, "no such file; create it with width, height, fx, fy, cx, cy and depth_scale")
    found = config.load(path, _CameraFile)
    return Camera(
        Intrinsics(found.width, found.height, found.fx, found.fy, found.cx, found.cy),
        depth_scale=found.depth_scale,
        rate_hz=found.rate_hz,
        gravity_world=None if found.gravity_world is None else np.array(found.gravity_world),
        min_range=found.min_range,
        max_range=found.max_range,
    )


def read_trajectory(path: Path) -> Trajectory:
    """Read poses in the layout of groundtruth.txt.

    Raises:
        FileError: The file is missing, a line is malformed, or there is no line.
    """
    rows = _rows(path, 8)
    if not rows:
        raise FileError(path, "at least one `timestamp tx ty tz qx qy qz qw` line expected, found none")
    values = np.empty((len(rows), 7))
    for n, (line, fields) in enumerate(rows):
        values[n] = [_float(path, line, field) for field in fields[1:]]
        if abs(np.linalg.norm(values[n, 3:]) - 1.0) > 1e-2:
            raise FileError(path, f"a unit quaternion qx qy qz qw expected, found {' '.join(fields[4:])[:80]!r}", line)
    return Trajectory(_stamps(path, rows), transform(rotation_from_quaternion(values[:, [6, 3, 4, 5]]), values[:, :3]))


class RecordingWriter:
    """Writer of a recording, image by image, for use in a `with` statement.

    An interrupted recording remains readable.
    """

    def __init__(self, folder: Path, camera: Camera) -> None:
        """Start a recording.

        Args:
            folder: Created if missing; must not contain a recording.
            camera: Contents of camera.toml.

        Raises:
            FileExistsError: The folder contains a depth.txt.
            WriteError: The recording cannot be written.
        """
        if (folder / _DEPTH_FILE).exists():
            raise FileExistsError(f"{folder} already contains a recording; choose another folder or remove it")
        whole_files.make_folder(folder / "depth")
        whole_files.write_text(folder / "camera.toml", _camera_toml(camera))
        self._folder, self._camera = folder, camera
        self._last_ns: int | None = None
        self._has_truth = False
        whole_files.write_text(folder / _DEPTH_FILE, _DEPTH_HEADER)

    def __enter__(self) -> "RecordingWriter":
        return self

    def __exit__(self, *exc: object) -> None:
        """Do nothing, because each frame is complete once it is added."""

    def add(self, stamp_ns: int, depth_raw: NDArray[np.uint16], T_world_camera: NDArray[np.float64] | None = None) -> None:
        """Append a frame and, if known, its true pose.

        Args:
            stamp_ns: [ns] later than the last, stored to the microsecond.
            depth_raw: (h, w) raw depth.
            T_world_camera: (4, 4) true pose of the depth camera; the first one creates groundtruth.txt.

        Raises:
            ValueError: The image has another size or type, or the stamp is not later than the last.
            WriteError: The frame cannot be written; the recording is unchanged.
        """
        shape = (self._camera.intrinsics.height, self._camera.intrinsics.width)
        if depth_raw.dtype != np.uint16 or depth_raw.shape != shape:
            raise ValueError(f"uint16 depth image {shape} expected, found {depth_raw.dtype} {depth_raw.shape}")
        if self._last_ns is not None and stamp_ns // 1000 <= self._last_ns // 1000:
            raise ValueError(f"a stamp of at least 1 us after {self._last_ns} ns expected, found {stamp_ns} ns")
        stamp = _seconds(stamp_ns)
        whole_files.write_bytes(self._folder / "depth" / f"{stamp}.png", cv2.imencode(".png", depth_raw)[1].tobytes())
        if T_world_camera is not None:
            if not self._has_truth:
                whole_files.write_text(self._folder / _TRUTH_FILE, _TRUTH_HEADER)
                self._has_truth = True
            whole_files.append_text(self._folder / _TRUTH_FILE, _truth_line(stamp_ns, T_world_camera))
        whole_files.append_text(self._folder / _DEPTH_FILE, f"{stamp} depth/{stamp}.png\n")
        self._last_ns = stamp_ns


def write_trajectory(path: Path, trajectory: Trajectory, of: str = "depth camera") -> None:
    """Write poses of a camera, or of something else, in the layout of groundtruth.txt."""
    poses = zip(trajectory.stamps_ns, trajectory.T_world_camera, strict=True)
    whole_files.write_text(
        path, _TRUTH_HEADER.replace("depth camera", of) + "".join(_truth_line(int(stamp_ns), T) for stamp_ns, T in poses)
    )


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns // 1000 % 1_000_000:06d}"


def _truth_line(stamp_ns: int, T_world_camera: NDArray[np.float64]) -> str:
    w, x, y, z = quaternion_from_rotation(T_world_camera[:3, :3])
    numbers = " ".join(f"{value:.9f}" for value in (*T_world_camera[:3, 3], x, y, z, w))
    return f"{_seconds(stamp_ns)} {numbers}\n"


def _camera_toml(camera: Camera) -> str:
    i = camera.intrinsics
    lines = [
        "# pinhole intrinsics of the depth camera; depth PNG value / depth_scale = metres, 0 = no return",
        f"width = {i.width}",
        f"height = {i.height}",
        *(f"{key} = {float(value)!r}" for key, value in (("fx", i.fx), ("fy", i.fy), ("cx", i.cx), ("cy", i.cy))),
        f"depth_scale = {float(camera.depth_scale)!r}",
        f"rate_hz = {float(camera.rate_hz)!r}",
        f"min_range = {float(camera.min_range)!r}",
        f"max_range = {float(camera.max_range)!r}",
    ]
    if camera.gravity_world is not None:
        lines.append("# unit vector pointing DOWN, in the world frame of groundtruth.txt")
        lines.append(f"gravity_world = {[float(value) for value in camera.gravity_world]!r}")
    return "\n".join(lines) + "\n"


def _rows(path: Path, columns: int) -> list[tuple[int, list[str]]]:
    """Return line numbers and fields of all lines that are not comments."""
    if not path.exists():
        raise FileError(path, f"no such file; the TUM RGB-D layout has one line of {columns} fields a frame")
    rows = []
    for number, line in enumerate(input_file.read_text(path).splitlines(), start=1):
        fields = line.split("#", 1)[0].split()
        if fields and len(fields) != columns:
            raise FileError(path, f"{columns} fields expected, found {len(fields)}: {line.strip()[:80]!r}", number)
        if fields:
            rows.append((number, fields))
    return rows


def _stamps(path: Path, rows: list[tuple[int, list[str]]]) -> NDArray[np.int64]:
    stamps = np.empty(len(rows), dtype=np.int64)
    for n, (line, fields) in enumerate(rows):
        seconds = _float(path, line, fields[0])
        if not 0.0 <= seconds < 9e9:
            raise FileError(path, f"a time in seconds from 0 to 9e9 expected, found {fields[0][:80]}", line)
        whole, _, fraction = fields[0].partition(".")
        # Parse plain text exactly: a double holds the seconds since 1970 only to a quarter of a microsecond.
        plain = whole.isdecimal() and len(whole) < 20 and (fraction.isdecimal() or not fraction)
        stamps[n] = int(whole) * 10**9 + int(f"{fraction:0<9}"[:9]) if plain else round(seconds * 1e9)
        if n and stamps[n] <= stamps[n - 1]:
            raise FileError(path, f"ascending times expected, found {fields[0][:40]} after {rows[n - 1][1][0][:40]}", line)
    return stamps


def _float(path: Path, line: int, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise FileError(path, f"a number expected, found {text[:80]!r}", line) from None
    if not math.isfinite(value):
        raise FileError(path, f"a finite number expected, found {text[:80]!r}", line)
    return value
