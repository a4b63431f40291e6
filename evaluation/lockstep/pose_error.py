"""Simulated localisation errors with the statistics of recorded SLAM systems.

Lotriet 2024, section 3.4, tested his walks by adding estimation noise to the pose. Here the noise is added to the poses and
scans that perception publishes. Perception is unchanged, and no subscriber can tell the difference.

An error has six axes: position and rotation vector, {world}. Each axis is the sum of a slow and a fast Ornstein-Uhlenbeck
process, with autocorrelation  share * exp(-t / slow) + (1 - share) * exp(-t / fast).
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sextant.shared.geometry import Array, apply, exp_so3, transform
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Service
from sextant.shared.wire.messages import BodyPose, Message, Scan

_LONGEST_LAG_S = 2.0  # [s] longest lag at which autocorrelations are compared
_AXES = 6


@dataclass(frozen=True, slots=True)
class Correlation:
    """Correlation of an error over time."""

    share: float  # [1] share of the variance that changes slowly
    slow_s: float  # [s]
    fast_s: float  # [s]

    def __post_init__(self) -> None:
        if not (0.0 <= self.share <= 1.0 and 0.0 < self.fast_s <= self.slow_s):
            raise ValueError(f"a share of 0 to 1 and 0 < fast_s <= slow_s expected, found {self}")

    def at(self, t: Array) -> Array:
        """Return the autocorrelation [1] at lags t [s]."""
        return np.asarray(self.share * np.exp(-t / self.slow_s) + (1.0 - self.share) * np.exp(-t / self.fast_s))


@dataclass(frozen=True, slots=True)
class PoseErrorModel:
    """Statistics of a localisation error."""

    position_m: tuple[float, float, float]  # [m] standard deviations {world}
    rotation_rad: tuple[float, float, float]  # [rad]
    position: Correlation
    rotation: Correlation

    @property
    def sigma(self) -> Array:
        """Standard deviations (6,) [m, rad]."""
        return np.array([*self.position_m, *self.rotation_rad])


# `fitted` to error series of two visual SLAM systems against motion capture (TUM RGB-D benchmark): RGB-D SLAM on fr1/xyz, 786
# poses in 27 s, and ORB-SLAM on fr2/desk, 2225 poses in 99 s; tests/unit/evaluation/lockstep/test_pose_error.py derives them
# again. The model follows the autocorrelation of the second within 0.03. That of the first oscillates with the camera's
# motion, and is negative after 1 s.
MODELS: Mapping[str, PoseErrorModel] = {
    "rgbdslam": PoseErrorModel(
        (0.0100, 0.0076, 0.0048), (0.0088, 0.0064, 0.0039), Correlation(0.15, 0.40, 0.355), Correlation(0.03, 0.40, 0.355)
    ),
    "orb_slam": PoseErrorModel(
        (0.0044, 0.0058, 0.0037), (0.0047, 0.0033, 0.0035), Correlation(0.75, 4.5, 0.063), Correlation(0.55, 1.8, 0.050)
    ),
}


class PoseError:
    """One realisation of an error over time."""

    def __init__(self, model: PoseErrorModel, rng: np.random.Generator):
        """Draw the first error from the stationary distribution."""
        self._sigma = model.sigma
        both = (model.position, model.rotation)
        self._share = np.repeat([[c.share, 1.0 - c.share] for c in both], 3, axis=0).T  # (2, 6) slow, fast
        self._time_s = np.repeat([[c.slow_s, c.fast_s] for c in both], 3, axis=0).T
        self._rng = rng
        self._state = rng.standard_normal((2, _AXES))
        self._stamp_ns: int | None = None

    def at(self, stamp_ns: int) -> Array:
        """Return the error (6,) [m, rad] at a time [ns]; the same for the same time.

        Times must not decrease.
        """
        if self._stamp_ns is None:
            self._stamp_ns = stamp_ns
        passed_s = (stamp_ns - self._stamp_ns) * 1e-9
        if passed_s > 0.0:
            kept = np.exp(-passed_s / self._time_s)
            self._state = kept * self._state + np.sqrt(1.0 - kept**2) * self._rng.standard_normal((2, _AXES))
            self._stamp_ns = stamp_ns
        return np.asarray(self._sigma * (np.sqrt(self._share) * self._state).sum(axis=0))


class NoisyPerception:
    """A perception service with errors in its poses and everything placed by them."""

    def __init__(self, perception: Service, model: PoseErrorModel, seed: int):
        """Wrap a perception; the error's generator is `default_rng([seed, 6])`."""
        self.name, self.stages = perception.name, perception.stages
        self._inner = perception
        self._error = PoseError(model, np.random.default_rng([seed, 6]))
        self._covariance = np.diag(model.sigma**2)
        self._T: Array = np.eye(4)  # transform of the last pose, {world}

    @property
    def trigger(self) -> AnyTopic | Every:
        """Trigger of the wrapped service."""
        return self._inner.trigger

    @property
    def subscribes(self) -> tuple[AnyTopic, ...]:
        """Topics that the wrapped service subscribes to."""
        return self._inner.subscribes

    @property
    def publishes(self) -> tuple[AnyTopic, ...]:
        """Topics that the wrapped service publishes."""
        return self._inner.publishes

    def status(self) -> str:
        """Return the status of the wrapped service."""
        return self._inner.status()

    def step(self, message: Any, inbox: Inbox) -> Iterable[Message]:
        """Yield perception's messages, moved by the current error."""
        return self._moved(self._inner.step(message, inbox))

    def _moved(self, messages: Iterable[Message]) -> Iterator[Message]:
        for made in messages:
            if isinstance(made, BodyPose):
                self._T = moved_by(self._error.at(made.stamp_ns), made.T_world_body)
                yield replace(
                    made,
                    T_world_body=self._T @ made.T_world_body,
                    T_world_odom=self._T @ made.T_world_odom,
                    covariance=made.covariance + self._covariance,
                )
            elif isinstance(made, Scan):
                yield moved_scan(made, self._T, self._covariance)  # moved with the pose by which it was placed
            else:
                yield made


def moved_by(error: Array, T_world_body: Array) -> Array:
    """Return the transform (4, 4) that moves a body pose by an error (6,), {world}.

    The error is a position [m] and a rotation about the body's own position [rad].
    """
    R, p = exp_so3(error[3:]), T_world_body[:3, 3]
    return transform(R, p + error[:3] - R @ p)


def moved_scan(scan: Scan, T: Array, covariance: Array) -> Scan:
    """Move a scan by T (4, 4), as if its pose had an error.

    Points outside the range of 16-bit millimetres are dropped.
    """
    points, sights = (np.rint((apply(T, points) - scan.origin) * 1e3) for points in (scan.points, scan.free_ray_ends))
    kept, kept_sights = ((np.abs(mm) < 32767).all(axis=1) for mm in (points, sights))
    return replace(
        scan,
        points_mm=points[kept].astype(np.int16),
        pixel_count=scan.pixel_count[kept],
        height_range_mm=scan.height_range_mm[kept],
        p_world_camera=apply(T, scan.p_world_camera),
        pose_covariance=scan.pose_covariance + covariance,
        color=scan.color[kept] if len(scan.color) else scan.color,
        free_rays_mm=sights[kept_sights].astype(np.int16),
    )


def fitted(t: Array, position: Array, rotation: Array) -> PoseErrorModel:
    """Fit a model to a recorded error series.

    It has the series' standard deviations and the least-squares fit of its autocorrelation.

    Args:
        t: (n,) [s] rising.
        position: (n, 3) [m].
        rotation: (n, 3) [rad].
    """
    sigmas = [tuple(float(s) for s in np.std(x, axis=0)) for x in (position, rotation)]
    both = [_fitted_correlation(t, x / np.std(x, axis=0)) for x in (position - position.mean(0), rotation - rotation.mean(0))]
    return PoseErrorModel(sigmas[0], sigmas[1], both[0], both[1])  # type: ignore[arg-type]


def autocorrelation(t: Array, x: Array) -> tuple[Array, Array]:
    """Return lags [s] up to 2 s and the autocorrelation at them.

    The series (n, k) has unit variance; the result is the mean over its columns.
    """
    step = float(np.median(np.diff(t)))
    lags, values = [], []
    for lag in range(1, int(_LONGEST_LAG_S / step)):
        apart = t[lag:] - t[:-lag]
        usual = float(np.median(apart))
        regular = np.abs(apart - usual) < 0.5 * step  # not across a gap
        lags.append(usual)
        values.append(float((x[:-lag] * x[lag:])[regular].mean()))
    return np.array(lags), np.array(values)


def _fitted_correlation(t: Array, x: Array) -> Correlation:
    lags, found = autocorrelation(t, x)
    best, least = Correlation(1.0, 1.0, 1.0), np.inf
    for slow in np.geomspace(0.1, 10.0, 41):
        for fast in np.geomspace(0.01, 1.0, 41):
            if fast > slow:
                continue
            a, b = np.exp(-lags / slow), np.exp(-lags / fast)
            share = float(np.clip(np.dot(a - b, found - b) / max(float(np.dot(a - b, a - b)), 1e-12), 0.0, 1.0))
            misfit = float(np.sum((share * a + (1.0 - share) * b - found) ** 2))
            if misfit < least - 1e-12:
                best, least = Correlation(share, float(slow), float(fast)), misfit
    return best
