"""Recorder service: records topics to MCAP files and publishes its state."""

import logging
import shutil
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Self

from sextant.services.console.recorder.config import Settings
from sextant.shared.recording.foxglove.translation import Foxglove
from sextant.shared.recording.live import LiveRecorder
from sextant.shared.recording.rotation import Rotation
from sextant.shared.recording.writer import LEFT_OUT, Recorder
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime import clock
from sextant.shared.runtime.service import AHEAD_NS, AnyTopic, Every, Inbox, Stages
from sextant.shared.runtime.zenoh_runner import Link
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Message, RecordCommand, RecorderState, Tick

_LOGGER = logging.getLogger(__name__)


class RecorderService:
    """Service that starts and ends recordings.

    While it records, it subscribes to the recorded topics through its own link, outside the service's inbox.
    """

    name = "recorder"
    trigger = Every.hz(topics.RECORDER_STATE.rate_hz)
    subscribes: tuple[AnyTopic, ...] = (topics.RECORD,)
    publishes: tuple[AnyTopic, ...] = (topics.RECORDER_STATE,)

    def __init__(
        self, profile: RobotProfile, settings: Settings, wall: Callable[[], datetime] = lambda: datetime.now().astimezone()
    ):
        """Create a recorder that is not recording.

        Args:
            profile: The robot.
            settings: Settings of the recorder.
            wall: Clock that returns the local date and time, for folder names.
        """
        self.stages = Stages()
        self._profile, self._settings, self._wall = profile, settings, wall
        self._link: Link | None = None
        self._sequence = -1
        self._recording: LiveRecorder | None = None  # current or last recording
        self._files: Rotation | None = None  # files of that recording
        self._wanted = False
        self._began_ns = self._ended_ns = 0
        self._reason = ""

    def meet(self, link: Link) -> None:
        """Set the link from which topics are recorded; call it before `step`."""
        self._link = link

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._recording is not None:
            self._recording.end()
            self._recording.join()

    def status(self) -> str:
        """Return the current or last recording as text."""
        if self._files is None:
            return self._reason or "recording nothing"
        if self._wanted:
            return f"recording {self._files.path}, {self._files.size / 1e6:.1f} MB"
        return self._reason or f"recorded {self._files.folder}"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Process commands, end a recording that failed, and yield the recorder's state."""
        for command in inbox.drain(topics.RECORD):
            self._obey(command, tick.stamp_ns)
        if self._wanted and self._recording is not None and self._recording.problem:
            self._end(tick.stamp_ns)
        yield self._state(tick.stamp_ns)

    def _obey(self, command: RecordCommand, now_ns: int) -> None:
        if not self._sequence < command.sequence <= now_ns + AHEAD_NS:
            return  # repeated, outdated, or so far in the future that all later commands would count as outdated
        self._sequence = command.sequence
        if command.record and not self._wanted:
            self._begin(now_ns)
        elif not command.record and self._wanted:
            self._end(now_ns)

    def _begin(self, now_ns: int) -> None:
        assert self._link is not None, "meet() must be called before step()"
        if self._recording is not None and not self._recording.finished:
            self._recording.join()
        wall = self._wall()
        folder = Path(self._settings.folder) / wall.strftime("%Y%m%d-%H%M%S")
        about = {"robot": self._profile.name, "run": "live", "began": wall.isoformat(timespec="seconds")}
        self._reason = ""
        try:
            self._files = open_rotation(folder, self._profile, self._settings, about)
        except OSError as error:
            self._reason = f"cannot record to {folder}: {error}"
            _LOGGER.warning("%s", self._reason)
            return
        self._recording = LiveRecorder(self._files)
        self._recording.start()
        self._recording.listen(self._link, clock.now_ns)
        self._wanted, self._began_ns = True, now_ns

    def _end(self, now_ns: int) -> None:
        assert self._recording is not None
        self._wanted, self._ended_ns = False, now_ns
        self._recording.end()  # the recording thread completes the file
        self._reason = self._recording.problem
        if self._reason:
            _LOGGER.warning("%s", self._reason)

    def _state(self, now_ns: int) -> RecorderState:
        recording = self._recording
        until_ns = now_ns if self._wanted else self._ended_ns
        return RecorderState(
            stamp_ns=now_ns,
            recording=self._wanted,
            sequence=self._sequence,
            file="" if self._files is None else str(self._files.path.resolve()),
            duration=0.0 if recording is None else (until_ns - self._began_ns) * 1e-9,
            size=0 if recording is None else recording.size,
            disk_free=_free(Path(self._settings.folder)),
            dropped=0 if recording is None else recording.dropped,
            reason=self._reason,
        )


def open_rotation(folder: Path, profile: RobotProfile, settings: Settings, about: dict[str, str]) -> Rotation:
    """Create the folder of a recording and return its rotating files.

    Args:
        folder: Folder, created if missing.
        profile: The robot.
        settings: File duration, disk reserve and content.
        about: Metadata of the recording.

    Raises:
        OSError: The folder is not writable, or the disk has too little free space.
    """
    folder.mkdir(parents=True, exist_ok=True)
    left_out = () if settings.pictures else LEFT_OUT

    def make(path: Path) -> Recorder:
        return Recorder(path, about, Foxglove(profile), left_out)

    return Rotation(folder, make, round(settings.file_s * 1e9), settings.reserve_mb * 1_000_000)


def _free(folder: Path) -> int:
    """Return the free disk space [B] at an existing or future folder, -1 if unknown."""
    for place in (folder.resolve(), *folder.resolve().parents):
        try:
            return shutil.disk_usage(place).free
        except OSError:
            continue
    return -1
