"""The console's process: `python -m sextant.services.console --connect tcp/127.0.0.1:7447`."""

import os

from sextant.services.console.config import Settings
from sextant.services.console.service import Console
from sextant.shared.runtime import process

# One thread for what Zenoh does, in place of four that wake each other for every message: that is half of what it takes here.
os.environ.setdefault("ZENOH_RUNTIME", "(rx: (handover: app), tx: (handover: app))")
process.main("console", Settings, Console)
