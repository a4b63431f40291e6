"""Accuracy of pose and map: rides through the real perception and mapper.

Messages pass through the codec. Results are compared with the ground truth.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.peers import foothold_model, kept
from benchmarks.peers.full_frame import FullFrames
from benchmarks.peers.scenes import MAPPED, REGISTERED, Scene
from benchmarks.peers.synthetic_trajectory import CarriedCamera, Errors, Ride, ride
from sextant.evaluation import params
from sextant.evaluation.metrics.true_ground import INTERIOR, TrueGround, rms
from sextant.evaluation.replay.listener import Listener
from sextant.services.mapper.config import Settings as MapperSettings
from sextant.services.mapper.elevation.elevation_grid import ElevationSnapshot
from sextant.services.mapper.service import Mapper
from sextant.services.perception.config import Settings as PerceptionSettings
from sextant.services.perception.service import Perception
from sextant.services.simulator.sensors.renderer import Renderer
from sextant.shared.geometry import apply
from sextant.shared.runtime.lockstep import Lockstep
from sextant.shared.runtime.process_priority import keep_memory
from sextant.shared.runtime.service import Service
from sextant.shared.runtime.workers import share_out
from sextant.shared.wire import topics
from sextant.shared.wire.messages import TerrainMap

Cells = NDArray[np.bool_]

SEXTANT = "Sextant"
_SETTLE_NS = 500_000_000  # simulated time after the last depth frame, for messages in transit
_SURVEYED = 10  # scans per survey: the last survey of a ride has seen everything
_REACH = 2  # cells by which noise may move a point out of view, in addition to the pose drift


@dataclass(frozen=True, slots=True)
class RideResult:
    """Results of one ride."""

    drift: float  # [m] position error at the end
    legs_drift: float  # [m] the same of the odometry
    refused: int  # frames with a rejected registration
    rmse: float  # [m] over all measured cells
    interior_rmse: float  # [m] over cells further than 2 cm from an edge
    bias: float  # [m] over all measured cells
    edge: float  # [m] median distance from a true edge to the mapped one, NaN without edges
    coverage: float  # share of the visible cells that are known
    invented: int  # known cells that were never in view
    # Survey of a strip, the model of Masri's thesis, if one was made:
    model_rmse: float = math.nan  # [m] off edges
    beside_rmse: float = math.nan  # [m] of the elevation map on the same cells
    normal_deg: float = math.nan  # [deg] rms error of the normals off edges
    model_coverage: float = math.nan  # share of the strip's visible cells that are known
    # Elevation map from full depth frames, if one was made:
    full_rmse: float = math.nan  # [m] over all measured cells
    full_interior_rmse: float = math.nan  # [m] over cells further than 2 cm from an edge
    full_edge: float = math.nan  # [m] median distance from a true edge to the mapped one
    full_coverage: float = math.nan  # share of the visible cells that are known


@dataclass(frozen=True, slots=True)
class Variant:
    """Plug-in and parameters of perception and mapper that differ from Sextant's."""

    registration: str = ""
    params: Mapping[str, Any] = field(default_factory=dict)  # nested table, as a scenario's `[params]`

    def words(self) -> str:
        """Return the differences as text; Sextant's name without any."""
        return ", ".join(filter(None, (self.registration, params.words(self.params)))) or SEXTANT


def measure(
    scene: Scene, seed: int, errors: Errors | None = None, survey: bool = False, variant: Variant = Variant()
) -> RideResult:
    """Ride over a scene.

    Args:
        scene: The ground.
        seed: Random seed of terrain, errors and noise.
        errors: Errors of the odometry.
        survey: Whether to survey a strip, and to map full depth frames in addition to the scans.
        variant: What differs from Sextant's own perception and mapper.

    Raises:
        RuntimeError: No map was published.
        ServiceFailedError: A service or the plug-in failed.
    """
    tuned = params.read(variant.params, "--set")
    rngs = [np.random.default_rng([seed, k]) for k in range(3)]
    way = ride(scene(rngs[0]), rngs[1], errors or Errors())
    camera = CarriedCamera(way, rngs[2])
    heard = Listener()
    seen = replace(tuned.perception, settle_s=0.0, scan_rate_hz=way.profile.camera.sensor.rate_hz)
    settings = params.settings(PerceptionSettings, seen, registration=variant.registration)
    mapped = params.settings(MapperSettings, replace(tuned.mapper, passage_every=_SURVEYED))
    makers: dict[str, Callable[[], Service]] = {
        "carried camera": lambda: camera,
        "perception": lambda: Perception(way.profile, settings),
        "mapper": lambda: Mapper(way.profile, mapped),
    }
    full = FullFrames(way.profile.camera, mapped.shape, mapped.resolution, settings.scan_range)
    if survey:
        makers["asker"] = foothold_model.Asker
        makers["full frames"] = lambda: full
    lockstep = Lockstep(
        makers,
        heard.tap,
        latency_s={topics.ODOMETRY.key: 0.001},  # fifty times a second on a robot, here once per depth frame
    )
    lockstep.run(int(way.stamps_ns[-1]) + _SETTLE_NS)
    if heard.terrain is None:
        raise RuntimeError(f"no map from the ride with seed {seed}")
    return _judged(way, heard, heard.terrain, full.grid.snapshot() if survey else None, settings.scan_range)


def _judged(way: Ride, heard: Listener, terrain: TerrainMap, full: ElevationSnapshot | None, scan_range: float) -> RideResult:
    poses, passage = heard.poses, heard.passage
    end = way.T_world_body[-1, :3, 3]
    truth = TrueGround.under(way.terrain.height_at, terrain.origin, terrain.elevation.shape, terrain.resolution)
    known = np.isfinite(terrain.elevation)
    seen = _in_view(way, terrain, scan_range)
    drift = float(np.linalg.norm(poses[-1].T_world_body[:3, 3] - end))
    reach = _REACH + math.ceil(drift / terrain.resolution)
    could_be_seen = cv2.dilate(seen.astype(np.uint8), np.ones((2 * reach + 1,) * 2)) > 0
    error = (terrain.elevation - truth.heights)[known & np.isfinite(truth.heights)]
    interior = known & (truth.edge_distance > INTERIOR) & np.isfinite(truth.heights)
    surveyed = None if passage is None else foothold_model.judged(passage, terrain, truth, seen)
    return RideResult(
        drift=drift,
        legs_drift=float(np.linalg.norm(way.T_odom_body[-1, :3, 3] - end)),
        refused=sum(not pose.ok for pose in poses),
        rmse=rms(error),
        interior_rmse=rms((terrain.elevation - truth.heights)[interior]),
        bias=float(error.mean()),
        edge=truth.edge_error(terrain.elevation),
        coverage=float(known[seen].mean()),
        invented=int((known & ~could_be_seen).sum()),
        model_rmse=math.nan if surveyed is None else surveyed.rmse,
        beside_rmse=math.nan if surveyed is None else surveyed.elevation_rmse,
        normal_deg=math.nan if surveyed is None else surveyed.normal_deg,
        model_coverage=math.nan if surveyed is None else surveyed.coverage,
        **({} if full is None else _of_full_frames(full, way, scan_range)),
    )


def _of_full_frames(full: ElevationSnapshot, way: Ride, scan_range: float) -> dict[str, float]:
    """Return the figures of the map from full depth frames.

    Its window is where it was at the last of them.
    """
    truth = TrueGround.under(way.terrain.height_at, full.origin, full.elevation.shape, full.resolution)
    error = full.elevation - truth.heights
    known = np.isfinite(error)
    return {
        "full_rmse": rms(error[known]),
        "full_interior_rmse": rms(error[known & (truth.edge_distance > INTERIOR)]),
        "full_edge": truth.edge_error(full.elevation),
        "full_coverage": float(np.isfinite(full.elevation)[_in_view(way, full, scan_range)].mean()),
    }


def _in_view(way: Ride, terrain: TerrainMap | ElevationSnapshot, scan_range: float) -> Cells:
    """Return the map cells (nx, ny) that an undisturbed depth frame of the ride shows."""
    camera = way.profile.camera
    renderer = Renderer(way.terrain, camera.intrinsics)
    shape = terrain.elevation.shape
    seen = np.zeros(shape, dtype=bool)
    for T in way.T_world_camera:
        depth = renderer.depth(T)
        inside = (depth >= camera.sensor.min_range) & (depth <= camera.sensor.max_range)
        points = apply(T, camera.intrinsics.points(np.where(inside, depth, 1.0))[inside])
        points = points[np.hypot(*(points[:, :2] - T[:2, 3]).T) <= scan_range]
        i, j = np.round((points[:, :2] - terrain.origin) / terrain.resolution).astype(int).T
        on_map = (i >= 0) & (j >= 0) & (i < shape[0]) & (j < shape[1])
        seen[i[on_map], j[on_map]] = True
    return seen


# ------------------------------------------------------------------------------------------------------------- the tables

LEGS: Mapping[str, Errors] = {
    "5 % wrong": Errors(),
    "slipping by half for 0.5 s": Errors(slip=0.5),
    "carried off by 0.29 m and 15 deg": Errors(carried_off=(-0.25, 0.15, math.radians(15.0))),
}
# Ground on which x, y and yaw are observable everywhere: a displaced robot must relocalize there.
_SHOWING: Mapping[str, Scene] = {"boxes": MAPPED["boxes"]}
_DIGITS = 6  # of a figure, after the point
_FOUND = 0.05  # [m] maximum position error at the end of a ride that has kept or found its position


@dataclass(frozen=True, slots=True)
class Row:
    """All rides over one scene with one odometry model."""

    table: str  # "registration" or "maps"
    scene: str
    legs: str
    rides: int
    found: int  # rides with a final error below 5 cm
    figures: dict[str, tuple[float, float]]  # name -> median and worst (largest; for coverage the least)
    method: str = SEXTANT  # or what differs from it


def tables(
    seeds: Sequence[int], jobs: int, say: Callable[[str], object] = lambda _: None, variant: Variant = Variant()
) -> list[Row]:
    """Return rows for all scenes and seeds, each followed by that of the variant if there is one.

    Registration scenes are run with every odometry model.
    """
    rides_of_tables = [("registration", scene, legs) for scene in (*REGISTERED, *_SHOWING) for legs in LEGS]
    rides_of_tables += [("maps", scene, next(iter(LEGS))) for scene in MAPPED]
    variants = [Variant()] if variant == Variant() else [Variant(), variant]
    rows = [(*ride, one) for ride in rides_of_tables for one in variants]
    rides = [(*row, seed) for row in rows for seed in seeds]
    out: list[Row] = []
    results: list[RideResult] = []
    for result in share_out(_ride_by_name, rides, jobs):
        results.append(result)
        if len(results) == len(seeds):
            found = sum(result.drift <= _FOUND for result in results)
            table, scene, legs, one = rows[len(out)]
            out.append(Row(table, scene, legs, len(seeds), found, medians(results), one.words()))
            say(_line(out[-1], _COLUMNS[table]))
            results.clear()
    return out


def _ride_by_name(table: str, scene: str, legs: str, variant: Variant, seed: int) -> RideResult:
    keep_memory()  # as in the services' processes; a ride takes a third of the time
    if table == "registration":
        return measure({**REGISTERED, **_SHOWING}[scene], seed, LEGS[legs], variant=variant)
    return measure(MAPPED[scene], seed, LEGS[legs], survey=True, variant=variant)


def medians(results: Iterable[RideResult]) -> dict[str, tuple[float, float]]:
    """Return median and worst of each figure over rides.

    The worst is the largest, for coverage the least. Figures without values are left out. Absolute values are used: a bias has
    no sign here. They are rounded to a millionth, as they are kept.
    """
    rides = list(results)
    out = {}
    for name in (f.name for f in fields(RideResult)):
        values = np.array([getattr(r, name) for r in rides], dtype=np.float64)
        values = np.abs(values[np.isfinite(values)])
        if len(values):
            worst = values.min() if name.endswith("coverage") else values.max()
            out[name] = round(float(np.median(values)), _DIGITS), round(float(worst), _DIGITS)
    return out


_COLUMNS = {  # columns of each table: figure -> heading, factor, digits
    "registration": {
        "drift": ("at the end, mm", 1e3, 1),
        "legs_drift": ("legs alone, mm", 1e3, 0),
        "refused": ("frames refused", 1, 0),
    },
    "maps": {
        "rmse": ("rmse, mm", 1e3, 1),
        "interior_rmse": ("off edges, mm", 1e3, 1),
        "bias": ("bias, mm", 1e3, 1),
        "edge": ("edges, mm", 1e3, 1),
        "coverage": ("coverage, %", 1e2, 1),
        "invented": ("invented cells", 1, 0),
        "drift": ("at the end, mm", 1e3, 1),
    },
    "maps of full frames, at the same poses": {
        "full_rmse": ("rmse, mm", 1e3, 1),
        "full_interior_rmse": ("off edges, mm", 1e3, 1),
        "full_edge": ("edges, mm", 1e3, 1),
        "full_coverage": ("coverage, %", 1e2, 1),
    },
    "maps of a strip survey, compared with the elevation map there": {
        "model_rmse": ("off edges, mm", 1e3, 1),
        "beside_rmse": ("elevation map, mm", 1e3, 1),
        "normal_deg": ("normals, deg", 1, 1),
        "model_coverage": ("coverage, %", 1e2, 1),
    },
}


def in_words(rows: Sequence[Row]) -> str:
    """Return the tables as Markdown."""
    lines = []
    varied = any(row.method != SEXTANT for row in rows)
    for table, columns in _COLUMNS.items():
        chosen = [row for row in rows if table.startswith(row.table) and columns.keys() & row.figures.keys()]
        if not chosen:
            continue
        registered = chosen[0].table == table == "registration"
        headings = ["scene", *registered * ["legs"], *varied * ["method"], *(heading for heading, _, _ in columns.values())]
        headings += registered * [f"within {100 * _FOUND:.0f} cm"]
        lines += [f"{table[0].upper()}{table[1:]}; median (worst) of {chosen[0].rides} rides of 2 m:", ""]
        lines += [f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
        lines += [*(_line(row, columns, registered, varied) for row in chosen), ""]
    return "\n".join(lines[:-1])


def _line(row: Row, columns: Mapping[str, tuple[str, float, int]], registered: bool = True, varied: bool = True) -> str:
    """Return a row of a table; with the legs and the rides that are found if it is one of registration."""
    cells = [row.scene, *registered * [row.legs], *varied * [row.method]]
    for name, (_, factor, digits) in columns.items():
        median, worst = row.figures.get(name, (math.nan, math.nan))
        cells.append("-" if math.isnan(median) else f"{factor * median:.{digits}f} ({factor * worst:.{digits}f})")
    cells += registered * [f"{row.found} of {row.rides}"]
    return f"| {' | '.join(cells)} |"


def to_json(rows: Sequence[Row]) -> str:
    """Return the tables as JSON; lengths in metres."""
    return kept.rows_to_json(rows)


def from_json(text: str) -> list[Row]:
    """Read rows written by `to_json`."""
    return kept.rows_from_json(text, Row)
