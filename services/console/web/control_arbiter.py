"""Arbitration of the operators' requests.

One page at a time controls the robot, and all pages may stop it. Each page has a seat and sends commands as the lease holder
`console N at PLACE`. The robot moves only while a page repeats a press of the pad, or to a goal of a page that is still
connected. A press ends when the pad is released, or when the page is silent for longer than the dead-man time. A press that has
ended cannot move the robot again, even if its messages arrive late. This module does no I/O; the caller passes the time.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from sextant.services.console.web.command_repeater import CommandRepeater
from sextant.services.console.web.requests import CancelGoal, Command, Drive, GoTo, Heartbeat, Name, Release, Request, TakeOver
from sextant.shared.wire.messages import ActuatorState, GapCrossingMode, Goal, Message, Mode, PlannerStatus, VelocityCommand

SEATS = 8  # maximum number of pages that may drive; further pages may only stop
DEAD_MAN_NS = 300_000_000  # [ns] silence of a page with a held pad after which the press ends
_NO_SEAT = f"this page can only view and stop: {SEATS} other pages may control the robot; close one, and reload this page"
_OVERVIEW = "the overview of all robots can only view and stop; open the robot's own page to control it"
AWAY_NS = 5_000_000_000  # [ns] silence after which a page loses control: it is hidden, frozen or disconnected
VELOCITY_NS = 40_000_000  # [ns] minimum period of velocity commands; a page repeats a held pad every 66 ms
_ZERO_NS = 300_000_000  # [ns] duration of zero velocity commands after a press
_GOAL_NS = 200_000_000  # [ns] period of a goal
_TOLERANCE_M = 0.05  # [m] radius around a goal
_LED = (Mode.HOLD, Mode.WALK)  # modes in which the robot can walk


@dataclass(slots=True)
class _Page:
    """State of one page."""

    number: int
    seat: int  # 0 for a page that may only stop
    barred: str  # why it may only stop, "" if it has a seat
    name: str
    holder: str  # lease holder of its commands, unique among all seats of all consoles
    heard_ns: int  # time of its newest request
    lapsed: int = -1  # number of the newest press that has ended
    told: int = -1  # number of the newest ended press of which the page was notified


@dataclass(frozen=True, slots=True)
class OperatorSession:
    """Public state of one page."""

    seat: int
    name: str
    holder: str  # lease holder of its commands
    leads: bool  # whether it holds the lease


@dataclass(slots=True)
class _Press:
    page: int
    drive: Drive
    heard_ns: int


@dataclass(slots=True)
class _ActiveGoal:
    page: int
    goal: GoTo
    sent_ns: int = -_GOAL_NS
    begun_ns: int = 0


class ControlArbiter:
    """Arbiter between pages: takes their requests and returns the messages to publish.

    Call `beat` every few hundredths of a second.
    """

    def __init__(self, max_speed: float, place: str, kind: str = "console"):
        """Start without pages.

        Args:
            max_speed: Maximum speed of the robot [m/s].
            place: Name of this console, unique among the consoles of the robot.
            kind: What the operators use, at the beginning of their names as lease holders.
        """
        self._max_speed, self._place, self._kind = max_speed, place, kind
        self._pages: dict[int, _Page] = {}
        self._state: ActuatorState | None = None
        self._press: _Press | None = None
        self._active_goal: _ActiveGoal | None = None
        self._zero: VelocityCommand | None = None  # zero velocity that is published after a press
        self._zero_until_ns = 0
        self._velocity_ns = 0  # time of the last velocity command
        self._commands = CommandRepeater()
        self._words: list[str] = []  # entries for the event log

    # ------------------------------------------------------------------------------------------------- pages come and go

    def arrive(self, page: int, now_ns: int, leads: bool = True) -> int:
        """Add a page and return its seat.

        The seat is 0 if all seats are taken, or if `leads` is false.
        """
        taken = {other.seat for other in self._pages.values()}
        seat = next((n for n in range(1, SEATS + 1) if n not in taken), 0) if leads else 0
        name, holder = (f"page {seat}", f"{self._kind} {seat}") if seat else ("viewer", self._kind)
        barred = "" if seat else _NO_SEAT if leads else _OVERVIEW
        self._pages[page] = _Page(page, seat, barred, name, f"{holder} at {self._place}", now_ns)
        return seat

    def leave(self, page: int, now_ns: int) -> None:
        """Remove a page; its press and its goal end."""
        found = self._pages.get(page)
        if found is None:
            return
        self._end_leading(page, found, now_ns, f"{found.name} was closed")
        self._commands.end(page)
        del self._pages[page]

    @property
    def seats(self) -> tuple[OperatorSession, ...]:
        """Public state of all pages, ordered by seat."""
        lease = "" if self._state is None else self._state.lease
        pages = sorted(self._pages.values(), key=lambda page: page.seat)
        return tuple(OperatorSession(p.seat, p.name, p.holder, bool(p.seat) and p.holder == lease) for p in pages)

    @property
    def at_the_pad(self) -> int:
        """Seat of the page that holds the pad, 0 for none."""
        return 0 if self._press is None else self._pages[self._press.page].seat

    @property
    def goal(self) -> GoTo | None:
        """Current goal, None without one."""
        return None if self._active_goal is None else self._active_goal.goal

    def drain_words(self) -> list[str]:
        """Remove and return the entries for the event log since the last call."""
        words, self._words = self._words, []
        return words

    # ----------------------------------------------------------------------------------------------------------- requests

    def ask(self, page: int, request: Request, now_ns: int) -> str:
        """Process a request; return why it is refused, "" if it is accepted."""
        sender = self._pages.get(page)
        if sender is None:
            return "the console has dropped this page; it reconnects"
        sender.heard_ns = now_ns
        match request:
            case Drive():
                return self._drive(page, sender, request, now_ns)
            case Release():
                self._release_pad(page, now_ns, "")
            case Command():
                return self._command(sender, request, now_ns)
            case TakeOver():
                return self._take_over(sender, now_ns)
            case GoTo():
                return self._go(page, sender, request, now_ns)
            case CancelGoal():
                self._end_goal(now_ns, f"{sender.name} cancelled the goal")
            case Name():
                sender.name = request.name
            case Heartbeat():
                pass
            case _:
                return "unknown request"
        return ""

    def _drive(self, page: int, sender: _Page, drive: Drive, now_ns: int) -> str:
        press = self._press
        if press is not None and press.page == page and now_ns - press.heard_ns > DEAD_MAN_NS:
            self._release_pad(page, now_ns, f"no message from {sender.name} while the pad was held")
            press = None
        if drive.press <= sender.lapsed:  # the press has ended
            told, sender.told = sender.told, max(sender.told, drive.press)
            return "the robot was stopped; release the pad and press it again" if drive.press > told else ""
        if press is not None and press.page == page and press.drive.press == drive.press:
            press.drive, press.heard_ns = drive, now_ns
            return ""
        refused = self._cannot_lead(sender)
        if press is not None and press.page != page:
            refused = refused or f"{self._pages[press.page].name} holds the pad"
        if refused:
            sender.lapsed = sender.told = drive.press  # the operator must release and press the pad again
            return refused
        self._end_goal(now_ns, f"{sender.name} uses the pad")
        self._press = _Press(page, drive, now_ns)
        self._order(sender, "walk", now_ns)
        return ""

    def _command(self, sender: _Page, command: Command, now_ns: int) -> str:
        refused = "" if command.order in ("off", "stop") else self._led_by_another(sender)
        if not refused:
            self._order_anew(sender, command.order, now_ns)
        return refused

    def _take_over(self, sender: _Page, now_ns: int) -> str:
        if sender.barred:
            return sender.barred
        self._order_anew(sender, "stop", now_ns, take=True)
        return ""

    def _go(self, page: int, sender: _Page, goal: GoTo, now_ns: int) -> str:
        refused = self._cannot_lead(sender)
        if self._press is not None:
            refused = refused or f"{self._pages[self._press.page].name} holds the pad"
        if refused:
            return refused
        self._active_goal = _ActiveGoal(page, goal, begun_ns=now_ns)
        self._order(sender, "walk", now_ns)
        return ""

    def _led_by_another(self, sender: _Page) -> str:
        if sender.barred:
            return sender.barred
        if self._state is None:
            return "no message from the actuator yet; is it running?"
        lease = self._state.lease
        return f"{self._named(lease)} is in control of the robot; take over first" if lease not in ("", sender.holder) else ""

    def _cannot_lead(self, sender: _Page) -> str:
        refused = self._led_by_another(sender)
        if refused or self._state is None or self._state.mode in _LED:
            return refused
        return f"the robot cannot walk, its mode is {self._state.mode}: {self._state.reason}"

    def _named(self, holder: str) -> str:
        return next((page.name for page in self._pages.values() if page.seat and page.holder == holder), holder)

    # --------------------------------------------------------------------------------------------------- messages to publish

    def beat(self, now_ns: int, state: ActuatorState | None, status: PlannerStatus | None) -> list[Message]:
        """Return the messages to publish now.

        Args:
            now_ns: Current time [ns].
            state: Newest state of the actuator, None if it is outdated.
            status: Newest status of the planner, None if it is outdated.
        """
        self._state = state
        for page, sender in self._pages.items():
            if now_ns - sender.heard_ns > AWAY_NS:
                self._end_leading(page, sender, now_ns, f"no message from {sender.name} for {AWAY_NS * 1e-9:.0f} s")
                self._commands.end(page)
        self._watch_press(now_ns)
        self._watch_goal(now_ns, status)
        return [*self._commands.drain(now_ns, state), *self._velocity(now_ns), *self._goal(now_ns)]

    def _watch_press(self, now_ns: int) -> None:
        press = self._press
        if press is None:
            return
        sender = self._pages[press.page]
        if now_ns - press.heard_ns > DEAD_MAN_NS:
            self._release_pad(press.page, now_ns, f"no message from {sender.name} while the pad was held")
        elif self._state is not None and self._state.lease not in ("", sender.holder):
            self._words.append(f"{self._named(self._state.lease)} has taken over")
            self._lapse()

    def _watch_goal(self, now_ns: int, status: PlannerStatus | None) -> None:
        active, state = self._active_goal, self._state
        if active is None or state is None:
            return
        if state.lease not in ("", self._pages[active.page].holder):
            self._words.append(f"{self._named(state.lease)} has taken over, the goal is cancelled")
            self._active_goal = None
        elif state.mode in (Mode.OFF, Mode.READY, Mode.SIT):
            self._words.append(f"the goal is cancelled: {state.mode}: {state.reason}")
            self._active_goal = None
        elif (
            status is not None
            and status.stamp_ns > active.begun_ns
            and status.has_arrived_at(np.array(active.goal.waypoints[-1]))
        ):
            self._words.append(f"arrived: {status.reason}")
            self._end_goal(now_ns, "")

    def _velocity(self, now_ns: int) -> list[Message]:
        if now_ns - self._velocity_ns < VELOCITY_NS:
            return []
        press, state = self._press, self._state
        if press is not None and state is not None and state.lease == self._pages[press.page].holder:
            self._velocity_ns = now_ns
            drive, walk = press.drive, press.drive.walk
            speed = math.hypot(drive.forward, drive.left)
            share = min(1.0, self._max_speed / speed) if speed > 0.0 else 1.0
            velocity = np.array([share * drive.forward, share * drive.left])
            how = walk.height, walk.lift, walk.gait, drive.blind_walking
            return [VelocityCommand(now_ns, velocity, drive.turn, *how, walk.gait == "auto")]
        if press is None and self._zero is not None and now_ns < self._zero_until_ns:
            self._velocity_ns = now_ns
            return [replace(self._zero, stamp_ns=now_ns)]
        return []

    def _goal(self, now_ns: int) -> list[Message]:
        active, state = self._active_goal, self._state
        if active is None or state is None or state.lease != self._pages[active.page].holder:
            return []
        if now_ns - active.sent_ns < _GOAL_NS:
            return []
        active.sent_ns = now_ns
        goal, walk = active.goal, active.goal.walk
        speed = min(goal.speed, self._max_speed)
        waypoints = np.array(goal.waypoints)
        crossing: GapCrossingMode = "always" if goal.passage else "if needed"
        how = walk.height, walk.lift, walk.gait, crossing
        return [Goal(now_ns, waypoints, _TOLERANCE_M, speed, *how, walk.gait == "auto")]

    # ------------------------------------------------------------------------------------------------ ends of presses, goals

    def _end_leading(self, page: int, sender: _Page, now_ns: int, why: str) -> None:
        self._release_pad(page, now_ns, why)
        if self._active_goal is not None and self._active_goal.page == page:
            self._end_goal(now_ns, f"{why}; its goal is cancelled")

    def _release_pad(self, page: int, now_ns: int, why: str) -> None:
        """End the press of a page and stop the robot; `why` goes to the event log."""
        if self._press is None or self._press.page != page:
            return
        if why:
            self._words.append(f"the robot is stopped: {why}")
        walk = self._press.drive.walk
        self._lapse()
        self._zero = VelocityCommand(now_ns, np.zeros(2), 0.0, walk.height, walk.lift, walk.gait, False)
        self._zero_until_ns, self._velocity_ns = now_ns + _ZERO_NS, 0
        self._order(self._pages[page], "stop", now_ns)

    def _lapse(self) -> None:
        """End the current press, so that its later messages have no effect."""
        assert self._press is not None
        self._pages[self._press.page].lapsed = self._press.drive.press
        self._press = None

    def _end_goal(self, now_ns: int, why: str) -> None:
        if self._active_goal is None:
            return
        if why:
            self._words.append(why)
        page, self._active_goal = self._active_goal.page, None
        self._order(self._pages[page], "stop", now_ns)

    def _order_anew(self, sender: _Page, mode: str, now_ns: int, take: bool = False) -> None:
        """Publish a command that ends the current press and goal."""
        if self._press is not None:
            self._lapse()
        self._active_goal = None
        self._order(sender, mode, now_ns, take)

    def _order(self, sender: _Page, mode: str, now_ns: int, take: bool = False) -> None:
        self._commands.order(sender.number, sender.holder, mode, now_ns, take)
