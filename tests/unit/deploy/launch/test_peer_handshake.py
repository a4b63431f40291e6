"""Compatibility checks between the machines of one robot.

An incompatible machine does not start, and is reported. No running machine ends.
"""

from collections.abc import Callable
from dataclasses import replace

import pytest

from sextant.deploy.launch import peer_handshake
from sextant.deploy.launch.peer_handshake import PeerHandshake, objection
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, topics
from sextant.shared.wire.messages import Health, Presence
from tests.support.frames import of_another_version

SEC = 1_000_000_000
ROBOT = peer_handshake.presence("hexapod-7", "onboard", "0.1.0", ("actuator", "perception"), 50.0, 0)
BASE = peer_handshake.presence("desk-9", "offboard", "0.1.0", ("mapper", "planner"), 20.0, 0)


def with_other_schemas(word: Presence, *keys: str) -> Presence:
    """Return the presence of a version with different declarations of some messages."""
    return replace(
        word,
        version="0.2.0",
        schemas=tuple("Other/1" if key in keys else schema for key, schema in zip(word.keys, word.schemas, strict=True)),
    )


class Wire:
    """A wire between machines: each message is sent to all of them."""

    def __init__(self) -> None:
        self.links: list[Wire.Link] = []

    class Link:
        """The link of one machine."""

        def __init__(self, wire: "Wire"):
            self.wire = wire
            self.frames: dict[str, list[bytes]] = {topic.key: [] for topic in topics.PRESENCE_OF.values()}
            self.health: list[Health] = []
            self.keys: set[str] = set()  # keys on which it published

        def send(self, topic: AnyTopic, frame: bytes) -> None:
            self.keys.add(topic.key)
            if topic in topics.HEALTH_OF.values():
                self.health.append(codec.decode(frame, Health)[0])
                return
            for link in self.wire.links:
                link.frames[topic.key].append(frame)

        def collect(self, topic: AnyTopic) -> Callable[[], list[bytes]]:
            def come() -> list[bytes]:
                frames, self.frames[topic.key] = self.frames[topic.key], []
                return frames

            return come

        def subscribe(self, topic: AnyTopic, receive: object):  # type: ignore[no-untyped-def]
            raise NotImplementedError

        def wanted(self, topic: AnyTopic) -> bool:
            return True

        astray = 0
        last_astray = ""

    def link(self) -> "Wire.Link":
        self.links.append(Wire.Link(self))
        return self.links[-1]


class Machine:
    """A machine that starts processes."""

    def __init__(
        self, wire: Wire, clock: list[int], name: str, role: str, *services: str, version: str = "0.1.0", certificate: str = ""
    ):
        self.said: list[str] = []
        self.link = wire.link()
        certificate = certificate or ("base" if role == "offboard" else "robot")
        self.meeting = PeerHandshake(self.link, name, role, version, services, lambda: clock[0], self.said.append, certificate)

    def hear(self, role: str, claim: Presence) -> None:
        """Receive a presence under the key of a role."""
        self.link.frames[topics.PRESENCE_OF[role].key].append(codec.encode(claim))


def run_machines(clock: list[int], seconds: float, *machines: Machine) -> None:
    for _ in range(round(seconds * 5)):
        clock[0] += SEC // 5
        for machine in machines:
            machine.meeting.beat()


def test_machines_of_same_schema_are_compatible() -> None:
    assert objection(ROBOT, BASE, "base") is None
    assert objection(BASE, ROBOT, "robot") is None
    newer = replace(BASE, version="0.1.1")
    assert objection(ROBOT, newer, "base") is None, "what they publish is what counts"


@pytest.mark.parametrize("base_up_s", [1.0, 500.0])
def test_schema_mismatch_prevents_start_of_base_but_not_of_robot(base_up_s: float) -> None:
    base = replace(with_other_schemas(BASE, "planner/step", "perception/scan"), uptime_s=base_up_s)
    at_robot, at_base = objection(ROBOT, base, "base"), objection(base, ROBOT, "robot")
    assert at_robot is not None
    assert at_base is not None
    assert not at_robot.bars_start
    assert at_base.bars_start
    assert "planner/step" in at_base.words
    assert "perception/scan" in at_base.words
    assert "hexapod-7 (onboard) runs Sextant 0.1.0, this machine 0.2.0" in at_base.words
    assert "install the same version on both" in at_base.words


def test_only_robot_presence_prevents_start_of_mismatched_base() -> None:
    found = objection(BASE, replace(with_other_schemas(ROBOT, "planner/step"), uptime_s=1e9), "console")
    assert found is not None
    assert not found.bars_start


def test_many_schema_differences_are_summarized() -> None:
    found = objection(ROBOT, with_other_schemas(BASE, *BASE.keys), "base")
    assert found is not None
    assert f"and {len(BASE.keys) - 4} more" in found.words


def test_topic_unknown_to_one_machine_is_no_mismatch() -> None:
    older = replace(BASE, keys=BASE.keys[:-2], schemas=BASE.schemas[:-2])
    assert objection(ROBOT, older, "base") is None
    assert objection(older, ROBOT, "robot") is None


def test_later_of_two_machines_with_same_service_does_not_start() -> None:
    late = replace(BASE, machine="laptop-3", uptime_s=2.0, services=("planner", "console"))
    first, second = objection(BASE, late, "base"), objection(late, BASE, "base")
    assert first is not None
    assert second is not None
    assert (first.bars_start, second.bars_start) == (False, True)
    assert second.words == (
        "desk-9 (offboard) already runs planner; leave it out on one of the two machines: --without planner"
    )
    twins = objection(BASE, replace(BASE, machine="e"), "base"), objection(replace(BASE, machine="e"), BASE, "base")
    assert sorted(one.bars_start for one in twins if one is not None) == [False, True], "at the same moment, exactly one"


@pytest.mark.parametrize(
    ("role", "service", "may"),
    [
        ("robot", "actuator", True),
        ("robot", "planner", True),
        ("base", "planner", True),
        ("base", "actuator", False),
        ("console", "planner", False),
        ("console", "stop", False),
        ("console", "console", True),
        ("viewer", "recorder", False),
    ],
)
def test_service_claim_counts_only_for_permitted_role(role: str, service: str, may: bool) -> None:
    assert peer_handshake.may_run(role, service) is may
    own = replace(BASE, services=(service,), uptime_s=0.0)
    claim = replace(ROBOT, services=(service,), uptime_s=1e9)
    assert (objection(own, claim, role) is not None) is may


@pytest.mark.parametrize("role", ["robot", "base", "console", "site"])
def test_presence_claim_never_ends_running_robot(role: str) -> None:
    """Keep a robot running for any presence that a certificate's holder may send.

    Here it is an earlier start of the same services, by another version.
    """
    clock, wire = [0], Wire()
    robot = Machine(wire, clock, "hexapod-7", "onboard", "actuator", "stop", "planner")
    run_machines(clock, 4.0, robot)
    claim = replace(
        with_other_schemas(ROBOT, "planner/step"), machine="z", uptime_s=1e9, services=("actuator", "stop", "planner")
    )
    for _ in range(20):
        robot.hear(role, claim)
        run_machines(clock, 0.2, robot)
    assert robot.said[0] == "z (onboard) has connected, running actuator, stop, planner"
    assert "z (onboard) runs Sextant 0.2.0, this machine 0.1.0" in robot.link.health[-1].status, "the console shows it"
    assert robot.link.health[-1].stamp_ns > clock[0] - SEC, "it goes on"
    assert not hasattr(robot.meeting, "refused"), "no message can end a running process"


def test_claimed_machines_are_bounded_and_expire() -> None:
    clock, wire = [0], Wire()
    robot = Machine(wire, clock, "hexapod-7", "onboard", "actuator")
    base = Machine(wire, clock, "desk-9", "offboard", "mapper")
    run_machines(clock, 2.0, robot, base)
    for number in range(2000):
        robot.hear("console", replace(BASE, machine=f"{number}" * 20, version="9" * 500, services=("x" * 1000,) * 50))
    run_machines(clock, 2.0, robot, base)
    assert len(robot.said) < 40
    assert max(map(len, robot.said)) < 5000
    assert any("more than 8 machines claim the role console" in words for words in robot.said)
    assert any(machine.presence.machine == "desk-9" for machine in robot.meeting._machines.values())
    run_machines(clock, 70.0, robot, base)
    assert [machine.presence.machine for machine in robot.meeting._machines.values()] == ["desk-9"]


def test_a_machine_publishes_under_the_role_of_its_certificate() -> None:
    clock, wire = [0], Wire()
    desk = Machine(wire, clock, "laptop-3", "offboard", "console", certificate="console")
    run_machines(clock, 2.0, desk)
    assert desk.link.keys == {"machine/presence/console", "health/console"}


def test_services_start_after_peer_presence_or_timeout() -> None:
    clock, wire = [0], Wire()
    alone = Machine(wire, clock, "desk-9", "offboard", "mapper")
    run_machines(clock, 2.8, alone)
    assert not alone.meeting.met
    run_machines(clock, 0.4, alone)
    assert alone.meeting.met
    second = Machine(wire, clock, "laptop-3", "offboard", "planner")
    run_machines(clock, 1.0, alone, second)
    assert not second.meeting.met, "another may publish within a second"
    run_machines(clock, 1.4, alone, second)
    assert second.meeting.met
    assert second.meeting.start_refusal == ""


def test_machines_connect_in_any_order_and_log_peer_changes() -> None:
    clock, wire = [0], Wire()
    base = Machine(wire, clock, "desk-9", "offboard", "mapper", "planner")
    run_machines(clock, 3.0, base)
    assert base.said == []
    assert base.link.health[-1].status == "no other machine yet"
    robot = Machine(wire, clock, "hexapod-7", "onboard", "actuator")
    run_machines(clock, 3.0, base, robot)
    assert base.said == ["hexapod-7 (onboard) has connected, running actuator"]
    assert robot.said == ["desk-9 (offboard) has connected, running mapper, planner"]
    assert base.link.health[-1].status == "connected to hexapod-7 (onboard)"
    run_machines(clock, 6.0, robot)
    assert robot.said[1:] == ["no message from desk-9 (offboard) for 5 s"]
    assert robot.link.health[-1].status == "no other machine yet"
    run_machines(clock, 3.0, base, robot)
    assert robot.said[2:] == ["desk-9 (offboard) has reconnected"]


def test_conflict_is_reported_once_and_prevents_start_of_later() -> None:
    clock, wire = [0], Wire()
    robot = Machine(wire, clock, "hexapod-7", "onboard", "actuator", "planner", version="0.3.0")
    run_machines(clock, 1.0, robot)
    base = Machine(wire, clock, "desk-9", "offboard", "mapper", "planner")
    run_machines(clock, 4.0, robot, base)
    assert not robot.meeting.start_refusal
    assert "already runs planner" in base.meeting.start_refusal
    assert sum("already runs planner" in words for words in robot.said) == 1
    assert "hexapod-7 (onboard) runs Sextant 0.3.0, this machine 0.1.0" in base.said
    assert "already runs planner" in robot.link.health[-1].status, "the console shows it"


def test_undecodable_presence_is_reported() -> None:
    clock, wire = [0], Wire()
    robot = Machine(wire, clock, "hexapod-7", "onboard", "actuator")
    robot.link.frames["machine/presence/base"] += [b"\x05\x00\x00\x00hello", of_another_version(BASE)]
    run_machines(clock, 1.0, robot)
    assert "the same version" in robot.said[-1]
    assert "cannot be decoded" in robot.link.health[-1].status
