"""Record of where feet have met ground, and which of them have proven that they stand. Pure."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sextant.services.actuator.estimation.touchdown_detector import FootContact
from sextant.shared.geometry import Array, apply

_EARLY_M = 0.006  # [m] height over its target from which a touch stops a foot; below that the leg's compliance takes it up
_SETTLE_S = 0.05  # [s] time constant in which the command of a stopped foot moves to its measured position
_SURVEY_S = 0.05  # [s] time constant in which the height of new footholds is measured at rest
_SURVEYED_M = 0.010  # [m] largest correction of the height at which touchdown was detected


@dataclass(frozen=True, slots=True)
class Finding:
    """Contact, or missing ground, that a foot has found."""

    leg: int
    p_odom: Array  # (3,) [m] foot centre: where it met ground, or the deepest point of its search
    carries: bool  # False: there is no ground


class GroundContacts:
    """Ground under each foot, from touchdown to lift-off."""

    def __init__(self, feet: Array, ground: Array):
        """Begin with feet (6, 3) [m] {cmd} that stand at heights (6,) [m] {odom}."""
        self.ground = ground.copy()  # (6,) [m] {odom} heights at which the standing feet were set down
        self.stopped: NDArray[np.bool_] = np.zeros(6, dtype=bool)  # swing legs that met ground before their targets
        self.met = feet.copy()  # (6, 3) [m] {cmd} positions where feet met ground
        self.proven: NDArray[np.bool_] = np.ones(6, dtype=bool)  # legs that have carried load since touchdown
        self.stop_height = np.zeros(6)  # [m] over their targets at which feet were stopped, by ground or by a false touchdown
        self._landed: NDArray[np.bool_] = np.zeros(6, dtype=bool)  # legs of the last swing
        self._surveyed = np.zeros(6)  # [m] height corrections of new footholds
        self._findings: list[Finding] = []

    def take_findings(self) -> list[Finding]:
        """Return the findings since the last call."""
        found, self._findings = self._findings, []
        return found

    def lift_off(self, legs: NDArray[np.bool_]) -> None:
        """Begin the swing of legs (6,), which must prove that they stand afterwards."""
        self.proven[legs] = False
        self.stop_height[legs] = 0.0
        self._landed = legs.copy()

    def prove(self, felt: FootContact, candidates: NDArray[np.bool_]) -> None:
        """Note legs (6,) of the candidates that carry load while others are unloaded."""
        self.accept(felt.bears & ~self.proven & candidates, felt)

    def accept(self, legs: NDArray[np.bool_], felt: FootContact) -> None:
        """Note legs (6,) that stand; a foot that is only assumed to stand yields no finding."""
        if np.count_nonzero(legs):
            self.proven |= legs
            self._find(legs & felt.known, felt.feet, carries=True)

    def survey(self, dt: float, felt: FootContact) -> None:
        """Measure at rest the height of feet that have just met ground.

        Their first measurement was in motion. The feet that stood before determine the body pose. All six are in the fit, so
        each update sees about half of the error. A foot whose height continues to change stands on soft ground or is not at
        its target, so the correction is limited.
        """
        fresh = self.stopped & self._landed & felt.known
        gap = min(dt / _SURVEY_S, 1.0) * (felt.feet[:, 2] - self.ground)
        gap = np.where(fresh, np.clip(self._surveyed + gap, -_SURVEYED_M, _SURVEYED_M) - self._surveyed, 0.0)
        self._surveyed += gap
        self.ground += gap
        self.met[:, 2] += gap

    def stop_early(self, legs: NDArray[np.bool_], targets: Array, met: Array, feet_odom: Array) -> None:
        """Stop feet where they have met ground, unless they are close to their targets.

        Args:
            legs: (6,) that have met something.
            targets: (6, 3) [m] {cmd} their targets.
            met: (6, 3) [m] {cmd} their measured positions.
            feet_odom: (6, 3) [m] {odom} the same positions.
        """
        over = met[:, 2] - targets[:, 2]
        early = legs & (over > _EARLY_M)
        self.stay(early, met, feet_odom)
        self.stop_height[early] = over[early]

    def stay(self, legs: NDArray[np.bool_], met: Array, feet_odom: Array) -> None:
        """Keep feet at measured positions (6, 3) [m], in {cmd} and in {odom}."""
        self.met[legs] = met[legs]
        self.ground[legs] = feet_odom[legs, 2]
        self._surveyed[legs] = 0.0
        self.stopped |= legs
        self._find(legs, feet_odom, carries=True)

    def lower(self, depth: Array) -> None:
        """Note feet that stand lower by depths (6,) [m] than where they were set down."""
        self.ground -= depth
        self.met[:, 2] -= depth

    def release(self, legs: NDArray[np.bool_]) -> None:
        """No longer hold legs (6,) where they met something."""
        self.stopped &= ~legs

    def report_missing(self, legs: NDArray[np.bool_], feet_odom: Array) -> None:
        """Report legs (6,) without ground down to positions (6, 3) [m] {odom}, once."""
        self._find(legs, feet_odom, carries=False)
        self.proven[legs] = True

    def settle(self, feet: Array, dt: float) -> None:
        """Move the commands (6, 3) [m] {cmd} of stopped feet to where they met ground, in place."""
        if np.count_nonzero(self.stopped):
            feet[self.stopped] += (1.0 - math.exp(-dt / _SETTLE_S)) * (self.met - feet)[self.stopped]

    def turn(self, T_odom: Array, T_cmd: Array, feet_odom: Array) -> None:
        """Turn the ground by T (4, 4), given in {odom} and in {cmd}, under feet (6, 3) [m] {odom}."""
        self.ground = apply(T_odom, np.column_stack([feet_odom[:, :2], self.ground]))[:, 2]
        self.met = apply(T_cmd, self.met)

    def _find(self, legs: NDArray[np.bool_], feet_odom: Array, carries: bool) -> None:
        if np.count_nonzero(legs):
            self._findings += [Finding(leg, feet_odom[leg].copy(), carries) for leg in np.flatnonzero(legs).tolist()]
