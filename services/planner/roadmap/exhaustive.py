"""Exhaustive offline search: decide whether any path across a strip exists.

**Footholds** are all those that the roadmap may choose (`roadmap_search.candidates`), grouped in tiles. A narrow piece of
ground has three tiles: around its first and last good place along the strip, and around its middle. Ground that is wide in both
directions is one tile. A foot on a tile may be at any of its places within reach, and may move among them at any time. The
**body** uses the roadmap's lattice and its cone of motions. If it turns, its headings are grouped in bins of 15 deg and its
places in squares of 2 cm: what is possible at any heading of a bin and any place of a square counts as possible at all of them.
A configuration is a place and a heading of the body, and a tile for each foot.

**Tests** are necessary conditions: reach, foot placement, distance between feet, and support. The support polygon has a margin
around the centre of mass only if every edge has this margin. An edge joins two neighbouring feet, and has it only if both feet
are at least as far from the centre of mass, in the direction perpendicular to the edge. So each foothold has the set of
directions in which it is far enough out, and a stance passes if the sets of every two neighbouring feet intersect.

The **height** of the body is that over any floor between the lowest and the highest foothold. On an uneven strip, where the
roadmap chooses it, it is up to 7 cm more or less.

The tests of the roadmap that are left out could only refuse more: torque, distances between legs, and clearance of trunk,
shanks and swings over the ground. The remaining configurations are often few enough to search all of them. If none of them
leads across, there is no path at this discretisation.
"""

import math
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.roadmap import roadmap_search
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import Roadmap, SectionPlan, Stance
from sextant.services.planner.roadmap.roadmap_search import Rules
from sextant.services.planner.roadmap.search_tables import legs_of, rules_of
from sextant.services.planner.roadmap.sections import is_uneven
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array, rotation_z
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.compiled import compiled

_ATTEMPTS = 24  # attempts of the roadmap, each with another seed
_WORDS = 2  # 64-bit words of a set of directions, one bit per direction
_FOOT_RANGE_M = 0.35  # [m] maximum distance of a foot from the body along each axis
_WIDE_M = 0.50  # [m] ground longer and wider than this is one tile
_NARROW_M = 0.08  # [m] maximum extent of a piece with three tiles; a longer one is divided into several pieces
_SWAY_M = 0.07  # [m] of the body's height over the floor to lower and higher places on an uneven strip; trunk and legs limit it
_MAX_CONFIGURATIONS = 4_000_000  # maximum number of configurations
_MAX_CODE = 2**63  # limit of the encoding of a configuration
_BIN, _SQUARE = 5, 2  # [lattice steps] of a body that turns: headings of a bin, edge of a square of places


class Tiles(NamedTuple):
    """Properties of tiles at each place and heading of the body."""

    out: NDArray[np.uint64]  # (bins, 6, tiles, nx, ny, 2) directions, as bits, in which a foot on a tile is far enough out
    near: NDArray[np.int16]  # (bins, 6, nx, ny, k) tiles within a leg's reach, then -1
    apart: NDArray[np.bool_]  # (tiles, tiles) whether one foot may stand on each
    onward: NDArray[np.bool_]  # (bins, tiles, tiles) whether a foot may step from the first to the second
    moves: NDArray[np.int64]  # (m, 3) body motions: bin of headings, and squares along and across


def passable(
    profile: RobotProfile, settings: PassageSettings, field: StripMap, stance: Stance, goal_x: float, attempts: int = _ATTEMPTS
) -> bool | None:
    """Decide whether a path exists; offline, in up to some minutes.

    Returns:
        True if the roadmap finds a path within `attempts`, straight on or with turns of the body. False if it does not, and
        `has_way` finds that there is none, straight on or with turns. None if undecided: a test that `has_way` leaves out may
        exclude all paths, or the roadmap may have missed one.
    """
    roadmap = Roadmap(profile, settings)
    for turning, seed in product((False, True), range(attempts)):
        roadmap.begin(field, stance, goal_x, seed, turning)
        while (found := roadmap.grow(settings.budget)) is None:
            pass
        if isinstance(found, SectionPlan) and found.complete:
            return True
    ways = (has_way(profile, settings, field, stance, goal_x, turning=turning) for turning in (False, True))
    return False if all(way is False for way in ways) else None


def has_way(
    profile: RobotProfile,
    settings: PassageSettings,
    field: StripMap,
    stance: Stance,
    goal_x: float,
    room: int = _MAX_CONFIGURATIONS,
    turning: bool = False,
) -> bool | None:
    """Return whether a path exists under the necessary conditions of this module.

    If there is none, the roadmap has no path over these footholds either.

    Args:
        profile: The robot.
        settings: Settings of the roadmap.
        field: The strip, completely known, with the body's lattice as its resolution.
        stance: First stance.
        goal_x: [m] {strip} goal of the body.
        room: Maximum number of configurations.
        turning: Whether the body may turn; otherwise it faces along the strip.

    Returns:
        None if there are more configurations than `room`.

    Raises:
        ValueError: A foot of the first stance is not on a foothold, or resolution and lattice differ.
    """
    rules, edge = rules_of(profile, settings, turning), _SQUARE if turning else 1
    tile, headings = _tile_map(field, settings), _headings(rules)
    start = np.rint(stance.body[:2] / rules.lattice).astype(np.int64)
    sides = max(math.floor(rules.drift / rules.lattice + 1e-6), abs(int(start[1])))
    ahead = math.ceil(goal_x / rules.lattice - 1e-6) - int(start[0])
    size = ahead // edge + 1, 2 * sides // edge + 1
    if math.prod(size) * len(headings) * (int(tile.max()) + 1) ** 6 >= _MAX_CODE:
        return None
    cells = np.floor((stance.feet[:, :2] - field.first_cell) / field.resolution + 0.5).astype(int)
    standing = tile[cells[:, 0], cells[:, 1]]
    if (standing < 0).any():
        raise ValueError(f"every foot on a foothold expected, found {stance.feet[standing < 0]} off footholds")
    tiles = _tiles(profile, settings, rules, field, tile, headings, (int(start[0]), -sides), size, edge)
    known = np.zeros(1 << math.ceil(math.log2(2 * room)), dtype=np.uint64)
    node, after, first = np.zeros(room, np.uint64), np.zeros(room, np.int32), np.full(size[0], -1, np.int32)
    heading = int(np.argmin([np.abs(yaws - stance.yaw).min() for yaws in headings]))
    place = (int(start[1]) + sides) // edge, heading
    found = _grow(tiles, standing.astype(np.int64), *place, known, node, after, first)
    return None if found < 0 else found > 0


def _headings(rules: Rules) -> list[Array]:
    """Return the headings [rad] {strip} of each bin, from right to left."""
    if rules.yaw_change == 0:
        return [np.zeros(1)]
    half, most = _BIN // 2, rules.yaw_most
    bins = max(math.ceil((most - half) / _BIN), 0)
    steps = [np.arange(max(_BIN * k - half, -most), min(_BIN * k + half, most) + 1) for k in range(-bins, bins + 1)]
    return [np.asarray(rules.yaw_step * some) for some in steps]


def _tile_map(field: StripMap, settings: PassageSettings) -> NDArray[np.int16]:
    """Return the tile (nx, ny) of each foothold cell, -1 for other cells.

    Wide ground is one tile, a narrow piece has three.
    """
    carries = np.zeros(field.evaluation.shape, dtype=np.bool_)
    roadmap_search.candidates(field.evaluation, settings.strong_cells, settings.wide_cells, settings.weakest_cells, carries)
    part = np.full(carries.shape, -1, dtype=np.int16)
    tile, tiles = part.copy(), 0
    for k in range(_label_pieces(carries, part)):
        cells = np.argwhere(part == k)
        extent = (np.ptp(cells, axis=0) + 1) * field.resolution
        if (extent > _WIDE_M).all():
            tile[tuple(cells.T)] = tiles
            tiles += 1
            continue
        pieces = np.ceil(extent / _NARROW_M - 1e-6).astype(int)
        which = (cells - cells.min(axis=0)) * pieces // (np.ptp(cells, axis=0) + 1)
        for piece in np.unique(which, axis=0):
            inside = cells[(which == piece).all(axis=1)]
            low, high = inside.min(axis=0), inside.max(axis=0)
            rows = np.unique([low[0], (low[0] + high[0]) // 2, high[0]])
            found, nearest = np.unique(np.abs(inside[:, :1] - rows).argmin(axis=1), return_inverse=True)
            tile[tuple(inside.T)] = tiles + nearest  # no cell is left out
            tiles += len(found)
    return tile


def _tiles(
    profile: RobotProfile,
    settings: PassageSettings,
    rules: Rules,
    field: StripMap,
    tile: NDArray[np.int16],
    headings: list[Array],
    corner: tuple[int, int],
    size: tuple[int, int],
    edge: int,
) -> Tiles:
    """Compute the properties of tiles (nx, ny).

    `corner` and `size` define the squares of body places, `edge` lattice steps long.
    """
    count = int(tile.max()) + 1
    if abs(rules.lattice - field.resolution) > 1e-9:
        raise ValueError(f"a cell size equal to the body lattice ({rules.lattice} m) expected, found {field.resolution} m")
    # 1. Places of feet relative to the body, and the directions in which they are far enough out; then the same for tiles.
    carrying = field.elevation[tile >= 0]
    low, high = float(carrying.min()), float(carrying.max())
    sway = math.ceil((_SWAY_M if is_uneven(field, settings.uneven_m) else rules.sway) / rules.lattice - 1e-6)
    out = np.zeros((len(headings), 6, count, *size, _WORDS), dtype=np.uint64)
    first = np.floor(np.array(field.first_cell) / rules.lattice + 1e-9).astype(np.int64) - corner
    for k, yaws in enumerate(headings):
        window = _window(profile, settings, np.array(field.first_cell), low - high - sway * rules.lattice, yaws)
        level = np.rint(np.where(tile >= 0, field.elevation - high, 0.0) / rules.lattice).astype(np.int64)
        lowest, floors = int(level.min()), (len(window) + 1) // 2 + sway
        over = np.stack(  # any floor
            [np.bitwise_or.reduce(window[len(window) + n - floors : len(window) + n]) for n in range(lowest, 1)]
        )
        places = np.zeros((count, *(edge * n + 1 for n in size), 6 * _WORDS), dtype=np.uint64)
        _combine_directions(over, np.asarray(over.any(axis=-1)), tile, level - lowest, first, places)
        by_leg = places.reshape(*places.shape[:3], 6, _WORDS).transpose(3, 0, 1, 2, 4)
        for i, j in product(range(edge + 1 if edge > 1 else 1), repeat=2):  # all corners of the squares
            out[k] |= by_leg[:, :, i : i + edge * size[0] : edge, j : j + edge * size[1] : edge]
    # 2. The tiles within reach come first in each leg's list.
    reached = out.any(axis=-1)  # (bins, 6, tiles, nx, ny)
    near = np.argsort(~reached, axis=2, kind="stable")[:, :, : int(reached.sum(axis=2).max())]
    near = np.where(np.take_along_axis(reached, near, axis=2), near, -1).astype(np.int16)
    # 3. Permitted pairs of tiles, and the body's cone.
    ends = np.array([[f(np.argwhere(tile == t), axis=0) for f in (np.min, np.max)] for t in range(count)])
    widest = np.maximum(ends[:, None, 1] - ends[None, :, 0], ends[None, :, 1] - ends[:, None, 0]) * field.resolution
    apart = np.linalg.norm(widest, axis=-1) >= rules.feet_apart - 1e-9
    most, least = ends[None, :, 1] - ends[:, None, 0], ends[None, :, 0] - ends[:, None, 1]  # (tiles, tiles, 2) [cells] onward
    onward = np.stack([_reaches(most, least, yaws) * field.resolution >= -rules.backward - 1e-9 for yaws in headings])
    distance, phi = np.meshgrid(np.linspace(0.0, rules.body_high, 200), rules.body_angle * np.linspace(-1.0, 1.0, 200))
    steps = np.stack([distance * np.cos(phi), distance * np.sin(phi)], axis=-1).reshape(-1, 2)
    moves = [_moves(steps / rules.lattice, yaws, edge) for yaws in headings]
    which = np.repeat(np.arange(len(headings)), [len(some) for some in moves])
    motions = np.column_stack([which, np.concatenate(moves)])
    return Tiles(out, np.ascontiguousarray(near.transpose(0, 1, 3, 4, 2)), apart, onward, motions)


def _reaches(most: Array, least: Array, yaws: Array) -> Array:
    """Return the largest distances (...) ahead, at any of some headings [rad], of motions between two limits (..., 2)."""
    c, s = np.cos(yaws), np.sin(yaws)
    ahead = c * most[..., :1] + np.maximum(s * most[..., 1:], s * least[..., 1:])
    return np.asarray(ahead.max(axis=-1))


def _moves(steps: Array, yaws: Array, edge: int) -> NDArray[np.int64]:
    """Return the motions (m, 2) in squares of `edge` for motions (n, 2) [lattice steps] at any of some headings [rad]."""
    turned = np.concatenate([steps @ rotation_z(yaw)[:2, :2].T for yaw in yaws])
    if edge == 1:
        return np.unique(np.rint(turned).astype(np.int64), axis=0)
    begins = np.stack(np.meshgrid([0.0, 1.0 - 1e-9], [0.0, 1.0 - 1e-9]), axis=-1).reshape(-1, 1, 2)  # within a square
    return np.unique(np.floor(turned / edge + begins).astype(np.int64).reshape(-1, 2), axis=0)


def _window(profile: RobotProfile, settings: PassageSettings, corner: Array, lowest: float, yaws: Array) -> NDArray[np.uint64]:
    """Return the directions in which a foot is far enough out, for each leg and each foot offset from the body.

    The shape is (levels, n, n, 6 * words). An offset out of the leg's reach has no direction. Directions at several headings
    are united.

    Args:
        profile: The robot.
        settings: Settings of the roadmap.
        corner: (2,) [m] any foot place. The grid of foot places has the same offset from the body's lattice everywhere.
        lowest: [m] lowest ground relative to the floor under the body, negative; the highest is as far above that floor.
        yaws: (k,) [rad] {strip} headings of the body.
    """
    rules, legs = rules_of(profile, settings), legs_of(profile, settings)
    levels = rules.lattice * np.arange(
        -math.ceil(-lowest / rules.lattice - 1e-6), math.ceil(-lowest / rules.lattice - 1e-6) + 1
    )
    k = math.ceil(_FOOT_RANGE_M / rules.lattice)
    lattice = rules.lattice * np.stack(np.meshgrid(*[np.arange(-k, k + 1)] * 2, indexing="ij"), axis=-1)
    off = lattice + corner - rules.lattice * np.floor(corner / rules.lattice + 1e-9)
    window = np.zeros((len(levels), *off.shape[:2], 6, _WORDS), dtype=np.uint64)
    centre, found = np.array([rules.centre_x, rules.centre_y]), np.zeros(off.shape[0] * off.shape[1], dtype=np.int64)
    for yaw in yaws:
        R_strip_body = rotation_z(yaw)[:2, :2]
        bits = _directions(off - R_strip_body @ centre, rules.margin)
        for leg, (n, level) in product(range(6), enumerate(levels)):
            z = np.full(off.shape[:2], level + rules.foot_radius - rules.height)
            roadmap_search.landings(legs, leg, np.ascontiguousarray(np.dstack([off @ R_strip_body, z]).reshape(-1, 3)), found)
            window[n, :, :, leg] |= np.where((found == roadmap_search.OK).reshape(off.shape[:2])[..., None], bits, np.uint64(0))
    return window.reshape(*window.shape[:3], -1)


def _directions(off: Array, margin: float) -> NDArray[np.uint64]:
    """Return the directions in which places are at least a margin [m] from the origin, as bits.

    Places are (..., 2) [m], the result is (..., words). Each bit stands for all directions up to half way to its neighbours.
    """
    n = 64 * _WORDS
    angle = 2.0 * np.pi / n * np.arange(n)
    distance = np.linalg.norm(off, axis=-1)
    most = np.where(distance >= margin, np.arccos(np.minimum(margin / np.maximum(distance, margin), 1.0)) + np.pi / n, -1.0)
    turn = np.abs((np.arctan2(off[..., 1], off[..., 0])[..., None] - angle + np.pi) % (2.0 * np.pi) - np.pi)
    flags = (turn <= most[..., None] + 1e-9).reshape(*off.shape[:-1], _WORDS, 64)
    return np.asarray((flags * (np.uint64(1) << np.arange(64, dtype=np.uint64))).sum(axis=-1, dtype=np.uint64))


@compiled
def _label_pieces(carries: NDArray[np.bool_], part: NDArray[np.int16]) -> int:
    """Number the connected pieces of ground; return how many there are."""
    pieces = 0
    stack = np.empty((carries.size, 2), np.int64)
    for i in range(carries.shape[0]):
        for j in range(carries.shape[1]):
            if not carries[i, j] or part[i, j] >= 0:
                continue
            stack[0, 0], stack[0, 1], n = i, j, 1
            part[i, j] = pieces
            while n > 0:
                n -= 1
                a, b = stack[n]
                for c in range(max(a - 1, 0), min(a + 2, carries.shape[0])):
                    for d in range(max(b - 1, 0), min(b + 2, carries.shape[1])):
                        if carries[c, d] and part[c, d] < 0:
                            part[c, d] = pieces
                            stack[n, 0], stack[n, 1] = c, d
                            n += 1
            pieces += 1
    return pieces


@compiled
def _combine_directions(
    window: NDArray[np.uint64],
    within_reach: NDArray[np.bool_],
    tile: NDArray[np.int16],
    level: NDArray[np.int64],
    first: NDArray[np.int64],
    out: NDArray[np.uint64],
) -> None:
    """Add the directions of each cell to those of its tile, for each body place within the window around the cell.

    Args:
        window: (levels, n, n, 6 * words) directions by height of the cell and offset from the body, for all legs.
        within_reach: (levels, n, n) whether any leg has a direction.
        tile: (nx, ny) tile of each cell.
        level: (nx, ny) height of each cell as a level of the window.
        first: (2,) lattice place of cell (0, 0).
        out: (tiles, nx, ny, 6 * words) directions of the tiles.
    """
    k = window.shape[1] // 2
    for i in range(tile.shape[0]):
        for j in range(tile.shape[1]):
            t = tile[i, j]
            if t < 0:
                continue
            n = level[i, j]
            for x in range(max(i + first[0] - k, 0), min(i + first[0] + k + 1, out.shape[1])):
                for y in range(max(j + first[1] - k, 0), min(j + first[1] + k + 1, out.shape[2])):
                    a, b = i + first[0] - x + k, j + first[1] - y + k
                    if within_reach[n, a, b]:
                        for w in range(out.shape[3]):
                            out[t, x, y, w] |= window[n, a, b, w]


@compiled
def _is_supported(out: NDArray[np.uint64], tiles: NDArray[np.int64], swing: int, x: int, y: int, heading: int) -> bool:
    """Return whether the legs other than `swing` can support the body at a place and heading from their tiles."""
    for a in range(6):
        if a == swing:
            continue
        b = (a + 1) % 6
        if b == swing:
            b = (b + 1) % 6
        both = False
        for w in range(out.shape[4]):
            both = both or (out[heading, a, tiles[a], x, y, w] & out[heading, b, tiles[b], x, y, w]) != 0
        if not both:
            return False
    return True


@compiled
def _add_configuration(
    x: int,
    y: int,
    heading: int,
    tiles: NDArray[np.int64],
    sizes: tuple[int, int, int],
    seen: NDArray[np.uint64],
    codes: NDArray[np.uint64],
    next_open: NDArray[np.int32],
    first_open: NDArray[np.int32],
    count: int,
) -> int:
    """Add a configuration to the open list of its row, unless it was seen before.

    `sizes` are the numbers of squares across, of headings and of tiles. Return the number of configurations, -1 if there are
    too many.
    """
    code = (np.uint64(x) * np.uint64(sizes[0]) + np.uint64(y)) * np.uint64(sizes[1]) + np.uint64(heading)
    for leg in range(6):
        code = code * np.uint64(sizes[2]) + np.uint64(tiles[leg])
    code += np.uint64(1)
    h = (code ^ (code >> np.uint64(31))) * np.uint64(0xFF51AFD7ED558CCD)
    mask = np.uint64(len(seen) - 1)
    at = (h ^ (h >> np.uint64(29))) & mask
    while seen[at] != 0:
        if seen[at] == code:
            return count
        at = (at + np.uint64(1)) & mask
    if count >= len(codes):
        return -1
    seen[at], codes[count], next_open[count], first_open[x] = code, code - np.uint64(1), first_open[x], count
    return count + 1


@compiled
def _grow(
    ground: Tiles,
    standing: NDArray[np.int64],
    y: int,
    heading: int,
    seen: NDArray[np.uint64],
    codes: NDArray[np.uint64],
    next_open: NDArray[np.int32],
    first_open: NDArray[np.int32],
) -> int:
    """Search all configurations: return 1 if the last row of body places is reached, or 0.

    Return -1 if the memory is full. A row is all body places at one distance along the strip. Each row has a linked list of
    open configurations: `first_open` of the row, then `next_open` of each configuration. The furthest row is expanded first.

    Args:
        ground: The tiles.
        standing: (6,) tile of each foot at the start.
        y: Square of the body across the strip, at the start.
        heading: Bin of the body's heading at the start.
        seen: Hash table of the configurations' codes, 0 where free.
        codes: Code of each configuration: body place and six tiles.
        next_open: Next configuration in the list of its row, -1 at the end.
        first_open: First configuration of each row's list, -1 if it is empty.
    """
    out, near, apart, onward, moves = ground
    tiles, steps = standing.copy(), standing.copy()
    sizes = (out.shape[4], out.shape[0], out.shape[2])
    x = 0
    count = _add_configuration(0, y, heading, tiles, sizes, seen, codes, next_open, first_open, 0)
    while x >= 0:
        if first_open[x] < 0:
            x -= 1
            continue
        if x == out.shape[3] - 1:
            return 1
        n = first_open[x]
        first_open[x] = next_open[n]
        code = codes[n]
        for leg in range(5, -1, -1):
            tiles[leg] = code % np.uint64(sizes[2])
            code = code // np.uint64(sizes[2])
        heading = int(code % np.uint64(sizes[1]))
        y = int(code // np.uint64(sizes[1]) % np.uint64(sizes[0]))
        at = x
        for leg in range(-1, 6):
            if leg >= 0 and not _is_supported(out, tiles, leg, at, y, heading):
                continue
            for m in range(len(moves)):
                u, v = at + moves[m, 1], y + moves[m, 2]
                if moves[m, 0] != heading or u < 0 or u >= out.shape[3] or v < 0 or v >= out.shape[4]:
                    continue
                for to in range(max(heading - 1, 0), min(heading + 2, len(out))):  # it turns while all feet stand
                    if leg < 0 and count >= 0 and _is_supported(out, tiles, leg, u, v, to):
                        count = _add_configuration(u, v, to, tiles, sizes, seen, codes, next_open, first_open, count)
                        x = max(x, u)
                if leg >= 0 and not _is_supported(out, tiles, leg, u, v, heading):
                    continue
                for k in range(near.shape[4] if leg >= 0 else 0):
                    t = near[heading, leg, u, v, k]
                    if t < 0:
                        break
                    fits = onward[heading, tiles[leg], t]
                    for other in range(6):
                        fits = fits and (other == leg or apart[tiles[other], t])
                    if not fits:
                        continue
                    steps[:] = tiles
                    steps[leg] = t
                    count = _add_configuration(u, v, heading, steps, sizes, seen, codes, next_open, first_open, count)
                    x = max(x, u)
                    if count < 0:
                        return -1
                if count < 0:
                    return -1
    return 0
