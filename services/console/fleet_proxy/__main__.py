"""Run the fleet proxy: `python -m sextant.services.console.fleet_proxy --set robots.alpha=8101 --set robots.beta=8102`."""

import argparse
import asyncio
import logging
import os
import signal
import sys
import time
from collections.abc import Sequence

from sextant.services.console.fleet_proxy.config import Settings
from sextant.services.console.fleet_proxy.proxy import HEAD_BYTES, FleetProxy
from sextant.shared.runtime.process import load_settings
from sextant.shared.runtime.shutdown import end_with
from sextant.shared.runtime.watchdog import Watchdog

_BEAT_S = 0.25  # [s] period of the watchdog heartbeat


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until a signal arrives.

    Returns:
        Exit status: 0 after a signal, 1 if the address is not available, 2 for invalid settings.
    """
    parser = argparse.ArgumentParser(
        prog="python -m sextant.services.console.fleet_proxy", description="Serve the pages of several consoles at one address."
    )
    parser.add_argument("--config", help="TOML file with settings")
    words = "value of a setting, repeatable; settings: host, port, token, robots"
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=words)
    parser.add_argument("--nice", type=int, default=0, help="niceness of the process, 0 to 19 (default 0)")
    parser.add_argument("--parent", type=int, help="id of the parent process; end when it ends")
    arguments = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="fleet_proxy: %(message)s")
    if arguments.parent:
        end_with(arguments.parent)
    os.nice(arguments.nice)
    try:
        settings = load_settings(Settings, arguments.config, arguments.set)
    except ValueError as error:
        logging.error("%s", error)
        return 2
    try:
        asyncio.run(_serve(settings))
    except OSError as error:
        words = f"the pages cannot be served on {settings.host} port {settings.port}: {error.strerror or error}"
        logging.error("%s; is another console running? choose another port with --set port=8081", words)
        return 1
    return 0


async def _serve(settings: Settings) -> None:
    over = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, over.set)
    front = FleetProxy(settings)
    server = await asyncio.start_server(front.meet, settings.host, settings.port, limit=HEAD_BYTES)
    with Watchdog(os.environ) as watchdog:
        while not over.is_set():
            watchdog.beat(time.monotonic_ns())
            try:
                await asyncio.wait_for(over.wait(), _BEAT_S)
            except TimeoutError:
                continue
    server.close()  # open connections end with this process


if __name__ == "__main__":
    sys.exit(main())
