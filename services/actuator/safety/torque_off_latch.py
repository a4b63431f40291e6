"""Torque-off latch: a file that outlives the processes that received the order.

The file contains the time of the order.
"""

import hashlib
import os
import re
from contextlib import suppress
from errno import ENOENT
from pathlib import Path
from secrets import token_hex

from sextant.shared.servo.bus_ports import all_ports

# Folders that all processes of one robot share, for any user and any way of starting: that of an installation
# (systemd units, containers), and one that exists on every machine.
SHARED = Path("/run/sextant")
FOLDERS = (SHARED, Path("/tmp"))
_DEVICES = Path("/dev")
_LINKS = ("", "serial/by-id", "serial/by-path")  # folders in /dev in which udev creates further device names
_MAX_NAME_LENGTH = 100  # characters after which a port name is truncated


class Latch:
    """Torque-off latch of one robot.

    Any receiver of the order closes it; only a torque-on order opens it.
    """

    def __init__(self, *paths: Path):
        """Use these files, one per existing folder; any of them closes the latch."""
        self.paths = paths
        self._names: list[str] = []  # names of the port, if the latch belongs to a port

    @classmethod
    def of_port(cls, port: str) -> "Latch":
        """Return the latch of the robot behind a servo port.

        The port may have several names, separated by commas; a robot with several buses has the names of each.

        It lasts until the machine is switched off.
        """
        latch = cls()
        latch._names = all_ports(port)
        latch._look_for_names()
        return latch

    @property
    def closed(self) -> bool:
        """Whether torque must be off.

        Raises:
            OSError: No file was found, and one could not be examined.
        """
        trouble: OSError | None = None
        for path in self.paths:
            try:
                if _is_there(path):
                    return True
            except OSError as error:
                trouble = error
        if trouble is not None:
            raise trouble
        return False

    @property
    def since_ns(self) -> int:
        """[ns] time of the order by the robot's clock; 0 if unknown or open.

        After a reboot the time is from another clock and may be in the future.
        """
        times = [_time_in(path) for path in self.paths if _may_be_there(path)]
        return max(times) if times and min(times) > 0 else 0

    def close(self, at_ns: int = 0) -> None:
        """Close the latch for an order of a given time [ns]; a newer one stays.

        Raises:
            OSError: No file could be written; the latch is not closed.
        """
        self._look_for_names()
        trouble: OSError = FileNotFoundError(ENOENT, os.strerror(ENOENT), str(self.paths[0].parent))
        kept = False
        for path in self.paths:
            try:
                kept = _close(path, at_ns) or kept
            except OSError as error:
                trouble = error
        if not kept:
            raise trouble

    def open(self, given_ns: int | None = None, now_ns: int = 0) -> bool:
        """Open the latch, unless torque was ordered off after the given order.

        The order was given at `given_ns` [ns]; the time is now `now_ns` [ns].

        Each file is removed before it is examined, so that a latch closed meanwhile is not lost.

        Returns:
            Whether it was opened, or was not closed.

        Raises:
            OSError: It cannot be opened, and stays closed.
        """
        self._look_for_names()
        there = [path for path in self.paths if _is_there(path)]
        if given_ns is not None and any(given_ns < _time_in(path) <= now_ns for path in there):
            return False
        return all(self._take_off(path, given_ns, now_ns) for path in there)

    def _look_for_names(self) -> None:
        """Update the file names; an adapter may appear later or under another name."""
        if self._names:
            self._names = list(dict.fromkeys(name for known in self._names for name in _names(known)))
            self.paths = tuple(folder / f"sextant-off-{name_of(name)}" for name in self._names for folder in FOLDERS)

    def _take_off(self, path: Path, given_ns: int | None, now_ns: int) -> bool:
        taken = _beside(path, "taken")
        try:
            path.replace(taken)
        except FileNotFoundError:
            return True
        newer = given_ns is not None and given_ns < _time_in(taken) <= now_ns
        try:
            if newer:
                self.close(_time_in(taken))
            taken.unlink()
        except OSError:
            taken.replace(path)
            raise
        return not newer


def name_of(port: str) -> str:
    """Return the file name part of a port.

    A device is shared by the machine, another port belongs to a user.
    """
    words = re.sub(r"[^A-Za-z0-9]+", "-", port).strip("-")
    if len(words) > _MAX_NAME_LENGTH:
        words = f"{words[:_MAX_NAME_LENGTH]}-{hashlib.blake2s(port.encode(), digest_size=8).hexdigest()}"
    return words if Path(port).is_absolute() else f"{os.getuid()}-{words}"


def _names(port: str) -> list[str]:
    """Return all paths of a port.

    These are udev links to one device; they stay when the device is renamed.
    """
    if "://" in port or "\0" in port:
        return [port]
    device = os.path.realpath(port)
    links = [path for folder in _LINKS for path in (_DEVICES / folder).glob("*") if path.is_symlink()]
    return list(dict.fromkeys((port, device, *(str(link) for link in links if os.path.realpath(link) == device))))


def _close(path: Path, at_ns: int) -> bool:
    """Write one file; return whether its folder exists."""
    if not path.parent.is_dir():
        return False
    if _is_there(path) and _time_in(path) >= at_ns:
        return True
    written = _beside(path, "new")
    try:
        written.write_text(str(at_ns))
        written.replace(path)
    except OSError:
        with suppress(OSError):
            written.unlink(missing_ok=True)
        if not _is_there(path):
            path.touch()  # works even on a full disk
    return True


def _beside(path: Path, what: str) -> Path:
    return path.with_name(f"{path.name}.{what}-{token_hex(4)}")


def _is_there(path: Path) -> bool:
    """Return whether a file exists; raise OSError if unknown.

    `Path.exists` returns False for some unknown cases.
    """
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _may_be_there(path: Path) -> bool:
    try:
        return _is_there(path)
    except OSError:
        return False


def _time_in(path: Path) -> int:
    try:
        text = path.read_bytes()
    except OSError:
        return 0
    return int(text) if text.isdigit() and len(text) < 20 else 0
