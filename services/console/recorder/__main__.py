"""Run the recorder: `python -m sextant.services.console.recorder --connect tcp/127.0.0.1:7447`."""

from sextant.services.console.recorder.config import Settings
from sextant.services.console.recorder.service import RecorderService
from sextant.shared.runtime import process

process.main("recorder", Settings, RecorderService)
