"""Footholds that one leg can use: in reach, and with room for foot and shank."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.locomotion.foothold_search import Foothold, NoFoothold, nearest_foothold, offsets_by_distance
from sextant.services.planner.locomotion.leg_collision import rises_clear, stands_clear
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, inverse
from sextant.shared.robot.kinematics import body_inverse, leg_inverse, within_limits
from sextant.shared.robot.profile import RobotProfile


class FootholdFinder:
    """Finds footholds for one robot; it keeps only lookup tables."""

    def __init__(self, profile: RobotProfile, params: StepParams):
        """Initialize for a robot."""
        self._profile, self._params = profile, params
        self.widths = (1.0, params.wide_search_ratio)  # factors of the search radius
        self._foot_up = np.array([0.0, 0.0, profile.foot.radius])  # [m] from the ground to a foot's centre
        self._offsets: dict[float, Array] = {}  # [m] offsets of the cells to try by `widths`, for the current map resolution
        self._offsets_resolution = 0.0  # [m]

    def find(
        self, leg: int, nominal: Array, feet: Array, T_end: Array, T_after: Array, terrain: Terrain, width: float = 1.0
    ) -> Foothold | NoFoothold:
        """Return the best foothold of one leg near its nominal place.

        Args:
            leg: The leg.
            nominal: (2,) [m] {world} touchdown on unobstructed ground.
            feet: (6, 3) [m] {world} centres of the other feet, NaN where not known yet.
            T_end: (4, 4) {world} body pose at the end of the step.
            T_after: (4, 4) {world} body pose when the foot will leave its foothold.
            terrain: The map.
            width: Factor of the robot's search radius, one of `widths`.
        """
        known = np.isfinite(feet[:, 0])
        known[leg] = False
        others = feet[known, :2]
        passed = np.stack([T_end, (T_end + T_after) / 2.0, T_after])  # body poses while the foot stands

        def reachable(points: Array) -> NDArray[np.bool_]:
            at = points + self._foot_up
            above = at + np.array([0.0, 0.0, self._params.descent_m])  # a folded leg descends further out
            reached = self._reaches(leg, (above, T_end), (at, T_end), (at, T_after))
            bounds = passed[[0, 2]]
            reached[reached] = stands_clear(leg, at[reached], bounds, self._params.leg_margin_m, self._profile, terrain)
            reached[reached] = rises_clear(leg, at[reached], passed, self._params.sink_margin_m, self._profile, terrain)
            return reached

        if terrain.map.resolution != self._offsets_resolution:
            radius, self._offsets_resolution = self._profile.stance.search_radius, terrain.map.resolution
            self._offsets = {w: offsets_by_distance(w * radius, terrain.map.resolution) for w in self.widths}
        return nearest_foothold(terrain, nominal, self._offsets[width], others, self._profile.stance.foot_distance, reachable)

    def _reaches(self, leg: int, *ways: tuple[Array, Array]) -> NDArray[np.bool_]:
        """Return which (n,) of foot centres one leg reaches from all of some body poses.

        Each pair holds foot centres (n, 3) [m] {world} and a body pose.
        """
        profile = self._profile
        feet = np.stack([apply(profile.T_coxa_body[leg] @ inverse(T), feet_world) for feet_world, T in ways])
        q = leg_inverse(feet, profile.links)
        limits = profile.joint_limits[leg]
        return np.asarray(((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=(0, 2)))  # NaN, out of reach, fails


def feet_in_reach(profile: RobotProfile, feet_world: Array, T_world_body: Array) -> NDArray[np.bool_]:
    """Return which legs (6,) reach their feet (6, 3) [m] {world} from a body pose (4, 4)."""
    q = body_inverse(profile, apply(inverse(T_world_body), feet_world))
    return np.asarray(within_limits(profile, q).all(axis=1))
