"""`sextant order`: stand, walk, stop, sit or torque off from the terminal."""

import getpass
import os
import socket
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import INTERRUPTED, SUCCESS, CommandError, InputError, complain, say
from sextant.deploy.terminal.arguments import Choice, argument, command, flag, option

if TYPE_CHECKING:
    from sextant.deploy.live.send_command import Order, What
    from sextant.shared.wire.transport import Endpoints


@command()
@argument(
    "what",
    "off: torque off; stop: set the feet down; ready: torque on; stand: rise; walk: start the planner; sit: lie down",
    type=Choice(("off", "stop", "ready", "stand", "walk", "sit")),
)
@options.connection
@option(
    "--holder",
    "name of this client; one leads at a time, each needs its own name (default: USER at MACHINE)",
    "NAME",
    default="",
)
@flag("--take", "take the lease over from its holder")
def order(what: "What", connection: options.Connection, holder: str, take: bool) -> int:
    """Command a running robot: stand, walk, stop, sit, or torque off."""
    from sextant.deploy.live.send_command import STOPS, Order
    from sextant.shared.wire import topics
    from sextant.shared.wire.transport import TransportError

    endpoints = connection.endpoints()
    refused = endpoints.keys.refusal([topics.MODE]) if endpoints.keys is not None else ""
    if refused and what not in STOPS:
        raise InputError(refused)
    given = Order(what, holder or client_name(), take, leads=not refused)
    try:
        return _give(given, endpoints)
    except TransportError as error:
        if what != "off":
            raise
        raise TransportError(f"{error} On the robot, `sextant servos off --port PORT` needs no actuator.") from None


def client_name() -> str:
    """Return "USER at MACHINE" as holder of the lease."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # a container's user may have no name
        user = str(os.getuid())
    return f"{user} at {socket.gethostname()}"


def _give(given: "Order", endpoints: "Endpoints") -> int:
    """Send an order until it has a result, or the operator interrupts."""
    from sextant.deploy.live.client_run import run_client

    withdrawn = run_client(given, endpoints, say)
    if withdrawn is not None:
        complain(f"stopped by the operator{': the feet are set down' if withdrawn else ''}")
        return INTERRUPTED
    if given.failed:
        raise CommandError(f"the robot at {', '.join(endpoints.connect)}, namespace {endpoints.namespace}: {given.failed}")
    say(given.status())
    return SUCCESS
