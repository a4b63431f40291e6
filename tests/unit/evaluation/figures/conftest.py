from collections.abc import Callable
from pathlib import Path

import pytest

from sextant.evaluation import report as reports
from sextant.evaluation.figures.recorded_run import RecordedRun, recorded_run
from sextant.shared.recording.writer import Recorder
from sextant.shared.wire import codec, topics

SCENARIO = 'name = "story"\n[goal]\ndistance = 0.5\n[[terrain]]\nkind = "plane"\n'


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the path of the scenario file of the synthetic walks."""
    path = tmp_path_factory.mktemp("scenario") / "story.toml"
    path.write_text(SCENARIO)
    return str(path)


def keep(story, folder: Path, *, truth: bool = True, until_s: float = 1e9) -> Path:
    """Write the files that a run of a synthetic walk leaves behind."""
    folder.mkdir()
    about = {"scenario": "story", "seed": str(story.seed), "robot": story.scenario.robot, "run": "live"}
    with Recorder(folder / "recording.mcap", about, thinned_ns={}) as recorder:
        for message in story.messages():
            topic = topics.OF_TYPE[type(message)]
            if truth or topic is not topics.TRUTH:
                recorder.write(topic, codec.encode(message), message.stamp_ns)
            if message.stamp_ns > until_s * 1e9:
                break
    if until_s == 1e9:
        reports.write(story.judged().result(), folder)
    return folder


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Return a function that creates the folder of a walk's run, once for each name."""
    root = tmp_path_factory.mktemp("runs")

    def made(name: str, story, **how) -> Path:
        return root / name if (root / name).exists() else keep(story, root / name, **how)

    return made


@pytest.fixture(scope="module")
def heard(kept: Callable[..., Path], scenario: str) -> Callable[..., RecordedRun]:
    """Return a function that reads a walk's run, once for each name."""
    runs: dict[str, RecordedRun] = {}

    def made(name: str, story, **how) -> RecordedRun:
        if name not in runs:
            runs[name] = recorded_run(kept(name, story, **how), scenario)
        return runs[name]

    return made
