"""Console service: shows the robot's state on pages and forwards their requests."""

from collections.abc import Callable, Iterator
from socket import gethostname
from types import TracebackType
from typing import Any, Self

from sextant.services.console.config import Settings
from sextant.services.console.web import frames, view
from sextant.services.console.web.control_arbiter import ControlArbiter
from sextant.services.console.web.recorder_client import RecorderClient
from sextant.services.console.web.requests import Command, Drive, GoTo, Record, Request, TakeOver, Watch
from sextant.services.console.web.server import Event, PageServer
from sextant.shared.recording.event_log import KEPT, EventLog
from sextant.shared.robot.profile import RobotProfile
from sextant.shared.runtime.clock import now_ns
from sextant.shared.runtime.health_table import HealthTable
from sextant.shared.runtime.lateness import SlowComputer
from sextant.shared.runtime.service import AnyTopic, Every, Inbox, Stages
from sextant.shared.wire import topics
from sextant.shared.wire.access import refusal_here
from sextant.shared.wire.messages import (
    ActuatorState,
    CameraState,
    Message,
    ModeCommand,
    PlannerStatus,
    StopOrder,
    TerrainMap,
    Tick,
)

_BEAT_HZ = 15.0  # rate of `step`, which also runs at once for a request
_VIEW_NS = 66_000_000  # [ns] period of views
_MAP_NS = 240_000_000  # [ns] minimum period of maps
_IDLE_NS = 250_000_000  # [ns] period of views while no page is open; they only keep the event log
_NEWS_NS = 240_000_000  # [ns] period of camera state, passage plans and service health
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
        self._desk = ControlArbiter(profile.stance.max_speed, f"{gethostname()}:{self.server.port}")
        self._event_log = EventLog()
        self._recorder = RecorderClient(self._event_log)
        self._watched: dict[int, Watch] = {}  # page number -> what the page shows
        self._glancing: set[int] = set()  # fleet pages, which receive only a summary
        self._view_due_ns = self._told_ns = 0  # times of the next view and of the last health message
        self._legs: ActuatorState | None = None
        self._status: PlannerStatus | None = None
        self._health = HealthTable()
        self._computer = SlowComputer(computer="the robot's computer")
        self._too_slow = ""  # warning that the robot's computer is too slow, "" if it is not
        self._told = self._glanced = ""  # last state and last summary sent
        self._logged = 0  # number of event log entries sent
        self._news_due_ns = self._map_due_ns = 0
        self._camera: CameraState | None = None
        self._map: TerrainMap | None = None  # newest map sent
        self._pictured_ns = -1

    def __enter__(self) -> Self:
        self.server.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.server.__exit__(kind, error, trace)

    def doing(self) -> str:
        """Return the address and the number of open pages."""
        return f"serving {self.server.url.partition('#')[0]} to {len(self._watched) + len(self._glancing)} pages"

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
        for message in self._desk.beat(now, self._legs, self._status):
            yield message
            if isinstance(message, ModeCommand) and (stop := _stop_of(message)) is not None:
                yield stop
        if due:
            yield from self._recorder.beat(now, inbox.fresh(topics.RECORDER_STATE))
        for words in self._desk.drain_words():
            self._event_log.note(now, "console", words)
        if due:
            period_ns = _VIEW_NS if self._watched else _IDLE_NS
            self._view_due_ns = max(self._view_due_ns, now - period_ns) + period_ns
            self._see(now, inbox)
        if now - self._told_ns >= _HEALTH_NS:
            self._told_ns = now
            if self._watched:
                self._tell("health", view.health(self._health.named(), now, self._too_slow))
        self.server.flush()

    # ---------------------------------------------------------------------------------------------------------- from pages

    def _take(self, event: Event) -> None:
        page, what, now = event.page, event.what, event.at_ns
        match what:
            case "arrived":
                self._welcome(page, now)
            case "glances":
                self._desk.arrive(page, now, leads=False)
                self._glancing.add(page)
                self._glanced = ""  # sends the summary to all fleet pages again
            case "left":
                self._desk.leave(page, now)
                self._watched.pop(page, None)
                self._glancing.discard(page)
            case Watch():
                self._watch(page, what)
            case _:
                self._ask(page, what, now)

    def _welcome(self, page: int, now: int) -> None:
        """Send a new page its seat, the event log so far and the newest map."""
        self._tell_log(now)  # brings the other pages up to date; the new page then receives the whole log once
        self._watched[page] = Watch()
        self._tell("hello", view.hello(self._profile, self._settings, self._desk.arrive(page, now)), page)
        self._tell("log", view.log(self._event_log.entries, now), page)
        self._tell("health", view.health(self._health.named(), now, self._too_slow), page)
        self._told = ""  # sends the state to all pages again
        self._draw(page)

    def _watch(self, page: int, watch: Watch) -> None:
        before, self._watched[page] = self._watched.get(page, Watch()), watch
        if before.layer != watch.layer:
            self._draw(page)

    def _draw(self, page: int) -> None:
        """Send the newest map to a page."""
        if self._map is not None:
            self.server.show("map", frames.map_frame(self._map, self._watched[page].layer), [page])

    def _ask(self, page: int, request: Request, now: int) -> None:
        refused = self._barred(request, now)
        if not refused:
            refused = (
                self._recorder.want(request.on, now) if isinstance(request, Record) else self._desk.ask(page, request, now)
            )
        if refused:
            self._tell("refused", view.answer(refused), page)

    def _barred(self, request: Request, now: int) -> str:
        """Return why this machine's certificate does not permit a request, "" if it does.

        A certificate without the right to drive still permits stop and torque off.
        """
        match request:
            case Record():
                return refusal_here(self._health.roles(now), [topics.RECORD])
            case Command(order="off" | "stop"):
                return ""
            case Command() | Drive() | GoTo() | TakeOver():
                return refusal_here(self._health.roles(now), [topics.MODE])
        return ""

    # ------------------------------------------------------------------------------------------------------------ to pages

    def _see(self, now: int, inbox: Inbox) -> None:
        legs, status = self._legs, self._status
        self._event_log.legs(now, legs)
        self._event_log.planner(now, status)
        if now >= self._news_due_ns:
            self._news_due_ns = now + _NEWS_NS
            self._hear_news(now, inbox)
        self._tell_log(now)
        if self._glancing:
            glance = view.text(
                view.glance(self._profile.name, self._desk, legs, status, view.silent(self._health.named(), now))
            )
            if glance != self._glanced:
                self._glanced = glance
                self.server.post("glance", glance, self._glancing)
        if not self._watched:
            return
        with self.stages("state"):
            pose = inbox.fresh(topics.BODY_POSE, _STATE_S)
            step, camera = inbox.latest(topics.STEP_PLAN), self._camera
            told = view.text({**view.state(self._desk, legs, pose, step, status, camera), "recorder": self._recorder.view()})
        if told != self._told:
            self._told = told
            self.server.post("state", told, self._watched)
        self._show(now, inbox)

    def _hear_news(self, now: int, inbox: Inbox) -> None:
        """Process messages that arrive rarely: health, camera state and passage plans."""
        self._health.drain(inbox, now)
        services = self._health.named()
        self._event_log.services(now, services)
        self._computer.linked = any(health.robot_ahead_s for health, _ in services.values())
        self._computer.update(services)
        self._too_slow = self._computer.words(now)
        self._event_log.computer(now, self._too_slow)
        self._camera = inbox.latest(topics.CAMERA_STATE)
        self._event_log.camera(now, self._camera)
        for plan in inbox.drain(topics.PASSAGE_PLAN):
            self._event_log.passage(now, plan)
            if self._watched:
                self._tell("passage", view.passage(plan))

    def _tell_log(self, now: int) -> None:
        """Send new entries of the event log to all pages."""
        new = min(self._event_log.count - self._logged, KEPT)
        self._logged = self._event_log.count
        if new and self._watched:
            self._tell("log", view.log(list(self._event_log.entries)[-new:], now))

    def _show(self, now: int, inbox: Inbox) -> None:
        """Send the newest map and picture to the pages that show them."""
        terrain = inbox.latest(topics.TERRAIN) if now >= self._map_due_ns else None
        if terrain is not None and terrain is not self._map:
            self._map, self._map_due_ns = terrain, now + _MAP_NS
            with self.stages("map"):
                for layer in {watch.layer for watch in self._watched.values()}:
                    pages = [page for page, watch in self._watched.items() if watch.layer == layer]
                    self.server.show("map", frames.map_frame(terrain, layer), pages)
        pages = [page for page, watch in self._watched.items() if watch.picture]
        picture = inbox.latest(topics.PREVIEW) if pages else None
        if picture is not None and picture.stamp_ns != self._pictured_ns:
            self._pictured_ns = picture.stamp_ns
            self.server.show("picture", frames.picture_frame(picture), pages)

    def _tell(self, kind: str, message: dict[str, Any], page: int | None = None) -> None:
        """Queue a message for one page, or for all pages."""
        self.server.post(kind, view.text(message), self._watched if page is None else [page])


def _stop_of(order: ModeCommand) -> StopOrder | None:
    """Return an off or stop command as a `StopOrder`, None for any other command.

    A machine without the right to drive can publish only `StopOrder`. Taking over the lease needs the right to drive.
    """
    if order.take or order.mode not in ("off", "stop"):
        return None
    return StopOrder(order.stamp_ns, "off" if order.mode == "off" else "stop", order.sequence, order.holder)
