"""The perception's process: `python -m services.perception --connect tcp/127.0.0.1:7447`."""

from services.perception.config import Settings
from services.perception.rehearsal import rehearse
from services.perception.service import Perception
from shared import process

process.main("perception", Settings, Perception, rehearse)
