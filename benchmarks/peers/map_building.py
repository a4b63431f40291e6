"""Benchmark of map building: Masri's as published and ours, from the same depth frames and the same leg odometry.

A camera is carried over scenes. Each frame goes through his registration and world model (`masri_mapping`), and through our
perception and mapper with the codec. At the end both maps are compared with the true ground in the same window: heights, and
footholds. A foothold is wrong if the true ground within 1 cm of it is no surface that carries a foot.
"""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from time import process_time_ns

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.scenes import MAPPED, REGISTERED, Scene
from benchmarks.peers.synthetic_trajectory import CarriedCamera, Errors, Ride, ride
from benchmarks.peers.timing import one_core
from sextant.evaluation.baselines import masri_mapping as his
from sextant.evaluation.baselines.masri_mapping import WorldModel
from sextant.evaluation.metrics.true_ground import INTERIOR, TrueGround, rms
from sextant.evaluation.replay.listener import Listener
from sextant.services.mapper.config import Settings as MapperSettings
from sextant.services.mapper.service import Mapper
from sextant.services.perception.config import Settings as PerceptionSettings
from sextant.services.perception.service import Perception
from sextant.shared.geometry import Array, inverse
from sextant.shared.runtime.lockstep import Lockstep
from sextant.shared.runtime.service import Service
from sextant.shared.wire import topics

MASRI, SEXTANT = "Masri 2016", "Sextant"
SCENES: dict[str, Scene] = {
    "flat": REGISTERED["flat"],
    "steps": MAPPED["steps"],
    "boxes": MAPPED["boxes"],
    "mixed": MAPPED["mixed"],
}
_WINDOW = (0.6, 2.6), (-0.6, 0.6)  # [m] x and y
_R = 0.01  # [m] cells of both
_CARRIES_M = 0.02  # [m] height differences within 1 cm that still carry a foot: a slope of 45 deg
_SETTLE_NS = 500_000_000
_FRAMES, _STEP_M = 100, 0.02  # of a ride, and between two frames


@dataclass(frozen=True, slots=True)
class Built:
    """The map of one ride."""

    scene: str
    method: str
    seed: int
    drift_m: float  # position error at the end
    rmse_m: float  # of the heights of all measured cells
    interior_m: float  # of cells further than 2 cm from an edge
    known: float  # share of the window that is measured
    wrong: float  # share of the footholds whose true ground carries no foot
    found: float  # share of the measured ground that carries a foot, and is a foothold
    ms: float  # processor time of a frame: median, ours the mean


@dataclass(frozen=True, slots=True)
class _Map:
    """Heights and footholds of the window, and the pose at the end."""

    elevation: NDArray[np.floating]  # (nx, ny) [m] {world}, NaN where unknown
    foothold: NDArray[np.bool_]  # (nx, ny)
    T_world_body: Array  # (4, 4)
    ms: float


def measure(
    seeds: Sequence[int], frames: int = _FRAMES, names: Iterable[str] = SCENES, say: Callable[[str], object] = lambda _: None
) -> list[Built]:
    """Ride over each scene with each seed, and build both maps."""
    out = []
    for name in names:
        for seed in seeds:
            way = ride(
                SCENES[name](np.random.default_rng([seed, 0])),
                np.random.default_rng([seed, 1]),
                Errors(),
                frames,
                _STEP_M * frames,
            )
            truth = _truth(way)
            with one_core():
                for method, build in ((MASRI, _by_masri), (SEXTANT, _by_sextant)):
                    out.append(_judged(name, method, seed, way, build(way, seed), truth))
        say(f"map building: {name} done")
    return out


def _camera(way: Ride, seed: int) -> CarriedCamera:
    return CarriedCamera(way, np.random.default_rng([seed, 2]))


def _by_masri(way: Ride, seed: int) -> _Map:
    """Register each frame against his world model, from the motion that the legs expect."""
    camera, model, times = _camera(way, seed), WorldModel(), []
    sensor, T_body_camera = way.profile.camera.sensor, way.profile.camera.T_body_camera
    low, high = sensor.raw_bounds
    T_body = way.T_odom_body[0]
    for k in range(len(way.stamps_ns)):
        if k:
            T_body = T_body @ inverse(way.T_odom_body[k - 1]) @ way.T_odom_body[k]
        raw = camera.frame(k)
        began = process_time_ns()
        depth = np.where((raw >= low) & (raw <= high), raw * np.float32(1.0 / sensor.depth_scale), np.float32(0.0))
        found = model.add(his.cropped(his.scan_of(depth, way.profile.camera.intrinsics)), T_body @ T_body_camera)
        T_body = T_body if found is None else found @ inverse(T_body_camera)
        times.append(1e-6 * (process_time_ns() - began))
    (x0, x1), (y0, y1) = _WINDOW
    ground = model.height_map(np.array([x0, y0]), (round((x1 - x0) / _R), round((y1 - y0) / _R)))
    foothold = his.evaluation(his.accessible(ground, float(T_body[2, 3]))) < 0
    return _Map(ground.elevation, foothold & np.isfinite(ground.elevation), T_body, float(np.median(times)))


def _by_sextant(way: Ride, seed: int) -> _Map:
    """Run perception and mapper on simulated time; their time is that of the run without the camera's."""
    camera, heard = _camera(way, seed), Listener()
    seen = PerceptionSettings(settle_s=0.0, scan_rate_hz=way.profile.camera.sensor.rate_hz)
    makers: dict[str, Callable[[], Service]] = {
        "carried camera": lambda: camera,
        "perception": lambda: Perception(way.profile, seen),
        "mapper": lambda: Mapper(way.profile, MapperSettings()),
    }
    lockstep = Lockstep(makers, heard.tap, latency_s={topics.ODOMETRY.key: 0.001})
    began = process_time_ns()
    lockstep.run(int(way.stamps_ns[-1]) + _SETTLE_NS)
    total = 1e-6 * (process_time_ns() - began) / len(way.stamps_ns)
    terrain = heard.terrain
    if terrain is None:
        raise RuntimeError(f"no map from the ride with seed {seed}")
    (x0, x1), (y0, y1) = _WINDOW
    x, y = np.arange(x0 + _R / 2, x1, _R), np.arange(y0 + _R / 2, y1, _R)
    i, j = (np.rint((c - o) / _R).astype(int) for c, o in zip((x, y), terrain.origin, strict=True))
    shape = terrain.elevation.shape
    inside = ((i >= 0) & (i < shape[0]))[:, None] & ((j >= 0) & (j < shape[1]))
    index = np.ix_(np.clip(i, 0, shape[0] - 1), np.clip(j, 0, shape[1] - 1))
    measured = inside & ~terrain.assumed[index]
    elevation = np.where(measured, terrain.elevation[index], np.nan)
    foothold = measured & (terrain.evaluation[index] < 0)
    ms = total - camera.stages.percentiles()["camera"][0]  # the camera computes on this core too
    return _Map(elevation, foothold, heard.poses[-1].T_world_body, ms)


def _truth(way: Ride) -> TrueGround:
    (x0, x1), (y0, y1) = _WINDOW
    shape = round((x1 - x0) / _R), round((y1 - y0) / _R)
    return TrueGround.under(way.terrain.height_at, np.array([x0, y0]) + _R / 2, shape, _R)


def carries(heights: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which cells (nx, ny) of true heights [m] carry a foot: those around are nearly as high."""
    square = np.ones((3, 3), np.uint8)
    z = heights.astype(np.float32)
    return np.asarray(cv2.dilate(z, square) - cv2.erode(z, square) <= _CARRIES_M)


def _judged(scene: str, method: str, seed: int, way: Ride, built: _Map, truth: TrueGround) -> Built:
    error = built.elevation - truth.heights
    known = np.isfinite(error)
    good = carries(truth.heights)
    return Built(
        scene=scene,
        method=method,
        seed=seed,
        drift_m=float(np.linalg.norm((built.T_world_body - way.T_world_body[-1])[:3, 3])),
        rmse_m=rms(error[known]),
        interior_m=rms(error[known & (truth.edge_distance > INTERIOR)]),
        known=float(known.mean()),
        wrong=float((built.foothold & ~good).sum() / max(built.foothold.sum(), 1)),
        found=float((built.foothold & good).sum() / max((known & good).sum(), 1)),
        ms=built.ms,
    )


_COLUMNS = (
    ("drift_m", "end, mm", 1e3, 1),
    ("rmse_m", "height, mm", 1e3, 1),
    ("interior_m", "off edges, mm", 1e3, 1),
    ("known", "known, %", 1e2, 0),
    ("wrong", "wrong footholds, %", 1e2, 2),
    ("found", "found footholds, %", 1e2, 0),
    ("ms", "ms", 1.0, 0),
)


def in_words(built: Sequence[Built]) -> str:
    """Return the table as Markdown: the median over the seeds, and the worst."""
    head = f"| scene | map | {' | '.join(heading for _, heading, _, _ in _COLUMNS)} |"
    lines = [head, "|---" * (len(_COLUMNS) + 2) + "|"]
    for scene in dict.fromkeys(one.scene for one in built):
        for method in (MASRI, SEXTANT):
            rides = [one for one in built if (one.scene, one.method) == (scene, method)]
            cells = []
            for name, _, factor, digits in _COLUMNS:
                values = factor * np.array([getattr(one, name) for one in rides])
                worst = values.min() if name in ("known", "found") else values.max()
                cells.append(f"{np.median(values):.{digits}f} ({worst:.{digits}f})")
            lines.append(f"| {scene} | {method} | {' | '.join(cells)} |")
    return "\n".join(lines)


def to_json(built: Sequence[Built]) -> str:
    """Return all rides as JSON."""
    return json.dumps([asdict(one) for one in built], indent=1) + "\n"


def from_json(text: str) -> list[Built]:
    """Return the rides of `to_json`."""
    return [Built(**one) for one in json.loads(text)]
