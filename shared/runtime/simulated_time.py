"""Simulated time shared by the processes of one run.

It is never faster than real time, and it waits for late services.

The simulator grants time in small spans, so time stands still while the simulator does not run. Each service with a limit on
the age of its inputs or on its cycle sets the time up to which simulated time may run. Time stops there until the service sets
a later limit. If a service sets none for `_PATIENCE_NS` of real time, it has ended or hangs, and time continues without it.

At the start, time is slow until all services are ready, which may take long if they compile. It does not stop, because the
watchdog of the actuator would take a cycle that does not end for a hang.

The state is in a file that all processes map. It has two records. The simulator writes the record that is not in use and then
increments the count. A reader whose count has not changed has read a consistent record. Robots with real servos do not use this
module.
"""

import mmap
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from sextant.shared.runtime.clock import in_use

SPAN_NS = 10_000_000  # [ns] maximum simulated time of one grant; it passes at once after all processes stood still
SERVO_BUS = "servo bus"  # has a limit while data is in transit in either direction
REACTION_NS = 8_000_000  # [ns] of simulated time that may pass after it is due; two ticks of the simulator, so that none waits
_PATIENCE_NS = 1_000_000_000  # [ns] of real time for which simulated time waits at one limit ...
_START_PATIENCE_NS = 180_000_000_000  # [ns] ... and for which it is slow at the start
_START_SLOWER = 20  # [1] ratio of real time to simulated time while a service is not ready
_START = "start of "  # begin of the name of a limit that holds until a service is ready
_NO_LIMIT = (1 << 63) - 1
_COUNT, _RECORDS, _RECORD, _SLOTS = 0, 1, 3, 7  # indices: count, first of two records, words per record, first limit
_NAME_BYTES = 32
_MAX_NAMES = 16
_WORDS = _SLOTS + 2 * _MAX_NAMES  # each service has a limit, and the real time for which simulated time waited at it
_SIZE = 8 * _WORDS + _NAME_BYTES * _MAX_NAMES


class SimulatedTime:
    """Simulated time [ns] of one run, in a mapped file; a call reads the time."""

    def __init__(self, path: Path, machine: Callable[[], int] = time.monotonic_ns):
        """Map the file of a run.

        Args:
            path: File made by `create`.
            machine: Monotonic clock of this machine [ns].

        Raises:
            ValueError: The file does not exist, or is not a file of simulated time.
        """
        try:
            with path.open("r+b") as file:
                self._map = mmap.mmap(file.fileno(), 0)
        except (OSError, ValueError) as error:
            raise ValueError(f"cannot map simulated time in {path}: {error}") from None
        if len(self._map) != _SIZE:
            size = len(self._map)
            self._map.close()
            raise ValueError(f"{path}: a file of {_SIZE} bytes expected for simulated time, found {size}")
        self.path = path
        self._words = memoryview(self._map).cast("q")
        self._machine = machine
        names = bytes(self._map[8 * _WORDS :])
        parts = [names[k : k + _NAME_BYTES].rstrip(b"\0") for k in range(0, len(names), _NAME_BYTES)]
        self.names = tuple(part.decode("utf-8", "replace") for part in parts if part)
        self._index = {name: _SLOTS + 2 * k for k, name in enumerate(self.names)}
        self._bound: dict[str, tuple[int, int]] = {}  # limits that time has reached, and when [ns] by this machine's clock
        self._granted_ns = machine()

    @classmethod
    def create(
        cls,
        path: Path,
        names: Sequence[str],
        machine: Callable[[], int] = time.monotonic_ns,
        starting: Sequence[str] = (),
        before_ready_ns: int = 0,
    ) -> "SimulatedTime":
        """Make the file of a run.

        Its time starts at this machine's time, and stands still until the first grant.

        Args:
            path: Path of the file.
            names: Services that may set limits.
            machine: Monotonic clock of this machine [ns].
            starting: Services that call `ready` once they are.
            before_ready_ns: [ns] of simulated time that pass at full speed before all of them are ready.

        Raises:
            ValueError: There are too many names, or one is too long.
        """
        names = [*names, *(_START + name for name in starting)]
        encoded = [name.encode() for name in names]
        if len(names) > _MAX_NAMES or any(len(name) > _NAME_BYTES for name in encoded):
            raise ValueError(f"at most {_MAX_NAMES} names of at most {_NAME_BYTES} bytes expected, found {names}")
        now = machine()
        words = [0, *(now, now, now) * 2, *(_NO_LIMIT, 0) * _MAX_NAMES]
        for k in range(len(names) - len(starting), len(names)):
            words[_SLOTS + 2 * k] = now + before_ready_ns
        head = struct.pack(f"={_WORDS}q", *words)
        path.write_bytes(
            head + b"".join(name.ljust(_NAME_BYTES, b"\0") for name in encoded).ljust(_NAME_BYTES * _MAX_NAMES, b"\0")
        )
        return cls(path, machine)

    def __call__(self) -> int:
        """Return the simulated time [ns]."""
        while True:
            count = self._words[_COUNT]
            machine_ns, simulated_ns, limit_ns = self._record(count)
            if self._words[_COUNT] == count:
                return min(simulated_ns + self._machine() - machine_ns, limit_ns)

    def grant(self) -> int:
        """Advance time by at most one span, up to the lowest limit.

        Only the simulator calls this.

        Returns:
            The simulated time [ns].
        """
        count, machine_ns = self._words[_COUNT], self._machine()
        then_ns, simulated_ns, granted_ns = self._record(count)
        now_ns = min(simulated_ns + machine_ns - then_ns, granted_ns)
        limit_ns = now_ns + SPAN_NS
        for name, word in self._index.items():
            stated_ns = self._words[word]
            if stated_ns >= limit_ns or self._has_waited(name, stated_ns, machine_ns):
                continue
            if name.startswith(_START):
                limit_ns = min(limit_ns, max(stated_ns, now_ns + (machine_ns - self._granted_ns) // _START_SLOWER))
                continue
            if stated_ns <= now_ns:
                self._words[word + 1] += machine_ns - self._granted_ns
            limit_ns = max(stated_ns, now_ns)
        self._granted_ns = machine_ns
        limit_ns = max(limit_ns, granted_ns)  # a grant is never withdrawn, so that time is monotonic
        for word, value in enumerate((machine_ns, now_ns, limit_ns), _RECORDS + _RECORD * (count + 1 & 1)):
            self._words[word] = value
        self._words[_COUNT] = count + 1
        return now_ns

    def hold(self, name: str, limit_ns: int | None) -> None:
        """Set the limit of a service: the time [ns] up to which simulated time may run.

        None removes the limit.
        """
        word = self._index.get(name)
        if word is not None:
            self._words[word] = _NO_LIMIT if limit_ns is None else limit_ns

    def limit(self, name: str) -> int:
        """Return the limit [ns] of a service, or a time that is never reached."""
        word = self._index.get(name)
        return _NO_LIMIT if word is None else int(self._words[word])

    def waited_s(self) -> dict[str, float]:
        """Return service -> real time [s] for which simulated time has waited for it."""
        return {name: self._words[word + 1] * 1e-9 for name, word in self._index.items()}

    def _record(self, count: int) -> tuple[int, int, int]:
        """Return machine time, simulated time and limit [ns] of a grant."""
        first = _RECORDS + _RECORD * (count & 1)
        return self._words[first], self._words[first + 1], self._words[first + 2]

    def _has_waited(self, name: str, stated_ns: int, machine_ns: int) -> bool:
        """Return whether time has waited at a limit for as long as it may."""
        met_ns, since_ns = self._bound.get(name, (-1, 0))
        if met_ns != stated_ns:
            self._bound[name] = stated_ns, machine_ns
            return False
        return machine_ns - since_ns >= (_START_PATIENCE_NS if name.startswith(_START) else _PATIENCE_NS)


def hold(name: str, limit_ns: int | None) -> None:
    """Set the limit [ns] of a service if this process uses simulated time.

    Otherwise do nothing.
    """
    time_in_use = in_use()
    if isinstance(time_in_use, SimulatedTime):
        time_in_use.hold(name, limit_ns)


def ready(name: str) -> None:
    """Tell simulated time, if this process uses it, that a service is ready."""
    hold(_START + name, None)


def limit_of(name: str) -> int:
    """Return the limit [ns] of a service if this process uses simulated time, else a time that is never reached."""
    time_in_use = in_use()
    return time_in_use.limit(name) if isinstance(time_in_use, SimulatedTime) else _NO_LIMIT
