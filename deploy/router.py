"""The Zenoh router as a process of its own, for deployments in which no launcher hosts it: python -m deploy.router."""

import argparse
import logging
import os
import signal
import sys
import time
from collections.abc import Sequence

from deploy import gate, refusals
from deploy.gatekeeper import CaughtOutput, Gatekeeper, link_to, publish
from deploy.knocking import Knocking
from deploy.process_table import ROUTER_ENDPOINT
from shared.access import AccessError
from shared.host import end_with
from shared.transport import Router, TransportError, log_to_stdout
from shared.watchdog import Watchdog

_ENDS = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP}
_WARN_S = 30.0  # between two warnings that it is open to anybody
_LOOK_S = 0.1


def main(argv: Sequence[str] | None = None) -> int:
    """Host the router until told to stop; 0 then, 2 when the address cannot be listened on or nobody should be let in."""
    parser = argparse.ArgumentParser(prog="python -m deploy.router", description="The router that the services meet at.")
    words = f"endpoint to listen on, as often as wanted (default {ROUTER_ENDPOINT}, with --keys also {gate.SECURE_ENDPOINT})"
    parser.add_argument("--listen", action="append", default=[], help=words)
    words = "router of another machine that this one is chained to, as often as wanted"
    parser.add_argument("--connect", action="append", default=[], help=words)
    parser.add_argument("--keys", metavar="DIR", help="let in by certificates: the folder with this machine's")
    parser.add_argument("--open", action="store_true", help="let anybody in")
    parser.add_argument("--namespace", default="sextant", help="prefix of every key (default %(default)s)")
    parser.add_argument("--parent", type=int, help="end when the process with this id, which started this one, has ended")
    arguments = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="router: %(message)s")
    if arguments.parent:
        end_with(arguments.parent)
    signal.pthread_sigmask(signal.SIG_BLOCK, _ENDS)  # before the router's threads, which inherit it
    try:
        given, upstream = arguments.listen, tuple(arguments.connect)
        gated = gate.of_arguments(given, arguments.keys, arguments.open, arguments.namespace, ROUTER_ENDPOINT, upstream)
        if gated.guarded:
            _guard(gated)
        else:
            with Router(gated.listen, gated.upstream):
                _listening(gated)
                signal.sigwait(_ENDS)
    except (TransportError, AccessError) as error:
        logging.error("%s", error)
        return 2
    return 0


def _tell(words: str) -> None:
    logging.warning("%s", words)


def _guard(gated: gate.Gate) -> None:
    """Host a router that may refuse somebody, say whom, and warn for as long as it refuses nobody."""
    configuration, warning, due_s = gated.configuration(), gated.warning(), 0.0
    doing = f"listening on {', '.join(gated.listen)}" + (f"; {warning}" if warning else "")
    with CaughtOutput() as caught:
        log_to_stdout(refusals.LEVELS)
        router = Router(gated.listen, gated.upstream, configuration)
        with router, link_to(gated.own, gated.namespace) as link, Knocking(gated.knock, lambda: router.chained, _tell):
            keeper = Gatekeeper(caught.take, publish(link), gated.name, gated.namespace, doing, sys.stderr)
            _listening(gated)
            while signal.sigtimedwait(_ENDS, _LOOK_S) is None:
                if told := keeper.look(time.monotonic_ns()):
                    logging.warning("%s", told)
                if warning and time.monotonic() >= due_s:
                    logging.warning("%s", warning)
                    due_s = time.monotonic() + _WARN_S


def _listening(gated: gate.Gate) -> None:
    """Say so, to people and to a service manager that starts others once this is ready."""
    logging.info("listening on %s", ", ".join(gated.listen))
    with Watchdog(os.environ) as watchdog:
        watchdog.beat(time.monotonic_ns())


if __name__ == "__main__":
    sys.exit(main())
