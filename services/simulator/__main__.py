"""The simulator's process: `python -m services.simulator --set scenario=steps --set bus_port=7450`."""

from services.simulator.config import Settings
from services.simulator.rehearsal import rehearse
from services.simulator.service import Simulator
from shared import process

process.main("simulator", Settings, Simulator, rehearse)
