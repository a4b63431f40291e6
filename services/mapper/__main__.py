"""The mapper's process: `python -m sextant.services.mapper --connect tcp/127.0.0.1:7447`."""

from sextant.services.mapper.config import Settings
from sextant.services.mapper.rehearsal import rehearse
from sextant.services.mapper.service import Mapper
from sextant.shared import process

process.main("mapper", Settings, Mapper, rehearse)
