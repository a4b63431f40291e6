"""The actuator's process: `python -m sextant.services.actuator --connect tcp/127.0.0.1:7447 --set port=/dev/ttyUSB0`."""

from sextant.services.actuator.config import Settings
from sextant.services.actuator.live import live_actuator
from sextant.shared.runtime import process

process.main("actuator", Settings, live_actuator)
