"""Whether there is any way across a strip, decided offline: what every way must have is searched to the end.

**Footholds** are all those that the roadmap may choose (`search.candidates`), in tiles: three of each narrow piece of ground,
about its first and last good place along the strip and its middle. Ground that is wide both ways is one tile. In a tile a foot
may be wherever its leg reaches from where the body is, and may always be set anew. The **body** goes by the roadmap's lattice
and its cone.

**Tests** kept are those of reach, of places, of distance between feet and of support: the centre of mass lies inside the line
through two feet by so much only if both are that far out in the direction across that line, so each foothold has a set of
directions, and a stance holds if those of every two feet beside each other meet. Left out is what could only refuse more:
torque, legs beside each other, trunk, shanks and swings over the ground. So few configurations are left that all can be looked
at; where none of them leads across, there is no way at this discretisation.
"""

import math
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.gap_crossing import roadmap_search
from sextant.services.planner.gap_crossing.roadmap import Crossing, Roadmap, Stance
from sextant.services.planner.gap_crossing.search_tables import legs_of, rules_of
from sextant.services.planner.gap_crossing.settings import PassageSettings
from sextant.services.planner.gap_crossing.strip_map import Field
from sextant.shared.geometry import Array
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.compiled import compiled

_ATTEMPTS = 24  # of the roadmap, with other samples each
_WORDS = 2  # of 64 directions each
_AROUND = 0.35  # [m] from the body, in which its feet are
_WIDE = 0.50  # [m] ground longer and wider than this is one tile
_NARROW = 0.08  # [m] between places of which one piece of ground may have three; what is longer is several pieces
_ROOM = 4_000_000  # configurations
_MOST_TILES, _MOST_SIDES = 255, 63  # that a configuration's code has room for


class Tiles(NamedTuple):
    """What is known of tiles of ground, for the body at each place of its lattice."""

    out: NDArray[np.uint64]  # (6, tiles, nx, ny, 2) directions in which a leg has a foot on a tile as far out as support asks
    near: NDArray[np.int16]  # (6, nx, ny, k) tiles that a leg reaches, -1 for no more
    apart: NDArray[np.bool_]  # (tiles, tiles) whether two feet may stand on them
    onward: NDArray[np.bool_]  # (tiles, tiles) whether a foot may be set from the first onto the second
    moves: NDArray[np.int64]  # (m, 2) of the body, in lattice steps


def passable(
    profile: RobotProfile, settings: PassageSettings, field: Field, stance: Stance, goal_x: float, attempts: int = _ATTEMPTS
) -> bool | None:
    """Whether there is a way: the roadmap finds one in so many attempts, or there can be none; offline, up to a minute.

    Returns:
        None where neither is so: what is left out of `has_way` may stand in the way, or the roadmap has missed it.
    """
    roadmap = Roadmap(profile, settings)
    for seed in range(attempts):
        roadmap.begin(field, stance, goal_x, seed)
        while (found := roadmap.grow(settings.budget)) is None:
            pass
        if isinstance(found, Crossing) and found.complete:
            return True
    return False if has_way(profile, settings, field, stance, goal_x) is False else None


def has_way(
    profile: RobotProfile, settings: PassageSettings, field: Field, stance: Stance, goal_x: float, room: int = _ROOM
) -> bool | None:
    """Whether there is a way but for what is left out here; where there is none, the roadmap has none at these footholds.

    Args:
        profile: The robot.
        settings: Of the roadmap.
        field: The strip, all of it known, its cells as wide as the body's lattice.
        stance: To begin with.
        goal_x: [m] {strip} where the body shall be.
        room: Most configurations.

    Returns:
        None where there are more.

    Raises:
        ValueError: A foot to begin with stands on nothing, or cells and lattice are not alike.
    """
    rules = rules_of(profile, settings)
    tile = _cut(field, settings)
    start = np.rint(stance.body[:2] / rules.lattice).astype(np.int64)
    sides = max(math.floor(rules.drift / rules.lattice + 1e-6), abs(int(start[1])))
    size = math.ceil(goal_x / rules.lattice - 1e-6) - int(start[0]) + 1, 2 * sides + 1
    if tile.max() >= _MOST_TILES or size[1] > _MOST_SIDES:
        return None
    cells = np.floor((stance.feet[:, :2] - field.corner) / field.resolution + 0.5).astype(int)
    standing = tile[cells[:, 0], cells[:, 1]]
    if (standing < 0).any():
        raise ValueError(f"feet on footholds expected, found {stance.feet[standing < 0]}")
    tiles = _tiles(profile, settings, field, tile, (int(start[0]), -sides), size)
    known = np.zeros(1 << math.ceil(math.log2(2 * room)), dtype=np.uint64)
    node, after, first = np.zeros(room, np.uint64), np.zeros(room, np.int32), np.full(size[0], -1, np.int32)
    found = _grow(tiles, standing.astype(np.int64), int(start[1]) + sides, known, node, after, first)
    return None if found < 0 else found > 0


def _cut(field: Field, settings: PassageSettings) -> NDArray[np.int16]:
    """The tile (nx, ny) of each cell that a foot may be set on, -1 elsewhere: one of wide ground, three of a narrow piece."""
    carries = np.zeros(field.evaluation.shape, dtype=np.bool_)
    roadmap_search.candidates(field.evaluation, settings.strong, settings.wide, settings.weakest, carries)
    part = np.full(carries.shape, -1, dtype=np.int16)
    tile, tiles = part.copy(), 0
    for k in range(_label(carries, part)):
        cells = np.argwhere(part == k)
        extent = (np.ptp(cells, axis=0) + 1) * field.resolution
        if (extent > _WIDE).all():
            tile[tuple(cells.T)] = tiles
            tiles += 1
            continue
        pieces = np.ceil(extent / _NARROW - 1e-6).astype(int)
        which = (cells - cells.min(axis=0)) * pieces // (np.ptp(cells, axis=0) + 1)
        for piece in np.unique(which, axis=0):
            inside = cells[(which == piece).all(axis=1)]
            low, high = inside.min(axis=0), inside.max(axis=0)
            rows = np.unique([low[0], (low[0] + high[0]) // 2, high[0]])
            found, nearest = np.unique(np.abs(inside[:, :1] - rows).argmin(axis=1), return_inverse=True)
            tile[tuple(inside.T)] = tiles + nearest  # none is left out
            tiles += len(found)
    return tile


def _tiles(
    profile: RobotProfile,
    settings: PassageSettings,
    field: Field,
    tile: NDArray[np.int16],
    corner: tuple[int, int],
    size: tuple[int, int],
) -> Tiles:
    """All about tiles (nx, ny of cells), for so many places of the body from a corner of the lattice on."""
    rules, count = rules_of(profile, settings), int(tile.max()) + 1
    if abs(rules.lattice - field.resolution) > 1e-9:
        raise ValueError(f"cells as wide as the body's lattice, {rules.lattice} m, expected, found {field.resolution} m")
    # 1. Where feet may be from the body, and in which directions they are far enough out; then the same for tiles.
    carrying = field.elevation[tile >= 0]
    low, high = float(carrying.min()), float(carrying.max())
    window = _window(profile, settings, np.array(field.corner), low - high)
    out = np.zeros((6, count, *size, _WORDS), dtype=np.uint64)
    first = np.floor(np.array(field.corner) / rules.lattice + 1e-9).astype(np.int64) - corner
    level = np.rint(np.where(tile >= 0, field.elevation - high, 0.0) / rules.lattice).astype(np.int64) + (window.shape[1] - 1)
    _reach(window, tile, level, first, window.shape[2] // 2, out)
    # 2. Those that each leg reaches come first in its list.
    reached = out.any(axis=-1)  # (6, tiles, nx, ny)
    near = np.argsort(~reached, axis=1, kind="stable")[:, : int(reached.sum(axis=1).max())]
    near = np.where(np.take_along_axis(reached, near, axis=1), near, -1).astype(np.int16)
    # 3. Tiles beside each other, and the body's cone.
    ends = np.array([[f(np.argwhere(tile == t), axis=0) for f in (np.min, np.max)] for t in range(count)])
    widest = np.maximum(ends[:, None, 1] - ends[None, :, 0], ends[None, :, 1] - ends[:, None, 0]) * field.resolution
    apart = np.linalg.norm(widest, axis=-1) >= rules.feet_apart - 1e-9
    onward = (ends[None, :, 1, 0] - ends[:, None, 0, 0]) * field.resolution >= -rules.backward - 1e-9
    distance, phi = np.meshgrid(np.linspace(0.0, rules.body_high, 200), rules.body_angle * np.linspace(-1.0, 1.0, 200))
    steps = np.stack([distance * np.cos(phi), distance * np.sin(phi)], axis=-1).reshape(-1, 2)
    moves = np.unique(np.rint(steps / rules.lattice).astype(np.int64), axis=0)
    return Tiles(out, np.ascontiguousarray(near.transpose(0, 2, 3, 1)), apart, onward, moves)


def _window(profile: RobotProfile, settings: PassageSettings, corner: Array, lowest: float) -> NDArray[np.uint64]:
    """Directions (6, levels, n, n, words) in which a leg has a foot far enough out, none where it does not reach.

    Args:
        profile: The robot.
        settings: Of the roadmap.
        corner: (2,) [m] a place of a foot whose offset from the body's lattice all have.
        lowest: [m] of ground under the level of the body's floor; the highest is as far over it.
    """
    rules, legs = rules_of(profile, settings), legs_of(profile, settings)
    levels = rules.lattice * np.arange(
        -math.ceil(-lowest / rules.lattice - 1e-6), math.ceil(-lowest / rules.lattice - 1e-6) + 1
    )
    k = math.ceil(_AROUND / rules.lattice)
    lattice = rules.lattice * np.stack(np.meshgrid(*[np.arange(-k, k + 1)] * 2, indexing="ij"), axis=-1)
    off = lattice + corner - rules.lattice * np.floor(corner / rules.lattice + 1e-9)
    window = np.zeros((6, len(levels), *off.shape[:2], _WORDS), dtype=np.uint64)
    centre = np.array([rules.centre_x, rules.centre_y])
    bits, found = _directions(off - centre, rules.margin), np.zeros(off.shape[0] * off.shape[1], dtype=np.int64)
    for leg, (n, level) in product(range(6), enumerate(levels)):
        z = np.full(off.shape[:2], level + rules.foot_radius - rules.height)
        roadmap_search.landings(legs, leg, np.ascontiguousarray(np.dstack([off, z]).reshape(-1, 3)), found)
        window[leg, n] = np.where((found == roadmap_search.OK).reshape(off.shape[:2])[..., None], bits, np.uint64(0))
    return window


def _directions(off: Array, margin: float) -> NDArray[np.uint64]:
    """Directions (..., words) in which places (..., 2) [m] are as far out as a margin [m], as bits.

    Between two that are told apart lie others: each stands for those half way to its neighbours.
    """
    n = 64 * _WORDS
    angle = 2.0 * np.pi / n * np.arange(n)
    distance = np.linalg.norm(off, axis=-1)
    most = np.where(distance >= margin, np.arccos(np.minimum(margin / np.maximum(distance, margin), 1.0)) + np.pi / n, -1.0)
    turn = np.abs((np.arctan2(off[..., 1], off[..., 0])[..., None] - angle + np.pi) % (2.0 * np.pi) - np.pi)
    flags = (turn <= most[..., None] + 1e-9).reshape(*off.shape[:-1], _WORDS, 64)
    return np.asarray((flags * (np.uint64(1) << np.arange(64, dtype=np.uint64))).sum(axis=-1, dtype=np.uint64))


@compiled
def _label(carries: NDArray[np.bool_], part: NDArray[np.int16]) -> int:
    """Number the pieces of ground that hang together; how many there are."""
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
def _reach(
    window: NDArray[np.uint64],
    tile: NDArray[np.int16],
    level: NDArray[np.int64],
    first: NDArray[np.int64],
    k: int,
    out: NDArray[np.uint64],
) -> None:
    """Gather what cells tell into their tiles; cell (0, 0) is at a place `first` of the body's, k places are around it.

    A cell is so many levels over the lowest that the body's floor may be at; the floor may be at any.
    """
    levels = (window.shape[1] + 1) // 2
    for i in range(tile.shape[0]):
        for j in range(tile.shape[1]):
            t = tile[i, j]
            if t < 0:
                continue
            for x in range(max(i + first[0] - k, 0), min(i + first[0] + k + 1, out.shape[2])):
                for y in range(max(j + first[1] - k, 0), min(j + first[1] + k + 1, out.shape[3])):
                    for floor in range(levels):
                        for leg in range(6):
                            for w in range(out.shape[4]):
                                out[leg, t, x, y, w] |= window[
                                    leg, level[i, j] - floor, i + first[0] - x + k, j + first[1] - y + k, w
                                ]


@compiled
def _holds(out: NDArray[np.uint64], tiles: NDArray[np.int64], swing: int, x: int, y: int) -> bool:
    """Whether the legs that stand may have their feet where the body is, with support."""
    for a in range(6):
        if a == swing:
            continue
        b = (a + 1) % 6
        if b == swing:
            b = (b + 1) % 6
        both = False
        for w in range(out.shape[4]):
            both = both or (out[a, tiles[a], x, y, w] & out[b, tiles[b], x, y, w]) != 0
        if not both:
            return False
    return True


@compiled
def _note(
    x: int,
    y: int,
    tiles: NDArray[np.int64],
    known: NDArray[np.uint64],
    node: NDArray[np.uint64],
    after: NDArray[np.int32],
    first: NDArray[np.int32],
    nodes: int,
) -> int:
    """Put a configuration among those to be looked at, unless it is known; how many there are now, -1 for too many."""
    code = np.uint64(x) << np.uint64(6) | np.uint64(y)
    for leg in range(6):
        code = code << np.uint64(8) | np.uint64(tiles[leg])
    code += np.uint64(1)
    h = (code ^ (code >> np.uint64(31))) * np.uint64(0xFF51AFD7ED558CCD)
    mask = np.uint64(len(known) - 1)
    at = (h ^ (h >> np.uint64(29))) & mask
    while known[at] != 0:
        if known[at] == code:
            return nodes
        at = (at + np.uint64(1)) & mask
    if nodes >= len(node):
        return -1
    known[at], node[nodes], after[nodes], first[x] = code, code - np.uint64(1), first[x], nodes
    return nodes + 1


@compiled
def _grow(
    ground: Tiles,
    standing: NDArray[np.int64],
    y: int,
    known: NDArray[np.uint64],
    node: NDArray[np.uint64],
    after: NDArray[np.int32],
    first: NDArray[np.int32],
) -> int:
    """Whether the body's last row of places is reached (1), not (0), or there is no room to tell (-1).

    Lists of what is to be looked at, by the body's row: first of each, and after each; the furthest is taken first.
    """
    out, near, apart, onward, moves = ground
    tiles, steps = standing.copy(), standing.copy()
    x = 0
    nodes = _note(0, y, tiles, known, node, after, first, 0)
    while x >= 0:
        if first[x] < 0:
            x -= 1
            continue
        if x == out.shape[2] - 1:
            return 1
        n = first[x]
        first[x] = after[n]
        code = node[n]
        for leg in range(5, -1, -1):
            tiles[leg] = code & np.uint64(255)
            code = code >> np.uint64(8)
        y = code & np.uint64(63)
        at = x
        for leg in range(-1, 6):
            if leg >= 0 and not _holds(out, tiles, leg, at, y):
                continue
            for m in range(len(moves)):
                u, v = at + moves[m, 0], y + moves[m, 1]
                if u >= out.shape[2] or v < 0 or v >= out.shape[3] or not _holds(out, tiles, leg, u, v):
                    continue
                if leg < 0:
                    nodes = _note(u, v, tiles, known, node, after, first, nodes)
                    x = max(x, u)
                for k in range(near.shape[3] if leg >= 0 else 0):
                    t = near[leg, u, v, k]
                    if t < 0:
                        break
                    fits = onward[tiles[leg], t]
                    for other in range(6):
                        fits = fits and (other == leg or apart[tiles[other], t])
                    if not fits:
                        continue
                    steps[:] = tiles
                    steps[leg] = t
                    nodes = _note(u, v, steps, known, node, after, first, nodes)
                    x = max(x, u)
                    if nodes < 0:
                        return -1
                if nodes < 0:
                    return -1
    return 0
