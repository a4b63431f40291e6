"""Moving obstacles of a scenario, as solids for the renderer.

The camera sees them, but they have no contacts.
"""

import math

import numpy as np

from sextant.services.simulator.physics.solids import Boxes, Capsules
from sextant.services.simulator.physics.terrain import Terrain
from sextant.shared.geometry import Array, rotation_z, yaw_of
from sextant.shared.scenario.mover import BoxMover, LegsMover, Mover


class _Walk:
    """Motion of one mover along its path, with repetitions."""

    def __init__(self, mover: Mover, start_s: float):
        self.mover, self._start_s = mover, start_s
        path = np.asarray(mover.path, dtype=np.float64)
        self._path, self._corners = path, path
        self._at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])  # [m] to each corner
        self._lap = -1  # repetition for which the corners {world} are computed

    def travelled(self, now_s: float, T_world_body: Array) -> float:
        """Return the distance [m] along the path, NaN while the mover is absent.

        A path in the robot's frame is transformed to {world} at the start of each repetition.
        """
        since_s = now_s - self._start_s
        if since_s < 0.0:
            return math.nan
        period_s = self.mover.period_s
        lap = int(since_s // period_s) if period_s > 0.0 else 0
        if lap != self._lap:
            self._lap = lap
            if self.mover.frame == "robot":
                R = rotation_z(yaw_of(T_world_body))[:2, :2]
                self._corners = self._path @ R.T + T_world_body[:2, 3]
        way = (since_s - lap * period_s) * self.mover.speed
        return way if way <= self._at[-1] else math.nan

    def place(self, way: float) -> tuple[Array, Array]:
        """Return the point (2,) [m] {world} and the direction (2,) at a path distance [m].

        Distances outside the path extrapolate its first or last segment.
        """
        k = int(np.clip(np.searchsorted(self._at, way, side="right") - 1, 0, len(self._at) - 2))
        ahead = (self._corners[k + 1] - self._corners[k]) / (self._at[k + 1] - self._at[k])
        return self._corners[k] + (way - self._at[k]) * ahead, ahead


class Movers:
    """All moving obstacles of a scenario."""

    def __init__(self, movers: tuple[Mover, ...], terrain: Terrain, rng: np.random.Generator):
        """Draw the start times.

        Args:
            movers: Movers of the scenario.
            terrain: Ground on which they move.
            rng: Generator of the start delays; one draw per mover, only here.
        """
        self._terrain = terrain
        self._walks = [_Walk(mover, mover.start_s + mover.start_spread_s * rng.random()) for mover in movers]
        self._ways: list[float] = [math.nan] * len(movers)

    def __len__(self) -> int:
        return len(self._walks)

    def add(self, mover: Mover) -> None:
        """Add a moving obstacle, which starts at its simulated time without a random delay."""
        self._walks.append(_Walk(mover, mover.start_s))
        self._ways.append(math.nan)

    def advance(self, now_s: float, T_world_body: Array) -> None:
        """Move all obstacles to a simulated time [s].

        The robot's body pose (4, 4) at that time places paths in the robot's frame.
        """
        self._ways = [walk.travelled(now_s, T_world_body) for walk in self._walks]

    def solids(self) -> tuple[Boxes, Capsules]:
        """Return the solids of the movers that are present."""
        centre, half, R = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros((0, 3, 3))]
        start, end, radius = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
        for walk, way in zip(self._walks, self._ways, strict=True):
            if math.isnan(way):
                continue
            mover = walk.mover
            if isinstance(mover, BoxMover):
                p, ahead = walk.place(way)
                size = np.asarray(mover.size)
                centre.append(np.array([[*p, self._ground(p) + size[2] / 2]]))
                half.append(size[None] / 2)
                R.append(rotation_z(math.atan2(ahead[1], ahead[0]))[None])
            else:
                for leg in (0, 1):
                    foot, hip = self._leg(walk, mover, way, leg)
                    start.append(foot[None])
                    end.append(hip[None])
                    radius.append(np.array([mover.radius]))
        boxes = Boxes(np.concatenate(centre), np.concatenate(half), np.concatenate(R))
        return boxes, Capsules(np.concatenate(start), np.concatenate(end), np.concatenate(radius))

    def _leg(self, walk: _Walk, mover: LegsMover, way: float, leg: int) -> tuple[Array, Array]:
        """Return the lower and upper end (3,) [m] {world} of a leg's axis.

        A cycle is two strides: stance in its first half, swing in its second half.
        """
        share = (way / mover.stride + leg) / 2.0 % 1.0
        swung = max(0.0, 2.0 * share - 1.0)  # 0 to 1
        off = mover.stride * (0.5 - 2.0 * share + 2.0 * swung)  # [m] of the foot ahead of the hip
        hip, ahead = walk.place(way)
        aside = (0.5 - leg) * mover.hips * np.array([-ahead[1], ahead[0]])
        hip = hip + aside
        foot = hip + off * ahead
        ground = self._ground(foot)
        lower = ground + mover.radius + mover.lift * math.sin(math.pi * swung)
        return np.array([*foot, lower]), np.array([*hip, ground + mover.height - mover.radius])

    def _ground(self, p: Array) -> float:
        """Return the height [m] {world} of the ground, 0 where there is none."""
        z = float(self._terrain.height_at(p[None])[0])
        return z if math.isfinite(z) else 0.0


def together(one: tuple[Boxes, Capsules], other: tuple[Boxes, Capsules]) -> tuple[Boxes, Capsules]:
    """Return the union of two groups of solids."""
    a, b = one[0], other[0]
    boxes = Boxes(np.concatenate([a.centre, b.centre]), np.concatenate([a.half, b.half]), np.concatenate([a.R, b.R]))
    c, d = one[1], other[1]
    capsules = Capsules(
        np.concatenate([c.start, d.start]), np.concatenate([c.end, d.end]), np.concatenate([c.radius, d.radius])
    )
    return boxes, capsules
