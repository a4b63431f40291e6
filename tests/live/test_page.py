"""The operator's page in a real browser, with a simulated robot that walks live.

Time limits are generous here because machines are shared; `python -m benchmarks page` measures the times.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.page import browser as browsers
from benchmarks.page.browser import DESKTOP, PHONE, SMALL, Hand
from benchmarks.page.page_robot import PageRobot
from sextant.shared.recording.reader import Recording
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import CalibrationState, Mode
from sextant.shared.wire.transport import ZenohLink
from tests.support.commands import PATIENCE_S

pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(not browsers.find(), reason=f"no browser found of {', '.join(browsers.BROWSERS)}: install Chromium"),
]
SCAN_RATE_HZ = 5.0  # registered scans; the two cores of a small machine also run the browsers
STAND_S = 30.0  # limit for a robot without an operator to stand, on a busy machine
SOON_S = 2.0  # limit for what takes some tenths of a second on a quiet machine


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def robot(recordings: Path) -> Iterator[PageRobot]:
    with PageRobot("steps", recordings=str(recordings), scan_rate_hz=SCAN_RATE_HZ) as made:
        yield made


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browsers.browser() as made:
        yield made


@pytest.fixture
def hand(robot: PageRobot, chromium: Any) -> Iterator[Hand]:
    """Open a page for a standing robot that no other page leads."""
    with open_page(robot, chromium) as made:
        if not robot.is_in(Mode.HOLD) or robot.state is None or robot.state.reason == "torque was on at the start":
            robot.stand(lambda: made.click('[data-order="stand"]'))
        yield made


class open_page:  # noqa: N801 - it reads as what it does
    """A page that is closed at the end; its network requests are recorded."""

    def __init__(self, robot: PageRobot, chromium: Any, size: tuple[int, int] = SMALL):
        self._robot, self._chromium, self._size = robot, chromium, size

    def __enter__(self) -> Hand:
        self._context = self._chromium.new_context(viewport={"width": self._size[0], "height": self._size[1]})
        self._context.set_default_timeout(1e3 * PATIENCE_S)
        page = self._context.new_page()
        self.errors: list[str] = []
        self.asked: list[str] = []
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", self._note)
        page.on("request", lambda request: self.asked.append(request.url))
        page.goto(self._robot.url)
        page.wait_for_function("() => document.getElementById('leader-words').textContent !== ''")
        return Hand(page)

    def _note(self, line: Any) -> None:
        if line.type == "error" and "WebSocket connection" not in line.text:  # a test closed the connection
            self.errors.append(line.text)

    def __exit__(self, *_: object) -> None:
        self._context.close()
        assert self.errors == []
        assert {url for url in self.asked if not url.startswith(("blob:", self._robot.url))} == set(), "no other page answers"


def walk(robot: PageRobot, hand: Hand) -> None:
    """Hold the pad until the robot has walked for a second.

    The pad is pressed again if the page of a busy machine let the press lapse.
    """
    presses, limit = 0, time.monotonic() + PATIENCE_S
    walking: float | None = None  # beginning of the walk
    while walking is None or time.monotonic() < walking + 1.0:
        if time.monotonic() > limit:
            said = f"the page says {hand.says('#leader-words')!r} and {hand.says('#notice')!r} after {presses} presses"
            robot.until(lambda: False, 0.0, f"a second's walk by the pad; {said}")
        if not hand.holds():
            hand.release()
            hand.hold_forward()
            presses += 1
        robot.pass_time(0.1)
        if not robot.is_in(Mode.WALK):
            walking = None
        elif walking is None:
            walking = time.monotonic()


def wait_until_standing(robot: PageRobot) -> None:
    robot.until(lambda: robot.is_in(Mode.HOLD), STAND_S, "standing")


def wait_until_stopped(robot: PageRobot, since_s: float) -> None:
    """Wait until the console has ordered a stop since `since_s`, and the robot stands.

    A robot that waits for its next step stands too, without an order.
    """
    robot.until(lambda: np.isfinite(robot.stop_ordered_after(since_s)), what="the console's order to stop")
    wait_until_standing(robot)


def x_of(robot: PageRobot) -> float:
    assert robot.pose is not None
    return float(robot.pose.T_world_body[0, 3])


def test_robot_walks_while_pad_is_held(robot: PageRobot, hand: Hand) -> None:
    begun = x_of(robot)
    hand.until_says("#first", 'Hold the pad to walk, or press "goal" and click the map.')
    walk(robot, hand)
    hand.page.wait_for_selector("#first", state="hidden")
    hand.until_says("#leader-words", "you are in control")
    robot.pass_time(1.0)
    assert x_of(robot) > begun + 0.05
    since, swing = time.monotonic(), robot.swinging()
    hand.release()
    wait_until_standing(robot)
    robot.pass_time(1.0)
    assert robot.stands_after(since, swing) < SOON_S
    assert robot.state is not None
    assert robot.state.reason.startswith(("ordered to stop", "the last accepted step is finished"))


@pytest.mark.parametrize(
    "how",
    [
        "keys",
        "frozen",
        pytest.param("hidden", marks=pytest.mark.rare),
        pytest.param("blur", marks=pytest.mark.rare),
        pytest.param("cut off", marks=pytest.mark.rare),
    ],
)
def test_end_of_press_stops_robot_until_new_press(robot: PageRobot, chromium: Any, hand: Hand, how: str) -> None:
    page = hand.page
    if how == "keys":
        limit = time.monotonic() + PATIENCE_S
        while not robot.is_in(Mode.WALK):  # the page of a busy machine may let a press lapse; it is then pressed again
            assert time.monotonic() < limit, f"a walk by keys; the page says {hand.says('#notice')!r}"
            page.keyboard.up("KeyW")
            page.keyboard.down("KeyW")
            robot.pass_time(3.0)
        since = time.monotonic()
        page.keyboard.up("KeyW")
        wait_until_stopped(robot, since)
        robot.pass_time(1.5)
        assert robot.is_in(Mode.HOLD)
        return
    walk(robot, hand)
    since = time.monotonic()
    match how:
        case "blur":
            page.evaluate("window.dispatchEvent(new Event('blur'))")
            wait_until_stopped(robot, since)
        case "hidden":
            page.evaluate("Object.defineProperty(document, 'hidden', {value: true, configurable: true})")
            page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
            wait_until_stopped(robot, since)
            page.evaluate("delete document.hidden")
        case "frozen":
            with browsers.frozen():
                wait_until_stopped(robot, since)
        case "cut off":
            page.context.set_offline(True)
            page.evaluate("window.sextant.link.socket.close()")
            wait_until_stopped(robot, since)
            page.context.set_offline(False)
            page.wait_for_function("() => window.sextant.link.open")
    robot.pass_time(1.5)
    assert robot.is_in(Mode.HOLD), "what was held goes on being held, and moves nothing"
    hand.release()
    walk(robot, hand)
    hand.release()
    wait_until_standing(robot)


def test_torque_off_during_walk_reaches_servo_bus(robot: PageRobot, hand: Hand) -> None:
    walk(robot, hand)
    hand.release()
    hand.move_to("#off")
    since = time.monotonic()
    hand.page.mouse.down()
    robot.until(lambda: np.isfinite(robot.torque_off_after(since)), SOON_S, "torque off on the wire")
    hand.page.mouse.up()
    robot.until(lambda: robot.is_in(Mode.OFF), SOON_S, "the mode off")
    robot.pass_time(0.5)
    hand.hold_forward()
    hand.page.wait_for_selector("#notice:not([hidden])")
    assert "the robot cannot walk, its mode is off" in hand.says("#notice")
    hand.release()
    assert robot.is_in(Mode.OFF), "it is latched"
    robot.stand(lambda: hand.click('[data-order="stand"]'))


def test_second_browser_can_stop_but_moves_only_after_takeover(robot: PageRobot, chromium: Any, hand: Hand) -> None:
    with open_page(robot, chromium) as second:  # before the walk: a press lapses while a browser is busy with opening a page
        walk(robot, hand)
        # The seat of the first page is another one after a lost connection.
        second.page.wait_for_function(
            "() => /^page .* is in control$/.test(document.getElementById('leader-words').textContent)"
        )
        first = second.says("#leader-words").removesuffix(" is in control")
        second.hold_forward()
        second.page.wait_for_selector("#notice:not([hidden])")
        assert f"{first} is in control of the robot; take over first" in second.says("#notice")
        second.release()
        assert robot.state is not None
        assert robot.state.lease.startswith(f"console {first.removeprefix('page ')} at "), "it has changed nothing"
        second.click("#stop")
        wait_until_standing(robot)
        robot.pass_time(1.0)
        assert robot.is_in(Mode.HOLD), "the first one still holds its pad, and has to press it again"
        second.click("#take-over")
        second.page.wait_for_function("() => document.getElementById('leader-words').textContent === 'you are in control'")
        hand.release()
        hand.hold_forward()
        hand.page.wait_for_selector("#notice:not([hidden])")
        hand.release()
        assert robot.is_in(Mode.HOLD)
        walk(robot, second)
        second.release()
        wait_until_standing(robot)
    hand.page.wait_for_function("() => document.getElementById('leader-words').textContent === 'no client is in control'")


def test_map_click_sets_goal_and_robot_reaches_it(robot: PageRobot, hand: Hand) -> None:
    page = hand.page
    page.wait_for_function("() => window.sextant.view.terrain.header !== null")
    hand.click("#above")
    page.wait_for_timeout(500)
    hand.click("#goal")
    ahead = x_of(robot) + np.linspace(0.30, 0.40, 11)  # some of it is in the shadow of a block
    goal, height = next(
        (x, z) for x in ahead if (z := page.evaluate(f"window.sextant.view.terrain.heightAt({x}, 0)")) is not None
    )
    page.mouse.click(*page.evaluate(f"window.sextant.view.pixel({goal}, 0, {height})"))
    robot.until(lambda: robot.is_in(Mode.WALK), what="a walk to the goal")
    page.wait_for_function("() => window.sextant.view.robot.goal.visible")
    robot.until(lambda: abs(x_of(robot) - goal) < 0.1, what="the goal")
    wait_until_standing(robot)
    page.wait_for_function("() => document.getElementById('give-up').disabled")
    entry = "() => [...document.querySelectorAll('#entries li')].some((line) => line.innerText.includes('arrived'))"
    page.wait_for_function(entry)  # the log may be drawn after the state


def test_map_layers_camera_images_and_panels_are_shown(robot: PageRobot, hand: Hand) -> None:
    page = hand.page
    for layer in ("evaluation", "variance", "score"):
        page.check(f'input[value="{layer}"]')
        page.wait_for_function(f"() => window.sextant.view.terrain.header?.layer === '{layer}'")
    assert page.is_disabled('input[value="color"]'), "this robot's camera sees no colour"
    hand.click("#look")
    page.wait_for_selector("#depth:not([hidden])")
    page.wait_for_function("() => document.getElementById('depth').naturalWidth === 320")
    services = page.locator("#service-list li b").all_inner_texts()
    assert {"actuator", "console", "mapper", "perception", "planner", "simulator", "stop"} <= {
        name.strip() for name in services
    }
    assert page.locator("#loads tr").count() == 6
    assert "V, hottest" in hand.says("#power")


def test_killed_console_stops_robot_and_page_reconnects(robot: PageRobot, chromium: Any) -> None:
    context = chromium.new_context()
    context.set_default_timeout(1e3 * PATIENCE_S)
    page = context.new_page()
    page.goto(robot.url)
    page.wait_for_function("() => document.getElementById('leader-words').textContent !== ''")
    hand = Hand(page)
    robot.until(lambda: robot.state is not None and robot.state.lease == "", what="that nobody leads")
    walk(robot, hand)
    robot.kill("console")
    page.wait_for_function("() => !window.sextant.link.open")
    wait_until_standing(robot)
    robot.until(lambda: page.evaluate("() => window.sextant.link.open"), what="the connection of the page")
    robot.pass_time(1.0)
    assert robot.is_in(Mode.HOLD), "the pad that is still held moves nothing"
    context.close()


def test_page_looks_right_on_desktop_and_phone(
    robot: PageRobot, chromium: Any, hand: Hand, tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    """Draw the pictures of the docs.

    pytest tests/live/test_page.py -k looks --pictures docs
    """
    folder = Path(pytestconfig.getoption("--pictures") or tmp_path)
    hand.page.set_viewport_size({"width": DESKTOP[0], "height": DESKTOP[1]})
    hand.click("#look")
    walk(robot, hand)
    hand.page.wait_for_selector("#depth:not([hidden])")
    hand.page.wait_for_function("() => document.getElementById('service-list').innerText.includes('depth image to legs')")
    hand.page.screenshot(path=folder / "page.png")
    hand.release()
    wait_until_standing(robot)
    with open_page(robot, chromium, PHONE) as phone:
        phone.page.wait_for_function("() => window.sextant.view.terrain.header !== null")
        drawn = phone.page.evaluate("window.sextant.view.frames")
        phone.page.wait_for_function(f"() => window.sextant.view.frames > {drawn + 3}")  # the map is on the page by then
        phone.page.screenshot(path=folder / "page_phone.png")
        wide = phone.page.evaluate("document.documentElement.scrollWidth")
        assert wide <= PHONE[0], "nothing is cut off at the side"
        for selector in ("#off", "#mode", "#pad", "#stop"):
            box = phone.page.locator(selector).bounding_box()
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= PHONE[0]
            assert min(box["width"], box["height"]) >= 20
        off = phone.page.locator("#off").bounding_box()
        assert off["y"] + off["height"] < 120, "in sight at once"
    for name, size in (("page.png", DESKTOP), ("page_phone.png", PHONE)):
        image = (folder / name).read_bytes()
        assert (int.from_bytes(image[16:20], "big"), int.from_bytes(image[20:24], "big")) == size


def test_page_shows_progress_and_result_of_a_calibration(robot: PageRobot, hand: Hand) -> None:
    running = CalibrationState(time.monotonic_ns(), True, "posture 3 of 37", 3, 37, (), "")
    result = ("roll_deg        0.84 +- 0.21 deg",)
    assert not hand.page.locator("#calibration-command").is_visible()
    hand.page.click("#calibration summary")
    assert hand.says("#calibration-command") == "sextant camera calibrate"
    with ZenohLink(robot.endpoints) as link:

        def until(state: CalibrationState, shown: Callable[[], bool]) -> None:
            limit = time.monotonic() + PATIENCE_S
            while not shown():
                assert time.monotonic() < limit, hand.says("#calibration")
                link.send(topics.CALIBRATION, codec.encode(state))
                robot.pass_time(0.2)

        def until_says(state: CalibrationState, selector: str, words: str) -> None:
            until(state, lambda: words in hand.says(selector))

        def posture() -> str | None:
            return hand.page.locator("#calibration-progress").get_attribute("value")

        until_says(running, "#calibration-words", "posture 3 of 37")
        assert posture() == "3"
        hand.page.click("#calibration summary")  # a panel that is closed stays closed
        until(replace(running, posture=4), lambda: posture() == "4")
        assert hand.page.locator("#calibration").get_attribute("open") is None
        hand.page.click("#calibration summary")
        refused = replace(running, running=False, result=result, refusal="the floor is tilted")
        until_says(refused, "#calibration-words", "not written: the floor is tilted")
        assert hand.says("#calibration-result") == "roll_deg 0.84 ± 0.21 deg"
        until_says(replace(refused, refusal=""), "#calibration-words", "measured; restart the services")


def test_page_controls_recording_and_reports_killed_recorder(robot: PageRobot, hand: Hand, recordings: Path) -> None:
    page = hand.page
    page.wait_for_function("() => !document.getElementById('record').disabled")
    before = set(recordings.iterdir())
    hand.click("#record")
    page.wait_for_function("() => document.getElementById('record').textContent === 'end'")
    (first,) = set(recordings.iterdir()) - before
    assert str(first) in hand.says("#recorder-words")
    robot.pass_time(2.0)
    robot.kill("recorder")
    robot.until(lambda: "not recorded" in hand.says("#entries"), what="that it died")
    robot.until(
        lambda: hand.says("#record") == "end" and str(first) not in hand.says("#recorder-words"), what="that it goes on"
    )
    robot.pass_time(1.0)
    hand.click("#record")
    page.wait_for_function("() => document.getElementById('record').textContent === 'record'")
    page.wait_for_function("() => document.getElementById('recorder-words').textContent.startsWith('recorded ')")
    (second,) = set(recordings.iterdir()) - before - {first}
    killed, whole = Recording(first), Recording(second)
    assert killed.counts()["actuator/state"] > 20
    assert not killed.complete
    robot.until(lambda: whole.files and whole.files[0].stat().st_size > 0, what="the file")
    assert sum(1 for _ in whole.frames()) > 50
