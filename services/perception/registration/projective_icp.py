"""Projective point-to-plane registration of depth frames with a motion prior.

Masri 2016, section 4.2, aligns scans by points and normals, and uses the expected motion only to start the iteration
(4.2.1). Here the expected motion is a term of the cost. Directions that the scene does not constrain then keep their
expected values. For example, a flat floor does not constrain x, y and yaw.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.services.perception.registration.keyframes import Keyframes, Match
from sextant.services.perception.registration.moving_body import is_one_body, is_within_body
from sextant.services.perception.registration.observability import AXES
from sextant.services.perception.registration.relocalization_map import MapContradiction, RelocalizationMap, surface_points
from sextant.shared.geometry import exp_so3, log_so3, orthonormal
from sextant.shared.robot.camera import DepthSensor, Intrinsics
from sextant.shared.runtime.compiled import compiled

_GATE_NEAR, _GATE_FAR = 0.02, 0.06  # [m] bounds of the largest point-to-plane distance of a match
_SLIP = 0.01  # [m] and [rad] added to the prior's spread for the first expected step
_MAX_ITERATIONS = 10
_MATCHED = 3200  # points of a full image that are matched with one keyframe
_CONVERGED = 1e-4  # [m] and [rad] step that ends the iteration
_INFORMATION_SHARE = 0.1  # matches share calibration and keyframe errors, so ten count as one
_SNR_OPEN, _SNR_KNOWN = 2.0, 5.0  # information over that of plane noise: weight 0 below the first, 1 above the second
_SWEEPS = 12  # maximum sweeps of Jacobi's method; six are enough for a (6, 6) matrix
_USUAL_SHARE = 0.05  # weight of each good frame in the average rmse
_RECENT_SHARE = 0.2  # weight of each good frame in the recent misfit and rmse
# The legs may have slipped if a frame's misfit or rmse exceeds the recent one by these factors, or if registration has moved
# the pose this far from the prior.
_SURPRISING, _FAR_APART, _DRAWN = 1.25, 1.6, 2.0  # times; times; [sigma]
_SPARSE = 0.5  # share of pixels on visible surfaces below which a failure message reports the missing pixels
_TRIES = 3  # alignments from a place found by the search
_FAR_APART_FOUND = 2.0  # times the recent rmse, above which a place found by the search is wrong
_EXPLAINED = 0.85  # ratio of misfits below which another pose fits better
_ALONG_FLOOR = [0, 1, 5]  # x, y and yaw
_SLIPPED = np.array([0.03, 0.03, 0.0, 0.0, 0.0, 0.03])  # [m] and [rad] possible slip of the legs between two frames
_TRUSTING = 2  # iterations after a slip in which distant matches keep full weight
_UNOBSERVED_SHIFT = 0.02  # [m, rad] largest shift by a search along a direction that the frame does not observe
_SAME_AWAY = np.array([0.04, 0.04, 0.04, 0.05, 0.05, 0.05])  # [m] and [rad] within which two searches agree
_REST_SIGMA = 1e-4  # [m] and [rad] sigma of x, y and yaw of a camera at rest
_REST_MOVED = 0.001  # [m] and [rad] along the ground beyond which a pose is not the rest pose
_STARTS_APART_M, _STARTS_APART_RAD = 0.3, 0.25  # [m] [rad] between keyframes that start a search for a lost frame
_OVERLAP_WANTED = 0.6  # overlap below which a frame with a much higher misfit than recent ones is refused
_UNKNOWN_SIGMA = 0.03  # [m] and [rad] along the ground; with a larger prior sigma, nearby start poses are tried
_LOST_SIGMA = 0.03  # [m] and [rad] uncertainty of a place found by the search


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationResult:
    """Pose of one depth frame, its uncertainty, and whether it is valid.

    Covariance and directions refer to the error twist (v, w) in world axes at the camera: (p + v, exp(w) R).
    """

    stamp_ns: int  # [ns] capture time of the frame
    T_world_camera: NDArray[np.float64]  # (4, 4), the prior where ok is False
    covariance: NDArray[np.float64]  # (6, 6) [m, rad], the prior's where ok is False
    overlap: float  # 0..1 share of the frame's points with a matching plane
    rmse: float  # [m] point-to-plane distance of the matches, NaN if there are none
    degenerate: NDArray[np.float64]  # (k, 6) unit twists that only the prior constrains
    ok: bool
    reason: str  # of the failure, empty when ok


@dataclass(frozen=True, slots=True)
class Acceptance:
    """Limits for refusing a pose, searching for a better one and restarting the map."""

    min_measured: float = 0.02  # share of the image's blocks with a depth
    min_overlap: float = 0.3  # share of points with a matching plane
    min_agreement: float = 0.5  # share of points facing a plane that lie on it
    max_rmse: float = 0.010  # [m] point-to-plane, absolute limit
    rmse_factor: float = 3.0  # times the average rmse, plus rmse_margin: relative limit
    rmse_margin: float = 0.001  # [m]
    # Departure from the prior that is allowed in addition to four sigma. A floor constrains height, roll and pitch reliably,
    # and a foot that slips off an edge tilts the robot by several degrees at once. Along the floor, a frame may have been
    # matched with the wrong block.
    jump_distance: float = 0.02  # [m] in x and y
    jump_angle: float = 0.02  # [rad] in yaw
    jump_height: float = 0.05  # [m] in z
    jump_tilt: float = 0.15  # [rad] in roll and pitch
    lever: float = 0.3  # [m] maximum camera height over the ground: a tilt about the feet also moves the camera in x and y
    max_misfit: float = 0.015  # share of points outside the known height range of their cells, above which the pose is in doubt
    doubt: int = 3  # consecutive doubtful or failed frames that start a search around the prior
    search_every: int = 8  # [frames] between searches while the doubt lasts
    patience: int = 60  # consecutive failed frames after which a new map starts at the prior
    rest_step: float = 0.001  # [m] and [rad] change of the prior between two frames, up to which the camera counts as at rest
    body_radius: float = 0.45  # [m] radius of a single body that may move in front of a camera at rest
    # For a camera without legs, which has no odometry. Where its velocity is unknown, poses around the prior are tried. A frame
    # that contradicts the map is refused. A lost frame is searched for around all keyframes.
    legless: bool = False
    max_worsening: float = 2.5  # times the recent misfit, above which a frame with little overlap is refused
    max_contradiction: float = 0.05  # share of points outside the known height range of their cells that refuses a frame


HAND_HELD = Acceptance(doubt=1, search_every=4, patience=300, legless=True, rest_step=0.003)


class Registration:
    """Registration of depth frames against keyframes, which estimates camera poses.

    Keyframes keep the pose at which they were taken, so standing still or returning adds no drift. Their points also form a
    coarse map. A frame that registers well but contradicts this map is in doubt. A frame that fails, or stays in doubt, is
    searched for in the map.
    """

    def __init__(
        self,
        intrinsics: Intrinsics,
        sensor: DepthSensor,
        acceptance: Acceptance | None = None,
        *,
        active_keyframes: int = 4,
        stored_keyframes: int = 32,
        keyframe_distance: float = 0.12,
        keyframe_angle: float = 0.12,
        max_range: float = 2.5,
        blocks_across: int = 160,
    ) -> None:
        """Create a registration for one camera.

        Args:
            intrinsics: Of the camera.
            sensor: Range and noise of the camera.
            acceptance: Limits for accepting a pose.
            active_keyframes: Number of keyframes that a frame is matched with.
            stored_keyframes: Number of keyframes kept.
            keyframe_distance: [m] from the nearest keyframe at which a new one is stored.
            keyframe_angle: [rad] the same for the rotation.
            max_range: [m] depth at which surfaces are cropped (Masri 2016, section 4.2), because a triangulating camera
                distorts distant ones.
            blocks_across: Blocks per image row. 160 are enough for ground; cluttered scenes show their planes to more blocks.
        """
        self._acceptance = acceptance or Acceptance()
        sensor = replace(sensor, max_range=min(sensor.max_range, max_range))
        self._frame = BlockFrame(intrinsics, sensor, blocks_across)
        rows, columns = self._frame.shape
        self._stride = max(1, round(rows * columns / _MATCHED))
        self._keyframes = Keyframes(self._frame, stored_keyframes, active_keyframes, keyframe_distance, keyframe_angle)
        self._relocalization_map = RelocalizationMap(float(sensor.sigma(np.array(1.0), intrinsics.fx)))
        self._usual_rmse = self._acceptance.max_rmse  # [m]
        self._lately = _Fit()
        self._failures = 0  # consecutive
        self._away: NDArray[np.float64] | None = None  # (6,) twist to the pose that the last search found for a doubtful frame
        self._doubtful = 0  # consecutive frames, including failed ones
        self._last: NDArray[np.float64] | None = None  # pose (4, 4) of the last frame
        self._rest: NDArray[np.float64] | None = None  # pose of the camera since it came to rest
        self._believed = 0  # frames for which the doubt is suspended, because the ground changed and not the pose

    @property
    def keyframe_poses(self) -> NDArray[np.float64]:
        """Poses (n, 4, 4) of the current keyframes."""
        return self._keyframes.poses

    def update(
        self,
        depth_raw: NDArray[np.uint16],
        stamp_ns: int,
        T_world_camera_prior: NDArray[np.float64],
        prior_covariance: NDArray[np.float64],
    ) -> RegistrationResult:
        """Register one frame; the first one is placed at its prior.

        Args:
            depth_raw: (h, w) raw depth, 0 = no return.
            stamp_ns: [ns] capture time, copied to the result.
            T_world_camera_prior: (4, 4) expected pose, e.g. the last pose composed with the odometry since.
            prior_covariance: (6, 6) [m, rad] of its error twist, as in `RegistrationResult`. It covers the odometry since the
                last registered frame, or is wide if the velocity is only assumed constant.

        Returns:
            The pose, or the prior and the reason of the failure. The covariance is relative to the recently mapped ground: it
            excludes the drift of the keyframes and the directions in which earlier frames relied on odometry.

        Raises:
            ValueError: A shape or type is wrong, or the covariance is not positive definite.
        """
        information = prior_information(T_world_camera_prior, prior_covariance)
        self._frame.load(depth_raw)
        reason = check_measured_share(self._frame, self._acceptance)
        if reason:
            return self._refuse(stamp_ns, T_world_camera_prior, prior_covariance, None, reason)
        if len(self._keyframes) == 0:
            self._remember(T_world_camera_prior)
            self._last = T_world_camera_prior
            return first_result(stamp_ns, T_world_camera_prior, prior_covariance)

        # 1. Align from the prior. If the fit is poor, try again with a prior that allows slip. If only one body moves in front
        # of a camera at rest, keep the rest pose.
        found, believable = self._align_around(T_world_camera_prior, prior_covariance, information), prior_covariance
        if self._may_have_slipped(found, T_world_camera_prior, prior_covariance):
            wide = _slipping(prior_covariance)
            slipped = self._align(T_world_camera_prior, prior_information(T_world_camera_prior, wide), _TRUSTING)
            fits = slipped.match.misfit < _EXPLAINED * found.match.misfit and not rejection_reason(
                slipped.match, self._acceptance
            )
            if fits and _is_apart(slipped.T, found.T, prior_covariance):
                found, believable = slipped, wide
        held = self._held(found, T_world_camera_prior, prior_covariance)
        if held is not None:
            found, believable = held, prior_covariance
        reason = (
            self._rejection_reason(found.match)
            or self._worsening(found.match)
            or check_jump(found.T, T_world_camera_prior, believable, self._acceptance)
        )
        # 2. Check the pose against the map, and search for a better one while it is in doubt.
        misfit = self._relocalization_map.misfit(self._frame.points, T_world_camera_prior if reason else found.T)
        # A single body that moves in front of a camera at rest is no evidence of camera motion.
        doubted = not self._is_passing_body(misfit) and (bool(reason) or self._is_doubted(misfit))
        self._doubtful = self._doubtful + 1 if doubted else 0
        self._away = self._away if doubted else None
        if self._is_time_to_search():
            T_expected = T_world_camera_prior if reason else found.T
            better = self._search(T_expected)
            confirmed = self._acceptance.legless or (
                isinstance(better, _Aligned) and self._is_confirmed(error_twist(better.T, T_expected))
            )
            if isinstance(better, _Aligned) and not confirmed:  # a passing person is gone at the next search
                reason = reason and f"{reason}; a better pose waits for a second search"
            elif isinstance(better, _Aligned):
                found, reason, doubted, self._doubtful = better, "", False, 0
            elif reason:
                reason = f"{reason}; {better.reason}"
            elif not better.is_elsewhere:
                self._believed = self._acceptance.search_every  # the scene has changed, not the pose
        if not reason and doubted and self._contradicts(misfit):
            reason = f"{misfit.share:.0%} of the image contradicts the map"
        match = found.match
        if reason:
            return self._refuse(stamp_ns, T_world_camera_prior, prior_covariance, match, reason)
        # 3. Good frames with new content extend the map.
        self._failures = 0
        if not doubted:
            self._usual_rmse += _USUAL_SHARE * (match.rmse - self._usual_rmse)
            self._lately = _Fit(_recent(self._lately.misfit, match.misfit), _recent(self._lately.rmse, match.rmse))
            if self._keyframes.is_new_view(found.T, match.overlap):
                self._remember(found.T)
        self._last = found.T
        return RegistrationResult(stamp_ns, found.T, found.covariance, match.overlap, match.rmse, found.degenerate, True, "")

    def _held(self, found: "_Aligned", T_prior: NDArray[np.float64], covariance: NDArray[np.float64]) -> "_Aligned | None":
        """Return the rest pose if only a single body supports the pose found, else None."""
        self._follow_rest(T_prior)
        if self._rest is None or np.abs(error_twist(found.T, self._rest)[_ALONG_FLOOR]).max() <= _REST_MOVED:
            return None
        T = T_prior.copy()
        T[:2, 3] = self._rest[:2, 3]
        resting = covariance.copy()
        resting[_ALONG_FLOOR, :] = resting[:, _ALONG_FLOOR] = 0.0
        resting[_ALONG_FLOOR, _ALONG_FLOOR] = _REST_SIGMA**2
        held = self._align(T, prior_information(T, resting))
        chosen = self._keyframes.select(T_prior)
        gains = self._keyframes.misfits(held.T, chosen) - self._keyframes.misfits(found.T, chosen)
        known = np.isfinite(gains)
        xy = self._frame.points[known] @ held.T[:2, :3].T + held.T[:2, 3]
        if is_one_body(xy, gains[known], self._acceptance.body_radius):
            return replace(held, degenerate=_with_floor_open(found.degenerate))
        self._rest = found.T
        return None

    def _follow_rest(self, T_prior: NDArray[np.float64]) -> None:
        """Track the rest pose of the camera while the prior is at rest.

        With legs, the rest pose follows small motions of the prior.
        """
        step = np.zeros(6) if self._last is None else error_twist(T_prior, self._last)
        if self._last is None or np.abs(step).max() > self._acceptance.rest_step:
            self._rest = None
        elif self._rest is None:
            self._rest = T_prior
        elif not self._acceptance.legless:
            self._rest = apply_twist(self._rest, step)

    def _may_have_slipped(self, found: "_Aligned", T_prior: NDArray[np.float64], covariance: NDArray[np.float64]) -> bool:
        """Return whether the legs may have slipped (poor fit, or far from the prior)."""
        match, lately = found.match, self._lately
        if match.misfit > _SURPRISING * lately.misfit or match.rmse > _FAR_APART * lately.rmse:
            return True
        drawn = np.abs(error_twist(found.T, T_prior)) > _DRAWN * np.sqrt(np.diag(covariance))
        return bool(drawn[_ALONG_FLOOR].any())

    def _rejection_reason(self, match: Match) -> str:
        """Return why a match is rejected, or an empty string.

        The rmse limit follows the average rmse.
        """
        limits = self._acceptance
        usual = limits.rmse_factor * self._usual_rmse + limits.rmse_margin
        reason = rejection_reason(match, replace(limits, max_rmse=min(limits.max_rmse, usual)))
        share = self._frame.usual_share
        return (
            f"{reason}; {1.0 - share:.0%} of the pixels in view have no measurement" if reason and share < _SPARSE else reason
        )

    def _worsening(self, match: Match, overlap: float = _OVERLAP_WANTED) -> str:
        """Return why a frame without legs is rejected for a poor fit, or an empty string.

        It is rejected if its misfit is far above the recent one and its overlap is at most `overlap`.
        """
        limits, lately = self._acceptance, self._lately.misfit
        if not limits.legless or match.overlap > overlap or match.misfit <= limits.max_worsening * lately:
            return ""
        worse = match.misfit / lately
        return f"{match.overlap:.0%} of the frame overlaps known ground and fits {worse:.1f} times worse than recent frames"

    def _is_passing_body(self, misfit: MapContradiction) -> bool:
        """Return whether all contradictions are one body in front of a camera at rest."""
        limits = self._acceptance
        return self._rest is not None and misfit.share > limits.max_misfit and is_within_body(misfit.xy, limits.body_radius)

    def _is_doubted(self, misfit: MapContradiction) -> bool:
        self._believed = max(0, self._believed - 1)
        return self._believed == 0 and misfit.share > self._acceptance.max_misfit

    def _contradicts(self, misfit: MapContradiction) -> bool:
        return self._acceptance.legless and misfit.share > self._acceptance.max_contradiction

    def _is_confirmed(self, away: NDArray[np.float64]) -> bool:
        """Return whether two consecutive searches found the same twist (6,)."""
        before, self._away = self._away, away
        return before is not None and bool((np.abs(away - before) < _SAME_AWAY).all())

    def _is_time_to_search(self) -> bool:
        since = self._doubtful - self._acceptance.doubt
        return since >= 0 and since % self._acceptance.search_every == 0

    def _search(self, T_expected: NDArray[np.float64]) -> "_Aligned | _Nowhere":
        """Search the map for a better pose and register the frame there."""
        found = self._relocalization_map.find(self._frame.points, T_expected)
        if found.T_world_camera is None and self._acceptance.legless:
            found = self._relocalization_map.relocalize(
                self._frame.points, self._keyframes.apart(_STARTS_APART_M, _STARTS_APART_RAD)
            )
        if found.T_world_camera is None:
            return _Nowhere(found.reason, is_elsewhere=False)
        T = found.T_world_camera
        for _ in range(_TRIES):
            better = self._align(T, np.eye(6) / _LOST_SIGMA**2, _TRUSTING)
            T = better.T
            if better.match.rmse <= _FAR_APART_FOUND * self._lately.rmse:
                rejection_reason = (
                    self._rejection_reason(better.match)
                    or self._worsening(better.match, overlap=1.0)
                    or self._unobserved_shift(better, T_expected)
                )
                return _Nowhere(rejection_reason, is_elsewhere=True) if rejection_reason else better
        words = f"surfaces are {1e3 * better.match.rmse:.1f} mm apart at the best-fitting pose"
        return _Nowhere(words, is_elsewhere=True)

    def _unobserved_shift(self, better: "_Aligned", T_expected: NDArray[np.float64]) -> str:
        """Return why a pose found by a search is rejected for a shift that the frame does not observe, or an empty string.

        With legs, their odometry is better evidence in these directions than the search.
        """
        shift = np.abs(better.degenerate @ error_twist(better.T, T_expected))
        if self._acceptance.legless or not (shift > _UNOBSERVED_SHIFT).any():
            return ""
        return "the best-fitting pose is shifted in a direction that the frame does not observe"

    def _remember(self, T: NDArray[np.float64]) -> None:
        """Store the loaded frame as a keyframe and add it to the map."""
        self._keyframes.add(T)
        frame = self._frame
        self._relocalization_map.add(surface_points(frame.inverse_depth, frame.x, frame.y), T)

    def _align_around(
        self, T_prior: NDArray[np.float64], covariance: NDArray[np.float64], information: NDArray[np.float64]
    ) -> "_Aligned":
        """Return the best alignment, with several starts around an uncertain prior."""
        found = self._align(T_prior, information)
        sigma = np.sqrt(np.diag(covariance))
        if not self._acceptance.legless or sigma[_ALONG_FLOOR].max() < _UNKNOWN_SIGMA:
            return found
        for axis in _ALONG_FLOOR:
            for sign in (-1.0, 1.0):
                start = apply_twist(T_prior, sign * sigma[axis] * np.eye(6)[axis])
                other = self._align(T_prior, information, _TRUSTING, start)
                if other.match.misfit < _EXPLAINED * found.match.misfit and other.match.overlap >= found.match.overlap - 0.1:
                    found = other
        return found

    def _align(
        self,
        T_prior: NDArray[np.float64],
        information: NDArray[np.float64],
        trusting: int = 0,
        T_start: NDArray[np.float64] | None = None,
    ) -> "_Aligned":
        """Run Gauss-Newton on matches and prior: (H + P) step = -(g + P error).

        The iteration starts at the prior or at T_start. In the first `trusting` iterations all matches have full weight: for a
        start far from the solution, the few informative points are distant and would be treated as outliers.
        """
        chosen = self._keyframes.select(T_prior)
        T_start = T_prior if T_start is None else T_start
        T: NDArray[np.float64] = T_start
        # The first step may have to cover the prior's uncertainty and a slip.
        step: NDArray[np.floating] = 1.5 * np.sqrt(np.diag(np.linalg.inv(information))) + _SLIP
        for iteration in range(_MAX_ITERATIONS):
            gate = min(max(_GATE_NEAR, 2.0 * float(np.abs(step[:3]).max())), _GATE_FAR)
            match = self._keyframes.match(T, chosen, gate, self._stride, robust=iteration >= trusting)
            if T is T_start or gate == _GATE_NEAR:
                believed, degenerate = constraint_weights(match)
            H, g = believed @ match.H, believed @ match.g
            step = -np.linalg.solve(H + information, g + information @ error_twist(T, T_prior))
            T = apply_twist(T, step)
            if iteration >= trusting and float(np.abs(step).max()) < _CONVERGED:
                break
        covariance = np.linalg.inv(H + information)
        return _Aligned(orthonormal(T), (covariance + covariance.T) / 2.0, degenerate, match)

    def _refuse(
        self,
        stamp_ns: int,
        T_prior: NDArray[np.float64],
        prior_covariance: NDArray[np.float64],
        match: Match | None,
        reason: str,
    ) -> RegistrationResult:
        self._failures += 1
        self._last = T_prior
        if self._failures >= self._acceptance.patience and match is not None:
            # The prior has drifted too far for a search: start a new map there.
            self._keyframes.clear()
            self._relocalization_map.clear()
            # The ground here may be rougher than it has been so far.
            self._usual_rmse, self._lately = self._acceptance.max_rmse, _Fit()
            self._remember(T_prior)
            reason = f"{reason}; {self._failures} frames in a row failed, the map restarts at the prior pose"
            self._failures = 0
        return refused_result(stamp_ns, T_prior, prior_covariance, match, reason)


@dataclass(frozen=True, slots=True, eq=False)
class _Aligned:
    """Pose at which a frame fits the keyframes."""

    T: NDArray[np.float64]  # (4, 4) of the camera
    covariance: NDArray[np.float64]  # (6, 6) [m, rad]
    degenerate: NDArray[np.float64]  # (k, 6) unit twists that only the prior constrains
    match: Match


@dataclass(frozen=True, slots=True)
class _Nowhere:
    """Result of a search that found no pose."""

    reason: str  # of the failure
    is_elsewhere: bool  # True if a better pose than the expected one exists, but the frame does not fit it


@dataclass(frozen=True, slots=True)
class _Fit:
    """Recent quality of fit, infinite before the first frame."""

    misfit: float = math.inf
    rmse: float = math.inf  # [m]


def _recent(mean: float, value: float) -> float:
    """Return the running mean updated with a value."""
    return mean + _RECENT_SHARE * (value - mean) if math.isfinite(mean) else value


def _with_floor_open(degenerate: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the twists (k, 6) that only the prior constrains, plus x, y and yaw."""
    rest = degenerate.copy()
    rest[:, _ALONG_FLOOR] = 0.0
    kept = degenerate[np.linalg.norm(rest, axis=1) > 0.5]
    return np.vstack([np.eye(6)[_ALONG_FLOOR], kept])


def constraint_weights(match: Match) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute how far a match constrains each direction.

    Noisy normals make a flat floor seem to constrain x, y and yaw. N is the information that noise alone would give. The
    generalised eigenvalues of H against N are 1 in directions that hold only noise. The weight of a direction rises from 0
    to 1 between `_SNR_OPEN` and `_SNR_KNOWN`. (After Zhang, Kaess and Singh 2016, On degeneracy of optimization-based state
    estimation problems.)

    Returns:
        The (6, 6) matrix B of the weighted normal equations, B H and B g, and the unit twists (k, 6) of the directions with
        weight 0.
    """
    if not match.N.any():
        return np.zeros((6, 6)), np.eye(6)
    B, directions, unknown = _fade(match.H, match.N)
    return _INFORMATION_SHARE / match.keyframes * B, directions[unknown]


@compiled
def _product(A: NDArray[np.float64], B: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply two small matrices without a library call."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            for k in range(A.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@compiled
def _fade(H: NDArray[np.float64], N: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return B of `constraint_weights` before scaling, six unit twists, and which are unknown.

    N must not be zero.
    """
    scale = 0.0
    for i in range(6):
        scale += N[i, i] / 6.0
    # 1. N = L L^T (Cholesky), and the inverse of L.
    L, inverse_L = np.zeros((6, 6)), np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            rest = N[i, j] + (1e-9 * scale if i == j else 0.0)
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(max(rest, 1e-12 * scale)) if i == j else rest / L[j, j]
    for j in range(6):
        for i in range(j, 6):
            rest = 1.0 if i == j else 0.0
            for k in range(j, i):
                rest -= L[i, k] * inverse_L[k, j]
            inverse_L[i, j] = rest / L[i, i]
    # 2. L^-1 H L^-T = U diag(ratio) U^T by cyclic Jacobi rotations, until the off-diagonal elements vanish.
    A, U = _product(_product(inverse_L, H), inverse_L.T), np.eye(6)
    for _ in range(_SWEEPS):
        aside, whole = 0.0, 0.0
        for i in range(6):
            whole += A[i, i] * A[i, i]
            for j in range(i):
                aside += A[i, j] * A[i, j]
        if aside <= 1e-24 * whole:
            break
        for p in range(5):
            for q in range(p + 1, 6):
                if A[p, q] == 0.0:
                    continue
                theta = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(6):
                    A[k, p], A[k, q] = c * A[k, p] - s * A[k, q], s * A[k, p] + c * A[k, q]
                for k in range(6):
                    A[p, k], A[q, k] = c * A[p, k] - s * A[q, k], s * A[p, k] + c * A[q, k]
                for k in range(6):
                    U[k, p], U[k, q] = c * U[k, p] - s * U[k, q], s * U[k, p] + c * U[k, q]
    # 3. Weight each direction by its ratio.
    share = np.empty(6)
    for k in range(6):
        share[k] = min(max((A[k, k] - _SNR_OPEN) / (_SNR_KNOWN - _SNR_OPEN), 0.0), 1.0)
    B = _product(_product(L, U * share), _product(U.T, inverse_L))
    directions = _product(U.T, inverse_L)
    for k in range(6):
        directions[k] /= np.sqrt(np.sum(directions[k] ** 2))
    return B, directions, share == 0.0


def _is_apart(T: NDArray[np.float64], other: NDArray[np.float64], covariance: NDArray[np.float64]) -> bool:
    """Return whether two poses differ along the floor by more than the prior's sigma.

    A better fit close to the odometry pose shows noise, not a slip.
    """
    return bool((np.abs(error_twist(T, other)) > np.sqrt(np.diag(covariance)))[_ALONG_FLOOR].any())


def _slipping(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a prior that allows for slip of the legs."""
    return covariance + np.diag(_SLIPPED**2)


def apply_twist(T: NDArray[np.float64], twist: NDArray[np.floating]) -> NDArray[np.float64]:
    """Move a pose by an error twist (6,) in world axes at its origin."""
    out = T.copy()
    out[:3, :3] = exp_so3(twist[3:]) @ T[:3, :3]
    out[:3, 3] += twist[:3]
    return out


def error_twist(T: NDArray[np.float64], T_from: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the error twist (6,) for which moved(T_from, twist) is T."""
    return np.concatenate([T[:3, 3] - T_from[:3, 3], log_so3(T[:3, :3] @ T_from[:3, :3].T)])


def prior_information(T: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the information matrix (6, 6) of a prior.

    Raises:
        ValueError: Not a finite (4, 4) pose, or not a positive definite (6, 6) covariance.
    """
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError(f"a finite (4, 4) prior pose expected, found {T.tolist()}")
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError(f"a finite (6, 6) prior covariance expected, found shape {covariance.shape}")
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise ValueError("a positive definite prior covariance expected: give every direction some variance")
    return np.asarray(np.linalg.inv(covariance))


def check_measured_share(frame: BlockFrame, acceptance: Acceptance) -> str:
    """Return why a frame has too few measurements, or an empty string."""
    share = frame.valid / (frame.shape[0] * frame.shape[1])
    if share < acceptance.min_measured:
        return f"only {100 * share:.1f} % of the image is measured, {100 * acceptance.min_measured:.0f} % needed"
    return ""


def rejection_reason(match: Match, acceptance: Acceptance) -> str:
    """Return why a match is rejected, or an empty string."""
    if match.overlap < acceptance.min_overlap:
        return f"{100 * match.overlap:.0f} % of the frame overlaps known ground, {100 * acceptance.min_overlap:.0f} % needed"
    if match.agreement < acceptance.min_agreement:
        return f"only {100 * match.agreement:.0f} % of the overlap agrees with known ground"
    if match.rmse > acceptance.max_rmse:
        return f"surfaces are {1000 * match.rmse:.1f} mm apart, {1000 * acceptance.max_rmse:.1f} mm allowed"
    return ""


def check_jump(
    T: NDArray[np.float64], T_prior: NDArray[np.float64], covariance: NDArray[np.float64], acceptance: Acceptance
) -> str:
    """Return why a pose is implausibly far from its prior, or an empty string."""
    twist = np.abs(error_twist(T, T_prior))
    level, tilt = acceptance.jump_distance, acceptance.jump_tilt
    swept = acceptance.lever * float(min(max(twist[3], twist[4]), tilt))
    margin = np.array([level + swept, level + swept, acceptance.jump_height, tilt, tilt, acceptance.jump_angle])
    allowed = 4.0 * np.sqrt(np.diag(covariance)) + margin
    worst = int(np.argmax(twist / allowed))
    if twist[worst] <= allowed[worst]:
        return ""
    unit, factor = ("m", 1.0) if worst < 3 else ("deg", math.degrees(1.0))
    return (
        f"jump of {factor * twist[worst]:.3f} {unit} in {AXES[worst]} from the expected pose, "
        f"at most {factor * allowed[worst]:.3f} {unit} plausible"
    )


def first_result(stamp_ns: int, T: NDArray[np.float64], covariance: NDArray[np.float64]) -> RegistrationResult:
    """Return the result for the first frame of a map, placed at its prior."""
    return RegistrationResult(stamp_ns, T.copy(), covariance.copy(), 1.0, 0.0, np.eye(6), True, "")


def refused_result(
    stamp_ns: int, T: NDArray[np.float64], covariance: NDArray[np.float64], match: Match | None, reason: str
) -> RegistrationResult:
    """Return the result for a frame that was not registered: its prior and the reason."""
    overlap, rmse = (0.0, math.nan) if match is None else (match.overlap, match.rmse)
    return RegistrationResult(stamp_ns, T.copy(), covariance.copy(), overlap, rmse, np.eye(6), False, reason)
