"""The mapper's process: `python -m services.mapper --connect tcp/127.0.0.1:7447`."""

from services.mapper.config import Settings
from services.mapper.rehearsal import rehearse
from services.mapper.service import Mapper
from shared import process

process.main("mapper", Settings, Mapper, rehearse)
