"""The planner's process: `python -m sextant.services.planner --connect tcp/127.0.0.1:7447`."""

from sextant.services.planner.config import Settings
from sextant.services.planner.service import Planner
from sextant.services.planner.warmup import SearchCompilation
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime import process

search = SearchCompilation()


def make(profile: RobotProfile, settings: Settings) -> Planner:
    """Make a planner that crosses gaps once the search is compiled."""
    return Planner(profile, settings, search.is_ready)


process.main("planner", Settings, make, search.start)
