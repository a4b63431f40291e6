"""Bus sniffer process between the host and the servo bus.

It forwards bytes in both directions, and logs what the host sent and when.

python -m benchmarks.faults.bus_sniffer --listen 21000 --servos 22000

Each event is a line on stdout: `open NS` if a host has connected, `sent NS HEX` for bytes sent to the servos; NS is the
machine's monotonic clock [ns].
"""

import argparse
import select
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

from sextant.deploy.launch.process_table import ENVIRONMENT, Command
from sextant.shared.runtime.process_priority import go_first
from sextant.shared.runtime.shutdown import end_with

_CHUNK = 4096  # [bytes]
_HOST = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class Opened:
    """A host has opened the port."""

    at_ns: int

    def __str__(self) -> str:
        return f"open {self.at_ns}"


@dataclass(frozen=True, slots=True)
class Sent:
    """A host's bytes were sent to the servos."""

    at_ns: int
    data: bytes

    def __str__(self) -> str:
        return f"sent {self.at_ns} {self.data.hex()}"


def command(listen: int, servos: int) -> Command:
    """Return the command of a sniffer between the host's port and the servos' port."""
    words = ("-m", "benchmarks.faults.bus_sniffer", "--listen", str(listen), "--servos", str(servos))
    return Command("tap", words, ENVIRONMENT, ready_port=listen)


def understood(line: str) -> Opened | Sent:
    """Parse an output line of the sniffer.

    Raises:
        ValueError: It is invalid.
    """
    match line.split():
        case ["open", at_ns]:
            return Opened(int(at_ns))
        case ["sent", at_ns, data]:
            return Sent(int(at_ns), bytes.fromhex(data))
    raise ValueError(
        f"`open NS` or `sent NS HEX` expected of a tap, found {line[:60]!r}; run `python -m benchmarks.faults.bus_sniffer`"
    )


def serve(listener: socket.socket, servos: int, say: Callable[[Opened | Sent], object]) -> None:
    """Forward between the servos and one host after another.

    Each host gets a new connection to the servos. The function returns when the listener closes.
    """
    while True:
        try:
            host, _ = listener.accept()
        except OSError:  # closed
            return
        say(Opened(time.monotonic_ns()))
        with host:
            try:
                with socket.create_connection((_HOST, servos)) as bus:
                    _pass_on(host, bus, say)
            except OSError:  # one side closed without notice; so does this process
                continue


def _pass_on(host: socket.socket, bus: socket.socket, say: Callable[[Opened | Sent], object]) -> None:
    for end in (host, bus):
        end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    while True:
        ready, _, _ = select.select([host, bus], [], [])
        for end in ready:
            data = end.recv(_CHUNK)
            if not data:
                return
            if end is bus:
                host.sendall(data)
            else:
                bus.sendall(data)
                say(Sent(time.monotonic_ns(), data))


def main() -> int:
    """Serve until the process is terminated."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.faults.bus_sniffer", description=__doc__)
    parser.add_argument("--listen", type=int, required=True, help="TCP port of 127.0.0.1 to listen on for the host")
    parser.add_argument("--servos", type=int, required=True, help="TCP port of the servo bus on 127.0.0.1")
    parser.add_argument("--parent", type=int, help="id of the parent process; this process ends with it")
    arguments = parser.parse_args()
    if arguments.parent:
        end_with(arguments.parent)
    go_first()  # high priority: a real wire adds no delay

    def say(word: Opened | Sent) -> None:
        sys.stdout.write(f"{word}\n")
        sys.stdout.flush()

    with socket.create_server((_HOST, arguments.listen)) as listener:
        serve(listener, arguments.servos, say)
    return 0


if __name__ == "__main__":
    sys.exit(main())
