"""Start of the firmware on a board, from its file main.py:

from firmware import main
main.run()
"""

import os
import select
import sys
import time

import machine

from . import board, config

_WATCHDOG_MS = 1000  # [ms] after which a board that hangs starts again; the servos keep their torque and goals


def run() -> None:
    """Run the bridge until the board is switched off."""
    clock = board.Clock(time.ticks_us, time.ticks_diff)  # type: ignore[attr-defined]
    bus, host = board.open_bus(machine, config), board.open_host(machine, config, _usb())
    firmware = board.start(config, int.from_bytes(os.urandom(4), "little"), clock.now_us())
    watchdog = machine.WDT(timeout=_WATCHDOG_MS)
    while True:
        board.turn(firmware, clock, host, bus)
        watchdog.feed()


def _usb() -> board.StreamPort:
    """Return the USB port; a byte 3 from the host does not interrupt the firmware."""
    if config.HOST_UART is None:
        import micropython

        micropython.kbd_intr(-1)
    poller = select.poll()
    poller.register(sys.stdin, select.POLLIN)
    return board.StreamPort(sys.stdin.buffer, sys.stdout.buffer, lambda: poller.poll(0))
