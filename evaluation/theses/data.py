"""Data of the figures: lockstep walks, kept in a folder, and the maps and camera pictures along them."""

import datetime
import json
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sextant.evaluation import report as reports
from sextant.evaluation.figures.recorded_run import RecordedRun, recorded_run
from sextant.evaluation.lockstep.lockstep_run import run_lockstep
from sextant.evaluation.observers.run_observers import RECORDING
from sextant.evaluation.provenance import Made, commit
from sextant.evaluation.theses import planner_table
from sextant.evaluation.theses.planner_table import Planned
from sextant.shared.files import whole_files
from sextant.shared.files.input_file import FileError, read_json
from sextant.shared.geometry import Array
from sextant.shared.recording.layout import RecordingError
from sextant.shared.recording.reader import read
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.workers import share_out
from sextant.shared.scenario.loading import load_scenario
from sextant.shared.wire import topics
from sextant.shared.wire.messages import TerrainMap

PLANS = "table_6_1.json"
_MADE = "made.json"  # in a walk's folder: the commit that made it; written last
Say = Callable[[str], object]


class Data:
    """Data of one thesis' figures; everything that is slow is made once and kept below a folder."""

    def __init__(self, folder: Path, seed: int = 0, crossings: int = 25, say: Say = lambda _: None):
        """Keep walks and plans below a folder.

        Args:
            folder: The folder.
            seed: First seed of the walks.
            crossings: Number of crossings in Table 6.1, with seeds from 0 up.
            say: Receives progress.
        """
        self.folder, self.seed, self._crossings, self._say = folder, seed, crossings, say
        self._runs: dict[tuple[str, int], RecordedRun] = {}
        self._maps: dict[str, list[TerrainMap]] = {}
        self._planned: tuple[list[Planned], str] | None = None
        self.profile: RobotProfile = load_profile("phantomx_mk2")

    def prepare(self, walks: Iterable[tuple[str, int]], jobs: int) -> None:
        """Walk what is not kept yet: pairs of scenario and trial."""
        missing = [(name, self.seed + trial) for name, trial in dict.fromkeys(walks)]
        missing = [(name, seed) for name, seed in missing if not _is_kept(self._place(name, seed))]
        tasks = [(name, seed, self._place(name, seed)) for name, seed in missing]
        for result in share_out(_walk, tasks, jobs, in_order=False):
            self._say(result)

    def run(self, name: str, trial: int = 0) -> RecordedRun:
        """Return a walk over a scenario; it is walked if it is not kept."""
        key = name, self.seed + trial
        if key not in self._runs:
            self.prepare([(name, trial)], 1)
            self._runs[key] = recorded_run(self._place(*key))
        return self._runs[key]

    def recording(self, name: str, trial: int = 0) -> Path:
        """Return the recording of a walk."""
        self.run(name, trial)
        return self._place(name, self.seed + trial) / RECORDING

    def maps(self, name: str) -> list[TerrainMap]:
        """Return the recorded maps of the first walk over a scenario, about one a second."""
        if name not in self._maps:
            found = [message for _, message, _ in read(self.recording(name), [topics.TERRAIN])]
            self._maps[name] = [one for one in found if isinstance(one, TerrainMap)]
        return self._maps[name]

    def planned(self) -> tuple[list[Planned], str]:
        """Return the crossings of Table 6.1, and what made them as text; they are kept in `PLANS`."""
        path = self.folder / PLANS
        if self._planned is None and path.exists():
            self._planned = planner_table.read(path)
        if self._planned is None or len({one.seed for one in self._planned[0]}) != self._crossings:
            made = Made.of([(commit(), datetime.datetime.now(datetime.UTC).isoformat())]).words
            self._planned = planner_table.measure(range(self._crossings), self._say), made
            whole_files.write_text(path, planner_table.to_json(*self._planned))
        return self._planned

    def _place(self, name: str, seed: int) -> Path:
        return self.folder / "walks" / f"{name}-{seed}"


def map_window(terrain: TerrainMap, layer: NDArray[np.generic], x: tuple[float, float], y: tuple[float, float]) -> Array:
    """Return a layer (n, m) of a map over a rectangle [m] {world}; NaN beyond the map."""
    r = terrain.resolution
    i, j = (
        np.rint((np.arange(low, high, r) + r / 2 - origin) / r).astype(int)
        for (low, high), origin in zip((x, y), terrain.origin, strict=True)
    )
    inside = ((i >= 0) & (i < layer.shape[0]))[:, None] & ((j >= 0) & (j < layer.shape[1]))
    values = layer[np.clip(i, 0, layer.shape[0] - 1)[:, None], np.clip(j, 0, layer.shape[1] - 1)]
    return np.where(inside, values.astype(np.float64), np.nan)


def _walk(name: str, seed: int, place: Path) -> str:
    """Walk a scenario in lockstep and keep the run; return the result as text."""
    report = run_lockstep(load_scenario(name), seed, place)
    whole_files.write_text(place / _MADE, json.dumps({"commit": commit()}) + "\n")
    return f"{name}, seed {seed}: {report.reason}"


def _is_kept(place: Path) -> bool:
    """Return whether a walk is complete and can be read by this version."""
    try:
        read_json(place / _MADE)
        report = read_json(place / reports.FILE)
        next(iter(read(place / RECORDING, [topics.TRUTH])))
    except (FileError, RecordingError, StopIteration):
        return False
    return not reports.check(report)
