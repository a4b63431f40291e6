"""Setup of a bus: all servos of the robot are there, are of the right type, and answer without delay."""

from typing import Protocol

from sextant.services.actuator.servo_bus import bus_scan
from sextant.services.actuator.servo_bus.bus_scan import BusResponse, Problem, ServoScan


class BusSetupError(ConnectionError):
    """The bus lacks servos that the robot needs; the message names the remedy."""


class BoardSilentError(BusSetupError):
    """The board between port and servos does not answer: another device may be on the port."""


class Bus(bus_scan.Bus, Protocol):
    """Part of `ServoBus` that is used here."""

    names: dict[int, str]

    @property
    def is_clean(self) -> bool:
        """Whether all requests so far were answered, with no other bytes."""

    def echo_problem(self) -> Problem | None:
        """Return the problem of an adapter whose echo is not as set, or None."""


def set_up(bus: Bus, lock: bool) -> dict[int, ServoScan]:
    """Check presence, uniqueness and type of all servos of a bus, and configure fast answers; return their scan.

    Registers of the EEPROM are written only where they differ; `lock` tells whether to lock it. Torque and limits stay.

    Raises:
        BusSetupError: Servos are missing, doubled, of another model, in wheel mode or refuse; all are named.
        BusDisconnectedError: The port is gone.
    """
    names = bus.names
    seen = bus_scan.call(bus, names)
    if (not bus.is_clean or len(seen) < len(names)) and (echo := bus.echo_problem()):
        raise BusSetupError(": ".join(echo))
    for i, mute in [(i, found) for i, found in seen.items() if found.response is BusResponse.MUTE]:
        seen[i] = bus_scan.wake(bus, i) or mute
    if not seen:
        raise BusSetupError(
            f"none of the {len(names)} servos answers; check their power, the adapter and the baud rate, "
            f"then try `sextant servos scan`"
        )
    wrong = bus_scan.problems(names, seen)
    for i in names.keys() - wrong.keys():
        if words := bus_scan.prepare(bus, seen[i], lock):
            wrong[i] = Problem(f"{bus_scan.named(i, names)} {words}", "")
    if wrong:
        words = "; ".join(dict.fromkeys(problem.words for problem in wrong.values()))
        raise BusSetupError(
            f"{len(wrong.keys() & names.keys())} of {len(names)} servos are not ready: {words}; "
            f"`sextant servos scan` says what to do"
        )
    return seen
