"""Discovery of the machines of one robot.

Each machine publishes its version and the services that it has started. Such a message from another machine is only a claim. It
never ends a running service: a conflict is reported, and shown in `health`. Only a machine that has not started its services
yet refuses to start them. The key of a machine's presence contains the role of its certificate. The presence counts only for
services that this role may run.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from sextant.deploy.launch.process_table import ON_ROBOT
from sextant.deploy.security.router_security import PUBLISHED_BY
from sextant.shared.runtime.zenoh_runner import Link
from sextant.shared.wire import codec, topics
from sextant.shared.wire.access import ROLE_NAMED
from sextant.shared.wire.messages import Health, Presence

PERIOD_NS = 1_000_000_000
SILENT_NS = 5_000_000_000  # [ns] without a message after which another machine counts as away
FORGOTTEN_NS = 60_000_000_000  # [ns] after which it is forgotten
MOST_MACHINES = 8  # for each role; further machines are refused until one is forgotten
_MEET_NS = 1_250_000_000  # from the first presence to the start of services: by then, each machine has published once
_ALONE_NS = 3_000_000_000  # after which a machine starts without any presence from others
_FEW = 4  # maximum number of keys in a report
_NAME_LENGTH = 64  # [characters] shown of another machine's name, version and services
_REPORTED = 64  # number of reports remembered, to report each only once


@dataclass(frozen=True, slots=True)
class Objection:
    """A conflict between two machines."""

    words: str
    bars_start: bool  # whether it prevents the start of this machine


def presence(machine: str, role: str, version: str, services: Iterable[str], up_s: float, now_ns: int) -> Presence:
    """Return the presence message of this machine.

    Args:
        machine: Unique name of this start.
        role: Role that was started.
        version: Version of Sextant.
        services: Services that it has started.
        up_s: [s] since the start.
        now_ns: [ns] by its own clock.
    """
    keys = tuple(topic.key for topic in topics.TOPICS)
    schemas = tuple(codec.schema_id(topic.type) for topic in topics.TOPICS)
    return Presence(now_ns, machine, role, version, up_s, tuple(services), keys, schemas)


def objection(own: Presence, other: Presence, other_role: str) -> Objection | None:
    """Return the conflict between this machine and another one, or None.

    Args:
        own: Presence of this machine.
        other: Presence of the other machine.
        other_role: Role of the other's certificate, from the key of its presence.
    """
    theirs = dict(zip(other.keys, other.schemas, strict=False))
    misread = [key for key, schema in zip(own.keys, own.schemas, strict=True) if theirs.get(key, schema) != schema]
    if misread:
        named = ", ".join(misread[:_FEW]) + (f" and {len(misread) - _FEW} more" if len(misread) > _FEW else "")
        words = (
            f"{_named(other)} runs Sextant {_short(other.version)}, this machine {own.version}, with different messages for "
            f"{named}; install the same version on both machines"
        )
        return Objection(words, own.role == "offboard" and other_role == "robot")
    twice = [service for service in own.services if service in other.services and may_run(other_role, service)]
    if twice:
        words = f"{_named(other)} already runs {', '.join(twice)}; leave {'it' if len(twice) == 1 else 'them'} out "
        came_later = (own.uptime_s, other.machine) < (other.uptime_s, own.machine)
        return Objection(words + f"on one of the two machines: --without {','.join(twice)}", came_later)
    return None


def may_run(role: str, service: str) -> bool:
    """Return whether a machine with a role's certificate may run a service.

    The robot may run all of them.
    """
    topic = PUBLISHED_BY.get(service)
    return role == "robot" or (service not in ON_ROBOT and (topic is None or topic in ROLE_NAMED[role].publishes))


def _named(other: Presence) -> str:
    return f"{_short(other.machine)} ({_short(other.role)})"


def _short(name: str) -> str:
    return name if len(name) <= _NAME_LENGTH else f"{name[:_NAME_LENGTH]}..."


@dataclass(slots=True)
class _Machine:
    role: str  # of its certificate
    presence: Presence
    at_ns: int  # when the presence was received
    away: bool = False


class PeerHandshake:
    """Publishes this machine's presence once a second, and tracks other machines."""

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
        """Subscribe to the other machines.

        Args:
            link: Connection to the other machines.
            machine: Unique name of this start.
            role: Role that is started.
            version: Version of Sextant.
            services: Services that are started.
            clock: [ns] this machine's monotonic clock.
            say: Called with a report of each machine that appears or disappears, and of each conflict.
            certificate_role: Role of this machine's certificate.
        """
        self._link, self._clock, self._say = link, clock, say
        self._about = (machine, role, version, tuple(services))
        self._presence_topic, self._health_topic = topics.PRESENCE_OF[certificate_role], topics.HEALTH_OF[certificate_role]
        self._began_ns = self._due_ns = clock()
        self._met_ns: int | None = None  # time of the first presence of another machine
        self._come = [(name, link.collect(topic)) for name, topic in topics.PRESENCE_OF.items()]
        self._machines: dict[tuple[str, str], _Machine] = {}  # by role and name
        self._reported: dict[str, None] = {}
        self._misread = ""

    @property
    def met(self) -> bool:
        """Whether services may be started.

        They may after the other machines have published, or after a while without any.
        """
        now_ns = self._clock()
        return (self._met_ns is not None and now_ns - self._met_ns >= _MEET_NS) or now_ns - self._began_ns >= _ALONE_NS

    @property
    def start_refusal(self) -> str:
        """Reason why this machine must not start its services now, or empty.

        It does not apply to running services.
        """
        found = self._objections(self._own(self._clock()))
        return next((one.words for one in found if one.bars_start), "")

    def beat(self) -> None:
        """Process received messages, and publish if it is time."""
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
                self._say(f"no message from {_named(machine.presence)} for {SILENT_NS * 1e-9:.0f} s")
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
            self._misread = f"another machine publishes messages that cannot be decoded here: {error}"
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
            self._say(f"{_named(other)} has connected, running {', '.join(map(_short, other.services[:_NAME_LENGTH]))}")
            if other.version != own.version:
                self._say(f"{_named(other)} runs Sextant {_short(other.version)}, this machine {own.version}")
        else:
            if machine.away:
                self._say(f"{_named(other)} has reconnected")
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
        doing = problems or self._misread or (f"connected to {with_whom}" if with_whom else "no other machine yet")
        nothing = np.zeros(0)
        return Health(now_ns, f"{own.role} on {own.machine}", doing[:500], 0, 0, 0, "", (), nothing, nothing)
