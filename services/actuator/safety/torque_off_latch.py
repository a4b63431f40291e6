"""That torque is to be off, as a file with the time of that order, which outlives the processes it was given to."""

import hashlib
import os
import re
from contextlib import suppress
from errno import ENOENT
from pathlib import Path
from secrets import token_hex

# Where all who have to do with one robot look, whoever they are and however they were started: what an installation shares
# (systemd's units, containers), and what is there on every machine.
SHARED = Path("/run/sextant")
FOLDERS = (SHARED, Path("/tmp"))
_DEVICES = Path("/dev")
_LINKS = ("", "serial/by-id", "serial/by-path")  # folders there in which udev gives devices further names
_LONG = 100  # characters of a port's name from which it is cut


class Latch:
    """One robot's latch. It is set by whoever hears the order, and taken off by an order to turn torque on alone."""

    def __init__(self, *paths: Path):
        """Keep it in files, one in each folder that is there: it is closed where any of them is."""
        self.paths = paths
        self._names: list[str] = []  # of the port, where it is that of one

    @classmethod
    def of_port(cls, port: str) -> "Latch":
        """The latch of the robot behind a servo port, or several with commas between, by whatever name each is given.

        It lasts until the machine is switched off.
        """
        latch = cls()
        latch._names = [one.strip() for one in port.split(",")]
        latch._look_for_names()
        return latch

    @property
    def closed(self) -> bool:
        """Whether torque is to be off.

        Raises:
            OSError: No file says so, and one cannot be looked at.
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
        """[ns] by the robot's clock when that was ordered; 0 where nobody knows, or it is open.

        One that has outlived the machine's last start tells of another clock, maybe of a time to come.
        """
        times = [_time_in(path) for path in self.paths if _may_be_there(path)]
        return max(times) if times and min(times) > 0 else 0

    def close(self, at_ns: int = 0) -> None:
        """Set it, for an order of that time [ns]; a newer one that is there stays.

        Raises:
            OSError: It cannot be set anywhere, and is not.
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
        """Take it off; by an order that was given at a time [ns] not where torque was ordered off since, by now [ns].

        It is taken away before it is looked at: whoever closes it meanwhile does not lose that order.

        Returns:
            Whether it was taken off, or there was none.

        Raises:
            OSError: It cannot be taken off, and is not.
        """
        self._look_for_names()
        there = [path for path in self.paths if _is_there(path)]
        if given_ns is not None and any(given_ns < _time_in(path) <= now_ns for path in there):
            return False
        return all(self._take_off(path, given_ns, now_ns) for path in there)

    def _look_for_names(self) -> None:
        """An adapter may have been unplugged when this was made, or have come back under another name since."""
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
    """What files of a port are called; a device is one for the whole machine, another port belongs to a user."""
    words = re.sub(r"[^A-Za-z0-9]+", "-", port).strip("-")
    if len(words) > _LONG:
        words = f"{words[:_LONG]}-{hashlib.blake2s(port.encode(), digest_size=8).hexdigest()}"
    return words if Path(port).is_absolute() else f"{os.getuid()}-{words}"


def _names(port: str) -> list[str]:
    """The paths by which somebody may know a port: udev's are links to one device, and stay where the device is renamed."""
    if "://" in port or "\0" in port:
        return [port]
    device = os.path.realpath(port)
    links = [path for folder in _LINKS for path in (_DEVICES / folder).glob("*") if path.is_symlink()]
    return list(dict.fromkeys((port, device, *(str(link) for link in links if os.path.realpath(link) == device))))


def _close(path: Path, at_ns: int) -> bool:
    """Set one file; whether its folder is there."""
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
            path.touch()  # a disk that is full has room for a name
    return True


def _beside(path: Path, what: str) -> Path:
    return path.with_name(f"{path.name}.{what}-{token_hex(4)}")


def _is_there(path: Path) -> bool:
    """Whether a file is there, or an OSError where nobody can say; `Path.exists` says no to some of these."""
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
