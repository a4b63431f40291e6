"""Terrain: solids of a scenario's primitives, and the true height of the ground.

Level ground is a plane and measured ground is one height field. All other primitives are oriented boxes. Physics, renderer and
scorer use the same arrays.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TypeVar, assert_never

import numpy as np
from numpy.typing import NDArray

from sextant.services.simulator.physics.friction import NO_PATCHES, FrictionPatches, draw_patches
from sextant.services.simulator.physics.height_map import read_height_map
from sextant.services.simulator.physics.relief import build_relief
from sextant.services.simulator.physics.solids import Boxes, HeightField
from sextant.services.simulator.physics.tipping import NONE_TIPPING, Tipping
from sextant.shared.files.config import ConfigError
from sextant.shared.geometry import Array, rotation_from_rpy, rotation_z
from sextant.shared.scenario.counts import MAX_BLOCKS
from sextant.shared.scenario.course import Blocks, Course, Flight, Gap, Level, Ramp, Stones, Stretch
from sextant.shared.scenario.relief import Relief
from sextant.shared.scenario.scenario import Scenario
from sextant.shared.scenario.terrain import (
    Box,
    Color,
    HeightMap,
    Hole,
    Patches,
    PillarField,
    Pillars,
    Plane,
    Puddle,
    Puddles,
    Rubble,
    Slope,
    Stairs,
)
from sextant.shared.scenario.terrain import Terrain as Primitive

DEPTH = 0.5  # [m] extent of rubble and height fields below the ground
_BATCH = 256  # number of rubble candidates per draw
_FEW = 16  # number of candidates of a draw that are tested first
_BATCHES = 40  # draws for one block before all blocks are placed again
_RESTARTS = 20  # maximum number of attempts to place all blocks
_PACKED = 0.75  # area share of blocks that random placement cannot reach
_HOPELESS_RESTARTS, _HOPELESS_SHARE = 3, 0.7  # give up after this number of restarts without this share of the blocks
_MAX_BOXES = 5000  # per terrain, because time and memory of physics and renderer grow with it
Block = TypeVar("Block", Box, Hole)
_FAR = 50.0  # [m] extent along +-x and +-y of level ground with puddles or holes, which is made of boxes


@dataclass(frozen=True, slots=True)
class Hollows:
    """Axis-aligned rectangles that look like level ground, but do not carry a foot.

    A foot sinks through to a bed.
    """

    low: Array  # (n, 2) [m] {world}
    high: Array  # (n, 2) [m] {world}
    depth: Array  # (n,) [m] from the visible surface to the bed
    color: Array  # (n, 3) R, G, B

    def __len__(self) -> int:
        return len(self.depth)


_NO_HOLLOWS = Hollows(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 3)))


@dataclass(frozen=True, slots=True)
class Weak:
    """Weak boxes of the terrain, which sink under too much load and stay down."""

    box: NDArray[np.intp]  # (n,) indices of the terrain's boxes
    bears: Array  # (n,) [N] maximum load
    sinks: Array  # (n,) [m] depth by which the box sinks

    def __len__(self) -> int:
        return len(self.box)


_NONE_WEAK = Weak(np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, slots=True)
class Look:
    """Colours of the ground, R, G, B from 0 to 255; NaN selects the default colour."""

    boxes: Array  # (n, 3)
    plane: Array  # (3,)
    height_field: Array  # (3,)


@dataclass(frozen=True, slots=True)
class Terrain:
    """Ground of one run."""

    boxes: Boxes
    height_field: HeightField | None = None
    plane: float | None = None  # [m] height of the level ground, None without level ground
    hollows: Hollows = _NO_HOLLOWS  # puddles in the plane
    look: Look | None = None
    weak: Weak = _NONE_WEAK  # weak boxes among `boxes`
    tipping: Tipping = NONE_TIPPING  # tipping boxes among `boxes`
    friction: FrictionPatches = NO_PATCHES

    def height_at(self, xy: Array) -> Array:
        """Return the true height (n,) [m] of the ground at points (n, 2) [m] {world}.

        It is the height of the highest visible surface. The height is -inf without ground. Weak boxes count at their original
        height.

        Raises:
            ValueError: The points are not (n, 2).
        """
        xy = np.asarray(xy, dtype=np.float64)
        if xy.ndim != 2 or xy.shape[1] != 2:
            raise ValueError(f"points (n, 2) expected, found {xy.shape}")
        z = np.full(len(xy), -np.inf if self.plane is None else self.plane)
        if self.height_field is not None:
            z = np.maximum(z, self.height_field.height_at(xy))
        boxes = self.boxes
        x, y = np.ascontiguousarray(xy.T)  # contiguous columns; NumPy is slow on rows of two
        reach = np.einsum("nij,nj->ni", np.abs(boxes.R[:, :2]), boxes.half)  # half size of the box's projection onto x, y
        for centre, half, R, r in zip(boxes.centre, boxes.half, boxes.R, reach, strict=True):
            below = np.flatnonzero((np.abs(x - centre[0]) <= r[0]) & (np.abs(y - centre[1]) <= r[1]))
            if not len(below):
                continue
            z[below] = np.maximum(z[below], _box_top(xy[below], centre, half, R))
        return z

    def sink_at(self, xy: Array) -> Array:
        """Return the depth (n,) [m] by which a foot sinks at points (n, 2) [m] {world}."""
        sink, boxes, weak = np.zeros(len(xy)), self.boxes, self.weak
        if self.plane is not None and len(self.hollows):
            for low, high, depth in zip(self.hollows.low, self.hollows.high, self.hollows.depth, strict=True):
                sink[((xy >= low) & (xy <= high)).all(axis=1)] = depth
            sink[self.height_at(xy) > self.plane] = 0.0  # solids above the hollow carry a foot
        for k, sinks in zip(weak.box, weak.sinks, strict=True):
            top = _box_top(xy, boxes.centre[k], boxes.half[k], boxes.R[k])
            sink[np.isfinite(top) & (top >= self.height_at(xy))] = sinks
        return sink

    def carrying_boxes(self) -> Boxes:
        """Return boxes of the level ground around the hollows, and of their beds.

        There are none without hollows.
        """
        heap = _Heap()
        if self.plane is not None and len(self.hollows):
            _surround(heap, self.hollows, self.plane)
        return heap.boxes()

    def raster(self, x0: float, y0: float, nx: int, ny: int, resolution: float) -> Array:
        """Return true heights (nx, ny) [m] on a grid.

        The points are (x0 + i * resolution, y0 + j * resolution) [m] {world}.
        """
        x, y = np.meshgrid(x0 + resolution * np.arange(nx), y0 + resolution * np.arange(ny), indexing="ij")
        return self.height_at(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(nx, ny)


def build_terrain(scenario: Scenario, rng: np.random.Generator) -> Terrain:
    """Build the terrain of a scenario; `rng` draws its random parts.

    Raises:
        ConfigError: The terrain has two planes or two height maps, rubble does not fit into its region, or a height map is not
            readable.
    """
    try:
        return _built(scenario, rng)
    except ValueError as error:
        raise ConfigError(f"scenario {scenario.name}", [str(error)]) from error


@contextmanager
def _named(place: str) -> Iterator[None]:
    """Name the place of a wrong value in its error."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from error


def _built(scenario: Scenario, rng: np.random.Generator) -> Terrain:
    heap = _Heap()
    planes: list[Plane] = []
    fields: list[tuple[HeightField, Color | None]] = []
    puddles: list[Puddle] = []
    holes: list[Hole] = []
    patches: list[Patches] = []
    weak, tipping = [_NONE_WEAK], [NONE_TIPPING]
    # `_drawn` resolves stairs and courses before any rubble is placed, so that rubble does not change their random draws.
    pieces: list[tuple[int, Primitive]] = []
    for k, whole in enumerate(scenario.terrain):
        with _named(f"terrain[{k}]"):
            pieces += [(k, piece) for piece in _drawn(whole, rng)]
    for k, part in pieces:
        heap.paint = None if isinstance(part, Patches) else part.color
        with _named(f"terrain[{k}]"):
            match part:
                case Plane():
                    planes.append(part)
                case Box():
                    box = _drawn_block(part, rng)
                    heap.add(box.xy, box.size, box.top, box.top - box.depth, np.radians(box.yaw_deg))
                case Hole():
                    holes.append(_drawn_block(part, rng))
                case Stairs():
                    _stairs(heap, part)
                case Pillars():
                    sinks, tips = _pillars(heap, part, rng)
                    weak.append(sinks)
                    tipping.append(tips)
                case PillarField():
                    _pillar_field(heap, part, rng)
                case Slope():
                    _slope(heap, part)
                case Rubble():
                    _rubble(heap, part, rng)
                case HeightMap():
                    fields.append((read_height_map(part, Path(scenario.folder)), part.color))
                case Relief():
                    fields.append((build_relief(part, rng), part.color))
                case Puddle():
                    puddles.append(part)
                case Puddles():
                    puddles += _scattered(part, rng)
                case Patches():
                    patches.append(part)
                case Course():
                    raise AssertionError("every course has been replaced by its pieces")
                case _:
                    assert_never(part)
    with _named("terrain"):
        for name, count in (("plane", len(planes)), ("height_map or relief", len(fields))):
            if count > 1:
                raise ValueError(f"at most one {name} in a terrain expected, found {count}; join them")
        if puddles and not planes:
            raise ValueError('puddles need level ground to lie in: add [[terrain]] with kind = "plane"')
        if holes and (not planes or puddles):
            raise ValueError('holes need level ground to lie in, and without puddles: add [[terrain]] with kind = "plane"')
    if holes:
        heap.paint = planes[0].color
        low, high = (np.array([np.array(h.xy) + sign * np.array(h.size) / 2 for h in holes]) for sign in (-1, 1))
        depth = np.array([h.depth for h in holes])
        _surround(heap, Hollows(low, high, depth, np.zeros((len(holes), 3))), planes[0].height)
    field_, field_color = fields[0] if fields else (None, None)
    with _named("terrain"):
        look = Look(_rgb(heap.color), _rgb([planes[0].color if planes else None])[0], _rgb([field_color])[0])
    level = planes[0].height if planes and not holes else None  # level ground with holes is made of boxes
    all_weak = Weak(*(np.concatenate([getattr(w, name) for w in weak]) for name in ("box", "bears", "sinks")))
    all_tipping = Tipping(*(np.concatenate([getattr(t, name) for t in tipping]) for name in ("box", "base", "mass", "most")))
    return Terrain(heap.boxes(), field_, level, _hollows(puddles), look, all_weak, all_tipping, draw_patches(patches, rng))


def _rgb(colors: list[Color | None]) -> Array:
    """Return colours (n, 3), NaN for None.

    Raises:
        ValueError: A value is outside 0 to 255.
    """
    rgb = np.array([(np.nan,) * 3 if color is None else color for color in colors], dtype=np.float64).reshape(-1, 3)
    if np.any((rgb < 0) | (rgb > 255)):
        raise ValueError(f"colours of R, G, B from 0 to 255 expected, found {colors}")
    return rgb


def _hollows(puddles: list[Puddle]) -> Hollows:
    for puddle in puddles:
        if min(*puddle.size, puddle.depth) <= 0:
            raise ValueError(f"a puddle of positive size and depth expected, found {puddle.size} and {puddle.depth} m")
    xy, size = (np.array([getattr(p, name) for p in puddles]).reshape(-1, 2) for name in ("xy", "size"))
    return Hollows(xy - size / 2, xy + size / 2, np.array([p.depth for p in puddles]), _rgb([p.color for p in puddles]))


def _scattered(puddles: Puddles, rng: np.random.Generator) -> list[Puddle]:
    """Return puddles at random positions, placed like rubble but axis-aligned."""
    like = Rubble(puddles.x, puddles.y, puddles.count, puddles.size, (0.0, 0.0), gap=puddles.gap, yaw_deg=0.0)
    return [
        Puddle((x, y), (length, width), depth=puddles.depth, color=puddles.color)
        for x, y, length, width, _ in _placed(like, rng).tolist()
    ]


def _surround(heap: "_Heap", hollows: Hollows, plane: float) -> None:
    """Add boxes that fill the plane except the hollows, and boxes for the beds.

    The plane is filled strip by strip along x.
    """
    edges = np.unique(np.concatenate([[-_FAR, _FAR], hollows.low[:, 0], hollows.high[:, 0]]))
    for x0, x1 in pairwise(edges):
        across = (hollows.low[:, 0] < (x0 + x1) / 2) & (hollows.high[:, 0] > (x0 + x1) / 2)
        y = -_FAR
        for low, high in sorted(zip(hollows.low[across, 1], hollows.high[across, 1], strict=True)):
            if low > y:
                heap.add(((x0 + x1) / 2, (y + low) / 2), (x1 - x0, low - y), plane, plane - DEPTH)
            y = max(y, high)
        heap.add(((x0 + x1) / 2, (y + _FAR) / 2), (x1 - x0, _FAR - y), plane, plane - DEPTH)
    for low, high, depth in zip(hollows.low, hollows.high, hollows.depth, strict=True):
        heap.add((low + high) / 2, tuple((high - low).tolist()), plane - depth, plane - depth - DEPTH)


@dataclass(slots=True)
class _Heap:
    """Collector of boxes and their colours."""

    centre: list[Array] = field(default_factory=list)
    half: list[Array] = field(default_factory=list)
    R: list[Array] = field(default_factory=list)
    color: list[Color | None] = field(default_factory=list)
    paint: Color | None = None  # colour of the boxes that are added next

    def add(self, xy: Iterable[float], size: tuple[float, float], top: float, bottom: float, yaw: float = 0.0) -> None:
        """Add an upright box with a centre xy, size, top and bottom [m] and a yaw [rad]."""
        if len(self.centre) >= _MAX_BOXES:
            raise ValueError(f"at most {_MAX_BOXES} solids expected, found more; ask for fewer or larger ones")
        if not (min(size) > 0 and top > bottom):
            raise ValueError(f"a box with positive edges expected, found {size[0]} x {size[1]} x {top - bottom} m")
        self.centre.append(np.array([*xy, (top + bottom) / 2]))
        self.half.append(np.array([*size, top - bottom]) / 2)
        self.R.append(rotation_z(yaw))
        self.color.append(self.paint)

    def boxes(self) -> Boxes:
        return Boxes(
            np.array(self.centre).reshape(-1, 3), np.array(self.half).reshape(-1, 3), np.array(self.R).reshape(-1, 3, 3)
        )


def _drawn(part: Primitive, rng: np.random.Generator) -> list[Primitive]:
    """Return the primitives that replace a primitive after its random draws.

    Stairs get one riser and tread, a course is replaced by its primitives, and others are unchanged.
    """
    match part:
        case Stairs():
            return [_drawn_stairs(part, rng)]
        case Course():
            return _pieces(part, rng)
        case _:
            return [part]


def _drawn_stairs(stairs: Stairs, rng: np.random.Generator) -> Stairs:
    if not (stairs.riser_spread or stairs.tread_spread):
        return stairs
    riser, tread = rng.uniform(-1.0, 1.0, 2) * (stairs.riser_spread, stairs.tread_spread)
    return replace(stairs, riser=stairs.riser + riser, tread=stairs.tread + tread, riser_spread=0.0, tread_spread=0.0)


def _drawn_block(block: Block, rng: np.random.Generator) -> Block:
    """Return a box or hole with random offsets within its spreads."""
    top_spread = block.top_spread if isinstance(block, Box) else 0.0
    if not any((*block.xy_spread, *block.size_spread, top_spread)):
        return block
    x, y, length, width, top = rng.uniform(-1.0, 1.0, 5) * (*block.xy_spread, *block.size_spread, top_spread)
    xy, size = (block.xy[0] + x, block.xy[1] + y), (block.size[0] + length, block.size[1] + width)
    if isinstance(block, Box):
        return replace(block, xy=xy, size=size, top=block.top + top)
    return replace(block, xy=xy, size=size)


def _pieces(course: Course, rng: np.random.Generator) -> list[Primitive]:
    """Return the primitives of a course, with its stretches end to end."""
    pieces: list[Primitive] = []
    x, base = course.x, 0.0
    for stretch in _in_order(course, rng):
        found, length, rise = _laid(stretch, course, x, base, rng)
        pieces += found
        x, base = x + length, base + rise
    return pieces


def _in_order(course: Course, rng: np.random.Generator) -> list[Stretch]:
    """Return the stretches of a course in order of x.

    The course defines whether they are shuffled and separated by level ground.
    """
    first, inner, last = course.stretches[:1], course.stretches[1:-1], course.stretches[1:][-1:]
    if course.shuffled:
        inner = tuple(inner[k] for k in rng.permutation(len(inner)))
    rests = [Level(course.rest)] if course.rest > 0 else []
    between = [stretch for k, one in enumerate(inner) for stretch in [*(rests if k else []), one]]
    return [*first, *between, *last]


def _laid(
    stretch: Stretch, course: Course, x: float, base: float, rng: np.random.Generator
) -> tuple[list[Primitive], float, float]:
    """Return the primitives, the length [m] and the rise [m] of a stretch.

    The stretch begins at x [m] and height `base` [m].
    """
    depth = base - course.bottom
    match stretch:
        case Level():
            return [_slab(x, stretch.length, base, course)], stretch.length, 0.0
        case Ramp():
            angle = stretch.angle_deg + stretch.angle_spread_deg * float(rng.uniform(-1.0, 1.0))
            rise = stretch.length * float(np.tan(np.radians(angle)))
            ramp = Slope((x, 0.0), angle, stretch.length, course.width, landing=0.0, base=base, color=course.color)
            return [replace(ramp, depth=depth + min(rise, 0.0))], stretch.length, rise
        case Flight():
            stairs = Stairs((x, 0.0), stretch.riser, stretch.tread, stretch.count, course.width, base=base, color=course.color)
            stairs = replace(stairs, riser_spread=stretch.riser_spread, tread_spread=stretch.tread_spread)
            stairs = _drawn_stairs(stairs, rng)
            rise = stairs.count * stairs.riser
            stairs = replace(stairs, landing=stairs.tread, depth=depth + min(rise, 0.0))
            return [stairs], stairs.count * stairs.tread, rise
        case Blocks():
            half = course.width / 2
            region = ((x, x + stretch.length), (-half, half))
            rubble = Rubble(*region, stretch.count, stretch.size, stretch.top, base=base, color=course.color)
            rubble = replace(rubble, gap=stretch.gap, yaw_deg=stretch.yaw_deg)
            return [_slab(x, stretch.length, base, course), rubble], stretch.length, 0.0
        case Stones():
            return _stones(stretch, course, x, base, rng)
        case Gap():
            return [], stretch.length + stretch.spread * float(rng.uniform(-1.0, 1.0)), 0.0


def _slab(x: float, length: float, top: float, course: Course) -> Box:
    """Return level ground over the width of a course."""
    return Box((x + length / 2, 0.0), (length, course.width), top, depth=top - course.bottom, color=course.color)


def _stones(
    stones: Stones, course: Course, x: float, base: float, rng: np.random.Generator
) -> tuple[list[Primitive], float, float]:
    pitch = stones.size + stones.gap
    across = max(1, int((course.width + stones.gap) // pitch))
    if stones.rows * across > _MAX_BOXES:
        raise ValueError(f"at most {_MAX_BOXES} stones expected, found {stones.rows} rows of {across}")
    i, j = np.meshgrid(np.arange(stones.rows), np.arange(across), indexing="ij")
    xy = np.stack([x + stones.gap + stones.size / 2 + pitch * i, pitch * (j - (across - 1) / 2)], axis=-1).reshape(-1, 2)
    xy += rng.uniform(-stones.jitter, stones.jitter, xy.shape)
    tops = base + rng.uniform(*stones.top, len(xy))
    size = (stones.size, stones.size)
    boxes: list[Primitive] = [
        Box((at_x, at_y), size, top, depth=top - course.bottom, color=course.color)
        for at_x, at_y, top in np.column_stack([xy, tops]).tolist()
    ]
    return boxes, stones.rows * pitch + stones.gap, 0.0


def _stairs(heap: _Heap, stairs: Stairs) -> None:
    yaw = np.radians(stairs.yaw_deg)
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    bottom = min(stairs.base, stairs.base + stairs.count * stairs.riser) - stairs.depth
    for step in range(stairs.count):
        tread = stairs.landing if step == stairs.count - 1 else stairs.tread
        middle = np.asarray(stairs.xy) + (step * stairs.tread + tread / 2) * forward
        heap.add(middle, (tread, stairs.width), stairs.base + (step + 1) * stairs.riser, bottom, yaw)


def _slope(heap: _Heap, slope: Slope) -> None:
    if not 0 < abs(slope.angle_deg) < 80:
        raise ValueError(f"a slope of less than 80 deg, not level, expected, found angle_deg = {slope.angle_deg}")
    angle, yaw = np.radians(slope.angle_deg), np.radians(slope.yaw_deg)
    rise = slope.length * np.tan(angle)
    along = np.array([np.cos(yaw), np.sin(yaw)])
    R = rotation_from_rpy((0.0, -angle, yaw))
    half = np.array([slope.length / np.cos(angle), slope.width, (abs(rise) + slope.depth) * np.cos(angle)]) / 2
    middle_of_top = np.array([*(np.asarray(slope.xy) + slope.length / 2 * along), slope.base + rise / 2])
    heap.centre.append(middle_of_top - R[:, 2] * half[2])
    heap.half.append(half)
    heap.R.append(R)
    heap.color.append(heap.paint)
    if slope.landing > 0:
        middle = np.asarray(slope.xy) + (slope.length + slope.landing / 2) * along
        heap.add(middle, (slope.landing, slope.width), slope.base + rise, slope.base + min(rise, 0.0) - slope.depth, yaw)


def _pillars(heap: _Heap, pillars: Pillars, rng: np.random.Generator) -> tuple[Weak, Tipping]:
    """Add pillars, and return those that sink and those that tip."""
    xy, tops = np.array(pillars.xy, dtype=np.float64).reshape(-1, 2), np.full(len(pillars.xy), pillars.top)
    if pillars.jitter:
        xy += rng.uniform(-pillars.jitter, pillars.jitter, xy.shape)
    if pillars.top_spread:
        tops += rng.uniform(-pillars.top_spread, pillars.top_spread, len(tops))
    yaw = float(np.radians(pillars.turn_deg))
    xy = pillars.pivot + (xy - pillars.pivot) @ rotation_z(yaw)[:2, :2].T
    size, bottom, first = (pillars.length or pillars.size, pillars.size), pillars.top - pillars.depth, len(heap.centre)
    chosen = rng.permutation(len(xy)) if pillars.weak or pillars.tipping else np.zeros(0, dtype=np.intp)
    weak, tipping = np.sort(chosen[: pillars.weak]), np.sort(chosen[pillars.weak :][: pillars.tipping])
    for k, (place, top) in enumerate(zip(xy, tops.tolist(), strict=True)):
        heap.add(place, size, top, top - pillars.tip_height if k in tipping else bottom, yaw)
    for k in tipping.tolist():
        heap.add(xy[k], (2 * pillars.bears_within,) * 2, float(tops[k]) - pillars.tip_height, bottom, yaw)
    n = len(tipping)
    return (
        Weak(first + weak, np.full(len(weak), pillars.bears), np.full(len(weak), pillars.sinks)),
        Tipping(
            first + tipping,
            np.full(n, pillars.bears_within),
            np.full(n, pillars.tip_mass),
            np.full(n, np.radians(pillars.tip_deg)),
        ),
    )


def _pillar_field(heap: _Heap, pillars: PillarField, rng: np.random.Generator) -> None:
    density = rng.uniform(*pillars.density)
    area = (pillars.x[1] - pillars.x[0]) * (pillars.y[1] - pillars.y[0])
    count, size = round(density * area / pillars.size**2), (pillars.size, pillars.size)
    if count > MAX_BLOCKS:
        raise ValueError(f"at most {MAX_BLOCKS} pillars in a field expected, found {count}; ask for fewer or larger ones")
    like = Rubble(pillars.x, pillars.y, count, size, (0.0, 0.0), gap=pillars.gap, yaw_deg=0.0)
    for x, y, *_ in _placed(like, rng):
        heap.add((x, y), size, pillars.top, pillars.top - pillars.depth)


def _rubble(heap: _Heap, rubble: Rubble, rng: np.random.Generator) -> None:
    placed = _placed(rubble, rng)
    tops = rng.uniform(*rubble.top, rubble.count)
    for (x, y, length, width, yaw), top in zip(placed, tops, strict=True):
        heap.add((x, y), (length, width), rubble.base + float(top), rubble.base - DEPTH, yaw)


def _placed(rubble: Rubble, rng: np.random.Generator) -> Array:
    """Place blocks by rejection sampling.

    Size, yaw and position of a block are drawn until it keeps the gap to all other blocks.

    Returns:
        (count, 5) centre x, y, length, width [m], yaw [rad].
    """
    for bounds in (rubble.x, rubble.y, rubble.size, rubble.top):
        if bounds[0] > bounds[1]:
            raise ValueError(f"rubble bounds in rising order expected, found {bounds}")
    least = rubble.size[0] + rubble.gap
    room = _PACKED * (np.ptp(rubble.x) + rubble.gap) * (np.ptp(rubble.y) + rubble.gap) / max(least, 1e-6) ** 2
    if rubble.count > room:
        raise _no_room(rubble, int(room))
    most = 0
    for restart in range(_RESTARTS):
        placed = _place_rectangles(rubble, rng)
        if len(placed) == rubble.count:
            return placed
        most = max(most, len(placed))
        if restart >= _HOPELESS_RESTARTS and most < _HOPELESS_SHARE * rubble.count:
            break
    raise _no_room(rubble, most)


def _no_room(rubble: Rubble, found: int) -> ValueError:
    return ValueError(
        f"room for {rubble.count} blocks of rubble expected, found room for about {found} of {rubble.size[0]} to "
        f"{rubble.size[1]} m in {rubble.x[1] - rubble.x[0]:g} x {rubble.y[1] - rubble.y[0]:g} m, {rubble.gap} m apart; "
        "ask for fewer, smaller or closer ones, or a larger region"
    )


def _place_rectangles(rubble: Rubble, rng: np.random.Generator) -> Array:
    """Return rectangles (n, 5): centre x, y, length, width [m], yaw [rad].

    There are fewer than requested if no more fit.
    """
    placed = np.zeros((0, 5))
    lower, upper = np.array([rubble.x[0], rubble.y[0]]), np.array([rubble.x[1], rubble.y[1]])
    while len(placed) < rubble.count:
        for _ in range(_BATCHES):
            size = rng.uniform(*rubble.size, (_BATCH, 2))
            yaw = np.radians(rng.uniform(-rubble.yaw_deg, rubble.yaw_deg, _BATCH))
            c, s = np.abs(np.cos(yaw)), np.abs(np.sin(yaw))
            reach = np.stack([c * size[:, 0] + s * size[:, 1], s * size[:, 0] + c * size[:, 1]], axis=1) / 2
            xy = lower + reach + rng.uniform(0.0, 1.0, (_BATCH, 2)) * (upper - lower - 2 * reach)
            fits = np.all(upper - lower >= 2 * reach, axis=1)
            candidates = np.column_stack([xy, size, yaw])
            free = _first_free(candidates[fits], placed, rubble.gap)
            if free is not None:
                placed = np.vstack([placed, free])
                break
        else:
            return placed
    return placed


def _first_free(candidates: Array, placed: Array, gap: float) -> Array | None:
    """Return the first rectangle that keeps a gap [m] to all placed ones.

    Candidates are (n, 5) and placed rectangles (m, 5), as in `_place_rectangles`. The result is None without such a candidate.
    """
    for some in np.split(candidates, [_FEW]):
        free = np.flatnonzero(~_blocked(some, placed, gap))
        if len(free):
            return np.asarray(some[free[0]])
    return None


def _blocked(candidates: Array, placed: Array, gap: float) -> NDArray[np.bool_]:
    """Return which candidates lie within a gap [m] of a placed rectangle.

    Candidates are (n, 5), placed rectangles (m, 5), and the result is (n,).
    """
    blocked = np.zeros(len(candidates), dtype=np.bool_)
    reach, reach_placed = (np.hypot(some[:, 2], some[:, 3]) / 2 for some in (candidates, placed))
    d2 = np.subtract.outer(candidates[:, 0], placed[:, 0]) ** 2 + np.subtract.outer(candidates[:, 1], placed[:, 1]) ** 2
    # At a larger distance, an axis of either rectangle separates them for all headings.
    i, j = np.nonzero(d2 < 2.0 * (reach[:, None] + reach_placed + max(gap, 0.0)) ** 2)
    blocked[i[_closer_than(candidates[i], placed[j], gap)]] = True
    return blocked


def _closer_than(a: Array, b: Array, gap: float) -> Array:
    """Return whether rectangles (..., 5) lie within a gap [m] of each other.

    The test uses the separating axis theorem. Between two corners the test is conservative: it requires a slightly wider gap.
    """
    d = b[..., :2] - a[..., :2]
    c, s = np.cos(b[..., 4] - a[..., 4]), np.sin(b[..., 4] - a[..., 4])
    apart = np.zeros(d.shape[:-1], dtype=bool)
    for one, other in ((a, b), (b, a)):
        cos, sin = np.cos(one[..., 4]), np.sin(one[..., 4])
        along = np.stack([d[..., 0] * cos + d[..., 1] * sin, d[..., 1] * cos - d[..., 0] * sin], axis=-1)
        length, width = other[..., 2], other[..., 3]
        shadow = np.stack([np.abs(c) * length + np.abs(s) * width, np.abs(s) * length + np.abs(c) * width], axis=-1)
        apart |= np.any(np.abs(along) >= (one[..., 2:4] + shadow) / 2 + gap, axis=-1)
    return ~apart


def _box_top(xy: Array, centre: Array, half: Array, R: Array) -> Array:
    """Return the heights (n,) [m] of the top of a box at points (n, 2) [m].

    The height is -inf where the vertical line through a point misses the box.
    """
    origin = (np.column_stack([xy - centre[:2], np.full(len(xy), -centre[2])])) @ R  # lines at z = 0 {box}
    enter, leave = np.full(len(xy), -np.inf), np.full(len(xy), np.inf)
    for axis in range(3):
        rate = R[2, axis]  # component of the vertical along this box axis
        if abs(rate) < 1e-12:
            leave = np.where(np.abs(origin[:, axis]) <= half[axis], leave, -np.inf)
            continue
        slab = np.stack([-half[axis] - origin[:, axis], half[axis] - origin[:, axis]]) / rate
        enter, leave = np.maximum(enter, slab.min(axis=0)), np.minimum(leave, slab.max(axis=0))
    return np.where(enter <= leave, leave, -np.inf)
