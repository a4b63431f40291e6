"""Run the simulator: `python -m sextant.services.simulator --set scenario=steps --set bus_port=7450`."""

from sextant.services.simulator.config import Settings
from sextant.services.simulator.service import Simulator
from sextant.services.simulator.warmup import compile_functions
from sextant.shared.runtime import process

process.main("simulator", Settings, Simulator, compile_functions)
