"""Evidence for a replayed depth sequence, and advice where it is insufficient.

A picture supports the trajectory if it registers and constrains every direction of motion. Elsewhere the trajectory is the
expected motion, which is a guess.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation.metrics.stage_times import rounded
from sextant.services.perception.registration.observability import AXES, unobservable_directions
from sextant.shared.geometry import Array, inverse, log_so3
from sextant.shared.robot.camera import DepthSensor
from sextant.shared.wire.messages import BodyPose

USUAL_SCALES = (1000.0, 5000.0, 10_000.0, 100.0)  # raw units per metre: mm, as in the TUM RGB-D benchmark, 0.1 mm, cm
_SAMPLED = 4  # step of the sampled rows and columns of a picture
_PERCENTILES = (5, 50, 95)


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits from which a trajectory counts as supported."""

    min_share: float = 0.9  # [1] share of the pictures after the first that support it
    max_gap_s: float = 0.5  # [s] between two supporting pictures, if others lie between them
    min_in_range: float = 0.5  # [1] share of depths in range, below which range or scale may be wrong
    max_size_error: float = 0.1  # [1] relative error of the trajectory's size
    max_error_share: float = 0.1  # [1] allowed rms error, as a share of the true trajectory's extent
    max_error_m: float = 0.05  # [m] allowed rms error at least
    max_speed_m_s: float = 3.0  # [m/s] of a camera in a hand
    max_turn_rad_s: float = 10.0  # [rad/s] of a camera in a hand


@dataclass(frozen=True, slots=True)
class DepthRange:
    """The depths of one picture against the range of a sensor."""

    measured: float  # [1] share of the picture's pixels with a return
    in_range: float  # [1] share of those within the range, which registration uses
    depths: tuple[float, float, float]  # [m] 5th, 50th and 95th percentile of the returns, NaN without one
    at_scale: tuple[float, ...]  # [1] share in range at each of the usual scales


@dataclass(frozen=True, slots=True)
class PictureEvidence:
    """Contribution of one picture to the trajectory."""

    stamp_s: float  # [s] since the first picture
    registered: bool
    reason: str  # why it did not register
    overlap: float  # [1] share of its points that matched a plane
    unobservable: tuple[str, ...]  # directions that only the expected motion determines
    depth: DepthRange

    @property
    def supports(self) -> bool:
        """Whether it registered and constrains every direction."""
        return self.registered and not self.unobservable

    def as_table(self) -> dict[str, Any]:
        """Return a plain table for JSON."""
        return {
            "stamp_s": rounded(self.stamp_s),
            "registered": self.registered,
            "reason": self.reason,
            "overlap": rounded(self.overlap),
            "unobservable": list(self.unobservable),
            "depth_measured": rounded(self.depth.measured),
            "depth_used": rounded(self.depth.in_range),
            "depth_m": _percentiles(self.depth.depths),
        }


@dataclass(frozen=True, slots=True)
class TrueComparison:
    """The estimated trajectory against the true one."""

    rms_m: float  # [m] error after rigid alignment
    extent_m: float  # [m] largest distance of the true one from its beginning
    size: float | None  # [1] estimated over true size; None if their shapes differ


@dataclass(frozen=True, slots=True)
class CameraMotion:
    """Motion of the estimated camera between two registered pictures."""

    stamps_s: tuple[float, float]  # [s] of the two pictures, since the first of the sequence
    moved_m: float  # [m]
    turned_rad: float  # [rad]

    @property
    def speed_m_s(self) -> float:
        """Mean speed [m/s]."""
        return self.moved_m / (self.stamps_s[1] - self.stamps_s[0])

    @property
    def turn_rad_s(self) -> float:
        """Mean rate of turn [rad/s]."""
        return self.turned_rad / (self.stamps_s[1] - self.stamps_s[0])


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of all pictures of a sequence together."""

    pictures: tuple[PictureEvidence, ...]
    sensor: DepthSensor  # with the range that registration uses
    truth: TrueComparison | None = None
    motions: tuple[CameraMotion, ...] = ()  # between each two successive registered pictures
    limits: Limits = Limits()

    @property
    def supporting(self) -> int:
        """Number of supporting pictures after the first, which only begins the map."""
        return sum(p.supports for p in self.pictures[1:])

    @property
    def longest_gap_s(self) -> float:
        """Longest time [s] without support, over pictures that give none.

        It counts from a supporting picture, or the first, to the next one or the end.
        """
        longest, since_s, broken = 0.0, 0.0, False
        for n, picture in enumerate(self.pictures):
            last = n == len(self.pictures) - 1
            broken = broken or (n > 0 and not picture.supports)
            if broken and (picture.supports or last):
                longest = max(longest, picture.stamp_s - since_s)
            if picture.supports:
                since_s, broken = picture.stamp_s, False
        return longest

    @property
    def unobservable(self) -> dict[str, int]:
        """Direction -> registered pictures that do not constrain it, most frequent first.

        The first picture does not count.
        """
        counts: dict[str, int] = {}
        for picture in self.pictures[1:]:
            for name in picture.unobservable if picture.registered else ():
                counts[name] = counts.get(name, 0) + 1
        return dict(sorted(counts.items(), key=lambda item: -item[1]))

    @property
    def depths(self) -> tuple[float, float, float]:
        """Median over the pictures of their 5th, 50th and 95th percentile [m].

        NaN without a return.
        """
        found = np.array([p.depth.depths for p in self.pictures if p.depth.measured > 0]).reshape(-1, 3)
        if not len(found):
            return (float("nan"),) * 3
        low, median, high = np.median(found, axis=0)
        return float(low), float(median), float(high)

    @property
    def measured(self) -> float:
        """Mean share [1] of the pixels with a return."""
        return float(np.mean([p.depth.measured for p in self.pictures])) if self.pictures else 0.0

    @property
    def used(self) -> float:
        """Share [1] of the returns that are in range, over all pictures."""
        return self._in_range([p.depth.in_range for p in self.pictures])

    @property
    def fitting_scale(self) -> float | None:
        """The usual depth scale with the most depths in range.

        None unless few depths are in range at the given scale and many at this one.
        """
        if not self.pictures or self.used >= self.limits.min_in_range:
            return None
        shares = [self._in_range([p.depth.at_scale[k] for p in self.pictures]) for k in range(len(USUAL_SCALES))]
        best = int(np.argmax(shares))
        return USUAL_SCALES[best] if shares[best] >= max(self.limits.min_in_range, 2.0 * self.used) else None

    @property
    def problem(self) -> str:
        """Why the trajectory is not supported, and what to do; empty if it is."""
        after, limits = self.pictures[1:], self.limits
        if not after:
            return f"a trajectory needs at least 2 pictures, found {len(self.pictures)}; record a longer sequence"
        if not any(p.depth.measured > 0 for p in self.pictures):
            return "all depths of all pictures are 0; check that the images are 16-bit depth images"
        out_of_range = self.used < limits.min_in_range
        if out_of_range and self.depths[1] < self.sensor.min_range:
            return self._out_of_range()  # nearer than the camera measures, so what registers is not depth
        if self.supporting < limits.min_share * len(after) or self.longest_gap_s > limits.max_gap_s:
            lost = [p for p in after if not p.registered]
            if 2 * len(lost) < len(after) - self.supporting:
                return self._not_observed()
            return self._out_of_range() if out_of_range else self._lost(lost)
        return self._against_truth() if self.truth is not None else self._too_fast()

    def as_table(self) -> dict[str, Any]:
        """Return a plain table for JSON; the pictures are in `PictureEvidence.as_table`."""
        return {
            "supported": not self.problem,
            "problem": self.problem,
            "pictures_supporting": self.supporting,
            "pictures_registered": sum(p.registered for p in self.pictures[1:]),
            "pictures_after_first": len(self.pictures[1:]),
            "longest_gap_s": rounded(self.longest_gap_s),
            "unobservable": self.unobservable,
            "depth_measured": rounded(self.measured),
            "depth_used": rounded(self.used),
            "depth_m": _percentiles(self.depths),
            "range_m": [self.sensor.min_range, self.sensor.max_range],
            "depth_scale": self.sensor.depth_scale,
            "fitting_depth_scale": self.fitting_scale,
            "size_of_true": None if self.truth is None or self.truth.size is None else rounded(self.truth.size),
        }

    def _in_range(self, shares: Sequence[float]) -> float:
        """Return the mean of a share of the returns, weighted by each picture's returns."""
        weights = np.array([p.depth.measured for p in self.pictures])
        return float(np.dot(shares, weights) / weights.sum()) if weights.any() else 0.0

    def _too_fast(self) -> str:
        """Return where the trajectory moves faster than a hand, which a registration at a similar place does."""
        for motion in self.motions:
            if motion.speed_m_s > self.limits.max_speed_m_s or motion.turn_rad_s > self.limits.max_turn_rad_s:
                begin, end = motion.stamps_s
                return (
                    f"the trajectory jumps by {motion.moved_m:.2f} m and {motion.turned_rad:.2f} rad from {begin:.2f} to "
                    f"{end:.2f} s, at {motion.speed_m_s:.1f} m/s and {motion.turn_rad_s:.1f} rad/s "
                    f"({self.limits.max_speed_m_s:g} m/s and {self.limits.max_turn_rad_s:g} rad/s allowed), though the "
                    f"pictures register: different places may look alike; record without a cut, or add groundtruth.txt"
                )
        return ""

    def _against_truth(self) -> str:
        truth, limits = self.truth, self.limits
        assert truth is not None
        if truth.size is not None and abs(truth.size - 1.0) > limits.max_size_error:
            return (
                f"the trajectory has the true shape at {truth.size:.3g} times the true size: depth_scale is "
                f"{self.sensor.depth_scale:g}, and depth_scale = {self.sensor.depth_scale * truth.size:.4g} in camera.toml fits"
            )
        allowed_m = max(limits.max_error_m, limits.max_error_share * truth.extent_m)
        if truth.rms_m > allowed_m:
            return (
                f"the trajectory is {1e3 * truth.rms_m:.0f} mm rms off groundtruth.txt, {1e3 * allowed_m:.0f} mm allowed, "
                f"though the pictures register: different places look alike, or camera.toml is wrong"
            )
        return ""

    def _not_observed(self) -> str:
        names = ", ".join(self.unobservable)
        return (
            f"{self.supporting} of {len(self.pictures) - 1} pictures show every direction of motion ({names} unobservable, "
            f"for up to {self.longest_gap_s:.1f} s): the rest of the trajectory is a guess; record a scene with edges, "
            f"objects or walls in all directions, or a robot's run with its leg odometry"
        )

    def _out_of_range(self) -> str:
        low, median, high = self.depths
        found = (
            f"only {self.used:.0%} of the depths are in range: at depth_scale {self.sensor.depth_scale:g} they are "
            f"{low:.2f} to {high:.2f} m (median {median:.2f} m), the range used is {self.sensor.min_range:g} to "
            f"{self.sensor.max_range:g} m"
        )
        if self.fitting_scale is not None:
            return f"{found}; depth_scale = {self.fitting_scale:g} in camera.toml fits"
        return f"{found}; set min_range and max_range in camera.toml if the camera is accurate at these depths"

    def _lost(self, lost: Sequence[PictureEvidence]) -> str:
        return (
            f"{len(lost)} of {len(self.pictures) - 1} pictures did not register, for up to {self.longest_gap_s:.1f} s "
            f"(at {lost[0].stamp_s:.2f} s: {lost[0].reason}): the trajectory is a guess there; move the camera more slowly, "
            f"and keep a third of the earlier view in each picture"
        )


def depth_range(raw: NDArray[np.uint16], sensor: DepthSensor) -> DepthRange:
    """Compare a sample of a raw picture's depths (h, w) with the range of a sensor."""
    sample = raw[::_SAMPLED, ::_SAMPLED]
    returns = sample[sample > 0]
    if not returns.size:
        nan = float("nan")
        return DepthRange(0.0, 0.0, (nan, nan, nan), (0.0,) * len(USUAL_SCALES))

    def share(scale: float) -> float:
        low, high = sensor.min_range * scale, sensor.max_range * scale
        return float(np.count_nonzero((returns >= low) & (returns <= high))) / returns.size

    low, median, high = np.percentile(returns, _PERCENTILES) / sensor.depth_scale
    depths = float(low), float(median), float(high)
    at_scale = tuple(share(scale) for scale in USUAL_SCALES)
    return DepthRange(returns.size / sample.size, share(sensor.depth_scale), depths, at_scale)


def camera_motions(stamps_ns: NDArray[np.int64], T_world_camera: Array) -> tuple[CameraMotion, ...]:
    """Return the motions between successive poses (n, 4, 4) at times (n,) [ns] since the first picture."""
    motions = []
    for k in range(1, len(stamps_ns)):
        T = inverse(T_world_camera[k - 1]) @ T_world_camera[k]
        stamps_s = (float(stamps_ns[k - 1]) * 1e-9, float(stamps_ns[k]) * 1e-9)
        motions.append(CameraMotion(stamps_s, float(np.linalg.norm(T[:3, 3])), float(np.linalg.norm(log_so3(T[:3, :3])))))
    return tuple(motions)


def picture_evidence(stamp_ns: int, pose: BodyPose | None, depth: DepthRange) -> PictureEvidence:
    """Return the evidence of a picture at a time [ns], from its pose if there is one."""
    if pose is None or not pose.ok:
        reason = "no pose was estimated" if pose is None else pose.reason
        return PictureEvidence(stamp_ns * 1e-9, False, reason, 0.0 if pose is None else pose.overlap, AXES, depth)
    return PictureEvidence(stamp_ns * 1e-9, True, "", pose.overlap, unobservable_directions(pose.degenerate), depth)


def in_words(table: Mapping[str, Any]) -> list[str]:
    """Format `Evidence.as_table` as lines of text."""
    after, depth = table["pictures_after_first"], table["depth_m"]
    lines = [f"{table['pictures_supporting']} of {after} pictures after the first show every direction of motion"]
    if table["unobservable"]:
        counts = ", ".join(f"{name} in {count}" for name, count in table["unobservable"].items())
        lines.append(f"unobservable, left to the expected motion: {counts}")
    if table["longest_gap_s"] > 0:
        lines.append(f"longest time without such a picture: {table['longest_gap_s']:.2f} s")
    if depth["median"] is not None:
        low, high = table["range_m"]
        lines.append(
            f"depths {depth['p5']:.2f} to {depth['p95']:.2f} m (5 to 95 %), median {depth['median']:.2f} m; "
            f"{table['depth_used']:.0%} are within the {low:g} to {high:g} m that are used"
        )
    return lines


def _percentiles(depths: tuple[float, float, float]) -> dict[str, float | None]:
    """Return a plain table of the percentiles [m]; JSON has no NaN."""
    known = [rounded(depth) if np.isfinite(depth) else None for depth in depths]
    return dict(zip(("p5", "median", "p95"), known, strict=True))
