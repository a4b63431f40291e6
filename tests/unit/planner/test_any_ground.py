"""Planning on random maps of any size and with any goal: a result or a reason.

No call raises an exception.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.services.planner.gap_crossing.gap_detection import GapEdge, detect_gap
from sextant.services.planner.gap_crossing.params import GapDetectionParams
from sextant.services.planner.gap_crossing.strip_survey import BEHIND, STRIP
from sextant.services.planner.navigation.params import CostmapParams
from sextant.services.planner.navigation.path_planner import NoPath, find_path
from sextant.services.planner.navigation.traversability import LocalGroundMap, RequiredSpace
from sextant.services.planner.roadmap.params import BareGroundParams
from sextant.services.planner.roadmap.sections import bare, goal_behind, without
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.services.planner.terrain import Terrain
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Goal, PassageMap, PassageRequest, StepPlan, TerrainMap
from tests.unit.planner.test_service import HEIGHT, Rig

CAMERA = load_profile("phantomx_mk2").camera
MAX_STEP_M = CostmapParams().max_step_m
HEIGHTS = [0.0, 0.0, 0.0, 0.03, 0.09, 0.4, -0.05, -0.4, np.nan]  # [m] of patches
RESOLUTIONS = [0.01, 0.01, 0.015, 0.04, 0.1]  # [m]
seeds = st.integers(0, 2**32 - 1)


def patches(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Return heights (nx, ny) [m] in patches or strips, uniform or unknown."""
    coarse = rng.choice(HEIGHTS, (rng.integers(1, 9), rng.integers(1, 9)))
    if rng.random() < 0.1:
        coarse[:] = np.nan
    i, j = (np.sort(rng.integers(0, n, size)) for n, size in zip(coarse.shape, shape, strict=True))
    return np.asarray(coarse[np.ix_(i, j)])


def any_map(rng: np.random.Generator) -> TerrainMap:
    """Return a map of random size and place; its scores need not fit its heights."""
    shape = (int(rng.integers(1, 180)), int(rng.integers(1, 180)))
    resolution = float(rng.choice(RESOLUTIONS))
    height = patches(rng, shape)
    flat = height == rng.choice([0.0, 0.03])
    whole = rng.random() < 0.2
    return TerrainMap(
        stamp_ns=0,
        resolution=resolution,
        origin=rng.uniform(-1.0, 0.2, 2) * (np.array(shape) * resolution),
        elevation=height.astype(np.float32),
        variance=np.full(shape, 1e-6, dtype=np.float32),
        score=np.where(np.isnan(height), np.nan, np.where(flat | whole, 0.0, 9.0)).astype(np.float32),
        assumed=np.zeros(shape, dtype=np.bool_),
        evaluation=np.where(np.isnan(height), 127, np.where(flat | whole, -5, 5)).astype(np.int8),
    )


def any_strip(rng: np.random.Generator, request: PassageRequest, resolution: float = 0.01) -> PassageMap:
    """Return the map of a requested strip with random ground."""
    shape = (round(request.length / resolution), round(request.width / resolution))
    height = patches(rng, shape)
    along = np.array([np.cos(request.heading), np.sin(request.heading)])
    left = np.array([-along[1], along[0]])
    right_side = request.origin + resolution * 0.5 * along - (0.5 * request.width - 0.5 * resolution) * left
    carries = height == 0.0
    return PassageMap(
        stamp_ns=0,
        resolution=resolution,
        origin=right_side,
        heading=request.heading,
        elevation=height.astype(np.float32),
        evaluation=np.where(np.isnan(height), 127, np.where(carries, -9, 9)).astype(np.int8),
        normals=np.zeros((*shape, 3), dtype=np.int16),
        roughness=np.zeros(shape, dtype=np.float32),
        assumed=np.zeros(shape, dtype=np.bool_),
        unseen_share=float(np.isnan(height).mean()),
        reason="",
        T_world_next_view=from_xyz_rpy((*request.origin, HEIGHT), (0.0, 0.0, request.heading)),
        next_view_cells=np.zeros(shape, dtype=np.bool_),
    )


@settings(max_examples=200, deadline=None)
@given(seeds)
def test_detected_gap_lies_between_robot_and_target(seed: int) -> None:
    rng = np.random.default_rng(seed)
    terrain = Terrain(any_map(rng))
    xy, target = rng.uniform(-1.5, 1.5, (2, 2))
    found = detect_gap(
        terrain, xy, target, float(rng.choice([-0.4, 0.0, 0.03])), CostmapParams().max_step_m, GapDetectionParams()
    )
    if isinstance(found, GapEdge):
        assert 0.0 <= found.distance <= np.linalg.norm(target - xy)
    else:
        assert found


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(seeds)
def test_path_on_any_map_starts_at_robot_or_has_reason(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ground, terrain = LocalGroundMap(CostmapParams()), Terrain(any_map(rng))
    place = np.array([*rng.uniform(-1.0, 1.0, 2), rng.uniform(-np.pi, np.pi)])
    body = from_xyz_rpy((*place[:2], HEIGHT), (0.0, 0.0, place[2]))
    for _ in range(4):
        ground.add_map(terrain, body, CAMERA, 0.0)
    stuck = rng.uniform(-1.0, 1.0, (int(rng.integers(0, 3)), 2))
    goal = rng.uniform(-1.0, 1.0, 2) * rng.choice([0.02, 1.0, 6.0])
    cost_map = ground.cost_map(RequiredSpace(0.31, 0.19, 0.51), place, stuck, 0.08).beside(place[:2], goal, 1.5)
    found = find_path(cost_map, place[:2], goal, 0.05)
    if isinstance(found, NoPath):
        assert found.reason
    else:
        np.testing.assert_array_equal(found.corners[0], place[:2])
        assert np.isfinite(found.corners).all()


@settings(max_examples=100, deadline=None)
@given(seeds)
def test_section_goal_on_any_strip_is_ahead_up_to_target(seed: int) -> None:
    rng = np.random.default_rng(seed)
    request = PassageRequest(0, rng.uniform(-1.0, 1.0, 2), float(rng.uniform(-3.0, 3.0)), *STRIP)
    field = StripMap.of(any_strip(rng, request))
    for _ in range(int(rng.integers(0, 4))):
        field = without(field, rng.uniform([-0.2, -0.6, -0.4], [2.9, 0.6, 0.1]), 0.055)
    x, target = rng.uniform(-0.3, 3.0, 2)
    goal = goal_behind(field, x, target, BareGroundParams())
    assert goal is None or x - BEHIND < goal <= target
    assert bare(field, BareGroundParams()).shape == (len(field.evaluation),)


@pytest.mark.slow
@settings(max_examples=4, deadline=None)
@given(seeds)
def test_planner_steps_or_reports_reason_on_any_map_and_strip(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = Rig()
    rig.command, rig.terrain = None, any_map(rng)
    waypoints = rng.uniform(-1.5, 1.5, (int(rng.integers(1, 4)), 2)) * rng.choice([0.03, 1.0, 4.0])
    rig.goal = Goal(0, waypoints, 0.05, 0.1, HEIGHT, 0.03, gap_crossing="always" if rng.random() < 0.5 else "if needed")
    for _ in range(40):
        said = rig.cycle()
        for request in (m for m in said if isinstance(m, PassageRequest)):
            answer = replace(any_strip(rng, request), stamp_ns=rig.now_ns)
            rig.inbox.receive(topics.PASSAGE, codec.encode(answer), rig.now_ns)
        for plan in (m for m in said if isinstance(m, StepPlan)):
            assert np.isfinite(plan.touchdown).all()
            rig.begin(plan)
            rig.finish(plan)
            assert rig.pose is not None
            rig.pose = replace(rig.pose, T_world_body=rig.state.T_odom_body)
            rig.terrain = any_map(rng) if rng.random() < 0.3 else rig.terrain
    assert rig.status().reason
