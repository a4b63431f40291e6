"""Zenoh router as a separate process, where no launcher hosts it.

Run with `python -m sextant.deploy.launch.router`.
"""

import argparse
import contextlib
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from itertools import count
from types import FrameType

from sextant.deploy.launch.peer_handshake import PeerHandshake
from sextant.deploy.launch.process_table import ROUTER_ENDPOINT
from sextant.deploy.security import router_security
from sextant.deploy.security.connect_probe import ConnectProbe
from sextant.deploy.security.hosting import hosted
from sextant.deploy.security.router_health import RefusedConnections, RouterHealthReporter, link_to, publish
from sextant.deploy.security.tcp_timeout import TcpTimeout
from sextant.deploy.terminal.interrupts import Interrupts
from sextant.evaluation.provenance import version
from sextant.shared.runtime.process_priority import allow_many_files, switch_often
from sextant.shared.runtime.shutdown import bound_the_end, end_with, leave, leave_at_errors, leave_at_errors_of_threads
from sextant.shared.runtime.watchdog import Watchdog
from sextant.shared.wire.access import AccessError
from sextant.shared.wire.ports import NoFreePortError
from sextant.shared.wire.transport import GIVEN_UP_S, LEASE_MS, TransportError, ZenohLink

_WARN_S = 30.0  # [s] between two warnings that it is open to any client
_LOOK_S = 0.1
_STOPPED = 75  # exit status when its links have expired: EX_TEMPFAIL of sysexits(3)
_SILENCE_TURNS = 5  # polls between two checks for new connections


def main(argv: Sequence[str] | None = None) -> int:
    """Host the router until it is stopped.

    Returns:
        0 when stopped; 2 if it cannot listen on the address, or its access rules are missing or wrong. It exits with 75,
        without returning, if it was suspended for longer than its links last, so that another one replaces it.
    """
    parser = argparse.ArgumentParser(prog="python -m sextant.deploy.launch.router", description="Zenoh router of the services.")
    words = f"endpoint to listen on; repeatable (default {ROUTER_ENDPOINT}, with --keys also {router_security.SECURE_ENDPOINT})"
    parser.add_argument("--listen", action="append", default=[], help=words)
    words = "router of another machine to connect to; repeatable"
    parser.add_argument("--connect", action="append", default=[], help=words)
    parser.add_argument("--keys", metavar="DIR", help="folder with this machine's keys; clients then need certificates")
    parser.add_argument("--open", action="store_true", help="admit any client, without certificates")
    parser.add_argument("--namespace", default="sextant", help="prefix of every key (default %(default)s)")
    words = "publish this role of the machine, and report machines in conflict with it; `sextant up` sets this option"
    parser.add_argument("--role", default="", choices=("onboard", "offboard", "all", "sim"), help=words)
    parser.add_argument(
        "--starts", default="", metavar="NAMES", help="processes that this machine starts, published with --role"
    )
    parser.add_argument("--parent", type=int, help="id of the parent process; this process ends with it")
    arguments = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="router: %(message)s")
    if arguments.parent:
        end_with(arguments.parent)
    allow_many_files()
    switch_often()
    try:
        given, upstream = arguments.listen, tuple(arguments.connect)
        gated = router_security.of_arguments(
            given, arguments.keys, arguments.open, arguments.namespace, ROUTER_ENDPOINT, upstream
        )
        with Interrupts() as interrupts:
            _host(gated, arguments.role, [name for name in arguments.starts.split(",") if name], interrupts.asked)
    except (TransportError, NoFreePortError, AccessError) as error:
        logging.error("%s", error)
        return 2
    return 0


def _tell(words: str) -> None:
    logging.warning("%s", words)


def _host(gated: router_security.Gate, role: str, starts: Sequence[str], told_to_stop: Callable[[], bool]) -> None:
    """Host the router until it is stopped.

    With access control it logs refused connections; while it is open to any client it warns repeatedly. With a role it also
    connects to the machines of the other roles.
    """
    awake = _Awake()  # before any client can connect here
    with contextlib.ExitStack() as stack:
        beats: list[Callable[[], None]] = []
        machine_role = gated.role(offboard=role == "offboard" or (not role and bool(gated.upstream)))
        refused = RefusedConnections()
        router = stack.enter_context(hosted(gated, refused.add))
        if gated.guarded or role:
            link = stack.enter_context(link_to(gated.own, gated.namespace))
        if gated.guarded:
            stack.enter_context(ConnectProbe(gated.knock, lambda: router.chained, _tell))
            beats.append(_Guard(gated, refused, link, machine_role).beat)
        if role:
            machine = f"{socket.gethostname()}-{os.getpid()}"
            beats.append(PeerHandshake(link, machine, role, version(), starts, time.monotonic_ns, _tell, machine_role).beat)
        logging.info("listening on %s", ", ".join(gated.listen))
        silence = TcpTimeout(LEASE_MS * 1e-3)
        silence.look()
        watchdog = stack.enter_context(Watchdog(os.environ))
        for turn in count():
            watchdog.beat(awake.look())
            time.sleep(_LOOK_S)  # not sigtimedwait: a process that was stopped in it gets a signal that was never sent
            if told_to_stop():
                bound_the_end()
                break
            if turn % _SILENCE_TURNS == 0:
                silence.look()
            for beat in beats:
                beat()


class _Guard:
    """Logs refused connections, and warns while the router is open to any client."""

    def __init__(self, gated: router_security.Gate, refused: RefusedConnections, link: ZenohLink, role: str):
        self._warning, self._due_s = gated.warning(), 0.0
        doing = f"listening on {', '.join(gated.listen)}" + (f"; {self._warning}" if self._warning else "")
        self._health = RouterHealthReporter(refused, publish(link, role), gated.name, doing)

    def beat(self) -> None:
        """Do what is due."""
        if told := self._health.beat(time.monotonic_ns()):
            _tell(told)
        if self._warning and time.monotonic() >= self._due_s:
            _tell(self._warning)
            self._due_s = time.monotonic() + _WARN_S


class _Awake:
    """Ends this process if it was suspended for longer than its links last.

    It ends before it sends anything to clients that reconnect; see `sextant.shared.wire.transport.Router` for the reason.
    """

    def __init__(self) -> None:
        self._looked_ns = time.monotonic_ns()
        signal.signal(signal.SIGCONT, self._go_on)

    def look(self) -> int:
        """Record that the process is running; return the monotonic time [ns]."""
        self._looked_ns = time.monotonic_ns()
        return self._looked_ns

    def _go_on(self, _number: int, _frame: FrameType | None) -> None:
        away_s = (time.monotonic_ns() - self._looked_ns) * 1e-9
        if away_s > GIVEN_UP_S:
            os.write(2, f"router: suspended for {away_s:.1f} s, its clients have disconnected; exiting\n".encode())
            os._exit(_STOPPED)


if __name__ == "__main__":
    leave_at_errors()
    leave_at_errors_of_threads()
    leave(main())
