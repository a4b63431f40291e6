"""The perception's process: `python -m services.perception --connect tcp/127.0.0.1:7447`."""

import sys

from services.perception.config import Settings
from services.perception.service import Perception
from shared import process

sys.exit(process.run("perception", Settings, Perception))
