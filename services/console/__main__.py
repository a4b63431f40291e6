"""The console's process: `python -m services.console --connect tcp/127.0.0.1:7447`."""

from services.console.config import Settings
from services.console.service import Console
from shared import process

process.main("console", Settings, Console)
