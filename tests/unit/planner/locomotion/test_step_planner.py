"""Step planner: every step can be walked, with the length that the ground allows.

Without a step it returns the reason.
"""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion.body_pose import leaning
from sextant.services.planner.locomotion.gait import GAITS, Pace, directions, swing_order
from sextant.services.planner.locomotion.params import StepParams
from sextant.services.planner.locomotion.step_planner import SHARES, NoStep, PlannedStep, StepPlanner, StepStart
from sextant.services.planner.locomotion.swing_clearance import descent_clearance
from sextant.services.planner.locomotion.swing_motion import shortest_swing_s
from sextant.services.planner.terrain import Terrain, flat_terrain
from sextant.shared.geometry import Array, apply, from_xyz_rpy, inverse, rpy_from_rotation
from sextant.shared.robot.kinematics import body_inverse, within_limits
from sextant.shared.robot.profiles import load_profile
from sextant.shared.robot.stability import support_margin
from sextant.shared.wire.messages import MAX_FOOTHOLD_SCORE, GaitName, VelocityCommand

Flags = NDArray[np.bool_]

PROFILE = load_profile("phantomx_mk2")
SETTINGS = Settings()
PLANNER = StepPlanner(PROFILE, SETTINGS)
HEIGHT = 0.11
TRIPOD = np.arange(6) % 2 == 0
FLAT = flat_terrain(0, np.zeros(2), 0.0)
UP = np.array([0.0, 0.0, PROFILE.foot.radius])
Maker = Callable[..., Terrain]


def command(
    vx: float = 0.05, vy: float = 0.0, yaw_rate: float = 0.0, height: float = HEIGHT, lift: float = 0.04
) -> VelocityCommand:
    return VelocityCommand(0, np.array([vx, vy]), yaw_rate, height, lift)


def standing(
    asked: VelocityCommand | None = None, swing: Flags = TRIPOD, T: Array | None = None, feet: Array | None = None
) -> StepStart:
    body = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3)) if T is None else T
    return StepStart(body, apply(body, PROFILE.rest_feet(HEIGHT)) if feet is None else feet, swing, asked or command())


def stride(at: StepStart, terrain: Terrain = FLAT) -> PlannedStep:
    found = PLANNER.plan(at, terrain)
    assert isinstance(found, PlannedStep), found
    return found


def check_walkable(found: PlannedStep, at: StepStart) -> None:
    """Check the properties of every step."""
    feet = apply(inverse(found.body_goal), found.touchdown)
    assert within_limits(PROFILE, body_inverse(PROFILE, feet)).all()
    above = apply(inverse(found.body_goal), found.touchdown + np.array([0.0, 0.0, 0.03]))
    from_above = within_limits(PROFILE, body_inverse(PROFILE, above))
    assert from_above[at.swing].all()  # and no foot comes down from the side
    np.testing.assert_array_equal(found.touchdown[~at.swing], at.feet[~at.swing])
    for legs, body in ((~at.swing, at.T_world_body), (~at.swing, found.body_goal), (at.swing, found.body_goal)):
        assert support_margin(found.touchdown[legs][:, :2], body[:2, 3]) >= PROFILE.stance.support_margin
    apart = np.linalg.norm(found.touchdown[:, None, :2] - found.touchdown[None, :, :2], axis=2) + np.eye(6)
    assert apart[np.ix_(at.swing, np.ones(6, dtype=bool))].min() >= PROFILE.stance.foot_distance
    assert (found.clearance >= 0).all()
    # The body does not climb, sink or tilt faster than allowed.
    assert abs(found.body_goal[2, 3] - at.T_world_body[2, 3]) <= PROFILE.stance.max_climb + 1e-9
    tilt = rpy_from_rotation(found.body_goal[:3, :3])[:2] - rpy_from_rotation(at.T_world_body[:3, :3])[:2]
    assert np.degrees(np.abs(tilt)).max() <= SETTINGS.step.max_tilt_deg + 1e-6


@given(st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.floats(-0.2, 0.2), st.booleans())
@settings(max_examples=40)
def test_step_on_level_ground_follows_command(vx: float, vy: float, yaw_rate: float, even: bool) -> None:
    at = standing(command(vx, vy, yaw_rate), TRIPOD if even else ~TRIPOD)
    found = stride(at)
    check_walkable(found, at)
    turn = (
        float(np.clip(yaw_rate * PROFILE.stance.step_s, *np.radians([-SETTINGS.step.max_turn_deg, SETTINGS.step.max_turn_deg])))
        * found.share
    )
    travel = np.array([vx, vy]) * PROFILE.stance.step_s
    travel *= found.share * min(1.0, PROFILE.stance.stride / max(float(np.linalg.norm(travel)), 1e-9))
    assert rpy_from_rotation(found.body_goal[:3, :3])[2] == pytest.approx(turn, abs=0.01)
    assert np.linalg.norm(found.body_goal[:2, 3]) == pytest.approx(np.linalg.norm(travel), abs=1e-9)
    assert found.body_goal[2, 3] == pytest.approx(HEIGHT)
    np.testing.assert_allclose(found.touchdown[at.swing, 2], PROFILE.foot.radius, atol=1e-6)


def test_moderate_command_gives_full_stride() -> None:
    assert stride(standing()).share == 1.0
    assert stride(standing()).moved == 0


def test_stride_and_turn_are_limited() -> None:
    found = stride(standing(command(5.0, 0.0, 9.0)))
    assert np.linalg.norm(found.body_goal[:2, 3]) <= PROFILE.stance.stride + 1e-9
    assert rpy_from_rotation(found.body_goal[:3, :3])[2] <= np.radians(SETTINGS.step.max_turn_deg) + 1e-9


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_patchy_ground_gives_acceptable_footholds_or_reason(seed: int) -> None:
    ground = flat_terrain(0, np.zeros(2), 0.0)
    ground.map.score[np.random.default_rng(seed).random(ground.map.score.shape) < 0.85] = 2.0 * MAX_FOOTHOLD_SCORE
    at = standing()
    found = PLANNER.plan(at, ground)
    if isinstance(found, NoStep):
        assert found.reason
        return
    check_walkable(found, at)
    landed = found.touchdown[at.swing, :2]
    assert (ground.scores(landed) <= MAX_FOOTHOLD_SCORE).all()
    assert np.linalg.norm(landed - found.nominal[at.swing], axis=1).max() <= PROFILE.stance.search_radius + 0.01


def test_stride_is_shortened_towards_edge_before_refusal(make_terrain: Maker) -> None:
    """Check that steps become shorter towards an abyss, until there is none."""
    shares = []
    for edge in np.arange(0.34, 0.10, -0.01):
        ground = make_terrain(score=lambda x, y, edge=edge: np.where(x > edge, 9.0, 0.0))
        found = PLANNER.plan(standing(command(0.06)), ground)
        shares.append(found.share if isinstance(found, PlannedStep) else 0.0)
    assert shares[0] == 1.0
    assert shares[-1] == 0.0
    assert shares == sorted(shares, reverse=True)
    assert len(set(shares)) > 2


@pytest.mark.parametrize("across", [0.145, 0.155, 0.165])
def test_front_feet_at_the_edge_of_a_ditch_step_across(make_terrain: Maker, across: float) -> None:
    """A step of 45 % brings the standing front foot too near its coxa axis, one of 25 % finds no foothold across."""
    feet = np.array(
        [(0.17, 0.137), (0.17, -0.145), (-0.015, -0.2), (-0.2, -0.152), (-0.226, 0.151), (-0.014, 0.205)]
    )  # as before a walk over `ditch` was blocked
    ground = make_terrain(score=lambda x, y: np.where((x > 0.175) & (x < 0.175 + across), np.nan, 0.0), half=1.5)
    at = standing(command(0.11, lift=0.025), feet=np.column_stack([feet, np.full(6, UP[2])]))
    found, _ = PLANNER.choose([at, replace(at, swing=~TRIPOD)], ground)
    assert isinstance(found, PlannedStep), found
    assert found.touchdown[found.swing, 0].max() > 0.175 + across
    check_walkable(found, at)


def test_reason_is_that_of_full_stride(make_terrain: Maker) -> None:
    nothing = make_terrain(score=lambda x, y: np.full_like(x, np.nan))
    found = PLANNER.plan(standing(), nothing)
    assert isinstance(found, NoStep)
    assert found.leg in np.flatnonzero(TRIPOD)
    assert found.reason.startswith("left front leg: no foothold")
    assert "not seen" in found.reason


def test_body_off_its_feet_is_reported() -> None:
    feet = apply(from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3)), PROFILE.rest_feet(HEIGHT))
    away = from_xyz_rpy((0.11, 0.0, HEIGHT), np.zeros(3))
    found = PLANNER.plan(standing(command(0.01), T=away, feet=feet), FLAT)
    assert isinstance(found, NoStep)
    assert "side the support polygon" in found.reason or "out of reach" in found.reason


@pytest.mark.parametrize("rise", [0.02, 0.04, -0.03])
def test_body_follows_ground_height_at_limited_rate(make_terrain: Maker, rise: float) -> None:
    ground = make_terrain(lambda x, y: np.full_like(x, rise))
    found = stride(standing(command(0.02)), ground)
    allowed = np.clip(rise, -PROFILE.stance.max_climb, PROFILE.stance.max_climb)
    assert abs(found.body_goal[2, 3] - HEIGHT) <= PROFILE.stance.max_climb + 1e-9
    # The floor is the mean of the three highest feet: upwards the swinging tripod's, downwards the standing one's.
    assert found.body_goal[2, 3] - HEIGHT == pytest.approx(max(allowed, 0.0), abs=1e-6)
    np.testing.assert_allclose(found.touchdown[TRIPOD, 2], rise + PROFILE.foot.radius, atol=1e-6)


def staircase(make_terrain: Maker, riser: float, tread: float) -> Terrain:
    """Return stairs from x = 0.3 m on, without footholds within 3 cm of an edge."""

    def steps(x: Array) -> Array:
        return np.maximum(np.floor((x - 0.3) / tread) + 1.0, 0.0)

    def near_edge(x: Array, y: Array) -> Array:
        return np.where(steps(x - 0.03) != steps(x + 0.03), 9.0, 0.0)

    return make_terrain(lambda x, y: riser * steps(x), near_edge, half=2.0)


def climbs(planner: StepPlanner, ground: Terrain) -> list[PlannedStep]:
    """Return the steps from level ground to x = 1.4 m, or as far as they go."""
    at, strides = standing(command(0.10)), []
    while at.T_world_body[0, 3] < 1.4:
        found = planner.plan(at, ground)
        if isinstance(found, NoStep):
            break
        check_walkable(found, at)
        strides.append(found)
        at = StepStart(found.body_goal, found.touchdown, ~at.swing, at.command)
    return strides


def lean_deg(found: PlannedStep) -> float:
    return float(np.degrees(np.arccos(min(found.body_goal[2, 2], 1.0))))


@pytest.mark.slow
@pytest.mark.parametrize("riser", [-0.05, -0.03, 0.03, 0.05])
@pytest.mark.parametrize("tread", [0.25, 0.325, 0.40])
def test_stairs_are_climbed_and_descended(make_terrain: Maker, riser: float, tread: float) -> None:
    strides = climbs(PLANNER, staircase(make_terrain, riser, tread))
    assert strides[-1].body_goal[0, 3] >= 1.4
    assert max(map(lean_deg, strides)) <= min(SETTINGS.step.max_lean_deg, np.degrees(np.arctan(abs(riser) / tread)) + 5.0)
    assert lean_deg(strides[0]) == 0.0


def test_high_stairs_need_leaning_body(make_terrain: Maker) -> None:
    ground = staircase(make_terrain, 0.06, 0.25)
    level = climbs(StepPlanner(PROFILE, Settings(step=StepParams(max_lean_deg=0.0))), ground)
    assert level[-1].body_goal[0, 3] < 1.0
    assert max(map(lean_deg, climbs(PLANNER, ground))) > 3.0


def test_body_is_lowered_gradually_for_low_standing_legs() -> None:
    body = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
    feet = apply(body, PROFILE.rest_feet(HEIGHT))
    heights = []
    for low in np.arange(0.0, 0.12, 0.01):
        feet[3:5, 2] = PROFILE.foot.radius - low
        at = standing(command(0.01), T=body, feet=feet.copy())
        found = PLANNER.plan(at, FLAT)
        if isinstance(found, PlannedStep):
            check_walkable(found, at)
            heights.append(found.body_goal[2, 3])
    assert heights[0] == pytest.approx(HEIGHT)
    assert heights == sorted(heights, reverse=True)
    assert heights[-1] < HEIGHT - 0.004
    assert heights[-1] >= PROFILE.stance.body_height_range[0]


def test_body_is_lowered_or_pitched_for_low_touchdowns(make_terrain: Maker) -> None:
    high = 0.12
    down = make_terrain(lambda x, y: np.where(x > 0.17, -0.09, 0.0), lambda x, y: np.where(np.abs(x - 0.17) < 0.03, 9.0, 0.0))
    T = from_xyz_rpy((0.0, 0.0, high), np.zeros(3))
    at = standing(command(0.10, height=high), T=T, feet=apply(T, PROFILE.rest_feet(high)))
    found = stride(at, down)
    check_walkable(found, at)
    assert found.touchdown[0, 2] < -0.05
    assert found.body_goal[2, 3] < high or rpy_from_rotation(found.body_goal[:3, :3])[1] > 0.0


class _Scripted(StepPlanner):
    """Planner whose legs reach their feet by chance, always the same ones from the same pose of the body."""

    def __init__(self, seed: int) -> None:
        super().__init__(PROFILE, SETTINGS)
        self.rng, self.share = np.random.default_rng(seed), (0.2, 0.5, 0.8)[seed % 3]
        self.legs: dict[bytes, Flags] = {}
        self.feet: list[Array] = []  # those asked for, and the poses
        self.bodies: list[Array] = []
        self.postures: list[tuple[Array, float]] = []

    def of(self, T: Array) -> Flags:
        return self.legs.setdefault((np.round(T, 9) + 0.0).tobytes(), self.rng.random(6) < self.share)

    def reached(self, feet_world: Array, T_world_body: Array) -> Flags:
        self.feet += list(feet_world)
        self.bodies += list(T_world_body)
        return np.array([self.of(T) for T in T_world_body])

    def _postures(self, T_world_body: Array, slope: Array, room: float) -> tuple[Array, Array]:
        leans, stoops = super()._postures(T_world_body, slope, room)
        self.postures = list(zip(leans, stoops.tolist(), strict=True))
        return leans, stoops


def test_body_takes_the_first_posture_in_which_all_legs_reach_or_else_those_that_stand() -> None:
    taken, margin = set(), np.array([0.0, 0.0, PLANNER._params.reach_margin_m])
    for seed in range(1000, 1060):
        planner, at = _Scripted(seed), standing()
        at.feet[:, 2] += 0.2 * at.feet[:, 0]
        T_end, T_after = (from_xyz_rpy((x, 0.0, HEIGHT), np.zeros(3)) for x in (0.02, 0.04))
        found = planner._raised(at, FLAT, T_end, T_after, at.feet[:, :2])
        each = [tuple(leaning(T, *posture) for T in planner.bodies[:2]) for posture in planner.postures]
        reached = [planner.of(end) & (planner.of(after) | ~TRIPOD) for end, after in each]
        best, second = ([k for k, legs in enumerate(reached) if legs[which].all()] for which in (TRIPOD | True, ~TRIPOD))
        first = (best or second or [0])[0]
        np.testing.assert_allclose(found, each[first], atol=1e-9)
        for feet in planner.feet[2:]:
            np.testing.assert_allclose(planner.feet[0] - feet, np.broadcast_to(margin, (6, 3)), atol=1e-9)
        taken.add(("all" if best else "standing" if second else "none", first > 0))
    assert taken == {("all", False), ("all", True), ("standing", False), ("standing", True), ("none", False)}


@pytest.mark.parametrize(("asked", "why"), [(command(height=0.25), "body height"), (command(lift=0.2), "lift of")])
def test_infeasible_command_is_reported(asked: VelocityCommand, why: str) -> None:
    assert why in PLANNER.validation_error(asked)
    assert PLANNER.validation_error(command()) == ""


def test_foothold_search_uses_map_resolution(make_terrain: Maker) -> None:
    """Check a single good place that lies between the cells of a coarser map."""
    fine = flat_terrain(0, np.zeros(2), 0.0, half_size=0.6, resolution=0.005)
    wanted = stride(standing(), fine).touchdown[0, :2]
    fine.map.score[:] = 9.0
    cell = fine.cells(wanted[None])[0][0] + (3, -5)
    fine.map.score[tuple(cell)] = 0.0
    other = [leg for leg in (2, 4) if TRIPOD[leg]]
    for leg in other:
        ij = fine.cells(stride(standing()).touchdown[leg : leg + 1, :2])[0][0]
        fine.map.score[ij[0] - 3 : ij[0] + 4, ij[1] - 3 : ij[1] + 4] = 0.0
    found = stride(standing(), fine)
    np.testing.assert_allclose(found.touchdown[0, :2], fine.map.origin + 0.005 * cell, atol=1e-9)
    assert stride(standing()).moved == 0  # and a coarser map works again


def test_body_approaches_commanded_height_at_limited_rate() -> None:
    found = stride(standing(command(0.0, height=HEIGHT + 0.02)))
    assert found.body_goal[2, 3] == pytest.approx(HEIGHT + min(0.02, PROFILE.stance.max_climb))


def test_foot_is_lifted_over_obstacle_on_its_path(make_terrain: Maker) -> None:
    at = standing(command(0.1))
    plain = stride(at)
    middle = (at.feet[0, :2] + plain.touchdown[0, :2]) / 2
    ridge = make_terrain(lambda x, y: np.where(np.hypot(x - middle[0], y - middle[1]) < 0.012, 0.06, 0.0))
    found = stride(at, ridge)
    assert plain.clearance[0] == pytest.approx(at.command.lift)
    assert found.clearance[0] >= 0.06 + SETTINGS.step.path_margin_m - 0.01
    assert found.clearance[2] == pytest.approx(at.command.lift)


def test_obstacle_higher_than_max_lift_blocks_step(make_terrain: Maker) -> None:
    at = standing(command(0.05))
    foot = at.feet[0, :2]
    # A wall around the foot, so near that no step is short enough to end before it, and bad footholds around it.
    ring = make_terrain(
        lambda x, y: np.where(np.abs(np.hypot(x - foot[0], y - foot[1]) - 0.03) < 0.012, 0.2, 0.0),
        lambda x, y: np.where(np.hypot(x - foot[0], y - foot[1]) < 0.05, 9.0, 0.0),
    )
    found = PLANNER.plan(at, ring)
    assert isinstance(found, NoStep)
    assert found.leg == 0
    assert "left front leg: to pass the ground between (" in found.reason
    assert "max_lift allows 0.11 m" in found.reason


@pytest.mark.parametrize("even", [True, False])
def test_body_travel_is_limited_by_leg_clearance(make_terrain: Maker, even: bool) -> None:
    """Check posts next to the front feet that only a femur would touch.

    The femur moves with the body.
    """
    post = make_terrain(lambda x, y: np.where((x > 0.20) & (x < 0.23) & (np.abs(y) > 0.075) & (np.abs(y) < 0.13), 0.125, 0.0))
    at = standing(command(0.06), TRIPOD if even else ~TRIPOD)
    assert stride(at).share == 1.0
    assert stride(at, post).share < 1.0


@pytest.mark.parametrize("heading", np.radians([30.0, 90.0, -135.0]))
def test_step_is_invariant_to_world_position_and_heading(heading: float) -> None:
    """Check that the step is the same in {body} on moved and turned level ground."""
    T = from_xyz_rpy((0.31, -0.17, HEIGHT), (0.0, 0.0, heading))
    here, there = stride(standing(command(0.06, 0.02, 0.1))), stride(standing(command(0.06, 0.02, 0.1), T=T))
    T_start = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
    for a, b in ((here.touchdown, there.touchdown),):
        np.testing.assert_allclose(apply(inverse(T), b), apply(inverse(T_start), a), atol=1e-6)
    np.testing.assert_allclose(inverse(T) @ there.body_goal, inverse(T_start) @ here.body_goal, atol=1e-9)


def test_retarget_on_same_map_changes_nothing() -> None:
    found = stride(standing())
    np.testing.assert_allclose(PLANNER.retarget(found, FLAT).touchdown, found.touchdown, atol=1e-9)


def test_retarget_moves_only_foot_on_bad_ground(make_terrain: Maker) -> None:
    found = stride(standing())
    bad = found.touchdown[2, :2]
    newer = make_terrain(score=lambda x, y: np.where(np.hypot(x - bad[0], y - bad[1]) < 0.02, 9.0, 0.0))
    moved = PLANNER.retarget(found, newer)
    changed = np.abs(moved.touchdown - found.touchdown).max(axis=1) > 1e-6
    np.testing.assert_array_equal(np.flatnonzero(changed), [2])
    assert newer.scores(moved.touchdown[2:3, :2])[0] <= MAX_FOOTHOLD_SCORE
    np.testing.assert_array_equal(moved.body_goal, found.body_goal)


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_retargeted_feet_stay_in_reach_until_next_step(seed: int) -> None:
    found, ground = stride(standing(command(0.1))), flat_terrain(0, np.zeros(2), 0.0)
    ground.map.score[np.random.default_rng(seed).random(ground.map.score.shape) < 0.9] = 2.0 * MAX_FOOTHOLD_SCORE
    moved = PLANNER.retarget(found, ground)
    for body in (found.body_goal, found.body_after):
        within = within_limits(PROFILE, body_inverse(PROFILE, apply(inverse(body), moved.touchdown)))
        assert within[found.swing].all()


def test_retarget_follows_ground_height(make_terrain: Maker) -> None:
    found = stride(standing())
    moved = PLANNER.retarget(found, make_terrain(lambda x, y: np.full_like(x, 0.012)))
    np.testing.assert_allclose(moved.touchdown[TRIPOD, 2] - found.touchdown[TRIPOD, 2], 0.012, atol=1e-6)


def test_retarget_keeps_foothold_without_better_one(make_terrain: Maker) -> None:
    found = stride(standing())
    nothing = make_terrain(score=lambda x, y: np.full_like(x, 9.0))
    np.testing.assert_array_equal(PLANNER.retarget(found, nothing).touchdown, found.touchdown)


def test_retarget_refuses_path_that_needs_more_lift(make_terrain: Maker) -> None:
    at = standing(command(0.1))
    found = stride(at)
    middle, bad = (at.feet[0, :2] + found.touchdown[0, :2]) / 2, found.touchdown[0, :2]

    def spoilt(x: Array, y: Array) -> Array:
        return np.where(np.hypot(x - bad[0], y - bad[1]) < 0.02, 9.0, 0.0)

    bump = make_terrain(lambda x, y: np.where(np.hypot(x - middle[0], y - middle[1]) < 0.025, 0.07, 0.0), spoilt)
    np.testing.assert_array_equal(PLANNER.retarget(found, bump).touchdown[0], found.touchdown[0])
    assert np.abs(PLANNER.retarget(found, make_terrain(score=spoilt)).touchdown[0] - found.touchdown[0]).max() > 0.01


def test_step_moved_by_pose_correction_is_unchanged_in_body_frame() -> None:
    found, T = stride(standing(command(0.06, 0.01, 0.1))), from_xyz_rpy((0.02, -0.01, 0.004), (0.0, 0.0, 0.03))
    moved = found.moved_by(T)
    for name in ("touchdown", "start"):
        was, now = getattr(found, name), getattr(moved, name)
        np.testing.assert_allclose(apply(inverse(moved.body_goal), now), apply(inverse(found.body_goal), was), atol=1e-12)
    was, now = (inverse(one.body_goal) @ one.body_after for one in (found, moved))
    np.testing.assert_allclose(now, was, atol=1e-12)
    np.testing.assert_allclose(moved.nominal, apply(T, np.column_stack([found.nominal, np.zeros(6)]))[:, :2], atol=1e-9)


# ---- gaits


@pytest.mark.slow
@pytest.mark.parametrize("gait", GAITS)
@pytest.mark.parametrize(
    ("velocity", "yaw_rate"),
    [((1.0, 0.0), 0.0), ((-1.0, 0.0), 0.0), ((0.0, 1.0), 0.0), ((0.7, -0.7), 0.0), ((0.0, 0.0), 0.15), ((0.8, 0.0), -0.1)],
)
def test_every_gait_walks_in_any_direction_and_turns_on_the_spot(
    gait: GaitName, velocity: tuple[float, float], yaw_rate: float
) -> None:
    """Check a sequence of steps on level ground.

    Enough legs stand before, during and after each step, and the body follows the command.
    """
    rhythm = GAITS[gait]
    speed = 0.06 / rhythm.stances / rhythm.pace / PROFILE.stance.step_s  # [m/s] at which a foot moves by 6 cm during its stance
    asked = replace(command(speed * velocity[0], speed * velocity[1], yaw_rate / rhythm.stances, lift=0.025), gait=gait)
    rest = PROFILE.rest_feet(HEIGHT)
    along = directions(asked.velocity, asked.yaw_rate, rest)
    body = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
    feet, shares = apply(body, rest), []
    for _ in range(4 * len(rhythm.groups)):
        swing = swing_order(rhythm, along, apply(inverse(body), feet), rest)[0]
        found = stride(StepStart(body, feet, swing, asked))
        for T in (body, found.body_goal):
            assert support_margin(feet[~swing][:, :2], T[:2, 3]) >= PROFILE.stance.support_margin
        assert within_limits(PROFILE, body_inverse(PROFILE, apply(inverse(found.body_goal), found.touchdown))).all()
        assert found.duration >= PLANNER.duration(asked)
        body, feet = found.body_goal, found.touchdown
        shares.append(found.share)
    assert np.mean(shares) > 0.9
    way = PLANNER.duration(asked) * np.sum(shares)
    turned = asked.yaw_rate * way
    assert rpy_from_rotation(body[:3, :3])[2] == pytest.approx(turned, abs=1e-6)
    assert np.linalg.norm(body[:2, 3]) <= np.linalg.norm(asked.velocity) * way + 1e-9


def test_speed_limit_of_gait_is_reported() -> None:
    slow = command(0.05)
    assert PLANNER.describe_slowdown(slow, stride(standing(slow))) == ""
    fast = replace(command(0.10), gait="wave")
    words = PLANNER.describe_slowdown(fast, stride(standing(fast, np.arange(6) == 3)))
    assert re.fullmatch(r", speed limited to \d\.\d of 10\.0 cm/s \(leg reach and joint speed in the wave gait\)", words)


def test_higher_commanded_speed_never_gives_lower_speed() -> None:
    speeds = []
    for asked in (command(v, height=PROFILE.stance.body_height, lift=0.025) for v in (0.08, 0.1, PROFILE.stance.max_speed)):
        body = from_xyz_rpy((0.0, 0.0, asked.body_height), np.zeros(3))
        rest = PROFILE.rest_feet(asked.body_height)
        feet, along = apply(body, rest), directions(asked.velocity, 0.0, rest)
        for _ in range(8):
            order = swing_order(GAITS["tripod"], along, apply(inverse(body), feet), rest)
            found, _ = PLANNER.choose([StepStart(body, feet, swing, asked) for swing in order], wide_flat(body))
            assert isinstance(found, PlannedStep)
            speed = float(found.body_goal[0, 3] - body[0, 3]) / found.duration
            body, feet = found.body_goal, found.touchdown
        speeds.append(speed)
    assert speeds == sorted(speeds)


def wide_flat(body: Array) -> Terrain:
    return flat_terrain(0, body[:2, 3], 0.0)


def test_step_of_other_legs_reports_reason() -> None:
    due, others = standing(command(0.05)), standing(command(0.05), ~TRIPOD)
    bad = stride(due).touchdown[0, :2]
    x, y = np.meshgrid(np.arange(200) * 0.01 - 1.0, np.arange(200) * 0.01 - 1.0, indexing="ij")
    score = np.where(np.hypot(x - bad[0], y - bad[1]) < 0.12, 9.0, 0.0).astype(np.float32)
    found, way = PLANNER.choose([due, others], Terrain(replace(FLAT.map, score=score)))
    assert isinstance(found, PlannedStep)
    assert way >= len(SHARES)
    assert found.instead.startswith("left front leg: no foothold")
    assert PLANNER.choose([others, due], FLAT)[0].instead == ""  # type: ignore[union-attr]


def test_search_radius_is_widened_only_when_no_legs_find_step() -> None:
    """Check one leg of each group amid ground without footholds.

    The ground extends a little beyond the first search radius.
    """
    situations = [standing(command(0.005), swing) for swing in (TRIPOD, ~TRIPOD)]
    x, y = np.meshgrid(np.arange(200) * 0.01 - 1.0, np.arange(200) * 0.01 - 1.0, indexing="ij")
    score = np.zeros((200, 200), dtype=np.float32)
    for leg, at in enumerate(situations):
        bad = PLANNER.plan(at, FLAT).nominal[leg]  # type: ignore[union-attr]
        score[np.hypot(x - bad[0], y - bad[1]) < PROFILE.stance.search_radius + 0.015] = 9.0
    ditch = Terrain(replace(FLAT.map, score=score))
    assert all(isinstance(PLANNER.plan(at, ditch), NoStep) for at in situations)
    found, _ = PLANNER.choose(situations, ditch)
    assert isinstance(found, PlannedStep)
    far = np.linalg.norm((found.touchdown[:, :2] - found.nominal)[found.swing], axis=1)
    assert PROFILE.stance.search_radius < far.max() < 1.6 * PROFILE.stance.search_radius


@pytest.mark.slow
@given(st.sets(st.integers(0, 2 * len(SHARES) - 1)))
def test_refused_choices_are_skipped_and_others_tried_in_order(refused: set[int]) -> None:
    situations = [standing(command(0.05), swing) for swing in (TRIPOD, ~TRIPOD)]
    found, way = PLANNER.choose(situations, FLAT, refused)
    left = [k for k in range(2 * len(SHARES)) if k not in refused]
    if not left:
        assert isinstance(found, NoStep)
    else:
        assert way == left[0]  # on level ground every choice is possible
        assert isinstance(found, PlannedStep)
        np.testing.assert_array_equal(found.swing, situations[way // len(SHARES)].swing)
        assert found.share == SHARES[way % len(SHARES)]


def situations_of(body: Array, feet: Array, asked: VelocityCommand) -> list[StepStart]:
    along = directions(asked.velocity, asked.yaw_rate, PROFILE.rest_feet(HEIGHT))
    order = swing_order(GAITS[asked.gait], along, apply(inverse(body), feet), PROFILE.rest_feet(HEIGHT))
    return [StepStart(body, feet, swing, asked) for swing in order]


def test_stretched_robot_gathers_feet_by_steps_on_the_spot() -> None:
    """Check a stance left by short steps of always the same legs.

    The ground for the other legs is unseen.
    """
    asked, body = command(0.11), from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
    behind = 1e-3 * np.array([[-47, 16], [-66, 0], [11, 1], [-38, 2], [12, 1], [-41, -1]])
    feet = apply(body, PROFILE.rest_feet(HEIGHT)) + np.column_stack([behind, np.zeros(6)])
    at = situations_of(body, feet, asked)
    blocked, _ = PLANNER.choose(at, FLAT)
    assert isinstance(blocked, NoStep)
    assert "out of reach" in blocked.reason
    found, way = PLANNER.gather(at, FLAT)
    assert isinstance(found, PlannedStep)
    assert way >= len(at) * len(SHARES), "no way of `choose` has its number"
    check_walkable(found, next(one for one in at if (one.swing == found.swing).all()))
    np.testing.assert_allclose(found.body_goal[:2, 3], body[:2, 3])
    other, _ = PLANNER.gather(at, FLAT, {way})
    assert isinstance(other, NoStep) or (other.swing != found.swing).all(), "what was refused is not tried again"
    assert isinstance(PLANNER.choose(situations_of(found.body_goal, found.touchdown, asked), FLAT)[0], PlannedStep)


@pytest.mark.slow
@given(st.lists(st.floats(-0.02, 0.02), min_size=12, max_size=12))
@settings(max_examples=25)
def test_gathering_steps_end_with_all_feet_near_rest(off: list[float]) -> None:
    body = from_xyz_rpy((0.0, 0.0, HEIGHT), np.zeros(3))
    rest = apply(body, PROFILE.rest_feet(HEIGHT))
    feet = rest + np.column_stack([np.reshape(off, (6, 2)), np.zeros(6)])
    for _ in range(4):
        found, _ = PLANNER.gather(situations_of(body, feet, command()), FLAT)
        if isinstance(found, NoStep):
            break
        body, feet = found.body_goal, found.touchdown
    assert isinstance(found, NoStep)
    for legs in (TRIPOD, ~TRIPOD):
        assert np.linalg.norm((feet - rest)[legs], axis=1).sum() <= 0.03


@pytest.mark.slow
@given(st.floats(0.0, 0.12), st.floats(0.02, 0.06), st.floats(-0.01, 0.01))
@settings(max_examples=25)
def test_swing_clears_obstacle_before_touchdown(height: float, before: float, aside: float) -> None:
    """Check the clearance before a touchdown; a step that needs too much lift is none."""
    at = standing(command(0.1))
    x0, y0 = stride(at).touchdown[2, :2] - [before, aside]
    x, y = np.meshgrid(np.arange(200) * 0.01 - 1.0, np.arange(200) * 0.01 - 1.0, indexing="ij")
    block = np.hypot(x - x0, y - y0) < 0.012
    ground = Terrain(replace(FLAT.map, elevation=np.where(block, height, 0.0).astype(np.float32)))
    found = PLANNER.plan(at, ground)
    if isinstance(found, PlannedStep):
        swing = found.swing
        along = ground.ground_along(found.start[:, :2], found.touchdown[:, :2])
        needed = descent_clearance(along, found.start - UP, found.touchdown - UP, SETTINGS.step.sink_margin_m)
        assert (found.clearance[swing] >= needed[swing] - 1e-9).all()
        assert found.clearance[swing].max() <= PROFILE.stance.max_lift


def test_higher_lift_takes_longer_step(make_terrain: Maker) -> None:
    low, high = (stride(standing(command(0.05, lift=lift))) for lift in (0.02, 0.08))
    assert low.duration == PROFILE.stance.step_s
    assert high.duration > low.duration
    way = np.linalg.norm((high.touchdown - high.start)[high.swing], axis=1).max() + 4 * 0.08
    assert way / (high.duration - SETTINGS.step.handover_s) == pytest.approx(PROFILE.stance.foot_speed)


@pytest.mark.slow
@pytest.mark.parametrize("off", [0.03, 0.04])
def test_body_shifts_to_give_folded_leg_clearance_from_riser(make_terrain: Maker, off: float) -> None:
    """Check a left front foot near its coxa and right before a riser.

    The actuator refuses the other legs' step.
    """
    feet = standing().feet.copy()
    feet[0, :2] -= [0.04, 0.03]
    riser = float(feet[0, 0]) + off
    block = make_terrain(
        lambda x, y: np.where((x > riser) & (x < riser + 0.25) & (y > -0.05), 0.035, 0.0),
        lambda x, y: np.where((np.abs(x - riser) < 0.02) & (y > -0.05), 9.0, 0.0),
    )
    situations = [standing(swing=legs, feet=feet) for legs in (TRIPOD, ~TRIPOD)]
    others = frozenset(range(len(SHARES), 2 * len(SHARES)))
    shift, way = PLANNER.choose(situations, block, others)
    assert isinstance(shift, PlannedStep)
    assert not shift.swing.any()
    assert "left front leg: its foot would be pushed against the ground" in shift.instead
    assert within_limits(PROFILE, body_inverse(PROFILE, apply(inverse(shift.body_goal), feet))).all()
    assert support_margin(feet[:, :2], shift.body_goal[:2, 3]) >= PROFILE.stance.support_margin
    after, _ = PLANNER.choose([replace(at, T_world_body=shift.body_goal) for at in situations], block, others)
    assert isinstance(after, PlannedStep)
    np.testing.assert_array_equal(after.swing, TRIPOD)
    assert not after.instead, "nothing stands in the way of the legs that are due"
    pushed, _ = PLANNER.choose(situations, block, others | {way})
    assert isinstance(pushed, PlannedStep)
    assert pushed.swing[0], "the last resort, once the actuator refuses the shift as well"


def test_faster_pace_shortens_a_step_within_the_speed_of_the_servos(make_terrain: Maker) -> None:
    at, terrain = standing(command(0.05)), make_terrain()
    usual = PLANNER.plan(at, terrain)
    quick = PLANNER.plan(replace(at, pace=Pace(0.5, 2.0 * PROFILE.stance.foot_speed)), terrain)
    reckless = PLANNER.plan(replace(at, pace=Pace(0.3, 100.0)), terrain)
    assert isinstance(usual, PlannedStep)
    assert isinstance(quick, PlannedStep)
    assert isinstance(reckless, PlannedStep)
    assert quick.duration < usual.duration
    bodies = at.T_world_body, reckless.body_goal, StepParams().max_joint_speed
    in_air = shortest_swing_s(PROFILE, reckless.start, reckless.touchdown, reckless.clearance, *bodies)
    assert reckless.duration >= in_air[reckless.swing].max()
