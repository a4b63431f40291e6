"""Mapper service: fuse scans into an elevation map and publish it with its scores."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.config import Settings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid, ElevationSnapshot
from sextant.services.mapper.elevation.foot_evidence import FootEvidence
from sextant.services.mapper.elevation.fusion import FusionModel
from sextant.services.mapper.elevation.ground_changes import GroundChanges
from sextant.services.mapper.elevation.scan_admission import ScanAdmission
from sextant.services.mapper.elevation.start_ground import assume_start_ground
from sextant.services.mapper.elevation.validated_scan import ValidatedScan
from sextant.services.mapper.footholds.layers import FootholdLayers, Layers, body_height_and_sigma
from sextant.services.mapper.footholds.plugin_rule import PluginRule
from sextant.services.mapper.footholds.terrain_type_mapping import TerrainTypeMapping, without_hazards
from sextant.services.mapper.passage_map.passage_survey import PassageSurvey, empty_passage_map
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, BodyPose, Message, PassageMap, Scan, ScanReceipt, TerrainMap

_SLACK_NS = 10_000_000  # [ns] jitter allowed between scans
_NEAR_RATIO = 1.2  # [1] multiple of the camera's minimum range, up to which a ray without a return carries no information
_MAX_SCAN_AGE_S = 0.6  # [s] largest age of a scan, because the planner does not use an older map


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
        self._settings, self._profile = settings, profile
        shape, resolution, foot_radius_m = settings.shape, settings.resolution, profile.foot.radius
        self._model = FusionModel.of_sensor(profile.camera.sensor, profile.camera.intrinsics.fx, settings.elevation)
        self._grid = self._unseen_grid()
        self._layers = FootholdLayers.of(shape, resolution, foot_radius_m, settings.footholds, profile.camera.color)
        self._rule = PluginRule(profile, settings.foothold_rule) if settings.foothold_rule else None
        self._admission = ScanAdmission()
        self._ground = GroundChanges()
        self._feet = FootEvidence(foot_radius_m, resolution, settings.leg_difference)
        self._types = TerrainTypeMapping(settings, foot_radius_m)
        self._hazards: tuple[NDArray[np.uint8], Array] | None = None  # of the newest map, and the centre of its cell (0, 0)
        self._survey = PassageSurvey(profile, settings, self.stages)
        self._knows_start = False  # whether the ground at the start has been assumed
        self._restarts = 0  # number of times the map was restarted
        self._scans = 0
        self._refused = ""  # why the newest scan was not mapped
        self._unpublished, self._published_ns = 0, -1  # scans since the newest map, and the stamp of that map
        self._known = 0.0  # share of known cells

    def _unseen_grid(self) -> ElevationGrid:
        settings = self._settings
        return ElevationGrid(settings.shape, settings.resolution, self._model, settings.ray_clearing, settings.height_drift)

    def status(self) -> str:
        """Return the status for the operator: scans, share of known cells, drift."""
        if self._refused:
            return f"the newest scan is not mapped: {self._refused}"
        drift = self._grid.height_drift
        risen = f", the map compensates {1e3 * drift:+.1f} mm of height drift of the pose" if drift else ""
        surveying = ", mapping a gap" if self._survey.is_running else ""
        again = (
            f", restarted {self._restarts} times because the feet stood where the map had no ground" if self._restarts else ""
        )
        legs = self._feet.leg_heights.describe()
        differs = f"; {legs}" if legs else ""
        return f"mapping, {self._scans} scans, {self._known:.0%} of the cells known{risen}{surveying}{again}{differs}"

    def step(self, scan: Scan, inbox: Inbox) -> Iterator[Message]:
        """Fuse one scan, and score and publish the map after several scans.

        A map is due after `publish_every` scans, or after their usual duration where the link drops scans.
        """
        yield ScanReceipt(scan.stamp_ns, self._refused, self._feet.leg_heights.measured)
        pose, legs = inbox.latest(topics.BODY_POSE), inbox.latest(topics.ACTUATOR_STATE)
        centre = scan.p_world_camera if pose is None else pose.T_world_body[:3, 3]
        self._refused = self._admission.rejection_reason(scan, pose, centre) or self._fuse(scan, centre, pose, legs)
        if self._refused:
            return  # an old map must not be published as a new one
        if pose is not None and legs is not None:
            self._feet.apply_touchdowns(self._grid, pose, legs)
            if self._feet.is_refuted(self._grid, scan.stamp_ns, pose, legs):
                self._reset_map(centre)
                return
            if not self._knows_start:
                self._knows_start = assume_start_ground(self._grid, self._settings, self._profile.foot.radius, pose, legs)
        if self._profile.camera.color and (len(scan.color) or self._types.has_types):
            with self.stages("terrain type"):
                self._types.update(scan, self._grid, pose, legs)
        self._scans += 1
        if self._is_map_due(scan.stamp_ns):
            yield self._terrain(scan.stamp_ns, pose)
        yield from self._map_passage(scan, pose, inbox)

    def _fuse(self, scan: Scan, centre: Array, pose: BodyPose | None, legs: ActuatorState | None) -> str:
        """Fuse a scan around the body (3,) [m] {world}; return why it is refused, or ""."""
        with self.stages("fuse"):
            try:
                validated = ValidatedScan.of_millimetres(
                    scan.origin,
                    scan.points_mm,
                    scan.pixel_count,
                    scan.height_range_mm,
                    scan.p_world_camera,
                    scan.pose_covariance,
                    scan.free_rays_mm,
                    nearest=_NEAR_RATIO * self._profile.camera.sensor.min_range,
                )
            except ValueError as error:
                return str(error)
            self._grid.move_to(centre[:2])
            change = self._ground.next(scan.ground_change)
            if change is not None:
                self._grid.change_ground(change)
                if pose is not None and legs is not None:
                    self._feet.change_ground(change, pose, legs)
            ground = None
            if pose is not None and legs is not None:
                ground = self._feet.confirmed_ground(self._grid, scan.stamp_ns, pose, legs)
            off = self._grid.fuse(validated, ground).contradiction
        self._admission.accept(scan.stamp_ns)
        if off == 0.0:
            return ""
        where = "below" if off < 0.0 else "above"
        return (
            f"the camera shows the ground {abs(off) * 1e2:.0f} cm {where} the map, on which the feet stand: "
            "check its intrinsics and mount, and that nothing stands before it"
        )

    def _reset_map(self, centre: Array) -> None:
        """Reset the map; it is rebuilt from the next scans and the feet."""
        self._grid = self._unseen_grid()
        self._grid.move_to(centre[:2])
        self._feet.forget()
        self._types.reset()
        self._survey.end()
        self._hazards = None
        self._knows_start = False
        self._restarts += 1

    def _is_map_due(self, stamp_ns: int) -> bool:
        """Return whether to publish the map after this scan."""
        self._unpublished += 1
        usual_ns = round(1e9 * self._settings.publish_every / topics.SCAN.rate_hz) + _SLACK_NS
        late = 0 <= self._published_ns <= stamp_ns - usual_ns
        if not late and self._unpublished < self._settings.publish_every:
            return False
        self._unpublished, self._published_ns = 0, stamp_ns
        return True

    def _terrain(self, stamp_ns: int, pose: BodyPose | None) -> TerrainMap:
        with self.stages("snapshot"):
            snapshot = self._grid.snapshot()
        with self.stages("score"):
            layers = self._layers.update(
                snapshot.elevation,
                _measured_variance(snapshot),
                np.round(snapshot.origin / snapshot.resolution - 0.5).astype(np.int64),
                *body_height_and_sigma(pose),
            )
        self._known = np.count_nonzero(np.isfinite(snapshot.elevation)) / snapshot.elevation.size
        score, evaluation = self._score(snapshot, layers), layers.evaluation
        made_of: dict[str, NDArray[np.uint8]] = {}
        if self._types.has_types:
            with self.stages("terrain type"):
                found = self._types.classify(*self._layers.terms())
                score = score + found.cost
                evaluation = without_hazards(evaluation, found.hazard)
                self._hazards = found.hazard, snapshot.origin
                made_of = {"color": self._types.rgb(), "hazard": found.hazard, "confidence": found.confidence}
        return TerrainMap(
            stamp_ns=stamp_ns,
            resolution=snapshot.resolution,
            origin=snapshot.origin,
            elevation=snapshot.elevation,
            variance=snapshot.variance,
            score=score,
            evaluation=evaluation,
            assumed=snapshot.assumed.astype(np.bool_),
            leg_heights=self._feet.leg_heights.differences.copy(),
            **made_of,
        )

    def _score(self, snapshot: ElevationSnapshot, layers: Layers) -> NDArray[np.float32]:
        """Return the score (nx, ny) of the map: Lotriet's, or that of the plug-in."""
        if self._rule is None:
            return layers.score
        with self.stages("foothold plug-in"):
            return self._rule.score(snapshot)

    def _map_passage(self, scan: Scan, pose: BodyPose | None, inbox: Inbox) -> Iterator[PassageMap]:
        """Merge the scan into the requested passage map; publish it every `passage_every` scans."""
        request = inbox.fresh(topics.PASSAGE_REQUEST)
        if request is None:
            self._survey.end()
            return
        invalid_reason = self._survey.add(request, scan, self._grid)
        if not self._survey.is_map_due:
            return
        if invalid_reason:
            yield empty_passage_map(scan.stamp_ns, request, self._settings.resolution, invalid_reason)
        else:
            legs = inbox.fresh(topics.ACTUATOR_STATE)
            yield self._survey.passage_map(scan.stamp_ns, self._grid, pose, legs, self._hazards)


def _measured_variance(snapshot: ElevationSnapshot) -> NDArray[np.float32]:
    """Return the variance (nx, ny) [m^2], 0 for assumed heights.

    A plane that is assumed has no uncertain edges.
    """
    if not snapshot.assumed.any():
        return snapshot.variance
    return np.where(snapshot.assumed != 0, np.float32(0.0), snapshot.variance)
