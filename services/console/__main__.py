"""Run the console: `python -m sextant.services.console --connect tcp/127.0.0.1:7447`."""

import os

from sextant.services.console.config import Settings
from sextant.services.console.service import Console
from sextant.shared.runtime import process

# Run Zenoh on one thread. Its default four threads wake each other for every message, which doubles its CPU time here.
os.environ.setdefault("ZENOH_RUNTIME", "(rx: (handover: app), tx: (handover: app))")
process.main("console", Settings, Console)
