"""Warm-up: plan a step and a short gap crossing, so that all functions are compiled in advance.

The search of gap crossings takes long to compile. The first time, the planner already works meanwhile: it waits with a crossing
(`SearchCompilation`).

python -m sextant.services.planner.warmup     compiles the functions while the cores have nothing else to do
"""

import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np

from sextant.services.planner.config import Settings
from sextant.services.planner.locomotion import warmup as steps
from sextant.services.planner.roadmap import roadmap_search
from sextant.services.planner.roadmap.params import PassageSettings
from sextant.services.planner.roadmap.roadmap import Roadmap, Stance
from sextant.services.planner.roadmap.strip_map import StripMap
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.process_priority import go_last
from sextant.shared.runtime.shutdown import end_with, leave
from sextant.shared.wire import codec
from sextant.shared.wire.messages import PassageMap

_CELL, _CELLS = 0.01, (150, 120)  # [m], and number of cells along and across
_START, _GOAL = 0.44, 0.80  # [m] start and goal of the body along the strip
_EXPANSIONS = 200
_LATE_S = 30.0  # [s] from the start of the planner to that of the process that compiles
_ANY_ROBOT = "phantomx_mk2"  # the compiled code is the same for all


def compile_functions(profile: RobotProfile, settings: Settings) -> None:
    """Compile all functions that the planner calls."""
    steps.compile_functions(profile, settings)
    height = profile.stance.body_height
    elevation, nothing = np.zeros(_CELLS, dtype=np.float32), np.zeros(_CELLS, dtype=np.bool_)
    layers = (elevation, np.zeros((*_CELLS, 3), dtype=np.int16), elevation, nothing, np.full(_CELLS, -1, dtype=np.int8))
    told = PassageMap(0, _CELL, np.full(2, _CELL / 2), 0.0, *layers, 0.0, "", np.eye(4), nothing)
    # Arrays of a received message are read-only, which makes them another type for the compiler.
    field = StripMap.of(codec.decode(codec.encode(told), PassageMap)[0])
    body = np.array([_START, 0.0, height])
    roadmap = Roadmap(profile, PassageSettings(body_height=height))
    roadmap.begin(field, Stance(body, profile.rest_feet(height) + body), _GOAL, seed=0)
    roadmap.grow(_EXPANSIONS)


def is_compiled() -> bool:
    """Return whether Numba has cached the search."""
    search: Any = roadmap_search.grow
    name = f"{roadmap_search.__name__.rpartition('.')[2]}.grow-{search.py_func.__code__.co_firstlineno}.*.nbi"
    return any(Path(search.stats.cache_path).glob(name))


class SearchCompilation:
    """Makes the search ready: loads it, or lets another process compile it first while the planner works.

    A thread that compiles would delay the planner's cycles. Unless a crossing is due, the other process starts late: the start
    of the robot and its first steps need the cores.
    """

    def __init__(self) -> None:
        self._ready, self._is_due = threading.Event(), threading.Event()

    def is_ready(self) -> bool:
        """Return whether a search compiles nothing; the caller has a crossing to search."""
        self._is_due.set()
        return self._ready.is_set()

    def start(self, profile: RobotProfile, settings: Settings) -> None:
        """Load the search, or start to compile it if it is not cached; compile the planning of steps."""
        steps.compile_functions(profile, settings)
        if is_compiled():
            self._load(profile, settings)
            return
        logging.info("compiling the search of gap crossings, the first time only; until then no gap is crossed")
        threading.Thread(target=self._compile, args=(profile, settings), name="compile", daemon=True).start()

    def _load(self, profile: RobotProfile, settings: Settings) -> None:
        compile_functions(profile, settings)
        self._ready.set()

    def _compile(self, profile: RobotProfile, settings: Settings) -> None:
        self._is_due.wait(_LATE_S)
        status = subprocess.run([sys.executable, "-m", __name__], check=False).returncode
        if status == -signal.SIGTERM:
            return  # the robot shuts down
        if status:
            logging.error("compiling the search of gap crossings failed (exit status %d)", status)
            leave(1)
        self._load(profile, settings)
        logging.info("the search of gap crossings is compiled")


if __name__ == "__main__":
    end_with(os.getppid())
    go_last()
    compile_functions(load_profile(_ANY_ROBOT), Settings())
