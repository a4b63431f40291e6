"""Mount of the IMU, from gravity in postures at rest.

A body that stands in one posture feels gravity alone. The legs measure each posture against the floor below the feet. A turned
IMU turns gravity with the body, and a sloping floor does not, so postures with different headings tell the two apart.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.calibration.kinematic_calibration import BodyPoses
from sextant.shared.geometry import Array, exp_so3, skew

_REST_NS = 300_000_000  # [ns] before the last image of a posture, in which the body rests
_MIN_READINGS = 5  # in this time
_STILL_RAD_S = 0.1  # [rad/s] fastest turn of a body at rest; the bias of a gyroscope is smaller
_MIN_POSTURES = 12
_ROUNDS = 10  # of the search; it converges in three
_ASSUMED = np.concatenate([np.full(3, np.radians(20.0)), np.full(2, np.radians(5.0))])  # [rad] one sigma of mount and slope
_SMALLEST_RAD = np.radians(0.05)  # [rad] error of one posture that few residuals cannot deny
_CORRELATION = 1.5  # [1] by which errors are larger than those of independent postures: horns and links are the same in all


@dataclass(frozen=True, slots=True, eq=False)
class ImuTrack:
    """Readings of an IMU over time, in the body frame of the profile."""

    stamp_ns: NDArray[np.int64]  # (n,) rising
    gyro: Array  # (n, 3) [rad/s] {body}
    specific_force: Array  # (n, 3) [m/s^2] {body}


@dataclass(frozen=True, slots=True, eq=False)
class ImuMount:
    """Turn of an IMU against its profile.

    An error of its accelerometer counts as turn: what a robot needs from an IMU is the direction of gravity.
    """

    turn: Array  # (3,) [rad] {body} rotation vector that turns the profile's IMU into the real one
    sigma: Array  # (3,) [rad]
    slope: Array  # (2,) [1] rise of the floor along x and y {floor}


def estimate(track: ImuTrack, poses: BodyPoses) -> ImuMount | None:
    """Return the mount of an IMU, or None if the body rested in too few postures with readings.

    Args:
        track: Readings during the motion.
        poses: Poses of the body by the legs.
    """
    pairs = list(_at_rest(track, poses))
    if len(pairs) < _MIN_POSTURES:
        return None
    R_floor_body, up = (np.array(part) for part in zip(*pairs, strict=True))
    return fit(R_floor_body, up)


def fit(R_floor_body: Array, up: Array) -> ImuMount:
    """Return the mount that explains the measured directions of up (n, 3) {body} in postures (n, 3, 3) by least squares.

    The unknowns are the turn w of the IMU and the slope s of the floor: R exp(w) up = (-s, 1), normalised.
    """
    turn, slope = np.zeros(3), np.zeros(2)
    for _ in range(_ROUNDS):
        seen = up @ exp_so3(turn).T  # (n, 3) {body}
        normal = np.array([*-slope, 1.0])
        errors = (R_floor_body @ seen[..., None])[..., 0] - normal / np.linalg.norm(normal)
        by_turn = -R_floor_body @ skew(seen)
        by_slope = np.tile(np.eye(3)[:, :2], (len(up), 1, 1))
        J = np.concatenate([by_turn, by_slope], axis=2).reshape(-1, 5)
        variance = max(float((errors**2).sum()) / max(2 * len(up) - 5, 1), _SMALLEST_RAD**2)
        information = J.T @ J / variance + np.diag(_ASSUMED**-2.0)
        step = np.linalg.solve(information, -J.T @ errors.ravel() / variance - np.array([*turn, *slope]) / _ASSUMED**2)
        turn, slope = turn + step[:3], slope + step[3:]
    return ImuMount(turn, _CORRELATION * np.sqrt(np.diag(np.linalg.inv(information))[:3]), slope)


def _at_rest(track: ImuTrack, poses: BodyPoses) -> Iterator[tuple[Array, Array]]:
    """Yield attitude (3, 3) {floor} and measured up (3,) {body} of each posture in which the body came to rest."""
    for number in np.unique(poses.posture):
        last = int(np.flatnonzero(poses.posture == number)[-1])
        begin, end = np.searchsorted(track.stamp_ns, [poses.stamp_ns[last] - _REST_NS, poses.stamp_ns[last]])
        if end - begin >= _MIN_READINGS and np.linalg.norm(track.gyro[begin:end], axis=1).max() < _STILL_RAD_S:
            force = track.specific_force[begin:end].mean(axis=0)
            yield poses.T_floor_body[last, :3, :3], force / np.linalg.norm(force)
