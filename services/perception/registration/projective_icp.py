"""Projective point-to-plane registration of depth frames with a motion prior.

Masri 2016, section 4.2, aligns scans by points and normals, and uses the expected motion only to start the iteration
(4.2.1). Here the expected motion is a term of the cost. Directions that the scene does not constrain then keep their
expected values. For example, a flat floor does not constrain x, y and yaw.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sextant.services.perception.registration.acceptance import (
    Acceptance,
    check_jump,
    check_measured_share,
    rejection_reason,
)
from sextant.services.perception.registration.alignment import TRUSTING, Aligned, Aligner, prior_information
from sextant.services.perception.registration.block_frame import BlockFrame
from sextant.services.perception.registration.error_twist import ALONG_FLOOR, error_twist
from sextant.services.perception.registration.fit_history import FitHistory
from sextant.services.perception.registration.keyframes import Keyframes
from sextant.services.perception.registration.moving_body import is_one_body, is_within_body
from sextant.services.perception.registration.params import AlignmentParams, KeyframeParams, TextureParams
from sextant.services.perception.registration.pose_doubt import PoseDoubt
from sextant.services.perception.registration.projective_matching import Match
from sextant.services.perception.registration.registration_result import RegistrationResult, first_result, refused_result
from sextant.services.perception.registration.relocalization_map import MapContradiction, RelocalizationMap, surface_points
from sextant.services.perception.registration.rest_pose import RestPose
from sextant.services.perception.registration.texture_constraint import TextureConstraint
from sextant.shared.robot.camera import DepthSensor, Intrinsics

# The legs may have slipped if registration has moved the pose this far from the prior.
_DRAWN = 2.0  # [sigma]
_SLIPPED = np.array([0.03, 0.03, 0.0, 0.0, 0.0, 0.03])  # [m] and [rad] possible slip of the legs between two frames
_MAX_ALIGNMENTS = 3  # alignments from a place found by the search
_UNOBSERVED_SHIFT = 0.02  # [m, rad] largest shift by a search or a slip along a direction that no frame observes
_STARTS_APART_M, _STARTS_APART_RAD = 0.3, 0.25  # [m] [rad] between keyframes that start a search for a lost frame
_LOST_SIGMA = 0.03  # [m] and [rad] uncertainty of a place found by the search
_NO_DIRECTIONS: NDArray[np.float64] = np.zeros((0, 6))


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
        alignment: AlignmentParams | None = None,
        keyframes: KeyframeParams | None = None,
        texture: TextureParams | None = None,
        max_range: float = 2.5,
        blocks_across: int = 160,
    ) -> None:
        """Create a registration for one camera.

        Args:
            intrinsics: Of the camera.
            sensor: Range and noise of the camera.
            acceptance: Limits for accepting a pose.
            alignment: Parameters of the alignment.
            keyframes: Parameters of the keyframes.
            texture: Parameters of texture, or None for a camera without grey images.
            max_range: [m] depth at which surfaces are cropped (Masri 2016, section 4.2), because a triangulating camera
                distorts distant ones.
            blocks_across: Blocks per image row. 160 are enough for ground; cluttered scenes show their planes to more blocks.
        """
        self._acceptance = acceptance or Acceptance()
        sensor = replace(sensor, max_range=min(sensor.max_range, max_range))
        self._frame = BlockFrame(intrinsics, sensor, blocks_across)
        rows, columns = self._frame.shape
        kept, self._alignment = keyframes or KeyframeParams(), alignment or AlignmentParams()
        self._keyframes = Keyframes(self._frame, kept.stored, kept.active, kept.distance, kept.angle)
        self._aligner = Aligner(self._keyframes, rows * columns, self._alignment)
        self._texture: TextureConstraint | None = None
        if texture is not None and texture.use and not self._acceptance.legless:
            self._texture = TextureConstraint(intrinsics.gray, self._frame, self._keyframes, kept.stored, texture)
        self._relocalization_map = RelocalizationMap(float(sensor.sigma(np.array(1.0), intrinsics.fx)))
        limits = self._acceptance
        self._fit = FitHistory(limits)
        self._doubt = PoseDoubt(limits.doubt, limits.search_every)
        self._rest = RestPose(limits.rest_step, follows_prior=not limits.legless)
        self._failures = 0  # consecutive
        self._unobserved = _NO_DIRECTIONS  # (k, 6) degenerate twists of the last frame without doubt

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
        gray: NDArray[np.uint8] | None = None,
    ) -> RegistrationResult:
        """Register one frame; the first one is placed at its prior.

        Args:
            depth_raw: (h, w) raw depth, 0 = no return.
            stamp_ns: [ns] capture time, copied to the result.
            T_world_camera_prior: (4, 4) expected pose, e.g. the last pose composed with the odometry since.
            prior_covariance: (6, 6) [m, rad] of its error twist, as in `RegistrationResult`. It covers the odometry since the
                last registered frame, or is wide if the velocity is only assumed constant.
            gray: Grey image of the same instant, of the size of `Intrinsics.gray`; its texture is used.

        Returns:
            The pose, or the prior and the reason of the failure. The covariance is relative to the recently mapped ground: it
            excludes the drift of the keyframes and the directions in which earlier frames relied on odometry.

        Raises:
            ValueError: A shape or type is wrong, or the covariance is not positive definite.
        """
        information = prior_information(T_world_camera_prior, prior_covariance)
        self._frame.load(depth_raw)
        if self._texture is not None:
            self._texture.begin_frame(gray, T_world_camera_prior)
        reason = check_measured_share(self._frame, self._acceptance)
        if reason:
            return self._refuse(stamp_ns, T_world_camera_prior, prior_covariance, None, reason)
        if len(self._keyframes) == 0:
            self._remember(T_world_camera_prior)
            self._end_frame(T_world_camera_prior)
            return first_result(stamp_ns, T_world_camera_prior, prior_covariance)
        found, believable = self._align(T_world_camera_prior, prior_covariance, information)
        reason = (
            self._rejection_reason(found.match)
            or self._fit.worsening(found.match)
            or check_jump(found.T, T_world_camera_prior, believable, self._acceptance)
        )
        checked = self._check_against_map(found, reason, T_world_camera_prior)
        found, match = checked.found, checked.found.match
        if checked.reason:
            return self._refuse(stamp_ns, T_world_camera_prior, prior_covariance, match, checked.reason)
        self._failures = 0
        if not checked.doubted:  # good frames with new content extend the map
            self._fit.add(match)
            self._unobserved = found.shapeless
            if self._keyframes.is_new_view(found.T, match.overlap):
                self._remember(found.T)
        self._end_frame(found.T)
        return RegistrationResult(stamp_ns, found.T, found.covariance, match.overlap, match.rmse, found.degenerate, True, "")

    def _align(
        self, T_prior: NDArray[np.float64], covariance: NDArray[np.float64], information: NDArray[np.float64]
    ) -> tuple[Aligned, NDArray[np.float64]]:
        """Align the frame from the prior; return the pose and the covariance (6, 6) within which it is believable.

        If the fit is poor, try again with a prior that allows slip, except in directions that the ground did not show in the
        last frame without doubt: what shows them now is a person. If only one body moves in front of a camera at rest, keep
        the rest pose.
        """
        if self._acceptance.legless:
            found = self._aligner.align_around(T_prior, covariance, information)
        elif self._texture is None or self._rest.pose is not None:
            found = self._aligner.align(T_prior, information)
        else:
            found = self._texture.align(self._aligner, T_prior, information)
        believable = covariance
        if self._may_have_slipped(found, T_prior, covariance):
            wide = covariance + np.diag(_SLIPPED**2)
            slipped = self._aligner.align(T_prior, prior_information(T_prior, wide), TRUSTING)
            fits = slipped.match.misfit < self._alignment.explained * found.match.misfit
            fits = fits and not rejection_reason(slipped.match, self._acceptance)
            if (
                fits
                and _is_apart(slipped.T, found.T, covariance)
                and not self._is_unobserved(self._unobserved, slipped.T, T_prior)
            ):
                found, believable = slipped, wide
        held = self._held(found, T_prior, covariance)
        return (found, believable) if held is None else (held, covariance)

    def _check_against_map(self, found: Aligned, reason: str, T_prior: NDArray[np.float64]) -> "_Checked":
        """Check a pose against the map, and search for a better one while it is in doubt.

        Args:
            found: The aligned frame.
            reason: Why it is refused, or an empty string.
            T_prior: (4, 4) expected pose.
        """
        T_expected = T_prior if reason else found.T
        contradiction = self._relocalization_map.contradiction(self._frame.points, T_expected)
        # A single body that moves in front of a camera at rest is no evidence of camera motion.
        doubted = not self._is_passing_body(contradiction) and (bool(reason) or self._is_doubted(contradiction))
        self._doubt.update(doubted)
        if self._doubt.is_search_due():
            better = self._search(T_expected)
            if isinstance(better, _Nowhere):
                if reason:
                    reason = f"{reason}; {better.reason}"
                elif not better.is_elsewhere:
                    self._doubt.suspend()
            elif self._acceptance.legless or self._doubt.is_confirmed(better.T, T_expected):
                self._doubt.clear()
                return _Checked(better, "", doubted=False)
            elif reason:  # a passing person is gone at the next search
                reason = f"{reason}; a better pose waits for a second search"
        if not reason and doubted and self._contradicts(contradiction):
            reason = f"{contradiction.share:.0%} of the image contradicts the map"
        return _Checked(found, reason, doubted)

    def _held(self, found: Aligned, T_prior: NDArray[np.float64], covariance: NDArray[np.float64]) -> Aligned | None:
        """Return the rest pose if only a single body supports the pose found, else None."""
        self._rest.update(T_prior)
        if not self._rest.is_left(found.T):
            return None
        T, resting = self._rest.as_prior(T_prior, covariance)
        held = self._aligner.align(T, prior_information(T, resting))
        chosen = self._keyframes.select(T_prior)
        gains = self._keyframes.misfits(held.T, chosen) - self._keyframes.misfits(found.T, chosen)
        known = np.isfinite(gains)
        xy = self._frame.points[known] @ held.T[:2, :3].T + held.T[:2, 3]
        if is_one_body(xy, gains[known], self._acceptance.body_radius):
            return replace(held, degenerate=_with_floor_open(found.degenerate))
        self._rest.pose = found.T
        return None

    def _may_have_slipped(self, found: Aligned, T_prior: NDArray[np.float64], covariance: NDArray[np.float64]) -> bool:
        """Return whether the legs may have slipped (poor fit, or far from the prior).

        While several frames have contradicted the map, a person in view explains a poor fit. A slip is then left to the
        search, which needs a second one to confirm it.
        """
        if not self._acceptance.legless and self._doubt.lasts:
            return False
        if self._fit.is_poor(found.match):
            return True
        drawn = np.abs(error_twist(found.T, T_prior)) > _DRAWN * np.sqrt(np.diag(covariance))
        return bool(drawn[ALONG_FLOOR].any())

    def _rejection_reason(self, match: Match) -> str:
        """Return why a match is rejected, or an empty string."""
        return self._fit.rejection_reason(match, self._frame.usual_share)

    def _is_passing_body(self, contradiction: MapContradiction) -> bool:
        """Return whether all contradictions are one body in front of a camera at rest."""
        limits = self._acceptance
        at_rest = self._rest.pose is not None
        return at_rest and contradiction.share > limits.max_misfit and is_within_body(contradiction.xy, limits.body_radius)

    def _is_doubted(self, contradiction: MapContradiction) -> bool:
        return not self._doubt.is_suspended() and contradiction.share > self._acceptance.max_misfit

    def _contradicts(self, contradiction: MapContradiction) -> bool:
        return self._acceptance.legless and contradiction.share > self._acceptance.max_contradiction

    def _search(self, T_expected: NDArray[np.float64]) -> "Aligned | _Nowhere":
        """Search the map for a better pose and register the frame there."""
        found = self._relocalization_map.find(self._frame.points, T_expected)
        if found.T_world_camera is None and self._acceptance.legless:
            found = self._relocalization_map.relocalize(
                self._frame.points, self._keyframes.apart(_STARTS_APART_M, _STARTS_APART_RAD)
            )
        if found.T_world_camera is None:
            return _Nowhere(found.reason, is_elsewhere=False)
        T = found.T_world_camera
        for _ in range(_MAX_ALIGNMENTS):
            better = self._aligner.align(T, np.eye(6) / _LOST_SIGMA**2, TRUSTING)
            T = better.T
            if self._fit.is_plausible(better.match):
                reason = (
                    self._rejection_reason(better.match)
                    or self._fit.worsening(better.match, overlap=1.0)
                    or self._unobserved_shift(better, T_expected)
                )
                return _Nowhere(reason, is_elsewhere=True) if reason else better
        words = f"surfaces are {1e3 * better.match.rmse:.1f} mm apart at the best-fitting pose"
        return _Nowhere(words, is_elsewhere=True)

    def _unobserved_shift(self, better: Aligned, T_expected: NDArray[np.float64]) -> str:
        """Return why a pose found by a search is rejected for a shift that the frame does not observe, or an empty string."""
        if not self._is_unobserved(better.degenerate, better.T, T_expected):
            return ""
        return "the best-fitting pose is shifted in a direction that the frame does not observe"

    def _is_unobserved(self, directions: NDArray[np.float64], T: NDArray[np.float64], T_expected: NDArray[np.float64]) -> bool:
        """Return whether a pose is far from the expected one along unobserved directions (k, 6).

        With legs, their odometry is better evidence in these directions than registration.
        """
        shift = np.abs(directions @ error_twist(T, T_expected))
        return not self._acceptance.legless and bool((shift > _UNOBSERVED_SHIFT).any())

    def _end_frame(self, T: NDArray[np.float64]) -> None:
        """Set the pose (4, 4) of the frame."""
        self._rest.end_frame(T)
        if self._texture is not None:
            self._texture.end_frame(T)

    def _remember(self, T: NDArray[np.float64]) -> None:
        """Store the loaded frame as a keyframe and add it to the map."""
        slot = self._keyframes.add(T)
        if self._texture is not None:
            self._texture.store(slot)
        frame = self._frame
        self._relocalization_map.add(surface_points(frame.inverse_depth, frame.x, frame.y), T)

    def _forget_map(self) -> None:
        """Forget the map, and everything that is known relative to it."""
        self._keyframes.clear()
        if self._texture is not None:
            self._texture.clear()
        self._relocalization_map.clear()
        self._fit.reset()
        self._doubt.reset()
        self._unobserved = _NO_DIRECTIONS

    def _refuse(
        self,
        stamp_ns: int,
        T_prior: NDArray[np.float64],
        prior_covariance: NDArray[np.float64],
        match: Match | None,
        reason: str,
    ) -> RegistrationResult:
        self._failures += 1
        self._end_frame(T_prior)
        if self._failures >= self._acceptance.patience and match is not None:
            # The prior has drifted too far for a search: start a new map there.
            self._forget_map()
            self._remember(T_prior)
            reason = f"{reason}; {self._failures} frames in a row failed, the map restarts at the prior pose"
            self._failures = 0
        return refused_result(stamp_ns, T_prior, prior_covariance, match, reason)


@dataclass(frozen=True, slots=True, eq=False)
class _Checked:
    """A frame after the check against the map."""

    found: Aligned
    reason: str  # why the frame is refused, or an empty string
    doubted: bool


@dataclass(frozen=True, slots=True)
class _Nowhere:
    """Result of a search that found no pose."""

    reason: str  # of the failure
    is_elsewhere: bool  # True if a better pose than the expected one exists, but the frame does not fit it


def _with_floor_open(degenerate: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the twists (k, 6) that only the prior constrains, plus x, y and yaw."""
    rest = degenerate.copy()
    rest[:, ALONG_FLOOR] = 0.0
    kept = degenerate[np.linalg.norm(rest, axis=1) > 0.5]
    return np.vstack([np.eye(6)[ALONG_FLOOR], kept])


def _is_apart(T: NDArray[np.float64], other: NDArray[np.float64], covariance: NDArray[np.float64]) -> bool:
    """Return whether two poses differ along the floor by more than the prior's sigma.

    A better fit close to the odometry pose shows noise, not a slip.
    """
    return bool((np.abs(error_twist(T, other)) > np.sqrt(np.diag(covariance)))[ALONG_FLOOR].any())
