"""What the robot can cross, in cells of 5 cm around it: what a walk over each costs, and where there is none.

A bad cell is no obstacle: feet find another place within 6 cm, and the body passes over. What stops a robot is ground that
changes by more than its legs can take, ground without a foothold over more than feet can step across, and ground that was
looked at and not there. Ground never seen is dear but open: who comes nearer sees it, and no foot is set on it before.

A hole is not a wall: the body may reach out over a hole, and feet beside it may stand closer together.

What was seen is kept while the map moves on, so that a robot that turns back does not take the way it knows to be closed.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.navigation.downsampled_map import (
    Mask,
    closed,
    coarse,
    distance,
    lowest_around,
    mean_around,
    over_square,
    wide,
)
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, apply, inverse
from sextant.shared.robot.profile import Camera

EDGE = 0.05  # [m] of a cell
_CELLS = 128  # of the window that is kept, either way
MAX_STEP = 0.065  # [m] between the ground of neighbouring cells that legs can take
_SEEN = 0.25  # [1] share of a cell that must be known
_BARE = 0.8  # [1] share of a cell out of reach of every foothold, from which it is bare, and
_NARROW = 2  # cells that bare ground must be wide to stop feet, and
_BRIDGED = 5  # cells of low ground up to which it may be narrow, and stepped over
_LOOKS = 3  # at a place that showed nothing, from which it is a hole
_NEAREST, _FURTHEST = 1.15, 1.10  # of the camera's least range, and [m]: where what is there shows
_FRAME = 0.84  # [1] share of the picture's width and height in which it does
_SHADOW = 0.01  # [m] under the top of what stands before it, a place is hidden
BESIDE = 0.55  # [m] from the body, within which the camera sees nothing wherever it looks

OPEN, STEP, BARE, HOLE, STUCK, FAR = range(6)  # what stops a robot at a cell
WORDS = (
    "",
    f"a step of more than {int(MAX_STEP * 100)} cm",
    "no foothold",
    "a hole, or ground that does not show",
    "where it got stuck",
    "too far off the straight way",
)


@dataclass(frozen=True, slots=True)
class Prices:
    """What a metre costs beyond the metre."""

    rough: float = 1.5  # where no cell carries a foot, of a footprint; less where some do
    bare: float = 6.0  # where no foothold is in reach
    relief: float = 2.0  # where the ground changes by as much as legs can take
    near: float = 3.0  # `half_width` from what cannot be crossed, falling to nothing at `wide`
    unseen: float = 1.0
    behind: float = 2.0  # beyond that, unseen right behind the robot; less where it need not turn about to look at it
    beside: float = 40.0  # unseen and so near that it cannot be looked at


@dataclass(frozen=True, slots=True)
class Size:
    """How much room the robot takes."""

    half_width: float  # [m] from its middle to its feet, by which it must keep away from what stands in its way
    beside_hole: float  # [m] from its middle, by which it must keep away from a hole
    wide: float  # [m] by which it would like to keep away from both


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """Where the robot's middle may go. Cell (i, j) spans edge * (first + (i, j)) and one edge more, either way, [m] {world}."""

    first: NDArray[np.int64]  # (2,)
    edge: float  # [m]
    cost: Array  # (n, m) of a metre, 1 and more; inf where it may not be
    room: (
        Array  # (n, m) [m] to the cell that leaves the robot least, of those that cannot be crossed; at most what it would like
    )
    needs: Array  # (n, m) [m] by which the robot must keep away from that cell
    stops: NDArray[np.int8]  # (n, m) what cannot be crossed there, OPEN where the ground can
    unseen: Mask  # (n, m)
    veiled: Array  # (n, m) [1] share of the ground under a robot there that is unseen

    def cell(self, xy: Array) -> tuple[int, int]:
        """The cell that holds a place (2,) [m] {world}, the nearest one if it lies outside."""
        i, j = np.clip(np.floor(xy / self.edge).astype(np.int64) - self.first, 0, np.array(self.cost.shape) - 1)
        return int(i), int(j)

    def centres(self, cells: NDArray[np.int64]) -> Array:
        """Centres (k, 2) [m] {world} of cells (k, 2)."""
        return np.asarray((cells + self.first + 0.5) * self.edge)

    def holds(self, xy: Array) -> bool:
        """Whether a place (2,) [m] {world} lies in it."""
        ij = np.floor(xy / self.edge).astype(np.int64) - self.first
        return bool(((ij >= 0) & (ij < self.cost.shape)).all())

    def at(self, layer: NDArray[Any], xy: Array) -> NDArray[Any]:
        """A layer (k,) at places (k, 2) [m] {world}, of the nearest cell where they lie outside."""
        ij = np.clip(np.floor(xy / self.edge).astype(np.int64) - self.first, 0, np.array(self.cost.shape) - 1)
        return np.asarray(layer[ij[:, 0], ij[:, 1]])

    def beside(self, start: Array, end: Array, most: float) -> "Crossing":
        """The same, closed further than so much [m] from the straight way between two places (2,) [m] {world}."""
        cells = np.indices(self.cost.shape).reshape(2, -1).T
        way = end - start
        off = self.centres(cells) - start
        s = np.clip(off @ way / max(float(way @ way), 1e-9), 0.0, 1.0)
        far = (np.linalg.norm(off - s[:, None] * way, axis=1) > most).reshape(self.cost.shape)
        stops = np.where(far & (self.stops == OPEN), FAR, self.stops).astype(np.int8)
        return replace(self, cost=np.where(far, np.inf, self.cost), stops=stops)


class SeenGround:
    """The ground around the robot as the maps have shown it, kept while it stays within 3.2 m."""

    def __init__(self) -> None:
        """Begin with nothing seen."""
        self._first: NDArray[np.int64] = np.zeros(2, dtype=np.int64)
        self._edge = EDGE
        self._layers = _nothing()

    def see(self, terrain: Terrain, T_world_body: Array, camera: Camera, floor: float) -> None:
        """Take in a map.

        Args:
            terrain: The newest map.
            T_world_body: (4, 4) the body as it looked.
            camera: What it looked with.
            floor: [m] {world} of the ground under the robot.
        """
        block = max(1, round(EDGE / terrain.map.resolution))
        edge = block * terrain.map.resolution
        if edge != self._edge:
            self._edge = edge
            self._layers = _nothing()
        self._move_to(T_world_body[:2, 3])
        found = coarse(terrain, block)
        offset = found.first - self._first
        low = np.maximum(offset, 0)
        high = np.minimum(offset + found.layers["known"].shape, _CELLS)
        if (low >= high).any():
            return  # a map of elsewhere
        here = np.s_[low[0] : high[0], low[1] : high[1]]
        there = np.s_[low[0] - offset[0] : high[0] - offset[0], low[1] - offset[1] : high[1] - offset[1]]
        anew = found.layers["known"][there] > 0
        for name, layer in found.layers.items():
            self._layers[name][here][anew] = layer[there][anew]
        # Narrow low ground is stepped over.
        mind = self._layers
        floor_beside = closed(mind["low"], _BRIDGED)
        mind["rise"] = mind["high"] - lowest_around(floor_beside)
        mind["fall"] = -lowest_around(-mind["high"]) - floor_beside
        self._look(T_world_body @ camera.T_body_camera, camera, floor, low, high)

    def crossing(self, size: Size, prices: Prices, place: Array, stuck: Array, stuck_radius: float) -> Crossing:
        """What it costs to cross, and where one cannot.

        Args:
            size: Of the robot.
            prices: Of what is dear.
            place: (3,) [m, m, rad] {world} of the robot: unseen ground beside it cannot be looked at, behind it not soon.
            stuck: (k, 2) [m] {world} where it could not go on.
            stuck_radius: [m] around them.
        """
        seen = self._layers
        unseen = seen["known"] < _SEEN
        stops = np.zeros(unseen.shape, dtype=np.int8)
        # 1. Ground that rises or falls by more than legs can take: its upper edge.
        rise = seen["rise"]
        stops[rise > MAX_STEP] = STEP
        # 2. Ground without a foothold in reach, and ground that does not show, unless feet can step across.
        stops[wide(~unseen & (seen["bare"] > _BARE), _NARROW) & (stops == OPEN)] = BARE
        stops[wide(unseen & (seen["looks"] >= _LOOKS), _NARROW) & (stops == OPEN)] = HOLE
        centres = (np.indices(unseen.shape).transpose(1, 2, 0) + self._first + 0.5) * self._edge
        for shut in stuck:
            stops[(np.linalg.norm(centres - shut, axis=2) < stuck_radius) & (stops == OPEN)] = STUCK
        room, needs = self._room(stops, size)
        # 3. Where the body may be: prices over the ground that its feet stand on, and more where there is little room.
        off = centres - place[:2]
        near = np.linalg.norm(off, axis=2) < BESIDE
        aside = np.abs((np.arctan2(off[..., 1], off[..., 0]) - place[2] + np.pi) % (2.0 * np.pi) - np.pi) / np.pi
        relief = np.clip(np.nan_to_num(rise) / MAX_STEP, 0.0, 1.0)
        ground_price = np.where(
            unseen,
            np.where(near, prices.beside, prices.unseen + prices.behind * aside),
            prices.rough * (1.0 - seen["footing"]) + prices.bare * seen["bare"] + prices.relief * relief**2,
        )
        beyond = np.maximum((size.wide - room) / max(size.wide - size.half_width, 1e-9), 0.0)
        under = round(size.half_width / self._edge)
        cost = 1.0 + mean_around(ground_price, under) + prices.near * beyond**2
        cost[room < needs] = np.inf
        veiled = mean_around(unseen.astype(np.float64), under)
        return Crossing(self._first.copy(), self._edge, cost, room, needs, stops, unseen, veiled)

    def _room(self, stops: NDArray[np.int8], size: Size) -> tuple[Array, Array]:
        """Distances (n, m) [m] to what stops the robot, and which (n, m) [m] it needs: of all, those that leave least.

        A step is a wall to a robot below it, which keeps away from its upper edge, and a hole to one above, from its lower.
        """
        seen, reach = self._layers, int(np.ceil(size.half_width / self._edge))
        tops = over_square(np.where(stops == STEP, seen["high"], -np.inf), reach, reach, np.maximum, -np.inf)
        below = tops > np.nan_to_num(seen["low"], nan=-np.inf) + MAX_STEP
        kinds = (
            (stops == STUCK, size.half_width),
            (stops == STEP, np.where(below, size.half_width, 0.0)),
            ((stops == BARE) | (stops == HOLE) | (seen["fall"] > MAX_STEP), size.beside_hole),
        )
        rooms = np.stack([distance(mask, size.wide / self._edge) * self._edge for mask, _ in kinds])
        needs = np.stack([np.broadcast_to(need, stops.shape) for _, need in kinds])
        least = np.argmin(rooms - needs, axis=0)[None]
        return np.take_along_axis(rooms, least, axis=0)[0], np.take_along_axis(needs, least, axis=0)[0]

    def _move_to(self, xy: Array) -> None:
        """Bring the window's middle to where the robot is, a quarter at a time; what it leaves is forgotten."""
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
        """Count the look at cells of the map, from low to high, that would show if there were ground as high as the robot's."""
        cells = np.argwhere(self._layers["known"] < _SEEN)
        cells = cells[((cells >= low) & (cells < high)).all(axis=1)]
        places = np.column_stack([(cells + self._first + 0.5) * self._edge, np.full(len(cells), floor)])
        eye = T_world_camera[:3, 3]
        reach = np.linalg.norm(places[:, :2] - eye[:2], axis=1) < _FURTHEST
        cells, places = cells[reach], places[reach]
        x, y, z = apply(inverse(T_world_camera), places).T
        lens = camera.intrinsics
        ahead = z > _NEAREST * camera.sensor.min_range
        z = np.where(ahead, z, 1.0)
        across = np.abs(lens.fx * x / z + lens.cx - lens.width / 2) < _FRAME * lens.width / 2
        upright = np.abs(lens.fy * y / z + lens.cy - lens.height / 2) < _FRAME * lens.height / 2
        shown = ahead & across & upright
        cells, places = cells[shown], places[shown]
        s = np.linspace(0.1, 0.92, 24)[:, None, None]
        line = eye + s * (places - eye)
        i, j = np.moveaxis(np.clip(np.floor(line[..., :2] / self._edge).astype(np.int64) - self._first, 0, _CELLS - 1), -1, 0)
        tops = self._layers["high"]
        top = over_square(np.where(np.isnan(tops), -np.inf, tops), 1, 1, np.maximum, -np.inf)
        shown = ~(top[i, j] > line[..., 2] - _SHADOW).any(axis=0)
        self._layers["looks"][tuple(cells[shown].T)] += 1


def _nothing() -> dict[str, Array]:
    """Layers of ground never seen."""
    blank = {
        "known": 0.0,  # share of the cell
        "footing": 0.0,  # share of it that carries a foot
        "bare": 0.0,  # share of what is known of it that has no foothold in reach
        "high": np.nan,  # [m] {world}
        "low": np.nan,  # [m] {world}
        "looks": 0.0,  # at the cell, in which nothing showed
        "rise": 0.0,  # [m] over the lowest ground around
        "fall": 0.0,  # [m] under the highest ground around
    }
    return {name: np.full((_CELLS, _CELLS), value) for name, value in blank.items()}
