"""The roadmap's search, compiled: robot configurations that grow from the root over body motions and footholds.

Masri 2016, chapter 5, with what it leaves out. All of it is one file, since compiled functions must not call across files.

The search is lazy. A new configuration has passed what is cheap to know: reach and limits of all legs, support, torque, places
of its feet. What is dear, the swing and the distances of legs to each other and to the ground, is proven when its turn comes.
A configuration that was expanded for the leg whose turn it is comes back later, at a price, for the next leg in order.

Joint limits are tested without inverse trigonometry: on directions, by the signs of cross products, and on the knee's cosine.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.compiled import compiled
from shared.geometry import Array

OK, REACH, UNDER, LEVEL, APART, FOOTHOLD, UNKNOWN, MARGIN, TORQUE, LEGS, GROUND, SWING = range(12)  # tests, by what fails
TESTS = 12
OPEN, PROVEN, REFUSED = 0, 1, 2  # what is known of the step to a configuration
NODES, QUEUED, EXPANDED, BEST, GOAL, FURTHEST, PROVED = range(7)  # places in `Tree.counts`
COUNTS = 7
ALL_STAND = -1  # in place of the leg that swings
ROOT_FOOT = -1  # in place of a cell: the foot has not moved since the root
_NEVER_SEEN = 127
_SAMPLES = 9  # of a swing
_PAIR = 2


class Legs(NamedTuple):
    """What the tests know of the legs. Leading axis 2: within limits by a spare, and by the limits themselves."""

    mount: Array  # (6, 3) [m] {body}
    yaw: Array  # (6, 2) cosine and sine of the neutral direction
    coxa: Array  # (2, 6, 5) directions of the lower and upper limit as (cos, sin, cos, sin), 1 if more than half a turn apart
    femur: Array  # (2, 6, 5) likewise
    knee: Array  # (2, 6, 2) least and greatest cosine of the tibia angle
    way: Array  # (2, 6, 2) [m] shortest and longest way from femur axis to foot
    rest: Array  # (6, 2) [m] {body} nominal feet
    stroke: Array  # (6,) [m] by which a foot may fall back behind its nominal place
    fore: NDArray[np.int64]  # (6,) 1 for front legs, -1 for rear legs, 0 between
    order: NDArray[np.int64]  # (6,) in which legs take turns
    place: NDArray[np.int64]  # (6,) of each leg in that order
    swing: Array  # (3, 9) of a swing: share of the time, share of the way, share of the height


class Rules(NamedTuple):
    """Lengths and limits of the tests, in SI units."""

    coxa: float
    femur: float
    tibia: float
    foot_radius: float
    half_length: float  # of the body
    half_width: float
    half_height: float
    weight: float  # [N]
    torque: float  # [N m] that a servo may give
    easy_torque: float  # [N m] that it may give for hours
    height: float  # [m] of the body over the floor
    climb: float  # [m] of the body in a step
    margin: float  # [m] of the body's centre inside its standing feet
    feet_apart: float
    legs_apart: float
    body_clear: float
    leg_clear: float
    swing_clear: float
    least_lift: float
    most_lift: float
    lift_step: float
    moved_most: float  # [m] by which a point of a swing may be moved into reach
    lattice: float  # [m] of body places
    alike_body: float  # [m] edge of the squares in which body places count as one
    alike_foot: int  # [cells] likewise for feet
    body_low: float  # [m] d_bmin
    body_high: float  # [m] d_bmax
    body_angle: float  # [rad] alpha
    foot_low: float  # [m] d_lmin
    foot_high: float  # [m] d_lmax
    foot_angle: float  # [rad] beta
    foot_back: float  # [m] from the nominal place back to the tip of the cone of footholds
    strong: int  # [cells] F from which a place is taken as it is
    wide: int  # [cells] F of a local minimum from which ground is wide
    weakest: int  # [cells] F that a local minimum must have
    drift: float  # [m] Delta y
    depth: int  # most steps
    step_gain: float  # [m] by which a step brings robot and feet on, for the cost to go
    eager: float  # weight of the cost to go
    lag_price: float  # of a foot that has its whole stroke behind it
    turn_price: float
    still_price: float  # of a step in which all stand
    foothold_price: float
    margin_price: float
    torque_price: float
    aside_price: float
    move_samples: int  # m
    foot_samples: int  # n
    rounds: int  # of all legs that one configuration may have
    backward: float  # [m] that a foot may be set back


class Ground(NamedTuple):
    """The strip: cell (i, j) is centred at (x0, y0) + resolution * (i, j) {strip}."""

    elevation: NDArray[np.float32]  # (nx, ny) [m] {strip}, NaN where unknown
    top: NDArray[np.float32]  # (nx, ny) [m] highest within a cell around, -inf where nothing is known
    evaluation: NDArray[np.int8]  # (nx, ny) Masri's F
    candidate: NDArray[np.bool_]  # (nx, ny) footholds of the exhaustive search
    resolution: float
    x0: float
    y0: float


class Tree(NamedTuple):
    """Configurations, queue and table of those known; `counts` and `fails` tell what happened."""

    root: Array  # (6, 3) [m] {strip} feet
    body: Array  # (n, 3) [m] {strip}
    foot: NDArray[np.int32]  # (n, 6) cell, or ROOT_FOOT
    parent: NDArray[np.int32]  # (n,)
    leg: NDArray[np.int8]  # (n,) that swung to get here
    depth: NDArray[np.int16]  # (n,)
    state: NDArray[np.int8]  # (n,)
    cost: Array  # (n,) of the way here
    lift: Array  # (n,) [m] clearance of the swing to here
    margin: Array  # (n,) [m] of the step to here
    key: Array  # (q,) of the queue, a binary heap
    queued: NDArray[np.int32]  # (q,)
    turn: NDArray[np.int16]  # (q,)
    table: NDArray[np.int32]  # (2^k,) nodes by hash, -1 empty
    counts: NDArray[np.int64]  # (7,)
    fails: NDArray[np.int64]  # (2, tests, 7) over all, and by those as far as any; last axis legs, then none
    random: NDArray[np.uint64]  # (1,)
    goal: Array  # (1,) [m] {strip} x of the body


# Random numbers -------------------------------------------------------------------------------------------------------------


@compiled
def _uniform(state: NDArray[np.uint64]) -> float:
    """In [0, 1), by xorshift64*."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return float((x * np.uint64(2685821657736338717)) >> np.uint64(11)) / 9007199254740992.0


@compiled
def _bell(state: NDArray[np.uint64]) -> float:
    """In [-1, 1]: the sum of three uniform ones, a Gaussian of a third within its bounds (Masri 2016, eq. 5.2 and 5.4)."""
    return (_uniform(state) + _uniform(state) + _uniform(state)) / 1.5 - 1.0


# Tests of one leg -----------------------------------------------------------------------------------------------------------


@compiled
def _between(c: float, s: float, limit: Array) -> bool:
    """Whether a direction lies between two limits; it need not have length one."""
    after = limit[0] * s - limit[1] * c >= 0.0
    before = c * limit[3] - s * limit[2] >= 0.0
    return bool((after or before) if limit[4] > 0.0 else (after and before))


@compiled
def _leg(
    legs: Legs, rules: Rules, strict: int, leg: int, bx: float, by: float, bz: float, fx: float, fy: float, fz: float
) -> tuple[int, float, float, float, float, float, float]:
    """Whether a leg can hold its foot (fx, fy, fz) with the body at (bx, by, bz), both {strip}.

    Returns:
        OK or REACH; horizontal reach from the femur axis and the shank's part of it [m]; femur axis and knee as the
        direction (ux, uy) of the leg {body}, and the knee's reach and height from the femur axis.

    Source: Masri 2016, eq. (3.3)-(3.10) and (3.14)-(3.16), as `shared.kinematics` reads them.
    """
    px, py, z = fx - bx - legs.mount[leg, 0], fy - by - legs.mount[leg, 1], fz - bz - legs.mount[leg, 2]
    out = math.sqrt(px * px + py * py)
    reach = out - rules.coxa
    d2 = reach * reach + z * z
    f, t = rules.femur, rules.tibia
    knee = (d2 - f * f - t * t) / (2.0 * f * t)
    if out < 1e-6 or knee < legs.knee[strict, leg, 0] or knee > legs.knee[strict, leg, 1]:
        return REACH, reach, 0.0, 1.0, 0.0, 0.0, 0.0
    across = -t * math.sqrt(max(1.0 - knee * knee, 0.0))
    along = f + t * knee
    # Direction of the femur, times the squared way.
    fc, fs = reach * along + z * across, z * along - reach * across
    c, s = legs.yaw[leg, 0], legs.yaw[leg, 1]
    ok = _between(px * c + py * s, py * c - px * s, legs.coxa[strict, leg]) and _between(fc, fs, legs.femur[strict, leg])
    knee_out, knee_up = f * fc / d2, f * fs / d2
    return (OK if ok else REACH), reach, reach - knee_out, px / out, py / out, knee_out, knee_up


@compiled
def _placed(legs: Legs, rules: Rules, leg: int, x: float, y: float) -> int:
    """Whether a foot at (x, y) {body} may be there (Masri 2016, sections 5.1.1 and 5.2.1).

    Not under the body; front feet not behind its front, rear feet not before its rear. What that guards is balance, which
    the support margin measures; so the level is that of the leg's own axis, and no more than the thesis' joint limits say.
    """
    if abs(x) < rules.half_length and abs(y) < rules.half_width:
        return UNDER
    if legs.fore[leg] * (x - legs.mount[leg, 0]) < 0.0:
        return LEVEL
    return OK


@compiled
def _foot(tree: Tree, ground: Ground, rules: Rules, code: int, leg: int) -> tuple[float, float, float]:
    """Centre of a standing foot [m] {strip}."""
    if code == ROOT_FOOT:
        return tree.root[leg, 0], tree.root[leg, 1], tree.root[leg, 2]
    ny = ground.evaluation.shape[1]
    i, j = code // ny, code % ny
    z = float(ground.elevation[i, j]) + rules.foot_radius
    return ground.x0 + i * ground.resolution, ground.y0 + j * ground.resolution, z


# Tests of the stance --------------------------------------------------------------------------------------------------------


@compiled
def _support(feet: Array, swing: int, bx: float, by: float) -> float:
    """How far [m] a body's centre is inside the feet (6, 3) that stand, by the edges from leg to leg around the body.

    Where a foot stands inside the hull of the others that is less than its distance from the hull, never more.
    """
    least = np.inf
    for a in range(6):
        if a == swing:
            continue
        b = (a + 1) % 6
        if b == swing:
            b = (b + 1) % 6
        # Legs go clockwise: inside is to the right of each edge.
        ex, ey = feet[b, 0] - feet[a, 0], feet[b, 1] - feet[a, 1]
        length = math.sqrt(ex * ex + ey * ey)
        if length < 1e-6:
            return -np.inf
        least = min(least, (ey * (bx - feet[a, 0]) - ex * (by - feet[a, 1])) / length)
    return least


@compiled
def _floor(feet: Array, swing: int, radius: float) -> float:
    """Mean height [m] of the three highest standing feet's soles (Lotriet 2024, section 6.4)."""
    a = b = c = -np.inf
    for leg in range(6):
        if leg == swing:
            continue
        z = feet[leg, 2]
        if z > a:
            a, b, c = z, a, b
        elif z > b:
            b, c = z, b
        elif z > c:
            c = z
    return (a + b + c) / 3.0 - radius


@compiled
def _stands(
    legs: Legs, rules: Rules, codes: Array, feet: Array, swing: int, bx: float, by: float, bz: float, loads: bool
) -> tuple[int, int, float]:
    """Whether the standing legs hold a body: the test that fails, the leg, and the greatest torque [N m].

    Feet share the weight as springs under a stiff body do: by a plane over their places that balances it.
    """
    n = 0
    mx = my = 0.0
    for leg in range(6):
        if leg != swing:
            mx, my, n = mx + feet[leg, 0], my + feet[leg, 1], n + 1
    mx, my = mx / n, my / n
    sxx = sxy = syy = 0.0
    for leg in range(6):
        if leg != swing:
            dx, dy = feet[leg, 0] - mx, feet[leg, 1] - my
            sxx, sxy, syy = sxx + dx * dx, sxy + dx * dy, syy + dy * dy
    determinant = sxx * syy - sxy * sxy
    if determinant < 1e-9:
        return MARGIN, ALL_STAND, 0.0
    gx, gy = bx - mx, by - my
    kx, ky = (syy * gx - sxy * gy) / determinant, (sxx * gy - sxy * gx) / determinant
    worst = 0.0
    for leg in range(6):
        if leg == swing:
            continue
        at_root = codes[leg] == ROOT_FOOT
        x, y = feet[leg, 0], feet[leg, 1]
        test, reach, shank, _, _, _, _ = _leg(legs, rules, 1 if at_root else 0, leg, bx, by, bz, x, y, feet[leg, 2])
        if test == OK and not at_root:
            test = _placed(legs, rules, leg, x - bx, y - by)
        if test != OK:
            return test, leg, 0.0
        force = rules.weight * max(1.0 / n + kx * (x - mx) + ky * (y - my), 0.0)
        torque = force * max(abs(reach), abs(shank))
        if loads and torque > rules.torque:
            return TORQUE, leg, torque
        worst = max(worst, torque)
    return OK, ALL_STAND, worst


# Footholds ------------------------------------------------------------------------------------------------------------------


@compiled
def _lower(F: NDArray[np.int8], i: int, j: int) -> tuple[int, int]:
    """The least of a cell and its eight neighbours."""
    bi, bj = i, j
    for a in range(max(i - 1, 0), min(i + 2, F.shape[0])):
        for b in range(max(j - 1, 0), min(j + 2, F.shape[1])):
            if F[a, b] < F[bi, bj]:
                bi, bj = a, b
    return bi, bj


@compiled
def _resolved(F: NDArray[np.int8], i: int, j: int, strong: int, wide: int) -> tuple[int, int]:
    """The foothold that a sampled cell stands for: by greedy descent of F (Masri 2016, section 5.2.1).

    On wide ground, whose minimum is low, a cell that is good enough is its own, another is the first on its descent that is.
    Narrow ground has its middle, the local minimum, and along the strip its first and last good cells: who must reach far
    takes those. Of a minimum two cells wide the lower numbers are the middle.
    """
    a, b = i, j
    good_i, good_j, good = i, j, F[i, j] <= strong
    while True:
        c, d = _lower(F, a, b)
        if c == a and d == b:
            break
        a, b = c, d
        if not good and F[a, b] <= strong:
            good_i, good_j, good = a, b, True
    if F[a, b] <= wide:
        return good_i, good_j
    here = F[a, b]
    if a > 0 and F[a - 1, b] == here:
        a -= 1
    if b > 0 and F[a, b - 1] == here:
        b -= 1
    if F[i, j] <= strong:
        if i < a:
            while a > 0 and F[a - 1, b] <= strong:
                a -= 1
        elif i > a + 1:
            while a < F.shape[0] - 1 and F[a + 1, b] <= strong:
                a += 1
    return a, b


@compiled
def candidates(F: NDArray[np.int8], strong: int, wide: int, weakest: int, coarse: int, candidate: NDArray[np.bool_]) -> None:
    """Mark the footholds that an exhaustive search tries: all of narrow ground, and of wide ground every so many cells."""
    candidate[:] = False
    for i in range(F.shape[0]):
        for j in range(F.shape[1]):
            if F[i, j] == _NEVER_SEEN:
                continue
            a, b = _resolved(F, i, j, strong, wide)
            if F[a, b] > weakest:
                continue
            c, d = a, b
            while True:
                e, f = _lower(F, c, d)
                if e == c and f == d:
                    break
                c, d = e, f
            if F[c, d] > wide or (b % coarse == 0 and (a % coarse == 0 or F[a, b] == strong)):
                candidate[a, b] = True


# Legs in space --------------------------------------------------------------------------------------------------------------


@compiled
def _squared_between(p: Array, q: Array, r: Array, s: Array) -> float:
    """Squared distance [m^2] of the segments p-q and r-s (Ericson, Real-Time Collision Detection, section 5.1.9)."""
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = s[0] - r[0], s[1] - r[1], s[2] - r[2]
    wx, wy, wz = p[0] - r[0], p[1] - r[1], p[2] - r[2]
    a, e, b = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, ux * vx + uy * vy + uz * vz
    c, f = ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
    denominator = a * e - b * b
    m = min(max((b * f - c * e) / denominator, 0.0), 1.0) if denominator > 1e-12 else 0.0
    k = (b * m + f) / e
    if k < 0.0:
        k, m = 0.0, min(max(-c / a, 0.0), 1.0)
    elif k > 1.0:
        k, m = 1.0, min(max((b - c) / a, 0.0), 1.0)
    dx, dy, dz = wx + ux * m - vx * k, wy + uy * m - vy * k, wz + uz * m - vz * k
    return float(dx * dx + dy * dy + dz * dz)


@compiled
def _pose(legs: Legs, rules: Rules, leg: int, bx: float, by: float, bz: float, foot: Array, points: Array) -> int:
    """Femur axis, knee and foot of a leg into points (3, 3) [m] {strip}; REACH where it cannot, by its limits themselves."""
    test, _, _, ux, uy, out, up = _leg(legs, rules, 1, leg, bx, by, bz, foot[0], foot[1], foot[2])
    x, y, z = bx + legs.mount[leg, 0], by + legs.mount[leg, 1], bz + legs.mount[leg, 2]
    points[0, 0], points[0, 1], points[0, 2] = x + rules.coxa * ux, y + rules.coxa * uy, z
    points[1, 0], points[1, 1], points[1, 2] = x + (rules.coxa + out) * ux, y + (rules.coxa + out) * uy, z + up
    points[2, 0], points[2, 1], points[2, 2] = foot[0], foot[1], foot[2]
    return test


@compiled
def _legs_collide(a: Array, b: Array, apart: float) -> bool:
    """Whether femur or tibia of one leg (3, 3) come nearer to those of another than so much [m]."""
    for k in range(2):
        for m in range(2):
            if _squared_between(a[k], a[k + 1], b[m], b[m + 1]) < apart * apart:
                return True
    return False


@compiled
def _top(ground: Ground, x: float, y: float) -> float:
    """Highest known ground [m] within a cell of a place, -inf where none is."""
    i, j = (
        math.floor((x - ground.x0) / ground.resolution + 0.5),
        math.floor((y - ground.y0) / ground.resolution + 0.5),
    )
    if i < 0 or j < 0 or i >= ground.top.shape[0] or j >= ground.top.shape[1]:
        return -np.inf
    return float(ground.top[i, j])


@compiled
def _shank_clear(ground: Ground, points: Array, clear: float) -> bool:
    """Whether a leg's tibia and knee (3, 3) stay over the ground by so much [m]; near its foot the foot's place counts."""
    for k in range(1, 5):
        s = 0.25 * k
        x, y = points[2, 0] + s * (points[1, 0] - points[2, 0]), points[2, 1] + s * (points[1, 1] - points[2, 1])
        if points[2, 2] + s * (points[1, 2] - points[2, 2]) - _top(ground, x, y) < clear:
            return False
    return True


@compiled
def _body_clear(ground: Ground, rules: Rules, bx: float, by: float, bz: float) -> bool:
    """Whether the trunk stays over all ground under it."""
    least = bz - rules.half_height - rules.body_clear
    x = -rules.half_length
    while x <= rules.half_length + 1e-9:
        y = -rules.half_width
        while y <= rules.half_width + 1e-9:
            if _top(ground, bx + x, by + y) > least:
                return False
            y += 2.0 * ground.resolution  # `top` looks a cell around
        x += 2.0 * ground.resolution
    return True


@compiled
def _into_reach(legs: Legs, rules: Rules, leg: int, bx: float, by: float, bz: float, foot: Array) -> float:
    """Move a foot (3,) to the nearest place that its leg's knee allows; by how much [m] (Masri 2016, section 5.4)."""
    x, y, z = bx + legs.mount[leg, 0], by + legs.mount[leg, 1], foot[2] - bz - legs.mount[leg, 2]
    px, py = foot[0] - x, foot[1] - y
    out = max(math.sqrt(px * px + py * py), 1e-6)
    reach = out - rules.coxa
    way = math.sqrt(reach * reach + z * z)
    short, far = legs.way[1, leg, 0] + 1e-4, legs.way[1, leg, 1] - 1e-4
    if short <= way <= far:
        return 0.0
    if way > far:
        new, new_z = reach * far / way, z * far / way
    else:
        new, new_z = math.sqrt(max(short * short - z * z, 0.0)), z
    scale = (rules.coxa + new) / out
    foot[0], foot[1], foot[2] = x + px * scale, y + py * scale, foot[2] + new_z - z
    return math.sqrt((new - reach) ** 2 + (new_z - z) ** 2)


# The lazy proof of a step ---------------------------------------------------------------------------------------------------


@compiled
def _swing_test(
    legs: Legs, rules: Rules, ground: Ground, feet: Array, goal: Array, leg: int, b0: Array, b1: Array, lift: float
) -> int:
    """Whether a swing with a clearance may be flown: in reach, over the ground, beside its neighbours."""
    way = np.empty((_SAMPLES, 3))
    foot = np.empty(3)
    own, other = np.empty((3, 3)), np.empty((3, 3))
    level = max(feet[leg, 2], goal[2]) + 0.8 * lift
    for k in range(_SAMPLES):
        s, along, up = legs.swing[0, k], legs.swing[1, k], legs.swing[2, k]
        end_z = feet[leg, 2] if k < _SAMPLES // 2 else goal[2]
        foot[0] = feet[leg, 0] + along * (goal[0] - feet[leg, 0])
        foot[1] = feet[leg, 1] + along * (goal[1] - feet[leg, 1])
        foot[2] = end_z + up * (level - end_z)
        bx, by, bz = b0[0] + s * (b1[0] - b0[0]), b0[1] + s * (b1[1] - b0[1]), b0[2] + s * (b1[2] - b0[2])
        if _into_reach(legs, rules, leg, bx, by, bz, foot) > (rules.moved_most if 0 < k < _SAMPLES - 1 else 0.0) + 1e-3:
            return REACH
        way[k] = foot
        if _pose(legs, rules, leg, bx, by, bz, foot, own) != OK and k > 0:
            return REACH
        if not _shank_clear(ground, own, rules.leg_clear):
            return GROUND
        for side in (1, 5):
            beside = (leg + side) % 6
            _pose(legs, rules, beside, bx, by, bz, feet[beside], other)
            if _legs_collide(own, other, rules.legs_apart):
                return LEGS
    # The foot's own way, every centimetre: 2 cm over the ground, but for its rise and its fall.
    for k in range(_SAMPLES - 1):
        dx, dy = way[k + 1, 0] - way[k, 0], way[k + 1, 1] - way[k, 1]
        pieces = 1 + int(math.sqrt(dx * dx + dy * dy) / ground.resolution)
        for m in range(pieces + 1):
            s = m / pieces
            x, y, z = way[k, 0] + s * dx, way[k, 1] + s * dy, way[k, 2] + s * (way[k + 1, 2] - way[k, 2])
            off = min((x - way[0, 0]) ** 2 + (y - way[0, 1]) ** 2, (x - goal[0]) ** 2 + (y - goal[1]) ** 2)
            needed = min(rules.swing_clear, 0.5 * math.sqrt(off) - 0.005)
            if z - rules.foot_radius - _top(ground, x, y) < needed:
                return SWING
    return OK


@compiled
def _proof(legs: Legs, rules: Rules, ground: Ground, tree: Tree, node: int) -> int:
    """Prove the step that leads to a configuration and note its clearance; the test that fails, or OK."""
    parent, leg = tree.parent[node], tree.leg[node]
    feet, goal = np.empty((6, 3)), np.empty(3)
    for k in range(6):
        feet[k] = _foot(tree, ground, rules, tree.foot[parent, k], k)
    b0, b1 = tree.body[parent], tree.body[node]
    if not _body_clear(ground, rules, b1[0], b1[1], b1[2]):
        return GROUND
    # Standing legs beside each other, half way and at the end.
    poses = np.empty((6, 3, 3))
    for half in range(1, 3):
        s = 0.5 * half
        bx, by, bz = b0[0] + s * (b1[0] - b0[0]), b0[1] + s * (b1[1] - b0[1]), b0[2] + s * (b1[2] - b0[2])
        for k in range(6):
            if k != leg:
                _pose(legs, rules, k, bx, by, bz, feet[k], poses[k])
                if not _shank_clear(ground, poses[k], rules.leg_clear):
                    return GROUND
        for k in range(6):
            after = (k + 1) % 6
            if leg not in (k, after) and _legs_collide(poses[k], poses[after], rules.legs_apart):
                return LEGS
    if leg == ALL_STAND:
        return OK
    goal[:] = _foot(tree, ground, rules, tree.foot[node, leg], leg)
    lift, test = rules.least_lift, SWING
    while lift <= rules.most_lift + 1e-9:
        test = _swing_test(legs, rules, ground, feet, goal, leg, b0, b1, lift)
        if test == OK:
            tree.lift[node] = lift
            return OK
        lift += rules.lift_step
    return test


# Queue and table ------------------------------------------------------------------------------------------------------------


@compiled
def _push(tree: Tree, key: float, node: int, turn: int) -> bool:
    """Queue a configuration; False when the queue is full."""
    i = tree.counts[QUEUED]
    if i >= len(tree.key):
        return False
    tree.counts[QUEUED] = i + 1
    while i > 0:
        up = (i - 1) // 2
        if tree.key[up] <= key:
            break
        tree.key[i], tree.queued[i], tree.turn[i] = tree.key[up], tree.queued[up], tree.turn[up]
        i = up
    tree.key[i], tree.queued[i], tree.turn[i] = key, node, turn
    return True


@compiled
def _pop(tree: Tree) -> tuple[float, int, int]:
    """The configuration with the least key, and its turn."""
    first = tree.key[0], tree.queued[0], tree.turn[0]
    n = tree.counts[QUEUED] - 1
    tree.counts[QUEUED] = n
    key, node, turn = tree.key[n], tree.queued[n], tree.turn[n]
    i = 0
    while 2 * i + 1 < n:
        down = 2 * i + 1
        if down + 1 < n and tree.key[down + 1] < tree.key[down]:
            down += 1
        if tree.key[down] >= key:
            break
        tree.key[i], tree.queued[i], tree.turn[i] = tree.key[down], tree.queued[down], tree.turn[down]
        i = down
    if n > 0:
        tree.key[i], tree.queued[i], tree.turn[i] = key, node, turn
    return first


@compiled
def _mixed(h: np.uint64, value: int) -> np.uint64:
    h = (h ^ np.uint64(value)) * np.uint64(0xFF51AFD7ED558CCD)
    return h ^ (h >> np.uint64(29))


@compiled
def _alike(tree: Tree, ground: Ground, rules: Rules, node: int, digits: NDArray[np.int64]) -> None:
    """What configurations that count as one have in common: the square of the body's place, and those of the feet (8,)."""
    ny = ground.evaluation.shape[1]
    digits[0] = math.floor(tree.body[node, 0] / rules.alike_body + 0.5)
    digits[1] = math.floor(tree.body[node, 1] / rules.alike_body + 0.5)
    for leg in range(6):
        code = tree.foot[node, leg]
        if code >= 0 and rules.alike_foot > 1:
            code = (code // ny) // rules.alike_foot * ny + (code % ny) // rules.alike_foot
        digits[2 + leg] = code


@compiled
def _known(tree: Tree, ground: Ground, rules: Rules, node: int) -> bool:
    """Whether there is a configuration already that counts as the one in the place of a node; if not, the node is noted."""
    mine, other = np.empty(8, np.int64), np.empty(8, np.int64)
    _alike(tree, ground, rules, node, mine)
    h = np.uint64(88172645463325252)
    for value in mine:
        h = _mixed(h, int(value))
    mask = np.int64(len(tree.table) - 1)
    at = np.int64(h & np.uint64(mask))
    while tree.table[at] >= 0:
        _alike(tree, ground, rules, tree.table[at], other)
        if (mine == other).all():
            return True
        at = (at + 1) & mask
    tree.table[at] = node
    return False


# Growing --------------------------------------------------------------------------------------------------------------------


@compiled
def _fail(tree: Tree, far: bool, test: int, leg: int) -> None:
    place = leg if leg >= 0 else 6
    tree.fails[0, test, place] += 1
    if far:
        tree.fails[1, test, place] += 1


@compiled
def _to_go(tree: Tree, legs: Legs, rules: Rules, feet: Array, bx: float) -> float:
    """Steps still to go [1]: by the way that the body has before it, and that of the feet behind it."""
    ahead = max(tree.goal[0] - bx, 0.0)
    lag = lagging = 0.0
    for leg in range(6):
        behind = bx + legs.rest[leg, 0] - feet[leg, 0]
        lag += max(ahead + behind, 0.0) / 6.0
        lagging += (max(behind, 0.0) / legs.stroke[leg]) ** 2
    return float(0.5 * (ahead + lag) / rules.step_gain + rules.lag_price * lagging)


@compiled
def _add(
    tree: Tree,
    ground: Ground,
    legs: Legs,
    rules: Rules,
    parent: int,
    leg: int,
    body: Array,
    code: int,
    feet: Array,
    price: float,
    margin: float,
) -> bool:
    """Add a configuration unless it is known; False when there is no room for more."""
    node = tree.counts[NODES]
    if node >= len(tree.parent):
        return False
    tree.body[node] = body
    tree.foot[node] = tree.foot[parent]
    if leg >= 0:
        tree.foot[node, leg] = code
    if _known(tree, ground, rules, node):
        return True
    tree.counts[NODES] = node + 1
    tree.parent[node], tree.leg[node], tree.depth[node] = parent, leg, tree.depth[parent] + 1
    tree.state[node], tree.lift[node], tree.margin[node] = OPEN, 0.0, margin
    cost = tree.cost[parent] + 1.0 + price
    tree.cost[node] = cost
    return _push(tree, cost + rules.eager * _to_go(tree, legs, rules, feet, body[0]), node, 0)


@compiled
def _next_leg(tree: Tree, legs: Legs, node: int, turn: int) -> int:
    """The leg that a configuration is expanded for: the one whose turn it is, then the others in order, then none."""
    turn = turn % 7
    if turn == 6:
        return ALL_STAND
    last = tree.leg[node]
    up = node
    while last < 0 and tree.parent[up] >= 0:
        up = tree.parent[up]
        last = tree.leg[up]
    return int(legs.order[((legs.place[last] + 1 if last >= 0 else 0) + turn) % 6])


@compiled
def _place_price(rules: Rules, legs: Legs, ground: Ground, leg: int, code: int, x: float, y: float, bx: float) -> float:
    """What a foothold costs: near an edge more than in the middle, off the robot's track more than on it."""
    F = ground.evaluation[code // ground.evaluation.shape[1], code % ground.evaluation.shape[1]]
    poor = max(0, F + 3)
    aside = abs(y - legs.rest[leg, 1])
    return float(rules.foothold_price * poor + rules.aside_price * aside)


@compiled
def _expand_for(
    tree: Tree, ground: Ground, legs: Legs, rules: Rules, node: int, leg: int, exhaustive: bool, far: bool, work: Array
) -> bool:
    """Add what one leg can do from a configuration: up to m motions of the body with up to n footholds each.

    Returns False when there is no room for more.
    """
    feet, after = work[:6], work[6:12]
    codes = tree.foot[node]
    b0 = tree.body[node]
    for k in range(6):
        feet[k] = _foot(tree, ground, rules, codes[k], k)
    begin = _support(feet, leg, b0[0], b0[1])
    if begin < rules.margin:
        _fail(tree, far, MARGIN, leg)
        return True
    test, which, strained = _stands(legs, rules, codes, feet, leg, b0[0], b0[1], b0[2], True)
    if test == TORQUE:
        _fail(tree, far, test, which)
        return True
    height = _floor(feet, leg, rules.foot_radius) + rules.height
    body = np.empty(3)
    body[2] = min(max(height, b0[2] - rules.climb), b0[2] + rules.climb)
    # All places in the cone, or samples of it; the first sample is to stay.
    across = math.ceil(rules.body_high * math.sin(min(rules.body_angle, 1.5)) / rules.lattice)
    wide = 2 * across + 1
    longest = math.floor(rules.body_high / rules.lattice + 1e-6)
    moves = wide * (longest + 1) if exhaustive else rules.move_samples
    last_x, last_y = np.empty(moves), np.empty(moves)
    for m in range(moves):
        if exhaustive:
            dx, dy = (m // wide) * rules.lattice, (m % wide - across) * rules.lattice
            distance = math.sqrt(dx * dx + dy * dy)
            if distance > rules.body_high + 1e-9 or abs(dy) > dx * math.tan(rules.body_angle) + 0.5 * rules.lattice:
                last_x[m], last_y[m] = np.inf, np.inf
                continue
        else:
            distance = rules.body_low + (rules.body_high - rules.body_low) * _uniform(tree.random)
            phi = rules.body_angle * _bell(tree.random)
            if m == 0 and tree.depth[node] == 0:
                distance = 0.0  # a repaired stance may have no room to move before its first step
            dx, dy = distance * math.cos(phi), distance * math.sin(phi)
        body[0] = rules.lattice * round((b0[0] + dx) / rules.lattice)
        body[1] = rules.lattice * round((b0[1] + dy) / rules.lattice)
        last_x[m], last_y[m] = body[0], body[1]
        known = leg < 0 and abs(body[0] - b0[0]) + abs(body[1] - b0[1]) < 1e-6
        for k in range(m):
            known = known or (abs(last_x[k] - body[0]) + abs(last_y[k] - body[1]) < 1e-6)
        if known or abs(body[1]) > rules.drift + max(abs(tree.body[0, 1]) - rules.drift, 0.0):
            continue
        # 1. The body's motion, over the legs that stand.
        margin = min(begin, _support(feet, leg, body[0], body[1]))
        if margin < rules.margin:
            _fail(tree, far, MARGIN, leg)
            continue
        test, which, torque = _stands(legs, rules, codes, feet, leg, body[0], body[1], body[2], True)
        if test == OK:
            mid = 0.5 * (b0 + body)
            test, which, _ = _stands(legs, rules, codes, feet, leg, mid[0], mid[1], mid[2], False)
        if test != OK:
            _fail(tree, far, test, which)
            continue
        price = rules.margin_price * max(0.0, 2.0 * rules.margin - margin)
        price += rules.torque_price * max(0.0, max(torque, strained) - rules.easy_torque)
        if leg < 0:
            if not _add(tree, ground, legs, rules, node, leg, body, ROOT_FOOT, feet, rules.still_price + price, margin):
                return False
            continue
        # 2. Footholds of the leg that swings.
        if not _footholds(tree, ground, legs, rules, node, leg, body, feet, after, price, margin, exhaustive, far):
            return False
    return True


@compiled
def _footholds(
    tree: Tree,
    ground: Ground,
    legs: Legs,
    rules: Rules,
    node: int,
    leg: int,
    body: Array,
    feet: Array,
    after: Array,
    price: float,
    margin: float,
    exhaustive: bool,
    far: bool,
) -> bool:
    """Add configurations with a leg's footholds for one motion of the body; False when there is no room for more."""
    F = ground.evaluation
    nx, ny = F.shape
    tip_x, tip_y = body[0] + legs.rest[leg, 0] - rules.foot_back, body[1] + legs.rest[leg, 1]
    i0, j0 = int((tip_x - ground.x0) / ground.resolution), int((tip_y - ground.y0) / ground.resolution)
    deep = int(rules.foot_high / ground.resolution)
    across = int(rules.foot_high * math.sin(min(rules.foot_angle, 1.5)) / ground.resolution)
    wide = 2 * across + 1
    tries = (deep + 1) * wide if exhaustive else rules.foot_samples
    tried = np.empty(rules.foot_samples, np.int64)
    for n in range(tries):
        if exhaustive:
            i, j = i0 + n // wide, j0 - across + n % wide
            if not (0 <= i < nx and 0 <= j < ny) or not ground.candidate[i, j]:
                continue
        else:
            tried[n] = -1
            distance = rules.foot_low + (rules.foot_high - rules.foot_low) * _uniform(tree.random)
            phi = rules.foot_angle * _bell(tree.random)
            i = math.floor((tip_x + distance * math.cos(phi) - ground.x0) / ground.resolution + 0.5)
            j = math.floor((tip_y + distance * math.sin(phi) - ground.y0) / ground.resolution + 0.5)
            if not (0 <= i < nx and 0 <= j < ny) or F[i, j] == _NEVER_SEEN:
                _fail(tree, far, UNKNOWN, leg)
                continue
            i, j = _resolved(F, i, j, rules.strong, rules.wide)
            code = i * ny + j
            known = False
            for k in range(n):
                known = known or tried[k] == code
            if known:
                continue
            tried[n] = code
        code = i * ny + j
        if F[i, j] > rules.weakest or not ground.elevation[i, j] > -np.inf:
            _fail(tree, far, FOOTHOLD, leg)
            continue
        x, y, z = _foot(tree, ground, rules, code, leg)
        if x < feet[leg, 0] - rules.backward or code == tree.foot[node, leg]:
            continue
        test = _placed(legs, rules, leg, x - body[0], y - body[1])
        if test == OK:
            test, _, _, _, _, _, _ = _leg(legs, rules, 0, leg, body[0], body[1], body[2], x, y, z)
        if test == OK:
            for k in range(6):
                if k != leg and (feet[k, 0] - x) ** 2 + (feet[k, 1] - y) ** 2 < rules.feet_apart**2:
                    test = APART
        if test != OK:
            _fail(tree, far, test, leg)
            continue
        after[:] = feet
        after[leg, 0], after[leg, 1], after[leg, 2] = x, y, z
        place = _place_price(rules, legs, ground, leg, code, x, y, body[0])
        if not _add(tree, ground, legs, rules, node, leg, body, code, after, price + place, margin):
            return False
    return True


@compiled
def grow(tree: Tree, ground: Ground, legs: Legs, rules: Rules, expansions: int, exhaustive: bool) -> int:
    """Expand configurations; how many were, fewer than asked for where the search has come to its end.

    It ends with `counts[GOAL]` set, or with nothing queued, or with no room left.
    """
    work = np.empty((12, 3))
    done = 0
    while done < expansions and tree.counts[QUEUED] > 0 and tree.counts[GOAL] < 0:
        key, node, turn = _pop(tree)
        if tree.state[node] == OPEN:
            test = _proof(legs, rules, ground, tree, node)
            tree.counts[PROVED] += 1
            if test != OK:
                tree.state[node] = REFUSED
                _fail(tree, tree.body[tree.parent[node], 0] > tree.body[tree.counts[FURTHEST], 0] - 0.02, test, tree.leg[node])
                done += 1
                tree.counts[EXPANDED] += 1
                continue
            tree.state[node] = PROVEN
            if tree.body[node, 0] >= tree.goal[0] - 1e-9:
                tree.counts[GOAL] = node
                done += 1
                break
            if tree.body[node, 0] > tree.body[tree.counts[FURTHEST], 0] + 1e-9:
                tree.counts[FURTHEST] = node
                tree.fails[1] = 0
            if tree.depth[node] >= rules.depth:
                continue
        far = tree.body[node, 0] > tree.body[tree.counts[FURTHEST], 0] - 0.02
        leg = _next_leg(tree, legs, node, turn)
        room = _expand_for(tree, ground, legs, rules, node, leg, exhaustive, far, work)
        if turn + 1 < (7 if exhaustive else 7 * rules.rounds):
            room = _push(tree, key + rules.turn_price * (1.0 + turn // 7), node, turn + 1) and room
        done += 1
        tree.counts[EXPANDED] += 1
        if not room:
            tree.counts[QUEUED] = 0
    return done


@compiled
def faults(legs: Legs, rules: Rules, strict: int, feet: Array, body: Array, found: NDArray[np.int64]) -> None:
    """The test that each leg of a stance fails in (7,), the last that of the whole robot; by the limits themselves if 1."""
    for leg in range(6):
        test, _, _, _, _, _, _ = _leg(
            legs, rules, strict, leg, body[0], body[1], body[2], feet[leg, 0], feet[leg, 1], feet[leg, 2]
        )
        found[leg] = test
    found[6] = OK if _support(feet, ALL_STAND, body[0], body[1]) >= rules.margin else MARGIN
