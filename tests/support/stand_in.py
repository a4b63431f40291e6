"""A small process that replaces a service in the launcher's tests.

python stand_in.py BEHAVIOUR [WORD ...] [--parent PID]
"""

import faulthandler
import os
import signal
import socket
import subprocess
import sys
import time
from types import FrameType


def main(words: list[str]) -> int:
    if "--parent" in words:
        at = words.index("--parent")
        end_with(int(words[at + 1]))
        del words[at : at + 2]
    behaviour, *rest = words
    return BEHAVIOURS[behaviour](*rest)


def end_with(parent: int) -> None:
    import ctypes

    ctypes.CDLL(None).prctl(1, signal.SIGTERM)
    if os.getppid() != parent:
        raise SystemExit(1)


def obedient() -> int:
    """End on SIGTERM."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    return ready_and_wait()


def counting() -> int:
    """Report the number of SIGTERMs, and end half a second after the first."""
    asked: list[int] = []
    signal.signal(signal.SIGTERM, lambda *_: asked.append(1))
    say(f"ready {os.getpid()}")
    while not asked:
        signal.pause()
    time.sleep(0.5)
    say(f"asked {len(asked)}")
    return 0


def stubborn() -> int:
    """Ignore SIGTERM."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return ready_and_wait()


def crash(message: str) -> int:
    """Fail with a traceback on SIGUSR1."""

    def fail(_number: int, _frame: FrameType | None) -> None:
        raise RuntimeError(message)

    signal.signal(signal.SIGUSR1, fail)
    return ready_and_wait()


def refuse(message: str) -> int:
    """Print an error of the caller, and end with status 2."""
    say(message)
    return 2


def listen(port: str) -> int:
    """Listen on a port after SIGUSR1."""
    opened = []
    signal.signal(signal.SIGUSR1, lambda *_: opened.append(socket.create_server(("127.0.0.1", int(port)))))
    return ready_and_wait()


def family() -> int:
    """Start a child process that ignores SIGTERM."""
    child = subprocess.Popen([sys.executable, __file__, "stubborn"])
    say(f"child {child.pid}")
    return ready_and_wait()


def beating() -> int:
    """Send watchdog pulses at 10 Hz, as a service's loop does, until SIGTERM."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    name = os.environ["NOTIFY_SOCKET"].replace("@", "\0", 1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as watcher:
        watcher.sendto(b"WATCHDOG=1", name)
        say(f"ready {os.getpid()}")
        while True:
            signal.sigtimedwait([], 0.1)
            watcher.sendto(b"WATCHDOG=1", name)


def hanging() -> int:
    """Send one watchdog pulse, then loop forever without another."""
    faulthandler.enable()
    name = os.environ["NOTIFY_SOCKET"].replace("@", "\0", 1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as watcher:
        watcher.sendto(b"WATCHDOG=1", name)
    say(f"ready {os.getpid()}")
    return round_in_circles()


def round_in_circles() -> int:
    while True:
        pass


def ready_and_wait() -> int:
    say(f"ready {os.getpid()}")
    while True:
        signal.pause()


def say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


BEHAVIOURS = {
    "obedient": obedient,
    "counting": counting,
    "stubborn": stubborn,
    "crash": crash,
    "refuse": refuse,
    "listen": listen,
    "family": family,
    "beating": beating,
    "hanging": hanging,
}

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
