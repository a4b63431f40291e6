"""Radio between two network namespaces.

python -m benchmarks.net_testbed.relay

This process creates the namespaces. It prints the ids of two processes in the namespaces. It accepts `cut`, `mend` and
`what it carried` on standard input, and answers each with a line. When standard input is closed, it ends, and both namespaces
with it.
"""

import os
import select
import signal
import sys
import time

from benchmarks.net_testbed import orders
from benchmarks.net_testbed.channel import Channel
from benchmarks.net_testbed.namespace import MTU, NetTestbedError, leave_network, leave_user, wire
from sextant.shared.runtime.process_priority import go_first
from sextant.shared.runtime.shutdown import end_with

ROBOT, BASE = "10.77.0.1", "10.77.0.2"  # addresses, visible only inside the namespaces
_READ = MTU + 64  # [bytes]


def main() -> int:
    """Create both machines, and forward packets until standard input ends."""
    link, seed = orders.radio(orders.parser("benchmarks.net_testbed.relay", __doc__).parse_args())
    try:
        leave_user()
        robot, held_robot = _machine(ROBOT)
        base, held_base = _machine(BASE)
    except NetTestbedError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    go_first()  # high priority if permitted: a real radio is not delayed by programs
    orders.say(f"{held_robot} {held_base}")
    _carry({robot: Channel(link, seed), base: Channel(link, seed + 1)}, {robot: base, base: robot})
    for held in (held_robot, held_base):
        os.kill(held, signal.SIGKILL)
        os.waitpid(held, 0)
    return 0


def _machine(address: str) -> tuple[int, int]:
    """Enter a new network namespace.

    Return the file of its device, and the id of a process that stays there.
    """
    leave_network()
    file = wire("radio", address)
    parent = os.getpid()
    held = os.fork()
    if held == 0:
        end_with(parent)
        while True:
            signal.pause()
    return file, held


def _carry(ways: dict[int, Channel], other: dict[int, int]) -> None:
    """Forward packets between two devices until standard input ends."""
    said = sys.stdin.fileno()
    while True:
        now_ns = time.monotonic_ns()
        for wire_, way in ways.items():
            for packet in way.arrived(now_ns):
                os.write(other[wire_], packet)
        due = [way.due_ns for way in ways.values() if way.due_ns is not None]
        wait_s = max(min(due) - time.monotonic_ns(), 0) * 1e-9 if due else None
        ready, _, _ = select.select([said, *ways], [], [], wait_s)
        now_ns = time.monotonic_ns()
        for wire_, way in ways.items():
            if wire_ in ready:
                _take(wire_, way, now_ns)
        if said in ready and not _obey(os.read(said, 4096).decode(), list(ways.values())):
            return


def _take(wire_: int, way: Channel, now_ns: int) -> None:
    while True:
        try:
            way.send(os.read(wire_, _READ), now_ns)
        except BlockingIOError:
            return


def _obey(said: str, ways: list[Channel]) -> bool:
    """Execute the commands in some lines; return whether to continue."""
    for order in orders.read(said):
        if order != orders.ASK:
            for way in ways:
                way.cut = order == orders.CUT
        orders.answer(time.monotonic_ns(), [(way.carried, way.packets, way.dropped) for way in ways])
    return bool(said)


if __name__ == "__main__":
    sys.exit(main())
