"""Speed of the mapping stages compared with their peers.

The inputs are rides over generated scenes. Every stage processes each depth frame in turn: the frame to one point per cell, the
scan into a map, the map to its score. Each stage is done by Sextant and by the peers. The two services are timed, too, with
encoding, from the incoming frame to the outgoing layers.
"""

import ctypes
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers import reduction_peers, score_peers, timing
from benchmarks.peers.anybotics_core import AnyboticsMap
from benchmarks.peers.map_peer import NumpyGrid
from benchmarks.peers.scenes import MAPPED
from benchmarks.peers.score_peers import Layer, Scores
from benchmarks.peers.synthetic_trajectory import CarriedCamera, Errors, ride
from benchmarks.peers.timing import Race, held_against_first, installed, one_core
from sextant.services.mapper.config import Settings as MapperSettings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid, ElevationSnapshot
from sextant.services.mapper.elevation.fusion import FusionModel
from sextant.services.mapper.elevation.validated_scan import ValidatedScan
from sextant.services.mapper.footholds.hole_filling import fill_small_holes
from sextant.services.mapper.footholds.layers import FootholdLayers, Margin
from sextant.services.mapper.footholds.params import FootholdMapParams, ScoreParams
from sextant.services.mapper.footholds.plugin_rule import PluginRule
from sextant.services.mapper.service import Mapper
from sextant.services.perception.config import Settings as PerceptionSettings
from sextant.services.perception.reduction.scan_reduction import ReducedScan, reduce_scan
from sextant.services.perception.service import Perception
from sextant.shared.geometry import Array, from_millimetres
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.process_priority import keep_memory
from sextant.shared.runtime.service import AnyTopic, Inbox, ServiceRunner, Stages
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE, UNKNOWN, DepthImage, Odometry, Tick

_Scored = tuple[Layer, NDArray[np.int8] | None]  # score and evaluation function; a plug-in has no such function
_Score = Callable[[Layer, NDArray[np.int64], ElevationSnapshot], _Scored]
_Fuse = Callable[[ReducedScan, Array, NDArray[np.float32]], None]  # scan, position of the camera, points of all pixels

SCENES = ("steps", "boxes", "mixed")
SIZES = (256, 512)  # cells along an edge
OURS, CHANGED = "Sextant", "Sextant, changes only"
ANYBOTICS, ANYBOTICS_PIXELS = "elevation_mapping", "elevation_mapping, all pixels"
HEADINGS = {"agreement": ("agrees, %", 1e2, 2), "growth": ("growth", 1.0, 2)}
_RESOLUTION = 0.01  # [m]
_WARM = 5  # untimed frames at the start, if there are more
_STEP = 0.02  # [m] between frames
_BEYOND = 1.0  # [m] depth beyond the range of scans up to which pixels count
_COMPARED = 10  # interval, in frames, at which results are compared
_WEIGHTS, _RULES, _MARGIN = ScoreParams(unknown_clearance=0.02), FootholdMapParams(), Margin(sigmas=0.0)
_POSE_COVARIANCE = 1e-6 * np.eye(6)  # [m, rad]
_SAME_MM, _SAME_SCORE = 2.0, 0.01  # tolerances for equal results


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured(timing.Measured):
    """All results."""

    parts_ms: dict[str, float]  # stage -> median of its time between frame and layers


def in_words(measured: Measured) -> str:
    """Return the timings as Markdown, and the parts of the time from frame to layers in one line."""
    parts = ", ".join(f"{name} {ms:.2f} ms" for name, ms in measured.parts_ms.items())
    return f"{timing.in_words(measured, HEADINGS)}\nFrame to layers: {parts}."


def stages(
    seeds: Sequence[int],
    frames: int = 100,
    say: Callable[[str], object] = lambda _: None,
    plugin: str = "",
    anybotics: ctypes.CDLL | None = None,
) -> Measured:
    """Time the mapping stages.

    Figures: `agreement`, share of known cells with equal results of peer and Sextant, and for a plug-in of cells that both take
    as a foothold, or neither; `growth`, Sextant's time relative to that on the smallest map; `made`, share of the frames that
    produced layers.

    Args:
        seeds: One ride over each scene for each seed.
        frames: Frames of a ride.
        say: Called with the progress.
        plugin: Name of a foothold rule that scores the maps, too; empty for none.
        anybotics: Library of `anybotics_core.build`, whose map is updated, too; None for none.

    Raises:
        PluginError: The plug-in failed.
        ValueError: Fewer than three frames.
    """
    keep_memory()  # as in the services' processes
    at_work = _Races(min(_WARM, frames - 1), plugin, anybotics)
    with one_core():
        for scene in SCENES:
            for seed in seeds:
                rngs = [np.random.default_rng([seed, k]) for k in range(3)]
                way = ride(MAPPED[scene](rngs[0]), rngs[1], Errors(), frames, _STEP * frames)
                camera, inbox = CarriedCamera(way, rngs[2]), Inbox((), Stages())
                at_work.start(way.profile)
                for k, T in enumerate(way.T_world_camera):
                    odometry, image = camera.step(Tick(int(way.stamps_ns[k])), inbox)
                    at_work.run(odometry, image, T, compare=k % _COMPARED == 0)  # type: ignore[arg-type]
                at_work.end()
                say(f"map: {scene}, seed {seed} done")
    return at_work.measured()


class _Races:
    """All jobs and their results."""

    def __init__(self, warm: int, plugin: str, anybotics: ctypes.CDLL | None):
        self._plugin, self._anybotics = plugin, anybotics
        self._reduce = Race("reduction", "640x480", warm)
        self._fuse = {n: Race("map update", f"{n}x{n}", warm) for n in SIZES}
        self._score = {n: Race("score chain", f"{n}x{n}", warm) for n in SIZES}
        self._whole = Race("frame to layers", "256x256", warm)
        self._agreement: dict[tuple[str, str], dict[str, list[float]]] = {}
        self._missing: list[str] = []
        self._parts: list[dict[str, float]] = []
        self._made: list[bool] = []

    def start(self, profile: RobotProfile) -> None:
        """Start a ride with empty maps."""
        self._camera = camera = profile.camera
        reach, most = PerceptionSettings().scan_range, PerceptionSettings().scan_points

        def ours(depth: NDArray[np.uint16], T: Array) -> ReducedScan:
            return reduce_scan(
                depth, camera.intrinsics, camera.sensor, T, resolution=_RESOLUTION, max_range=reach, max_points=most
            )

        peers, missing = installed(reduction_peers.REDUCTION, camera.intrinsics, camera.sensor, _RESOLUTION, reach)
        self._reduce.start({OURS: ours, **{name: peer.reduce for name, peer in peers.items()}})
        scores, also_missing = installed(score_peers.SCORE, _RESOLUTION, _WEIGHTS, _RULES)
        self._missing = missing + also_missing
        model = FusionModel.of_sensor(camera.sensor, camera.intrinsics.fx)
        self._grids: dict[int, dict[str, Any]] = {}
        for n in SIZES:
            ours_grid, peer = ElevationGrid(n, _RESOLUTION, model), NumpyGrid(n, _RESOLUTION, model)
            self._grids[n] = {OURS: ours_grid, "NumPy": peer}
            fused = {OURS: _fused_into(ours_grid), "NumPy": _fused_by_numpy(peer)}
            if self._anybotics is not None:
                few, all_ = (AnyboticsMap(self._anybotics, n, _RESOLUTION) for _ in range(2))
                self._grids[n] |= {ANYBOTICS: few, ANYBOTICS_PIXELS: all_}
                fused |= {ANYBOTICS: _added_points(few), ANYBOTICS_PIXELS: _added_pixels(all_)}
            self._fuse[n].start(fused)
            whole, changed = (FootholdLayers((n, n), _RESOLUTION, _MARGIN, _WEIGHTS, _RULES) for _ in range(2))
            ours_scored = {OURS: _Anew(whole, n).layers, CHANGED: _Anew(changed, 0).layers}
            peers_scored = {name: _without_place(peer) for name, peer in scores.items()}
            rules = {self._plugin: _by_rule(PluginRule(profile, self._plugin))} if self._plugin else {}
            self._score[n].start({**ours_scored, **peers_scored, **rules})
        self._services = _Services(profile)
        self._whole.start({OURS: self._services.run})

    def run(self, odometry: Odometry, image: DepthImage, T: Array, compare: bool) -> None:
        """Process one depth frame with all methods."""
        points = self._reduce.run(image.depth, T)
        scan: ReducedScan = points[OURS]
        pixels = self._pixels(image.depth, T) if self._anybotics is not None else np.zeros((0, 3), np.float32)
        for n in SIZES:
            self._fuse[n].run(scan, T[:3, 3], pixels)
            grids = self._grids[n]
            snapshot = grids[OURS].snapshot()
            elevation = snapshot.elevation
            layers = self._score[n].run(fill_small_holes(elevation), grids[OURS].low, snapshot)
            if compare:
                fused = {OURS: elevation, "NumPy": grids["NumPy"].elevation}
                theirs = [name for name, grid in grids.items() if isinstance(grid, AnyboticsMap)]
                fused |= {name: grids[name].heights(grids[OURS].low) for name in theirs}
                self._agree(self._fuse[n], fused, 1e-3 * _SAME_MM)
                self._agree(self._score[n], {name: _same_where(layers[OURS], both) for name, both in layers.items()}, 0.5)
        if compare:
            maps = {name: _rastered(_points(found), scan.origin) for name, found in points.items()}
            self._agree(self._reduce, maps, 1e-3 * _SAME_MM)
        made = self._whole.run(codec.encode(odometry), codec.encode(image), image.stamp_ns)
        self._made.append(bool(made[OURS]))

    def _pixels(self, depth: NDArray[np.uint16], T_world_camera: Array) -> NDArray[np.float32]:
        """Return the points (n, 3) [m] {world} of all pixels within the camera's range."""
        z = depth / self._camera.sensor.depth_scale
        seen = (depth > 0) & (z < PerceptionSettings().scan_range + _BEYOND)
        points = self._camera.intrinsics.points(z)[seen] @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        return points.astype(np.float32)

    def end(self) -> None:
        """End the ride."""
        self._parts.append(self._services.parts_ms())

    def measured(self) -> Measured:
        """Return the results of all rides."""
        out = []
        for race in (self._reduce, *self._fuse.values(), *self._score.values(), self._whole):
            agreement = self._agreement.get((race.stage, race.case), {})
            figures = {name: {"agreement": float(np.mean(shares))} for name, shares in agreement.items()}
            small = {"map update": self._fuse, "score chain": self._score}.get(race.stage, {}).get(SIZES[0], race)
            if race is not small:
                figures[OURS] = {"growth": float(np.median(race.ms(OURS) / small.ms(OURS)))}
            if race is self._whole:
                figures[OURS] = {"made": float(np.mean(self._made))}
            out += race.timings(figures)
        # The sum of two stages' times, from the frame into the map.
        n = SIZES[0]
        both = {name: self._reduce.ms(name) + self._fuse[n].ms(name) for name in (OURS, "NumPy")}
        at = next(k for k, t in enumerate(out) if t.stage == "score chain")
        out[at:at] = held_against_first("frame into map", f"{n}x{n}", both, {})
        names = dict.fromkeys(name for parts in self._parts for name in parts)
        parts = {name: float(np.median([p[name] for p in self._parts if name in p])) for name in names}
        whole = float(np.median(self._whole.ms(OURS)))
        parts["codec and the rest"] = max(0.0, whole - sum(parts.values()))
        return Measured(timings=tuple(out), missing=tuple(self._missing), parts_ms=parts)

    def _agree(self, race: Race, layers: Mapping[str, Array], same: float) -> None:
        """Record the share of cells on which each peer agrees with Sextant.

        Cells known to either method count.
        """
        ours = layers[OURS]
        for name, other in layers.items():
            if name != OURS:
                either = np.isfinite(ours) | np.isfinite(other)
                share = float((np.abs(ours - other) < same)[either].mean()) if either.any() else 1.0
                self._agreement.setdefault((race.stage, race.case), {}).setdefault(name, []).append(share)


def _fused_into(grid: ElevationGrid) -> _Fuse:
    """Return a function that fuses a scan into Sextant's grid.

    The scan is in millimetres, as transmitted.
    """

    def fuse(scan: ReducedScan, p_world_camera: Array, _pixels: NDArray[np.float32]) -> None:
        grid.move_to(p_world_camera[:2])
        grid.fuse(
            ValidatedScan.of_millimetres(
                scan.origin, scan.points, scan.count, scan.spread, p_world_camera, pose_covariance=_POSE_COVARIANCE
            )
        )

    return fuse


def _fused_by_numpy(grid: NumpyGrid) -> _Fuse:
    """Return the same function for the peer."""

    def fuse(scan: ReducedScan, p_world_camera: Array, _pixels: NDArray[np.float32]) -> None:
        grid.move_to(p_world_camera[:2])
        points = from_millimetres(scan.points, scan.origin)
        grid.fuse(points, scan.count.astype(float), 1e-3 * scan.spread.astype(float), p_world_camera, _POSE_COVARIANCE)

    return fuse


def _added_points(grid: AnyboticsMap) -> _Fuse:
    """Return a function that adds the points of a scan to ANYbotics' map."""

    def add(scan: ReducedScan, p_world_camera: Array, _pixels: NDArray[np.float32]) -> None:
        grid.move_to(p_world_camera[:2])
        grid.add(from_millimetres(scan.points, scan.origin).astype(np.float32), p_world_camera)

    return add


def _added_pixels(grid: AnyboticsMap) -> _Fuse:
    """Return the same function for all pixels, whose points are given."""

    def add(_scan: ReducedScan, p_world_camera: Array, pixels: NDArray[np.float32]) -> None:
        grid.move_to(p_world_camera[:2])
        grid.add(pixels, p_world_camera)

    return add


class _Anew:
    """Sextant's two layers of a map, updated where it changed, or computed completely."""

    def __init__(self, layers: FootholdLayers, away: int):
        """Store the layers.

        The map is reported to have moved by `away` cells each time; a large number leaves no known cell.
        """
        self._layers, self._away, self._moved = layers, away, 0

    def layers(self, elevation: Layer, low: NDArray[np.int64], _: ElevationSnapshot) -> _Scored:
        """Return score and evaluation function."""
        self._moved += self._away
        made = self._layers.update(elevation, np.zeros_like(elevation), low + self._moved)
        return made.score, made.evaluation


def _without_place(peer: Scores) -> _Score:
    return lambda elevation, _low, _snapshot: peer.layers(elevation)


def _by_rule(rule: PluginRule) -> _Score:
    return lambda _elevation, _low, snapshot: (rule.score(snapshot), None)


def _same_where(ours: _Scored, other: _Scored) -> Array:
    """Compare both layers; of a plug-in only whether it takes the same cells as footholds.

    Return 1 where both are equal, 0 where one is not, NaN where the cell is unknown.
    """
    if other[1] is None:
        same = (ours[0] <= MAX_FOOTHOLD_SCORE) == (other[0] <= MAX_FOOTHOLD_SCORE)
        return np.where(ours[1] == UNKNOWN, np.nan, same)
    score = np.isclose(other[0], ours[0], atol=_SAME_SCORE, equal_nan=True)
    return np.where(ours[1] == UNKNOWN, np.nan, score & (other[1] == ours[1]))


def _points(found: ReducedScan | Array) -> Array:
    return from_millimetres(found.points, found.origin) if isinstance(found, ReducedScan) else found


def _rastered(points: Array, centre: Array) -> Array:
    """Return the highest of the points (n, 3) [m] in each cell around a centre.

    NaN in a cell without points.
    """
    half = round(PerceptionSettings().scan_range / _RESOLUTION) + 2
    cells = np.floor((points[:, :2] - centre[:2]) / _RESOLUTION + 1e-6).astype(int) + half
    inside = ((cells >= 0) & (cells < 2 * half)).all(axis=1)
    out = np.full((2 * half, 2 * half), -np.inf)
    np.maximum.at(out, tuple(cells[inside].T), points[inside, 2])
    return np.where(np.isfinite(out), out, np.nan)


class _Services:
    """Perception and mapper on one machine, with encoded messages.

    A map is computed for each frame. Previews are left out: they are made after the scan is sent.
    """

    def __init__(self, profile: RobotProfile):
        rate_hz = profile.camera.sensor.rate_hz
        perception = Perception(profile, PerceptionSettings(settle_s=0.0, scan_rate_hz=rate_hz))
        mapper = Mapper(profile, MapperSettings(publish_every=1))
        perception.stages, mapper.stages = _CoreStages(), _CoreStages()
        self._now_ns = 0
        encode = partial(codec.encode, packs=False)
        self._mapper = ServiceRunner(mapper, self._done, lambda: self._now_ns, encode=encode)
        self._perception = ServiceRunner(
            perception,
            self._to_mapper,
            lambda: self._now_ns,
            wanted=lambda topic: topic is not topics.PREVIEW,
            encode=encode,
        )
        self._layers = b""

    def run(self, odometry: bytes, image: bytes, now_ns: int) -> bytes:
        """Return the encoded layers for an encoded frame; empty if it produces none."""
        self._now_ns, self._layers = now_ns, b""
        self._perception.inbox.receive(topics.ODOMETRY, odometry, self._now_ns)
        self._perception.inbox.receive(topics.DEPTH, image, self._now_ns)
        self._perception.arrived()
        return self._layers

    def parts_ms(self) -> dict[str, float]:
        """Return stage -> median of its time."""
        out = {}
        for worker in (self._perception, self._mapper):
            for name, (p50, _) in worker.service.stages.percentiles().items():
                if name != worker.service.name and not name.startswith("latency "):
                    out[name] = p50
        return out

    def _to_mapper(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        if topic in self._mapper.subscribes:
            self._mapper.inbox.receive(topic, frame, at_ns)
            if topic is topics.SCAN:
                self._mapper.arrived()

    def _done(self, topic: AnyTopic, frame: bytes, _at_ns: int) -> None:
        if topic is topics.TERRAIN:
            self._layers = frame


class _CoreStages(Stages):
    """Stages measured in processor time."""

    def __call__(self, name: str) -> Any:
        return _CoreStage(self, name)


class _CoreStage:
    def __init__(self, stages: Stages, name: str):
        self._stages, self._name = stages, name

    def __enter__(self) -> None:
        self._began = time.process_time_ns()

    def __exit__(self, *_: object) -> None:
        self._stages.add(self._name, 1e-6 * (time.process_time_ns() - self._began))
