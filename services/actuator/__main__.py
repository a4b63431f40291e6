"""The actuator's process: `python -m services.actuator --connect tcp/127.0.0.1:7447 --set port=/dev/ttyUSB0`."""

from services.actuator.config import Settings
from services.actuator.service import Actuator
from shared import process

process.main("actuator", Settings, Actuator)
