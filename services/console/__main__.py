"""The console's process: `python -m services.console --connect tcp/127.0.0.1:7447`."""

import os

from services.console.config import Settings
from services.console.service import Console
from shared import process

# One thread for what Zenoh does, in place of four that wake each other for every message: that is half of what it takes here.
os.environ.setdefault("ZENOH_RUNTIME", "(rx: (handover: app), tx: (handover: app))")
process.main("console", Settings, Console)
