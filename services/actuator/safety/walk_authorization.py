"""Walk order in force, in a file: a restarted actuator resumes only this order."""

import os
from contextlib import suppress
from pathlib import Path
from secrets import token_hex

from sextant.services.actuator.safety.command_ordering import WalkOrder
from sextant.services.actuator.safety.torque_off_latch import FOLDERS, name_of

_MAX_FILE_BYTES = 4096  # [B] read from a file at most


class WalkAuthorization:
    """Store of the walk order in force, which outlives the process."""

    def __init__(self, path: Path | None = None):
        """Keep the order in a file; without one, only in this object."""
        self.trouble = ""  # why a restart would resume an order that has ended
        self._path = path
        self._order = None if path is None else _order_in(path)

    @classmethod
    def of_port(cls, port: str) -> "WalkAuthorization":
        """Return the store of the robot behind a servo port.

        It lasts until the machine is switched off.
        """
        usable = [folder for folder in FOLDERS if os.access(folder, os.W_OK | os.X_OK)]
        return cls(usable[0] / f"sextant-walk-{name_of(port)}" if usable else None)

    @property
    def order(self) -> WalkOrder | None:
        """The walk order in force."""
        return self._order

    def keep(self, order: WalkOrder | None) -> None:
        """Store this order for a restart and no other; store none if it cannot be written."""
        if order == self._order and not self.trouble:
            return
        self._order, self.trouble = order, ""
        if self._path is None:
            return
        if order is not None:
            written = self._path.with_name(f"{self._path.name}.new-{token_hex(4)}")
            try:
                written.write_text(f"{order.sequence} {order.holder}", encoding="utf-8")
                written.replace(self._path)
            except OSError:
                with suppress(OSError):
                    written.unlink(missing_ok=True)
            else:
                return
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            self.trouble = f"a restarted actuator would resume an ended walk, its order cannot be deleted: {error}"


def _order_in(path: Path) -> WalkOrder | None:
    """Return the order in a file; None if the file is not a valid one."""
    try:
        with path.open("rb") as file:
            sequence, _, holder = file.read(_MAX_FILE_BYTES).decode("utf-8").partition(" ")
    except (OSError, UnicodeDecodeError):
        return None
    return WalkOrder(holder, int(sequence)) if sequence.isascii() and sequence.isdigit() and holder else None
