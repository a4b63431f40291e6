"""The planner's process: `python -m sextant.services.planner --connect tcp/127.0.0.1:7447`."""

from sextant.services.planner.config import Settings
from sextant.services.planner.service import Planner
from sextant.services.planner.warmup import compile_functions
from sextant.shared.runtime import process

process.main("planner", Settings, Planner, compile_functions)
