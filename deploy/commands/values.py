"""Parsers of command-line values; their errors state what is expected."""

import argparse
import re
from collections.abc import Sequence

_SERVO_IDS = 254  # the next id is the broadcast id
_LARGEST = 2**53  # largest integer that every JSON reader represents exactly
_LONGEST_SEEDS = 40  # characters
_MOST_SEEDS = 1_000_000


def seeds(text: str) -> range:
    """Parse seeds A:B, B not included."""
    found = re.fullmatch(r"(\d+):(\d+)", text)
    if found is None or len(text) > _LONGEST_SEEDS or not int(found[1]) < int(found[2]) <= _LARGEST:
        raise argparse.ArgumentTypeError(f"A:B with A < B expected, B not included, found {text[:60]!r}; for example 0:50")
    if int(found[2]) - int(found[1]) > _MOST_SEEDS:
        raise argparse.ArgumentTypeError(f"at most {_MOST_SEEDS} seeds expected, found {text[:60]!r}; for example 0:50")
    return range(int(found[1]), int(found[2]))


def servo_ids(text: str) -> range:
    """Parse servo ids A:B, B not included."""
    found = seeds(text)
    if found.stop > _SERVO_IDS:
        raise argparse.ArgumentTypeError(f"ids of servos expected, 0 to {_SERVO_IDS - 1}, found {text!r}; for example 1:19")
    return found


def any_seeds(text: str) -> Sequence[int]:
    """Parse seeds A:B, or commit:N for N seeds derived from the commit."""
    drawn = re.fullmatch(r"commit:([1-9]\d*)", text)
    if drawn is None:
        return seeds(text)
    from sextant.deploy.provenance import seeds_of_commit

    try:
        return seeds_of_commit(int(drawn[1]))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def natural(text: str) -> int:
    """Parse an integer of at least 0."""
    return _whole(text, 0, _LARGEST)


def positive(text: str) -> int:
    """Parse an integer of at least 1."""
    return _whole(text, 1, _LARGEST)


def port(text: str) -> int:
    """Parse a TCP port; 0 for any free one."""
    return _whole(text, 0, 65535)


def processes(text: str) -> int:
    """Parse a number of parallel processes."""
    return _whole(text, 1, 256)


def angle(text: str) -> float:
    """Parse an angle [deg]."""
    return _number(text, -180.0, 180.0, "degrees")


def _whole(text: str, lowest: int, highest: int) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) < 20 and lowest <= int(text) <= highest):
        bounds = f"at least {lowest}" if highest == _LARGEST else f"{lowest} to {highest}"
        raise argparse.ArgumentTypeError(f"a whole number of {bounds} expected, found {text[:60]!r}")
    return int(text)


def minutes(text: str) -> float:
    """Parse a time [min]."""
    try:
        found = float(text)
    except ValueError:
        found = 0.0
    if not 0.5 <= found <= 1440.0:
        raise argparse.ArgumentTypeError(f"minutes from 0.5 to 1440 expected, found {text!r}")
    return found


def seconds(text: str) -> float:
    """Parse a time [s]."""
    try:
        found = float(text)
    except ValueError:
        found = 0.0
    if not 0.0 < found <= 86400.0:
        raise argparse.ArgumentTypeError(f"seconds above 0 and up to 86400 expected, found {text!r}")
    return found


def _number(text: str, lowest: float, highest: float, what: str) -> float:
    try:
        found = float(text)
    except ValueError:
        found = float("nan")
    if not lowest <= found <= highest:
        raise argparse.ArgumentTypeError(f"{what} from {lowest:g} to {highest:g} expected, found {text!r}")
    return found


def longest_cut(text: str) -> float:
    """Parse the longest outage [s] of a radio."""
    return _number(text, 0.1, 600.0, "seconds")


def times(text: str) -> float:
    """Parse a speed factor [1]."""
    return _number(text, 0.05, 100.0, "a number")


def rate(text: str) -> float:
    """Parse a frame rate [Hz]."""
    return _number(text, 1.0, 120.0, "frames per second")


def instant(text: str) -> float:
    """Parse a time [s] from the beginning."""
    return _number(text, 0.0, 1e6, "seconds")


def size(text: str) -> tuple[int, int]:
    """Parse width and height [px] of a picture that can be encoded."""
    found = re.fullmatch(r"(\d{2,4})x(\d{2,4})", text)
    width, height = (int(found[1]), int(found[2])) if found else (0, 0)
    if not (64 <= width <= 3840 and 64 <= height <= 2160) or width % 2 or height % 2:
        raise argparse.ArgumentTypeError(f"WxH expected, even and 64x64 to 3840x2160, found {text!r}; for example 960x540")
    return width, height


def frames(text: str) -> int:
    """Parse a number of depth frames."""
    return _whole(text, 3, 100_000)
