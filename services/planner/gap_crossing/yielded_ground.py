"""Ground that gave way under a foot, which carries no foot again."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.planner.roadmap.sections import without
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.geometry import Array, apply
from sextant.shared.robot.profile import LEGS
from sextant.shared.wire.messages import ActuatorState

YIELDED_RADIUS_M = 0.055  # [m] around a foot without ground, where ground counts as no foothold
_SUNK = 0.012  # [m] from the mapped ground down to a standing foot, from which the ground has given way


class YieldedGround:
    """Places where ground gave way."""

    def __init__(self, places: list[Array], foot_radius_m: float):
        """Start with the places of earlier crossings.

        Args:
            places: (3,) [m] {world} undersides of feet that found no ground, or lower ground; this class appends to the list.
            foot_radius_m: [m] from a foot's centre to its underside.
        """
        self._places, self._foot_radius_m = places, foot_radius_m
        self._touch_ns: NDArray[np.int64] | None = None  # earlier touches do not count
        self.reason = ""  # which feet found no ground since this was last cleared

    def record(self, state: ActuatorState) -> None:
        """Record places where a foot found no ground."""
        before, self._touch_ns = self._touch_ns, state.touchdown_ns.copy()
        if before is None:
            return
        new = np.flatnonzero((state.touchdown_ns > before) & ~state.touchdown_contact).tolist()
        self.add([apply(state.T_world_odom, state.touchdown_point[leg]) for leg in new])
        if new:
            self.reason = f"no ground under the {' and '.join(LEGS[leg] for leg in new)} foot"

    def add(self, soles: list[Array]) -> None:
        """Add undersides (3,) [m] {world} of feet where ground gave way."""
        self._places += soles

    def in_strip(self, field: StripMap) -> list[Array]:
        """Return the places (3,) [m] {strip}."""
        return [apply(field.T_strip_world, place) for place in self._places]

    def excluded_from(self, field: StripMap, feet: Array) -> StripMap:
        """Return the field updated by touch.

        Ground that gave way under a foot carries none. Ground is no higher than the feet (6, 3) [m] {strip} that stand on it.
        """
        gone = self.in_strip(field)
        soles = feet - [0.0, 0.0, self._foot_radius_m]
        on_gone = [any(np.hypot(*(sole - place)[:2]) < YIELDED_RADIUS_M for place in gone) for sole in soles]
        sunk = [
            sole
            for sole, known in zip(soles, on_gone, strict=True)
            if not known and field.lowest_ground(sole) - sole[2] > _SUNK
        ]
        self.add([apply(field.T_world_strip, sole) for sole in sunk])
        for place in [*gone, *soles[on_gone], *sunk]:
            field = without(field, place, YIELDED_RADIUS_M)
        return field
