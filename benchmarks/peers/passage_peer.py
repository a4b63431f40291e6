"""The tests of a roadmap expansion in plain NumPy.

Their speed and results are compared with the compiled tests. They are optimised as usual in NumPy: whole arrays over motions,
footholds, legs and times. Failed candidates are not tested further.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.roadmap.roadmap_search import (
    APART,
    GROUND,
    LEGS,
    LEVEL,
    MARGIN,
    OK,
    REACH,
    SWING,
    TORQUE,
    UNDER,
    Ground,
    Legs,
    Rules,
)
from sextant.shared.geometry import Array

Verdicts = NDArray[np.int64]
_AXIS = 0.035  # [m] minimum distance of a foot from its coxa axis
_PIECES = 12  # pieces between two sampled times
# Time, progress along the path, and level at the steepest parts of a swing: rise and fall.
_STEEP = np.array([[0.20, 0.05, 0.70], [0.82, 0.95, 0.40]])
_FLIES = 0.8  # share of its clearance at which a swing is taken to fly


class NumpyTests:
    """`sextant.services.planner.roadmap.roadmap_search.judge` in NumPy."""

    def __init__(self, legs: Legs, rules: Rules, ground: Ground):
        """Store the parameters of the tests."""
        table = legs.table
        self._rules, self._ground, self._shape = rules, ground, legs.swing
        self._mount, self._yaw = table[0, :, :3], table[0, :, 3:5]
        self._coxa, self._femur, self._knee, self._way = (
            table[:, :, 5:10],
            table[:, :, 10:15],
            table[:, :, 15:17],
            table[1, :, 17:19],
        )
        self._links, self._fore, self._room = table[0, 0, 19:22], table[0, :, 22], table[0, 0, 23:25]

    def judge(self, feet: Array, leg: int, b0: Array, bodies: Array, goals: Array) -> tuple[Verdicts, Array]:
        """Return the first failing tests (m, n) and the clearances [m].

        They are for a leg's footholds (m, n, 3) and motions (m, 3) of the body.
        """
        m, n = goals.shape[:2]
        verdict, lifts = np.zeros((m, n), dtype=np.int64), np.zeros((m, n))
        standing = np.delete(np.arange(6), leg)
        both = np.concatenate([b0[None], bodies])
        margins = self._support(feet[standing], both)
        tests = self._stands(feet, standing, np.concatenate([both, 0.5 * (b0 + bodies)]), m + 1)
        end, middle = tests[1 : m + 1], tests[m + 1 :]
        test = np.where(end != OK, end, middle)
        if margins[0] < self._rules.margin:
            test[:] = MARGIN
        elif tests[0] == TORQUE:
            test[:] = TORQUE
        else:
            test[margins[1:] < self._rules.margin] = MARGIN
        verdict[:] = np.where(test[:, None] != OK, test[:, None], self._landing(feet[standing], leg, bodies[:, None], goals))
        left = np.argwhere(verdict == OK)
        if len(left):
            motion, which = np.unique(left[:, 0], return_inverse=True)
            clear = self._stance_clear(feet, standing, b0, bodies[motion])[which]
            verdict[tuple(left.T)] = clear
            left = left[clear == OK]
            verdict[tuple(left.T)], lifts[tuple(left.T)] = self._lifted(feet, leg, b0, bodies[left[:, 0]], goals[tuple(left.T)])
        return verdict, lifts

    def _support(self, feet: Array, bodies: Array) -> Array:
        """Return stability margins (k,) from the edges between feet."""
        edge = np.roll(feet, -1, axis=0)[:, :2] - feet[:, :2]
        off = bodies[:, None, :2] - feet[:, :2]
        length = np.sqrt(edge[:, 0] * edge[:, 0] + edge[:, 1] * edge[:, 1])
        return np.asarray(((edge[:, 1] * off[..., 0] - edge[:, 0] * off[..., 1]) / length).min(axis=1))

    def _leg(self, strict: int, legs: NDArray[np.intp], p: Array) -> tuple[NDArray[np.bool_], Array, Array, Array, Array]:
        """Return whether feet (..., k, 3) {body} of k legs are reachable, with geometry.

        The geometry is the reach, the shank's part, the direction, and the knee outward and upward.
        """
        local = p - self._mount[legs]
        coxa, f, t = self._links
        out = np.sqrt(local[..., 0] * local[..., 0] + local[..., 1] * local[..., 1])
        reach, z = out - coxa, local[..., 2]
        d2 = reach * reach + z * z
        knee = (d2 - f * f - t * t) / (2.0 * f * t)
        bent = (out >= _AXIS) & (knee >= self._knee[strict, legs, 0]) & (knee <= self._knee[strict, legs, 1])
        across = -t * np.sqrt(np.maximum(1.0 - knee * knee, 0.0))
        along = f + t * knee
        fc, fs = reach * along + z * across, z * along - reach * across
        ok = bent & self._turned(strict, legs, local, fc, fs)
        knee_out, knee_up = np.where(bent, f * fc / d2, 0.0), np.where(bent, f * fs / d2, 0.0)
        way = np.where(bent[..., None], local[..., :2] / np.maximum(out, 1e-12)[..., None], np.array([1.0, 0.0]))
        shank = np.where(bent, reach - f * fc / d2, 0.0)
        return ok, reach, shank, way, np.stack([knee_out, knee_up], axis=-1)

    def _turned(self, strict: int, legs: NDArray[np.intp], local: Array, fc: Array, fs: Array) -> NDArray[np.bool_]:
        c, s = self._yaw[legs, 0], self._yaw[legs, 1]
        px, py = local[..., 0], local[..., 1]
        turned = _between(px * c + py * s, py * c - px * s, self._coxa[strict, legs])
        return turned & _between(fc, fs, self._femur[strict, legs])

    def _turns(self, leg: int, p: Array) -> NDArray[np.bool_]:
        """Return whether coxa and femur angles for feet (..., 3) {body} are within limits.

        The knee is within its reach or at the end of it.
        """
        local = p - self._mount[leg]
        coxa, f, t = self._links
        reach, z = np.sqrt(local[..., 0] * local[..., 0] + local[..., 1] * local[..., 1]) - coxa, local[..., 2]
        knee = np.clip((reach * reach + z * z - f * f - t * t) / (2.0 * f * t), -1.0, 1.0)
        across, along = -t * np.sqrt(1.0 - knee * knee), f + t * knee
        return self._turned(0, np.intp(leg), local, reach * along + z * across, z * along - reach * across)  # type: ignore[arg-type]

    def _placed(self, legs: NDArray[np.intp], p: Array) -> Verdicts:
        under = (np.abs(p[..., 0]) < self._room[0]) & (np.abs(p[..., 1]) < self._room[1])
        level = self._fore[legs] * (p[..., 0] - self._mount[legs, 0]) < 0.0
        return np.where(under, UNDER, np.where(level, LEVEL, OK))

    def _stands(self, feet: Array, standing: NDArray[np.intp], bodies: Array, loaded: int) -> Verdicts:
        """Return the first failing tests (k,) of the standing legs for bodies (k, 3).

        Torques are tested only at the first of them.
        """
        there = feet[standing]
        ok, reach, shank, _, _ = self._leg(0, standing, there - bodies[:, None])
        tests = np.where(ok, self._placed(standing, there - bodies[:, None]), REACH)
        off = there[:, :2] - there[:, :2].mean(axis=0)
        sxx, sxy, syy = (off[:, 0] ** 2).sum(), (off[:, 0] * off[:, 1]).sum(), (off[:, 1] ** 2).sum()
        gx, gy = (bodies[:, :2] - there[:, :2].mean(axis=0)).T
        determinant = sxx * syy - sxy * sxy
        kx, ky = (syy * gx - sxy * gy) / determinant, (sxx * gy - sxy * gx) / determinant
        share = 1.0 / len(standing) + kx[:, None] * off[:, 0] + ky[:, None] * off[:, 1]
        torque = self._rules.weight * np.maximum(share, 0.0) * np.maximum(np.abs(reach), self._rules.knee * np.abs(shank))
        strained = (torque > self._rules.torque) & (np.arange(len(bodies)) < loaded)[:, None]
        return _first(np.where(tests != OK, tests, np.where(strained, TORQUE, OK)))

    def _landing(self, others: Array, leg: int, bodies: Array, goals: Array) -> Verdicts:
        test = self._placed(np.intp(leg), goals - bodies)  # type: ignore[arg-type]
        ok = self._leg(0, np.array([leg]), (goals - bodies)[..., None, :])[0][..., 0]
        gap = ((others[:, :2] - goals[..., None, :2]) ** 2).sum(axis=-1).min(axis=-1)
        return np.where(test != OK, test, np.where(~ok, REACH, np.where(gap < self._rules.feet_apart**2, APART, OK)))

    def _poses(self, legs: NDArray[np.intp], bodies: Array, feet: Array) -> Array:
        """Return femur axes, knees and feet (..., k, 3, 3) {strip} of k legs.

        Their feet are (..., k, 3), the bodies (..., 3).
        """
        _, _, _, way, knee = self._leg(1, legs, feet - bodies[..., None, :])
        mounts = bodies[..., None, :] + self._mount[legs]
        points = np.empty((*feet.shape[:-1], 3, 3))
        points[..., 0, :2] = mounts[..., :2] + self._links[0] * way
        points[..., 0, 2] = mounts[..., 2]
        points[..., 1, :2] = mounts[..., :2] + (self._links[0] + knee[..., :1]) * way
        points[..., 1, 2] = mounts[..., 2] + knee[..., 1]
        points[..., 2, :] = feet
        return points

    def _top(self, x: Array, y: Array) -> Array:
        ground = self._ground
        i, j = (np.floor((v - v0) / ground.resolution + 0.5).astype(np.int64) for v, v0 in ((x, ground.x0), (y, ground.y0)))
        inside = (i >= 0) & (j >= 0) & (i < ground.top.shape[0]) & (j < ground.top.shape[1])
        return np.where(inside, ground.top[np.where(inside, i, 0), np.where(inside, j, 0)].astype(np.float64), -np.inf)

    def _shank_clear(self, poses: Array) -> NDArray[np.bool_]:
        foot, knee = poses[..., None, 2, :], poses[..., None, 1, :]
        p = foot + np.array([0.25, 0.5, 0.75, 1.0])[:, None] * (knee - foot)
        return np.asarray(~(p[..., 2] - self._top(p[..., 0], p[..., 1]) < self._rules.leg_clear).any(axis=-1))

    def _stance_clear(self, feet: Array, standing: NDArray[np.intp], b0: Array, b1: Array) -> Verdicts:
        """Test the clearances (k,) of trunk and standing legs.

        They are the distances to the ground and to each other, halfway and at the end.
        """
        rules, step = self._rules, 2.0 * self._ground.resolution
        x = -rules.half_length + step * np.arange(int((2.0 * rules.half_length + 1e-9) / step) + 1)
        y = -rules.half_width + step * np.arange(int((2.0 * rules.half_width + 1e-9) / step) + 1)
        under = self._top(*np.broadcast_arrays(b1[:, 0, None, None] + x[:, None], b1[:, 1, None, None] + y))
        trunk = (under > (b1[:, 2] - rules.half_height - rules.body_clear)[:, None, None]).any(axis=(1, 2))
        test = np.where(trunk, GROUND, OK)
        beside = [(a, b) for a, b in zip(range(5), [*range(1, 5), 0], strict=True) if (standing[b] - standing[a]) % 6 == 1]
        one, other = np.array(beside).T
        for s in (0.5, 1.0):
            bodies = b0 + s * (b1 - b0)
            poses = self._poses(standing, bodies, np.broadcast_to(feet[standing], (len(b1), 5, 3)))
            low = ~self._shank_clear(poses).all(axis=1)
            near = _collide(poses[:, one], poses[:, other], rules.legs_apart).any(axis=1)
            test = np.where(test != OK, test, np.where(low, GROUND, np.where(near, LEGS, OK)))
        return test

    def _lifted(self, feet: Array, leg: int, b0: Array, b1: Array, goals: Array) -> tuple[Verdicts, Array]:
        """Return the minimum clearances [m] (k,) for valid swings.

        Without one, return the tests that the highest swing fails.
        """
        rules = self._rules
        test, lifts, lift = np.full(len(goals), SWING), np.zeros(len(goals)), rules.least_lift
        while lift <= rules.most_lift + 1e-9:
            left = np.flatnonzero(test != OK)
            if not len(left):
                break
            test[left] = self._swing(feet, leg, b0, b1[left], goals[left], lift, False)
            left = left[test[left] == OK]
            if len(left):
                test[left] = self._swing(feet, leg, b0, b1[left], goals[left], lift, True)
            lifts[left[test[left] == OK]] = lift
            lift += rules.lift_step
        return test, lifts

    def _swing(self, feet: Array, leg: int, b0: Array, b1: Array, goals: Array, lift: float, smooth: bool) -> Verdicts:
        rules, (time, along, up), start = self._rules, self._shape, feet[leg]
        move = b1 - b0
        early, late = 0.5 * time[1], 0.5 * (1.0 - time[-2])
        first, last = start - b0 - early * move, goals - b1 + late * move
        first[:, 2], last[:, 2] = start[2] - b0[2], goals[:, 2] - b1[:, 2]
        stuck = ~(self._turns(leg, first) & self._turns(leg, last))
        level = np.maximum(start[2], goals[:, 2]) + _FLIES * lift
        end_z = np.where(np.arange(len(time)) < len(time) // 2, start[2], goals[:, 2:])
        xy = start[:2] + along[:, None] * (goals[:, None, :2] - start[:2])
        share = time * time * (3.0 - 2.0 * time) if smooth else time
        bodies = b0 + share[:, None] * move[:, None]
        low = np.concatenate([xy, (end_z + up * (level[:, None] - end_z))[..., None]], axis=-1)
        high = np.concatenate([xy, (end_z + up * (level[:, None] + (1.0 - _FLIES) * lift - end_z))[..., None]], axis=-1)
        high, _ = self._into_reach(leg, bodies, high)
        way, moved = self._into_reach(leg, bodies, low)
        inner = np.arange(len(time)) > 0
        local = low - bodies - self._mount[leg]
        whirls = local[..., 0] * local[..., 0] + local[..., 1] * local[..., 1] < _AXIS * _AXIS
        most = np.where(np.arange(len(time)) < len(time) - 1, rules.moved_most, 1e-3)
        reach = inner & (whirls | (moved > most) | ~(self._turns(leg, high - bodies) & self._turns(leg, way - bodies)))
        own = self._poses(np.array([leg]), bodies, way[..., None, :])
        ground = ~self._shank_clear(own)[..., 0]
        near = self._near(leg, bodies, way, feet)
        steep = self._steep(feet, leg, b0, move, goals, lift, smooth)
        low_way = self._passes_low(leg, bodies, low, start, goals)
        tests = np.where(reach, REACH, np.where(ground, GROUND, np.where(near, LEGS, np.where(low_way, SWING, OK))))
        return np.where(stuck, REACH, np.where(steep, LEGS, _first(tests)))

    def _steep(
        self, feet: Array, leg: int, b0: Array, move: Array, goals: Array, lift: float, smooth: bool
    ) -> NDArray[np.bool_]:
        """Return which swings (k,) come near a neighbouring leg in their steepest parts."""
        (time, along, up), start = _STEEP.T, feet[leg]
        share = time * time * (3.0 - 2.0 * time) if smooth else time
        bodies = b0 + share[:, None] * move[:, None]
        level = np.maximum(start[2], goals[:, 2:]) + lift
        end_z = np.stack([np.full(len(goals), start[2]), goals[:, 2]], axis=1)
        xy = start[:2] + along[:, None] * (goals[:, None, :2] - start[:2])
        way = np.concatenate([xy, (end_z + up * (level - end_z))[..., None]], axis=-1)
        way, _ = self._into_reach(leg, bodies, way)
        return np.asarray(self._near(leg, bodies, way, feet).any(axis=-1))

    def _near(self, leg: int, bodies: Array, way: Array, feet: Array) -> NDArray[np.bool_]:
        """Return where a leg is too near to its standing neighbours.

        Its foot is at (..., 3).
        """
        sides = np.array([(leg + 1) % 6, (leg + 5) % 6])
        own = self._poses(np.array([leg]), bodies, way[..., None, :])
        beside = self._poses(sides, bodies, np.broadcast_to(feet[sides], (*bodies.shape[:-1], 2, 3)))
        return np.asarray(_collide(np.broadcast_to(own, beside.shape), beside, self._rules.legs_apart).any(axis=-1))

    def _passes_low(self, leg: int, bodies: Array, way: Array, start: Array, goals: Array) -> NDArray[np.bool_]:
        """Return where (k, 9) the path piece that ends at a time is too low.

        The path (k, 9, 3) is not yet limited to the reachable points.
        """
        rules, parts = self._rules, np.arange(1, _PIECES + 1) / _PIECES
        bodies, p = (
            np.concatenate(
                [v[:, :1, None].repeat(_PIECES, axis=2), v[:, :-1, None] + parts[:, None] * np.diff(v, axis=1)[:, :, None]], 1
            )
            for v in (bodies, way)
        )
        p, _ = self._into_reach(leg, bodies, p)
        off = np.minimum(((p - start)[..., :2] ** 2).sum(axis=-1), ((p - goals[:, None, None])[..., :2] ** 2).sum(axis=-1))
        needed = np.minimum(rules.swing_clear, 0.5 * np.sqrt(off) - 0.005)
        low = (p[..., 2] - rules.foot_radius - self._top(p[..., 0], p[..., 1]) < needed).any(axis=-1)
        low[:, 0] = False
        return np.asarray(low)

    def _into_reach(self, leg: int, bodies: Array, p: Array) -> tuple[Array, Array]:
        """Return the nearest reachable points of feet (..., 3) and the displacements [m].

        The knee limits the reach.
        """
        mount = bodies + self._mount[leg]
        off = p - mount
        out = np.maximum(np.sqrt(off[..., 0] * off[..., 0] + off[..., 1] * off[..., 1]), 1e-6)
        reach, z = out - self._links[0], off[..., 2]
        way = np.sqrt(reach * reach + z * z)
        short, far = self._way[leg, 0] + 1e-4, self._way[leg, 1] - 1e-4
        new = np.where(way > far, reach * far / np.maximum(way, 1e-9), np.sqrt(np.maximum(short * short - z * z, 0.0)))
        new_z = np.where(way > far, z * far / np.maximum(way, 1e-9), z)
        stays = (short <= way) & (way <= far)
        scale = ((self._links[0] + new) / out)[..., None]
        moved = np.concatenate([mount[..., :2] + off[..., :2] * scale, (p[..., 2] + new_z - z)[..., None]], axis=-1)
        return np.where(stays[..., None], p, moved), np.where(stays, 0.0, np.sqrt((new - reach) ** 2 + (new_z - z) ** 2))


def _between(c: Array, s: Array, limits: Array) -> NDArray[np.bool_]:
    after = limits[..., 0] * s - limits[..., 1] * c >= 0.0
    before = c * limits[..., 3] - s * limits[..., 2] >= 0.0
    return np.where(limits[..., 4] > 0.0, after | before, after & before)


def _first(tests: Verdicts) -> Verdicts:
    """Return the first test along the last axis that is not OK."""
    return np.take_along_axis(tests, (tests != OK).argmax(axis=-1)[..., None], axis=-1)[..., 0]


def _collide(one: Array, other: Array, apart: float) -> NDArray[np.bool_]:
    """Return whether legs (..., 3, 3) are closer to others than `apart` [m]."""
    p, r = one[..., :2, None, :], other[..., None, :2, :]
    u, v = one[..., 1:, None, :] - p, other[..., None, 1:, :] - r
    w = p - r
    a, e, b = (u * u).sum(axis=-1), (v * v).sum(axis=-1), (u * v).sum(axis=-1)
    c, f = (u * w).sum(axis=-1), (v * w).sum(axis=-1)
    denominator = a * e - b * b
    wide = denominator > 1e-12
    m = np.where(wide, np.clip((b * f - c * e) / np.where(wide, denominator, 1.0), 0.0, 1.0), 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):  # unreachable legs are rejected by another test
        k = (b * m + f) / e
        m = np.where(k < 0.0, np.clip(-c / a, 0.0, 1.0), np.where(k > 1.0, np.clip((b - c) / a, 0.0, 1.0), m))
    k = np.clip(k, 0.0, 1.0)
    d = w + u * m[..., None] - v * k[..., None]
    return np.asarray(((d * d).sum(axis=-1) < apart * apart).any(axis=(-1, -2)))
