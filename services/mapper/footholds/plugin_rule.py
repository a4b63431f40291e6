"""A foothold rule of another package, in place of the mapper's score."""

import numpy as np
from numpy.typing import NDArray

from sextant.services.mapper.elevation.elevation_grid import ElevationSnapshot
from sextant.shared.plugins.foothold_rule import ElevationMap, checked_score
from sextant.shared.plugins.loading import Plugin
from sextant.shared.robot.profile import RobotProfile


class PluginRule:
    """Passes each map to a plug-in, and checks its score."""

    def __init__(self, profile: RobotProfile, name: str):
        """Load the plug-in.

        Raises:
            PluginError: It cannot be loaded.
        """
        self._foot_radius = profile.foot.radius
        self._plugin = Plugin.make("foothold", name, profile)

    def score(self, snapshot: ElevationSnapshot) -> NDArray[np.float32]:
        """Return the score (nx, ny) of a map.

        Raises:
            PluginError: The plug-in failed, or its score is invalid.
        """
        elevation, variance, origin = snapshot.elevation.copy(), snapshot.variance.copy(), snapshot.origin.copy()
        for array in (elevation, variance, origin):
            array.setflags(write=False)
        ground = ElevationMap(elevation, variance, origin, snapshot.resolution, self._foot_radius)
        return self._plugin.call(lambda rule: checked_score(rule(ground), elevation.shape))
