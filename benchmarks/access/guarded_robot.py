"""Simulated robot in real time, with a router that accepts certified machines."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.faults.instrumented_robot import Places
from benchmarks.faults.live_walk import commands
from sextant.deploy.launch.launcher import Launcher
from sextant.deploy.security.authority import Authority
from sextant.deploy.security.router_security import Gate
from sextant.services.actuator.safety.torque_off_latch import Latch
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.access import ROLES, Keys
from sextant.shared.wire.messages import ActuatorState, Mode, ModeCommand
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, ZenohLink

_NAMESPACE = "intruders"
_PATIENCE_S = 90.0
_LEAD_S = 0.5  # [s] between two commands of the leader


class GuardedRobot:
    """Processes of a robot behind a secured router.

    A link on its own machine receives the actuator's state. This is a context manager.
    """

    def __init__(self, folder: Path):
        authority = Authority(days=1)
        for role in ROLES:
            authority.issue(folder / role.name, role.name)
        self._folder, self._secure = folder, f"tls/127.0.0.1:{free_port()}"
        self._places = Places.free(_NAMESPACE)
        self._latch = Latch.of_port(self._places.servos)
        gate = Gate((*self._places.robot.connect, self._secure), _NAMESPACE, folder / "robot")
        self._launcher = Launcher(commands(self._places, 1, gate))
        self.states: list[ActuatorState] = []
        self._leads, self._number, self._due_s = False, 0, 0.0

    def __enter__(self) -> "GuardedRobot":
        self._latch.open()
        with contextlib.ExitStack() as stack:
            stack.callback(self._latch.open)
            stack.enter_context(self._launcher)
            self._launcher.wait_for_start(_PATIENCE_S)
            self._link = stack.enter_context(ZenohLink(self._places.robot))
            self._link.subscribe(topics.ACTUATOR_STATE, self._hear)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def link_of(self, role: str) -> ZenohLink:
        """Open a link with the certificate of a role."""
        return ZenohLink(Endpoints((self._secure,), namespace=_NAMESPACE, keys=self._keys(role)))

    def peer_of(self, role: str) -> ZenohLink:
        """Open a peer with the certificate of a role.

        It also scouts, and listens for direct connections that bypass the router.
        """
        return ZenohLink(Endpoints((self._secure,), True, _NAMESPACE, self._keys(role), loopback=True))

    def _keys(self, role: str) -> Keys:
        return Keys.load(self._folder / role)

    def until(self, holds: Callable[[ActuatorState], bool], what: str) -> None:
        """Wait for a new state of the actuator.

        Raises:
            TimeoutError: There is none.
        """
        begun, limit = len(self.states), time.monotonic() + _PATIENCE_S
        while not any(holds(state) for state in self.states[begun:]):
            if time.monotonic() > limit:
                last = f"{self.states[-1].mode}: {self.states[-1].reason}" if self.states else "nothing"
                raise TimeoutError(f"{what} expected within {_PATIENCE_S:.0f} s, the actuator reports {last}")
            self.look(0.02)

    def look(self, seconds: float) -> None:
        """Wait; restart ended processes, and lead the robot if this is switched on."""
        if self._leads and time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + _LEAD_S
            now_ns = time.monotonic_ns()
            self._link.send(topics.MODE, codec.encode(ModeCommand(now_ns, "walk", self._number, "bench")))
        self._launcher.wait(seconds)

    def lead(self, leads: bool) -> None:
        """Start or stop leading: the robot may walk, but gets no goal."""
        self._leads, self._number = leads, time.monotonic_ns()
        self.until(
            lambda s: s.mode is Mode.HOLD and (s.lease == "bench") == leads,
            "a robot with a lease holder" if leads else "a robot without a lease holder",
        )

    def leave_alone(self) -> None:
        """Pause the operator's process, so that no client leads."""
        self._launcher.freeze("operator")

    def restart_clock(self) -> None:
        """Kill the actuator, and wait for its successor."""
        epoch = self.states[-1].epoch
        self._launcher.kill("actuator")
        self.until(lambda state: state.epoch != epoch and state.mode is Mode.HOLD, "a new actuator that holds")

    @property
    def ports(self) -> tuple[int, ...]:
        """The router's ports: for its own processes, and for other machines."""
        own = (*self._places.robot.connect, self._secure)
        return tuple(int(endpoint.rpartition(":")[2]) for endpoint in own)

    def restart_actuator(self) -> float:
        """Kill the actuator; return the time [s] until its successor's first state."""
        epoch, began_s = self.states[-1].epoch, time.monotonic()
        self._launcher.kill("actuator")
        self.until(lambda state: state.epoch != epoch, "a new actuator")
        return time.monotonic() - began_s

    def _hear(self, _topic: AnyTopic, frame: bytes) -> None:
        self.states.append(codec.decode(frame, topics.ACTUATOR_STATE.type)[0])
