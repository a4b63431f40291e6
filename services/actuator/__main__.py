"""The actuator's process: `python -m services.actuator --connect tcp/127.0.0.1:7447 --set port=/dev/ttyUSB0`."""

from services.actuator.config import Settings
from services.actuator.live import live_actuator
from shared import process

process.main("actuator", Settings, live_actuator)
