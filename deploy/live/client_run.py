"""Run of a client of the robot in a terminal."""

import threading
from collections.abc import Callable
from typing import Protocol

from sextant.deploy.terminal.interrupts import Interrupts
from sextant.shared.runtime.service import Service
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Message
from sextant.shared.wire.transport import Endpoints, ZenohLink

_LOOK_S = 0.05


class Client(Service, Protocol):
    """A service that leads the robot until it is finished."""

    finished: bool

    def withdraw(self) -> tuple[Message, ...]:
        """Return the messages that end its order."""
        ...


def run_client(client: Client, endpoints: Endpoints, tell: Callable[[str], None]) -> tuple[Message, ...] | None:
    """Run a client until it is finished, or the operator interrupts.

    Args:
        client: The client.
        endpoints: Of the robot.
        tell: Receives each new status.

    Returns:
        None when it is finished; after an interruption, the messages that ended its order.

    Raises:
        Exception: The client failed; its order has ended.
    """
    stop, told = threading.Event(), ""
    failures: list[Exception] = []
    with Interrupts() as interrupts, ZenohLink(endpoints) as link:

        def run() -> None:
            try:
                run_live(client, link, stop, role=endpoints.role)
            except Exception as error:  # noqa: BLE001 - it is raised again below
                failures.append(error)

        running = threading.Thread(target=run, name=client.name)
        running.start()
        try:
            while not client.finished and not failures and not interrupts.asked():
                if client.status() != told:
                    told = client.status()
                    tell(told)
                stop.wait(_LOOK_S)
        finally:
            stop.set()
            running.join()
        if client.finished:
            return None
        withdrawn = client.withdraw()
        for message in withdrawn:
            link.send(topics.OF_TYPE[type(message)], codec.encode(message))
        if failures:
            raise failures[0]
        return withdrawn
