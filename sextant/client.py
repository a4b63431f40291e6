"""A program's connection to a robot: its newest state, and commands to it."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, TypeAlias

import numpy as np

from sextant.deploy.robot_time import RobotTime
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.wire import topics
from sextant.shared.wire.access import Keys
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    Goal,
    Message,
    Mode,
    ModeCommand,
    PlannerStatus,
    StopOrder,
    Tick,
    VelocityCommand,
)
from sextant.shared.wire.transport import Endpoints, ZenohLink

Command: TypeAlias = Literal["off", "stop", "stand", "walk", "sit"]

CONNECT_S = 10.0  # [s] in which the actuator has to publish its first state
COMMAND_S = 20.0  # [s] in which a command has to be finished
BLOCKED_S = 20.0  # [s] for which the planner may be blocked before `goto` gives up
_REPEAT_NS = 500_000_000  # [ns] between two messages of the same command: the robot may restart
_SETTLED_NS = 200_000_000  # [ns] after a command, before a state counts as its result
_DONE: dict[Command, tuple[Mode, ...]] = {
    "off": (Mode.OFF,),
    "stop": (Mode.OFF, Mode.READY, Mode.HOLD, Mode.FAULT),
    "stand": (Mode.HOLD,),
    "walk": (Mode.WALK, Mode.HOLD),
    "sit": (Mode.READY, Mode.OFF),
}


class ClientError(RuntimeError):
    """A command that the robot refuses or does not finish, with its reason."""


@dataclass(frozen=True, slots=True)
class Status:
    """What the robot has published last."""

    actuator: ActuatorState
    pose: BodyPose | None  # None before the first one
    planner: PlannerStatus | None


class Client:
    """A connection to a robot; a context manager.

    One client at a time leads a robot. A client that leads repeats its commands while it is connected; when it leaves, the
    robot stops. Methods that command the legs block until the robot has done so, but `walk`, which returns once it walks.

        with sextant.Client("tcp/robot.local:7447") as robot:
            robot.stand()
            robot.walk(0.08)
            time.sleep(5.0)
            robot.goto(1.0, 0.0)
            robot.sit()
    """

    def __init__(
        self,
        endpoint: str = "tcp/127.0.0.1:7447",
        *,
        namespace: str = "sextant",
        keys: Path | str | None = None,
        name: str = "client",
        take: bool = False,
    ):
        """Connect, and wait for the first state of the robot.

        Args:
            endpoint: Of the robot's router, e.g. tcp/127.0.0.1:7447 or tls/robot.local:7448.
            namespace: Of the robot, if several share a network.
            keys: Folder with the certificate of this machine, for an endpoint of tls.
            name: Under which this client leads.
            take: Whether to lead in place of another client or operator.

        Raises:
            ValueError: The endpoint is malformed, or asks for a certificate and there is none.
            AccessError: The keys are incomplete or expired.
            TransportError: Nothing answers at the endpoint.
            ClientError: No actuator publishes its state there.
        """
        loaded = None if keys is None else Keys.load(Path(keys))
        role = "robot" if loaded is None else loaded.role.name
        self._commander = Commander(name, take)
        with contextlib.ExitStack() as stack:
            link = stack.enter_context(ZenohLink(Endpoints((endpoint,), namespace=namespace, keys=loaded)))
            over = threading.Event()
            running = threading.Thread(
                target=run_live, args=(self._commander, link, over), kwargs={"role": role}, name=f"client {name}"
            )
            running.start()
            stack.callback(running.join)
            stack.callback(over.set)
            stack.callback(self._commander.withdraw)
            self._until(lambda _: True, CONNECT_S, f"no actuator has published its state at {endpoint}")
            self._open = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Stop the robot if this client leads it, and disconnect."""
        self._open.close()

    @property
    def status(self) -> Status:
        """What the robot has published last."""
        status = self._commander.status
        assert status is not None  # the constructor has waited for it
        return status

    @property
    def state(self) -> ActuatorState:
        """The newest state of the legs: mode, reason, joint angles, feet, contact, load, voltage and temperature."""
        return self.status.actuator

    def stand(self) -> None:
        """Stand up.

        Raises:
            ClientError: The robot refuses, or does not stand in time.
        """
        self._command("stand")

    def walk(
        self,
        forward_mps: float,
        left_mps: float = 0.0,
        yaw_rate_rad_s: float = 0.0,
        *,
        body_height_m: float = 0.11,
        lift_m: float = 0.04,
    ) -> None:
        """Walk at a velocity in {body} until another command; the planner moves each foothold to where the map allows it.

        Raises:
            ClientError: The robot refuses, or does not stand.
        """
        velocity = np.array([forward_mps, left_mps])
        self._commander.move(VelocityCommand(0, velocity, yaw_rate_rad_s, body_height_m, lift_m))
        self._command("walk")

    def goto(
        self,
        x_m: float,
        y_m: float,
        *,
        tolerance_m: float = 0.03,
        speed_mps: float = 0.1,
        body_height_m: float = 0.11,
        lift_m: float = 0.04,
        within_s: float = 600.0,
    ) -> None:
        """Walk to a place in {world}, around what the robot cannot cross, and stop there.

        Raises:
            ClientError: The robot refuses, finds no way for `BLOCKED_S`, or does not arrive in time.
        """
        goal = np.array([[x_m, y_m]])
        self._commander.move(Goal(0, goal, tolerance_m, speed_mps, body_height_m, lift_m))
        given_ns = self._command("walk")
        try:
            self._until(
                lambda status: _arrived(status, given_ns), within_s, f"the goal is not reached within {within_s:g} s", True
            )
        finally:
            self.stop()

    def stop(self) -> None:
        """Finish the step and stand still.

        Raises:
            ClientError: The robot does not stop in time.
        """
        self._command("stop")

    def sit(self) -> None:
        """Lower the body to the ground.

        Raises:
            ClientError: The robot refuses, or does not sit in time.
        """
        self._command("sit")

    def torque_off(self) -> None:
        """Turn the torque of all servos off at once: a robot that stands falls.

        Raises:
            ClientError: The actuator does not confirm it in time.
        """
        self._command("off")

    def _command(self, command: Command) -> int:
        """Give a command and wait until it is done; the time [ns] at which it was given, by the robot's clock."""
        before = self.state
        given_ns = self._commander.give(command)
        leads = command not in ("off", "stop")

        def done(status: Status) -> bool:
            state = status.actuator
            if refusal := _refusal(command, self._commander.name, state, before):
                raise ClientError(refusal)
            late_enough = state.stamp_ns > given_ns + _SETTLED_NS
            return late_enough and state.mode in _DONE[command] and (not leads or state.lease == self._commander.name)

        self._until(done, COMMAND_S, f"`{command}` is not done within {COMMAND_S:g} s")
        return given_ns

    def _until(self, holds: Callable[[Status], bool], within_s: float, failure: str, may_be_blocked: bool = False) -> None:
        """Wait for a status.

        Raises:
            ClientError: It does not come in time, or the planner is blocked for long where that matters.
        """
        until, blocked_since = time.monotonic() + within_s, None
        with self._commander.changed:
            while (status := self._commander.status) is None or not holds(status):
                now = time.monotonic()
                planner = None if status is None else status.planner
                blocked = may_be_blocked and planner is not None and planner.state == "blocked"
                blocked_since = (blocked_since or now) if blocked else None
                if blocked_since is not None and planner is not None and now - blocked_since > BLOCKED_S:
                    raise ClientError(f"no way to the goal: {planner.reason}")
                if now >= until:
                    raise ClientError(failure if status is None else f"{failure}: {_words(status)}")
                self._commander.changed.wait(min(until - now, 0.5))


class Commander:
    """Repeats the commands of a client and keeps what the robot publishes; a service."""

    reads: tuple[AnyTopic, ...] = (topics.ACTUATOR_STATE, topics.BODY_POSE, topics.PLANNER_STATUS)
    writes: tuple[AnyTopic, ...] = (topics.MODE, topics.STOP, topics.VELOCITY, topics.GOAL)

    def __init__(self, name: str, take: bool = False):
        """Begin without a command."""
        self.name = name
        self.paced_by = Every.hz(topics.VELOCITY.rate_hz)
        self.stages = Stages()
        self.status: Status | None = None
        self.changed = threading.Condition()  # notified when there is a new status
        self._take = take
        self._robot = RobotTime()
        self._now_ns = 0
        self._command: tuple[Command, int] | None = None  # and its sequence number: the robot's time [ns] when it was given
        self._motion: VelocityCommand | Goal | None = None
        self._due_ns: dict[str, int] = {}
        self._lock = threading.Lock()

    def doing(self) -> str:
        """The command that is repeated."""
        return "" if self._command is None else self._command[0]

    def give(self, command: Command) -> int:
        """Begin to repeat a command; its sequence number [ns], a time of the robot's clock."""
        with self._lock:
            number = self._robot() if self._command is None else max(self._robot(), self._command[1] + 1)
            self._command = command, number
            self._due_ns.clear()
            return number

    def move(self, motion: VelocityCommand | Goal) -> None:
        """Set the motion that is repeated while the robot is to walk; its stamp does not count."""
        with self._lock:
            self._motion = motion
            self._due_ns.clear()

    def withdraw(self) -> None:
        """Command a stop if a walk is commanded; it is published at least once before the service ends."""
        if self._command is not None and self._command[0] == "walk":
            self.give("stop")
            with self.changed:
                self.changed.wait_for(lambda: "stop" in self._due_ns, timeout=1.0)

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Publish what is due, and keep what has come."""
        state = inbox.latest(topics.ACTUATOR_STATE)
        with self._lock:
            if self._robot.see(tick.stamp_ns, None if state is None else state.stamp_ns):
                self._command = None  # the robot has restarted its clock: nothing that was commanded before counts
            self._take &= state is None or state.lease != self.name  # once it leads, it gives way to another that takes over
            due = list(self._due(tick.stamp_ns)) if self._robot.known else []
        yield from due
        if state is not None:
            with self.changed:
                self.status = Status(state, inbox.latest(topics.BODY_POSE), inbox.latest(topics.PLANNER_STATUS))
                self.changed.notify_all()

    def _due(self, now_ns: int) -> Iterator[Message]:
        if self._command is None:
            return
        command, number = self._command
        stamp_ns = self._robot()
        if now_ns >= self._due_ns.get(command, 0):
            self._due_ns[command] = now_ns + _REPEAT_NS
            yield ModeCommand(stamp_ns, command, number, self.name, self._take)
            if command == "off" or command == "stop":
                yield StopOrder(stamp_ns, command, number, self.name)
        if command == "walk" and self._motion is not None:
            topic = topics.OF_TYPE[type(self._motion)]
            if now_ns >= self._due_ns.get(topic.key, 0):
                self._due_ns[topic.key] = now_ns + round(1e9 / topic.rate_hz)
                yield replace(self._motion, stamp_ns=stamp_ns)


def _refusal(command: Command, name: str, state: ActuatorState, before: ActuatorState) -> str:
    """Why the actuator refuses a command, if it says so since."""
    starts = (f"`{command}` refused", f"`{command}` of {name} refused", "torque stays off")
    found = next((warning for warning in state.warnings if warning.startswith(starts)), "")
    return "" if found in before.warnings else found


def _arrived(status: Status, given_ns: int) -> bool:
    planner = status.planner
    return planner is not None and planner.state == "arrived" and planner.stamp_ns > given_ns + _SETTLED_NS


def _words(status: Status) -> str:
    planner = f"; planner {status.planner.state}: {status.planner.reason}" if status.planner is not None else ""
    return f"the robot is in mode {status.actuator.mode} ({status.actuator.reason}){planner}"
