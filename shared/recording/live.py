"""Recording of a link's messages in a thread that never blocks the link."""

import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from sextant.shared.recording.rotation import NoRoomError
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.runtime.zenoh_runner import Link
from sextant.shared.wire import codec, topics

_QUEUE_FRAMES = 2000  # maximum number of queued frames
_QUEUE_BYTES = 64 << 20  # maximum total size of queued frames
_WRITE_S = 0.05  # [s] between two writes of the queue
_FLUSH_S = 0.4  # [s] between two flushes to the operating system, which keeps the data if this process dies
_SYNC_S = 0.4  # [s] between two syncs to the disk, against power failures


class Sink(Protocol):
    """Protocol of a destination of frames, such as a `Recorder` or a `Rotation`."""

    @property
    def target(self) -> str: ...  # noqa: D102 - as in these classes

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
    """Records the messages of a link without blocking it; a context manager.

    Frames wait in a bounded queue for the writing thread. Frames that arrive while the queue is full are dropped and counted.
    """

    def __init__(self, sink: Sink):
        self.taken = 0  # frames written or queued
        self.dropped = 0  # frames dropped because the queue was full
        self.problem = ""  # why writing ended early; empty if it did not
        self._sink = sink
        self._queue: deque[tuple[AnyTopic, bytes, int]] = deque()
        self._waiting_bytes = 0
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._endings: list[Callable[[], None]] = []  # functions that end the subscriptions
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._syncing = threading.Thread(target=self._sync, name="sync", daemon=True)

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._sink.size

    def take(self, topic: AnyTopic, frame: bytes, at_ns: int) -> None:
        """Queue a frame for writing, from any thread, without blocking."""
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
        """Subscribe to every topic that the sink does not skip.

        `clock` gives the time [ns].
        """
        for topic in topics.TOPICS:
            if topic not in self._sink.skipped:
                self._endings.append(link.subscribe(topic, lambda heard, frame: self.take(heard, frame, clock())))

    def __enter__(self) -> Self:
        self.start()
        return self

    def start(self) -> None:
        """Start the threads."""
        self._thread.start()
        self._syncing.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.end()
        self.join()

    def end(self) -> None:
        """End the subscriptions.

        The thread then writes the queue and finishes the file (see `finished`).
        """
        for ending in self._endings:
            ending()
        self._endings.clear()
        self._ended.set()

    def join(self) -> None:
        """Wait until the thread has finished the file; call `end` first."""
        self._thread.join()

    @property
    def finished(self) -> bool:
        """Whether the last file is complete, or was abandoned."""
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
            self.problem = f"the recording ended early: {error}"  # the last file is complete
        except OSError as error:
            self.problem = f"the recording ended early: {error}"
            self._sink.abandon()
            return
        try:
            self._sink.close()
        except OSError as error:
            self.problem = self.problem or f"the recording could not be finished: {error}"

    def _sync(self) -> None:
        """Sync the file in a separate thread, because the disk is slow."""
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
        for topic, frame, at_ns in waiting:
            self._sink.write(topic, codec.packed(frame, topic.type), at_ns)
