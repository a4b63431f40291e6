"""The order to walk that the robot is under, as a file: an actuator that begins anew walks on by that one alone."""

import os
from contextlib import suppress
from pathlib import Path
from secrets import token_hex

from sextant.services.actuator.safety.command_ordering import WalkOrder
from sextant.services.actuator.safety.torque_off_latch import FOLDERS, name_of

_LONGEST = 4096  # [B] of a file that is looked at


class Permit:
    """What outlives the process of the order that is in force; nothing once it has ended, for whatever reason."""

    def __init__(self, path: Path | None = None):
        """Keep it in a file; without one this object alone remembers it."""
        self.trouble = ""  # why a restart would walk on by an order that has ended, in words
        self._path = path
        self._order = None if path is None else _order_in(path)

    @classmethod
    def of_port(cls, port: str) -> "Permit":
        """That of the robot behind a servo port; it lasts until the machine is switched off."""
        usable = [folder for folder in FOLDERS if os.access(folder, os.W_OK | os.X_OK)]
        return cls(usable[0] / f"sextant-walk-{name_of(port)}" if usable else None)

    @property
    def order(self) -> WalkOrder | None:
        """The order that is in force."""
        return self._order

    def keep(self, order: WalkOrder | None) -> None:
        """Have a restart know of this order and no other; of none, where it cannot be kept."""
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
            self.trouble = f"a restarted actuator would walk on by an order that has ended: {error}"


def _order_in(path: Path) -> WalkOrder | None:
    """The order that a file tells of; nothing where it is not one of ours."""
    try:
        with path.open("rb") as file:
            sequence, _, holder = file.read(_LONGEST).decode("utf-8").partition(" ")
    except (OSError, UnicodeDecodeError):
        return None
    return WalkOrder(holder, int(sequence)) if sequence.isascii() and sequence.isdigit() and holder else None
