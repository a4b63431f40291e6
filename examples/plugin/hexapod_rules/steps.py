"""A step planner: each foot goes to the foothold nearest to its place under the body."""

import numpy as np

from sextant.plugins import NoStep, RobotProfile, Step, StepRequest, TerrainMap

REACH = 0.05  # [m] search around the place of a foot on unobstructed ground
SHARES = (1.0, 0.6, 0.3)  # of the commanded motion, tried in this order


class NearestFoothold:
    """Plans steps of the gait's first group of legs."""

    def __init__(self, profile: RobotProfile):
        self.profile = profile

    def plan(self, request: StepRequest) -> Step | NoStep:
        """Return the longest step for which every swinging foot finds a foothold, and a shorter one after a refusal."""
        for share in SHARES[min(request.refused, len(SHARES) - 1) :]:
            step = self.step(request, share)
            if isinstance(step, Step):
                break
        return step

    def step(self, request: StepRequest, share: float) -> Step | NoStep:
        """Return a step with a share of the commanded motion."""
        travel = share * request.step_s * request.velocity
        stride = self.profile.stance.stride / request.stances  # [m] longest travel in a step
        travel *= min(1.0, stride / max(float(np.linalg.norm(travel)), 1e-9))
        turn = share * request.step_s * request.yaw_rate
        end = moved(request.T_world_body, travel, turn)
        middle = moved(end, travel * request.stances / 2, turn * request.stances / 2)  # of the stance that follows
        swing, touchdown = request.due[0], request.feet.copy()
        rest = self.profile.rest_feet(request.body_height)
        for leg in np.flatnonzero(swing):
            place = foothold(request.map, (middle[:3, :3] @ rest[leg] + middle[:3, 3])[:2])
            if place is None:
                return NoStep("no foothold near its place", int(leg))
            touchdown[leg] = place
            touchdown[leg, 2] += self.profile.foot.radius
        end[2, 3] = touchdown[:, 2].mean() - self.profile.foot.radius + request.body_height
        rise = np.abs(touchdown[:, 2] - request.feet[:, 2])
        clearance = np.minimum(np.maximum(request.lift, rise.max() + 0.02), self.profile.stance.max_lift)
        return Step(swing, touchdown, end, np.full(6, clearance), request.step_s)


def moved(T_world_body, travel, turn: float):
    """Return the level body pose after a travel (2,) [m] {body} and a turn [rad]."""
    yaw = np.arctan2(T_world_body[1, 0], T_world_body[0, 0])
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw + turn), -np.sin(yaw + turn)], [np.sin(yaw + turn), np.cos(yaw + turn)]]
    way = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ travel
    T[:3, 3] = T_world_body[:3, 3] + [*way, 0.0]
    return T


def foothold(terrain: TerrainMap, xy):
    """Return the nearest place (3,) [m] {world} that carries a foot, or None."""
    n = round(REACH / terrain.resolution)
    offsets = np.stack(np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1), indexing="ij"), -1).reshape(-1, 2)
    offsets = offsets[np.argsort(np.linalg.norm(offsets, axis=1), kind="stable")]
    cells = np.rint((xy - terrain.origin) / terrain.resolution).astype(int) + offsets
    cells = cells[((cells >= 0) & (cells < terrain.score.shape)).all(axis=1)]
    good = cells[terrain.score[tuple(cells.T)] <= 1.0]  # NaN is unknown
    if not len(good):
        return None
    return np.array([*(terrain.origin + terrain.resolution * good[0]), terrain.elevation[tuple(good[0])]])
