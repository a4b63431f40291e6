"""Batch calibration of the camera and the legs of a robot that moves its body over standing feet on a flat floor.

All numbers of the robot and the body pose at each image are estimated together, with maximum likelihood, as in Bloesch et al.,
ICRA 2013 ("Kinematic batch calibration for legged robots"). The joint angles of the standing legs and the inverse depth of the
floor measure these poses; an IMU is not needed. The frame of the batch, {floor}, has its x-y plane on the floor below the feet.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.calibration.floor_view import block_centres
from sextant.shared.geometry import Array, align_rigid, exp_so3
from sextant.shared.robot.kinematics import feet_and_shanks
from sextant.shared.robot.profile import Camera, RobotProfile
from sextant.shared.wire.messages import FloorView

# The numbers of a robot and what is assumed about them before the measurement: one standard deviation.
_BLOCKS: tuple[tuple[str, int, float | tuple[float, ...]], ...] = (
    ("rotation", 3, np.radians(4.0)),  # [rad] of the camera, as a rotation vector in its optical frame
    ("place", 3, 0.02),  # [m] {body} of the camera
    ("scale", 1, 0.03),  # [1] relative error of the depth
    ("bias", 1, 0.01),  # [1/m] error of the inverse depth
    ("focal", 1, 0.02),  # [1] relative error of the focal lengths
    ("centre", 2, 3.0),  # [px] error of the principal point
    ("distortion", 1, 0.02),  # [1] k1
    ("slope", 2, np.radians(0.15)),  # [1] of the floor in view against the floor below the feet, along x and y
    ("delay", 1, 0.05),  # [s] from the exposure of an image to its stamp, beyond the profile's
    ("trims", 18, np.radians(4.0)),  # [rad] errors of the horns
    ("links", 18, 0.003),  # [m] errors of the links
    ("feet", 18, (0.05, 0.05, 0.001)),  # [m] {floor} foot centres in the first image, against those of the profile
)
_SLICES: dict[str, slice] = {}
for _name, _size, _ in _BLOCKS:
    _begin = max((part.stop for part in _SLICES.values()), default=0)
    _SLICES[_name] = slice(_begin, _begin + _size)
SIZE = _SLICES["feet"].stop
_OF_IMAGES = np.arange(_SLICES["rotation"].start, _SLICES["slope"].stop)  # numbers that the images depend on
_OF_FEET = np.arange(_SLICES["delay"].start, SIZE)  # numbers that the feet depend on
_ROUNDS, _DAMPINGS = 30, 8  # of the search; of one round
_CONVERGED = 1e-3  # [1] improvement of the squared error that ends the search
_STEP = 1e-6  # of the numerical derivatives
_SIGMA_FEET = (0.003, 0.003, 0.0005)  # [m] first guess of the errors of the feet: slip, resolution and backlash
_SIGMA_W = 0.004  # [1/m] first guess of the errors of a block's mean inverse depth
_REWEIGHTINGS = 5
# [1] by which errors are larger than those of independent measurements: slip and backlash are correlated between postures
_CORRELATION = 1.5
# [1] by which errors of the feet across the floor are larger than their deviation: a foot that slips stays where it is
_SLIP = 3.0
MIN_LEGS = 4  # that stand in a view
_UNKNOWN = 20.0  # [1] freedom of the feet's errors along one axis that trims, links and places of the feet take
_DELAY_STEP_S = 0.005  # [s] of the numerical derivative by the delay: joint angles are interpolated
_OUTLIER = 4.0  # [sigma] beyond which a block of pixels is not floor


@dataclass(frozen=True, slots=True, eq=False)
class JointTrack:
    """Measured joint angles over time."""

    stamp_ns: NDArray[np.int64]  # (n,) rising
    q: Array  # (n, 6, 3) [rad]
    contact: NDArray[np.bool_]  # (n, 6) legs that carry load

    def at(self, stamp_ns: Array) -> Array:
        """Return the joint angles (k, 18) [rad] at times (k,) [ns]."""
        flat = self.q.reshape(len(self.q), 18)
        return np.stack([np.interp(stamp_ns, self.stamp_ns, flat[:, joint]) for joint in range(18)], axis=1)

    def stands(self, stamp_ns: Array) -> NDArray[np.bool_]:
        """Return which legs (k, 6) carry load around times (k,) [ns]."""
        after = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self.stamp_ns) - 1)
        return np.asarray(self.contact[after - 1] & self.contact[after])


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Measurements of a robot that moves its body."""

    views: Sequence[FloorView]
    posture: NDArray[np.int64]  # (views,) number of the posture that the robot had or moved to
    joints: JointTrack


@dataclass(frozen=True, slots=True, eq=False)
class BodyPoses:
    """Poses of the body in the images."""

    stamp_ns: Array  # (n,) rising
    posture: NDArray[np.int64]  # (n,) number of the posture that the robot had or moved to
    T_floor_body: Array  # (n, 4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Numbers of a robot with their covariance, and the poses of its body."""

    values: Array  # (SIZE,)
    covariance: Array  # (SIZE, SIZE) for independent errors
    sigma_feet: Array  # (3,) [m] {floor} standard deviation of the feet: they slip, and joints have backlash
    sigma_w: float  # [1/m] standard deviation of the inverse depth of a block
    poses: BodyPoses

    def of(self, name: str) -> Array:
        """Return the numbers of one kind, see `_BLOCKS`."""
        return self.values[_SLICES[name]]

    def sigma(self, name: str) -> Array:
        """Return their standard deviations."""
        return np.asarray(_CORRELATION * np.sqrt(np.diag(self.covariance)[_SLICES[name]]))

    def with_exact_links(self) -> "Estimate":
        """Return the estimate under the condition that all links have the lengths of the profile."""
        C, links = self.covariance, _SLICES["links"]
        gain = np.linalg.solve(C[links, links], C[links]).T
        values, covariance = self.values - gain @ self.of("links"), C - gain @ C[links]
        return replace(self, values=values, covariance=covariance)

    def surprise(self, name: str) -> Array:
        """Return by how many standard deviations the numbers contradict what was assumed about them."""
        assumed = _prior()[_SLICES[name]] ** 2
        learned = assumed - np.diag(self.covariance)[_SLICES[name]]
        return np.asarray(np.abs(self.of(name)) / np.sqrt(np.maximum(learned, 1e-6 * assumed)))


def estimate(profile: RobotProfile, recording: Recording) -> Estimate:
    """Estimate the numbers of a robot from a recording.

    Errors of the feet and of the images are estimated, too. The images of one posture count as one, because slip, backlash and
    the errors of the depth hardly change between them.
    """
    problem = _Problem(profile, recording)
    x, poses = np.zeros(SIZE), problem.first_poses()
    sigma = np.array(_SIGMA_FEET), _SIGMA_W
    for _ in range(_REWEIGHTINGS):
        x, poses, information = _solve(problem, x, poses, sigma)
        sigma = problem.errors(x, poses)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    stamps = problem.stamps - 1e9 * x[_SLICES["delay"]]
    return Estimate(x, covariance, *sigma, BodyPoses(stamps, problem.posture, poses))


def standing_share(recording: Recording) -> float:
    """Return the share of the images in which enough legs stand."""
    stamps = np.array([view.stamp_ns for view in recording.views], dtype=np.float64)
    return float((recording.joints.stands(stamps).sum(axis=1) >= MIN_LEGS).mean())


class _Problem:
    """Residuals of a recording: of the feet against the floor, and of the floor in the images."""

    def __init__(self, profile: RobotProfile, recording: Recording):
        self._camera: Camera = profile.camera
        self._radius = profile.foot.radius
        self._T_body_coxa = profile.T_body_coxa
        self._links = np.array([profile.links.coxa, profile.links.femur, profile.links.tibia])
        self._joints = recording.joints
        stamps = np.array([view.stamp_ns for view in recording.views]) - 1e9 * self._camera.time_offset_s
        stands = self._joints.stands(stamps)
        used = stands.sum(axis=1) >= MIN_LEGS
        self.stamps, self._stands = stamps[used], stands[used]
        self._seen = np.array([view.inverse_depth for view in recording.views])[used]
        self.posture = recording.posture[used]
        self.weights = 1.0 / np.bincount(self.posture)[self.posture]  # (views,)
        q = self._joints.at(self.stamps).reshape(-1, 6, 3)
        legs = [feet_and_shanks(profile, angles) for angles in q]
        self._feet_body = np.array([feet for feet, _ in legs])  # (views, 6, 3)
        self._shanks = np.array([shanks for _, shanks in legs])
        rest = profile.rest_feet()
        T_floor_body = align_rigid(self._feet_body[0], rest + np.array([0.0, 0.0, self._radius - rest[0, 2]]))
        feet = self._feet_body[0] @ T_floor_body[:3, :3].T + T_floor_body[:3, 3]
        self._feet = np.column_stack([feet[:, :2], np.full(6, self._radius)])
        self._first_shanks = self._shanks[0] @ T_floor_body[:3, :3].T

    def first_poses(self) -> Array:
        """Return body poses (views, 4, 4) {floor} by the legs of the profile."""
        return np.array([align_rigid(feet, self._feet) for feet in self._feet_body])

    def of_feet(self, x: Array, poses: Array) -> Array:
        """Return the errors (views, 18) [m] {floor} of the feet by the joint angles; 0 for feet in the air."""
        R, p = poses[:, :3, :3], poses[:, :3, 3]
        q = self._joints.at(self.stamps - 1e9 * x[_SLICES["delay"]]).reshape(-1, 6, 3) - x[_SLICES["trims"]].reshape(6, 3)
        coxa, femur, tibia = (self._links + x[_SLICES["links"]].reshape(6, 3)).T
        along, up = q[..., 1] + q[..., 2], femur * np.sin(q[..., 1])
        reach = coxa + femur * np.cos(q[..., 1]) + tibia * np.cos(along)
        foot = np.stack([reach * np.cos(q[..., 0]), reach * np.sin(q[..., 0]), up + tibia * np.sin(along)], axis=-1)
        T = self._T_body_coxa
        feet_body = (T[:, :3, :3] @ foot[..., None])[..., 0] + T[:, :3, 3]
        errors = feet_body @ R.mT + p[:, None] - self._feet - x[_SLICES["feet"]].reshape(6, 3)
        shanks, first = self._shanks @ R.mT, self._first_shanks
        # A foot is a sphere that rolls, see `LegOdometry`.
        errors[..., :2] -= self._radius * (first[:, 2:] * shanks[..., :2] - first[:, :2] * shanks[..., 2:])
        return np.where(self._stands[..., None], errors, 0.0).reshape(-1, 18)

    def of_images(self, x: Array, poses: Array) -> Array:
        """Return the errors (views, blocks) [1/m] of the predicted inverse depths of the floor; NaN where it is unseen."""
        camera, lens = self._camera, self._camera.intrinsics
        u, v = block_centres(lens)
        scale, bias, focal, k1 = (float(x[_SLICES[name]][0]) for name in ("scale", "bias", "focal", "distortion"))
        k1 += camera.distortion
        du, dv = x[_SLICES["centre"]]
        seen = np.stack([(u - lens.cx - du) / lens.fx, (v - lens.cy - dv) / lens.fy]) / (1.0 + focal)
        ray = seen
        for _ in range(3):
            ray = seen / (1.0 + k1 * (ray**2).sum(axis=0))
        T = camera.T_body_camera
        R = poses[:, :3, :3] @ T[:3, :3] @ exp_so3(x[_SLICES["rotation"]])
        p = poses[:, :3, :3] @ (T[:3, 3] + x[_SLICES["place"]]) + poses[:, :3, 3]
        normal = np.array([*-x[_SLICES["slope"]], 1.0])
        true = -(normal @ R @ np.stack([*ray, np.ones(len(u))])) / (p @ normal)[:, None]
        return np.asarray(true / ((1.0 + scale) * (1.0 + camera.depth_error)) - bias - self._seen)

    def errors(self, x: Array, poses: Array) -> tuple[Array, float]:
        """Return the standard deviations of feet (3,) [m] and inverse depths [1/m].

        Blocks that do not show the floor, and feet that do not stand on it, are forgotten.
        """
        feet, depths = self.of_feet(x, poses).reshape(-1, 6, 3), self.of_images(x, poses)
        self._seen[np.abs(depths) > _OUTLIER * 1.4826 * np.nanmedian(np.abs(depths))] = np.nan
        height = np.abs(feet[..., 2])
        self._stands &= height < _OUTLIER * 1.4826 * np.median(height[self._stands])
        postures = float(self.weights.sum())
        freedom = np.maximum(np.array([4.5, 4.5, 6.0]) * postures * self._stands.mean() - _UNKNOWN, 1.0)
        sigma = np.sqrt((self.weights[:, None, None] * feet**2).sum(axis=(0, 1)) / freedom)
        across = np.full(2, _SLIP * np.sqrt((sigma[:2] ** 2).mean()))
        return np.array([*across, sigma[2]]), float(np.sqrt(np.nanmean(np.where(np.isfinite(self._seen), depths, np.nan) ** 2)))

    def feet_by_numbers(self, x: Array, poses: Array) -> Array:
        """Return the derivatives (views, 18, k) of `of_feet` by the numbers that the feet depend on."""
        now = self.of_feet(x, poses)
        derivatives = np.zeros((*now.shape, len(_OF_FEET)))
        derivatives[..., 0] = (self.of_feet(_stepped(x, _SLICES["delay"].start, _DELAY_STEP_S), poses) - now) / _DELAY_STEP_S
        for name in ("trims", "links", "feet"):  # legs are independent of each other: step all at once
            for k in range(3):
                numbers = np.arange(_SLICES[name].start + k, _SLICES[name].stop, 3)
                change = (self.of_feet(_stepped(x, numbers, _STEP), poses) - now) / _STEP
                for leg, number in enumerate(numbers - _OF_FEET[0]):
                    derivatives[:, 3 * leg : 3 * leg + 3, number] = change[:, 3 * leg : 3 * leg + 3]
        return derivatives

    def images_by_numbers(self, x: Array, poses: Array) -> Array:
        """Return the derivatives (views, blocks, k) of `of_images` by the numbers that the images depend on."""
        now = self.of_images(x, poses)
        return np.stack([(self.of_images(_stepped(x, number, _STEP), poses) - now) / _STEP for number in _OF_IMAGES], axis=-1)


_Sigma = tuple[Array, float]  # standard deviations of feet (3,) [m] and inverse depths [1/m]


def _solve(problem: _Problem, x: Array, poses: Array, sigma: _Sigma) -> tuple[Array, Array, Array]:
    """Return the numbers, the poses and the information about the numbers at the smallest squared error (Marquardt 1963)."""
    prior = 1.0 / _prior()

    def cost(x: Array, poses: Array) -> float:
        feet = problem.of_feet(x, poses) / np.tile(sigma[0], 6)
        images = np.nan_to_num(problem.of_images(x, poses)) / sigma[1]
        return float(problem.weights @ ((feet**2).sum(axis=1) + (images**2).sum(axis=1)) + ((prior * x) ** 2).sum())

    damping, now = 1e-4, cost(x, poses)
    for _ in range(_ROUNDS):
        normal = _normal_equations(problem, x, poses, sigma)
        before = now
        for _ in range(_DAMPINGS):
            step, turns = normal.step(damping)
            tried, moved = x + step, _moved(poses, turns)
            value = cost(tried, moved)
            if value < now:
                x, poses, now, damping = tried, moved, value, damping * 0.1
                break
            damping *= 10.0
        if before - now < _CONVERGED:
            break
    return x, poses, _normal_equations(problem, x, poses, sigma).information


@dataclass(frozen=True, slots=True, eq=False)
class _NormalEquations:
    """Normal equations, with the poses eliminated by their Schur complement."""

    pose_blocks: Array  # (views, 6, 6)
    mixed: Array  # (views, 6, SIZE)
    numbers: Array  # (SIZE, SIZE)
    pose_gradient: Array  # (views, 6)
    gradient: Array  # (SIZE,)

    @property
    def information(self) -> Array:
        """Return the information (SIZE, SIZE) about the numbers, with unknown poses."""
        eliminated = np.linalg.solve(self.pose_blocks, self.mixed)
        return np.asarray(self.numbers - self.mixed.reshape(-1, SIZE).T @ eliminated.reshape(-1, SIZE))

    def step(self, damping: float) -> tuple[Array, Array]:
        """Return the changes (SIZE,) of the numbers and (views, 6) of the poses."""
        blocks = self.pose_blocks * (1.0 + damping * np.eye(6))
        eliminated = np.linalg.solve(blocks, self.mixed)
        gone = np.linalg.solve(blocks, self.pose_gradient[..., None])[..., 0]
        mixed = self.mixed.reshape(-1, SIZE).T
        A = self.numbers * (1.0 + damping * np.eye(SIZE)) - mixed @ eliminated.reshape(-1, SIZE)
        step = np.asarray(np.linalg.solve(A, self.gradient - mixed @ gone.ravel()), dtype=np.float64)
        return step, np.asarray(gone - eliminated @ step)


def _normal_equations(problem: _Problem, x: Array, poses: Array, sigma: _Sigma) -> _NormalEquations:
    views = len(poses)
    prior = 1.0 / _prior() ** 2
    # Each pose is known within 1 m and 1 rad: nothing else may measure it once its feet turn out to be in the air.
    known = np.tile(np.eye(6), (views, 1, 1))
    equations = _NormalEquations(known, np.zeros((views, 6, SIZE)), np.diag(prior), np.zeros((views, 6)), -prior * x)
    images = problem.of_images(x, poses)
    seen = np.isfinite(images)
    for errors, by_pose, by_numbers, numbers, precision in (
        (
            problem.of_feet(x, poses),
            _by_poses(lambda T: problem.of_feet(x, T), poses),
            problem.feet_by_numbers(x, poses),
            _OF_FEET,
            np.tile(1.0 / sigma[0], 6),
        ),
        (
            np.where(seen, images, 0.0),
            _by_poses(lambda T: problem.of_images(x, T), poses),
            problem.images_by_numbers(x, poses),
            _OF_IMAGES,
            seen / sigma[1],
        ),
    ):
        precision = np.sqrt(problem.weights)[:, None] * precision
        r, local, shared = -precision * errors, precision[..., None] * by_pose, precision[..., None] * by_numbers
        local, shared = np.nan_to_num(local), np.nan_to_num(shared)
        flat = shared.reshape(-1, len(numbers))
        equations.pose_blocks[:] += local.mT @ local
        equations.mixed[..., numbers] += local.mT @ shared
        equations.numbers[np.ix_(numbers, numbers)] += flat.T @ flat
        equations.pose_gradient[:] += (local.mT @ r[..., None])[..., 0]
        equations.gradient[numbers] += flat.T @ r.ravel()
    return equations


def _by_poses(errors: Callable[[Array], Array], poses: Array) -> Array:
    """Return the derivatives (views, n, 6) of errors (views, n) by a displacement and a turn of each pose."""
    now = errors(poses)
    return np.stack([(errors(_moved(poses, step)) - now) / _STEP for step in _STEP * np.eye(6)], axis=-1)


def _prior() -> Array:
    """Return the standard deviations (SIZE,) that are assumed before the measurement."""
    return np.concatenate([np.tile(sigma, size // np.size(sigma)) for _, size, sigma in _BLOCKS])


def _stepped(x: Array, numbers: int | NDArray[np.int64], step: float) -> Array:
    stepped = x.copy()
    stepped[numbers] += step
    return stepped


def _moved(poses: Array, change: Array) -> Array:
    """Return poses (views, 4, 4) after a displacement and a turn {floor}, (6,) or (views, 6)."""
    moved = poses.copy()
    moved[:, :3, 3] += change[..., :3]
    moved[:, :3, :3] = exp_so3(change[..., 3:]) @ poses[:, :3, :3]
    return moved
