"""The recorder's process: `python -m services.console.recorder --connect tcp/127.0.0.1:7447`."""

from services.console.recorder.config import Settings
from services.console.recorder.service import RecorderService
from shared import process

process.main("recorder", Settings, RecorderService)
