"""The whole console: from services to pages, and from requests to messages."""

import contextlib
import json
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from socket import gethostname
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import ClientConnection, connect

from sextant.services.console.config import Settings
from sextant.services.console.service import Console
from sextant.services.console.web.control_arbiter import DEAD_MAN_NS
from sextant.services.console.web.origin_policy import PROTOCOL
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import (
    BodyPose,
    CalibrationState,
    CameraState,
    Health,
    Message,
    Mode,
    ModeCommand,
    PassagePlan,
    PlannerStatus,
    Preview,
    RecordCommand,
    RecorderState,
    StepPlan,
    StopOrder,
    Tick,
    VelocityCommand,
)
from tests.support.served import Serving
from tests.support.states import actuator_state
from tests.unit.console.web.test_frames import read, read_map, terrain

PROFILE = load_profile("phantomx_mk2")
PATIENCE_S = 20.0
CLOSE_S = 0.1  # [s] timeout of a page that closes with unread messages
MS = 1_000_000


class Rig:
    """A console and its inbox, with time that the test advances."""

    def __init__(self) -> None:
        self.now = 10_000 * MS
        self.pages = contextlib.ExitStack()
        self.console = Console(PROFILE, Settings(port=0), lambda: self.now)
        self.inbox = Inbox(self.console.subscribes, self.console.stages)
        self.serving = Serving(self.console.server.wait)

    def hear(self, *messages: Message) -> None:
        for message in messages:
            topic = topics.OF_TYPE[type(message)]
            self.inbox.receive(topic, codec.encode(message), self.now)

    def legs(self, **changes: Any) -> None:
        self.hear(actuator_state(PROFILE, stamp_ns=self.now, **changes))

    def beat(self, after_ms: float = 50.0) -> list[Message]:
        self.now += round(after_ms * MS)
        self.inbox.now_ns = self.now
        with self.serving.turn:
            return list(self.console.step(Tick(self.now), self.inbox))

    def page(self, query: str = "") -> "Browser":
        words: Any = [PROTOCOL]
        url = f"ws://127.0.0.1:{self.console.server.port}/socket{query}"
        return Browser(
            self, self.pages.enter_context(connect(url, subprotocols=words, compression=None, close_timeout=CLOSE_S))
        )


class Browser:
    """A scripted page."""

    def __init__(self, rig: Rig, socket: ClientConnection):
        self._rig, self._socket = rig, socket
        self.told: dict[str, Any] = {}
        self.log: list[str] = []
        self.frames: dict[str, bytes] = {}

    def ask(self, type_: str, **fields: Any) -> None:
        self._socket.send(json.dumps({"type": type_, **fields}))

    def until(self, kind: str, holds: Any = lambda _: True) -> Any:
        """Beat and listen until a message of this type fulfils the condition."""
        limit = time.monotonic() + PATIENCE_S
        while time.monotonic() < limit:
            self._rig.beat()
            self.listen()
            found = self.frames.get(kind) or self.told.get(kind)
            if found is not None and holds(found):
                return found
        raise AssertionError(f"{kind}: {self.told.get(kind)}; log {self.log}")

    def listen(self) -> None:
        while True:
            try:
                data = self._socket.recv(timeout=0.01)
            except TimeoutError:
                return
            if isinstance(data, bytes):
                kind = read(data)[0]["type"]
                self.frames[kind] = data
                self.ask("seen", what=kind)
                continue
            message = json.loads(data)
            self.told[message["type"]] = message
            if message["type"] == "log":
                self.log += [f"{e['who']}: {e['words']}" for e in message["entries"]]

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def rig() -> Iterator[Rig]:
    made = Rig()
    with made.console, made.serving, made.pages:
        yield made


def plan(step: int) -> StepPlan:
    swing = np.arange(6) % 2 == 0
    touchdown = PROFILE.rest_feet()
    return StepPlan(1, 0, step, 0, np.eye(4), swing, touchdown, np.full(6, 0.04), np.eye(4), 0.6, False)


def test_page_receives_robot_description_and_state(rig: Rig) -> None:
    page = rig.page()
    rig.legs(mode=Mode.WALK, reason="walking", lease="bench", step=4, warnings=("the battery is low",))
    T = np.eye(4)
    T[:3, 3] = (1.0, 0.5, 0.1)
    rig.hear(
        BodyPose(1, T, T, np.zeros((6, 6)), 0.93, True, "", np.zeros((0, 6))),
        plan(4),
        PlannerStatus(1, "stepping", "0 of 3 moved", 4, 0, -1, np.array([[1.0, 0.5], [2.0, 0.0]])),
        CameraState(1, "a camera", True, ""),
    )
    hello = page.until("hello")
    assert (hello["seat"], hello["robot"]["name"], len(hello["robot"]["legs"])) == (1, PROFILE.name, 6)
    assert hello["dead_man_ms"] * 1e6 == DEAD_MAN_NS, "after which the page counts itself as paused"
    state = page.until("state", lambda told: told["legs"] and told["planner"] and told["camera"])
    assert (state["legs"]["mode"], state["legs"]["lease"], state["legs"]["warnings"]) == (
        "walk",
        "bench",
        ["the battery is low"],
    )
    np.testing.assert_allclose(np.reshape(state["pose"]["T"], (4, 4)), T)
    assert state["plan"]["legs"] == [0, 2, 4]
    np.testing.assert_allclose(np.reshape(state["plan"]["touchdown"], (-1, 3)), PROFILE.rest_feet()[::2], atol=1e-4)
    assert state["planner"]["path"] == [1.0, 0.5, 2.0, 0.0]
    assert state["seats"] == [{"seat": 1, "name": "page 1", "leads": False}]
    page.until("log", lambda _: {"actuator: walk: walking", "actuator: the battery is low"} <= set(page.log))


def test_stale_state_is_sent_as_unknown(rig: Rig) -> None:
    page = rig.page()
    rig.legs()
    page.until("state", lambda told: told["legs"])
    rig.now += 2000 * MS
    state = page.until("state", lambda told: told["legs"] is None)
    assert (state["pose"], state["plan"]) == (None, None)


def test_map_is_sent_in_requested_layer(rig: Rig) -> None:
    page = rig.page()
    map_ = terrain(3)
    rig.hear(map_)
    assert read_map(page.until("map"))[0]["layer"] == "score"
    page.ask("watch", layer="variance", picture=False)
    header, heights, _ = read_map(page.until("map", lambda frame: read(frame)[0]["layer"] == "variance"))
    assert heights.shape == map_.elevation.shape
    assert header["stamp_ns"] == map_.stamp_ns


def test_images_are_sent_only_on_request(rig: Rig) -> None:
    page, other = rig.page(), rig.page()
    page.ask("watch", layer="score", picture=True)
    page.until("state", lambda _: len(rig.console.status()) > 0)
    limit = time.monotonic() + PATIENCE_S
    stamp = 0
    while "picture" not in page.frames and time.monotonic() < limit:
        stamp += 1
        rig.hear(Preview(stamp, np.arange(5, dtype=np.uint8), np.zeros(0, np.uint8)))
        rig.beat()
        page.listen()
    assert read(page.frames["picture"])[1] == bytes(range(5))
    other.listen()
    assert "picture" not in other.frames


def test_page_commands_are_published_and_refusals_reported(rig: Rig) -> None:
    page, other = rig.page(), rig.page()
    place = f"{gethostname()}:{rig.console.server.port}"  # unlike that of another machine's console, which also has a page 1
    rig.legs(lease=f"console 1 at {place}")
    page.until("state", lambda told: len(told["seats"]) == 2)
    drive = {
        "press": 1,
        "forward": 0.1,
        "left": 0.0,
        "turn": 0.0,
        "height": 0.1,
        "lift": 0.04,
        "gait": "tripod",
        "blind_walking": False,
    }
    sent: list[Message] = []
    limit = time.monotonic() + PATIENCE_S
    while not any(isinstance(m, VelocityCommand) for m in sent):
        assert time.monotonic() < limit
        rig.legs(lease=f"console 1 at {place}")
        page.ask("drive", **drive)
        threading.Event().wait(0.005)
        sent += rig.beat(45.0)
    assert next(m.mode for m in sent if isinstance(m, ModeCommand)) == "walk"
    rig.legs(lease=f"console 1 at {place}")
    other.ask("drive", **drive)
    assert "take over first" in other.until("refused")["words"] or "holds the pad" in other.told["refused"]["words"]
    other.ask("order", order="off")
    limit = time.monotonic() + PATIENCE_S
    while not any(isinstance(m, ModeCommand) and m.mode == "off" for m in sent):
        assert time.monotonic() < limit
        sent += rig.beat()
    off = next(m for m in sent if isinstance(m, StopOrder) and m.mode == "off")
    assert off.holder == f"console 2 at {place}", "by the key of those who may not lead, too"
    page.close()
    other.close()


def test_page_reports_certificate_that_only_allows_stopping(rig: Rig) -> None:
    page = rig.page()
    page.until("state", lambda told: len(told["seats"]) == 1)
    rig.legs()
    nothing = np.zeros(0)
    word = Health(1, "router of viewer", "listening", 0, 0, 0, "", (), nothing, nothing)
    rig.hear(word)
    rig.beat(300.0)
    page.ask("order", order="stand")
    assert "is in control of the robot" in page.until("refused")["words"], "the name of a service is a claim"
    rig.inbox.receive(topics.HEALTH_OF["viewer"], codec.encode(word), rig.now)
    rig.beat(300.0)
    page.ask("order", order="stand")
    page.until("refused", lambda told: "this certificate (viewer: " in told["words"])
    rig.beat(6000.0)
    rig.legs()
    rig.beat(300.0)
    page.ask("order", order="stand")
    page.until("refused", lambda told: "is in control of the robot" in told["words"])  # its router has another role by now
    page.ask("order", order="off")
    sent: list[Message] = []
    limit = time.monotonic() + PATIENCE_S
    while not any(isinstance(m, StopOrder) for m in sent):
        assert time.monotonic() < limit
        sent += rig.beat()
    page.close()


def test_seats_follow_opened_and_closed_pages(rig: Rig) -> None:
    page, other = rig.page(), rig.page()
    page.until("state", lambda told: len(told["seats"]) == 2)
    other.close()
    page.until("state", lambda told: len(told["seats"]) == 1)
    assert rig.console.status().endswith("to 1 pages")


def test_fleet_page_receives_only_summary_and_may_only_stop(rig: Rig) -> None:
    rig.legs(mode=Mode.WALK, reason="walking", lease="bench", voltage=10.84)
    glance = rig.page("?glance")
    rig.hear(Health(rig.now, "mapper", "mapping", 0, 0, 0, "", (), np.zeros(0), np.zeros(0)))
    told = glance.until("glance", lambda found: found["mode"] == "walk")
    assert told == {
        "type": "glance",
        "robot": PROFILE.name,
        "mode": "walk",
        "reason": "walking",
        "leader": "bench",
        "voltage": 10.8,
        "temperature": 30.0,
        "planner": "",
        "silent": [],
    }
    rig.hear(terrain())
    silent = glance.until("glance", lambda found: found["silent"])
    assert silent["silent"] == ["mapper"]
    assert (silent["mode"], silent["reason"]) == (None, "no message from the actuator")
    assert set(glance.told) == {"glance"}
    assert glance.frames == {}
    page = rig.page()
    assert [seat["seat"] for seat in page.until("state")["seats"]] == [0, 1], "who glances has no seat to lead from"
    # It may stop the robot, and nothing else.
    rig.legs()
    rig.beat()
    glance.ask("order", order="stand")
    refused = glance.until("refused")["words"]
    assert refused == "the overview of all robots can only view and stop; open the robot's own page to control it"
    glance.ask("order", order="off")
    limit = time.monotonic() + PATIENCE_S
    said: list[Message] = []
    while not any(isinstance(one, StopOrder) and one.mode == "off" for one in said):
        assert time.monotonic() < limit
        said += rig.beat()
    glance.close()


def test_each_page_receives_every_log_line_once(rig: Rig) -> None:
    rig.hear(CameraState(1, "a camera", False, "the first"))
    rig.beat(300.0)  # logged while there is no page
    page = rig.page()
    page.until("log", lambda _: "camera: the first" in page.log)
    rig.hear(CameraState(2, "a camera", False, "the second"))
    rig.beat(300.0)
    other = rig.page()
    other.until("log", lambda _: "camera: the second" in other.log)
    rig.hear(CameraState(3, "a camera", False, "the third"))
    for one in (page, other):
        one.until("log", lambda _, one=one: "camera: the third" in one.log)
        assert [line for line in one.log if "camera" in line] == [f"camera: the {n}" for n in ("first", "second", "third")]


def test_page_receives_service_health_and_passage_plans(rig: Rig) -> None:
    page = rig.page()
    rig.hear(Health(1, "mapper", "mapping", 1, 2, 3, "", ("map",), np.array([1.0]), np.array([2.5])))
    steps, points = np.array([2, 6], dtype=np.uint8), np.ones((2, 3))
    words, edges = "no foothold for the left front leg", np.zeros((0, 2, 3), np.float32)
    numbers = (0.0, 1.0, 0.4, 10, 9, 1.0)
    rig.hear(PassagePlan(1, 1, "no way", words, np.zeros(2), *numbers, steps, points, points, edges, points[:1]))
    told = page.until("health", lambda told: told["services"])
    assert told["services"][0] | {"age_s": 0} == {
        "name": "mapper", "status": "mapping", "age_s": 0, "silent": False, "refused": 2, "dropped": 3,
        "robot_clock_offset_s": 0.0, "stages": {"map": 2.5},
    }  # fmt: skip
    passage = page.until("passage")
    assert (passage["state"], passage["legs"], passage["footholds"]) == ("no way", [2], [1.0, 1.0, 1.0])
    page.until("log", lambda _: any("no foothold for the left front leg" in line for line in page.log))


def test_page_reports_slow_robot_computer(rig: Rig) -> None:
    def late(stamp_ns: int) -> Health:
        nothing, late = np.zeros(0), [np.array([figure]) for figure in (1.6, 1.2, 0.8, 0.5)]
        return Health(stamp_ns, "planner", "waiting", 1, 0, 0, "", (), nothing, nothing, 0.0, ("mapper/terrain",), *late)

    page = rig.page()
    assert page.until("health")["too_slow"] == ""
    for second in range(3):
        rig.hear(late(second))
        rig.beat(1000.0)
    told = page.until("health", lambda told: told["too_slow"])
    assert told["too_slow"] == "the robot's computer is too slow: maps are 1.6 s old, 0.8 s allowed; close programs there"
    page.until("log", lambda _: any("too slow: maps" in line for line in page.log))


def test_page_controls_recorder_and_shows_its_state(rig: Rig) -> None:
    page = rig.page()
    page.until("hello")
    page.ask("record", on=True)
    assert "no recorder is running" in page.until("refused")["words"]
    resting = RecorderState(rig.now, False, -1, "", 0.0, 0, 5 * 10**9, 0, "")
    rig.hear(resting)
    assert page.until("state", lambda told: told["recorder"])["recorder"]["disk_free_gb"] == 5.0
    page.ask("record", on=True)
    orders: list[RecordCommand] = []
    while not orders:
        rig.hear(resting)
        orders = [m for m in rig.beat() if isinstance(m, RecordCommand)]
    assert orders[0].record
    rig.hear(replace(resting, recording=True, sequence=orders[0].sequence, file="/r/1.mcap"))
    page.until("state", lambda told: told["recorder"] and told["recorder"]["recording"])
    page.until("log", lambda _: any("recording to /r/1.mcap" in line for line in page.log))


def test_page_receives_progress_and_result_of_a_calibration(rig: Rig) -> None:
    page = rig.page()
    page.until("hello")
    rig.hear(CalibrationState(1, True, "posture 3 of 37", 3, 37, (), ""))
    told = page.until("calibration", lambda told: told["running"])
    assert (told["status"], told["posture"], told["postures"]) == ("posture 3 of 37", 3, 37)
    rig.now += 61_000 * MS
    told = page.until("calibration", lambda told: not told["running"])
    assert told["refusal"] == "its command has ended without a result"
    page.until("log", lambda _: "camera: no new calibration: its command has ended without a result" in page.log)
    rig.hear(CalibrationState(2, False, "measured", 37, 37, ("roll_deg 0.10 +- 0.05 deg",), "the floor is tilted"))
    told = page.until("calibration", lambda told: told["result"])
    assert (told["result"], told["refusal"]) == (["roll_deg 0.10 +- 0.05 deg"], "the floor is tilted")
    page.until("log", lambda _: "camera: no new calibration: the floor is tilted" in page.log)
    later = rig.page()
    assert later.until("calibration")["refusal"] == "the floor is tilted", "a new page receives it, too"
