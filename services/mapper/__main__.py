"""Mapper process: `python -m sextant.services.mapper --connect tcp/127.0.0.1:7447`."""

from sextant.services.mapper.config import Settings
from sextant.services.mapper.service import Mapper
from sextant.services.mapper.warmup import compile_functions
from sextant.shared.runtime import process

process.main("mapper", Settings, Mapper, compile_functions)
