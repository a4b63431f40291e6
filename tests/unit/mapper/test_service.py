"""Mapper service: assumed and measured ground, and the times of publication."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sextant.services.mapper.config import Settings
from sextant.services.mapper.service import Mapper
from sextant.services.planner.terrain import Terrain
from sextant.shared.color import codes, ycocg_from_rgb
from sextant.shared.geometry import Array, apply, from_xyz_rpy
from sextant.shared.plugins.loading import PluginError
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import (
    MAX_FOOTHOLD_SCORE,
    ActuatorState,
    BodyPose,
    Message,
    Mode,
    PassageMap,
    PassageRequest,
    Scan,
    ScanReceipt,
    TerrainMap,
)
from tests.support.states import actuator_state

Flags = NDArray[np.bool_]

PROFILE = load_profile("phantomx_mk2")
HEIGHT = 0.10
MS = 1_000_000
SETTINGS = Settings(cells=200, publish_every=1)


def legs(swing: Flags | None = None, feet: Array | None = None) -> ActuatorState:
    swing = np.zeros(6, dtype=bool) if swing is None else swing
    return actuator_state(PROFILE, swing=swing, feet=PROFILE.rest_feet(HEIGHT) if feet is None else feet)


def ground_scan(stamp_ns: int, height: float, x: tuple[float, float] = (0.5, 1.0), y: float = 0.3) -> Scan:
    """Return a scan with a point in the middle of each cell of a level rectangle."""
    cx, cy = np.meshgrid(np.arange(x[0], x[1], 0.01) + 0.005, np.arange(-y, y, 0.01) + 0.005, indexing="ij")
    n = cx.size
    mm = np.column_stack([cx.ravel(), cy.ravel(), np.full(n, height)]) * 1e3
    return Scan(
        stamp_ns=stamp_ns,
        origin=np.zeros(3),
        points_mm=np.rint(mm).astype(np.int16),
        pixel_count=np.full(n, 20, dtype=np.uint8),
        height_range_mm=np.zeros(n, dtype=np.uint8),
        p_world_camera=np.array([0.1, 0.0, 0.25]),
        pose_covariance=np.eye(6) * 1e-6,
    )


def without_receipt(made: Iterable[Message]) -> list[Message]:
    receipt, *rest = made
    assert isinstance(receipt, ScanReceipt)
    return rest


class Rig:
    def __init__(self, settings: Settings = SETTINGS) -> None:
        self.mapper = Mapper(PROFILE, settings)
        self.inbox = Inbox([self.mapper.trigger, *self.mapper.subscribes], self.mapper.stages)
        self.now_ns = 0

    def hear(self, message: Message) -> None:
        self.inbox.receive(topics.OF_TYPE[type(message)], codec.encode(message), self.now_ns)

    def stand(self, T: Array, state: ActuatorState | None = None) -> None:
        self.hear(BodyPose(self.now_ns, T, np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6))))
        self.hear(state or legs())

    def scan(self, height: float = 0.0, x: tuple[float, float] = (0.5, 1.0)) -> list[TerrainMap]:
        self.now_ns += 66 * MS
        made = list(self.mapper.step(ground_scan(self.now_ns, height, x), self.inbox))
        return [m for m in made if isinstance(m, TerrainMap)]


def at(x: float = 0.0, yaw: float = 0.0, pitch: float = 0.0) -> Array:
    return from_xyz_rpy((x, 0.0, HEIGHT), (0.0, pitch, yaw))


def test_start_ground_is_foot_plane_marked_assumed() -> None:
    rig = Rig()
    rig.stand(at())
    (map_,) = rig.scan()
    ground = Terrain(map_)
    under = np.array([[0.0, 0.0], [0.2, 0.2], [-0.2, -0.1], [0.45, 0.0]])
    np.testing.assert_allclose(ground.heights(under), 0.0, atol=1e-6)
    i, j = ground.cells(under)[0].T
    assert map_.assumed[i, j].all()
    assert (ground.scores(under) <= 1.0).all()
    assert np.isnan(ground.heights(np.array([[-0.6, 0.0], [0.3, 0.6]]))).all()


def test_score_is_that_of_the_foothold_plugin() -> None:
    rig = Rig(replace(SETTINGS, foothold_rule="tests.support.plugins:Weighted"))
    rig.stand(at())
    (map_,) = rig.scan()
    assert (map_.score == 1.0).all(), "the rule scores each cell by the foot radius"
    assert (map_.evaluation < 0).any(), "Masri's layer stays"


def test_score_of_another_shape_names_the_plugin() -> None:
    rig = Rig(replace(SETTINGS, foothold_rule="tests.support.plugins:wrong_shape"))
    rig.stand(at())
    with pytest.raises(PluginError, match=r"wrong_shape failed: ValueError: a score as a float array \(200, 200\) expected"):
        rig.scan()


@pytest.mark.parametrize(("yaw", "pitch"), [(0.0, 0.1), (1.0, 0.0), (-2.0, -0.08)])
def test_assumed_plane_follows_feet_at_any_body_orientation(yaw: float, pitch: float) -> None:
    rig, T = Rig(), at(yaw=yaw, pitch=pitch)
    rig.stand(T)
    (map_,) = rig.scan(x=(2.0, 2.01))
    ground = Terrain(map_)
    feet = apply(T, PROFILE.rest_feet(HEIGHT))
    cells = ground.centres(feet[:, :2])
    slope = np.linalg.lstsq(np.column_stack([np.ones(6), feet[:, :2]]), feet[:, 2] - PROFILE.foot.radius, rcond=None)[0]
    np.testing.assert_allclose(ground.heights(cells), slope[0] + cells @ slope[1:], atol=1e-5)


def test_measured_ground_replaces_assumed_ground() -> None:
    rig = Rig()
    rig.stand(at())
    (before,) = rig.scan(x=(0.8, 1.0))
    (after,) = rig.scan(0.02, x=(0.4, 1.0))
    place = np.array([[0.55, 0.0]])
    (i, j), (k, m) = Terrain(before).cells(place)[0][0], Terrain(after).cells(place)[0][0]
    assert before.assumed[i, j]
    assert before.elevation[i, j] == pytest.approx(0.0, abs=1e-6)
    assert not after.assumed[k, m]
    assert after.elevation[k, m] == pytest.approx(0.02, abs=1e-3)


def test_foot_plane_is_assumed_only_once() -> None:
    rig = Rig()
    rig.stand(at())
    rig.scan(x=(0.8, 1.0))
    rig.stand(at(0.5))
    (later,) = rig.scan(x=(0.8, 1.0))
    assert np.isnan(Terrain(later).heights(np.array([[0.75, 0.38], [1.1, 0.0]]))).all()


def test_no_ground_is_assumed_without_pose_and_leg_state() -> None:
    rig = Rig()
    (map_,) = rig.scan()
    assert not map_.assumed.any()
    assert np.isfinite(map_.elevation).any()
    rig.stand(at())
    (then,) = rig.scan()
    assert then.assumed.any()


@pytest.mark.parametrize(
    "limp",
    [
        replace(legs(), mode=Mode.OFF, contact=np.zeros(6, dtype=bool)),
        replace(legs(), contact=np.zeros(6, dtype=bool)),
        legs(feet=PROFILE.rest_feet(HEIGHT) + np.array([0.0, 0.0, 1e30])),
    ],
)
def test_no_ground_is_assumed_from_legs_that_do_not_stand(limp: ActuatorState) -> None:
    rig = Rig()
    rig.stand(at())
    rig.hear(replace(limp, stamp_ns=rig.now_ns))
    (before,) = rig.scan()
    assert not before.assumed.any()
    rig.stand(at())
    (then,) = rig.scan()
    assert then.assumed.any()


def test_swing_feet_are_excluded_from_assumed_plane() -> None:
    """Start the mapper in the middle of a step."""
    rig, swing = Rig(), np.arange(6) % 2 == 0
    lifted = PROFILE.rest_feet(HEIGHT) + np.where(swing[:, None], [0.0, 0.0, 0.05], 0.0)
    rig.stand(at(), legs(swing, lifted))
    (map_,) = rig.scan(x=(0.8, 1.0))
    np.testing.assert_allclose(Terrain(map_).heights(np.array([[0.0, 0.0], [0.2, 0.1]])), 0.0, atol=1e-6)


def test_each_scan_makes_map_when_scans_are_rare() -> None:
    rig = Rig(replace(SETTINGS, publish_every=2))
    rig.stand(at())
    maps = [len(rig.scan()) for _ in range(4)]
    for _ in range(4):
        rig.now_ns += 150 * MS
        maps.append(len(rig.scan()))
    assert maps == [0, 1, 0, 1, 1, 1, 1, 1]


def test_scan_receipt_is_sent_before_mapping() -> None:
    rig = Rig()
    rig.stand(at())
    scan = ground_scan(rig.now_ns, 0.0)
    receipt = next(iter(rig.mapper.step(scan, rig.inbox)))
    assert isinstance(receipt, ScanReceipt)
    assert (receipt.stamp_ns, receipt.refused) == (scan.stamp_ns, "")
    assert np.isnan(receipt.leg_heights).all()


@pytest.mark.parametrize("every", [1, 2, 4])
def test_map_is_published_every_n_scans_with_newest_stamp(every: int) -> None:
    rig = Rig(replace(SETTINGS, publish_every=every))
    rig.stand(at())
    for k in range(1, 9):
        maps = rig.scan()
        assert len(maps) == (k % every == 0)
        assert all(m.stamp_ns == rig.now_ns for m in maps)
    assert "8 scans" in rig.mapper.status()


def test_map_follows_robot_and_keeps_known_ground() -> None:
    rig = Rig()
    rig.stand(at())
    rig.scan(0.01)
    rig.stand(at(0.4))
    (map_,) = rig.scan(0.01, x=(0.9, 1.3))
    centre = map_.origin + map_.resolution * (np.array(map_.elevation.shape) - 1) / 2
    np.testing.assert_allclose(centre, [0.4, 0.0], atol=0.011)
    assert Terrain(map_).heights(np.array([[0.6, 0.0]]))[0] == pytest.approx(0.01, abs=1e-3)


def test_unknown_stays_unknown_in_every_layer() -> None:
    rig = Rig()
    rig.stand(at())
    (map_,) = rig.scan()
    unseen = np.isnan(map_.elevation)
    assert unseen.any()
    np.testing.assert_array_equal(np.isnan(map_.variance), unseen)
    assert not map_.assumed[unseen].any()


STRIP = PassageRequest(0, np.array([-0.45, 0.0]), 0.0, 2.7, 1.0)


def surveyed(
    rig: Rig, request: PassageRequest, height: float = 0.0, x: tuple[float, float] = (0.5, 1.0), swing: Flags | None = None
) -> list[PassageMap]:
    """Return the passage maps of eight scans, each with a new request of the strip."""
    told = []
    for _ in range(8):
        rig.hear(replace(request, stamp_ns=rig.now_ns))
        rig.hear(legs(swing))
        rig.now_ns += 66 * MS
        rig.inbox.now_ns = rig.now_ns
        made = without_receipt(rig.mapper.step(ground_scan(rig.now_ns, height, x), rig.inbox))
        told += [codec.decode(codec.encode(m), PassageMap)[0] for m in made if isinstance(m, PassageMap)]
    return told


def test_passage_map_is_published_only_while_requested() -> None:
    rig = Rig()
    rig.stand(at())
    rig.scan()
    assert "mapping a gap" not in rig.mapper.status()
    (told,) = surveyed(rig, STRIP)
    assert told.stamp_ns == rig.now_ns
    assert told.elevation.shape == (270, 100)
    np.testing.assert_allclose(told.origin, [-0.445, -0.495])
    assert "mapping a gap" in rig.mapper.status()
    rig.now_ns += 1600 * MS
    rig.inbox.now_ns = rig.now_ns
    made = without_receipt(rig.mapper.step(ground_scan(rig.now_ns, 0.0), rig.inbox))
    assert [type(m) for m in made] == [TerrainMap]
    assert "mapping a gap" not in rig.mapper.status()


def test_passage_map_distinguishes_measured_assumed_and_unseen_cells() -> None:
    rig = Rig()
    rig.stand(at())
    rig.scan(0.02)
    (told,) = surveyed(rig, STRIP, height=0.02)
    x, y = told.origin[0] + 0.01 * np.arange(270), told.origin[1] + 0.01 * np.arange(100)
    measured = (x[:, None] > 0.51) & (x[:, None] < 0.99) & (np.abs(y) < 0.28)
    np.testing.assert_allclose(told.elevation[measured], 0.02, atol=1e-3)
    assert not told.assumed[measured].any()
    np.testing.assert_array_equal(told.normals[measured], np.broadcast_to([0, 0, 32767], (np.count_nonzero(measured), 3)))
    under = (x[:, None] > -0.42) & (x[:, None] < 0.47) & (np.abs(y) < 0.38)
    assert told.assumed[under].all()
    np.testing.assert_allclose(told.elevation[under], 0.0, atol=1e-6)
    beyond = (x[:, None] > 1.1) & np.ones(100, dtype=bool)
    assert np.isnan(told.elevation[beyond]).all()
    assert not told.normals[beyond].any()
    assert told.unseen_share == pytest.approx(np.isnan(told.elevation).mean())
    assert told.reason.startswith(f"{np.isnan(told.elevation).sum()} of 27000 cells not seen: ")
    assert told.next_view_cells.sum() > 20
    assert np.isnan(told.elevation[told.next_view_cells]).all()
    assert len(codec.encode(told)) < 500_000
    assert (told.evaluation[(x[:, None] > 0.6) & (x[:, None] < 0.9) & (np.abs(y) < 0.2)] == -5).all()
    assert (told.evaluation[beyond] == 127).all()


def test_passage_map_has_resolution_of_terrain_map() -> None:
    rig = Rig(Settings(cells=128, resolution=0.02, publish_every=1))
    rig.stand(at())
    rig.scan(0.02)
    (told,) = surveyed(rig, STRIP, height=0.02)
    assert told.resolution == 0.02
    assert told.elevation.shape == (135, 50)
    x, y = told.origin[0] + 0.02 * np.arange(135), told.origin[1] + 0.02 * np.arange(50)
    measured = (x[:, None] > 0.53) & (x[:, None] < 0.97) & (np.abs(y) < 0.27)
    np.testing.assert_allclose(told.elevation[measured], 0.02, atol=1e-3)
    assert (told.normals[measured][:, 2] > 32000).all()


def test_no_view_is_proposed_while_legs_swing() -> None:
    rig = Rig()
    swing = np.array([True, False, False, False, False, False])
    rig.stand(at(), legs(swing))
    rig.scan()
    (told,) = surveyed(rig, STRIP, swing=swing)
    assert not told.next_view_cells.any()
    assert "legs swing" in told.reason
    np.testing.assert_array_equal(told.T_world_next_view, at())


def test_passage_map_includes_ground_measured_before_request() -> None:
    rig = Rig()
    rig.stand(at())
    rig.scan(0.03, x=(0.8, 0.95))
    rig.scan(0.03, x=(0.8, 0.95))
    (told,) = surveyed(rig, STRIP, x=(0.5, 0.7))
    place = told.elevation[round((0.9 + 0.45) / 0.01), 50]
    assert place == pytest.approx(0.03, abs=1e-3)


def test_moved_strip_keeps_overlapping_cells() -> None:
    rig = Rig()
    rig.stand(at())
    (before,) = surveyed(rig, STRIP)
    (after,) = surveyed(rig, replace(STRIP, origin=np.array([0.05, 0.0])))
    np.testing.assert_allclose(after.elevation[46:94, 22:78], before.elevation[96:144, 22:78], atol=1e-4)


@pytest.mark.parametrize(
    ("origin", "heading", "length", "width", "words"),
    [
        ((0.0, 0.0), 0.0, -1.0, 1.0, "length and width"),
        ((0.0, 0.0), 0.0, 2.705, 1.0, "whole cells"),
        ((0.0, 0.0), 0.0, 50.0, 50.0, "at most 40000 cells"),
        ((0.0, 0.0), 0.785, 100.0, 0.04, "in the box around the strip"),
        ((1e9, 0.0), 0.0, 2.7, 1.0, "within"),
        ((0.0, 0.0), 0.0, 1.0, 0.02, "at least 3 cells along and across expected, found 100 x 2"),
        ((0.0, 0.0), 0.0, 0.01, 1.0, "at least 3 cells"),
    ],
)
def test_invalid_strip_is_refused_with_reason(
    origin: tuple[float, float], heading: float, length: float, width: float, words: str
) -> None:
    rig = Rig()
    rig.stand(at())
    told = surveyed(rig, PassageRequest(0, np.array(origin), heading, length, width))
    assert [m.elevation.size for m in told] == [0]
    assert words in told[0].reason
    assert told[0].unseen_share == 1.0
    assert len(surveyed(rig, STRIP)) == 1


# ---- foothold layers


def step_ahead(rig: Rig, covariance: NDArray[np.float64], height: float = HEIGHT) -> TerrainMap:
    """Return the map of level ground with a 3 cm step at x = 0.75 m.

    The pose of the body has a covariance (6, 6).
    """
    T = from_xyz_rpy((0.0, 0.0, height), (0.0, 0.0, 0.0))
    rig.hear(BodyPose(rig.now_ns, T, np.eye(4), covariance, 1.0, True, "", np.zeros((0, 6))))
    rig.hear(legs())
    rig.scan(0.0, x=(0.5, 0.75))
    (map_,) = rig.scan(0.03, x=(0.75, 1.0))
    return map_


def nearest_to_the_step(map_: TerrainMap, good: Flags) -> float:
    """Return the distance [m] from the step to the nearest foothold below it."""
    j = round((0.0 - map_.origin[1]) / map_.resolution)
    x = map_.origin[0] + map_.resolution * np.arange(map_.elevation.shape[0])
    return float(0.75 - x[good[:, j] & (x < 0.75)].max())


def test_both_foothold_layers_agree_near_step() -> None:
    map_ = step_ahead(Rig(), np.eye(6) * 1e-6)
    for good in (map_.score <= 1, map_.evaluation < 0):
        assert 0.015 <= nearest_to_the_step(map_, good) <= 0.035
    assert (map_.evaluation[np.isnan(map_.elevation)] == 127).all()


def test_uncertain_pose_widens_margin_of_both_layers() -> None:
    doubtful = np.eye(6) * 1e-6
    doubtful[:2, :2] = [[0.015**2, 0.0], [0.0, 0.001**2]]  # along x only: a foot may be off to either side of the step
    sure, unsure = step_ahead(Rig(), np.eye(6) * 1e-6), step_ahead(Rig(), doubtful)
    for layer in (lambda m: m.score <= 1, lambda m: m.evaluation < 0):
        assert nearest_to_the_step(unsure, layer(unsure)) >= nearest_to_the_step(sure, layer(sure)) + 0.015


def test_ground_far_below_the_body_is_not_accessible() -> None:
    """Check the depth limit of 0.25 m, which counts from the body.

    With the body high enough, the robot's own ground is too deep.
    """
    low, high = step_ahead(Rig(), np.eye(6) * 1e-6), step_ahead(Rig(), np.eye(6) * 1e-6, height=0.30)
    assert (low.evaluation < 0).any()
    measured = np.isfinite(high.elevation) & ~high.assumed
    deep = high.elevation < 0.05 - 1e-3
    assert (high.evaluation[measured & deep] > 0).all()


@pytest.mark.parametrize(("cells", "cells_y", "resolution"), [(100, 300, 0.02), (512, 0, 0.01), (300, 200, 0.005)])
def test_map_of_any_size_and_resolution_is_scored(cells: int, cells_y: int, resolution: float) -> None:
    rig = Rig(Settings(cells=cells, cells_y=cells_y, resolution=resolution, publish_every=1))
    rig.stand(at())
    maps = [m for _ in range(4) for m in rig.scan(0.01)]
    assert maps[-1].elevation.shape == (cells, cells_y or cells)
    assert maps[-1].resolution == resolution
    place = np.array([[0.72, 0.1]])  # outside the assumed ground
    i, j = np.rint((place[0] - maps[-1].origin) / resolution).astype(int)
    assert np.nanmedian(maps[-1].elevation[i - 2 : i + 3, j - 2 : j + 3]) == pytest.approx(0.01, abs=1e-3)
    if resolution >= 0.01:
        assert maps[-1].score[i, j] <= 1.0


def test_map_is_consistent_with_newest_pose_after_height_drift() -> None:
    """Let the pose rise by 0.8 mm per scan while the camera moves over level ground."""
    rig = Rig(replace(SETTINGS, publish_every=1))
    rig.stand(at())
    maps: list[TerrainMap] = []
    for k in range(60):
        maps += rig.scan(0.0008 * k, x=(0.5 + 0.0025 * k, 0.8 + 0.0025 * k))
    ground = Terrain(maps[-1])
    early, late = ground.heights(np.array([[0.55, 0.0], [0.9, 0.0]]))
    assert late == pytest.approx(0.0008 * 59, abs=0.003)
    assert early == pytest.approx(late, abs=0.005)
    assert "compensates +" in rig.mapper.status()


@pytest.mark.parametrize("lifted", [-50.0, 50.0])
def test_contacts_far_from_mapped_height_are_ignored(lifted: float) -> None:
    """Check a single wrong pose that moves the feet by metres.

    Their contacts are not mapped as ground.
    """
    rig, right = Rig(), np.array([True, False] * 3)
    rig.mapper = Mapper(replace(PROFILE, camera=replace(PROFILE.camera, color=True)), SETTINGS)
    confidence = []
    for step, phase, swing, height in ((1, 0.5, right, 0.0), (2, 0.5, ~right, lifted), (2, 1.0, ~right, lifted)):
        rig.now_ns += 66 * MS
        T_world_odom = from_xyz_rpy((0.0, 0.0, HEIGHT + height), (0.0, 0.0, 0.0))
        rig.hear(BodyPose(rig.now_ns, at(), T_world_odom, np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6))))
        rig.hear(replace(legs(swing), stamp_ns=rig.now_ns, step=step, phase=phase))
        seen = ground_scan(rig.now_ns, 0.0, x=(-0.4, 0.4))
        colored = replace(seen, color=codes(np.full((len(seen.points_mm), 3), 120, dtype=np.uint8)))
        (made,) = without_receipt(rig.mapper.step(colored, rig.inbox))
        assert isinstance(made, TerrainMap)
        confidence.append(made.confidence)
    np.testing.assert_array_equal(confidence[2], confidence[1])


def stand_on_seen_ground(rig: Rig, depth: float, on_pillars: int, scans: int = 25) -> TerrainMap:
    """Let a robot stand where ground was seen at a depth [m]; return the last map.

    Under some of its feet the ground was seen at the height of their soles.
    """
    level = PROFILE.rest_feet(HEIGHT)[:, 2].mean() + HEIGHT - PROFILE.foot.radius
    state, maps = legs(), []
    for _ in range(20):
        rig.now_ns += 66 * MS
        seen = ground_scan(rig.now_ns, level - depth, x=(-0.5, 0.6), y=0.4)
        points = seen.points_mm.copy()
        for foot in state.feet[:on_pillars, :2]:
            points[np.abs(points[:, :2] - 1e3 * foot).max(axis=1) < 80.0, 2] = round(1e3 * level)
        list(rig.mapper.step(replace(seen, points_mm=points), rig.inbox))
    for _ in range(scans):
        rig.stand(at(), replace(state, step=3))
        maps += rig.scan(level, x=(0.4, 0.8))
    return maps[-1]


def test_map_restarts_without_ground_under_standing_feet() -> None:
    rig = Rig()
    made = Terrain(stand_on_seen_ground(rig, 0.75, on_pillars=0))
    np.testing.assert_allclose(made.heights(PROFILE.rest_feet(HEIGHT)[:, :2]), 0.0, atol=0.02)
    assert np.isnan(made.heights(np.array([[-0.45, 0.0]]))).all(), "what it knew elsewhere is forgotten"
    assert "restarted 1 times because the feet stood where the map had no ground" in rig.mapper.status()


@pytest.mark.parametrize(
    ("depth", "on_pillars", "scans"),
    [(0.06, 0, 25), (0.75, 3, 25), (0.75, 0, 12)],
    ids=["a little off", "three feet on pillars", "for a moment"],
)
def test_map_is_kept_if_feet_may_stand_on_it(depth: float, on_pillars: int, scans: int) -> None:
    rig = Rig()
    stand_on_seen_ground(rig, depth, on_pillars, scans)
    assert "restarted" not in rig.mapper.status()


def test_scan_color_is_ignored_for_robot_without_color_camera() -> None:
    rig = Rig()
    rig.hear(legs(np.zeros(6, dtype=np.bool_)))
    seen = ground_scan(rig.now_ns, 0.0, x=(-0.4, 0.4))
    colored = replace(seen, color=codes(np.full((len(seen.points_mm), 3), 120, dtype=np.uint8)))
    (made,) = without_receipt(rig.mapper.step(colored, rig.inbox))
    assert isinstance(made, TerrainMap)
    assert np.isfinite(made.elevation).any()
    assert made.color.size == 0


def maps_with_puddle(settings: Settings) -> list[Message]:
    """Return the messages of a mapper that sees a puddle of 16 x 16 cm around (0.85, 0.1)."""
    rig = Rig()
    rig.mapper = Mapper(replace(PROFILE, camera=replace(PROFILE.camera, color=True)), settings)
    rig.inbox = Inbox([rig.mapper.trigger, *rig.mapper.subscribes], rig.mapper.stages)
    rig.stand(at())
    made: list[Message] = []
    for _ in range(8):
        rig.now_ns += 66 * MS
        rig.inbox.now_ns = rig.now_ns
        rig.hear(replace(STRIP, stamp_ns=rig.now_ns))
        rig.hear(legs())
        seen = ground_scan(rig.now_ns, 0.0)
        puddle = (np.abs(seen.points[:, :2] - [0.85, 0.1]) < 0.08).all(axis=1)
        rgb = np.where(puddle[:, None], [150, 175, 205], [120, 118, 115]).astype(np.uint8)
        made += rig.mapper.step(replace(seen, color=codes(ycocg_from_rgb(rgb))), rig.inbox)
    return made


@pytest.mark.parametrize("limit", [0.3, 1.0, 100.0])
def test_hazard_is_no_foothold_at_any_limit_of_the_score(limit: float) -> None:
    footholds = replace(SETTINGS.footholds, score=replace(SETTINGS.footholds.score, limit=limit))
    last = [m for m in maps_with_puddle(replace(SETTINGS, footholds=footholds)) if isinstance(m, TerrainMap)][-1]
    scored = last.hazard.astype(bool) & np.isfinite(last.score)
    assert scored.sum() > 100
    assert (last.score[scored] > MAX_FOOTHOLD_SCORE).all()


def test_passage_map_has_no_foothold_in_puddle() -> None:
    told = [m for m in maps_with_puddle(SETTINGS) if isinstance(m, PassageMap)]
    x, y = told[-1].origin[0] + 0.01 * np.arange(270)[:, None], told[-1].origin[1] + 0.01 * np.arange(100)
    in_it = (np.abs(x - 0.85) < 0.07) & (np.abs(y - 0.1) < 0.07)
    beside = (np.abs(x - 0.85) < 0.07) & (np.abs(y + 0.15) < 0.07)
    assert (told[-1].evaluation[in_it] > 0).all()
    assert (told[-1].evaluation[beside] < 0).all()


@pytest.mark.parametrize(("bear", "step", "assumed"), [(6, 0, True), (5, 0, True), (4, 0, False), (4, 3, True)])
def test_no_plane_is_assumed_with_unloaded_feet_before_first_step(bear: int, step: int, assumed: bool) -> None:
    rig = Rig()
    rig.stand(at(), replace(legs(), contact=np.arange(6) < bear, step=step))
    (map_,) = rig.scan(x=(0.8, 1.0))
    assert map_.assumed.any() == assumed
