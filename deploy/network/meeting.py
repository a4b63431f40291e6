"""The machines of one robot meet: each publishes which version it runs and which services it has started.

What another machine publishes is a claim. It never ends anything that runs: a misfit is reported, and shown in `health`. Only
a machine that has not started its services yet refuses to start them. A machine's presence has the key of the role of its
certificate, and counts only for services that this role may run.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from sextant.deploy.network.gate import PUBLISHED_BY
from sextant.deploy.process_table import ON_ROBOT
from sextant.shared.runtime.zenoh_runner import Link
from sextant.shared.wire import codec, topics
from sextant.shared.wire.access import ROLE_NAMED
from sextant.shared.wire.messages import Health, Presence

PERIOD_NS = 1_000_000_000
SILENT_NS = 5_000_000_000  # after which another machine counts as away
FORGOTTEN_NS = 60_000_000_000  # after which it is forgotten
MOST_MACHINES = 8  # of a role; more are refused until one is forgotten
_MEET_NS = 1_250_000_000  # from the first presence to the start of services: each machine has published once by then
_ALONE_NS = 3_000_000_000  # after which a machine starts though no presence has come
_FEW = 4  # keys that are named
_NAME_LENGTH = 64  # [characters] of another machine's name, version and services, as they are shown
_REPORTED = 64  # reports that are remembered, so that each is made once


@dataclass(frozen=True, slots=True)
class Objection:
    """Why two machines do not fit."""

    words: str
    bars_start: bool  # whether this machine does not start for it


def presence(machine: str, role: str, version: str, services: Iterable[str], up_s: float, now_ns: int) -> Presence:
    """What a machine publishes of itself.

    Args:
        machine: Name of this start, unlike any other.
        role: That was started.
        version: Of Sextant.
        services: That it has started.
        up_s: [s] for how long.
        now_ns: [ns] by its own clock.
    """
    keys = tuple(topic.key for topic in topics.TOPICS)
    schemas = tuple(codec.schema_id(topic.type) for topic in topics.TOPICS)
    return Presence(now_ns, machine, role, version, up_s, tuple(services), keys, schemas)


def objection(own: Presence, other: Presence, other_role: str) -> Objection | None:
    """Why a machine does not fit with another, or None.

    Args:
        own: Presence of this machine.
        other: Presence of the other.
        other_role: Role of the other's certificate, by the key that its presence came under.
    """
    theirs = dict(zip(other.keys, other.schemas, strict=False))
    misread = [key for key, schema in zip(own.keys, own.schemas, strict=True) if theirs.get(key, schema) != schema]
    if misread:
        named = ", ".join(misread[:_FEW]) + (f" and {len(misread) - _FEW} more" if len(misread) > _FEW else "")
        words = (
            f"{_named(other)} runs Sextant {_short(other.version)}, here is {own.version}, and they mean different things by "
            f"{named}; install the same version on both"
        )
        return Objection(words, own.role == "offboard" and other_role == "robot")
    twice = [service for service in own.services if service in other.services and may_run(other_role, service)]
    if twice:
        words = f"{_named(other)} has started {', '.join(twice)} already; leave {'it' if len(twice) == 1 else 'them'} out "
        came_later = (own.up_s, other.machine) < (other.up_s, own.machine)
        return Objection(words + f"on one of the two: --without {','.join(twice)}", came_later)
    return None


def may_run(role: str, service: str) -> bool:
    """Whether a machine whose certificate has a role may run a service; the robot may run them all."""
    topic = PUBLISHED_BY.get(service)
    return role == "robot" or (service not in ON_ROBOT and (topic is None or topic in ROLE_NAMED[role].puts))


def _named(other: Presence) -> str:
    return f"{_short(other.machine)} ({_short(other.role)})"


def _short(name: str) -> str:
    return name if len(name) <= _NAME_LENGTH else f"{name[:_NAME_LENGTH]}..."


@dataclass(slots=True)
class _Machine:
    role: str  # of its certificate
    presence: Presence
    at_ns: int  # when that came
    away: bool = False


class Meeting:
    """Publishes once a second that this machine is here, and watches which others are."""

    def __init__(
        self,
        link: Link,
        machine: str,
        role: str,
        version: str,
        services: Iterable[str],
        clock: Callable[[], int],
        say: Callable[[str], object],
        certificate_role: str = "robot",
    ):
        """Subscribe.

        Args:
            link: To the others.
            machine: Name of this start, unlike any other.
            role: That is started.
            version: Of Sextant.
            services: That are started.
            clock: [ns] this machine's monotonic clock.
            say: Takes a report of each machine that comes or goes, and of each that does not fit.
            certificate_role: Of this machine's certificate.
        """
        self._link, self._clock, self._say = link, clock, say
        self._about = (machine, role, version, tuple(services))
        self._presence_topic, self._health_topic = topics.PRESENCE_OF[certificate_role], topics.HEALTH_OF[certificate_role]
        self._began_ns = self._due_ns = clock()
        self._met_ns: int | None = None  # when the first presence of another machine came
        self._come = [(name, link.collect(topic)) for name, topic in topics.PRESENCE_OF.items()]
        self._machines: dict[tuple[str, str], _Machine] = {}  # by role and name
        self._reported: dict[str, None] = {}
        self._misread = ""

    @property
    def met(self) -> bool:
        """Whether services may be started: the machines that are there have published, or none has for a while."""
        now_ns = self._clock()
        return (self._met_ns is not None and now_ns - self._met_ns >= _MEET_NS) or now_ns - self._began_ns >= _ALONE_NS

    @property
    def start_refusal(self) -> str:
        """Why this machine must not start its services now, or empty; it says nothing of services that run."""
        found = self._objections(self._own(self._clock()))
        return next((one.words for one in found if one.bars_start), "")

    def beat(self) -> None:
        """Take in what has come, and publish when that is due."""
        now_ns = self._clock()
        own = self._own(now_ns)
        for role, come in self._come:
            for frame in come():
                self._hear(own, role, frame, now_ns)
        for key, machine in list(self._machines.items()):
            if now_ns - machine.at_ns > FORGOTTEN_NS:
                del self._machines[key]
            elif now_ns - machine.at_ns > SILENT_NS and not machine.away:
                machine.away = True
                self._say(f"nothing has come from {_named(machine.presence)} for {SILENT_NS * 1e-9:.0f} s")
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + PERIOD_NS
            timing = codec.Timing(now_ns, now_ns)
            self._link.send(self._presence_topic, codec.encode(own, timing))
            self._link.send(self._health_topic, codec.encode(self._health(own, now_ns), timing))

    def _own(self, now_ns: int) -> Presence:
        return presence(*self._about, (now_ns - self._began_ns) * 1e-9, now_ns)

    def _hear(self, own: Presence, role: str, frame: bytes, now_ns: int) -> None:
        topic = topics.PRESENCE_OF[role]
        try:
            other, _ = codec.decode(frame, Presence, topic.max_bytes)
        except codec.DecodeError as error:
            self._misread = f"another machine publishes what is not understood here: {error}"
            self._report_once(self._misread)
            return
        if other.machine == own.machine:
            return
        machine = self._machines.get((role, other.machine))
        if machine is None:
            if sum(known == role for known, _ in self._machines) >= MOST_MACHINES:
                self._report_once(f"more than {MOST_MACHINES} machines claim the role {role}; the others are ignored")
                return
            self._machines[role, other.machine] = _Machine(role, other, now_ns)
            self._met_ns = now_ns if self._met_ns is None else self._met_ns
            self._say(f"{_named(other)} is here: {', '.join(map(_short, other.services[:_NAME_LENGTH]))}")
            if other.version != own.version:
                self._say(f"it runs Sextant {_short(other.version)}, here is {own.version}")
        else:
            if machine.away:
                self._say(f"{_named(other)} is back")
            machine.presence, machine.at_ns, machine.away = other, now_ns, False
        found = objection(own, other, role)
        if found is not None:
            self._report_once(found.words)

    def _report_once(self, words: str) -> None:
        if words not in self._reported:
            self._reported[words] = None
            if len(self._reported) > _REPORTED:
                del self._reported[next(iter(self._reported))]
            self._say(words)

    def _objections(self, own: Presence) -> list[Objection]:
        found = [objection(own, other.presence, other.role) for other in self._here()]
        return [one for one in found if one is not None]

    def _here(self) -> list[_Machine]:
        return [machine for machine in self._machines.values() if not machine.away]

    def _health(self, own: Presence, now_ns: int) -> Health:
        problems = "; ".join(one.words for one in self._objections(own))
        with_whom = ", ".join(_named(machine.presence) for machine in self._here())
        doing = problems or self._misread or (f"together with {with_whom}" if with_whom else "alone so far")
        nothing = np.zeros(0)
        return Health(now_ns, f"{own.role} on {own.machine}", doing[:500], 0, 0, 0, "", (), nothing, nothing)
