"""Interface of a registration, which replaces perception's estimate of the camera pose."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sextant.shared.geometry import Array, is_rigid, orthonormal

_ROUNDING = 1e-3  # [1] largest error of a rotation matrix, which is then made orthonormal


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A depth frame and the pose that leg odometry expects for it.

    Attributes:
        stamp_ns: [ns] capture time.
        depth: (height, width) [m] along the optical axis, 0 where there is no measurement.
        T_world_camera: (4, 4) expected pose; x right, y down, z forward.
        covariance: (6, 6) [m, rad] of its error twist (v, w) in world axes at the camera.
    """

    stamp_ns: int
    depth: NDArray[np.float32]
    T_world_camera: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose of a frame.

    Attributes:
        T_world_camera: (4, 4) pose; x right, y down, z forward.
        covariance: (6, 6) [m, rad] of its error twist (v, w) in world axes at the camera.
        overlap: [1] share of the frame that matches earlier frames.
    """

    T_world_camera: Array
    covariance: Array
    overlap: float = 1.0


@dataclass(frozen=True, slots=True)
class NoPose:
    """Reason why a frame has no pose; the robot then walks by leg odometry for a short time."""

    reason: str


class Registration(Protocol):
    """A registration; the class is called with the robot's profile, whose `camera` has intrinsics and range."""

    def register(self, frame: Frame, /) -> Pose | NoPose:
        """Return the pose of the frame. {world} is where the expected pose of the first frame places it.

        It is called for each registered frame, some fifteen times a second, and should take less than 30 ms.
        """
        ...


def checked_pose(pose: object) -> Pose | NoPose:
    """Return the pose of a registration.

    Raises:
        TypeError: It is no pose.
        ValueError: A number is not finite or impossible.
    """
    if isinstance(pose, NoPose):
        if not pose.reason:
            raise ValueError("a NoPose with a reason expected, found none")
        return pose
    if not isinstance(pose, Pose):
        raise TypeError(f"a Pose or a NoPose expected, found {type(pose).__name__}")
    T, covariance = np.array(pose.T_world_camera, dtype=np.float64), np.array(pose.covariance, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError(f"T_world_camera of finite numbers (4, 4) expected, found {T.shape}: {T.tolist()}")
    if not is_rigid(T, _ROUNDING):
        raise ValueError(f"a rigid transform as T_world_camera expected, found {T.tolist()}")
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError(f"a covariance of finite numbers (6, 6) expected, found {covariance.shape}")
    covariance = (covariance + covariance.T) / 2.0
    least = float(np.linalg.eigvalsh(covariance)[0])
    if least < 0:
        raise ValueError(f"a covariance without negative eigenvalues expected, found {least:.3g}")
    if not 0.0 <= pose.overlap <= 1.0:
        raise ValueError(f"an overlap from 0 to 1 expected, found {pose.overlap}")
    return Pose(orthonormal(T), covariance, float(pose.overlap))
