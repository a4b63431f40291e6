"""Compiled search of the roadmap: a tree over body motions and footholds.

It follows Masri 2016, chapter 5, and adds what the thesis leaves out. The whole search is one file, because compiled functions
must not call across files.

The search is lazy. A new configuration passes only the cheap tests: reach and limits of all legs, support, torque, and places
of its feet. The expensive tests are the swing, and the distances of legs to each other and to the ground. They run when the
configuration is next in the queue. After an expansion for the due leg, the configuration is queued again for the next leg in
order, at a price.

Joint limits are tested without inverse trigonometry: as directions, by the signs of cross products, and by the knee's cosine.

The body turns in steps without a swing. So each swing has one heading, and is tested in the frame {level}: that of the strip,
turned about its origin by the body's yaw. Only look-ups of the ground turn back, by a `Turn`.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array
from sextant.shared.runtime.compiled import compiled, constants

OK, REACH, UNDER, LEVEL, APART, FOOTHOLD, UNKNOWN, MARGIN, TORQUE, LEGS, GROUND, SWING = constants(range(12))  # test results
TESTS = 12
OPEN, PROVEN, REFUSED = 0, 1, 2  # proof state of the step to a configuration
NODES, QUEUED, EXPANDED, BEST, GOAL, FURTHEST, PROVED = constants(range(7))  # indices into `Tree.counts`
COUNTS = 7
(ALL_STAND,) = constants([-1])  # instead of the swinging leg
(ROOT_FOOT,) = constants([-1])  # instead of a cell: the foot has not moved since the root
_WITHOUT_TORQUES, _WITH_TORQUES = constants([0, 1])  # which tests of a stance
(_FIRST_TURN,) = constants([0])
_NEVER_SEEN = 127
CROWDS, _CROWD = 512, 0.01  # number of progress bins, and [m] length of one
_SAMPLES = 9  # number of samples of a swing
_AXIS = (
    0.035  # [m] minimum foot distance from the coxa axis; nearer, the coxa turns too fast and the foot's push is unpredictable
)
_INSIDE = 0.001  # [m] from the ends of the range of body heights
_PIECES = 12  # pieces of the path between two samples
_LEVEL_SHARE = 0.8  # share of its clearance at which a swing is taken to be level
_RISES = (0.20, 0.05, 0.70)  # shares of time, path and level height of the steepest possible rise
_FALLS = (0.82, 0.95, 0.40)  # the same for the steepest descent


Turn = tuple[float, float]  # cosine and sine of the body's yaw {strip}


# Columns of `Legs.table`.
_MOUNT, _YAW, _COXA, _FEMUR, _KNEE, _WAY, _LINKS, _FORE, _ROOM = constants([0, 3, 5, 10, 15, 17, 19, 22, 23])
LEG_COLUMNS = 25


# Leading index of `Legs.table`: limits with a reserve for the next steps, or as they are.
WITH_RESERVE, WITHOUT_RESERVE = constants([0, 1])


class Legs(NamedTuple):
    """Leg parameters for the tests.

    The table is one array, because each array argument costs reference counting in a call. Its leading axis selects the limits:
    `WITH_RESERVE` or `WITHOUT_RESERVE`. Its columns are:

    - mount (3) [m] {body};
    - cosine and sine of the neutral direction;
    - coxa (5) and femur (5): directions of the lower and upper limit as (cos, sin, cos, sin), and 1 if they are more than half
      a turn apart;
    - minimum and maximum cosine of the tibia angle;
    - shortest and longest distance [m] from femur axis to foot;
    - lengths of coxa, femur and tibia [m];
    - 1 for front legs, -1 for rear legs, 0 for middle legs;
    - half length and half width of the body [m].
    """

    table: Array  # (2, 6, 25)
    rest: Array  # (6, 2) [m] {body} nominal foot positions
    stroke: Array  # (6, 2) [m] maximum distance of a foot behind and before its nominal place
    order: NDArray[np.int64]  # (6,) order in which legs take turns
    swing: Array  # (3, 9) swing samples: shares of time, path and height


class Rules(NamedTuple):
    """Lengths and limits of the tests, in SI units."""

    foot_radius: float
    half_length: float  # of the body
    half_width: float
    half_height: float
    weight: float  # [N]
    torque: float  # [N m] permitted torque of a femur servo
    easy_torque: float  # [N m] torque that a femur servo sustains for hours
    knee: float  # stall torque of a femur servo divided by that of a tibia servo
    height: float  # [m] of the body over the floor
    climb: float  # [m] maximum height change of the body in a step
    centre_x: float  # [m] centre of mass relative to the body's middle
    centre_y: float
    margin: float  # [m] minimum distance of the centre of mass inside the support polygon
    feet_apart: float
    legs_apart: float
    body_clear: float
    leg_clear: float
    swing_clear: float
    least_lift: float
    most_lift: float
    lift_step: float
    moved_most: float  # [m] maximum shift of a swing point into reach
    lattice: float  # [m] lattice of body places
    alike_body: float  # [m] edge of the squares in which body places count as the same
    alike_foot: int  # [cells] the same for feet
    body_low: float  # [m] d_bmin
    body_high: float  # [m] d_bmax
    body_angle: float  # [rad] alpha
    foot_low: float  # d_lmin, as a share of the leg's stroke
    foot_high: float  # d_lmax, as a share of the leg's stroke
    foot_angle: float  # [rad] beta
    foot_back: float  # [m] from the end of the leg's stroke back to the tip of the cone of footholds
    strong: int  # [cells] F up to which a place is taken unchanged
    wide: int  # [cells] F of a local minimum up to which ground is wide
    weakest: int  # [cells] weakest permitted F of a local minimum
    central: int  # [cells] reach around a foothold in which the lowest F is taken, 0 for the foothold itself
    inward: int  # [cells] by which it then moves towards the middle of equally low F
    drift: float  # [m] Delta y
    depth: int  # maximum number of steps
    step_gain: float  # [m] progress of robot and feet in a step, for the cost to go
    eager: float  # weight of the cost to go
    lag_price: float  # of a foot that has its whole stroke behind it
    crowd_price: float  # of each expansion at the same progress
    turn_price: float
    still_price: float  # of a step without a swing
    foothold_price: float
    margin_price: float
    torque_price: float
    aside_price: float
    move_samples: int  # m
    foot_samples: int  # n
    rounds: int  # of all legs that one configuration may take
    backward: float  # [m] by which a foot may be placed further back
    yaw_step: float  # [rad] lattice of the body's yaw
    yaw_change: int  # maximum change of the yaw in one step [lattice steps]; 0: the body does not turn
    yaw_most: int  # maximum yaw {strip} [lattice steps]
    sway: float  # [m] maximum sampled distance of the body from its normal height
    uneven: bool  # whether a sampled height is moved into the reach of the standing legs


class Ground(NamedTuple):
    """The strip: cell (i, j) is centred at (x0, y0) + resolution * (i, j) {strip}."""

    elevation: NDArray[np.float32]  # (nx, ny) [m] {strip}, NaN where unknown
    top: NDArray[np.float32]  # (nx, ny) [m] highest ground of the cell and its neighbours, -inf where unknown
    evaluation: NDArray[np.int8]  # (nx, ny) Masri's F
    meant: NDArray[np.int32]  # (nx, ny) foothold cell of a sampled cell, -1 until it is computed
    nearest: NDArray[np.int32]  # (nx, ny) nearest seen cell, the cell itself where it is seen
    resolution: float
    x0: float
    y0: float


class Tree(NamedTuple):
    """Configurations, priority queue, hash table, and statistics (`counts`, `fails`)."""

    root: Array  # (6, 3) [m] {strip} feet
    body: Array  # (n, 3) [m] {strip}
    yaw: NDArray[np.int16]  # (n,) {strip} in lattice steps
    foot: NDArray[np.int32]  # (n, 6) cell, or ROOT_FOOT
    parent: NDArray[np.int32]  # (n,)
    leg: NDArray[np.int8]  # (n,) leg that swung in the step to the configuration
    depth: NDArray[np.int16]  # (n,)
    state: NDArray[np.int8]  # (n,)
    cost: Array  # (n,) cost of the path from the root
    lift: Array  # (n,) [m] clearance of that step
    margin: Array  # (n,) [m] support margin of that step
    key: Array  # (q,) keys of the queue, a binary heap
    queued: NDArray[np.int32]  # (q,)
    turn: NDArray[np.int16]  # (q,)
    table: NDArray[np.int32]  # (2^k,) nodes by hash, -1 for empty
    counts: NDArray[np.int64]  # (7,)
    fails: NDArray[np.int64]  # (2, tests, 7) failures of all, and of the furthest; last axis: legs, then robot
    visits: NDArray[np.int64]  # (512,) expansions by progress bin
    random: NDArray[np.uint64]  # (1,)
    goal: Array  # (1,) [m] {strip} goal x of the body


# Integers -------------------------------------------------------------------------------------------------------------------


@compiled
def _wide(value: np.integer) -> int:
    """Widen an integer, so that a function of it is compiled once."""
    return int(np.int64(value))


# Random numbers -------------------------------------------------------------------------------------------------------------


@compiled
def _uniform(state: NDArray[np.uint64]) -> float:
    """Return a uniform random number in [0, 1), by xorshift64*."""
    x = state[0]
    x ^= x >> np.uint64(12)
    x ^= x << np.uint64(25)
    x ^= x >> np.uint64(27)
    state[0] = x
    return float((x * np.uint64(2685821657736338717)) >> np.uint64(11)) / 9007199254740992.0


@compiled
def _bell(state: NDArray[np.uint64]) -> float:
    """Return a random number in [-1, 1] from the sum of three uniform ones.

    It approximates a Gaussian with a standard deviation of a third, within its bounds (Masri 2016, eq. 5.2 and 5.4).
    """
    return (_uniform(state) + _uniform(state) + _uniform(state)) / 1.5 - 1.0


# Headings -------------------------------------------------------------------------------------------------------------------


@compiled
def _turn_of(rules: Rules, yaw: float) -> Turn:
    """Return the turn of a yaw [lattice steps]."""
    return math.cos(rules.yaw_step * yaw), math.sin(rules.yaw_step * yaw)


@compiled
def _to_level(turn: Turn, x: float, y: float) -> tuple[float, float]:
    """Return a place {level} of a place {strip}."""
    return turn[0] * x + turn[1] * y, turn[0] * y - turn[1] * x


@compiled
def _to_strip(turn: Turn, x: float, y: float) -> tuple[float, float]:
    """Return a place {strip} of a place {level}."""
    return turn[0] * x - turn[1] * y, turn[0] * y + turn[1] * x


@compiled
def _level_stance(tree: Tree, ground: Ground, rules: Rules, node: int, turn: Turn, feet: Array, body: Array) -> None:
    """Write feet (6, 3) and body (3,) [m] {level} of a configuration."""
    for k in range(6):
        x, y, feet[k, 2] = _foot(tree, ground, rules, _wide(tree.foot[node, k]), k)
        feet[k, 0], feet[k, 1] = _to_level(turn, x, y)
    body[0], body[1] = _to_level(turn, tree.body[node, 0], tree.body[node, 1])
    body[2] = tree.body[node, 2]


# Tests of one leg -----------------------------------------------------------------------------------------------------------


@compiled
def _between(c: float, s: float, table: Array, limits: int, leg: int, column: int) -> bool:
    """Return whether a direction lies between a leg's limits that begin at a column."""
    after = table[limits, leg, column] * s - table[limits, leg, column + 1] * c >= 0.0
    before = c * table[limits, leg, column + 3] - s * table[limits, leg, column + 2] >= 0.0
    return bool((after or before) if table[limits, leg, column + 4] > 0.0 else (after and before))


@compiled
def _leg(
    table: Array, limits: int, leg: int, x: float, y: float, z: float
) -> tuple[int, float, float, float, float, float, float]:
    """Test whether a leg can hold its foot at (x, y, z) {body}.

    Returns:
        OK or REACH; the horizontal distances [m] from femur axis to foot and from knee to foot; the leg's direction (ux, uy)
        {body}; and the knee's horizontal distance and height from the femur axis [m].

    Source: Masri 2016, eq. (3.3)-(3.10) and (3.14)-(3.16), as `sextant.shared.robot.kinematics` reads them.
    """
    px, py, pz = x - table[0, leg, _MOUNT], y - table[0, leg, _MOUNT + 1], z - table[0, leg, _MOUNT + 2]
    coxa, f, t = table[0, leg, _LINKS], table[0, leg, _LINKS + 1], table[0, leg, _LINKS + 2]
    out = math.sqrt(px * px + py * py)
    reach = out - coxa
    d2 = reach * reach + pz * pz
    knee = (d2 - f * f - t * t) / (2.0 * f * t)
    if out < _AXIS or knee < table[limits, leg, _KNEE] or knee > table[limits, leg, _KNEE + 1]:
        return REACH, reach, 0.0, 1.0, 0.0, 0.0, 0.0
    across = -t * math.sqrt(max(1.0 - knee * knee, 0.0))
    along = f + t * knee
    # Direction of the femur, times the squared distance from femur axis to foot.
    fc, fs = reach * along + pz * across, pz * along - reach * across
    c, s = table[0, leg, _YAW], table[0, leg, _YAW + 1]
    ok = _between(px * c + py * s, py * c - px * s, table, limits, leg, _COXA)
    ok = ok and _between(fc, fs, table, limits, leg, _FEMUR)
    knee_out, knee_up = f * fc / d2, f * fs / d2
    return (OK if ok else REACH), reach, reach - knee_out, px / out, py / out, knee_out, knee_up


@compiled
def _placed(table: Array, leg: int, x: float, y: float) -> int:
    """Test whether a foot may be at (x, y) {body}.

    A foot must not be under the body. In the thesis front feet must not be behind the body's front, and rear feet not before
    its rear. The purpose is balance, which the support margin already measures. So the level here is the leg's own axis, which
    is no stricter than the joint limits of the thesis. Source: Masri 2016, sections 5.1.1 and 5.2.1.
    """
    if abs(x) < table[0, leg, _ROOM] and abs(y) < table[0, leg, _ROOM + 1]:
        return UNDER
    if table[0, leg, _FORE] * (x - table[0, leg, _MOUNT]) < 0.0:
        return LEVEL
    return OK


@compiled
def _foot(tree: Tree, ground: Ground, rules: Rules, code: int, leg: int) -> tuple[float, float, float]:
    """Return the centre of a standing foot [m] {strip}."""
    if code == ROOT_FOOT:
        return tree.root[leg, 0], tree.root[leg, 1], tree.root[leg, 2]
    ny = ground.evaluation.shape[1]
    i, j = code // ny, code % ny
    z = float(ground.elevation[i, j]) + rules.foot_radius
    return ground.x0 + i * ground.resolution, ground.y0 + j * ground.resolution, z


# Tests of the stance --------------------------------------------------------------------------------------------------------


@compiled
def _support(rules: Rules, feet: Array, swing: int, body_x: float, body_y: float) -> float:
    """Return the distance [m] of the centre of mass inside the standing feet (6, 3).

    The edges connect neighbouring legs around the body. If a foot stands inside the hull of the others, the result is less than
    the distance from the hull, never more.
    """
    x, y = body_x + rules.centre_x, body_y + rules.centre_y
    least = np.inf
    for a in range(6):
        if a == swing:
            continue
        b = (a + 1) % 6
        if b == swing:
            b = (b + 1) % 6
        # Legs are numbered clockwise: inside is to the right of each edge.
        ex, ey = feet[b, 0] - feet[a, 0], feet[b, 1] - feet[a, 1]
        length = math.sqrt(ex * ex + ey * ey)
        if length < 1e-6:
            return -np.inf
        least = min(least, (ey * (x - feet[a, 0]) - ex * (y - feet[a, 1])) / length)
    return least


@compiled
def _floor(feet: Array, swing: int, radius: float) -> float:
    """Return the mean height [m] of the three highest standing feet's undersides.

    Source: Lotriet 2024, section 6.4.
    """
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
def _height_range(table: Array, feet: Array, swing: int, bx: float, by: float) -> tuple[float, float]:
    """Return the lowest and the highest body [m] at a place for which the knees of the standing legs reach their feet."""
    low, high = -np.inf, np.inf
    for leg in range(6):
        if leg == swing:
            continue
        x, y = feet[leg, 0] - bx - table[0, leg, _MOUNT], feet[leg, 1] - by - table[0, leg, _MOUNT + 1]
        z = feet[leg, 2] - table[0, leg, _MOUNT + 2]
        reach = math.sqrt(x * x + y * y) - table[0, leg, _LINKS]
        short, far = table[WITH_RESERVE, leg, _WAY], table[WITH_RESERVE, leg, _WAY + 1]
        high = min(high, z + math.sqrt(max(far * far - reach * reach, 0.0)))
        low = max(low, z + math.sqrt(max(short * short - reach * reach, 0.0)))
    return low, high


@compiled
def _stands(
    table: Array, rules: Rules, codes: NDArray[np.int32], feet: Array, swing: int, bx: float, by: float, bz: float, torques: int
) -> tuple[int, int, float]:
    """Return the failed test or OK, its leg, and the greatest torque [N m], as of a femur servo.

    Feet share the weight like springs under a rigid body: the force is linear in the foot's position and balances the weight.
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
        test, reach, shank, _, _, _, _ = _leg(
            table, WITHOUT_RESERVE if at_root else WITH_RESERVE, leg, x - bx, y - by, feet[leg, 2] - bz
        )
        if test == OK and not at_root:
            test = _placed(table, leg, x - bx, y - by)
        if test != OK:
            return test, leg, 0.0
        force = rules.weight * max(1.0 / n + kx * (x - mx) + ky * (y - my), 0.0)
        torque = force * max(abs(reach), rules.knee * abs(shank))
        if torques == _WITH_TORQUES and torque > rules.torque:
            return TORQUE, leg, torque
        worst = max(worst, torque)
    return OK, ALL_STAND, worst


@compiled
def _landing(table: Array, rules: Rules, feet: Array, leg: int, body: Array, goal: Array) -> int:
    """Test a leg's touchdown at `goal` (3,); the other legs stand."""
    test = _placed(table, leg, goal[0] - body[0], goal[1] - body[1])
    if test == OK:
        test, _, _, _, _, _, _ = _leg(table, WITH_RESERVE, leg, goal[0] - body[0], goal[1] - body[1], goal[2] - body[2])
    if test == OK:
        for k in range(6):
            if k != leg and (feet[k, 0] - goal[0]) ** 2 + (feet[k, 1] - goal[1]) ** 2 < rules.feet_apart**2:
                test = APART
    return int(test)


# Footholds ------------------------------------------------------------------------------------------------------------------


@compiled
def _lower(F: NDArray[np.int8], i: int, j: int) -> tuple[int, int]:
    """Return the lowest of a cell and its eight neighbours."""
    bi, bj = i, j
    for a in range(max(i - 1, 0), min(i + 2, F.shape[0])):
        for b in range(max(j - 1, 0), min(j + 2, F.shape[1])):
            if F[a, b] < F[bi, bj]:
                bi, bj = a, b
    return bi, bj


@compiled
def _resolved(F: NDArray[np.int8], i: int, j: int, strong: int, wide: int) -> tuple[int, int]:
    """Return the foothold of a sampled cell by greedy descent of F.

    On wide ground, where the minimum is low, a good cell is its own foothold. For another cell it is the first good cell on the
    descent. Narrow ground has three footholds: its middle, which is the local minimum, and the first and last good cells along
    the strip, for legs that must reach far. In a minimum two cells wide, the cell with the lower index is the middle.

    Source: Masri 2016, section 5.2.1.
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
def _lowest(F: NDArray[np.int8], i: int, j: int, reach: int, inward: int) -> tuple[int, int]:
    """Return the lowest cell of F to which steps of at most a reach [cells] along both axes lead from (i, j).

    Of several, it is the nearest one to the last step, and then moves by up to `inward` cells along both axes towards their
    middle. Map noise makes shallow local minima near edges, where greedy descent ends.
    """
    while True:
        bi, bj, nearest = i, j, 0
        rows, columns, n = 0, 0, 0
        for a in range(max(i - reach, 0), min(i + reach + 1, F.shape[0])):
            for b in range(max(j - reach, 0), min(j + reach + 1, F.shape[1])):
                if F[a, b] > F[bi, bj]:
                    continue
                distance = (a - i) ** 2 + (b - j) ** 2
                if F[a, b] < F[bi, bj]:
                    bi, bj, nearest = a, b, distance
                    rows, columns, n = 0, 0, 0
                elif distance < nearest:
                    bi, bj, nearest = a, b, distance
                rows, columns, n = rows + a, columns + b, n + 1
        if F[bi, bj] == F[i, j]:
            return _towards(F, i, j, rows / n, columns / n, inward)
        i, j = bi, bj


@compiled
def _towards(F: NDArray[np.int8], i: int, j: int, row: float, column: float, most: int) -> tuple[int, int]:
    """Return the cell with the F of (i, j) that is nearest to a place, at most a number of cells away along both axes."""
    bi, bj = i, j
    for a in range(max(i - most, 0), min(i + most + 1, F.shape[0])):
        for b in range(max(j - most, 0), min(j + most + 1, F.shape[1])):
            if F[a, b] == F[i, j] and (a - row) ** 2 + (b - column) ** 2 < (bi - row) ** 2 + (bj - column) ** 2:
                bi, bj = a, b
    return bi, bj


@compiled
def candidates(F: NDArray[np.int8], strong: int, wide: int, weakest: int, candidate: NDArray[np.bool_]) -> None:
    """Mark the cells that are the foothold of any cell."""
    candidate[:] = False
    for i in range(F.shape[0]):
        for j in range(F.shape[1]):
            if F[i, j] == _NEVER_SEEN:
                continue
            a, b = _resolved(F, i, j, strong, wide)
            if F[a, b] <= weakest:
                candidate[a, b] = True


@compiled
def nearest_seen(F: NDArray[np.int8], nearest: NDArray[np.int32]) -> None:
    """Fill (nx, ny) with the nearest seen cell along rows and columns, -1 for none.

    A sample on the floor of a gap counts as the edge next to it, and descends to a foothold from there. So it makes no
    difference whether the floor is seen.
    """
    nx, ny = F.shape
    queue, n = np.empty(nx * ny, np.int32), 0
    for code in range(nx * ny):
        seen = F[code // ny, code % ny] != _NEVER_SEEN
        nearest[code // ny, code % ny] = code if seen else -1
        if seen:
            queue[n], n = code, n + 1
    k = 0
    while k < n:
        i, j, k = queue[k] // ny, queue[k] % ny, k + 1
        for c, d in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
            if 0 <= c < nx and 0 <= d < ny and nearest[c, d] < 0:
                nearest[c, d] = nearest[i, j]
                queue[n], n = c * ny + d, n + 1


# Legs in space --------------------------------------------------------------------------------------------------------------


@compiled
def _pose(table: Array, leg: int, bx: float, by: float, bz: float, x: float, y: float, z: float, poses: Array) -> int:
    """Write femur axis, knee and foot of a leg to its row of poses (6, 9) [m] {strip}.

    Return REACH if the joint limits exclude the pose.
    """
    test, _, _, ux, uy, out, up = _leg(table, WITHOUT_RESERVE, leg, x - bx, y - by, z - bz)
    coxa = table[0, leg, _LINKS]
    mx, my, mz = bx + table[0, leg, _MOUNT], by + table[0, leg, _MOUNT + 1], bz + table[0, leg, _MOUNT + 2]
    poses[leg, 0], poses[leg, 1], poses[leg, 2] = mx + coxa * ux, my + coxa * uy, mz
    poses[leg, 3], poses[leg, 4], poses[leg, 5] = mx + (coxa + out) * ux, my + (coxa + out) * uy, mz + up
    poses[leg, 6], poses[leg, 7], poses[leg, 8] = x, y, z
    return test


@compiled
def _turns(table: Array, leg: int, x: float, y: float, z: float) -> bool:
    """Test the directions of coxa and femur for a foot at (x, y, z) {body}.

    Beyond the reach of the knee, the direction at the end of its reach counts.
    """
    px, py, pz = x - table[0, leg, _MOUNT], y - table[0, leg, _MOUNT + 1], z - table[0, leg, _MOUNT + 2]
    f, t = table[0, leg, _LINKS + 1], table[0, leg, _LINKS + 2]
    reach = math.sqrt(px * px + py * py) - table[0, leg, _LINKS]
    knee = min(max((reach * reach + pz * pz - f * f - t * t) / (2.0 * f * t), -1.0), 1.0)
    across, along = -t * math.sqrt(1.0 - knee * knee), f + t * knee
    c, s = table[0, leg, _YAW], table[0, leg, _YAW + 1]
    turned = _between(px * c + py * s, py * c - px * s, table, WITH_RESERVE, leg, _COXA)
    return turned and _between(reach * along + pz * across, pz * along - reach * across, table, WITH_RESERVE, leg, _FEMUR)


@compiled
def _collide(poses: Array, one: int, other: int, apart: float) -> bool:
    """Return whether femur or tibia of two legs come closer than a distance [m].

    Source: Ericson, Real-Time Collision Detection, section 5.1.9.
    """
    for i in range(0, 6, 3):
        px, py, pz = poses[one, i], poses[one, i + 1], poses[one, i + 2]
        ux, uy, uz = poses[one, i + 3] - px, poses[one, i + 4] - py, poses[one, i + 5] - pz
        a = ux * ux + uy * uy + uz * uz
        for j in range(0, 6, 3):
            rx, ry, rz = poses[other, j], poses[other, j + 1], poses[other, j + 2]
            vx, vy, vz = poses[other, j + 3] - rx, poses[other, j + 4] - ry, poses[other, j + 5] - rz
            wx, wy, wz = px - rx, py - ry, pz - rz
            e, b = vx * vx + vy * vy + vz * vz, ux * vx + uy * vy + uz * vz
            c, f = ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
            denominator = a * e - b * b
            m = min(max((b * f - c * e) / denominator, 0.0), 1.0) if denominator > 1e-12 else 0.0
            k = (b * m + f) / e
            if k < 0.0:
                k, m = 0.0, min(max(-c / a, 0.0), 1.0)
            elif k > 1.0:
                k, m = 1.0, min(max((b - c) / a, 0.0), 1.0)
            dx, dy, dz = wx + ux * m - vx * k, wy + uy * m - vy * k, wz + uz * m - vz * k
            if dx * dx + dy * dy + dz * dz < apart * apart:
                return True
    return False


@compiled
def _top(top: NDArray[np.float32], resolution: float, x0: float, y0: float, turn: Turn, x: float, y: float) -> float:
    """Return the highest known ground [m] within a cell of a place {level}, else -inf."""
    x, y = _to_strip(turn, x, y)
    i, j = math.floor((x - x0) / resolution + 0.5), math.floor((y - y0) / resolution + 0.5)
    if i < 0 or j < 0 or i >= top.shape[0] or j >= top.shape[1]:
        return -np.inf
    return float(top[i, j])


@compiled
def _shank_clear(
    top: NDArray[np.float32],
    resolution: float,
    x0: float,
    y0: float,
    turn: Turn,
    poses: Array,
    leg: int,
    clear: float,
) -> bool:
    """Return whether a leg's tibia and knee stay above the ground by a distance [m].

    Near the foot, the test of the foothold applies instead.
    """
    fx, fy, fz = poses[leg, 6], poses[leg, 7], poses[leg, 8]
    for k in range(1, 5):
        s = 0.25 * k
        x, y, z = fx + s * (poses[leg, 3] - fx), fy + s * (poses[leg, 4] - fy), fz + s * (poses[leg, 5] - fz)
        if z - _top(top, resolution, x0, y0, turn, x, y) < clear:
            return False
    return True


@compiled
def _body_clear(ground: Ground, rules: Rules, turn: Turn, bx: float, by: float, bz: float) -> bool:
    """Return whether the trunk stays above all ground under it."""
    top, resolution = ground.top, ground.resolution
    least = bz - rules.half_height - rules.body_clear
    x = -rules.half_length
    while x <= rules.half_length + 1e-9:
        y = -rules.half_width
        while y <= rules.half_width + 1e-9:
            if _top(top, resolution, ground.x0, ground.y0, turn, bx + x, by + y) > least:
                return False
            y += 2.0 * resolution  # `top` includes the neighbouring cells
        x += 2.0 * resolution
    return True


@compiled
def _into_reach(
    table: Array, leg: int, bx: float, by: float, bz: float, x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    """Return the nearest place of a foot within its knee's reach, and the shift [m].

    Source: Masri 2016, section 5.4.
    """
    mx, my, up = bx + table[0, leg, _MOUNT], by + table[0, leg, _MOUNT + 1], z - bz - table[0, leg, _MOUNT + 2]
    coxa, short, far = table[0, leg, _LINKS], table[1, leg, _WAY] + 1e-4, table[1, leg, _WAY + 1] - 1e-4
    px, py = x - mx, y - my
    out = max(math.sqrt(px * px + py * py), 1e-6)
    reach = out - coxa
    way = math.sqrt(reach * reach + up * up)
    if short <= way <= far:
        return x, y, z, 0.0
    if way > far:
        new, new_up = reach * far / way, up * far / way
    else:
        new, new_up = math.sqrt(max(short * short - up * up, 0.0)), up
    scale = (coxa + new) / out
    return mx + px * scale, my + py * scale, z + new_up - up, math.sqrt((new - reach) ** 2 + (new_up - up) ** 2)


@compiled
def _beside(table: Array, feet: Array, leg: int, bx: float, by: float, bz: float, poses: Array, apart: float) -> bool:
    """Return whether a leg comes closer to a standing neighbour than `apart`."""
    for side in range(1, 6, 4):
        beside = (leg + side) % 6
        _pose(table, beside, bx, by, bz, feet[beside, 0], feet[beside, 1], feet[beside, 2], poses)
        if _collide(poses, leg, beside, apart):
            return True
    return False


@compiled
def _steeply_apart(
    table: Array, rules: Rules, feet: Array, goal: Array, leg: int, b0: Array, b1: Array, lift: float, smooth: bool
) -> bool:
    """Return whether a leg keeps apart from others at its steepest rise and descent.

    The foot may be pushed outward.
    """
    poses = np.empty((6, 9))
    level = max(feet[leg, 2], goal[2]) + lift
    for at_end in range(2):
        s, along, up = _FALLS if at_end else _RISES
        if smooth:
            s = s * s * (3.0 - 2.0 * s)
        end_z = goal[2] if at_end else feet[leg, 2]
        bx, by, bz = b0[0] + s * (b1[0] - b0[0]), b0[1] + s * (b1[1] - b0[1]), b0[2] + s * (b1[2] - b0[2])
        x, y = feet[leg, 0] + along * (goal[0] - feet[leg, 0]), feet[leg, 1] + along * (goal[1] - feet[leg, 1])
        x, y, z, _ = _into_reach(table, leg, bx, by, bz, x, y, end_z + up * (level - end_z))
        _pose(table, leg, bx, by, bz, x, y, z, poses)
        if _beside(table, feet, leg, bx, by, bz, poses, rules.legs_apart):
            return False
    return True


# The lazy proof of a step ---------------------------------------------------------------------------------------------------


@compiled
def _swing_test(
    table: Array,
    shape: Array,
    rules: Rules,
    ground: Ground,
    turn: Turn,
    feet: Array,
    goal: Array,
    leg: int,
    b0: Array,
    b1: Array,
    lift: float,
    smooth: bool,
) -> int:
    """Test a swing with a clearance: reach, ground, and neighbouring legs.

    The body moves at constant speed, as between consecutive steps, or starts and stops (`smooth`).
    """
    top, resolution, x0, y0 = ground.top, ground.resolution, ground.x0, ground.y0
    poses = np.empty((6, 9))
    level = max(feet[leg, 2], goal[2]) + _LEVEL_SHARE * lift
    last_x, last_y, last_z, last_bx, last_by, last_bz = feet[leg, 0], feet[leg, 1], feet[leg, 2], b0[0], b0[1], b0[2]
    # The foot hardly moves at the start and the end of the swing, but the body does.
    s = 0.5 * shape[0, 1]
    x, y, z = feet[leg, 0] - b0[0] - s * (b1[0] - b0[0]), feet[leg, 1] - b0[1] - s * (b1[1] - b0[1]), feet[leg, 2] - b0[2]
    if not _turns(table, leg, x, y, z):
        return REACH
    s = 0.5 * (1.0 - shape[0, _SAMPLES - 2])
    x, y, z = goal[0] - b1[0] + s * (b1[0] - b0[0]), goal[1] - b1[1] + s * (b1[1] - b0[1]), goal[2] - b1[2]
    if not _turns(table, leg, x, y, z):
        return REACH
    if not _steeply_apart(table, rules, feet, goal, leg, b0, b1, lift, smooth):
        return LEGS
    for k in range(_SAMPLES):
        s, along, up = shape[0, k], shape[1, k], shape[2, k]
        if smooth:
            s = s * s * (3.0 - 2.0 * s)
        end_z = feet[leg, 2] if k < _SAMPLES // 2 else goal[2]
        x, y = feet[leg, 0] + along * (goal[0] - feet[leg, 0]), feet[leg, 1] + along * (goal[1] - feet[leg, 1])
        bx, by, bz = b0[0] + s * (b1[0] - b0[0]), b0[1] + s * (b1[1] - b0[1]), b0[2] + s * (b1[2] - b0[2])
        # The foot flies between the guaranteed level, which the ground requires, and its full clearance. Limits allow both.
        hx, hy, hz, _ = _into_reach(table, leg, bx, by, bz, x, y, end_z + up * (level + (1.0 - _LEVEL_SHARE) * lift - end_z))
        raw_x, raw_y, raw_z = x, y, end_z + up * (level - end_z)
        off_x, off_y = x - bx - table[0, leg, _MOUNT], y - by - table[0, leg, _MOUNT + 1]
        if k > 0 and off_x * off_x + off_y * off_y < _AXIS * _AXIS:
            return REACH
        x, y, z, moved = _into_reach(table, leg, bx, by, bz, raw_x, raw_y, raw_z)
        if k > 0 and moved > (rules.moved_most if k < _SAMPLES - 1 else 1e-3):
            return REACH
        if k > 0 and not (_turns(table, leg, hx - bx, hy - by, hz - bz) and _turns(table, leg, x - bx, y - by, z - bz)):
            return REACH
        _pose(table, leg, bx, by, bz, x, y, z, poses)
        if not _shank_clear(top, resolution, x0, y0, turn, poses, leg, rules.leg_clear):
            return GROUND
        if _beside(table, feet, leg, bx, by, bz, poses, rules.legs_apart):
            return LEGS
        # Sample the foot's path closely, as a folded leg may push it outward abruptly. 2 cm apply, but less near both ends.
        for m in range(1, _PIECES + 1 if k > 0 else 1):
            part = m / _PIECES
            u, v, w, _ = _into_reach(
                table,
                leg,
                last_bx + part * (bx - last_bx),
                last_by + part * (by - last_by),
                last_bz + part * (bz - last_bz),
                last_x + part * (raw_x - last_x),
                last_y + part * (raw_y - last_y),
                last_z + part * (raw_z - last_z),
            )
            off = min((u - feet[leg, 0]) ** 2 + (v - feet[leg, 1]) ** 2, (u - goal[0]) ** 2 + (v - goal[1]) ** 2)
            needed = min(rules.swing_clear, 0.5 * math.sqrt(off) - 0.005)
            if w - rules.foot_radius - _top(top, resolution, x0, y0, turn, u, v) < needed:
                return SWING
        last_x, last_y, last_z, last_bx, last_by, last_bz = raw_x, raw_y, raw_z, bx, by, bz
    return OK


@compiled
def _stand_clear(
    table: Array,
    rules: Rules,
    ground: Ground,
    turn: Turn,
    feet: Array,
    leg: int,
    b0: Array,
    b1: Array,
    poses: Array,
) -> int:
    """Test the standing legs against each other and the ground in a body motion.

    The test applies half way and at the end.
    """
    for half in range(1, 3):
        s = 0.5 * half
        bx, by, bz = b0[0] + s * (b1[0] - b0[0]), b0[1] + s * (b1[1] - b0[1]), b0[2] + s * (b1[2] - b0[2])
        for k in range(6):
            if k != leg:
                _pose(table, k, bx, by, bz, feet[k, 0], feet[k, 1], feet[k, 2], poses)
                if not _shank_clear(ground.top, ground.resolution, ground.x0, ground.y0, turn, poses, k, rules.leg_clear):
                    return GROUND
        for k in range(6):
            after = (k + 1) % 6
            if leg not in (k, after) and _collide(poses, k, after, rules.legs_apart):
                return LEGS
    return OK


@compiled
def _proven(
    table: Array,
    shape: Array,
    rules: Rules,
    ground: Ground,
    turn: Turn,
    feet: Array,
    goal: Array,
    leg: int,
    b0: Array,
    b1: Array,
) -> tuple[int, float]:
    """Run the expensive tests of a step: return the result and the clearance [m]."""
    test = _way_clear(table, rules, ground, turn, feet, leg, b0, b1)
    if test != OK or leg == ALL_STAND:
        return test, 0.0
    return _lifted(table, shape, rules, ground, turn, feet, goal, leg, b0, b1)


@compiled
def _way_clear(table: Array, rules: Rules, ground: Ground, turn: Turn, feet: Array, leg: int, b0: Array, b1: Array) -> int:
    """Test trunk and standing legs against the ground, and legs against each other."""
    if not _body_clear(ground, rules, turn, b1[0], b1[1], b1[2]):
        return GROUND
    return _stand_clear(table, rules, ground, turn, feet, leg, b0, b1, np.empty((6, 9)))


@compiled
def _lifted(
    table: Array,
    shape: Array,
    rules: Rules,
    ground: Ground,
    turn: Turn,
    feet: Array,
    goal: Array,
    leg: int,
    b0: Array,
    b1: Array,
) -> tuple[int, float]:
    """Return OK and the lowest feasible clearance [m] of a swing.

    Otherwise return the test that fails at the highest clearance.
    """
    test = SWING
    lift = rules.least_lift
    while lift <= rules.most_lift + 1e-9:
        for smooth in (False, True):
            test = _swing_test(table, shape, rules, ground, turn, feet, goal, leg, b0, b1, lift, smooth)
            if test != OK:
                break
        if test == OK:
            return OK, lift
        lift += rules.lift_step
    return test, 0.0


@compiled
def _turn_clear(table: Array, rules: Rules, ground: Ground, tree: Tree, parent: int, node: int) -> int:
    """Test trunk and standing legs of a turn of the body, half way and at its end."""
    feet, b0, b1 = np.empty((6, 3)), np.empty(3), np.empty(3)
    for half in range(1, 3):
        s = 0.5 * half
        turn = _turn_of(rules, tree.yaw[parent] + s * (tree.yaw[node] - tree.yaw[parent]))
        _level_stance(tree, ground, rules, parent, turn, feet, b0)
        _level_stance(tree, ground, rules, node, turn, feet, b1)
        for k in range(3):
            b1[k] = b0[k] + s * (b1[k] - b0[k])
        test = _way_clear(table, rules, ground, turn, feet, ALL_STAND, b1, b1)
        if test != OK:
            return int(test)
    return int(OK)


@compiled
def _proof(legs: Legs, rules: Rules, ground: Ground, tree: Tree, node: int) -> int:
    """Prove the step to a configuration, store its clearance, return the test result."""
    parent, leg = _wide(tree.parent[node]), _wide(tree.leg[node])
    feet, goal, b0, b1 = np.empty((6, 3)), np.zeros(3), np.empty(3), np.empty(3)
    if tree.yaw[parent] != tree.yaw[node]:
        return _turn_clear(legs.table, rules, ground, tree, parent, node)
    turn = _turn_of(rules, tree.yaw[node])
    _level_stance(tree, ground, rules, node, turn, feet, b1)
    for k in range(3):
        goal[k] = feet[leg, k] if leg != ALL_STAND else 0.0
    _level_stance(tree, ground, rules, parent, turn, feet, b0)
    test, tree.lift[node] = _proven(legs.table, legs.swing, rules, ground, turn, feet, goal, leg, b0, b1)
    return test


@compiled
def judge(
    legs: Legs,
    rules: Rules,
    ground: Ground,
    feet: Array,
    leg: int,
    b0: Array,
    bodies: Array,
    goals: Array,
    verdict: NDArray[np.int64],
    lifts: Array,
) -> None:
    """Run all tests of an expansion on given samples, as `grow` does (benchmark).

    Args:
        legs, rules, ground: Parameters of the tests.
        feet: (6, 3) [m] {strip} standing feet, all of which have moved since the root.
        leg: The swinging leg.
        b0: (3,) [m] {strip} body at the start.
        bodies: (m, 3) [m] {strip} bodies at the end.
        goals: (m, n, 3) [m] {strip} footholds for each.
        verdict: (m, n) output: the first failed test, or OK.
        lifts: (m, n) [m] output: clearances.
    """
    table, codes, turn = legs.table, np.zeros(6, np.int32), (1.0, 0.0)
    verdict[:], lifts[:] = OK, 0.0
    begin = _support(rules, feet, leg, b0[0], b0[1])
    strained, _, _ = _stands(table, rules, codes, feet, leg, b0[0], b0[1], b0[2], _WITH_TORQUES)
    for m in range(len(bodies)):
        b1 = bodies[m]
        test, _, _ = _stands(table, rules, codes, feet, leg, b1[0], b1[1], b1[2], _WITH_TORQUES)
        if test == OK:
            mid = 0.5 * (b0 + b1)
            test, _, _ = _stands(table, rules, codes, feet, leg, mid[0], mid[1], mid[2], _WITHOUT_TORQUES)
        if begin < rules.margin or (strained != TORQUE and _support(rules, feet, leg, b1[0], b1[1]) < rules.margin):
            test = MARGIN
        elif strained == TORQUE:
            test = TORQUE
        clear = -1
        for n in range(goals.shape[1]):
            verdict[m, n] = test if test != OK else _landing(table, rules, feet, leg, b1, goals[m, n])
            if verdict[m, n] != OK:
                continue
            if clear < 0:
                clear = _way_clear(table, rules, ground, turn, feet, leg, b0, b1)
            verdict[m, n] = clear
            if clear == OK:
                goal = goals[m, n]
                verdict[m, n], lifts[m, n] = _lifted(table, legs.swing, rules, ground, turn, feet, goal, leg, b0, b1)


@compiled
def judge_all(
    legs: Legs,
    rules: Rules,
    ground: Ground,
    feet: Array,
    leg: NDArray[np.int64],
    b0: Array,
    bodies: Array,
    goals: Array,
    verdict: NDArray[np.int64],
    lifts: Array,
) -> None:
    """Run `judge` for many expansions: all arguments have one more leading axis."""
    for k in range(len(leg)):
        judge(legs, rules, ground, feet[k], leg[k], b0[k], bodies[k], goals[k], verdict[k], lifts[k])


# Queue and table ------------------------------------------------------------------------------------------------------------


@compiled
def _push(tree: Tree, key: float, node: int, turn: int) -> bool:
    """Queue a configuration; return False if the queue is full."""
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
    """Remove and return the configuration with the lowest key, and its turn."""
    first = tree.key[0], _wide(tree.queued[0]), _wide(tree.turn[0])
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
def _square(foot: NDArray[np.int32], node: int, leg: int, ny: int, edge: int) -> int:
    """Return the square of `edge` cells in which a foot of a configuration stands."""
    code = foot[node, leg]
    return int((code // ny) // edge * ny + (code % ny) // edge if code >= 0 and edge > 1 else code)


@compiled
def _known(
    body: Array,
    yaw: NDArray[np.int16],
    foot: NDArray[np.int32],
    table: NDArray[np.int32],
    node: int,
    edge: float,
    foot_edge: int,
    ny: int,
) -> bool:
    """Return whether an equivalent configuration is known; if not, store the node.

    Configurations are equivalent if body and feet are in the same squares, and the yaw is the same.
    """
    ix, iy = math.floor(body[node, 0] / edge + 0.5), math.floor(body[node, 1] / edge + 0.5)
    h = _mixed(_mixed(_mixed(np.uint64(88172645463325252), ix), iy), yaw[node])
    for leg in range(6):
        h = _mixed(h, _square(foot, node, leg, ny, foot_edge))
    mask = np.int64(len(table) - 1)
    at = np.int64(h & np.uint64(mask))
    while table[at] >= 0:
        other = _wide(table[at])
        same = math.floor(body[other, 0] / edge + 0.5) == ix and math.floor(body[other, 1] / edge + 0.5) == iy
        same = same and yaw[other] == yaw[node]
        for leg in range(6):
            same = same and _square(foot, node, leg, ny, foot_edge) == _square(foot, other, leg, ny, foot_edge)
        if same:
            return True
        at = (at + 1) & mask
    table[at] = node
    return False


# Growing --------------------------------------------------------------------------------------------------------------------


@compiled
def _fail(tree: Tree, far: bool, test: int, leg: int) -> None:
    place = leg if leg >= 0 else 6
    tree.fails[0, test, place] += 1
    if far:
        tree.fails[1, test, place] += 1


@compiled
def _to_go(tree: Tree, legs: Legs, rules: Rules, feet: Array, x: float, bx: float) -> float:
    """Return the estimated steps to go [1], from the body's distance and the feet (6, 3) {level}.

    `x` is the body's place {strip} and `bx` the one {level} [m].
    """
    ahead = max(tree.goal[0] - x, 0.0)
    lag = lagging = 0.0
    for leg in range(6):
        behind = bx + legs.rest[leg, 0] - feet[leg, 0]
        lag += max(ahead + behind, 0.0) / 6.0
        lagging += (max(behind, 0.0) / legs.stroke[leg, 0]) ** 2
    return float(0.5 * (ahead + lag) / rules.step_gain + rules.lag_price * lagging)


@compiled
def _crowd(tree: Tree, rest: Array, feet: Array, x: float, bx: float) -> int:
    """Return the progress bin of a configuration: the mean progress of body and feet.

    The arguments are those of `_to_go`.
    """
    progress = x
    for leg in range(6):
        progress += (feet[leg, 0] + (x - bx) - rest[leg, 0]) / 6.0
    return min(max(math.floor(0.5 * progress / _CROWD), 0), len(tree.visits) - 1)


@compiled
def _key(tree: Tree, legs: Legs, rules: Rules, node: int, feet: Array, turn: int) -> float:
    """Return the queue key of a configuration with feet (6, 3) {level}; the lowest is expanded first.

    This is the weight of Masri 2016, eq. (5.5), with a correction. He takes F - d_g / d and expands the lowest, which would
    reward distance to go. Here that distance is added. F is part of the cost, as the difference of each foothold from the best.
    A place with many expansions becomes more expensive, so that a search without progress continues further back.
    """
    x = tree.body[node, 0]
    bx, _ = _to_level(_turn_of(rules, tree.yaw[node]), x, tree.body[node, 1])
    crowded = rules.crowd_price * tree.visits[_crowd(tree, legs.rest, feet, x, bx)]
    again = rules.turn_price * (turn + 7.0 * (turn // 7))
    return float(tree.cost[node] + rules.eager * _to_go(tree, legs, rules, feet, x, bx) + again + crowded)


@compiled
def _add(
    tree: Tree,
    ground: Ground,
    legs: Legs,
    rules: Rules,
    parent: int,
    leg: int,
    body: Array,
    yaw: int,
    code: int,
    feet: Array,
    price: float,
    margin: float,
) -> bool:
    """Add a configuration, with body and feet {level}, unless it is known; return False if the memory is full."""
    node = tree.counts[NODES]
    if node >= len(tree.parent):
        return False
    tree.body[node, 0], tree.body[node, 1] = _to_strip(_turn_of(rules, yaw), body[0], body[1])
    tree.body[node, 2], tree.yaw[node] = body[2], yaw
    for k in range(6):
        tree.foot[node, k] = tree.foot[parent, k]
    if leg >= 0:
        tree.foot[node, leg] = code
    ny = ground.evaluation.shape[1]
    if _known(tree.body, tree.yaw, tree.foot, tree.table, node, rules.alike_body, rules.alike_foot, ny):
        return True
    tree.counts[NODES] = node + 1
    tree.parent[node], tree.leg[node], tree.depth[node] = parent, leg, tree.depth[parent] + 1
    tree.state[node], tree.lift[node], tree.margin[node] = OPEN, 0.0, margin
    cost = tree.cost[parent] + 1.0 + price
    tree.cost[node] = cost
    return _push(tree, _key(tree, legs, rules, node, feet, _FIRST_TURN), node, _FIRST_TURN)


@compiled
def _swung_last(tree: Tree, node: int) -> int:
    """Return the leg that swung last on the path to a configuration, or none."""
    while tree.leg[node] < 0 and tree.parent[node] >= 0:
        node = tree.parent[node]
    return int(tree.leg[node])


@compiled
def _next_leg(
    rest: Array, stroke: Array, order: NDArray[np.int64], feet: Array, bx: float, last: int, turn: int, turns: bool
) -> int:
    """Return the leg for which a configuration is expanded.

    The order is: the due leg, the others by their lag, then none. If the body turns, none comes after the due leg.
    """
    due = order[0]
    for k in range(6):
        if order[k] == last:
            due = order[(k + 1) % 6]
    if turn == 0:
        return int(due)
    if turns:
        turn = turn - 1 if turn > 1 else 6
    if turn > 5:
        return ALL_STAND
    # Of the legs not yet taken, select the one with the largest lag. With six legs, counting those before each is enough.
    for leg in range(6):
        lag = (bx + rest[leg, 0] - feet[leg, 0]) / stroke[leg, 0]
        before = 0
        for k in range(6):
            other = (bx + rest[k, 0] - feet[k, 0]) / stroke[k, 0]
            if k != due and k != leg and (other > lag or (other == lag and k < leg)):
                before += 1
        if leg != due and before == turn - 1:
            return leg
    return ALL_STAND


@compiled
def _place_price(rules: Rules, legs: Legs, ground: Ground, leg: int, code: int, y: float, by: float) -> float:
    """Return the price of a foothold: higher near an edge and off the nominal track.

    That is the track of a body in the middle of the strip, or of the body as it turns.
    """
    F = ground.evaluation[code // ground.evaluation.shape[1], code % ground.evaluation.shape[1]]
    poor = max(0, F + 3)
    aside = abs(y - (by if rules.yaw_change > 0 else 0.0) - legs.rest[leg, 1])
    return float(rules.foothold_price * poor + rules.aside_price * aside)


@compiled
def _expand_for(tree: Tree, ground: Ground, legs: Legs, rules: Rules, node: int, leg: int, far: bool, work: Array) -> bool:
    """Expand a configuration for one leg: up to m body motions, n footholds each.

    `work` (12, 3) is memory; its first six rows are the feet {level} afterwards. Return False if the memory is full.
    """
    feet, after = work[:6], work[6:12]
    codes, yaw = tree.foot[node], _wide(tree.yaw[node])
    turn, b0 = _turn_of(rules, yaw), np.empty(3)
    _level_stance(tree, ground, rules, node, turn, feet, b0)
    begin = _support(rules, feet, leg, b0[0], b0[1])
    if begin < rules.margin:
        _fail(tree, far, MARGIN, leg)
        return True
    test, which, strained = _stands(legs.table, rules, codes, feet, leg, b0[0], b0[1], b0[2], _WITH_TORQUES)
    if test == TORQUE:
        _fail(tree, far, test, which)
        return True
    height = _floor(feet, leg, rules.foot_radius) + rules.height
    body = np.empty(3)
    body[2] = min(max(height, b0[2] - rules.climb), b0[2] + rules.climb)
    last_x, last_y = np.empty(rules.move_samples), np.empty(rules.move_samples)
    for m in range(rules.move_samples):
        distance = rules.body_low + (rules.body_high - rules.body_low) * _uniform(tree.random)
        phi = rules.body_angle * _bell(tree.random)
        if m == 0 and tree.depth[node] == 0:
            distance = 0.0  # a repaired stance may not allow motion before its first step
        dx, dy = distance * math.cos(phi), distance * math.sin(phi)
        body[0] = rules.lattice * round((b0[0] + dx) / rules.lattice)
        body[1] = rules.lattice * round((b0[1] + dy) / rules.lattice)
        if rules.sway > 0.0:
            swayed = height + rules.sway * (2.0 * _uniform(tree.random) - 1.0)
            if rules.uneven:
                low, high = _height_range(legs.table, feet, leg, body[0], body[1])
                swayed = max(min(swayed, high - _INSIDE), low + _INSIDE)
            body[2] = min(max(swayed, b0[2] - rules.climb), b0[2] + rules.climb)
        if rules.yaw_change > 0 and leg < 0:
            change = math.floor((2 * rules.yaw_change + 1) * _uniform(tree.random)) - rules.yaw_change
            after_turn = min(max(yaw + change, -rules.yaw_most), rules.yaw_most)
            if after_turn != yaw:
                if not _expand_turn(tree, ground, legs, rules, node, after_turn, turn, body, after, begin, strained, far):
                    return False
                continue
        last_x[m], last_y[m] = body[0], body[1]
        known = leg < 0 and abs(body[0] - b0[0]) + abs(body[1] - b0[1]) < 1e-6
        for k in range(m):
            known = known or (abs(last_x[k] - body[0]) + abs(last_y[k] - body[1]) < 1e-6)
        if known or not _in_drift(tree, rules, turn, body):
            continue
        # 1. Body motion, with the legs that stand.
        margin = min(begin, _support(rules, feet, leg, body[0], body[1]))
        if margin < rules.margin:
            _fail(tree, far, MARGIN, leg)
            continue
        test, which, torque = _stands(legs.table, rules, codes, feet, leg, body[0], body[1], body[2], _WITH_TORQUES)
        if test == OK:
            mid = 0.5 * (b0 + body)
            test, which, _ = _stands(legs.table, rules, codes, feet, leg, mid[0], mid[1], mid[2], _WITHOUT_TORQUES)
        if test != OK:
            _fail(tree, far, test, which)
            continue
        price = _stance_price(rules, margin, max(torque, strained))
        if leg < 0:
            if not _add(tree, ground, legs, rules, node, leg, body, yaw, ROOT_FOOT, feet, rules.still_price + price, margin):
                return False
            continue
        # 2. Footholds of the swinging leg.
        if not _footholds(tree, ground, legs, rules, node, leg, body, turn, feet, after, price, margin, far):
            return False
    return True


@compiled
def _in_drift(tree: Tree, rules: Rules, turn: Turn, body: Array) -> bool:
    """Return whether a body (3,) {level} is near enough to the middle of the strip."""
    _, y = _to_strip(turn, body[0], body[1])
    return bool(abs(y) <= rules.drift + max(abs(tree.body[0, 1]) - rules.drift, 0.0))


@compiled
def _stance_price(rules: Rules, margin: float, torque: float) -> float:
    """Return the price of a small support margin and of a large torque."""
    price = rules.margin_price * max(0.0, 2.0 * rules.margin - margin)
    price += rules.torque_price * max(0.0, torque - rules.easy_torque)
    return float(price)


@compiled
def _expand_turn(
    tree: Tree,
    ground: Ground,
    legs: Legs,
    rules: Rules,
    node: int,
    yaw: int,
    turn: Turn,
    body: Array,
    feet: Array,
    margin: float,
    strained: float,
    far: bool,
) -> bool:
    """Add a turn of the body to a yaw [lattice steps] while all feet stand; return False if the memory is full.

    `turn` is the one of the configuration, and `body` (3,) the place after the motion in its frame {level}. `feet` (6, 3) is
    memory.
    """
    if not _in_drift(tree, rules, turn, body):
        return True
    end, b0, at, torque = _to_strip(turn, body[0], body[1]), tree.body[node], np.empty(3), 0.0
    half_turn = 0.5 * (yaw - tree.yaw[node])
    for half in range(1, 3):
        s = 0.5 * half
        turned = _turn_of(rules, tree.yaw[node] + half * half_turn)
        _level_stance(tree, ground, rules, node, turned, feet, at)
        at[0], at[1] = _to_level(turned, b0[0] + s * (end[0] - b0[0]), b0[1] + s * (end[1] - b0[1]))
        at[2] = b0[2] + s * (body[2] - b0[2])
        margin = min(margin, _support(rules, feet, ALL_STAND, at[0], at[1]))
        test, which, torque = _stands(legs.table, rules, tree.foot[node], feet, ALL_STAND, at[0], at[1], at[2], _WITH_TORQUES)
        if margin < rules.margin or test != OK:
            _fail(tree, far, test if test != OK else MARGIN, which)
            return True
    price = rules.still_price + _stance_price(rules, margin, max(torque, strained))
    return _add(tree, ground, legs, rules, node, ALL_STAND, at, yaw, ROOT_FOOT, feet, price, margin)


@compiled
def _has_sunk(ground: Ground, code: int, x: float, y: float) -> bool:
    """Return whether a foot stands, since the root, on ground that the map excludes.

    That ground gave way under the foot, so the foot may step back.
    """
    if code != ROOT_FOOT:
        return False
    i = math.floor((x - ground.x0) / ground.resolution + 0.5)
    j = math.floor((y - ground.y0) / ground.resolution + 0.5)
    nx, ny = ground.evaluation.shape
    return bool(0 <= i < nx and 0 <= j < ny and ground.evaluation[i, j] >= 0)


@compiled
def _footholds(
    tree: Tree,
    ground: Ground,
    legs: Legs,
    rules: Rules,
    node: int,
    leg: int,
    body: Array,
    turn: Turn,
    feet: Array,
    after: Array,
    price: float,
    margin: float,
    far: bool,
) -> bool:
    """Add configurations with footholds for one body motion; False if memory is full.

    Body and feet are {level}, turned by `turn`.
    """
    F = ground.evaluation
    nx, ny = F.shape
    tip_x = body[0] + legs.rest[leg, 0] - legs.stroke[leg, 0] - rules.foot_back
    tip_y = body[1] + legs.rest[leg, 1]
    whole = legs.stroke[leg, 0] + legs.stroke[leg, 1]
    farthest = rules.foot_back + rules.foot_high * whole
    nearest = rules.foot_back + rules.foot_low * whole
    rearmost = feet[leg, 0] - rules.backward
    foot_x, foot_y = _to_strip(turn, feet[leg, 0], feet[leg, 1])
    if _has_sunk(ground, tree.foot[node, leg], foot_x, foot_y):
        rearmost, nearest = -np.inf, rules.foot_back  # as far back as the leg reaches
    else:
        nearest = max(nearest, feet[leg, 0] - tip_x)  # forward
        if nearest >= farthest:
            return True
    tried = np.empty(rules.foot_samples, np.int64)
    for n in range(rules.foot_samples):
        tried[n] = -1
        distance = nearest + (farthest - nearest) * _uniform(tree.random)
        phi = rules.foot_angle * _bell(tree.random)
        x, y = _to_strip(turn, tip_x + distance * math.cos(phi), tip_y + distance * math.sin(phi))
        i = math.floor((x - ground.x0) / ground.resolution + 0.5)
        j = math.floor((y - ground.y0) / ground.resolution + 0.5)
        if not (0 <= i < nx and 0 <= j < ny):
            _fail(tree, far, UNKNOWN, leg)
            continue
        unseen = F[i, j] == _NEVER_SEEN  # later failures of this sample may be due to unseen ground
        if unseen and ground.nearest[i, j] >= 0:
            i, j = ground.nearest[i, j] // ny, ground.nearest[i, j] % ny
        code = _wide(ground.meant[i, j])
        if code < 0:
            a, b = _resolved(F, i, j, rules.strong, rules.wide)
            a, b = _lowest(F, a, b, rules.central, rules.inward)
            code = a * ny + b
            ground.meant[i, j] = code
        known = False
        for k in range(n):
            known = known or tried[k] == code
        if known:
            if unseen:
                _fail(tree, far, UNKNOWN, leg)
            continue
        tried[n] = code
        i, j = code // ny, code % ny
        if F[i, j] > rules.weakest or not ground.elevation[i, j] > -np.inf:
            _fail(tree, far, UNKNOWN if unseen else FOOTHOLD, leg)
            continue
        x, y, z = _foot(tree, ground, rules, code, leg)
        x, y = _to_level(turn, x, y)
        if x < rearmost or code == tree.foot[node, leg]:
            if unseen:
                _fail(tree, far, UNKNOWN, leg)
            continue
        for k in range(6):
            after[k, 0], after[k, 1], after[k, 2] = feet[k, 0], feet[k, 1], feet[k, 2]
        after[leg, 0], after[leg, 1], after[leg, 2] = x, y, z
        test = _landing(legs.table, rules, feet, leg, body, after[leg])
        if test != OK:
            _fail(tree, far, UNKNOWN if unseen else test, leg)
            continue
        place = _place_price(rules, legs, ground, leg, code, y, body[1])
        yaw = _wide(tree.yaw[node])
        if not _add(tree, ground, legs, rules, node, leg, body, yaw, code, after, price + place, margin):
            return False
    return True


@compiled
def grow(tree: Tree, ground: Ground, legs: Legs, rules: Rules, expansions: int) -> int:
    """Expand configurations; return the number of expansions.

    It is lower than requested if the search ends: with `counts[GOAL]` set, with an empty queue, or with full memory.
    """
    work, level = np.empty((12, 3)), np.empty(3)
    done = 0
    while done < expansions and tree.counts[QUEUED] > 0 and tree.counts[GOAL] < 0:
        _, node, turn = _pop(tree)
        if tree.state[node] == OPEN:
            test = _proof(legs, rules, ground, tree, node)
            tree.counts[PROVED] += 1
            if test != OK:
                tree.state[node] = REFUSED
                _fail(
                    tree,
                    tree.body[tree.parent[node], 0] > tree.body[tree.counts[FURTHEST], 0] - 0.02,
                    test,
                    _wide(tree.leg[node]),
                )
                done += 1
                tree.counts[EXPANDED] += 1
                continue
            tree.state[node] = PROVEN
            if tree.body[node, 0] >= tree.goal[0] - 1e-9 or tree.depth[node] >= rules.depth:
                tree.counts[GOAL] = node
                done += 1
                break
            if tree.body[node, 0] > tree.body[tree.counts[FURTHEST], 0] + 1e-9:
                tree.counts[FURTHEST] = node
                tree.fails[1] = 0
        far = tree.body[node, 0] > tree.body[tree.counts[FURTHEST], 0] - 0.02
        _level_stance(tree, ground, rules, node, _turn_of(rules, tree.yaw[node]), work, level)
        x, bx, last = tree.body[node, 0], level[0], _swung_last(tree, node)
        leg = _next_leg(legs.rest, legs.stroke, legs.order, work, bx, last, turn % 7, rules.yaw_change > 0)
        tree.visits[_crowd(tree, legs.rest, work, x, bx)] += 1
        room = _expand_for(tree, ground, legs, rules, node, leg, far, work)
        if turn + 1 < 7 * rules.rounds:
            room = _push(tree, _key(tree, legs, rules, node, work, turn + 1), node, turn + 1) and room
        done += 1
        tree.counts[EXPANDED] += 1
        if not room:
            tree.counts[QUEUED] = 0
    return done


@compiled
def faults(legs: Legs, rules: Rules, limits: int, feet: Array, body: Array, found: NDArray[np.int64]) -> None:
    """Write the failed test of each leg of a stance, then of the robot, to (7,).

    `limits` is `WITH_RESERVE` or `WITHOUT_RESERVE`.
    """
    for leg in range(6):
        test, _, _, _, _, _, _ = _leg(
            legs.table, limits, leg, feet[leg, 0] - body[0], feet[leg, 1] - body[1], feet[leg, 2] - body[2]
        )
        found[leg] = test
    found[6] = OK if _support(rules, feet, ALL_STAND, body[0], body[1]) >= rules.margin else MARGIN


@compiled
def landings(legs: Legs, leg: int, places: Array, found: NDArray[np.int64]) -> None:
    """Write to (n,) the failed test of a leg for foot places (n, 3) [m] {body}."""
    for n in range(len(places)):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        found[n] = _placed(legs.table, leg, x, y)
        if found[n] == OK:
            found[n], _, _, _, _, _, _ = _leg(legs.table, WITH_RESERVE, leg, x, y, z)
