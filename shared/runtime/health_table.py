"""Bounded table of the newest health of every service, by role and name."""

from collections.abc import Mapping

from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Health

MOST_SERVICES = 32  # of one role; further names are ignored until one is forgotten
FORGOTTEN_NS = 300_000_000_000  # [ns] without health after which a service is forgotten
_FRESH_NS = 5_000_000_000  # [ns] since its last health for which a role counts as present
_NAME_LENGTH = 64  # [characters] longer names are truncated


class HealthTable:
    """Newest health of every service.

    Each role has its own names, so other roles cannot use or displace them.
    """

    def __init__(self) -> None:
        self._services: dict[str, dict[str, tuple[Health, int]]] = {role: {} for role in topics.ROLE_NAMES}

    def drain(self, inbox: Inbox, now_ns: int) -> None:
        """Add the health messages of an inbox that subscribes to `topics.HEALTH_OF`."""
        for role, topic in topics.HEALTH_OF.items():
            for health in inbox.drain(topic):
                self.add(role, health, now_ns)
        self.forget(now_ns)

    def add(self, role: str, health: Health, now_ns: int) -> None:
        """Add one health message received under the key of a role."""
        services, name = self._services[role], health.service[:_NAME_LENGTH]
        if name in services or len(services) < MOST_SERVICES:
            services[name] = health, now_ns

    def forget(self, now_ns: int) -> None:
        """Remove services that have been silent for `FORGOTTEN_NS`."""
        for services in self._services.values():
            for name in [name for name, (_, at_ns) in services.items() if now_ns - at_ns > FORGOTTEN_NS]:
                del services[name]

    def named(self) -> Mapping[str, tuple[Health, int]]:
        """Return name -> newest health and its arrival time [ns].

        The role is appended to the name of a service that is not the robot's.
        """
        return {
            name if role == "robot" else f"{name} ({role})": found
            for role, services in self._services.items()
            for name, found in services.items()
        }

    def roles(self, now_ns: int) -> frozenset[str]:
        """Return the roles with a health message in the last five seconds."""
        return frozenset(
            role
            for role, services in self._services.items()
            if any(now_ns - at_ns <= _FRESH_NS for _, at_ns in services.values())
        )
