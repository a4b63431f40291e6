"""That torque is to be off, as a file with the time of that order, which outlives the processes it was given to."""

import os
import re
import tempfile
from contextlib import suppress
from pathlib import Path

AHEAD_NS = 500_000_000  # [ns] by which the time at which an order was given may be ahead of now, as clocks are read


class Latch:
    """One robot's latch. It is set by whoever hears the order, and taken off by an order to turn torque on alone."""

    def __init__(self, path: Path):
        """Keep it in a file."""
        self.path = path

    @classmethod
    def of_port(cls, port: str) -> "Latch":
        """The latch of the robot behind a servo port; it lasts until the machine is switched off."""
        folder = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir())
        return cls(folder / f"sextant-{os.getuid()}-off-{re.sub(r'[^A-Za-z0-9]+', '-', port).strip('-')}")

    @property
    def closed(self) -> bool:
        """Whether torque is to be off."""
        return self.path.exists()

    @property
    def since_ns(self) -> int:
        """[ns] by the robot's clock when that was ordered; 0 where nobody knows, or it is open.

        One that has outlived the machine's last start tells of another clock, maybe of a time to come.
        """
        return _time_in(self.path)

    def close(self, at_ns: int = 0) -> None:
        """Set it, for an order of that time [ns]; a newer one that is there stays.

        Raises:
            OSError: It cannot be set, and is not.
        """
        if self.path.exists() and self.since_ns >= at_ns:
            return
        written = self._beside("new")
        try:
            written.write_text(str(at_ns))
            written.replace(self.path)
        except OSError:
            with suppress(OSError):
                written.unlink(missing_ok=True)
            if not self.path.exists():
                self.path.touch()  # a disk that is full has room for a name

    def open(self, given_ns: int | None = None, now_ns: int = 0) -> bool:
        """Take it off; by an order that was given at a time [ns] not where torque was ordered off since, by now [ns].

        It is taken away before it is looked at: whoever closes it meanwhile does not lose that order.

        Returns:
            Whether it was taken off, or there was none.
        """
        if not self.path.exists():
            return True
        if given_ns is not None and given_ns < self.since_ns <= now_ns:
            return False
        taken = self._beside("taken")
        try:
            self.path.replace(taken)
        except FileNotFoundError:
            return True
        newer = given_ns is not None and given_ns < _time_in(taken) <= now_ns
        try:
            if newer:
                self.close(_time_in(taken))
            taken.unlink()
        except OSError:
            taken.replace(self.path)
            raise
        return not newer

    def _beside(self, what: str) -> Path:
        return self.path.with_name(f"{self.path.name}.{what}-{os.getpid()}")


def _time_in(path: Path) -> int:
    try:
        text = path.read_bytes()
    except OSError:
        return 0
    return int(text) if text.isdigit() else 0
