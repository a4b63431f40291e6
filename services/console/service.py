"""Console service: shows the robot's state on pages and forwards their requests."""

from collections.abc import Callable, Iterator
from socket import gethostname
from types import TracebackType
from typing import Any, Self

from sextant.services.console.config import Settings
from sextant.services.console.web import view
from sextant.services.console.web.command_repeater import stop_order_of
from sextant.services.console.web.control_arbiter import ControlArbiter
from sextant.services.console.web.page_feed import PageFeed
from sextant.services.console.web.recorder_client import RecorderClient
from sextant.services.console.web.requests import Command, Drive, GoTo, Record, Request, TakeOver, Watch
from sextant.services.console.web.robot_monitor import RobotMonitor
from sextant.services.console.web.server import Event, PageServer
from sextant.shared.recording.event_log import EventLog
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.clock import now_ns
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.access import refusal_here
from sextant.shared.wire.messages import (
    ActuatorState,
    Message,
    ModeCommand,
    PlannerStatus,
    Tick,
)

_BEAT_HZ = 15.0  # rate of `step`, which also runs at once for a request
_VIEW_NS = 66_000_000  # [ns] period of views
_IDLE_NS = 250_000_000  # [ns] period of views while no page is open; they only keep the event log
_HEALTH_NS = 1_000_000_000  # [ns] period of the health message to pages
_STATE_S = 0.5  # [s] age after which a state message counts as missing


class Console:
    """Service that connects the robot to its operators' browsers."""

    name = "console"
    subscribes: tuple[AnyTopic, ...] = (
        topics.ACTUATOR_STATE,
        topics.BODY_POSE,
        topics.STEP_PLAN,
        topics.PLANNER_STATUS,
        topics.PASSAGE_PLAN,
        topics.CAMERA_STATE,
        topics.CALIBRATION,
        topics.TERRAIN,
        topics.PREVIEW,
        *topics.HEALTH_OF.values(),
        topics.RECORDER_STATE,
    )
    publishes: tuple[AnyTopic, ...] = (topics.VELOCITY, topics.GOAL, topics.MODE, topics.STOP, topics.RECORD)

    def __init__(self, profile: RobotProfile, settings: Settings, clock: Callable[[], int] = now_ns):
        """Open the socket of the web server.

        Args:
            profile: The robot.
            settings: Settings of the console.
            clock: Clock [ns] that stamps requests of pages; must be the clock of the ticks.

        Raises:
            OSError: The address is not available.
        """
        self.stages = Stages()
        self.server = PageServer(settings, clock)
        self.trigger = Every(round(1e9 / _BEAT_HZ), self.server.wait, fetches=True)
        self._profile, self._settings = profile, settings
        self._arbiter = ControlArbiter(profile.stance.max_speed, f"{gethostname()}:{self.server.port}")
        self._event_log = EventLog()
        self._recorder = RecorderClient(self._event_log)
        self._monitor = RobotMonitor(self._event_log)
        self._feed = PageFeed(self.server, self.stages)
        self._legs: ActuatorState | None = None
        self._status: PlannerStatus | None = None
        self._view_due_ns = self._health_ns = 0  # times of the next view and of the last health message

    def __enter__(self) -> Self:
        self.server.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.server.__exit__(kind, error, trace)

    def status(self) -> str:
        """Return the address and the number of open pages."""
        return f"serving {self.server.url.partition('#')[0]} to {len(self._feed)} pages"

    def step(self, tick: Tick, inbox: Inbox) -> Iterator[Message]:
        """Forward the requests of pages, and send them the robot's state.

        Requests are forwarded in each step, the state at the view rate.
        """
        now = tick.stamp_ns
        for event in self.server.drain():
            self._take(event)
        due = now >= self._view_due_ns
        if due:
            self._legs = inbox.fresh(topics.ACTUATOR_STATE, _STATE_S)
            self._status = inbox.fresh(topics.PLANNER_STATUS, _STATE_S)
        for message in self._arbiter.beat(now, self._legs, self._status):
            yield message
            if isinstance(message, ModeCommand) and (stop := stop_order_of(message)) is not None:
                yield stop
        if due:
            yield from self._recorder.beat(now, inbox.fresh(topics.RECORDER_STATE))
        for words in self._arbiter.drain_words():
            self._event_log.note(now, "console", words)
        if due:
            period_ns = _VIEW_NS if self._feed.has_pages else _IDLE_NS
            self._view_due_ns = max(self._view_due_ns, now - period_ns) + period_ns
            self._update_pages(now, inbox)
        if now - self._health_ns >= _HEALTH_NS:
            self._health_ns = now
            if self._feed.has_pages:
                self._feed.post("health", self._health(now))
        self.server.flush()

    # ---------------------------------------------------------------------------------------------------------- from pages

    def _take(self, event: Event) -> None:
        page, what, now = event.page, event.what, event.at_ns
        match what:
            case "arrived":
                self._welcome(page, now)
            case "glances":
                self._arbiter.arrive(page, now, leads=False)
                self._feed.open_fleet_page(page)
            case "left":
                self._arbiter.leave(page, now)
                self._feed.close(page)
            case Watch():
                self._feed.watch(page, what)
            case _:
                refused = self._ask(page, what, now)
                if refused:
                    self._feed.post("refused", view.answer(refused), page)

    def _welcome(self, page: int, now: int) -> None:
        """Send a new page its seat, the event log so far and the newest map."""
        self._feed.post_log(now, self._event_log)  # for the other pages; the new page then receives the whole log once
        self._feed.post("hello", view.hello(self._profile, self._settings, self._arbiter.arrive(page, now)), page)
        self._feed.post("log", view.log(self._event_log.entries, now), page)
        self._feed.post("health", self._health(now), page)
        self._feed.open(page)

    def _ask(self, page: int, request: Request, now: int) -> str:
        """Process a request; return why it is refused, "" if it is accepted."""
        refused = self._barred(request, now)
        if refused:
            return refused
        return self._recorder.want(request.on, now) if isinstance(request, Record) else self._arbiter.ask(page, request, now)

    def _barred(self, request: Request, now: int) -> str:
        """Return why this machine's certificate does not permit a request, "" if it does.

        A certificate without the right to drive still permits stop and torque off.
        """
        match request:
            case Record():
                return refusal_here(self._monitor.roles(now), [topics.RECORD])
            case Command(order="off" | "stop"):
                return ""
            case Command() | Drive() | GoTo() | TakeOver():
                return refusal_here(self._monitor.roles(now), [topics.MODE])
        return ""

    # ------------------------------------------------------------------------------------------------------------ to pages

    def _update_pages(self, now: int, inbox: Inbox) -> None:
        """Write the event log, and send pages what has changed."""
        feed, legs, status = self._feed, self._legs, self._status
        self._event_log.legs(now, legs)
        self._event_log.planner(now, status)
        passages = self._monitor.update(now, inbox)
        if feed.has_pages:
            for passage in passages:
                feed.post("passage", view.passage(passage))
        feed.post_log(now, self._event_log)
        if feed.has_fleet_pages:
            silent = view.silent(self._monitor.services, now)
            feed.post_glance(view.glance(self._profile.name, self._arbiter, legs, status, silent))
        if not feed.has_pages:
            return
        with self.stages("state"):
            pose = inbox.fresh(topics.BODY_POSE, _STATE_S)
            state = view.state(self._arbiter, legs, pose, inbox.latest(topics.STEP_PLAN), status, self._monitor.camera)
            feed.post_state({**state, "recorder": self._recorder.view()})
        feed.post_calibration(self._monitor.calibration)
        feed.show_frames(now, inbox)

    def _health(self, now: int) -> dict[str, Any]:
        return view.health(self._monitor.services, now, self._monitor.too_slow)
