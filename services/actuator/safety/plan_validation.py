"""Validation of step plans before they are walked. Pure: time is an input.

A plan is accepted or refused as a whole, with a reason. Every accepted plan ends with six feet on the ground and a stable
robot, so the actuator can always finish it alone.
"""

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, apply, inverse, is_rigid, rpy_from_rotation
from sextant.shared.robot.kinematics import body_forward, body_inverse, nearest_reachable, within_limits
from sextant.shared.robot.profile import (
    JOINTS,
    LEGS,
    LONGEST_STEP_S,
    MAX_CLEARANCE_M,
    MAX_TILT_DEG,
    MAX_TRAVEL_M,
    MAX_TURN_DEG,
    MIN_MARGIN_M,
    SHORTEST_STEP_S,
    RobotProfile,
)
from sextant.shared.robot.stability import resting_centre_of_mass, support_margin
from sextant.shared.wire.messages import StepPlan

FURTHEST = 1e6  # [m] from the origin of {world}
MEAN_SPEED = 0.9  # largest mean joint speed, as a share of the servo's top speed: a swing accelerates and decelerates
GATHERED_S = 0.55  # [s] of a motion at that speed: acceleration takes 8 % of that time, and at least 0.04 s
FLIES_AT = 0.8  # share of its clearance, between rise and fall
SHORTEST_LEFT_S = 0.1  # [s] minimum time in which a revision may ask for the last millimetres
MOVED = 0.005  # [m] by which a standing leg may miss its foot in a revision, by its length or joint limits
SAME = 1e-6  # [m] and [1] difference between poses and points of two plans for one step that is due to rounding
STAYS = np.full(6, np.inf)  # [s]
_BELOW, _ABOVE = ("turned right", "lowered", "bent"), ("turned left", "raised", "stretched")  # beyond the limits of a joint


class PlanCheck:
    """Validates plans, and keeps the stamp of the last accepted one."""

    def __init__(self, profile: RobotProfile, plan_age_s: float, epoch: int = 0, handover_s: float = 0.0):
        """Begin without an accepted plan.

        Args:
            profile: The robot.
            plan_age_s: [s] older plans are refused.
            epoch: Of {odom}; plans of another one are refused.
            handover_s: [s] of a step in which the feet of its legs are not in the air.
        """
        self.epoch = epoch
        self._profile, self._centre = profile, resting_centre_of_mass(profile)
        self._handover_s = handover_s
        self._plan_age_ns = round(plan_age_s * 1e9)
        self._last_stamp_ns = -1
        self._checked: dict[int, StepPlan] = {}  # the last plans of neighbouring steps that passed the checks, by step number

    def untimely(
        self, plan: StepPlan, now_ns: int, running: int, resting: bool, swing: NDArray[np.bool_], clearance: Array
    ) -> str:
        """Return why a plan is too late, too early or out of order, or an empty string.

        Args:
            plan: The plan.
            now_ns: [ns] this process's monotonic time.
            running: Number of the running or last step.
            resting: Whether no step is running.
            swing: (6,) legs that the running step swings.
            clearance: (6,) [m] with which their feet were lifted: a plan for more was made before that was known.
        """
        if plan.epoch != self.epoch:
            return (
                f"plan of step {plan.step} was made before {{odom}} restarted: epoch {self.epoch} expected, found {plan.epoch}"
            )
        age_ns = now_ns - plan.stamp_ns
        if age_ns > self._plan_age_ns:
            return f"plan of step {plan.step} is {age_ns * 1e-9:.2f} s old, at most {self._plan_age_ns * 1e-9:.2f} s allowed"
        if age_ns < -self._plan_age_ns:  # if accepted, it would make every later plan an old one
            return f"plan of step {plan.step} is stamped {-age_ns * 1e-9:.2f} s in the future"
        if plan.stamp_ns <= self._last_stamp_ns:
            return f"plan of step {plan.step} is not newer than the last accepted one"
        if wrong := out_of_order(plan, running, resting):
            return wrong
        if plan.step == running and (plan.swing != swing).any():
            return f"a revision of step {plan.step} swings other legs than the running step"
        if plan.step == running and (plan.clearance > clearance)[plan.swing].any():
            return f"a revision of step {plan.step} needs more clearance than its feet were lifted with"
        return ""

    def renew(self, plan: StepPlan) -> bool:
        """Return whether a plan only repeats the checked one of its step; it is then the newest, and needs no further check.

        It is compared with the plan that was checked, not with earlier repetitions, so that small differences cannot add up.
        """
        checked = self._checked.get(plan.step)
        renews = checked is not None and _repeats(plan, checked) and not _malformed(plan)
        if renews:
            self._last_stamp_ns = plan.stamp_ns
        return renews

    def unwalkable(self, plan: StepPlan, T_odom_body: Array, feet: Array, revises: bool = False, air_s: Array = STAYS) -> str:
        """Return why a plan must not be walked; an empty string accepts it as the newest.

        Args:
            plan: The plan.
            T_odom_body: (4, 4) commanded body pose when the plan takes effect: for the next step, at the end of this one.
            feet: (6, 3) [m] {odom} feet at that time.
            revises: Whether it revises the running step.
            air_s: (6,) [s] for which feet of the running step are then still in the air; infinite for the others.
        """
        reason = (
            _malformed(plan)
            or _out_of_bounds(plan, T_odom_body)
            or self._unstable(plan, T_odom_body, feet)
            or self._out_of_reach(plan, T_odom_body, feet, revises)
            or self._too_fast(plan, T_odom_body, feet, air_s if revises and np.isfinite(air_s).any() else None)
        )
        if not reason:
            near = {step: checked for step, checked in self._checked.items() if abs(step - plan.step) == 1}
            self._checked = {**near, plan.step: plan}
            self._last_stamp_ns = plan.stamp_ns
        return reason

    def _unstable(self, plan: StepPlan, T_odom_body: Array, feet: Array) -> str:
        """Return where the standing legs do not support the body, or an empty string."""
        T_odom_world = inverse(plan.T_world_odom)
        standing = feet[~plan.swing]
        if len(standing) < 3:
            return f"only {len(standing)} legs would stand, three are needed"
        for where, body in (("at the start", T_odom_body), ("at the end", T_odom_world @ plan.body_goal)):
            margin = support_margin(standing[:, :2], apply(body, self._centre)[:2])
            if margin < MIN_MARGIN_M:
                place = f"{abs(margin) * 1e3:.1f} mm {'inside' if margin > 0.0 else 'outside'} the support polygon {where}"
                return f"the centre of mass would be {place}, {MIN_MARGIN_M * 1e3:.0f} mm inside needed"
        return ""

    def _too_fast(self, plan: StepPlan, T_odom_body: Array, feet: Array, air_s: Array | None) -> str:
        """Return which joint would exceed the servo limits, or an empty string.

        Four points of a swing are checked: start, end of the rise, start of the descent, and end. For a swing in progress
        (`air_s`) these are its present point and its end.
        """
        T_odom_world = inverse(plan.T_world_odom)
        goal, touchdown = T_odom_world @ plan.body_goal, apply(T_odom_world, plan.touchdown)
        end = np.where(plan.swing[:, None], touchdown, feet)
        way, bodies = [feet, end], [T_odom_body, goal]
        if air_s is None:
            top = np.where(plan.swing, np.maximum(feet[:, 2], end[:, 2]) + FLIES_AT * plan.clearance, feet[:, 2])
            over = [np.column_stack([(feet + share * (end - feet))[:, :2], top]) for share in (0.25, 0.75)]
            way, bodies = [feet, *over, end], [T_odom_body, T_odom_body, goal, goal]
        feet_body = [nearest_reachable(self._profile, apply(inverse(T), p)) for T, p in zip(bodies, way, strict=True)]
        turns = np.abs(np.diff(body_inverse(self._profile, np.array(feet_body)), axis=0)).sum(axis=0)
        flight = np.full(6, plan.duration - self._handover_s) if air_s is None else np.maximum(air_s, SHORTEST_LEFT_S)
        time = np.where(plan.swing, flight, plan.duration if air_s is None else np.inf)[:, None]
        share = np.minimum(MEAN_SPEED, time / GATHERED_S) if air_s is None else MEAN_SPEED  # it is already moving
        most = self._profile.servos.no_load_speed * time * share
        if not (turns > most).any():
            return ""
        leg, joint = np.argwhere(turns > most)[0]
        words = f"the {JOINTS[joint]} of the {LEGS[leg]} leg would turn by {np.degrees(turns[leg, joint]):.0f} deg"
        return f"{words} in {time[leg, 0]:.2f} s, at most {np.degrees(most[leg, joint]):.0f} deg allowed"

    def _out_of_reach(self, plan: StepPlan, T_odom_body: Array, feet: Array, revises: bool) -> str:
        """Return which joint cannot reach its foot at the end, or an empty string.

        A standing leg may be too short for its foot already, if the ground has given way. Then it may still be too short at the
        end, if by less, and if the leg can hold its nearest point to the foot. In a revision, any standing leg may miss its
        foot by `MOVED`: feet move by millimetres, and it is worse to stop in mid-step on ground that was not chosen.
        """
        end = np.where(plan.swing[:, None], plan.touchdown, apply(plan.T_world_odom, feet))
        end = apply(inverse(plan.body_goal), end)
        bad = ~within_limits(self._profile, body_inverse(self._profile, end))
        if bad.any():
            start, nearest = apply(inverse(T_odom_body), feet), nearest_reachable(self._profile, end)
            beyond = np.linalg.norm(nearest - end, axis=1)
            before = np.linalg.norm(nearest_reachable(self._profile, start) - start, axis=1)
            q, limits = body_inverse(self._profile, nearest), self._profile.joint_limits
            over = np.maximum(limits[..., 0] - q, q - limits[..., 1]).max(axis=1)  # [rad], NaN where it cannot be held
            bad[~plan.swing & (over <= 0.0) & (beyond > 0.0) & (beyond < before)] = False
            if revises:
                held = body_forward(self._profile, np.clip(q, limits[..., 0], limits[..., 1]))
                bad[~plan.swing & (np.linalg.norm(held - end, axis=1) <= MOVED)] = False
        if bad.any():
            leg, joint = np.argwhere(bad)[0].tolist()
            what = "touchdown" if plan.swing[leg] else "standing foot"
            return f"the {what} of the {LEGS[leg]} leg is out of reach: {_excess(self._profile, end, leg, joint)}"
        return ""


def out_of_order(plan: StepPlan, running: int, resting: bool) -> str:
    """Return that a plan is neither of the next step nor of the running one, or an empty string.

    Args:
        plan: The plan.
        running: Number of the running or last step.
        resting: Whether no step is running.
    """
    if plan.step == running + 1 or (plan.step == running and not resting):
        return ""
    return f"plan of step {plan.step} does not follow step {running}"


def _excess(profile: RobotProfile, feet: Array, leg: int, joint: int) -> str:
    """Return by how much a foot, of feet (6, 3) [m] {body}, lies beyond what its leg reaches by a joint, as text."""
    q = float(body_inverse(profile, feet)[leg, joint])
    if np.isnan(q):  # beyond the links, not beyond a limit
        x, y, z = apply(profile.T_coxa_body[leg], feet[leg])
        away, links = float(np.hypot(np.hypot(x, y) - profile.links.coxa, z)), profile.links
        over = max(away - links.femur - links.tibia, abs(links.femur - links.tibia) - away)
        return f"{max(round(1e3 * over), 1)} mm too {'far' if away > links.femur else 'near'}"
    low, high = profile.joint_limits[leg, joint].tolist()
    over, how = (low - q, _BELOW[joint]) if q < low else (q - high, _ABOVE[joint])
    return f"its {JOINTS[joint]} would be {how} {max(round(np.degrees(over)), 1)} deg too far"


def _repeats(plan: StepPlan, checked: StepPlan) -> bool:
    """Return whether a plan repeats the step of a checked one.

    The robot's place in {world} may have been corrected meanwhile, so they are compared in {odom}.
    """
    if (plan.epoch, plan.step, plan.duration, plan.stop) != (checked.epoch, checked.step, checked.duration, checked.stop):
        return False
    if (plan.swing != checked.swing).any() or (plan.clearance != checked.clearance).any():
        return False
    T = checked.T_world_odom @ inverse(plan.T_world_odom)
    moved = (apply(T, plan.touchdown) - checked.touchdown)[plan.swing]
    return bool((np.abs(moved) < SAME).all() and (np.abs(T @ plan.body_goal - checked.body_goal) < SAME).all())


def _malformed(plan: StepPlan) -> str:
    """Return why a pose of the plan is invalid, or an empty string."""
    for name, T in (("T_world_odom", plan.T_world_odom), ("body_goal", plan.body_goal)):
        if not is_rigid(T):
            return f"the plan's {name} is not a rigid transform"
        if max(map(abs, T[:3, 3].tolist())) > FURTHEST:
            return f"the plan's {name} is more than {FURTHEST * 1e-3:.0f} km away, too far for millimetre precision"
    return ""


def _out_of_bounds(plan: StepPlan, T_odom_body: Array) -> str:
    """Return which limit of a step the plan exceeds, or an empty string."""
    move = inverse(T_odom_body) @ inverse(plan.T_world_odom) @ plan.body_goal
    travel, (roll, pitch, yaw) = float(np.linalg.norm(move[:3, 3])), np.degrees(rpy_from_rotation(move[:3, :3])).tolist()
    if travel > MAX_TRAVEL_M:
        return f"the body would travel {travel:.2f} m in one step, at most {MAX_TRAVEL_M} m allowed"
    if max(abs(roll), abs(pitch)) > MAX_TILT_DEG or abs(yaw) > MAX_TURN_DEG:
        turn = f"{[round(angle, 1) + 0.0 for angle in (roll, pitch, yaw)]} deg in one step (roll, pitch, yaw)"
        return f"the body would turn by {turn}, at most {MAX_TILT_DEG:g}, {MAX_TILT_DEG:g} and {MAX_TURN_DEG:g} deg allowed"
    if not SHORTEST_STEP_S <= plan.duration <= LONGEST_STEP_S:
        return f"a step of {SHORTEST_STEP_S} to {LONGEST_STEP_S} s expected, found {plan.duration:.2f} s"
    if plan.clearance.min() < 0 or plan.clearance.max() > MAX_CLEARANCE_M:
        found = f"{plan.clearance.min():.3f} to {plan.clearance.max():.3f} m"
        return f"clearances of 0 to {MAX_CLEARANCE_M} m expected, found {found}"
    return ""
