"""Pose errors like recorded ones: their statistics and their effects.

The statistics are derived again from the recordings.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sextant.deploy.launch import process_table
from sextant.evaluation.lockstep.noisy_perception import Settings, make
from sextant.evaluation.lockstep.pose_error import (
    MODELS,
    Correlation,
    NoisyPerception,
    PoseError,
    PoseErrorModel,
    autocorrelation,
    fitted,
    moved_by,
)
from sextant.shared.geometry import apply, exp_so3, from_xyz_rpy, inverse, log_so3
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic, Inbox, Stages
from sextant.shared.scenario.scenario import Goal, Scenario
from sextant.shared.scenario.terrain import Plane
from sextant.shared.wire import topics
from sextant.shared.wire.messages import BodyPose, Message, Scan
from sextant.shared.wire.transport import Endpoints
from tests.support.recordings import recording

MODEL = PoseErrorModel((0.01, 0.02, 0.005), (0.004, 0.006, 0.008), Correlation(0.7, 2.0, 0.1), Correlation(0.4, 1.0, 0.05))
T = from_xyz_rpy((0.7, -0.2, 0.1), (0.02, 0.01, 0.5))
POSE = BodyPose(0, T, from_xyz_rpy((0.1, 0, 0), (0, 0, 0.1)), np.eye(6) * 1e-6, 1.0, True, "", np.zeros((0, 6)))


def error_series(model: PoseErrorModel, seconds: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(0.0, seconds, 1 / 15)
    error = PoseError(model, np.random.default_rng(seed))
    return t, np.array([error.at(round(s * 1e9)) for s in t])


def test_pose_error_sigma_and_autocorrelation_match_model() -> None:
    t, x = error_series(MODEL, 3000.0)
    np.testing.assert_allclose(x.std(axis=0), MODEL.sigma, rtol=0.12)
    assert np.all(np.abs(x.mean(axis=0)) < 0.15 * MODEL.sigma)
    for columns, correlation in ((slice(0, 3), MODEL.position), (slice(3, 6), MODEL.rotation)):
        lags, found = autocorrelation(t, x[:, columns] / MODEL.sigma[columns])
        np.testing.assert_allclose(found, correlation.at(lags), atol=0.1)


def test_fit_recovers_model() -> None:
    t, x = error_series(MODEL, 3000.0, seed=3)
    found = fitted(t, x[:, :3], x[:, 3:])
    lags = np.linspace(1 / 15, 2.0, 30)
    np.testing.assert_allclose(found.sigma, MODEL.sigma, rtol=0.12)
    np.testing.assert_allclose(found.position.at(lags), MODEL.position.at(lags), atol=0.12)
    np.testing.assert_allclose(found.rotation.at(lags), MODEL.rotation.at(lags), atol=0.12)


def test_pose_error_is_deterministic_for_time_and_seed() -> None:
    error = PoseError(MODEL, np.random.default_rng(1))
    first = error.at(0)
    np.testing.assert_array_equal(error.at(0), first)
    later = error.at(10**9)
    assert (later != first).all()
    np.testing.assert_array_equal(error.at(10**9), later)
    np.testing.assert_array_equal(error_series(MODEL, 2.0, seed=4)[1], error_series(MODEL, 2.0, seed=4)[1])


@pytest.mark.data
@pytest.mark.parametrize(("name", "series"), [("rgbdslam", "rgbdslam_fr1_xyz"), ("orb_slam", "orb_rgbd_fr2_desk")])
def test_models_match_recorded_pose_errors(name: str, series: str) -> None:
    file = "slam_pose_errors.npz"
    path = recording("pose_errors", holds=file) / file
    with np.load(path, allow_pickle=False) as data:
        found = fitted(*(data[f"{series}_{part}"] for part in ("t", "dpos_m", "drot_rad")))
    model = MODELS[name]
    np.testing.assert_allclose(model.sigma, found.sigma, rtol=0.02)
    for ours, theirs in ((model.position, found.position), (model.rotation, found.rotation)):
        np.testing.assert_allclose(
            [ours.share, ours.slow_s, ours.fast_s], [theirs.share, theirs.slow_s, theirs.fast_s], rtol=0.1
        )


class StaticPerception:
    """A perception that sends the same pose and scan repeatedly."""

    name = "perception"
    trigger = topics.DEPTH
    subscribes: tuple[AnyTopic, ...] = (topics.ODOMETRY,)
    publishes: tuple[AnyTopic, ...] = (topics.BODY_POSE, topics.SCAN)

    def __init__(self, scan: Scan) -> None:
        self.stages, self._scan = Stages(), scan

    def status(self) -> str:
        return "resting"

    def step(self, stamp_ns: int, _: Any) -> Iterator[Message]:
        yield replace(POSE, stamp_ns=stamp_ns)
        yield replace(self._scan, stamp_ns=stamp_ns)


def scan(n: int = 50, color: bool = True) -> Scan:
    rng = np.random.default_rng(0)
    return Scan(
        stamp_ns=0,
        origin=np.array([0.8, -0.1, 0.25]),
        points_mm=rng.integers(-900, 900, (n, 3)).astype(np.int16),
        pixel_count=np.arange(n, dtype=np.uint8),
        height_range_mm=np.zeros(n, dtype=np.uint8),
        p_world_camera=np.array([0.8, -0.1, 0.25]),
        pose_covariance=np.eye(6) * 1e-6,
        color=rng.integers(0, 63, (n if color else 0, 3)).astype(np.uint8),
        free_rays_mm=rng.integers(-900, 900, (7, 3)).astype(np.int16),
    )


def test_pose_and_scan_move_together() -> None:
    """Move the scan with the pose: points keep their place relative to the body."""
    before = scan()
    erring = NoisyPerception(StaticPerception(before), MODEL, seed=2)  # type: ignore[arg-type]
    for stamp_ns in (0, 10**9, 3 * 10**9):
        pose, moved = erring.step(stamp_ns, Inbox((), Stages()))  # type: ignore[arg-type]
        assert isinstance(pose, BodyPose)
        assert isinstance(moved, Scan)
        assert np.abs(pose.T_world_body - T).max() > 1e-4
        points, shifted = (s.origin + np.vstack([s.points_mm, s.free_rays_mm]) * 1e-3 for s in (before, moved))
        np.testing.assert_allclose(apply(inverse(pose.T_world_body), shifted), apply(inverse(T), points), atol=1.2e-3)
        camera = apply(inverse(pose.T_world_body), moved.p_world_camera)
        np.testing.assert_allclose(camera, apply(inverse(T), before.p_world_camera), atol=1e-12)
        # Odometry is unchanged: T_world_odom has the same error.
        np.testing.assert_allclose(inverse(pose.T_world_odom) @ pose.T_world_body, inverse(POSE.T_world_odom) @ T, atol=1e-12)
        np.testing.assert_array_equal(moved.color, before.color)
        assert (np.diag(pose.covariance) > MODEL.sigma**2).all()
        assert (np.diag(moved.pose_covariance) > MODEL.sigma**2).all()


def test_rotation_error_is_about_body_origin() -> None:
    error = np.array([0.01, -0.02, 0.03, 0.1, 0.2, -0.3])
    moved = moved_by(error, T) @ T
    np.testing.assert_allclose(moved[:3, 3] - T[:3, 3], error[:3], atol=1e-12)
    np.testing.assert_allclose(log_so3(moved[:3, :3] @ T[:3, :3].T), error[3:], atol=1e-9)
    np.testing.assert_allclose(exp_so3(error[3:]) @ T[:3, :3], moved[:3, :3])


def test_points_beyond_int16_range_are_dropped() -> None:
    far = replace(scan(2), points_mm=np.array([[32760, 0, 0], [0, 0, 0]], dtype=np.int16))
    shift = replace(MODEL, position_m=(1e-9, 1e-9, 1e-9), rotation_rad=(1e-9, 1e-9, 0.5))
    for seed in range(6):
        _, moved = NoisyPerception(StaticPerception(far), shift, seed).step(0, Inbox((), Stages()))  # type: ignore[arg-type]
        assert isinstance(moved, Scan)
        assert len(moved.points_mm) == len(moved.pixel_count) == len(moved.color) in (1, 2)


def test_live_run_starts_noisy_perception_process() -> None:
    plain = Scenario("plain", (Plane(),), Goal(1.0))
    erring = replace(plain, pose_error="orb_slam")
    for scenario, module in ((plain, "sextant.services.perception"), (erring, "sextant.evaluation.lockstep.noisy_perception")):
        chosen = process_table.choices(scenario, "plain", 7)
        row = [p for p in process_table.TABLE if p.name == "perception"]
        (command,) = process_table.commands(row, chosen, Endpoints(("tcp/127.0.0.1:1",), False, "x"))
        assert command.arguments[1] == module
        assert ("pose_error=orb_slam" in command.arguments) == ("seed=7" in command.arguments) == (scenario is erring)


def test_noisy_perception_keeps_perception_settings() -> None:
    made = make(load_profile("phantomx_mk2"), Settings(settle_s=0.1, pose_error="rgbdslam"))
    assert made.name == "perception"
    assert made.trigger is topics.DEPTH
    assert "waiting" in made.status()


def test_invalid_correlation_is_refused() -> None:
    with pytest.raises(ValueError, match="share"):
        Correlation(1.5, 1.0, 0.1)
    with pytest.raises(ValueError, match="share"):
        Correlation(0.5, 0.1, 1.0)
