"""Access policy of a router: loopback only, with certificates, or open to all."""

import re
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sextant.shared.wire import access, topics
from sextant.shared.wire.access import AccessError, Keys
from sextant.shared.wire.endpoint import fault, obstacle
from sextant.shared.wire.handshake import refusal

SECURE_ENDPOINT = "tls/0.0.0.0:7448"
WARNING = (
    "open without certificates: any client that reaches {endpoints} may command the robot, unencrypted; use this only on a "
    "private network, or make certificates with `sextant keys new` and give --keys instead of --open"
)

# For each process, a topic that it alone publishes, of those read on other machines.
PUBLISHED_BY: Mapping[str, topics.Topic[Any]] = {
    "actuator": topics.ACTUATOR_STATE,
    "perception": topics.BODY_POSE,
    "mapper": topics.TERRAIN,
    "planner": topics.STEP_PLAN,
    "recorder": topics.RECORDER_STATE,
}


@dataclass(frozen=True, slots=True)
class Gate:
    """The endpoints of a router, and its access policy."""

    listen: tuple[str, ...]
    namespace: str = "sextant"
    keys: Path | None = None  # folder of this machine's keys, for tls endpoints
    open: bool = False  # whether any client is accepted at endpoints beyond loopback
    upstream: tuple[str, ...] = ()  # endpoints of other machines' routers to which this one connects

    def __post_init__(self) -> None:
        if wrong := fault((*self.listen, *self.upstream)):
            raise AccessError(wrong)
        elsewhere = access.plain_elsewhere(self.listen)
        secure = [endpoint for endpoint in self.listen if endpoint.startswith("tls/")]
        chained = access.plain_elsewhere(self.upstream)
        if chained and not self.open:
            raise AccessError(
                f"{', '.join(chained)} is another machine without certificates: any client there or in between may command the "
                "robot; connect to its tls endpoint with --keys DIR, or give --open to go without certificates"
            )
        if elsewhere and not self.open:
            raise AccessError(
                f"{', '.join(elsewhere)} would admit any client that reaches it: give --keys DIR, listen on {SECURE_ENDPOINT} "
                "(`sextant keys new` makes keys), or give --open to admit any client"
            )
        secure += [endpoint for endpoint in self.upstream if endpoint.startswith("tls/")]
        if secure and self.keys is None:
            raise AccessError(f"{', '.join(secure)} needs certificates: give --keys DIR, which `sextant keys new` makes")
        if self.keys is not None and not secure:
            raise AccessError(
                f"--keys needs a tls endpoint, e.g. {SECURE_ENDPOINT}, found {', '.join(self.listen + self.upstream)}"
            )
        if self.open and self.keys is not None:
            raise AccessError("either --keys or --open expected, found both")

    @property
    def guarded(self) -> bool:
        """Whether this router may refuse clients."""
        return self.open or self.keys is not None

    @property
    def secure(self) -> tuple[str, ...]:
        """Endpoints for other machines with certificates."""
        return tuple(endpoint for endpoint in self.listen if endpoint.startswith("tls/"))

    def behind_proxy(self, port: int) -> tuple[str, ...]:
        """Return the router's endpoints, with one loopback endpoint for the TLS proxy.

        It replaces the tls endpoints.

        Raises:
            AccessError: The keys have no certificates for it.
        """
        plain = tuple(endpoint for endpoint in self.listen if endpoint not in self.secure)
        if not self.secure or self.keys is None:
            return plain
        return (*plain, Keys.load(self.keys).behind_proxy(port))

    @property
    def own(self) -> str:
        """Endpoint for processes of this machine."""
        return re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", self.listen[0])

    @property
    def name(self) -> str:
        """Service name of the router, unique among all machines."""
        return f"{access.ROUTER_OF}{Keys.load(self.keys).role.name}" if self.keys is not None else "router"

    def role(self, offboard: bool) -> str:
        """Return the role of this machine.

        That is the role of its certificate. Without one, it is the robot, or a base station if `offboard`.
        """
        return Keys.load(self.keys).role.name if self.keys is not None else "base" if offboard else "robot"

    def configuration(self) -> Mapping[str, Any]:
        """Return the Zenoh configuration of access control.

        Raises:
            AccessError: The keys are wrong.
        """
        if self.keys is not None:
            self.behind_proxy(0)  # raises if its certificates are missing
            return Keys.load(self.keys).hosting(self.namespace, limited=bool(self.secure))
        if self.open:
            return access.opened(self.namespace, [name for _, name in socket.if_nameindex() if name != "lo"])
        return {}

    def knock(self) -> str:
        """Return why another machine's router does not accept this one, or ""."""
        keys = Keys.load(self.keys) if self.keys is not None else None
        refused = (refusal(one, keys) if keys and one.startswith("tls/") else obstacle(one) for one in self.upstream)
        return "; ".join(filter(None, refused))

    def misplaced(self, processes: Sequence[str]) -> str:
        """Return which processes cannot publish to the upstream machine and why, or "".

        Their messages are refused there because of this machine's role.
        """
        if self.keys is None or not self.upstream:
            return ""
        keys = Keys.load(self.keys)
        barred = [name for name in processes if name in PUBLISHED_BY and keys.refusal([PUBLISHED_BY[name]])]
        refused = keys.refusal([PUBLISHED_BY[name] for name in barred])
        return f"{', '.join(barred)} would be refused: {refused}; or leave out with --without" if refused else ""

    def warning(self) -> str:
        """Return the warning for an open router, or an empty string."""
        return WARNING.format(endpoints=", ".join(access.plain_elsewhere(self.listen + self.upstream))) if self.open else ""

    def words(self) -> tuple[str, ...]:
        """Return the arguments of the router's process."""
        listen = [word for endpoint in self.listen for word in ("--listen", endpoint)]
        listen += [word for endpoint in self.upstream for word in ("--connect", endpoint)]
        keys = ["--keys", str(self.keys.resolve())] if self.keys is not None else []
        return (*listen, "--namespace", self.namespace, *keys, *(["--open"] if self.open else []))


def of_arguments(
    listen: Sequence[str], keys: str | None, open_: bool, namespace: str, plain: str, upstream: tuple[str, ...] = ()
) -> Gate:
    """Build a gate from command-line arguments.

    Args:
        listen: Endpoints. With keys but without a tls endpoint or `upstream`, the default tls endpoint is added.
        keys: Folder of this machine's keys.
        open_: Whether any client is accepted.
        namespace: Prefix of every key.
        plain: Endpoint on loopback for this machine's own processes, if `listen` has none.
        upstream: Endpoints of other machines' routers.
    """
    secure = [endpoint for endpoint in listen if endpoint.startswith("tls/")]
    others = [endpoint for endpoint in listen if not endpoint.startswith("tls/")]
    if keys is not None and not secure and not upstream:
        secure = [SECURE_ENDPOINT]
    return Gate((*(others or [plain]), *secure), namespace, Path(keys) if keys is not None else None, open_, upstream)
