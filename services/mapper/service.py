"""The mapper: scans in, the terrain with its score out."""

from collections.abc import Iterator

import cv2
import numpy as np

from services.mapper.config import Settings
from services.mapper.elevation import ElevationGrid, FusionModel, fill_small_holes
from services.mapper.score import ScoreWeights, WalkabilityScorer
from shared import topics
from shared.geometry import Array, apply
from shared.messages import ActuatorState, BodyPose, Message, Scan, TerrainMap
from shared.robot import RobotProfile
from shared.service import AnyTopic, Inbox, Stages

# What is unknown may be the edge of a block seen from below, so a foot keeps as far from it as from an edge.
_WEIGHTS = ScoreWeights(unknown_clearance=0.02)

_LEVEL = 0.01  # [m] by which ground may leave a plane and still go on as it


class Mapper:
    """Fuses every scan, scores the map, and publishes both around the robot."""

    name = "mapper"
    paced_by: AnyTopic = topics.SCAN
    reads: tuple[AnyTopic, ...] = (topics.BODY_POSE, topics.ACTUATOR_STATE)
    writes: tuple[AnyTopic, ...] = (topics.TERRAIN,)

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Begin with an unknown world."""
        cv2.setNumThreads(1)  # the neighbours need the other cores, and one thread is deterministic
        self.stages = Stages()
        self._settings = settings
        self._foot_radius = profile.foot.radius
        model = FusionModel.of_sensor(profile.camera.sensor, profile.camera.intrinsics.fx)
        self._grid = ElevationGrid(settings.shape, settings.resolution, model)
        self._scorer = WalkabilityScorer(settings.shape, settings.resolution, _WEIGHTS)
        self._seeded = False
        self._scans = 0
        self._known = 0.0  # share of the cells

    def doing(self) -> str:
        """How much is known."""
        return f"mapping, {self._scans} scans, {self._known:.0%} of the cells known"

    def step(self, scan: Scan, inbox: Inbox) -> Iterator[Message]:
        """Fuse one scan; every few of them score and publish the map."""
        pose, legs = inbox.latest(topics.BODY_POSE), inbox.latest(topics.ACTUATOR_STATE)
        centre = scan.p_world_camera if pose is None else pose.T_world_body[:3, 3]
        with self.stages("fuse"):
            self._grid.move_to(centre[:2])
            self._grid.fuse(
                scan.origin + scan.points_mm * 1e-3,
                scan.count,
                scan.spread_mm * 1e-3,
                scan.p_world_camera,
                pose_variance_z=scan.pose_variance_z,
            )
        if not self._seeded and pose is not None and legs is not None:
            self._assume_ground(pose, legs)
            self._seeded = True
        self._scans += 1
        if self._scans % self._settings.publish_every == 0:
            yield self._terrain(scan.stamp_ns)

    def _assume_ground(self, pose: BodyPose, legs: ActuatorState) -> None:
        """Fill what the camera cannot see at the start with the plane of the standing feet; measurements amend it."""
        settings, T = self._settings, pose.T_world_body
        feet = apply(T, legs.feet)[~legs.swing] - [0.0, 0.0, self._foot_radius]
        plane: Array = np.linalg.lstsq(np.column_stack([np.ones(len(feet)), feet[:, :2]]), feet[:, 2], rcond=None)[0].astype(
            np.float64
        )
        # In mid-course, where a mapper begins anew, there may be anything ahead: unless what is seen beyond goes on as the
        # feet stand, only the ground under the robot is taken for known.
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
        """Whether the first ground seen ahead lies in a plane (a, bx, cy) [m] {world}."""
        settings = self._settings
        x, y = np.meshgrid(
            settings.assumed_ahead + np.linspace(-0.1, 0.1, 11), np.linspace(-1, 1, 21) * settings.assumed_aside, indexing="ij"
        )
        points = apply(T_world_body, np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))[:, :2]
        above = self._grid.heights(points) - np.column_stack([np.ones(len(points)), points]) @ plane
        seen = above[np.isfinite(above)]
        return bool(len(seen) > 0.3 * len(points) and np.percentile(np.abs(seen), 95) < _LEVEL)

    def _terrain(self, stamp_ns: int) -> TerrainMap:
        with self.stages("snapshot"):
            snapshot = self._grid.snapshot()
        with self.stages("score"):
            score = self._scorer.score(fill_small_holes(snapshot.elevation)).score
        self._known = float(np.isfinite(snapshot.elevation).mean())
        return TerrainMap(
            stamp_ns=stamp_ns,
            resolution=snapshot.resolution,
            origin=snapshot.origin,
            elevation=snapshot.elevation,
            variance=snapshot.variance,
            score=score,
            assumed=snapshot.assumed.astype(np.bool_),
        )
