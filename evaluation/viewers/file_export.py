"""Export of a recording to files of other tools: trajectories in the TUM format, and the map as a .npy array."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception import tum
from sextant.shared.files import whole_files
from sextant.shared.geometry import Array
from sextant.shared.recording.layout import RecordingError
from sextant.shared.recording.reader import Recording
from sextant.shared.wire import topics
from sextant.shared.wire.messages import BodyPose, GroundTruth, TerrainMap

_MAP_NS = 1_000_000_000  # [ns] between two maps that are merged


def export_trajectories(source: Path, target: Path) -> dict[Path, int]:
    """Write the estimated poses of the body to `target`, and the true ones, if any, to a file next to it.

    Each line is `timestamp tx ty tz qx qy qz qw` in seconds and metres. The truth is in the simulator's world, the estimate in
    {world}, which begins where the robot started; tools such as evo align them.

    Returns:
        The files, and their numbers of poses.

    Raises:
        RecordingError: `source` is not a recording, or has no estimated pose.
        WriteError: A file cannot be written.
    """
    estimated: list[tuple[int, Array]] = []
    true: list[tuple[int, Array]] = []
    for _, message, _ in Recording(source).messages((topics.BODY_POSE, topics.TRUTH)):
        if isinstance(message, BodyPose):
            estimated.append((message.stamp_ns, message.T_world_body))
        elif isinstance(message, GroundTruth):
            true.append((message.stamp_ns, message.T_world_body))
    if not estimated:
        raise RecordingError(f"{source}: no pose of {topics.BODY_POSE.key} in this recording")
    written = {}
    for path, poses in ((target, estimated), (target.with_name(f"{target.stem}_true{target.suffix}"), true)):
        if poses:
            trajectory = _ascending(poses)
            tum.write_trajectory(path, trajectory, of="body")
            written[path] = len(trajectory.stamps_ns)
    return written


def _ascending(poses: Iterable[tuple[int, Array]]) -> tum.Trajectory:
    """Return poses by ascending time to the microsecond, the newest of equal times."""
    by_time = {stamp_ns // 1000: T for stamp_ns, T in poses}
    times = sorted(by_time)
    return tum.Trajectory(np.array(times) * 1000, np.array([by_time[time] for time in times]))


@dataclass(frozen=True, slots=True, eq=False)
class MergedMap:
    """Merged maps of a recording; cell (i, j) is centred at origin + resolution * (i, j)."""

    heights: NDArray[np.float32]  # (nx, ny) [m], NaN where never seen
    origin: Array  # (2,) [m] {world}
    resolution: float  # [m]
    stamp_ns: int  # [ns] of the newest map


def export_map(source: Path, target: Path) -> tuple[int, int]:
    """Write the merged maps of a recording as heights (nx, ny) [m] in a .npy file, and its place as JSON next to it.

    Returns:
        Number of cells along x and y.

    Raises:
        RecordingError: `source` is not a recording, or has no map.
        WriteError: A file cannot be written.
    """
    found = merged_map(source)
    about = {
        "resolution_m": found.resolution,
        "origin_m": found.origin.round(9).tolist(),
        "frame": "world",
        "shape": found.heights.shape,
        "cell": "cell (i, j) is centred at origin_m + resolution_m * (i, j); NaN where never seen",
    }
    whole_files.write_by_name(target, lambda path: np.save(path, found.heights))
    whole_files.write_text(target.with_suffix(".json"), json.dumps(about, indent=1) + "\n")
    return found.heights.shape


def merged_map(source: Path) -> MergedMap:
    """Return the merged maps of a recording.

    Raises:
        RecordingError: `source` is not a recording, or has no map.
    """
    maps: list[TerrainMap] = []
    for _, message, _ in Recording(source).messages((topics.TERRAIN,)):
        if isinstance(message, TerrainMap):
            if len(maps) > 1 and message.stamp_ns - maps[-2].stamp_ns < _MAP_NS:
                maps.pop()  # the last map always stays
            maps.append(message)
    if not maps:
        raise RecordingError(f"{source}: no map of {topics.TERRAIN.key} in this recording")
    return MergedMap(*merged(maps), maps[-1].resolution, maps[-1].stamp_ns)


def merged(maps: Iterable[TerrainMap]) -> tuple[NDArray[np.float32], Array]:
    """Return the heights (nx, ny) [m] of maps of one resolution, the newest on top, and the centre (2,) [m] of cell (0, 0)."""
    found = list(maps)
    edge, phase = found[-1].resolution, found[-1].origin
    starts = [np.round((one.origin - phase) / edge).astype(int) for one in found]
    low = np.min(starts, axis=0)
    high = np.max([start + one.elevation.shape for start, one in zip(starts, found, strict=True)], axis=0)
    heights = np.full(high - low, np.nan, np.float32)
    for (i, j), one in zip(starts - low, found, strict=True):
        nx, ny = one.elevation.shape
        window = heights[i : i + nx, j : j + ny]
        np.copyto(window, one.elevation, where=np.isfinite(one.elevation))
    return heights, phase + edge * low
