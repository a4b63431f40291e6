"""The stop path's process: `python -m services.actuator.stop --connect tcp/127.0.0.1:7447 --set port=/dev/ttyUSB0`."""

from services.actuator.stop.config import Settings
from services.actuator.stop.service import Stop
from shared import process

process.main("stop", Settings, Stop)
