"""A walk as arrays: ground truth combined with the received messages.

There is one row per sample of truth. Times count from the first message of truth.
Frame: {start}, as in `sextant.evaluation.trace.course`.
"""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.metrics.walk_metrics import debounced, in_the_way, runs, stability_margin
from sextant.evaluation.trace.course import Course
from sextant.evaluation.trace.run_log import RunLog
from sextant.shared.geometry import Array, apply
from sextant.shared.robot.kinematics import leg_points
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.stability import centre_of_mass
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Mode

Flags = NDArray[np.bool_]

DEBOUNCE = max(1, round(0.02 * topics.TRUTH.rate_hz))  # samples of truth, 20 ms
_STALE_NS = 250_000_000  # [ns] an actuator that has been silent for longer is not walking
_GROUNDED = 0.2  # [1] share of the phase at both ends of a swing in which a foot in contact counts as supporting
_EVERY = 5  # sampling interval of the collision check, in samples of truth
_HANGING = 0.003  # [m] a foot this close above its ground supports the body after a tilt of one degree


class Walk:
    """Ground truth of a walk, aligned with the actuator's states and commands."""

    def __init__(self, heard: RunLog, course: Course, profile: RobotProfile):
        self._heard, self._course, self._profile = heard, course, profile
        truth = heard.truth
        self.t_ns = heard.stamps()  # (n,)
        self.T = course.T_start_sim @ truth["T_world_body"].reshape(-1, 4, 4)  # (n, 4, 4) body
        self.p: Array = self.T[:, :3, 3]  # (n, 3) [m] body
        self.up = truth["T_world_body"].reshape(-1, 4, 4)[:, 2, :3]  # (n, 3) {body} the vertical
        self.feet = apply(course.T_start_sim, truth["feet"].reshape(-1, 6, 3))  # (n, 6, 3) [m] centres
        self.torque = np.abs(truth["torque"].reshape(-1, 6, 3))  # (n, 6, 3) [N m]
        self.contact: Flags = debounced(truth["contact"].astype(bool).reshape(-1, 6), DEBOUNCE)  # (n, 6)
        self.bears: Flags = debounced(truth["carries_load"].astype(bool).reshape(-1, 6), DEBOUNCE)  # (n, 6)
        self.shutdown: Flags = truth["shutdown"].astype(bool).reshape(-1, 6, 3)  # servos with an error
        self._align()

    @cached_property
    def ground(self) -> Array:
        """True height (n, 6) [m] {start} of the visible ground under the feet."""
        return self._course.height_at(self.feet[..., :2].reshape(-1, 2)).reshape(-1, 6)

    @cached_property
    def shanks(self) -> Array:
        """Unit vectors (n, 6, 3) {start} from the feet up the shanks."""
        truth = self._heard.truth
        legs = leg_points(self._profile, truth["q"].reshape(-1, 6, 3))
        R = self._course.T_start_sim[:3, :3] @ truth["T_world_body"].reshape(-1, 4, 4)[:, :3, :3]
        shanks = (legs[:, :, 2] - legs[:, :, 3]) / self._profile.links.tibia
        return np.asarray(np.einsum("nij,nkj->nki", R, shanks))

    @cached_property
    def carrying(self) -> Flags:
        """Legs (n, 6) that support the body, or would after a slight tilt.

        They bear load or hang just above their ground. By plan, they are in stance, about to lift off or just landed.
        """
        if not self._heard.states:
            return self.bears
        phase = np.array([s.phase for s in self._heard.states])[self._state_of]
        grounded = (phase < _GROUNDED) | (phase > 1.0 - _GROUNDED)
        hangs_low = self.feet[..., 2] - self._profile.foot.radius - self.ground < _HANGING
        return np.asarray((self.bears | hangs_low) & (~self.swing | grounded[:, None]))

    @cached_property
    def margin(self) -> Array:
        """Distance (n,) [m] of the centre of mass to the edge of the support polygon.

        It is negative outside, and NaN without a supporting leg.
        """
        if not self._heard.states:
            return np.full(len(self.t_ns), np.nan)
        q = self._heard.truth["q"].reshape(-1, 6, 3)
        offset = (self.T[:, :3, :3] @ centre_of_mass(self._profile, q)[..., None])[..., 0]
        return stability_margin(self.feet[..., :2], self.carrying, (self.p + offset)[:, :2])

    @cached_property
    def in_the_way(self) -> Flags:
        """Feet, then the body, (n, 7) in collision.

        Only every `_EVERY`-th sample is checked; the others are False.
        """
        flags = np.zeros((len(self.t_ns), 7), dtype=bool)
        truth = self._heard.truth
        if truth:
            feet, bodies = truth["feet"][::_EVERY], truth["T_world_body"][::_EVERY]
            size, ground = self._profile.body.size, self._course.terrain.height_at
            flags[::_EVERY] = in_the_way(ground, feet, bodies, self._profile.foot.radius, size)
        return flags

    @property
    def collisions(self) -> int:
        """Number of collisions.

        A foot or the body hits an obstacle higher than a step, or a foot hangs in a hole.
        """
        return len(runs(np.asarray(self.in_the_way[::_EVERY].any(axis=1))))

    def _align(self) -> None:
        """Assign to each sample of truth the actuator state that held at its time."""
        states, n = self._heard.states, len(self.t_ns)
        self.height_reference: Array = np.full(n, np.nan)  # (n,) [m] {start} of the body; NaN before the first actuator state
        self.up_reference: Array = np.tile([0.0, 0.0, 1.0], (n, 1))  # (n, 3) the vertical in the commanded body
        self.walking: Flags = np.zeros(n, dtype=bool)  # (n,)
        self.swing: Flags = np.zeros((n, 6), dtype=bool)  # (n, 6) by plan
        self.step: NDArray[np.int64] = np.zeros(n, dtype=np.int64)  # (n,) number of the current step
        if not states:
            return
        t = np.array([s.stamp_ns - self._heard.begin_ns for s in states], dtype=np.float64)
        self._state_of = np.clip(np.searchsorted(t, self.t_ns, side="right") - 1, 0, None)
        age = self.t_ns - t[self._state_of]
        walk = np.array([s.mode is Mode.WALK for s in states])
        self.walking = np.asarray(walk[self._state_of] & (age >= 0) & (age < _STALE_NS))
        self.swing = np.asarray(np.array([s.swing for s in states]).reshape(-1, 6)[self._state_of] & self.walking[:, None])
        self.step = np.asarray(np.array([s.step for s in states])[self._state_of])
        height, up = self._references()
        self.height_reference = np.where(self.t_ns < t[0], np.nan, np.interp(self.t_ns, t, height))
        self.up_reference = up[self._state_of]

    def _references(self) -> tuple[Array, Array]:
        """Return commanded body heights (m,) [m] {start} and verticals (m, 3) {body}.

        There is one row per actuator state. A reference is in {odom}; the plan of its step gives T_world_odom.
        """
        plans, states = self._heard.plans, self._heard.states
        numbers = np.array(sorted(plans) or [0])
        ties = np.array([plans[n].T_world_odom for n in numbers]) if plans else np.eye(4)[None]
        steps = np.array([s.step for s in states])
        tie = ties[np.clip(np.searchsorted(numbers, steps, side="right") - 1, 0, None)]
        reference = tie @ np.array([s.body_ref for s in states])
        return reference[:, 2, 3], reference[:, 2, :3]
