"""The perception's process: `python -m sextant.services.perception --connect tcp/127.0.0.1:7447`."""

from sextant.services.perception.config import Settings
from sextant.services.perception.rehearsal import rehearse
from sextant.services.perception.service import Perception
from sextant.shared import process

process.main("perception", Settings, Perception, rehearse)
