"""Mapper with invalid scans: it keeps running, reports the error, and recovers.

It publishes no map of an invalid scan.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sextant.services.mapper.config import Settings
from sextant.services.mapper.elevation.elevation_grid import ElevationGrid
from sextant.services.mapper.service import Mapper
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import BodyPose, Scan, TerrainMap

PROFILE = load_profile("phantomx_mk2")
CAMERA = (0.1, 0.0, 0.25)
EMPTY = np.zeros((0, 3), np.int16)


def scan(points_mm, stamp_ns: int = 0, **changes: object) -> Scan:  # type: ignore[no-untyped-def]
    n = len(points_mm)
    made = Scan(
        stamp_ns=stamp_ns,
        origin=np.zeros(3),
        points_mm=np.asarray(points_mm, dtype=np.int16),
        pixel_count=np.full(n, 20, dtype=np.uint8),
        height_range_mm=np.zeros(n, dtype=np.uint8),
        p_world_camera=np.array(CAMERA),
        pose_covariance=1e-6 * np.eye(6),
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def ground(height_mm: float = 0.0) -> Array:
    x, y = np.meshgrid(np.arange(505, 1000, 10), np.arange(-295, 300, 10), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_mm)])


class Rig:
    """A mapper, and a body that stands at the origin."""

    def __init__(self) -> None:
        self.mapper = Mapper(PROFILE, Settings(cells=200, publish_every=1))
        self.inbox = Inbox([self.mapper.trigger, *self.mapper.subscribes], self.mapper.stages)
        self.now_ns = 1_000_000_000
        self.stand((0.0, 0.0, 0.1))

    def stand(self, xyz: tuple[float, float, float]) -> None:
        pose = BodyPose(
            self.now_ns, from_xyz_rpy(xyz, np.zeros(3)), np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6))
        )
        self.inbox.receive(topics.BODY_POSE, codec.encode(pose), self.now_ns)

    def map(self, sent: Scan, late_ns: int = 0) -> TerrainMap | None:
        """Return the map after a scan that passed through the codec.

        The scan is stamped now, or `late_ns` earlier.
        """
        self.now_ns += 66_000_000
        frame = codec.encode(replace(sent, stamp_ns=self.now_ns - late_ns))
        made = list(self.mapper.step(codec.decode(frame, Scan)[0], self.inbox))
        return next((m for m in made if isinstance(m, TerrainMap)), None)


GARBAGE = {
    "no pixels behind its points": (scan(ground(), pixel_count=np.zeros(len(ground()), np.uint8)), "counts of at least 1"),
    "a negative variance": (scan(ground(), pose_covariance=-np.eye(6)), "covariance"),
    "a place beyond all maps": (scan(ground(), origin=np.full(3, 1e12)), "1e+12 m away from its camera"),
    "points far from their camera": (scan(ground(), origin=np.array([1e5, 0.0, 0.0])), "1e+05 m away from its camera"),
    "a camera that is elsewhere": (scan(ground(), p_world_camera=np.array([40.0, 0.0, 0.25])), "40 m away from the body"),
    "a camera at the end of the world": (scan(ground(), p_world_camera=np.full(3, codec.MAX_NUMBER)), "away from the body"),
}


@pytest.mark.parametrize("name", GARBAGE)
def test_invalid_scan_is_reported_and_map_stays_unchanged(name: str) -> None:
    rig, (garbage, words) = Rig(), GARBAGE[name]
    before = rig.map(scan(ground()))
    assert before is not None
    for _ in range(5):
        assert rig.map(garbage) is None, "the old map is not taken for a new one"
        assert words in rig.mapper.status()
    after = rig.map(scan(ground()))
    assert after is not None
    np.testing.assert_array_equal(np.isfinite(after.elevation), np.isfinite(before.elevation))
    np.testing.assert_allclose(after.elevation, before.elevation, atol=1e-4)
    assert rig.mapper.status().startswith("mapping")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"covariance": np.full((6, 6), codec.MAX_NUMBER)},
            "a pose's covariance of at most 10000 m^2 and rad^2 expected, found",
        ),
    ],
)
def test_invalid_pose_is_reported_and_map_stays_unchanged(changes: dict[str, Array], words: str) -> None:
    rig = Rig()
    before = rig.map(scan(ground()))
    assert before is not None
    pose = BodyPose(rig.now_ns, np.eye(4), np.eye(4), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))
    bad = replace(pose, **changes)  # type: ignore[arg-type]
    rig.inbox.receive(topics.BODY_POSE, codec.encode(bad), rig.now_ns)
    assert rig.map(scan(ground())) is None
    assert words in rig.mapper.status()
    rig.stand((0.0, 0.0, 0.1))
    after = rig.map(scan(ground()))
    assert after is not None
    np.testing.assert_allclose(after.elevation, before.elevation, atol=1e-4)


def test_refused_scan_does_not_move_map() -> None:
    rig = Rig()
    before = rig.map(scan(ground()))
    away, camera = np.array([30.0, 0.0, 0.0]), np.array(CAMERA)
    rig.stand((30.0, 0.0, 0.1))
    no_pixels = np.zeros(len(ground()), np.uint8)
    assert rig.map(scan(ground(), origin=away, p_world_camera=camera + away, pixel_count=no_pixels)) is None
    rig.stand((0.0, 0.0, 0.1))
    after = rig.map(scan(EMPTY))
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.elevation, before.elevation)


def test_internal_error_is_not_reported_as_invalid_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    def raise_value_error(*_: object) -> None:
        raise ValueError("operands could not be broadcast together")

    rig = Rig()
    monkeypatch.setattr(ElevationGrid, "fuse", raise_value_error)
    with pytest.raises(ValueError, match="broadcast"):
        rig.map(scan(ground()))


def test_empty_scan_changes_nothing() -> None:
    rig = Rig()
    before = rig.map(scan(ground()))
    after = rig.map(scan(EMPTY))
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(after.elevation, before.elevation)
    alone = Rig().map(scan(EMPTY))
    assert alone is not None
    assert np.isnan(alone.elevation).all()
    assert np.isnan(alone.score).all()


def test_stale_scans_after_first_are_not_mapped() -> None:
    rig = Rig()
    assert rig.map(scan(ground())) is not None
    for k in range(1, 16):
        assert rig.map(scan(ground()), late_ns=k * 66_000_000) is None
        assert "not newer" in rig.mapper.status()
    assert rig.map(scan(ground())) is not None


def test_map_is_unchanged_after_scan_gap() -> None:
    rig = Rig()
    before = rig.map(scan(ground()))
    rig.now_ns += 200_000_000
    after = rig.map(scan(ground()))
    assert before is not None
    assert after is not None
    np.testing.assert_allclose(after.elevation, before.elevation, atol=1e-6)


def test_noise_scans_give_no_footholds_and_ground_recovers() -> None:
    rig, rng = Rig(), np.random.default_rng(0)
    points = ground()
    for _ in range(5):
        points[:, 2] = rng.integers(-2000, 2000, len(points))
        map_ = rig.map(scan(points))
        assert map_ is not None
        assert not (map_.score <= 1.0).any()
    for _ in range(40):  # the ground prevails in the end
        map_ = rig.map(scan(ground()))
    assert map_ is not None
    measured = map_.elevation[np.isfinite(map_.elevation)]
    assert np.percentile(np.abs(measured), 95) < 0.02


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(
    st.integers(0, 200),
    st.integers(0, 2**32 - 1),
    st.floats(-codec.MAX_NUMBER, codec.MAX_NUMBER),
    st.floats(-codec.MAX_NUMBER, codec.MAX_NUMBER),
    st.tuples(*[st.floats(-codec.MAX_NUMBER, codec.MAX_NUMBER)] * 3),
)
def test_mapper_recovers_from_any_scan(
    n: int, seed: int, origin: float, variance: float, body: tuple[float, float, float]
) -> None:
    rig, rng = Rig(), np.random.default_rng(seed)
    wild = scan(
        rng.integers(-32768, 32768, (n, 3)),
        pixel_count=rng.integers(0, 256, n).astype(np.uint8),
        height_range_mm=rng.integers(0, 256, n).astype(np.uint8),
        origin=np.array([origin, 0.0, -origin]),
        pose_covariance=variance * np.eye(6),
    )
    rig.map(wild)
    rig.stand(body)
    rig.map(wild)
    rig.map(replace(wild, p_world_camera=np.array(body)))
    rig.stand((0.0, 0.0, 0.1))
    map_ = rig.map(scan(ground()))
    assert map_ is not None
    assert rig.mapper.status().startswith("mapping")
