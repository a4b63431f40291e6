"""The machines of one robot meet: each says which version it runs and what it has started, and none works with one it misreads.

Who starts order does not matter. Of two that do not fit, the one off the robot ends, or else the one that came later.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from shared import codec, topics
from shared.live import Link
from shared.messages import Health, Presence

PERIOD_NS = 1_000_000_000
SILENT_NS = 5_000_000_000  # after which another machine is taken to be away
_FEW = 4  # keys that are named


@dataclass(frozen=True, slots=True)
class Objection:
    """Why two machines do not fit."""

    words: str
    ends_us: bool  # it is we who end for it


def presence(machine: str, role: str, version: str, services: Iterable[str], up_s: float, now_ns: int) -> Presence:
    """What a machine says of itself.

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


def objection(own: Presence, other: Presence) -> Objection | None:
    """Why a machine does not fit with another, or nothing."""
    on_robot, other_on_robot = own.role != "offboard", other.role != "offboard"
    came_later = (own.up_s, other.machine) < (other.up_s, own.machine)
    theirs = dict(zip(other.keys, other.schemas, strict=False))
    misread = [key for key, schema in zip(own.keys, own.schemas, strict=True) if theirs.get(key, schema) != schema]
    if misread:
        named = ", ".join(misread[:_FEW]) + (f" and {len(misread) - _FEW} more" if len(misread) > _FEW else "")
        words = (
            f"{_named(other)} runs Sextant {other.version}, here is {own.version}, and they mean different things by {named}; "
            "install the same version on both"
        )
        return Objection(words, came_later if on_robot == other_on_robot else not on_robot)
    twice = [service for service in own.services if service in other.services]
    if twice:
        words = f"{_named(other)} has started {', '.join(twice)} already; leave {'it' if len(twice) == 1 else 'them'} out "
        return Objection(words + f"on one of the two: --without {','.join(twice)}", came_later)
    return None


def _named(other: Presence) -> str:
    return f"{other.machine} ({other.role})"


class Meeting:
    """Says once a second that this machine is here, and looks who else is."""

    def __init__(
        self,
        link: Link,
        machine: str,
        role: str,
        version: str,
        services: Iterable[str],
        clock: Callable[[], int],
        say: Callable[[str], object],
    ):
        """Begin to listen.

        Args:
            link: To the others.
            machine: Name of this start, unlike any other.
            role: That is started.
            version: Of Sextant.
            services: That are started.
            clock: [ns] this machine's monotonic clock.
            say: Is told who comes and goes, and who does not fit.
        """
        self.refused = ""  # why this machine has to end
        self._link, self._clock, self._say = link, clock, say
        self._about = (machine, role, version, tuple(services))
        self._began_ns = self._due_ns = clock()
        self._come = link.collect(topics.PRESENCE)
        self._others: dict[str, tuple[Presence, int]] = {}  # by machine, with the time [ns] of the newest word
        self._away: set[str] = set()
        self._told: set[str] = set()
        self._misread = ""

    def beat(self) -> None:
        """Do what is due."""
        now_ns = self._clock()
        own = presence(*self._about, (now_ns - self._began_ns) * 1e-9, now_ns)
        for frame in self._come():
            self._hear(own, frame, now_ns)
        for machine, (other, at_ns) in self._others.items():
            if now_ns - at_ns > SILENT_NS and machine not in self._away:
                self._away.add(machine)
                self._say(f"nothing has been heard of {_named(other)} for {SILENT_NS * 1e-9:.0f} s")
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + PERIOD_NS
            self._link.send(topics.PRESENCE, codec.encode(own, codec.Timing(now_ns, now_ns)))
            self._link.send(topics.HEALTH, codec.encode(self._health(own, now_ns), codec.Timing(now_ns, now_ns)))

    def _hear(self, own: Presence, frame: bytes, now_ns: int) -> None:
        try:
            other, _ = codec.decode(frame, Presence, topics.PRESENCE.max_bytes)
        except codec.DecodeError as error:
            self._misread = f"another machine says what is not understood here: {error}"
            self._tell_once(self._misread)
            return
        if other.machine == own.machine:
            return
        known = other.machine in self._others
        self._others[other.machine] = other, now_ns
        if not known:
            self._say(f"{_named(other)} is here: {', '.join(other.services)}")
            if other.version != own.version:
                self._say(f"it runs Sextant {other.version}, here is {own.version}")
        elif other.machine in self._away:
            self._away.discard(other.machine)
            self._say(f"{_named(other)} is back")
        found = objection(own, other)
        if found is not None:
            self._tell_once(found.words)
            if found.ends_us:
                self.refused = self.refused or found.words

    def _tell_once(self, words: str) -> None:
        if words not in self._told:
            self._told.add(words)
            self._say(words)

    def _health(self, own: Presence, now_ns: int) -> Health:
        found = [objection(own, other) for machine, (other, _) in self._others.items() if machine not in self._away]
        problems = [one.words for one in found if one is not None]
        with_whom = ", ".join(_named(other) for machine, (other, _) in self._others.items() if machine not in self._away)
        doing = "; ".join(problems) or self._misread or (f"together with {with_whom}" if with_whom else "alone so far")
        nothing = np.zeros(0)
        return Health(now_ns, f"{own.role} on {own.machine}", doing[:500], 0, 0, 0, "", (), nothing, nothing)
