"""Perception process: `python -m sextant.services.perception --connect tcp/127.0.0.1:7447`."""

from sextant.services.perception.config import Settings
from sextant.services.perception.service import Perception
from sextant.services.perception.warmup import compile_functions
from sextant.shared.runtime import process

process.main("perception", Settings, Perception, compile_functions)
