"""Traversability: cost of 5 cm cells around the robot, and cells that stop it.

A bad cell is no obstacle: feet find another place within 6 cm, and the body passes over the cell. Three kinds of ground stop
the robot: height changes larger than its legs can take, bare ground that is wider than feet can step across, and ground that
was looked at but stays unseen (holes). Ground that was never looked at is expensive but open: the robot sees it when it
comes nearer, and no foot is placed on it before. There is no limit of the slope here: steep ground carries no foot by its score
in the mapper (`sextant.services.mapper.footholds`), and is therefore bare.

A hole is no wall: the body may extend over a hole, and feet next to it may stand closer together.

Seen ground is kept while the map moves on, so that a robot that turns back does not take a path that it knows to be closed.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.navigation.downsampled_map import (
    Mask,
    closed,
    distance,
    downsample,
    lowest_around,
    mean_around,
    over_square,
    wide,
)
from sextant.services.planner.navigation.params import CostmapParams
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, inverse
from sextant.shared.robot.profile import Camera

_CELLS = 128  # cells of the kept window, along each axis

OPEN, STEP, BARE, HOLE, STUCK, FAR = range(6)  # what stops the robot at a cell
_OBSTACLES = (
    "",
    "a step of more than {step_cm:.3g} cm",
    "no foothold",
    "a hole, or ground without measurements",
    "a place where the robot got stuck",
    "the maximum detour from the straight line",
)


@dataclass(frozen=True, slots=True)
class RequiredSpace:
    """Space that the robot needs."""

    half_width: float  # [m] from its centre to its feet: the distance to keep from obstacles
    beside_hole: float  # [m] from its centre: the distance to keep from a hole
    wide: float  # [m] preferred distance from both


@dataclass(frozen=True, slots=True, eq=False)
class CostMap:
    """Traversability map for the robot's centre.

    Cell (i, j) spans edge * (first + (i, j)) to edge * (first + (i, j) + 1) [m] {world}.
    """

    first: NDArray[np.int64]  # (2,)
    edge: float  # [m]
    cost: Array  # (n, m) per metre, 1 or more; inf where the robot must not be
    room: Array  # (n, m) [m] to the impassable cell that leaves the least room; at most the preferred distance
    needs: Array  # (n, m) [m] required distance from that cell
    stops: NDArray[np.int8]  # (n, m) obstacle kind, OPEN where the ground is passable
    unseen: Mask  # (n, m)
    veiled: Array  # (n, m) [1] share of unseen ground under a robot at the cell
    max_step_m: float = CostmapParams().max_step_m  # [m] from which a height difference stops the robot

    def obstacle_name(self, kind: int) -> str:
        """Return an obstacle kind of `stops` as text."""
        return _OBSTACLES[kind].format(step_cm=100.0 * self.max_step_m)

    def cell(self, xy: Array) -> tuple[int, int]:
        """Return the cell of a place (2,) [m] {world}, clipped to the map."""
        i, j = np.clip(np.floor(xy / self.edge).astype(np.int64) - self.first, 0, np.array(self.cost.shape) - 1)
        return int(i), int(j)

    def centres(self, cells: NDArray[np.int64]) -> Array:
        """Return the centres (k, 2) [m] {world} of cells (k, 2)."""
        return np.asarray((cells + self.first + 0.5) * self.edge)

    def holds(self, xy: Array) -> bool:
        """Return whether a place (2,) [m] {world} lies in the map."""
        ij = np.floor(xy / self.edge).astype(np.int64) - self.first
        return bool(((ij >= 0) & (ij < self.cost.shape)).all())

    def at(self, layer: NDArray[Any], xy: Array) -> NDArray[Any]:
        """Return a layer (k,) at places (k, 2) [m] {world}, clipped to the map."""
        ij = np.clip(np.floor(xy / self.edge).astype(np.int64) - self.first, 0, np.array(self.cost.shape) - 1)
        return np.asarray(layer[ij[:, 0], ij[:, 1]])

    def beside(self, start: Array, end: Array, most: float) -> "CostMap":
        """Return the map, closed beyond a distance [m] from a straight line.

        `start` and `end` (2,) [m] {world} are the ends of the line.
        """
        cells = np.indices(self.cost.shape).reshape(2, -1).T
        way = end - start
        off = self.centres(cells) - start
        s = np.clip(off @ way / max(float(way @ way), 1e-9), 0.0, 1.0)
        far = (np.linalg.norm(off - s[:, None] * way, axis=1) > most).reshape(self.cost.shape)
        stops = np.where(far & (self.stops == OPEN), FAR, self.stops).astype(np.int8)
        return replace(self, cost=np.where(far, np.inf, self.cost), stops=stops)


class LocalGroundMap:
    """Ground around the robot from all maps, kept while it is within 64 cells."""

    def __init__(self, params: CostmapParams, complete: bool = False):
        """Start without ground.

        Args:
            params: Parameters of the traversability map.
            complete: Whether the maps show all ground that there is: what they leave out counts as a hole.
        """
        self._params, self._complete = params, complete
        self._first: NDArray[np.int64] = np.zeros(2, dtype=np.int64)
        self._edge = params.cell_m
        self._layers = _nothing()

    def add_map(self, terrain: Terrain, T_world_body: Array, camera: Camera, floor: float) -> None:
        """Add a map.

        Args:
            terrain: The newest map.
            T_world_body: (4, 4) body pose at the scan.
            camera: The camera of the scan.
            floor: [m] {world} ground height under the robot.
        """
        block = max(1, round(self._params.cell_m / terrain.map.resolution))
        edge = block * terrain.map.resolution
        if edge != self._edge:
            self._edge = edge
            self._layers = _nothing()
        self._move_to(T_world_body[:2, 3])
        found = downsample(terrain, block)
        offset = found.first - self._first
        low = np.maximum(offset, 0)
        high = np.minimum(offset + found.layers["known"].shape, _CELLS)
        if (low >= high).any():
            return  # the map does not overlap the window
        here = np.s_[low[0] : high[0], low[1] : high[1]]
        there = np.s_[low[0] - offset[0] : high[0] - offset[0], low[1] - offset[1] : high[1] - offset[1]]
        anew = found.layers["known"][there] > 0
        for name, layer in found.layers.items():
            self._layers[name][here][anew] = layer[there][anew]
        # The robot steps over narrow low ground.
        mind = self._layers
        floor_beside = closed(mind["low"], self._params.bridged_cells)
        mind["rise"] = mind["high"] - lowest_around(floor_beside)
        mind["fall"] = -lowest_around(-mind["high"]) - floor_beside
        if self._complete:
            mind["looks"][mind["known"] < self._params.seen_share] = self._params.hole_looks
        else:
            self._look(T_world_body @ camera.T_body_camera, camera, floor, low, high)

    def cost_map(self, size: RequiredSpace, place: Array, stuck: Array, stuck_radius: float) -> CostMap:
        """Return the traversability map.

        Args:
            size: Space that the robot needs.
            place: (3,) [m, m, rad] {world} robot pose. Unseen ground next to it cannot be looked at, ground behind it only
                after a turn.
            stuck: (k, 2) [m] {world} places without progress.
            stuck_radius: [m] around them.
        """
        params, seen = self._params, self._layers
        unseen = seen["known"] < params.seen_share
        stops = np.zeros(unseen.shape, dtype=np.int8)
        # 1. Ground that rises or falls by more than legs can take: its upper edge.
        rise = seen["rise"]
        stops[rise > params.max_step_m] = STEP
        # 2. Ground without a foothold in reach, and holes, unless feet can step across.
        stops[wide(~unseen & (seen["bare"] > params.bare_share), params.bare_width_cells) & (stops == OPEN)] = BARE
        stops[wide(unseen & (seen["looks"] >= params.hole_looks), params.bare_width_cells) & (stops == OPEN)] = HOLE
        centres = (np.indices(unseen.shape).transpose(1, 2, 0) + self._first + 0.5) * self._edge
        for shut in stuck:
            stops[(np.linalg.norm(centres - shut, axis=2) < stuck_radius) & (stops == OPEN)] = STUCK
        room, needs = self._room(stops, size)
        # 3. Positions of the body: cost of the ground under its feet, and higher cost near obstacles.
        off = centres - place[:2]
        near = np.linalg.norm(off, axis=2) < params.blind_radius_m
        aside = np.abs((np.arctan2(off[..., 1], off[..., 0]) - place[2] + np.pi) % (2.0 * np.pi) - np.pi) / np.pi
        relief = np.clip(np.nan_to_num(rise) / params.max_step_m, 0.0, 1.0)
        ground_price = np.where(
            unseen,
            np.where(near, params.beside_cost, params.unseen_cost + params.behind_cost * aside),
            params.rough_cost * (1.0 - seen["footing"]) + params.bare_cost * seen["bare"] + params.relief_cost * relief**2,
        )
        beyond = np.maximum((size.wide - room) / max(size.wide - size.half_width, 1e-9), 0.0)
        under = round(size.half_width / self._edge)
        cost = 1.0 + mean_around(ground_price, under) + params.near_cost * beyond**2
        cost[room < needs] = np.inf
        veiled = mean_around(unseen.astype(np.float64), under)
        return CostMap(self._first.copy(), self._edge, cost, room, needs, stops, unseen, veiled, params.max_step_m)

    def _room(self, stops: NDArray[np.int8], size: RequiredSpace) -> tuple[Array, Array]:
        """Return distances (n, m) [m] to obstacles and the required distances (n, m) [m].

        Of all obstacles, the one that leaves the least room counts. A step in the ground is a wall for a robot below it, which
        keeps away from its upper edge. It is a hole for a robot above it, which keeps away from its lower edge.
        """
        seen, max_step_m = self._layers, self._params.max_step_m
        reach = int(np.ceil(size.half_width / self._edge))
        tops = over_square(np.where(stops == STEP, seen["high"], -np.inf), reach, reach, np.maximum, -np.inf)
        below = tops > np.nan_to_num(seen["low"], nan=-np.inf) + max_step_m
        kinds = (
            (stops == STUCK, size.half_width),
            (stops == STEP, np.where(below, size.half_width, 0.0)),
            ((stops == BARE) | (stops == HOLE) | (seen["fall"] > max_step_m), size.beside_hole),
        )
        rooms = np.stack([distance(mask, size.wide / self._edge) * self._edge for mask, _ in kinds])
        needs = np.stack([np.broadcast_to(need, stops.shape) for _, need in kinds])
        least = np.argmin(rooms - needs, axis=0)[None]
        return np.take_along_axis(rooms, least, axis=0)[0], np.take_along_axis(needs, least, axis=0)[0]

    def _move_to(self, xy: Array) -> None:
        """Recentre the window on the robot once it is a quarter of the window off centre.

        Ground that leaves the window is forgotten.
        """
        middle = np.floor(xy / self._edge).astype(np.int64)
        off = middle - (self._first + _CELLS // 2)
        if (np.abs(off) < _CELLS // 4).all():
            return
        first = middle - _CELLS // 2
        by = first - self._first
        kept, self._layers, self._first = self._layers, _nothing(), first
        low, high = np.maximum(by, 0), np.minimum(by + _CELLS, _CELLS)
        if (low < high).all():
            old = np.s_[low[0] : high[0], low[1] : high[1]]
            new = np.s_[low[0] - by[0] : high[0] - by[0], low[1] - by[1] : high[1] - by[1]]
            for name, layer in self._layers.items():
                layer[new] = kept[name][old]

    def _look(
        self, T_world_camera: Array, camera: Camera, floor: float, low: NDArray[np.int64], high: NDArray[np.int64]
    ) -> None:
        """Count a look for each unseen map cell that the camera should have seen.

        A cell should have been seen if it is in view and not hidden, for ground at the height of the robot's floor. `low` and
        `high` bound the cells of the map.
        """
        params = self._params
        cells = np.argwhere(self._layers["known"] < params.seen_share)
        cells = cells[((cells >= low) & (cells < high)).all(axis=1)]
        places = np.column_stack([(cells + self._first + 0.5) * self._edge, np.full(len(cells), floor)])
        eye = T_world_camera[:3, 3]
        reach = np.linalg.norm(places[:, :2] - eye[:2], axis=1) < params.view_far_m
        cells, places = cells[reach], places[reach]
        x, y, z = apply(inverse(T_world_camera), places).T
        lens = camera.intrinsics
        ahead = z > params.view_near_ratio * camera.sensor.min_range
        z = np.where(ahead, z, 1.0)
        across = np.abs(lens.fx * x / z + lens.cx - lens.width / 2) < params.view_frame_share * lens.width / 2
        upright = np.abs(lens.fy * y / z + lens.cy - lens.height / 2) < params.view_frame_share * lens.height / 2
        shown = ahead & across & upright
        cells, places = cells[shown], places[shown]
        s = np.linspace(0.1, 0.92, 24)[:, None, None]
        line = eye + s * (places - eye)
        i, j = np.moveaxis(np.clip(np.floor(line[..., :2] / self._edge).astype(np.int64) - self._first, 0, _CELLS - 1), -1, 0)
        tops = self._layers["high"]
        top = over_square(np.where(np.isnan(tops), -np.inf, tops), 1, 1, np.maximum, -np.inf)
        shown = ~(top[i, j] > line[..., 2] - params.shadow_m).any(axis=0)
        self._layers["looks"][tuple(cells[shown].T)] += 1


def _nothing() -> dict[str, Array]:
    """Return layers of ground that was never seen."""
    blank = {
        "known": 0.0,  # [1] share of known cells
        "footing": 0.0,  # [1] share of cells that carry a foot
        "bare": 0.0,  # [1] share of the known cells without a foothold in reach
        "high": np.nan,  # [m] {world}
        "low": np.nan,  # [m] {world}
        "looks": 0.0,  # number of looks without a measurement
        "rise": 0.0,  # [m] above the lowest ground around
        "fall": 0.0,  # [m] below the highest ground around
    }
    return {name: np.full((_CELLS, _CELLS), value) for name, value in blank.items()}
