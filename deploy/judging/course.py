"""The true ground of a run's course, in its frame {start}.

{start} lies on the true ground under the robot's starting place, x along its starting direction, z up. It is what the services
call {world}, as the truth has it: where the robot stands before its first step, it is laid so that place and heading of the
truth are those of the estimate, so errors count from there; its height is never taken from an estimate.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, apply, inverse, rotation_z, transform, yaw_of
from sextant.shared.robot.profile import Camera
from sextant.shared.scenario.scenario import Box, Hole, PillarField, Pillars, Plane, Puddle, Puddles, Rubble, Scenario

RAISED = 0.005  # [m] over the ground beside: on something
_NARROW = 0.20  # [m] and less is the width of pillars, stones and the like
_SAME_HEIGHT = 1e-6  # [m] of a place and the box that it lies on
_EDGE_JUMP = 0.02  # [m] in height, and more, is an edge of what carries a foot,
_EDGE_STEP, _DIRECTIONS = 0.001, 64  # [m] looked for in such steps outward, in so many directions
_IN_THE_WAY = (
    Box,
    Hole,
    Rubble,
    Pillars,
    PillarField,
    Puddle,
    Puddles,
)  # without which the ground is what blocks are raised over


class Ground(Protocol):
    """The true terrain."""

    def height_at(self, xy: Array) -> Array:
        """True height (n,) [m] at (n, 2) [m] {world of the simulator}."""
        ...


class Course:
    """The true ground, built as the simulator builds it, and where {start} lies on it."""

    def __init__(self, scenario: Scenario, seed: int, terrain: Ground | None = None):
        """Build it.

        Args:
            scenario: Whose terrain.
            seed: The run's; the terrain's generator is `default_rng([seed, 0])`, as the simulator's.
            terrain: The ground, in place of the scenario's.
        """
        from sextant.services.simulator.physics.terrain import (
            build_terrain,  # a robot without the simulator can import this module
        )

        self.terrain: Ground = build_terrain(scenario, np.random.default_rng([seed, 0])) if terrain is None else terrain
        unblocked = tuple(part for part in scenario.terrain if not isinstance(part, _IN_THE_WAY))
        bare = replace(scenario, terrain=unblocked or (Plane(),))
        self._unblocked: Ground = build_terrain(bare, np.random.default_rng([seed, 0]))
        self._length = scenario.goal.distance
        self.T_sim_start = self.T_start_sim = np.eye(4)

    def lay(self, T: Array, standing: float) -> None:
        """Lay {start} under a pose (4, 4) of the body in the simulator's world.

        Over an abyss, what the feet stand on [m] is its height.
        """
        ground = float(self.terrain.height_at(T[None, :2, 3])[0])
        level = ground if np.isfinite(ground) else standing
        self.T_sim_start = transform(rotation_z(yaw_of(T)), np.array([T[0, 3], T[1, 3], level]))
        self.T_start_sim = inverse(self.T_sim_start)

    def around(self, margin: float) -> tuple[float, float, float, float]:
        """Lowest and highest x, then y [m] {start}, of the course with a margin [m]."""
        return -margin, self._length + margin, -margin, margin

    def height_at(self, xy: Array) -> Array:
        """True height (n,) [m] {start} at (n, 2) [m] {start}."""
        return np.asarray(self.terrain.height_at(self._in_sim(xy)) - self.T_sim_start[2, 3])

    def sink_at(self, xy: Array) -> Array:
        """How far (n,) [m] the ground at (n, 2) [m] {start} gives way."""
        sink_at = getattr(self.terrain, "sink_at", None)
        return np.zeros(len(xy)) if sink_at is None else np.asarray(sink_at(self._in_sim(xy)))

    def carrying_at(self, xy: Array) -> Array:
        """Height (n,) [m] {start} of what carries at (n, 2) [m] {start}: below what is seen where that gives way."""
        return self.height_at(xy) - self.sink_at(xy)

    def on_blocks(self, xy: Array) -> int:
        """How many of the places (n, 2) [m] {start} lie on blocks and the like, over the ground as it were without them."""
        sim = self._in_sim(xy)
        without = np.maximum(self._unblocked.height_at(sim), self.T_sim_start[2, 3])
        return int((self.terrain.height_at(sim) > without + RAISED).sum())

    def edge_distance(self, xy: Array) -> Array:
        """Distance (n,) [m] from places (n, 2) [m] {start} to the nearest edge of the narrow top there, NaN without one.

        Tops that touch at one height are one.
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
        """Whether places (n, 2) [m] of the simulator's world lie on tops of pillars, stones and the like."""
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
        """Corners (b, 4, 2) [m] {start} of the tops of the terrain's boxes."""
        boxes = getattr(self.terrain, "boxes", None)
        if boxes is None or not len(boxes):
            return np.zeros((0, 4, 2))
        corners = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]) * boxes.half[:, None]
        top = np.einsum("bij,bkj->bki", boxes.R, corners) + boxes.centre[:, None]
        return apply(self.T_start_sim, top)[..., :2]

    def weak_blocks(self) -> NDArray[np.intp]:
        """Which of them give way under a foot."""
        weak = getattr(self.terrain, "weak", None)
        return np.zeros(0, dtype=np.intp) if weak is None else np.asarray(weak.box)

    def views(self, poses: Iterable[Array], camera: Camera) -> Iterator[tuple[NDArray[np.float32], Array]] | None:
        """What an undisturbed camera at poses (4, 4) of the simulator's world sees: depths (h, w) [m], and poses in {start}.

        None where the ground is none that can be drawn.
        """
        from sextant.services.simulator.physics.terrain import Terrain  # as above

        if not isinstance(self.terrain, Terrain):
            return None
        from sextant.services.simulator.sensors.renderer import Renderer

        renderer = Renderer(self.terrain, camera.intrinsics)
        return ((renderer.depth(T), self.T_start_sim @ T) for T in poses)

    def _in_sim(self, xy: Array) -> Array:
        T = self.T_sim_start
        return xy @ T[:2, :2].T + T[:2, 3]
