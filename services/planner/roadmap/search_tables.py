"""Tables of a robot and its settings for the compiled search."""

import math

import numpy as np

from sextant.services.planner.locomotion.swing_clearance import LEVEL, SWING_TIME, lowest_path
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap_search import (
    COUNTS,
    CROWDS,
    ROOT_FOOT,
    TESTS,
    Ground,
    Legs,
    Rules,
    Tree,
    nearest_seen,
)
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profile import GRAVITY, RobotProfile
from sextant.shared.robot.stability import resting_centre_of_mass

ORDER = (4, 3, 5, 2, 0, 1)  # rear to front, sides alternating
YAW_STEP_DEG = 3.0  # [deg] lattice of the body's yaw
_EASY = 1.0 / 3.0  # share of stall torque that a servo sustains for hours (AX-12A data; assumed equal for the RX-64)


def legs_of(profile: RobotProfile, settings: PassageSettings) -> Legs:
    """Return the leg parameters for the tests."""
    links, mount = profile.links, profile.T_body_coxa[:, :3, 3]
    fore = np.where(np.abs(mount[:, 0]) < 0.25 * profile.body.size[0], 0.0, np.sign(mount[:, 0]))
    unit = lowest_path(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]), np.array([1.0 / LEVEL]))[:, 0]
    table = []
    for angle, length in ((np.radians(settings.joint_margin_deg), settings.reach_margin_m), (0.0, 0.0)):
        limits = profile.joint_limits + np.array([angle, -angle])
        ends = np.maximum(limits[:, 2, 0], -np.pi), np.minimum(limits[:, 2, 1], 0.0)
        way = np.column_stack(
            [np.sqrt(links.femur**2 + links.tibia**2 + 2.0 * links.femur * links.tibia * np.cos(q)) for q in ends]
        ) + np.array([length, -length])
        knee = (way**2 - links.femur**2 - links.tibia**2) / (2.0 * links.femur * links.tibia)
        parts = [mount, profile.T_body_coxa[:, :2, 0], _directions(limits[:, 0]), _directions(limits[:, 1]), knee, way]
        same = [links.coxa, links.femur, links.tibia], fore, [profile.body.size[0] / 2, profile.body.size[1] / 2]
        table.append(np.column_stack([*parts, np.tile(same[0], (6, 1)), same[1], np.tile(same[2], (6, 1))]))
    return Legs(
        table=np.ascontiguousarray(table),
        rest=profile.rest_feet()[:, :2].copy(),
        stroke=_strokes(profile, settings),
        order=np.array(ORDER),
        swing=np.ascontiguousarray(np.stack([SWING_TIME, unit[:, 0], unit[:, 2]])),
    )


def rules_of(profile: RobotProfile, settings: PassageSettings, turning: bool = False) -> Rules:
    """Return the lengths and limits of the tests; `turning` is whether the body may turn."""
    links, stance, body = profile.links, profile.stance, profile.body
    size = links.femur + links.tibia
    centre = resting_centre_of_mass(profile)
    _, femur, tibia = (float(stall) for stall in profile.servos.stall_torque.min(axis=0))  # coxas bear no weight
    return Rules(
        foot_radius=profile.foot.radius,
        half_length=body.size[0] / 2,
        half_width=body.size[1] / 2,
        half_height=body.size[2] / 2,
        weight=body.total_mass * GRAVITY,
        torque=settings.torque_share * femur,
        easy_torque=_EASY * femur,
        knee=femur / tibia,
        height=settings.body_height or stance.body_height,
        climb=0.5 * stance.max_climb,
        centre_x=float(centre[0]),
        centre_y=float(centre[1]),
        margin=settings.margin_m,
        feet_apart=stance.foot_distance,
        legs_apart=settings.legs_apart_m,
        body_clear=settings.body_clear_m,
        leg_clear=settings.leg_clear_m,
        swing_clear=settings.swing_clear_m,
        least_lift=settings.swing_clear_m + 0.01,
        most_lift=stance.max_lift,
        lift_step=0.015,
        moved_most=settings.max_swing_shift_m,
        lattice=settings.lattice_m,
        alike_body=settings.alike_cells * settings.lattice_m,
        alike_foot=settings.alike_cells,
        body_low=settings.body_step[0] * size,
        body_high=settings.body_step[1] * size,
        body_angle=float(np.radians(settings.body_angle_deg)),
        foot_low=settings.foot_step[0],
        foot_high=settings.foot_step[1],
        foot_angle=float(np.radians(settings.foot_angle_deg)),
        foot_back=settings.foot_back * size,
        strong=settings.strong_cells,
        wide=settings.wide_cells,
        weakest=settings.weakest_cells,
        central=0,
        inward=0,
        drift=settings.turning_drift_m if turning else settings.drift_m,
        depth=(9 if turning else 6) * settings.cycles,  # a cycle has up to three turns between its steps
        step_gain=0.15 * size,
        eager=settings.eager,
        lag_price=settings.lag_price,
        crowd_price=settings.crowd_price,
        turn_price=0.4,
        still_price=0.3,
        foothold_price=0.2,
        margin_price=10.0,
        torque_price=0.5,
        aside_price=4.0,
        move_samples=settings.body_moves,
        foot_samples=settings.footholds,
        rounds=settings.rounds,
        backward=0.02,
        yaw_step=math.radians(YAW_STEP_DEG),
        yaw_change=round(settings.turn_deg / YAW_STEP_DEG) if turning else 0,
        yaw_most=round(settings.most_turn_deg / YAW_STEP_DEG),
        sway=settings.sway_m if turning else 0.0,
        uneven=False,
    )


def ground_of(field: StripMap) -> Ground:
    """Return the ground of a strip for the search.

    The layers are copied. Views of a message and arrays derived from it have other array types. For each new type the search
    would be compiled again, while the robot stands in the middle of the gap.
    """
    evaluation = field.evaluation.copy()
    meant, nearest = np.full((2, *evaluation.shape), -1, dtype=np.int32)
    nearest_seen(evaluation, nearest)
    return Ground(
        field.elevation.copy(),
        field.top,
        evaluation,
        meant,
        nearest,
        field.resolution,
        *field.first_cell,
    )


def tree_of(nodes: int) -> Tree:
    """Allocate a tree for a number of configurations and touch all of its memory."""
    slots = 1 << max(4, int(np.ceil(np.log2(2 * nodes))))
    queue = 2 * nodes

    return Tree(
        root=np.zeros((6, 3)),
        body=np.full((nodes, 3), 0, dtype=np.float64),
        yaw=np.full(nodes, 0, dtype=np.int16),
        foot=np.full((nodes, 6), ROOT_FOOT, dtype=np.int32),
        parent=np.full(nodes, -1, dtype=np.int32),
        leg=np.full(nodes, -1, dtype=np.int8),
        depth=np.full(nodes, 0, dtype=np.int16),
        state=np.full(nodes, 0, dtype=np.int8),
        cost=np.full(nodes, 0, dtype=np.float64),
        lift=np.full(nodes, 0, dtype=np.float64),
        margin=np.full(nodes, 0, dtype=np.float64),
        key=np.full(queue, 0, dtype=np.float64),
        queued=np.full(queue, 0, dtype=np.int32),
        turn=np.full(queue, 0, dtype=np.int16),
        table=np.full(slots, -1, dtype=np.int32),
        counts=np.zeros(COUNTS, dtype=np.int64),
        fails=np.zeros((2, TESTS, 7), dtype=np.int64),
        visits=np.zeros(CROWDS, dtype=np.int64),
        random=np.ones(1, dtype=np.uint64),
        goal=np.zeros(1),
    )


def _directions(limits: Array) -> Array:
    """Return limits (6, 2) [rad] as a table (6, 5).

    The columns are cosine and sine of both limits, and whether they are more than half a turn apart.
    """
    low, high = limits[:, 0], limits[:, 1]
    return np.column_stack([np.cos(low), np.sin(low), np.cos(high), np.sin(high), high - low > np.pi])


def _strokes(profile: RobotProfile, settings: PassageSettings) -> Array:
    """Return the stroke (6, 2) [m] of each foot behind and before its nominal place.

    It holds on level ground within the limits of the leg.
    """
    feet = profile.rest_feet(settings.body_height or profile.stance.body_height)
    off = 0.005 * np.arange(1, 80)
    out = np.empty((6, 2))
    for leg in range(6):
        for side, sign in enumerate((-1.0, 1.0)):
            line = np.repeat(feet[None], len(off), axis=0)
            line[:, leg, 0] += sign * off
            ok = np.asarray(within_limits(profile, body_inverse(profile, line))[:, leg].all(axis=1))
            out[leg, side] = off[max(int(np.argmin(ok)) - 1, 0)] if not ok.all() else off[-1]
    return out
