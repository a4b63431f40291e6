"""The true ground of a run's course, in its frame {start}.

{start} lies on the true ground under the robot's initial position, x along its initial heading, z up. It is the ground truth's
counterpart of the services' {world}. Before the first step, {start} is placed so that position and heading of truth and
estimate agree, so errors count from there. Its height never comes from an estimate.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, apply, inverse, rotation_z, transform, yaw_of
from sextant.shared.robot.profile import Camera
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.scenario.terrain import ON_GROUND, Plane

RAISED = 0.005  # [m] ground this much higher than its surroundings is raised
_NARROW = 0.20  # [m] maximum width of narrow tops, such as pillars and stones
_SAME_HEIGHT = 1e-6  # [m] tolerance for a point on the top of a box
_EDGE_JUMP = 0.02  # [m] minimum height difference at the edge of a supporting surface
_EDGE_STEP, _DIRECTIONS = 0.001, 64  # [m] radial step of the search for edges, and its number of directions


class Ground(Protocol):
    """The true terrain."""

    def height_at(self, xy: Array) -> Array:
        """True height (n,) [m] at (n, 2) [m] {world of the simulator}."""
        ...


class Course:
    """The true ground, built as the simulator builds it, and where {start} lies on it."""

    def __init__(self, scenario: Scenario, seed: int, terrain: Ground | None = None):
        """Build the ground.

        Args:
            scenario: The scenario with the terrain.
            seed: Seed of the run; the terrain generator is `default_rng([seed, 0])`, as in the simulator.
            terrain: The ground, in place of the scenario's.
        """
        from sextant.services.simulator.physics.terrain import (
            build_terrain,  # imported here because a robot has no simulator
        )

        self.terrain: Ground = build_terrain(scenario, np.random.default_rng([seed, 0])) if terrain is None else terrain
        unblocked = tuple(part for part in scenario.terrain if not isinstance(part, ON_GROUND))
        bare = replace(scenario, terrain=unblocked or (Plane(),))
        self._unblocked: Ground = build_terrain(bare, np.random.default_rng([seed, 0]))
        self._length = scenario.goal.distance
        self.T_sim_start = self.T_start_sim = np.eye(4)

    def lay(self, T: Array, standing: float) -> None:
        """Place {start} under a body pose (4, 4) in the simulator's world.

        Its height is that of the ground, or `standing` [m] where there is no ground. That is the height of the surface under
        the feet.
        """
        ground = float(self.terrain.height_at(T[None, :2, 3])[0])
        level = ground if np.isfinite(ground) else standing
        self.T_sim_start = transform(rotation_z(yaw_of(T)), np.array([T[0, 3], T[1, 3], level]))
        self.T_start_sim = inverse(self.T_sim_start)

    def around(self, margin: float) -> tuple[float, float, float, float]:
        """Return min x, max x, min y, max y [m] {start} of the course plus a margin [m]."""
        return -margin, self._length + margin, -margin, margin

    def height_at(self, xy: Array) -> Array:
        """Return the true height (n,) [m] {start} at (n, 2) [m] {start}."""
        return np.asarray(self.terrain.height_at(self._in_sim(xy)) - self.T_sim_start[2, 3])

    def sink_at(self, xy: Array) -> Array:
        """Return by how much (n,) [m] the ground at (n, 2) [m] {start} yields under load."""
        sink_at = getattr(self.terrain, "sink_at", None)
        return np.zeros(len(xy)) if sink_at is None else np.asarray(sink_at(self._in_sim(xy)))

    def carrying_at(self, xy: Array) -> Array:
        """Return the height (n,) [m] {start} of the supporting surface at (n, 2) [m].

        It is below the visible surface where that yields.
        """
        return self.height_at(xy) - self.sink_at(xy)

    def on_blocks(self, xy: Array) -> int:
        """Return how many points (n, 2) [m] {start} lie on blocks and similar parts.

        These are higher than the ground would be without them.
        """
        sim = self._in_sim(xy)
        without = np.maximum(self._unblocked.height_at(sim), self.T_sim_start[2, 3])
        return int((self.terrain.height_at(sim) > without + RAISED).sum())

    def edge_distance(self, xy: Array) -> Array:
        """Return the distance (n,) [m] from points (n, 2) [m] {start} to the nearest edge.

        Only points on narrow tops have a distance; others are NaN. Adjacent tops of the same height count as one.
        """
        places = self._in_sim(xy)
        found = np.full(len(xy), np.nan)
        on = self._on_narrow_tops(places)
        angle = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
        radii = np.arange(_EDGE_STEP, _NARROW, _EDGE_STEP)
        ring = radii[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        for k in np.flatnonzero(on):
            around = self.terrain.height_at((places[k] + ring).reshape(-1, 2)).reshape(ring.shape[:2])
            level = float(self.terrain.height_at(places[k, None])[0])
            over = (np.abs(around - level) > _EDGE_JUMP).any(axis=1)
            found[k] = radii[np.argmax(over)] - _EDGE_STEP / 2 if over.any() else _NARROW
        return found

    def _on_narrow_tops(self, places: Array) -> NDArray[np.bool_]:
        """Return which points (n, 2) [m] in the simulator's world lie on narrow tops."""
        on = np.zeros(len(places), dtype=bool)
        boxes, height = getattr(self.terrain, "boxes", None), self.terrain.height_at(places)
        if boxes is None:
            return on
        for centre, half, R in zip(boxes.centre, boxes.half, boxes.R, strict=True):
            within = (np.abs((places - centre[:2]) @ R[:2, :2]) <= half[:2]).all(axis=1)
            top = np.abs(height - centre[2] - half[2]) < _SAME_HEIGHT
            on |= within & top & (2 * half[:2].min() <= _NARROW)
        return on

    def block_corners(self) -> Array:
        """Return the corners (b, 4, 2) [m] {start} of the tops of the terrain's boxes."""
        boxes = getattr(self.terrain, "boxes", None)
        if boxes is None or not len(boxes):
            return np.zeros((0, 4, 2))
        corners = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]) * boxes.half[:, None]
        top = np.einsum("bij,bkj->bki", boxes.R, corners) + boxes.centre[:, None]
        return apply(self.T_start_sim, top)[..., :2]

    def weak_blocks(self) -> NDArray[np.intp]:
        """Return the indices of the boxes that yield under a foot."""
        weak = getattr(self.terrain, "weak", None)
        return np.zeros(0, dtype=np.intp) if weak is None else np.asarray(weak.box)

    def loose_tops(self) -> tuple[Array, Array, Array]:
        """Return centre (n, 3) [m] {start}, half edges (n, 3) [m] and rotation (n, 3, 3) of boxes that sink or tip.

        They are where they were at the start.
        """
        kinds = [getattr(self.terrain, name, None) for name in ("weak", "tipping")]
        box = np.concatenate([np.zeros(0, dtype=np.intp), *(kind.box for kind in kinds if kind is not None)])
        boxes, T = getattr(self.terrain, "boxes", None), self.T_start_sim
        if boxes is None or not len(box):
            return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3))
        return apply(T, boxes.centre[box]), boxes.half[box], T[:3, :3] @ boxes.R[box]

    def views(self, poses: Iterable[Array], camera: Camera) -> Iterator[tuple[NDArray[np.float32], Array]] | None:
        """Render undisturbed depth frames at camera poses (4, 4) in the simulator's world.

        Return depth frames (h, w) [m] with their poses in {start}, or None where the terrain cannot be rendered.
        """
        from sextant.services.simulator.physics.terrain import Terrain  # imported here for the same reason

        if not isinstance(self.terrain, Terrain):
            return None
        from sextant.services.simulator.sensors.renderer import Renderer

        renderer = Renderer(self.terrain, camera.intrinsics)
        return ((renderer.depth(T), self.T_start_sim @ T) for T in poses)

    def _in_sim(self, xy: Array) -> Array:
        T = self.T_sim_start
        return np.asarray((T[:2, :2] @ xy.T).T + T[:2, 3])  # for many points ten times as fast as xy @ T[:2, :2].T
