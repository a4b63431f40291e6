"""Driver: moves the robot by the keys of a terminal and the sticks of a gamepad.

It is one operator of the same arbiter as the pages of the console, so lease, dead-man time and refusals are the same.
"""

import select
from collections.abc import Callable, Iterator
from typing import Protocol

from sextant.services.console.drive.gamepad import Gamepad, GamepadError
from sextant.services.console.drive.keyboard import UNKNOWN, Keyboard, Wish
from sextant.services.console.web.command_repeater import stop_order_of
from sextant.services.console.web.control_arbiter import DEAD_MAN_NS, ControlArbiter
from sextant.services.console.web.requests import Command, Drive, Heartbeat, Name, Order, Release, Request, TakeOver, Walk
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.robot_clock import RobotClockEstimate
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.messages import ActuatorState, GaitRequest, Message, Mode, ModeCommand, PlannerStatus, Tick

SPEEDS = 10  # steps of the speed, up to the highest speed of the profile
TURN_RAD_S = 0.3  # turning rate at the highest speed, as on the page
_RATE_HZ = 30.0  # of `step`, which also runs at once for a key
_STATE_S = 0.5  # [s] age after which a state of the robot counts as missing
_LAST_NS = 2_000_000_000  # [ns] after the end of control, by which the robot has to rest
_SETTLED_NS = 200_000_000  # [ns] after the end of control, before a state counts as its result
_REOPEN_NS = 1_000_000_000  # [ns] between two attempts to open an unplugged gamepad
_PAGE = 1  # number of the only operator
ORDERS: dict[str, Order] = {"r": "ready", "u": "stand", "j": "sit", "O": "off", " ": "stop"}
_QUIT = ("x", "\x03", "\x04")  # x, Ctrl-C, Ctrl-D
KEYS = """\
  w s or up down     walk forward, back             u   stand up            + -  speed
  a d                walk left, right               j   sit down            t    take over the lease
  q e or left right  turn                           r   torque on           x    stop and quit
  hold a key: the robot walks while the terminal    O   torque off (shift): a standing robot falls
  repeats it, and stops 0.3 s after the last one    space stops; so does every other key"""
PAD = "  gamepad: hold L1 with the sticks centred, then move them; left stick walks, right stick turns, other buttons stop"


class TerminalLostError(Exception):
    """The terminal is gone, or no longer belongs to this process."""


class Terminal(Protocol):
    """Terminal whose keys arrive one by one."""

    def fileno(self) -> int:
        """Return the file number of the keys, for `select`."""
        ...

    def read(self) -> bytes:
        """Return the characters since the last call, without waiting.

        Raises:
            TerminalLostError: The terminal is gone, or belongs to another process.
        """
        ...


class Driver:
    """Service that turns keys and sticks into commands; one operator of the robot.

    Each end of an input stops the robot: a released key, an unknown key, a lost terminal, an unplugged gamepad, a pause of
    this process. After that the input has to be released and pressed again.
    """

    name = "drive"
    subscribes: tuple[AnyTopic, ...] = (topics.ACTUATOR_STATE, topics.PLANNER_STATUS, *topics.HEALTH_OF.values())
    publishes: tuple[AnyTopic, ...] = (topics.VELOCITY, topics.MODE, topics.STOP)

    def __init__(
        self,
        profile: RobotProfile,
        place: str,
        terminal: Terminal,
        gamepad: Gamepad | None = None,
        gait: GaitRequest = "tripod",
        barred: Callable[[Inbox], str] = lambda _: "",
    ):
        """Start without a press.

        Args:
            profile: The robot; its highest speed and its body height are the limits.
            place: Name of this operator, unique among all clients of the robot.
            terminal: The terminal.
            gamepad: An open gamepad, if there is one; it is closed by `close`.
            gait: Gait of the walk.
            barred: Returns why a router refuses commands of this machine, or an empty text.
        """
        self.trigger = Every(round(1e9 / _RATE_HZ), self._wait)
        self.stages = Stages()
        self.finished = False
        self.failed = ""  # why control has ended, if the operator has not ended it
        self.speed = SPEEDS // 2  # of SPEEDS
        self._max_speed, self._place = profile.stance.max_speed, place
        self._walk = Walk(profile.stance.body_height, min(0.04, profile.stance.max_lift), gait)
        self._terminal: Terminal | None = terminal
        self._keyboard = Keyboard()
        self._gamepad, self._gamepad_path, self._reopen_ns = gamepad, "" if gamepad is None else gamepad.path, 0
        self._barred = barred
        self._robot = RobotClockEstimate()
        self._arbiter = self._new_arbiter(0)
        self._press = 0  # number of the newest press
        self._held = False
        self._stale = False  # whether inputs are ignored until all are released
        self._wish: Wish | None = None  # newest motion of the inputs
        self._note = ""  # newest refusal, or why the robot was stopped
        self._state: ActuatorState | None = None
        self._planner: PlannerStatus | None = None
        self._stepped_ns = -1
        self._ends: str | None = None  # request from another thread to end, and its reason; empty for none
        self._ended_ns = -1

    def end(self, why: str = "") -> None:
        """Stop the robot and finish; from any thread.

        Args:
            why: Reason; empty if the operator wants it.
        """
        self._ends = why if self._ends is None else self._ends

    def close(self) -> None:
        """Close the gamepad."""
        if self._gamepad is not None:
            self._gamepad.close()

    def status(self) -> str:
        """Return two lines: mode, lease, speed and commanded motion; and the newest refusal, or what the robot does."""
        state = self._state
        if state is None:
            hint = self._note or "is the robot up, with this endpoint and namespace?"
            return f"no state of the robot for {_STATE_S:g} s\n{hint}"
        lease = "yours" if self._leads else state.lease or "free"
        mode, speed = state.mode, f"{100 * self._share * self._max_speed:.1f} of {100 * self._max_speed:.1f} cm/s"
        doing = f"planner: {self._planner.reason}" if mode is Mode.WALK and self._planner is not None else state.reason
        refused = state.warnings[0] if state.warnings else ""
        return f"{mode} | lease: {lease} | speed {speed} | {self._motion()}\n{self._note or refused or doing}"

    def withdraw(self) -> tuple[Message, ...]:
        """Return the messages that end the control; none if this operator does not move the robot."""
        if not self._held:
            return ()
        self._held = False
        now_ns = self._robot()
        self._arbiter.leave(_PAGE, now_ns)
        return tuple(self._messages(now_ns))

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Read keys and sticks, and return the commands that follow."""
        now = tick.stamp_ns
        self._see_robot(now, inbox)
        if 0 <= self._stepped_ns < now - DEAD_MAN_NS:
            self._cut(f"this process was paused for {(now - self._stepped_ns) * 1e-9:.1f} s")
            self._discard_keys(now)
        self._stepped_ns = now
        self._take_keys(now)
        self._take_gamepad(now)
        if self._ended_ns < 0 and self._ends is not None:
            self.failed, self._ended_ns = self._ends, now
            self._cut("the control has ended")
        self._steer(now)
        self._arbiter.ask(_PAGE, Heartbeat(), self._robot())
        yield from self._messages(self._robot())
        self.finished = self._ended_ns >= 0 and self._rests(now)

    # ------------------------------------------------------------------------------------------------------------- inputs

    def _wait(self, length_s: float) -> None:
        """Wait for a time [s], or until a key arrives; a gamepad sends too many events to wait for."""
        select.select([] if self._terminal is None else [self._terminal], [], [], length_s)

    def _take_keys(self, now: int) -> None:
        if self._terminal is None:
            return
        try:
            keys = self._keyboard.read(self._terminal.read(), now)
        except TerminalLostError as error:
            self._terminal = None
            self.end(str(error))
            return
        for key in keys:
            self._take_key(key)

    def _take_key(self, key: str) -> None:
        if key in _QUIT:
            self.end()
        elif key in ("+", "=", "-"):
            self.speed = max(1, min(SPEEDS, self.speed + (-1 if key == "-" else 1)))
        elif key == "t":
            self._cut("")
            self._ask(TakeOver())
        elif key in ORDERS:
            self._cut("")
            self._ask(Command(ORDERS[key]))
        else:
            self._cut("an unknown key" if key == UNKNOWN or not key.isprintable() else f"the key {key} has no meaning")

    def _discard_keys(self, now: int) -> None:
        """Discard the characters that have waited during a pause; a key that is still held has to be released."""
        self._keyboard.motion.release(now)
        if self._terminal is not None:
            try:
                self._terminal.read()
            except TerminalLostError as error:
                self._terminal = None
                self.end(str(error))

    def _take_gamepad(self, now: int) -> None:
        if self._gamepad is None:
            if self._gamepad_path and now >= self._reopen_ns and self._ended_ns < 0:
                self._reopen_ns = now + _REOPEN_NS
                try:
                    self._gamepad = Gamepad(self._gamepad_path)
                except GamepadError:
                    return  # it is still unplugged
                self._note = "the gamepad is back"
            return
        try:
            if self._gamepad.read():
                self._cut("a button of the gamepad")
        except GamepadError as error:
            self._gamepad, self._reopen_ns = None, now + _REOPEN_NS
            self._cut(str(error))

    # ------------------------------------------------------------------------------------------------------------- control

    def _steer(self, now: int) -> None:
        """Turn the motion of the inputs into a press."""
        self._wish = self._wished(now)
        if self._stale and self._wish is None and self._keyboard.motion.is_released(now):
            self._stale = False
            self._keyboard.motion.release(now)
        if self._wish is None or self._stale:
            self._release()
        else:
            if not self._held:
                self._held, self._note = True, ""
                self._press += 1
            forward, left, turn = self._wish
            speed = self._share * self._max_speed
            drive = Drive(self._press, forward * speed, left * speed, turn * self._share * TURN_RAD_S, self._walk, False)
            if refused := self._arbiter.ask(_PAGE, drive, self._robot()):
                self._held, self._stale = False, True
                self._note = self._note or refused  # who has taken over is known already

    def _wished(self, now: int) -> Wish | None:
        """Return the motion of all inputs together, each part from -1 to 1; None without one."""
        if self._ended_ns >= 0:
            return None
        wishes = [self._keyboard.motion.wish(now), None if self._gamepad is None else self._gamepad.wish()]
        found = [wish for wish in wishes if wish is not None]
        if not found:
            return None
        forward, left, turn = (sum(parts) for parts in zip(*found, strict=True))
        longest = max(1.0, (forward**2 + left**2) ** 0.5)
        return forward / longest, left / longest, max(-1.0, min(1.0, turn))

    def _cut(self, why: str) -> None:
        """End the press; inputs are ignored until all are released."""
        self._note = f"stopped: {why}" if why and self._held else why
        self._stale = True
        self._release()

    def _release(self) -> None:
        if self._held:
            self._held = False
            self._ask(Release())

    def _ask(self, request: Request) -> None:
        """Make a request; note why it is refused."""
        if refused := self._arbiter.ask(_PAGE, request, self._robot()):
            self._note = refused

    @property
    def _leads(self) -> bool:
        return any(seat.leads for seat in self._arbiter.seats)

    @property
    def _share(self) -> float:
        return self.speed / SPEEDS

    def _new_arbiter(self, now_ns: int) -> ControlArbiter:
        arbiter = ControlArbiter(self._max_speed, self._place, "drive")
        arbiter.arrive(_PAGE, now_ns)
        arbiter.ask(_PAGE, Name("sextant drive"), now_ns)
        return arbiter

    # --------------------------------------------------------------------------------------------------------------- robot

    def _see_robot(self, now: int, inbox: Inbox) -> None:
        """Keep the newest state of the robot, and its clock."""
        state = inbox.fresh(topics.ACTUATOR_STATE, _STATE_S)
        known = self._robot.known
        restarted = self._robot.see(now, None if state is None else state.stamp_ns)
        if restarted or (self._robot.known and not known):
            self._arbiter, self._held, self._stale = self._new_arbiter(self._robot()), False, True
            self._note = restarted
        self._state = None if self._robot.in_doubt else state
        self._planner = inbox.fresh(topics.PLANNER_STATUS, _STATE_S)
        if barred := self._barred(inbox):
            self._cut("")
            self._note = barred

    def _messages(self, now_ns: int) -> Iterator[Message]:
        for message in self._arbiter.beat(now_ns, self._state, self._planner):
            if self._robot.known or not isinstance(message, ModeCommand):  # its number is a time of the robot
                yield message
            if isinstance(message, ModeCommand) and (stop := stop_order_of(message)) is not None:
                yield stop
        if words := self._arbiter.drain_words():
            self._note = words[-1]

    def _rests(self, now: int) -> bool:
        """Return whether the robot has stopped, or does not obey this operator, or is given up."""
        since_ns, state = now - self._ended_ns, self._state
        walks = state is None or (state.mode is Mode.WALK and self._leads)
        return since_ns > _LAST_NS or (since_ns > _SETTLED_NS and not walks)

    def _motion(self) -> str:
        """Return the commanded motion as text."""
        if not self._held or self._wish is None:
            return "no motion"
        share = 100 * self._share * self._max_speed
        forward, left, turn = self._wish
        parts = (
            f"{'forward' if forward > 0 else 'back'} {abs(forward) * share:.1f} cm/s" if forward else "",
            f"{'left' if left > 0 else 'right'} {abs(left) * share:.1f} cm/s" if left else "",
            f"turn {'left' if turn > 0 else 'right'} {abs(turn) * self._share * TURN_RAD_S:.2f} rad/s" if turn else "",
        )
        return ", ".join(filter(None, parts))
