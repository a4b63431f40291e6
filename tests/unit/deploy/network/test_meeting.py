"""Machines of one robot meet: who fits, who ends, and what is said of it."""

from dataclasses import replace

import pytest

from deploy.network import meeting
from deploy.network.meeting import Meeting, objection
from shared import codec, topics
from shared.messages import Health, Presence
from shared.service import AnyTopic
from tests.support.frames import of_another_version

SEC = 1_000_000_000
ROBOT = meeting.presence("hexapod-7", "onboard", "0.1.0", ("actuator", "perception"), 50.0, 0)
BASE = meeting.presence("desk-9", "offboard", "0.1.0", ("mapper", "planner"), 20.0, 0)


def with_another(word: Presence, *keys: str) -> Presence:
    """By a version in which some messages are declared otherwise."""
    return replace(
        word,
        version="0.2.0",
        schemas=tuple("Other/1" if key in keys else schema for key, schema in zip(word.keys, word.schemas, strict=True)),
    )


class Wire:
    """Between machines: what one sends, the others fetch."""

    def __init__(self) -> None:
        self.links: list[Wire.Link] = []

    class Link:
        """A machine's."""

        def __init__(self, wire: "Wire"):
            self.wire = wire
            self.frames: list[bytes] = []
            self.health: list[Health] = []

        def send(self, topic: AnyTopic, frame: bytes) -> None:
            if topic is topics.HEALTH:
                self.health.append(codec.decode(frame, Health)[0])
                return
            for link in self.wire.links:
                link.frames.append(frame)

        def collect(self, topic: AnyTopic):  # type: ignore[no-untyped-def]
            assert topic is topics.PRESENCE

            def come() -> list[bytes]:
                frames, self.frames = self.frames, []
                return frames

            return come

        def subscribe(self, topic: AnyTopic, receive: object):  # type: ignore[no-untyped-def]
            raise NotImplementedError

        def wanted(self, topic: AnyTopic) -> bool:
            return True

    def link(self) -> "Wire.Link":
        self.links.append(Wire.Link(self))
        return self.links[-1]


class Machine:
    """One that starts processes."""

    def __init__(self, wire: Wire, clock: list[int], name: str, role: str, *services: str, version: str = "0.1.0"):
        self.said: list[str] = []
        self.link = wire.link()
        self.meeting = Meeting(self.link, name, role, version, services, lambda: clock[0], self.said.append)


def beats(clock: list[int], seconds: float, *machines: Machine) -> None:
    for _ in range(round(seconds * 5)):
        clock[0] += SEC // 5
        for machine in machines:
            machine.meeting.beat()


def test_two_halves_of_one_version_fit() -> None:
    assert objection(ROBOT, BASE) is None
    assert objection(BASE, ROBOT) is None
    newer = replace(BASE, version="0.1.1")
    assert objection(ROBOT, newer) is None, "what they say is what counts"


@pytest.mark.parametrize("base_up_s", [1.0, 500.0])
def test_a_base_that_means_something_else_ends_and_the_robot_does_not(base_up_s: float) -> None:
    base = replace(with_another(BASE, "planner/step", "perception/scan"), up_s=base_up_s)
    at_robot, at_base = objection(ROBOT, base), objection(base, ROBOT)
    assert at_robot is not None
    assert at_base is not None
    assert not at_robot.ends_us
    assert at_base.ends_us
    assert "planner/step" in at_base.words
    assert "perception/scan" in at_base.words
    assert "hexapod-7 (onboard) runs Sextant 0.1.0, here is 0.2.0" in at_base.words
    assert "install the same version on both" in at_base.words


def test_many_differences_are_counted() -> None:
    found = objection(ROBOT, with_another(BASE, *BASE.keys))
    assert found is not None
    assert f"and {len(BASE.keys) - 4} more" in found.words


def test_a_topic_that_only_one_knows_is_no_difference() -> None:
    older = replace(BASE, keys=BASE.keys[:-2], schemas=BASE.schemas[:-2])
    assert objection(ROBOT, older) is None
    assert objection(older, ROBOT) is None


def test_of_two_that_start_the_same_the_later_ends() -> None:
    late = replace(BASE, machine="laptop-3", up_s=2.0, services=("planner", "console"))
    first, second = objection(BASE, late), objection(late, BASE)
    assert first is not None
    assert second is not None
    assert (first.ends_us, second.ends_us) == (False, True)
    assert second.words == ("desk-9 (offboard) has started planner already; leave it out on one of the two: --without planner")
    twins = objection(BASE, replace(BASE, machine="e")), objection(replace(BASE, machine="e"), BASE)
    assert sorted(one.ends_us for one in twins if one is not None) == [False, True], "at the same moment, exactly one"


def test_they_meet_whoever_is_first_and_say_who_comes_and_goes() -> None:
    clock, wire = [0], Wire()
    base = Machine(wire, clock, "desk-9", "offboard", "mapper", "planner")
    beats(clock, 3.0, base)
    assert base.said == []
    assert base.link.health[-1].doing == "alone so far"
    robot = Machine(wire, clock, "hexapod-7", "onboard", "actuator")
    beats(clock, 3.0, base, robot)
    assert base.said == ["hexapod-7 (onboard) is here: actuator"]
    assert robot.said == ["desk-9 (offboard) is here: mapper, planner"]
    assert base.link.health[-1].doing == "together with hexapod-7 (onboard)"
    beats(clock, 6.0, robot)
    assert robot.said[1:] == ["nothing has been heard of desk-9 (offboard) for 5 s"]
    assert robot.link.health[-1].doing == "alone so far"
    beats(clock, 3.0, base, robot)
    assert robot.said[2:] == ["desk-9 (offboard) is back"]
    assert base.meeting.refused == robot.meeting.refused == ""


def test_who_does_not_fit_is_told_once_and_ends() -> None:
    clock, wire = [0], Wire()
    robot = Machine(wire, clock, "hexapod-7", "onboard", "actuator", "planner", version="0.3.0")
    beats(clock, 1.0, robot)
    base = Machine(wire, clock, "desk-9", "offboard", "mapper", "planner")
    beats(clock, 4.0, robot, base)
    assert not robot.meeting.refused
    assert "has started planner already" in base.meeting.refused
    assert sum("planner already" in words for words in robot.said) == 1
    assert "it runs Sextant 0.3.0, here is 0.1.0" in base.said
    assert "planner already" in robot.link.health[-1].doing, "the console shows it"


def test_a_machine_that_speaks_otherwise_is_named() -> None:
    clock, wire = [0], Wire()
    robot = Machine(wire, clock, "hexapod-7", "onboard", "actuator")
    robot.link.frames.append(b"\x05\x00\x00\x00hello")
    robot.link.frames.append(of_another_version(BASE))
    beats(clock, 1.0, robot)
    assert "different versions" in robot.said[-1]
    assert "not understood" in robot.link.health[-1].doing
