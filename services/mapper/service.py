"""Mapper service: fuse scans into an elevation map and publish it with its scores."""

import math
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.config import Settings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid, ElevationSnapshot
from sextant.services.mapper.elevation.fusion import FusionModel
from sextant.services.mapper.elevation.validated_scan import MAX_COORDINATE_M, ValidatedScan
from sextant.services.mapper.footholds.foothold_feedback import FirstStanceDetector
from sextant.services.mapper.footholds.layers import FootholdLayers, Margin
from sextant.services.mapper.footholds.score import ScoreWeights
from sextant.services.mapper.footholds.terrain_type import TerrainType
from sextant.services.mapper.passage_map.passage_grid import cell_centres, cells_of, feet_plane
from sextant.services.mapper.passage_map.passage_mapping import PassageMapping, ViewProposal
from sextant.services.mapper.passage_map.voxel_cloud import Strip
from sextant.shared.color import from_codes
from sextant.shared.geometry import Array, apply, is_rigid
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    Message,
    Mode,
    PassageMap,
    PassageRequest,
    Scan,
    ScanReceipt,
    TerrainMap,
)

# An unknown cell may be the edge of a block seen from below, so a foot keeps the same distance from it as from an edge.
_WEIGHTS = ScoreWeights(unknown_clearance=0.02)

_SLACK_NS = 10_000_000  # [ns] jitter allowed between scans
_OUT_OF_ORDER_NS = 1_000_000_000  # [ns] a scan older than the newest by less than this is late; by more, the clock has changed
_MAX_BODY_DISTANCE_M = 1.0  # [m] largest distance from body to camera; beyond it, pose and scan do not belong together
_MAX_ORIGIN_DISTANCE_M = 1.0  # [m] largest distance from camera to scan origin, which is a corner of the camera's cell
_NARROWEST = 3  # [cells] smallest length and width of a passage; fewer have no slope
_BOX = 10  # largest ratio of the cells in the box around an oblique passage to the cells allowed in a passage
_EVEN = 5  # feet that must carry load before the first step
_FIRST_SEEN = 0.20  # [m] beyond the assumed ground; the most common colour there is taken as that of the start ground
_NEAR = 1.2  # times the camera's minimum range; a ray without a return carries no information up to there
_MAX_HEIGHT_ERROR_M = (
    0.30  # [m] largest height difference between a foot and the map; beyond it, pose and map do not belong together
)
_CONTRADICTED, _CONTRADICTED_NS = 0.10, 1_000_000_000  # [m], [ns] height error and its duration from which feet refute the map
_SOLE_RADIUS_M, _SOLE_AGREES = 0.05, 0.1  # [m] around a foot, and the minimum share of the cells there that must agree with it
_TOUCH_SIGMA_M = 0.005  # [m] of a height measured by a foot: joint errors and the spherical shape of the foot
_WORST_COVARIANCE = 1e4  # [m^2] and [rad^2] largest valid covariance of a pose
_MAX_SCAN_AGE_S = 0.6  # [s] largest age of a scan, because the planner does not use an older map
_LEVEL = 0.01  # [m] largest deviation from a plane for ground that continues it


class Mapper:
    """Mapping service that fuses scans, scores the map and maps passages on request."""

    name = "mapper"
    trigger: AnyTopic = topics.SCAN
    subscribes: tuple[AnyTopic, ...] = (topics.BODY_POSE, topics.ACTUATOR_STATE, topics.PASSAGE_REQUEST)
    publishes: tuple[AnyTopic, ...] = (topics.SCAN_RECEIPT, topics.TERRAIN, topics.PASSAGE)

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Start with an unknown map."""
        cv2.setNumThreads(1)  # the other services need the other cores, and one thread is deterministic
        self.max_age_s = {topics.SCAN.key: _MAX_SCAN_AGE_S}
        self.stages = Stages()
        self._settings = settings
        self._profile = profile
        self._model = FusionModel.of_sensor(profile.camera.sensor, profile.camera.intrinsics.fx)
        self._grid = ElevationGrid(settings.shape, settings.resolution, self._model)
        self._layers = FootholdLayers(
            settings.shape, settings.resolution, Margin(profile.foot.radius), _WEIGHTS, keep_terms=profile.camera.color
        )
        self._type: TerrainType | None = None  # created at the first scan with colour
        self._hazards: tuple[NDArray[np.uint8], Array] | None = None  # of the newest map, and the centre of its cell (0, 0)
        self._touch_ns = np.full(6, -1, dtype=np.int64)  # stamps of the newest touchdowns in the map
        self._touches = FirstStanceDetector(profile.foot.radius)
        self._stands = False  # whether the colour of the ground at the start is known
        self._seeded = False
        self._contradicted_ns = -1  # stamp of the first scan that the feet refuted without interruption, or -1
        self._restarts = 0  # number of times the map was restarted
        self._scans = 0
        self._newest_ns = -_OUT_OF_ORDER_NS  # stamp of the newest mapped scan
        self._refused = ""  # why the newest scan was not mapped
        self._unpublished, self._published_ns = 0, -1  # scans since the newest map, and the stamp of that map
        self._known = 0.0  # share of known cells
        self._mapping: PassageMapping | None = None
        self._surveyed = 0  # scans since the mapping of this strip began

    def doing(self) -> str:
        """Return the status for the operator: scans, share of known cells, drift."""
        if self._refused:
            return f"the newest scan is not mapped: {self._refused}"
        drift = self._grid.height_drift
        risen = f", the map compensates {1e3 * drift:+.1f} mm of height drift of the pose" if drift else ""
        surveying = ", mapping a gap" if self._mapping is not None else ""
        again = (
            f", restarted {self._restarts} times because the feet stood where the map had no ground" if self._restarts else ""
        )
        return f"mapping, {self._scans} scans, {self._known:.0%} of the cells known{risen}{surveying}{again}"

    def step(self, scan: Scan, inbox: Inbox) -> Iterator[Message]:
        """Fuse one scan, and score and publish the map after several scans.

        A map is due after `publish_every` scans, or after their usual duration where the link drops scans.
        """
        yield ScanReceipt(scan.stamp_ns)
        pose, legs = inbox.latest(topics.BODY_POSE), inbox.latest(topics.ACTUATOR_STATE)
        centre = scan.p_world_camera if pose is None else pose.T_world_body[:3, 3]
        self._refused = self._rejection_reason(scan, pose, centre)
        if self._refused:
            return  # an old map must not be published as a new one
        with self.stages("fuse"):
            try:
                checked = ValidatedScan.of_millimetres(
                    scan.origin,
                    scan.points_mm,
                    scan.count,
                    scan.spread_mm,
                    scan.p_world_camera,
                    scan.pose_covariance,
                    scan.sights_mm,
                    nearest=_NEAR * self._profile.camera.sensor.min_range,
                )
            except ValueError as error:
                self._refused = str(error)
                return
            self._grid.move_to(centre[:2])
            self._grid.fuse(checked)
        self._newest_ns = scan.stamp_ns
        if pose is not None and legs is not None:
            self._apply_touchdowns(pose, legs)
            if self._is_refuted(scan.stamp_ns, pose, legs):
                self._reset_map(centre)
                return
        if not self._seeded and pose is not None and legs is not None and _stand(legs):
            self._assume_ground(pose, legs)
            self._seeded = True
        if self._profile.camera.color and (len(scan.color) or self._type is not None):
            with self.stages("terrain type"):
                self._learn(scan, pose, legs)
        self._scans += 1
        self._unpublished += 1
        usual_ns = round(1e9 * self._settings.publish_every / topics.SCAN.rate_hz) + _SLACK_NS
        late = 0 <= self._published_ns <= scan.stamp_ns - usual_ns
        if late or self._unpublished >= self._settings.publish_every:
            self._unpublished, self._published_ns = 0, scan.stamp_ns
            yield self._terrain(scan.stamp_ns, pose)
        request = inbox.fresh(topics.PASSAGE_REQUEST)
        if request is None:
            self._mapping = None  # the request has ended: discard the passage map
        else:
            yield from self._map_passage(request, scan, inbox)

    def _map_passage(self, request: PassageRequest, scan: Scan, inbox: Inbox) -> Iterator[PassageMap]:
        """Merge the scan into the passage map; publish it every `passage_every` scans."""
        try:
            strip = self._strip(request)
        except ValueError as error:
            self._mapping = None
            if self._scans % self._settings.passage_every == 0:
                yield _no_passage(scan.stamp_ns, request, self._settings.resolution, f"invalid map request: {error}")
            return
        with self.stages("merge"):
            if self._mapping is None:
                self._mapping = PassageMapping(self._profile, strip, self._grid.snapshot(), self._settings.scan_range, _WEIGHTS)
                self._surveyed = 0
            elif self._mapping.strip != strip:
                self._mapping.move_to(strip, self._grid.snapshot())
                self._surveyed = 0
            self._mapping.add(scan.points, scan.count, self._grid.height_drift)
        self._surveyed += 1
        if self._surveyed % self._settings.passage_every == 0:
            yield self._passage(scan.stamp_ns, self._mapping, inbox)

    def _passage(self, stamp_ns: int, mapping: PassageMapping, inbox: Inbox) -> PassageMap:
        """Return the passage map as a message."""
        pose, legs = inbox.latest(topics.BODY_POSE), inbox.fresh(topics.ACTUATOR_STATE)
        T_world_body = np.eye(4) if pose is None else pose.T_world_body
        with self.stages("passage"):
            grid = mapping.grid(self._grid.snapshot())
            evaluation = mapping.evaluation(
                grid,
                math.inf if pose is None else float(T_world_body[2, 3]),
                0.0 if pose is None else _position_sigma(pose),
            )
        if self._hazards is not None:
            evaluation = _without(evaluation, mapping.of_map(*self._hazards, 0))
        unseen = grid.unseen
        if pose is None or legs is None or legs.swing.any():
            # A view is only computed for known feet that all stand.
            words = f"{np.count_nonzero(unseen)} of {unseen.size} cells not seen"
            view_proposal = ViewProposal(
                f"{words}; no view is proposed while legs swing or send no state" if unseen.any() else "", None
            )
        else:
            with self.stages("look"):
                view_proposal = mapping.view_proposal(grid, T_world_body, legs.feet)
        view = view_proposal.view
        return PassageMap(
            stamp_ns=stamp_ns,
            resolution=grid.resolution,
            origin=cell_centres(grid.strip, grid.resolution)[0, 0],
            heading=grid.strip.heading,
            elevation=grid.elevation,
            normals=np.rint(np.nan_to_num(grid.normals) * 32767.0).astype(np.int16),
            roughness=grid.roughness,
            assumed=grid.assumed,
            evaluation=evaluation,
            unseen=float(unseen.mean()),
            reason=view_proposal.words,
            T_world_look=T_world_body if view is None else view.T_world_body,
            look_shows=np.zeros(unseen.shape, dtype=np.bool_) if view is None else view.sees,
        )

    def _strip(self, request: PassageRequest) -> Strip:
        """Return the requested strip.

        Raises:
            ValueError: The strip is invalid or too large.
        """
        settings = self._settings
        strip = Strip((float(request.origin[0]), float(request.origin[1])), request.heading, request.length, request.width)
        nx, ny = cells_of(strip, settings.resolution)
        if min(nx, ny) < _NARROWEST:
            raise ValueError(f"at least {_NARROWEST} cells along and across expected, found {nx} x {ny}")
        if nx * ny > settings.passage_cells:
            raise ValueError(f"at most {settings.passage_cells} cells expected, found {nx} x {ny}")
        columns = math.prod(strip.box(settings.resolution)[1])
        if columns > _BOX * settings.passage_cells:
            most = _BOX * settings.passage_cells
            raise ValueError(
                f"at most {most} cells in the box around the strip expected, found {columns}: "
                "choose a heading along x or y, or a shorter strip"
            )
        return strip

    def _rejection_reason(self, scan: Scan, pose: BodyPose | None, centre: Array) -> str:
        """Return why a scan cannot be mapped, or an empty string.

        Args:
            scan: The scan.
            pose: Newest body pose, if any.
            centre: (3,) [m] {world} position of the body, or else of the camera.
        """
        if 0 <= self._newest_ns - scan.stamp_ns < _OUT_OF_ORDER_NS:  # an older stamp is from another clock
            return "the scan is not newer than the previous one"
        if not (np.abs(centre) < MAX_COORDINATE_M).all():
            return f"a body within {MAX_COORDINATE_M:g} m of the world's origin expected"
        if pose is not None and not is_rigid(pose.T_world_body):
            return f"a rotation and a translation expected for the body's pose, found {pose.T_world_body.tolist()}"
        worst = 0.0 if pose is None else float(np.abs(pose.covariance).max())
        if worst > _WORST_COVARIANCE:
            return f"a pose's covariance of at most {_WORST_COVARIANCE:g} m^2 and rad^2 expected, found {worst:.3g}"
        away = float(np.abs(scan.p_world_camera - centre).max())
        if away > _MAX_BODY_DISTANCE_M:
            return f"the scan was taken {away:.3g} m away from the body"
        off = float(np.abs(scan.origin - scan.p_world_camera).max())
        if off > _MAX_ORIGIN_DISTANCE_M:
            return f"the scan's origin is {off:.3g} m away from its camera"
        return ""

    def _apply_touchdowns(self, pose: BodyPose, legs: ActuatorState) -> None:
        """Correct the map at the newest touchdowns, with or without ground."""
        new = np.flatnonzero(legs.touch_ns > self._touch_ns)
        self._touch_ns = legs.touch_ns.copy()
        for p in apply(pose.T_world_odom, legs.touch[new]):
            if abs(float(self._grid.heights(p[:2])) - p[2]) <= _MAX_HEIGHT_ERROR_M:  # and not NaN
                self._grid.touch(p, _TOUCH_SIGMA_M, self._profile.foot.radius)

    def _is_refuted(self, stamp_ns: int, pose: BodyPose, legs: ActuatorState) -> bool:
        """Return whether stance feet have refuted the map for `_CONTRADICTED_NS`.

        At least three feet that carry load, and all of them but one, must disagree with the known heights around them. A
        single foot over an edge, or a pose error of a few centimetres, does not refute the map.
        """
        carrying = legs.contact
        if legs.swing.any() or not _stand(legs):
            self._contradicted_ns = -1
            return False
        feet = apply(pose.T_world_body, legs.feet)[carrying] - [0.0, 0.0, self._profile.foot.radius]
        refuted = np.count_nonzero([self._disagrees_with_foot(foot) for foot in feet])
        if refuted < max(3, len(feet) - 1):
            self._contradicted_ns = -1
            return False
        if not 0 <= self._contradicted_ns <= stamp_ns:
            self._contradicted_ns = stamp_ns
        return stamp_ns - self._contradicted_ns >= _CONTRADICTED_NS

    def _disagrees_with_foot(self, foot: Array) -> bool:
        """Return whether the map around a foot's underside (3,) [m] {world} is wrong."""
        offsets = np.arange(-_SOLE_RADIUS_M, _SOLE_RADIUS_M + 1e-9, self._settings.resolution)
        around = foot[:2] + np.stack(np.meshgrid(offsets, offsets), axis=-1)
        above = self._grid.heights(around) - foot[2]
        known = above[np.isfinite(above)]
        return bool(len(known)) and float(np.mean(np.abs(known) < _CONTRADICTED)) < _SOLE_AGREES

    def _reset_map(self, centre: Array) -> None:
        """Reset the map; it is rebuilt from the next scans and the feet."""
        self._grid = ElevationGrid(self._settings.shape, self._settings.resolution, self._model)
        self._grid.move_to(centre[:2])
        self._type = self._hazards = self._mapping = None
        self._seeded = self._stands = False
        self._contradicted_ns = -1
        self._restarts += 1

    def _learn(self, scan: Scan, pose: BodyPose | None, legs: ActuatorState | None) -> None:
        """Update the terrain type with the scan's colours and the newest touchdowns."""
        if self._type is None:
            self._type = TerrainType(self._settings.shape, self._settings.resolution, self._grid.low)
        known = self._type
        known.move_to(self._grid.low)
        if len(scan.color):
            known.add_colors(scan.points[:, :2], from_codes(scan.color))
        if pose is None or legs is None:
            return
        if not self._stands:
            self._stands = known.learn_start_ground(self._first_seen(pose.T_world_body))
        for touch in self._touches.update(legs, pose):
            sink = float(self._grid.heights(touch.p_world[:2])) - float(touch.p_world[2])
            if abs(sink) <= _MAX_HEIGHT_ERROR_M:  # and not NaN
                known.touch(touch.p_world[:2], sink if touch.carries else None)

    def _first_seen(self, T_world_body: Array) -> NDArray[np.bool_]:
        """Return the mask (nx, ny) of the nearest measured cells ahead of the body."""
        settings, snapshot = self._settings, self._grid.snapshot()
        x, y = (snapshot.origin[k] + settings.resolution * np.arange(settings.shape[k]) for k in (0, 1))
        off = np.stack(np.broadcast_arrays(x[:, None] - T_world_body[0, 3], y - T_world_body[1, 3]), axis=-1)
        ahead, aside = np.moveaxis(off @ T_world_body[:2, :2], -1, 0)
        near = (ahead < settings.assumed_ahead + _FIRST_SEEN) & (ahead > 0) & (np.abs(aside) < settings.assumed_aside)
        return np.asarray(near & np.isfinite(snapshot.elevation))

    def _assume_ground(self, pose: BodyPose, legs: ActuatorState) -> None:
        """Fill the ground that is out of view at the start with the feet's plane."""
        settings, T = self._settings, pose.T_world_body
        feet = apply(T, legs.feet)[legs.contact & ~legs.swing] - [0.0, 0.0, self._profile.foot.radius]
        plane = feet_plane(feet)
        # A mapper that restarts in mid-course does not know the ground ahead. It then assumes ground ahead only if the measured
        # ground continues the plane of the feet, and otherwise only under the robot.
        known = legs.step == 0 or self._goes_on(T, plane)
        ahead = settings.assumed_ahead if known else float(legs.feet[:, 0].max())
        corners: Array = np.array(
            [
                [ahead, settings.assumed_aside, 0.0],
                [ahead, -settings.assumed_aside, 0.0],
                [-settings.assumed_behind, -settings.assumed_aside, 0.0],
                [-settings.assumed_behind, settings.assumed_aside, 0.0],
            ]
        )
        self._grid.seed_plane(apply(T, corners)[:, :2], plane)

    def _goes_on(self, T_world_body: Array, plane: Array) -> bool:
        """Return whether the nearest ground ahead lies in a plane (a, bx, cy) [m] {world}."""
        settings = self._settings
        x, y = np.meshgrid(
            settings.assumed_ahead + np.linspace(-0.1, 0.1, 11), np.linspace(-1, 1, 21) * settings.assumed_aside, indexing="ij"
        )
        points = apply(T_world_body, np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))[:, :2]
        above = self._grid.heights(points) - np.column_stack([np.ones(len(points)), points]) @ plane
        seen = above[np.isfinite(above)]
        return bool(len(seen) > 0.3 * len(points) and np.percentile(np.abs(seen), 95) < _LEVEL)

    def _terrain(self, stamp_ns: int, pose: BodyPose | None) -> TerrainMap:
        with self.stages("snapshot"):
            snapshot = self._grid.snapshot()
        with self.stages("score"):
            layers = self._layers.update(
                snapshot.elevation,
                _measured_variance(snapshot),
                np.round(snapshot.origin / snapshot.resolution - 0.5).astype(np.int64),
                math.inf if pose is None else float(pose.T_world_body[2, 3]),
                0.0 if pose is None else _position_sigma(pose),
            )
        self._known = float(np.isfinite(snapshot.elevation).mean())
        score, evaluation = layers.score, layers.evaluation
        made_of: dict[str, NDArray[np.uint8]] = {}
        if self._type is not None:
            with self.stages("terrain type"):
                found = self._type.classify(*self._layers.terms())
                score = score + found.cost
                evaluation = _without(evaluation, found.hazard)
                self._hazards = found.hazard, snapshot.origin
                made_of = {"color": self._type.rgb(), "hazard": found.hazard, "confidence": found.confidence}
        return TerrainMap(
            stamp_ns=stamp_ns,
            resolution=snapshot.resolution,
            origin=snapshot.origin,
            elevation=snapshot.elevation,
            variance=snapshot.variance,
            score=score,
            evaluation=evaluation,
            assumed=snapshot.assumed.astype(np.bool_),
            **made_of,
        )


def _stand(legs: ActuatorState) -> bool:
    """Return whether the feet show the height of the ground.

    They do not with torque off or while the robot is carried. Before the first step at least `_EVEN` feet must carry load:
    if more feet hang, the ground is not a plane.
    """
    carrying = legs.contact & ~legs.swing
    enough = _EVEN if legs.step == 0 and not legs.swing.any() else 3
    near = np.abs(legs.feet).max() < _MAX_BODY_DISTANCE_M
    return bool(legs.mode is not Mode.OFF and np.count_nonzero(carrying) >= enough and near)


def _no_passage(stamp_ns: int, request: PassageRequest, resolution: float, reason: str) -> PassageMap:
    """Return a passage map without cells, with the reason."""
    nothing = np.zeros((0, 0))
    return PassageMap(
        stamp_ns=stamp_ns,
        resolution=resolution,
        origin=request.origin,
        heading=request.heading,
        elevation=nothing.astype(np.float32),
        normals=np.zeros((0, 0, 3), dtype=np.int16),
        roughness=nothing.astype(np.float32),
        assumed=nothing.astype(np.bool_),
        evaluation=nothing.astype(np.int8),
        unseen=1.0,
        reason=reason,
        T_world_look=np.eye(4),
        look_shows=nothing.astype(np.bool_),
    )


def _without(evaluation: NDArray[np.int8], hazard: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Return the evaluation function with the cells of a hazard marked as no foothold."""
    return np.where(hazard > 0, np.maximum(evaluation, np.int8(1)), evaluation)


def _measured_variance(snapshot: ElevationSnapshot) -> NDArray[np.float32]:
    """Return the variance (nx, ny) [m^2], 0 for assumed heights.

    A plane that is assumed has no uncertain edges.
    """
    return np.where(snapshot.assumed != 0, np.float32(0.0), snapshot.variance)


def _position_sigma(pose: BodyPose) -> float:
    """Return the standard deviation [m] of the body's least certain horizontal axis."""
    xy = pose.covariance[:2, :2]
    half, spread = (xy[0, 0] + xy[1, 1]) / 2, math.hypot((xy[0, 0] - xy[1, 1]) / 2, xy[0, 1])
    return math.sqrt(max(0.0, half + spread))
