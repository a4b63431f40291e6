"""The planner's process: `python -m services.planner --connect tcp/127.0.0.1:7447`."""

from services.planner.config import Settings
from services.planner.rehearsal import rehearse
from services.planner.service import Planner
from shared import process

process.main("planner", Settings, Planner, rehearse)
