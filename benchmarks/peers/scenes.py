"""Scenes for measuring registration and maps, generated from a seed.

The seven of `MAPPED` are those of the published budgets for elevation maps (facts on performance: flat, slope, steps, gap,
boxes, rough, mixed). The four of `REGISTERED` differ in the observability of the motion.
"""

from collections.abc import Callable, Mapping

import cv2
import numpy as np

from sextant.services.simulator.physics.solids import Boxes, HeightField
from sextant.services.simulator.physics.terrain import Terrain, build_terrain
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Box, Pillars, Plane, Rubble, Slope, Stairs
from sextant.shared.scenario.terrain import Terrain as Part

Scene = Callable[[np.random.Generator], Terrain]

_WIDTH = 4.0  # [m] width of obstacles across the whole view
_ROUGH_STEP = 0.02  # [m] grid of the rough ground
_ROUGH_WAVE = 0.12  # [m] sigma of the smoothing filter
_ROUGH_HEIGHT = 0.14  # [m] peak to peak


def _built(*parts: Part) -> Scene:
    def build(rng: np.random.Generator) -> Terrain:
        return build_terrain(Scenario("bench", parts, Goal(1.0)), rng)

    return build


def _rough(rng: np.random.Generator) -> Terrain:
    """Generate smooth random ground without edges."""
    shape = round(5.0 / _ROUGH_STEP), round(_WIDTH / _ROUGH_STEP)
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), _ROUGH_WAVE / _ROUGH_STEP)
    heights = (noise - noise.mean()) / np.ptp(noise) * _ROUGH_HEIGHT
    empty = Boxes(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    return Terrain(empty, HeightField(heights, _ROUGH_STEP, (-1.0, -_WIDTH / 2)), None)


_PLATFORMS = (  # a gap of 0.7 m from x = 1 m
    Box((-0.5, 0.0), (3.0, _WIDTH), 0.0),
    Box((3.7, 0.0), (4.0, _WIDTH), 0.0),
    Plane(height=-0.5),
)

MAPPED: Mapping[str, Scene] = {
    "flat": _built(Plane()),
    "slope": _built(Plane(), Slope((0.8, 0.0), 15.0, 4.0, _WIDTH)),
    "steps": _built(Plane(), Stairs((1.0, 0.0), 0.12, 0.45, 6, _WIDTH)),
    "gap": _built(*_PLATFORMS),
    "boxes": _built(Plane(), Rubble((0.7, 3.2), (-0.8, 0.8), 14, (0.15, 0.40), (0.05, 0.20), gap=0.05)),
    "rough": _rough,
    "mixed": _built(
        Plane(),
        Rubble((0.6, 1.4), (-0.7, 0.7), 6, (0.12, 0.30), (0.04, 0.15), gap=0.05),
        Slope((1.6, 0.6), 15.0, 0.8, 1.0),
        Stairs((1.7, -0.6), 0.10, 0.35, 3, 1.0),
    ),
}

REGISTERED: Mapping[str, Scene] = {
    "stairs+pillars": _built(
        Plane(),
        Stairs((1.5, 0.0), 0.10, 0.35, 4, 1.4),
        Pillars(((0.9, 0.35), (1.0, -0.4), (1.4, 0.55), (1.3, -0.6)), 0.10, 0.15),
    ),
    "sparse boxes": _built(Plane(), Rubble((0.7, 3.2), (-0.7, 0.7), 6, (0.10, 0.25), (0.05, 0.12), gap=0.2)),
    "stairs": _built(Plane(), Stairs((1.0, 0.0), 0.10, 0.35, 6, 1.4)),
    "flat": _built(Plane()),
}
