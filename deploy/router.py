"""The Zenoh router as a process of its own, for deployments in which no launcher hosts it: python -m deploy.router."""

import argparse
import logging
import signal
import sys
from collections.abc import Sequence

from deploy.process_table import ROUTER_ENDPOINT
from shared.host import end_with
from shared.transport import Router, TransportError

_ENDS = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP}


def main(argv: Sequence[str] | None = None) -> int:
    """Host the router until told to stop; 0 then, 2 when the address cannot be listened on."""
    parser = argparse.ArgumentParser(prog="python -m deploy.router", description="The router that the services meet at.")
    parser.add_argument("--listen", action="append", help=f"endpoint to listen on (default {ROUTER_ENDPOINT})")
    parser.add_argument("--parent", type=int, help="end when the process with this id, which started this one, has ended")
    arguments = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="router: %(message)s")
    if arguments.parent:
        end_with(arguments.parent)
    signal.pthread_sigmask(signal.SIG_BLOCK, _ENDS)  # before the router's threads, which inherit it
    try:
        with Router(tuple(arguments.listen or (ROUTER_ENDPOINT,))):
            logging.info("listening on %s", ", ".join(arguments.listen or (ROUTER_ENDPOINT,)))
            signal.sigwait(_ENDS)
    except TransportError as error:
        logging.error("%s", error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
