"""The stop path's process: `python -m sextant.services.actuator.estop --connect tcp/127.0.0.1:7447 --set port=/dev/ttyUSB0`."""

from sextant.services.actuator.estop.config import Settings
from sextant.services.actuator.estop.service import EmergencyStop
from sextant.shared.runtime import process

process.main("stop", Settings, EmergencyStop)
