"""A program's connection to a robot: its newest state, and commands to it."""

import atexit
import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, TypeAlias

import numpy as np

from sextant.deploy.live.send_command import LEASE_ENDS_NS, REFUSED_NS, SETTLED, STOPS, OrderedMotion, refusal, router_refusal
from sextant.shared.runtime.robot_clock import RobotClockEstimate
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.runtime.zenoh_runner import run_live
from sextant.shared.wire import topics
from sextant.shared.wire.access import Keys
from sextant.shared.wire.messages import (
    ActuatorState,
    BodyPose,
    GapCrossingMode,
    Goal,
    Message,
    Mode,
    ModeCommand,
    PlannerStatus,
    PostureCommand,
    StopOrder,
    Tick,
    VelocityCommand,
)
from sextant.shared.wire.transport import Endpoints, TransportError, ZenohLink

Command: TypeAlias = Literal["off", "stop", "stand", "walk", "sit"]

CONNECT_S = 10.0  # [s] in which the actuator has to publish its first state
READY_S = 120.0  # [s] in which all services have to report; the first start compiles for a minute
POSTURE_S = 20.0  # [s] in which the body has to reach a posture
COMMAND_S = 20.0  # [s] in which a command has to be finished
PATIENCE_S = 10.0  # [s] for which the planner may be blocked before `goto` gives up; the planner itself tries again after 12 s
LOST_S = 20.0  # [s] for which the robot may be silent before `goto` gives up
_SILENT_S = 2.0  # [s] without a state, after which the actuator counts as silent
_REPEAT_NS = 500_000_000  # [ns] between two messages of the same command: the robot may restart
_SETTLED_NS = 200_000_000  # [ns] after a command, before a state counts as its result
_POSTURE_SETTLED_NS = 500_000_000  # [ns] the same for a posture: a state of the planner does not name the posture
_WALKING = (Mode.WALK, Mode.HOLD)  # modes while a walk command is obeyed: the robot holds while the planner plans


_SILENT = f"the actuator has published no state for {_SILENT_S:g} s: it has ended, or the connection is interrupted"


class ClientError(RuntimeError):
    """No robot answers, or it refuses or does not finish a command; the text says why."""


@dataclass(frozen=True, slots=True)
class Status:
    """The newest message of each kind from the robot, at most 2 s old.

    A client can connect before all services have started. `Client.wait_until_ready` waits until no message is missing.
    """

    actuator: ActuatorState
    """State of the legs; a client has one from the beginning."""
    pose: BodyPose | None
    """Estimated pose of the body in {world}; None until perception has registered the first scan, and without perception."""
    planner: PlannerStatus | None
    """State of the planner and the reason for it; None until the planner has started."""


class Client:
    """A connection to a robot; a context manager.

    One client at a time leads a robot. A client that leads repeats its command while it is connected; when it disconnects, the
    robot stops. Methods that command the legs block until the robot has executed the command; `walk` blocks until the robot
    has accepted it. A command that fails is not repeated. ::

        with sextant.Client("tcp/robot.local:7447") as robot:
            robot.wait_until_ready()
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
            keys: Folder with this machine's certificate; a tls endpoint requires it.
            name: Under which this client leads; clients that lead the same robot need different names.
            take: Whether to lead in place of another client or operator.

        Raises:
            ValueError: The endpoint is malformed, or asks for a certificate and there is none.
            AccessError: The keys are incomplete or expired.
            ClientError: Nothing answers at the endpoint, or no actuator publishes its state there.
        """
        loaded = None if keys is None else Keys.load(Path(keys))
        endpoints = Endpoints((endpoint,), namespace=namespace, keys=loaded)
        self._may_only_stop = "" if loaded is None else loaded.refusal([topics.MODE])
        self._commander = Commander(name, take, may_lead=not self._may_only_stop)
        with contextlib.ExitStack() as stack:
            try:
                link = stack.enter_context(ZenohLink(endpoints))
            except TransportError as error:
                raise ClientError(str(error)) from error
            over = threading.Event()
            running = threading.Thread(
                target=run_live,
                args=(self._commander, link, over),
                kwargs={"role": endpoints.role},
                name=f"client {name}",
                daemon=True,  # a program that does not close its client ends all the same
            )
            running.start()
            stack.callback(running.join)
            stack.callback(over.set)
            stack.callback(self._commander.withdraw)
            self._until(lambda _: True, CONNECT_S, f"no actuator publishes its state at {endpoint}, namespace {namespace}")
            self._open = stack.pop_all()
        atexit.register(self.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Stop the robot if this client leads it, and disconnect."""
        atexit.unregister(self.close)
        self._open.close()

    @property
    def status(self) -> Status:
        """The newest messages of the robot.

        Raises:
            ClientError: The actuator has published no state for 2 s: it has ended, or the connection is interrupted.
        """
        status = self._commander.newest
        if status is None:
            raise ClientError(self._commander.silence())
        return status

    @property
    def state(self) -> ActuatorState:
        """The newest state of the legs, with mode, reason, joint angles, feet, contact, load, voltage and temperature.

        Raises:
            ClientError: The actuator has published no state for 2 s.
        """
        return self.status.actuator

    def wait_until_ready(self, within_s: float = READY_S) -> None:
        """Wait until the robot has a pose and its planner runs, so that `status.pose` and `status.planner` are not None.

        `walk` and `goto` can be called before: the robot then holds until its services have started.

        Raises:
            ClientError: They do not report in time; the message names what is missing.
        """

        def is_ready(status: Status) -> bool:
            return status.pose is not None and status.planner is not None

        self._until(is_ready, within_s, f"the robot is not ready within {within_s:g} s")

    def stand(self) -> None:
        """Stand up. A robot that stands already keeps its feet on the ground, at their heights; {odom} starts again.

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

        Returns once the robot has accepted the command; it holds until the planner has planned the first steps.

        Raises:
            ClientError: The robot refuses.
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
        gap_crossing: GapCrossingMode = "if needed",
        patience_s: float = PATIENCE_S,
        within_s: float = 600.0,
    ) -> None:
        """Walk to a place in {world}, around what the robot cannot cross, and stop there.

        Returns once the robot stands with all legs at rest, within `tolerance_m` of the place by its own estimate of its pose.
        The heading at the place is that of the path. Where no path leads, the robot walks to the edge of the gap, looks, and
        tries to cross it foothold by foothold; it can take minutes until that is refused.

        Args:
            x_m: [m] of the place.
            y_m: [m] of the place.
            tolerance_m: [m] from the place that counts as arrived.
            speed_mps: [m/s] at most; the legs or the ground may allow less.
            body_height_m: [m] of the body over the ground.
            lift_m: [m] clearance of swinging feet.
            gap_crossing: "never" raises where no path leads; "always" walks straight, one planned leg at a time.
            patience_s: [s] for which the planner may be blocked, for example by an obstacle that moves away.
            within_s: [s] in which the robot has to arrive.

        Raises:
            ValueError: A value is not finite.
            ClientError: The robot refuses, can never execute this, finds no way for `patience_s`, stops walking, obeys another
                client, or does not arrive in time.
        """
        place = np.array([x_m, y_m])
        goal = Goal(0, place[None], tolerance_m, speed_mps, body_height_m, lift_m, gap_crossing=gap_crossing)
        blocked = _Blocked(patience_s)

        def arrived(planner: PlannerStatus) -> bool:
            if failure := blocked.see(planner):
                raise ClientError(failure)
            return planner.has_arrived_at(place)

        self._reach(goal, arrived, _SETTLED_NS, within_s, f"the goal is not reached within {within_s:g} s")
        self._end_walk()

    def posture(
        self,
        forward_m: float = 0.0,
        left_m: float = 0.0,
        up_m: float = 0.0,
        *,
        roll_rad: float = 0.0,
        pitch_rad: float = 0.0,
        yaw_rad: float = 0.0,
        within_s: float = POSTURE_S,
    ) -> None:
        """Move the body over its standing feet, and hold it there until another command.

        The posture is relative to the rest pose, in which the feet are nearest to the resting stance; all zero is that pose.
        Returns once the body has reached it. Positive pitch lowers the front. No map is needed.

        Args:
            forward_m: [m] from the rest pose.
            left_m: [m] from the rest pose.
            up_m: [m] from the rest pose.
            roll_rad: [rad] about the forward axis.
            pitch_rad: [rad] about the left axis.
            yaw_rad: [rad] about the vertical axis.
            within_s: [s] in which the body has to reach the posture.

        Raises:
            ValueError: A value is not finite.
            ClientError: The robot refuses, the legs do not reach the posture, the robot obeys another client, or it does not
                get there in time. The robot then stops.
        """
        place, rpy = np.array([forward_m, left_m, up_m]), np.array([roll_rad, pitch_rad, yaw_rad])

        def reached(planner: PlannerStatus) -> bool:
            if planner.state == "blocked":
                raise ClientError(planner.reason)
            return planner.state == "arrived"

        failure = f"the posture is not reached within {within_s:g} s"
        self._reach(PostureCommand(0, place, rpy), reached, _POSTURE_SETTLED_NS, within_s, failure)

    def _reach(
        self,
        motion: Goal | PostureCommand,
        reached: Callable[[PlannerStatus], bool],
        settled_ns: int,
        within_s: float,
        late: str,
    ) -> None:
        """Command a motion, and wait until the planner reports that it is complete; stop the robot if it fails.

        Args:
            motion: The motion.
            reached: Whether a state of the planner is that of the complete motion; it may raise.
            settled_ns: [ns] after the command, before a state of the planner counts.
            within_s: [s] in which the motion has to be complete.
            late: Error text if it is not complete in time.
        """
        self._commander.move(motion)
        given_ns = self._command("walk")

        def done(status: Status) -> bool:
            if failure := self._not_walking(status.actuator):
                raise ClientError(failure)
            planner = status.planner
            return planner is not None and planner.stamp_ns > given_ns + settled_ns and reached(planner)

        try:
            self._until(done, within_s, late, silent_s=LOST_S)
        except BaseException as failure:
            try:
                self._end_walk()
            except ClientError as second:
                failure.add_note(f"afterwards: {second}")
            raise

    def _end_walk(self) -> None:
        """Stop if a command is still repeated."""
        if self._commander.status():
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
        """Give a command and wait until it is executed; return its sequence number, a time [ns] of the robot's clock."""
        leads = command not in STOPS
        if leads and self._may_only_stop:
            raise ClientError(self._may_only_stop)
        if leads and not self._commander.leads:
            self._await_name()
        before, motion = self._commander.newest, OrderedMotion(command)
        given_ns = self._commander.give(command)

        def done(status: Status) -> bool:
            state = status.actuator
            obeyed = state.lease == self._commander.name
            found = refusal(command, self._commander.name, state)
            known = before is not None and found in before.actuator.warnings
            if found and (not known or state.stamp_ns > given_ns + REFUSED_NS):
                held = leads and state.lease not in ("", self._commander.name)
                raise ClientError(f"{found}; Client(..., take=True) takes it over" if held else found)
            if leads and not obeyed and self._commander.refused_by_router:
                raise ClientError(self._commander.refused_by_router)
            if obeyed and state.stamp_ns > given_ns and (interruption := motion.interruption(state)):
                raise ClientError(interruption)
            return state.stamp_ns > given_ns + _SETTLED_NS and state.mode in SETTLED[command] and (obeyed or not leads)

        try:
            self._until(done, COMMAND_S, f"`{command}` is not done within {COMMAND_S:g} s")
        except ClientError:
            self._commander.cancel(given_ns)
            raise
        if not leads and not self._commander.leads:
            self._commander.cancel(given_ns)
        return given_ns

    def _await_name(self) -> None:
        """Wait until no other client leads under the name of this one; the lease of an earlier program ends by itself.

        Raises:
            ClientError: Another client keeps leading under this name; each would supersede the other's commands.
        """
        name = self._commander.name
        taken = f"another client named {name!r} leads the robot; end it, or give this one another name: Client(..., name=...)"
        self._until(lambda status: status.actuator.lease != name, LEASE_ENDS_NS * 1e-9, taken)

    def _not_walking(self, state: ActuatorState) -> str:
        """Return why the robot no longer obeys this client's walk command, or an empty text."""
        if state.lease not in ("", self._commander.name):
            return f"{state.lease} has taken over the robot"
        return "" if state.mode in _WALKING else f"the robot is in mode {state.mode}: {state.reason}"

    def _until(self, holds: Callable[[Status], bool], within_s: float, failure: str, silent_s: float = np.inf) -> None:
        """Wait until a condition holds; it may raise.

        Raises:
            ClientError: It does not hold in time, or the actuator is silent for longer than `silent_s`.
        """
        until, heard_s = time.monotonic() + within_s, time.monotonic()
        with self._commander.changed:
            while (status := self._commander.newest) is None or not holds(status):
                now = time.monotonic()
                heard_s = heard_s if status is None else now
                if now - heard_s > silent_s:
                    raise ClientError(self._commander.silence())
                if now >= until:
                    raise ClientError(f"{failure}: {self._commander.silence() if status is None else _text(status)}")
                self._commander.changed.wait(min(until - now, 0.5))


class Commander:
    """Repeats the commands of a client and keeps what the robot publishes; a service."""

    subscribes: tuple[AnyTopic, ...] = (
        topics.ACTUATOR_STATE,
        topics.BODY_POSE,
        topics.PLANNER_STATUS,
        *topics.HEALTH_OF.values(),
    )
    publishes: tuple[AnyTopic, ...] = (topics.MODE, topics.STOP, topics.VELOCITY, topics.GOAL, topics.POSTURE)

    def __init__(self, name: str, take: bool = False, may_lead: bool = True):
        """Start without a command.

        Args:
            name: Holder of the lease.
            take: Take the lease from another holder.
            may_lead: Whether this client's certificate permits commands to move; else it may only stop.
        """
        self.name = name
        self.trigger = Every.hz(topics.VELOCITY.rate_hz)
        self.stages = Stages()
        self.newest: Status | None = None  # None while the actuator is silent
        self.changed = threading.Condition()  # notified after each step
        self.leads = False  # whether this client has commanded the robot and no other client has led it since
        self.refused_by_router = ""  # why a router has refused the newest command, or an empty text
        self._may_lead, self._take = may_lead, take
        self._unreadable = ""  # why the newest state is refused, or an empty text
        self._robot = RobotClockEstimate()
        self._holder = ""  # of the lease, in the newest state
        self._has_commanded = False  # whether this client has given a command to move
        self._command: tuple[Command, int] | None = None  # and its sequence number: the robot's time [ns] when it was given
        self._motion: VelocityCommand | Goal | PostureCommand | None = None
        self._due_ns: dict[str, int] = {}
        self._lock = threading.Lock()

    def status(self) -> str:
        """Return the command that is repeated, or an empty text."""
        return "" if self._command is None else self._command[0]

    def silence(self) -> str:
        """Return why there is no state of the actuator."""
        return self._unreadable or _SILENT

    def give(self, command: Command) -> int:
        """Start to repeat a command; return its sequence number, a time [ns] of the robot's clock."""
        with self._lock:
            number = self._robot() if self._command is None else max(self._robot(), self._command[1] + 1)
            self._command = command, number
            self._has_commanded |= command not in STOPS
            self._due_ns.clear()
            self.refused_by_router = ""
            return number

    def cancel(self, number: int) -> None:
        """Stop repeating a command, unless a newer one was given."""
        with self._lock:
            if self._command is not None and self._command[1] == number:
                self._command = None

    def move(self, motion: VelocityCommand | Goal | PostureCommand) -> None:
        """Set the motion that is repeated while the robot is to walk; its stamp is ignored."""
        with self._lock:
            self._motion = motion
            self._due_ns.clear()

    def withdraw(self) -> None:
        """Command a stop if this client commands a walk and no other client leads; return once it is published."""
        if self.status() == "walk" and self._holder in ("", self.name):
            self.give("stop")
            with self.changed:
                self.changed.wait_for(lambda: "stop" in self._due_ns, timeout=1.0)

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Publish the messages that are due, and keep the newest messages of the robot."""
        state = inbox.fresh(topics.ACTUATOR_STATE, _SILENT_S)
        self._unreadable = inbox.refusal_of(topics.ACTUATOR_STATE)
        with self._lock:
            if self._robot.see(tick.stamp_ns, None if state is None else state.stamp_ns):
                self._command = None  # the robot's clock has restarted: earlier commands are void
            if state is not None:
                self._see_lease(state.lease)
            due = list(self._due(tick.stamp_ns)) if self._robot.known else []
        yield from due
        newest = None
        if state is not None:
            pose, planner = inbox.fresh(topics.BODY_POSE, _SILENT_S), inbox.fresh(topics.PLANNER_STATUS, _SILENT_S)
            newest = Status(state, pose, planner)
        with self.changed:
            self.refused_by_router = router_refusal(inbox) or self.refused_by_router
            self.newest = newest  # set once: other threads read it without the lock
            self.changed.notify_all()

    def _see_lease(self, holder: str) -> None:
        """Give way to another client that has taken the lease from this one."""
        self._holder = holder
        if holder == self.name:
            if self._has_commanded:
                self.leads, self._take = True, False
        elif holder and self.leads:
            self.leads, self._command = False, None

    def _due(self, now_ns: int) -> Iterator[Message]:
        if self._command is None:
            return
        command, number = self._command
        stamp_ns = self._robot()
        if now_ns >= self._due_ns.get(command, 0):
            self._due_ns[command] = now_ns + _REPEAT_NS
            if self._may_lead:
                yield ModeCommand(stamp_ns, command, number, self.name, self._take)
            if command in ("off", "stop"):
                yield StopOrder(stamp_ns, command, number, self.name)
        if command == "walk" and self._motion is not None:
            topic = topics.OF_TYPE[type(self._motion)]
            if now_ns >= self._due_ns.get(topic.key, 0):
                self._due_ns[topic.key] = now_ns + round(1e9 / topic.rate_hz)
                yield replace(self._motion, stamp_ns=stamp_ns)


class _Blocked:
    """How long the planner has been blocked."""

    def __init__(self, patience_s: float):
        self._patience_s, self._since_ns = patience_s, -1

    def see(self, planner: PlannerStatus | None) -> str:
        """Return why the goal cannot be reached, once the planner is blocked for `patience_s`; else an empty text."""
        if planner is None:
            return ""
        if planner.invalid_command:
            return planner.reason
        if planner.state != "blocked":
            self._since_ns = -1
            return ""
        self._since_ns = planner.stamp_ns if self._since_ns < 0 else self._since_ns
        blocked_s = (planner.stamp_ns - self._since_ns) * 1e-9
        return f"no way to the goal: {planner.reason}" if blocked_s > self._patience_s else ""


def _text(status: Status) -> str:
    legs, planner = status.actuator, status.planner
    parts = (
        f"the robot is in mode {legs.mode} ({legs.reason})",
        "no pose from perception" if status.pose is None else "",
        "no message from the planner" if planner is None else f"planner {planner.state}: {planner.reason}",
    )
    return "; ".join(filter(None, parts))
