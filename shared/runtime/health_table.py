"""The newest health of every service, by the role under which it came and the name that it claims; bounded, and it forgets."""

from collections.abc import Mapping

from sextant.shared.runtime.service import Inbox
from sextant.shared.wire import topics
from sextant.shared.wire.messages import Health

MOST_SERVICES = 32  # of a role; further names are left out until one is forgotten
FORGOTTEN_NS = 300_000_000_000  # [ns] without health, after which a service is forgotten
_FRESH_NS = 5_000_000_000  # [ns] within which the health of a role counts as that of a machine that is there
_NAME_LENGTH = 64  # [characters] that are kept of a name


class HealthTable:
    """Takes health in as it comes. A name counts within its role: no other role can take it, or crowd it out."""

    def __init__(self) -> None:
        self._services: dict[str, dict[str, tuple[Health, int]]] = {role: {} for role in topics.ROLE_NAMES}

    def drain(self, inbox: Inbox, now_ns: int) -> None:
        """Take in what has come to an inbox, which reads `topics.HEALTH_OF`."""
        for role, topic in topics.HEALTH_OF.items():
            for health in inbox.drain(topic):
                self.add(role, health, now_ns)
        self.forget(now_ns)

    def add(self, role: str, health: Health, now_ns: int) -> None:
        """Take in one health that came under the key of a role."""
        services, name = self._services[role], health.service[:_NAME_LENGTH]
        if name in services or len(services) < MOST_SERVICES:
            services[name] = health, now_ns

    def forget(self, now_ns: int) -> None:
        """Drop the services that have been silent for long."""
        for services in self._services.values():
            for name in [name for name, (_, at_ns) in services.items() if now_ns - at_ns > FORGOTTEN_NS]:
                del services[name]

    def named(self) -> Mapping[str, tuple[Health, int]]:
        """Name -> newest health and when it came [ns]; the name of a service that is not the robot's has its role behind."""
        return {
            name if role == "robot" else f"{name} ({role})": found
            for role, services in self._services.items()
            for name, found in services.items()
        }

    def roles(self, now_ns: int) -> frozenset[str]:
        """Roles of which a service has published its health lately."""
        return frozenset(
            role
            for role, services in self._services.items()
            if any(now_ns - at_ns <= _FRESH_NS for _, at_ns in services.values())
        )
