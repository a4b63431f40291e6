"""Walking without a map: the ground is assumed to be the plane of the feet.

Every foot descends until it touches. The actuator stops a foot where it meets ground. So a touchdown is planned below the
expected ground, up to 5 cm and within the reach of the leg. Higher ground stops the foot earlier. The terrain ahead is unknown:
steps are short and slow, feet go high, and the next step is planned after all six feet stand and have been measured.
"""

from collections.abc import Set
from dataclasses import replace

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.body_pose import leaning, slope_under
from sextant.services.planner.locomotion.step_planner import NoStep, PlannedStep, StepPlanner, StepStart
from sextant.services.planner.terrain import DEEP, Terrain, plane_of, plane_through
from sextant.shared.geometry import Array, from_xyz_rpy, rpy_from_rotation, yaw_of
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.servo.servo_model import Feedback
from sextant.shared.wire.messages import GaitRequest, VelocityCommand

_DEPTHS = (0.05, 0.04, 0.03, 0.02, 0.01, 0.0)  # [m] depths below the plane for a touchdown; the first within reach is used


class BlindStepPlanner:
    """Plans steps over ground that the camera does not see."""

    def __init__(self, profile: RobotProfile, settings: Settings):
        """Initialize for a robot."""
        self._profile = profile
        self.has_touch = Feedback.POSITION in profile.servo_model.feedback  # else feet stand where the ground is expected
        self._params = params = settings.blind_walking
        self._max_lean_deg, self._blind_radius_m = settings.step.max_lean_deg, settings.costmap.blind_radius_m
        front, middle, rear = (params.width_ratio * radius for radius in profile.stance.foot_radius_from_coxa)
        slow = replace(
            profile.stance,
            step_s=params.step_s,
            stride=params.stride_m,
            foot_radius_from_coxa=(front, middle, rear),
        )
        self._strides = StepPlanner(replace(profile, stance=slow), settings)

    def asked(self, command: VelocityCommand) -> VelocityCommand:
        """Return the command with the higher lift of walking by touch; the tripod takes the place of `auto`."""
        gait: GaitRequest = "tripod" if command.gait == "auto" else command.gait
        return replace(command, lift=max(command.lift, self._params.lift_m), gait=gait, auto_speed=False)

    def terrain(self, stamp_ns: int, feet: Array) -> Terrain:
        """Return the expected ground for standing feet (6, 3) [m] {world}."""
        return plane_of(stamp_ns, feet - [0.0, 0.0, self._profile.foot.radius])

    def fill_unseen_start(self, terrain: Terrain, feet: Array, put_down: Array, course: float) -> Terrain | None:
        """Return the map with unseen cells near the start replaced by the feet's plane.

        The camera cannot see ground so close to the robot, in any direction. Cells of a known hazard stay unseen.

        Args:
            terrain: The newest map.
            feet: (6, 3) [m] {world} foot centres, all standing.
            put_down: (2,) [m] {world} position of the robot before its first step.
            course: [rad] {world} direction of motion.

        Returns:
            The map; None if the ground ahead is also unseen, or does not lie in that plane.
        """
        xy, height, slope = plane_through(feet - [0.0, 0.0, self._profile.foot.radius])
        ahead = np.array([np.cos(course), np.sin(course)])
        radius = self._blind_radius_m
        ranges = np.arange(radius, radius + self._params.seen_length_m, 0.02)
        along, aside = np.meshgrid(
            ranges, np.arange(-self._params.seen_half_width_m, self._params.seen_half_width_m + 1e-9, 0.02)
        )
        beyond = put_down + along[..., None] * ahead + aside[..., None] * np.array([-ahead[1], ahead[0]])
        above = terrain.heights(beyond) - height - (beyond - xy) @ slope
        if np.isfinite(above).mean() < self._params.seen_share or abs(float(np.nanmedian(above))) > self._params.level_m:
            return None
        m = terrain.map
        x, y = (m.origin[k] + m.resolution * np.arange(m.elevation.shape[k]) for k in (0, 1))
        near = np.hypot(x[:, None] - put_down[0], y - put_down[1]) < radius
        unseen = near & ~np.isfinite(m.elevation)
        if m.hazard.size:
            unseen &= m.hazard == 0  # a foot found no ground there
        plane = height + slope[0] * (x[:, None] - xy[0]) + slope[1] * (y - xy[1])
        filled = replace(
            m,
            elevation=np.where(unseen, plane, m.elevation).astype(np.float32),
            score=np.where(unseen, 0.0, m.score).astype(np.float32),
            evaluation=np.where(unseen, DEEP, m.evaluation).astype(np.int8),
            assumed=m.assumed | unseen,
        )
        return replace(terrain, map=filled)

    def choose(
        self, situations: list[StepStart], terrain: Terrain, refused: Set[int] = frozenset()
    ) -> tuple[PlannedStep | NoStep, int]:
        """Return the next step and the number of its way, or why there is none.

        Legs that are not due may also swing.

        Args:
            situations: Possible starts of the step, the most due legs first.
            terrain: The expected ground.
            refused: Ways that must not be tried.
        """
        found, way = self._strides.choose(situations, terrain, refused)
        if isinstance(found, NoStep) or not found.swing.any():
            return found, way
        begin = next(at for at in situations if (at.swing == found.swing).all())
        stride = self._along(found, begin)
        return self._lowered(stride) if self.has_touch else stride, way

    def _along(self, stride: PlannedStep, at: StepStart) -> PlannedStep:
        """Return the step with the body parallel to the feet, averaged over a few steps.

        There is no gravity reference here. Each foothold has a measurement error. A body that is kept level by footholds tilts
        by the sum of these errors. A body that is parallel to its feet follows the ground.
        """
        level = from_xyz_rpy(stride.body_goal[:3, 3], (0.0, 0.0, yaw_of(stride.body_goal)))
        slope = slope_under(at.feet, level)
        steep = max(float(np.linalg.norm(slope)) / np.radians(self._max_lean_deg), 1.0)
        was = rpy_from_rotation(at.T_world_body[:3, :3])[:2]
        goal = leaning(level, was + self._params.slope_share * (slope / steep - was), 0.0)
        return replace(stride, body_goal=goal) if self._strides.reached(stride.touchdown, goal).all() else stride

    def _lowered(self, stride: PlannedStep) -> PlannedStep:
        """Return the step with its touchdowns lowered as far as the legs reach.

        `_DEPTHS` lists the depths below the expected ground.
        """
        touchdown = stride.touchdown.copy()
        for depth in _DEPTHS:
            lower = stride.touchdown - [0.0, 0.0, depth]
            reached = self._strides.reached(lower, stride.body_goal) & stride.swing
            fresh = reached & (touchdown[:, 2] == stride.touchdown[:, 2])
            touchdown[fresh] = lower[fresh]
        before, after = np.maximum(stride.start, stride.touchdown)[:, 2], np.maximum(stride.start, touchdown)[:, 2]
        clearance = np.minimum(stride.clearance + before - after, self._profile.stance.max_lift)
        return replace(stride, touchdown=touchdown, clearance=clearance)
