"""Listener for the actuator's state on the robot's machine.

python -m benchmarks.net_testbed.listener ENDPOINT NAMESPACE

It prints each change as a line of JSON. It ends when its standard input is closed.
"""

import json
import sys
import threading
from dataclasses import asdict, dataclass

from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import ActuatorState, Mode
from sextant.shared.wire.transport import Endpoints, ZenohLink


@dataclass(frozen=True, slots=True)
class Heard:
    """A changed actuator state."""

    at_ns: int  # its time on this computer's monotonic clock
    mode: Mode
    reason: str
    step: int
    plan_ns: int  # stamp of the executed plan, -1 before the first

    @classmethod
    def of(cls, line: str) -> "Heard":
        """Parse an output line."""
        found = json.loads(line)
        return cls(found["at_ns"], Mode(found["mode"]), found["reason"], found["step"], found["plan_ns"])

    def line(self) -> str:
        """The state as an output line."""
        return json.dumps(asdict(self))

    @property
    def walks(self) -> bool:
        """Whether it walks on plans.

        Setting the feet down because no plan has arrived does not count.
        """
        return self.mode is Mode.WALK and self.reason == "walking"


class _Listener:
    def __init__(self) -> None:
        self._before: tuple[object, ...] = ()

    def hear(self, _topic: AnyTopic, frame: bytes) -> None:
        state, _ = codec.decode(frame, ActuatorState, topics.ACTUATOR_STATE.max_bytes)
        now = (state.mode, state.reason, state.step, state.plan_ns)
        if now != self._before:
            self._before = now
            sys.stdout.write(Heard(state.stamp_ns, *now).line() + "\n")
            sys.stdout.flush()


def main() -> int:
    """Listen until standard input ends."""
    endpoint, namespace = sys.argv[1:]
    stop = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        stop.set()

    threading.Thread(target=wait, daemon=True).start()
    with ZenohLink(Endpoints((endpoint,), namespace=namespace)) as link:
        link.subscribe(topics.ACTUATOR_STATE, _Listener().hear)
        stop.wait()
    return 0


if __name__ == "__main__":
    sys.exit(main())
