"""Survey of the strip across a gap: the request of its map, and which maps count."""

import numpy as np

from sextant.services.planner.gap_crossing.validated_map import validation_error
from sextant.shared.geometry import Array, from_xyz_rpy
from sextant.shared.wire.messages import PassageMap, PassageRequest

STRIP = (2.7, 1.0)  # [m] length and width of the requested map; Masri 2016, section 4.4
TURNING_WIDTH = 1.4  # [m] width of the requested map for a crossing that turns
BEHIND = 0.5  # [m] of the map behind the body
STILL_NS = 700_000_000  # [ns] of rest before a map counts, so that it contains the scans from this place
_REQUEST_NS = 400_000_000  # [ns] between two map requests
_AHEAD_NS = 1_000_000_000  # [ns] by which the stamp of a map may lie in the future


class StripSurvey:
    """Map of a strip that begins behind a place and leads towards another one."""

    def __init__(self, xy: Array, target: Array):
        """Lay the strip from the body's place (2,) [m] {world} towards a target (2,)."""
        heading = float(np.arctan2(*(target - xy)[::-1]))
        origin = xy - BEHIND * np.array([np.cos(heading), np.sin(heading)])
        self.T_world_strip = from_xyz_rpy((*origin, 0.0), (0.0, 0.0, heading))
        self._heading, self._size = heading, STRIP
        self._requested_ns = -1
        self._map_ns = -1  # of the map that was used last

    def widen(self) -> None:
        """Request a map that is wide enough for a crossing that turns, from the same place."""
        self._size = STRIP[0], TURNING_WIDTH

    def request(self, now_ns: int) -> PassageRequest | None:
        """Return a request for the map when it is due, else None."""
        if 0 <= now_ns - self._requested_ns < _REQUEST_NS:
            return None
        self._requested_ns = now_ns
        return PassageRequest(now_ns, self.T_world_strip[:2, 3].copy(), self._heading, *self._size)

    def use(self, map_: PassageMap | None, rest_since_ns: int, now_ns: int) -> PassageMap | str:
        """Return a new valid map that was taken at rest, or why it is invalid ("" for none).

        Args:
            map_: Newest map of the mapper.
            rest_since_ns: [ns] since when the robot rests.
            now_ns: [ns] current time.
        """
        newer_than_ns = max(rest_since_ns + STILL_NS, self._map_ns + 1)
        if map_ is None or not newer_than_ns <= map_.stamp_ns <= now_ns + _AHEAD_NS:
            return ""
        invalid_reason = validation_error(map_, self.T_world_strip, self._size)
        if invalid_reason:
            return invalid_reason
        self._map_ns = map_.stamp_ns
        return map_
