"""Which joint of a standing leg is off its encoder, from the motion of the standing feet against each other.

Standing feet are fixed to the ground, so their distances are constant. The distances by the encoders are not, if a joint's link
is off its encoder: they change by the change of their derivative, times that offset. Small constant offsets are those of horns
and links that differ from the profile. A Kalman filter learns them from stance to stance; a new offset is what it cannot
explain.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sextant.shared.geometry import Array
from sextant.shared.robot.kinematics import feet_and_shanks
from sextant.shared.robot.profile import RobotProfile

_PROBE_RAD = math.radians(10.0)  # offset at which the derivatives are computed, because slips are large
_USUAL_RAD = math.radians(2.5)  # standard deviation of the offsets of a robot's horns before the first stance
_NOISE_M = 0.002  # least standard deviation of a change of distance: play, bending, feet that roll and slide
_NOISE_RATIO = 2.0  # [1] assumed noise by the measured one: tails are heavier than Gaussian
_NOISE_WEIGHT = 0.1  # [1] of the newest stance in the measured noise
_LARGEST_RAD = math.radians(45.0)  # largest new offset
_SLIDING = 0.2  # [1] share of what is unusual by which feet slide, because legs work against each other
_MATCHED_M = 0.0012  # standard deviation of a change of distance in robots that match their profile
_LASTING_RAD = math.radians(4.0)  # standard deviation of a lasting offset before the first stance
_GROWTH_RAD = math.radians(3.0)  # standard deviation of the growth of a new offset in a stance


@dataclass(frozen=True, slots=True)
class Stance:
    """Changes of the distances of standing feet in a stance, by the encoders."""

    legs: tuple[int, ...]
    moved: Array  # (n,) [m] for each pair of legs
    constant: Array  # (n, 18) [m/rad] derivative by an offset that was there before the stance
    late: Array  # (n, 18) [m/rad] derivative by an offset that began in the stance


@dataclass(frozen=True, slots=True)
class Slip:
    """A joint whose offset explains what is unusual in stances."""

    joint: int  # 0 to 17
    size: float  # [rad] by which the link is ahead of its encoder, in joint direction
    left: float  # [1] squared Mahalanobis distance that it does not explain
    cost: float  # [1] minus twice the logarithm of its likelihood, up to a constant


def measure_stance(profile: RobotProfile, before: Array, after: Array, legs: Sequence[int]) -> Stance:
    """Compare the distances of standing feet at two measurements.

    Args:
        profile: The robot.
        before: (6, 3) [rad] joint angles.
        after: (6, 3) [rad] joint angles later.
        legs: Standing legs, at least two.
    """
    here, there = _probed(profile, before), _probed(profile, after)
    turn = np.cross(here[0][1], there[0][1])
    rolled = profile.foot.radius * np.stack([turn[:, 1], -turn[:, 0], np.zeros(6)], axis=1)  # see LegOdometry
    first, last = np.array([feet + rolled for feet, _ in here]), np.array([feet for feet, _ in there])
    pairs = list(combinations(legs, 2))
    moved, constant, late = np.zeros(len(pairs)), np.zeros((len(pairs), 18)), np.zeros((len(pairs), 18))
    for row, (a, b) in enumerate(pairs):
        moved[row] = math.dist(last[0, a], last[0, b]) - math.dist(first[0, a], first[0, b])
        for leg, other in ((a, b), (b, a)):
            columns = slice(3 * leg, 3 * leg + 3)
            late[row, columns] = _derivative(last, leg, other)
            constant[row, columns] = late[row, columns] - _derivative(first, leg, other)
    return Stance(tuple(legs), moved, constant, late)


def largest_change(profile: RobotProfile, before: Array, after: Array, legs: Sequence[int]) -> float:
    """Return the largest change [m] of the distance of two standing feet, but for their rolling; arguments as above."""
    first, last = feet_and_shanks(profile, before)[0], feet_and_shanks(profile, after)[0]
    return max(abs(math.dist(last[a], last[b]) - math.dist(first[a], first[b])) for a, b in combinations(legs, 2))


def _probed(profile: RobotProfile, q: Array) -> list[tuple[Array, Array]]:
    """Return feet and shanks (6, 3) for the joint angles, and with each joint of all legs turned up and down."""
    turns = np.zeros((7, 3))
    for joint in range(3):
        turns[1 + joint, joint], turns[4 + joint, joint] = _PROBE_RAD, -_PROBE_RAD
    found = [feet_and_shanks(profile, q + turn) for turn in turns]
    return [(np.array(feet), np.array(shanks)) for feet, shanks in found]


def _derivative(feet: Array, leg: int, other: int) -> list[float]:
    """Return the derivatives [m/rad] of the distance of two feet by the joints of the first leg."""
    away = [math.dist(foot, feet[0, other]) for foot in feet[1:, leg]]
    return [(more - less) / (2.0 * _PROBE_RAD) for more, less in zip(away[:3], away[3:], strict=True)]


class JointOffsets:
    """Kalman filter of the constant offsets between links and encoders (18,) [rad], with the profile as its start."""

    def __init__(self) -> None:
        """Begin with the profile."""
        self.mean = np.zeros(18)  # [rad] by which links are ahead of their encoders
        self._covariance = np.eye(18) * _USUAL_RAD**2
        self._noise = 0.0  # [m^2] mean square of what the offsets did not explain
        # Changes of distances: their number, the sums of all squares and of what earlier stances did not predict, both by the
        # variance in robots that match their profile, and sums for the fit of one joint's offset.
        self.pairs, self.moved, self.unpredicted = 0, 0.0, 0.0
        self._pull, self._weight = np.zeros(18), np.full(18, 1.0 / _LASTING_RAD**2)

    @property
    def sigma(self) -> Array:
        """Standard deviations (18,) [rad] of the offsets."""
        return np.asarray(np.sqrt(np.diag(self._covariance)))

    def learn(self, stance: Stance) -> None:
        """Take in a stance without a new offset."""
        unusual, covariance, constant = self._compared([stance])
        inverse = np.linalg.inv(covariance)
        measured = self._variance() * float(unusual @ inverse @ unusual) / len(unusual)
        gain = -self._covariance @ constant.T @ inverse
        self.mean = self.mean + gain @ unusual
        learned = self._covariance + gain @ constant @ self._covariance
        self._covariance = (learned + learned.T) / 2.0
        self._noise += _NOISE_WEIGHT * (measured - self._noise)
        self.pairs += len(unusual)
        self.unpredicted += float(unusual @ unusual) / _MATCHED_M**2
        self.moved += float(stance.moved @ stance.moved) / _MATCHED_M**2
        self._pull -= stance.moved @ stance.constant / _MATCHED_M**2
        self._weight += (stance.constant**2).sum(axis=0) / _MATCHED_M**2

    def lasting(self) -> list[Slip]:
        """Return all joints as if each were the only one that differs from the profile, the likeliest one first."""
        sizes, left = self._pull / self._weight, self.moved - self._pull**2 / self._weight
        return [Slip(int(joint), float(sizes[joint]), float(left[joint]), float(left[joint])) for joint in np.argsort(left)]

    def surprise(self, stances: Sequence[Stance]) -> float:
        """Return the squared Mahalanobis distance of stances from what the offsets explain."""
        unusual, covariance, _ = self._compared(stances)
        return float(unusual @ np.linalg.inv(covariance) @ unusual)

    def explain(self, stances: Sequence[Stance]) -> list[Slip]:
        """Return the joints whose single new offset may explain stances of the same legs, the likeliest one first.

        The offset began before the first stance or in it.
        """
        unusual, covariance, constant = self._compared(stances)
        covariance += np.eye(len(unusual)) * float(unusual @ unusual) / len(unusual) * _SLIDING**2
        late = constant.copy()
        late[: len(stances[0].late)] = stances[0].late
        slips = []
        for leg in stances[0].legs:
            for joint in range(3 * leg, 3 * leg + 3):
                grown = _block_diagonal([stance.late[:, joint] for stance in stances])
                spread = covariance + grown @ grown.T * _GROWTH_RAD**2
                inverse, volume = np.asarray(np.linalg.inv(spread)), float(np.linalg.slogdet(spread)[1])
                for effects in (constant, late):
                    size, left = _fit(-effects[:, joint], unusual, inverse)
                    slips.append(Slip(joint, size, left, left + volume))
        return sorted(slips, key=lambda slip: slip.cost)

    def _compared(self, stances: Sequence[Stance]) -> tuple[Array, Array, Array]:
        """Return what is unusual (n,) [m], its covariance (n, n), and the derivatives (n, 18) by constant offsets."""
        constant: Array = np.concatenate([stance.constant for stance in stances])
        unusual: Array = np.concatenate([stance.moved for stance in stances]) + constant @ self.mean
        covariance: Array = constant @ self._covariance @ constant.T + np.eye(len(unusual)) * self._variance()
        return unusual, covariance, constant

    def _variance(self) -> float:
        """Return the assumed variance [m^2] of the noise of a change of distance."""
        return max(_NOISE_M**2, _NOISE_RATIO**2 * self._noise)


def _fit(effect: Array, unusual: Array, inverse: Array) -> tuple[float, float]:
    """Return the size of an effect and the squared Mahalanobis distance that it does not explain."""
    weight = inverse @ effect
    size = float(weight @ unusual) / max(float(weight @ effect), 1e-12)
    size = min(max(size, -_LARGEST_RAD), _LARGEST_RAD)
    left = unusual - size * effect
    return size, float(left @ inverse @ left)


def _block_diagonal(columns: Sequence[Array]) -> Array:
    """Return a matrix with each column in its own rows."""
    matrix = np.zeros((sum(map(len, columns)), len(columns)))
    row = 0
    for index, column in enumerate(columns):
        matrix[row : row + len(column), index] = column
        row += len(column)
    return matrix
