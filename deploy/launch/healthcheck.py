"""Health check of a process in its container.

Usage: python -m sextant.deploy.launch.healthcheck [--port N] [--end-hung]

A process sends signs of life to the socket that NOTIFY_SOCKET names, as under systemd (`shared/runtime/watchdog.py`). This
program listens there until one arrives. No other process is needed and no file can become stale: a sign comes from the loop
that does the work, at that moment. It imports nothing that takes long, because it runs often.
"""

import argparse
import contextlib
import os
import signal
import socket
import struct
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from sextant.shared.files import whole_files
from sextant.shared.wire.ports import port_taken

_CREDENTIALS = struct.Struct("3i")  # Linux' struct ucred: process, user, group
_PATIENCE_S = 5.0  # default if WATCHDOG_USEC is not set


def main(argv: Sequence[str] | None = None) -> int:
    """Run the health check; return 0, or 1 with the reason on stderr."""
    parser = argparse.ArgumentParser(
        prog="python -m sextant.deploy.launch.healthcheck", description="Check that a process gives signs of life."
    )
    parser.add_argument("--port", type=int, default=0, help="TCP port of 127.0.0.1 on which a process must listen")
    parser.add_argument("--end-hung", action="store_true", help="kill a process whose signs of life have stopped")
    arguments = parser.parse_args(argv)
    problem = f"no process listens on port {arguments.port}" if arguments.port and not port_taken(arguments.port) else ""
    if not problem and os.environ.get("NOTIFY_SOCKET"):
        problem = silence(os.environ, arguments.end_hung)
    if problem:
        sys.stderr.write(f"{problem}\n")
    return 1 if problem else 0


def silence(environment: Mapping[str, str], end_hung: bool = False) -> str:
    """Wait for a sign of life; return why none came, or an empty string.

    Args:
        environment: Environment of the process: NOTIFY_SOCKET, a path in a folder of this container, and WATCHDOG_USEC, how
            long to wait [us].
        end_hung: Whether to kill a process that was alive at an earlier call and is silent now. A process without a first sign
            is still starting, and is not killed.
    """
    path = Path(environment["NOTIFY_SOCKET"])
    patience_s = int(environment.get("WATCHDOG_USEC") or 0) * 1e-6 or _PATIENCE_S
    heard = path.with_name(f"{path.name}.heard")  # holds the id of the process that sent the last sign
    pid = _next_sign(path, patience_s)
    if pid:
        whole_files.write_text(heard, f"{pid}\n")
        return ""
    known = int(heard.read_text(encoding="ascii")) if heard.exists() else 0
    if not known:
        return f"no sign of life within {patience_s:g} s: still starting"
    ended = "; killed" if end_hung and _end(known, path) else ""
    return f"process {known} hangs: no sign of life within {patience_s:g} s{ended}"


def _next_sign(path: Path, within_s: float) -> int:
    """Return the id of the next process that sends a sign, or 0 at a timeout."""
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        path.unlink(missing_ok=True)  # left by an earlier call that was interrupted
        listener.bind(str(path))
        listener.settimeout(within_s)
        try:
            _, ancillary, _, _ = listener.recvmsg(4096, socket.CMSG_SPACE(_CREDENTIALS.size))
        except TimeoutError:
            return 0
        finally:
            path.unlink(missing_ok=True)
    return next((_CREDENTIALS.unpack(data)[0] for _, kind, data in ancillary if kind == socket.SCM_CREDENTIALS), 0)


def _end(pid: int, path: Path) -> bool:
    """Kill a process if its NOTIFY_SOCKET is still this path."""
    try:
        around = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:  # the process has ended
        return False
    if f"NOTIFY_SOCKET={path}".encode() not in around:
        return False
    os.kill(pid, signal.SIGKILL)
    return True


if __name__ == "__main__":
    sys.exit(main())
