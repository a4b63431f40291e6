"""Recording what a link hears, in a thread of its own that nothing else ever waits for."""

import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from sextant.shared.recording.rotation import NoRoomError
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.runtime.zenoh_runner import Link
from sextant.shared.wire import topics

_QUEUE_FRAMES = 2000  # that may wait for the disk
_QUEUE_BYTES = 64 << 20  # of them together
_WRITE_S = 0.05  # between two looks at what waits
_FLUSH_S = 0.4  # after which what has come is handed to the system, which keeps it whatever becomes of this process
_SYNC_S = 0.4  # between two times that the system is to bring it to the disk, for when the power goes


class Sink(Protocol):
    """What is recorded into: a `Recorder`, a `Rotation` of them, or whoever else takes frames."""

    @property
    def target(self) -> str: ...  # noqa: D102 - as of those

    @property
    def size(self) -> int: ...  # noqa: D102

    @property
    def skipped(self) -> frozenset[AnyTopic]: ...  # noqa: D102

    def write(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None: ...  # noqa: D102

    def flush(self) -> None: ...  # noqa: D102

    def sync(self) -> None: ...  # noqa: D102

    def close(self) -> None: ...  # noqa: D102

    def abandon(self) -> None: ...  # noqa: D102


class LiveRecorder:
    """Records what a link hears, without ever holding the link up; a context manager.

    Frames wait in a bounded queue for a thread that writes. What finds the queue full is dropped and counted.
    """

    def __init__(self, sink: Sink):
        self.taken = 0  # frames that are written, or wait to be
        self.dropped = 0  # frames that found the queue full
        self.problem = ""  # why writing ended early, in words
        self._sink = sink
        self._queue: deque[tuple[AnyTopic, bytes, int]] = deque()
        self._waiting_bytes = 0
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._endings: list[Callable[[], None]] = []  # of what is listened to
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._syncing = threading.Thread(target=self._sync, name="sync", daemon=True)

    @property
    def size(self) -> int:
        """Written so far."""
        return self._sink.size

    def take(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Have a frame written; from any thread, never blocking."""
        if self.problem:
            return
        with self._lock:
            if len(self._queue) >= _QUEUE_FRAMES or self._waiting_bytes + len(frame) > _QUEUE_BYTES:
                self.dropped += 1
                return
            self._queue.append((topic, frame, at_ns))
            self._waiting_bytes += len(frame)
            self.taken += 1

    def listen(self, link: Link, clock: Callable[[], int]) -> None:
        """Record every topic of the table that is not left out; `clock` gives the time [ns]."""
        for topic in topics.TOPICS:
            if topic not in self._sink.skipped:
                self._endings.append(link.subscribe(topic, lambda heard, frame: self.take(heard, frame, clock())))

    def __enter__(self) -> Self:
        self.start()
        return self

    def start(self) -> None:
        """Let the thread write."""
        self._thread.start()
        self._syncing.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.end()
        self.join()

    def end(self) -> None:
        """Listen no longer, and let the thread write what waits and finish the file; `finished` says when."""
        for ending in self._endings:
            ending()
        self._endings.clear()
        self._ended.set()

    def join(self) -> None:
        """Wait for the thread to have finished the file, which `end` asked for."""
        self._thread.join()

    @property
    def finished(self) -> bool:
        """Whether the last file is whole, or given up."""
        return not self._thread.is_alive()

    def _run(self) -> None:
        flush_due_s = time.monotonic()
        try:
            while not self._ended.wait(_WRITE_S) and not self.problem:
                self._write_what_waits()
                if time.monotonic() >= flush_due_s:
                    flush_due_s = time.monotonic() + _FLUSH_S
                    self._sink.flush()
            self._write_what_waits()
        except NoRoomError as error:
            self.problem = f"the recording ended early: {error}"  # and its last file is whole
        except OSError as error:
            self.problem = f"the recording ended early: {error}"
            self._sink.abandon()
            return
        try:
            self._sink.close()
        except OSError as error:
            self.problem = self.problem or f"the recording could not be finished: {error}"

    def _sync(self) -> None:
        """The disk takes its time, in which the other thread goes on."""
        while not self._ended.wait(_SYNC_S) and not self.problem:
            try:
                self._sink.sync()
            except OSError as error:
                self.problem = self.problem or f"the recording ended early: {error}"

    def _write_what_waits(self) -> None:
        with self._lock:
            waiting = list(self._queue)
            self._queue.clear()
            self._waiting_bytes = 0
        for item in waiting:
            self._sink.write(*item)
