"""That torque is to be off, as a file: an order that outlives the processes it was given to."""

import os
import re
import tempfile
from pathlib import Path


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

    def close(self) -> None:
        """Set it."""
        self.path.touch()

    def open(self) -> None:
        """Take it off."""
        self.path.unlink(missing_ok=True)
