"""What a router is started with, by how it is to be met: on loopback alone, by certificates, or by anybody."""

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
    "open to anybody: whoever reaches {endpoints} may lead the robot, unencrypted and unasked; use it on a network of "
    "your own, or make certificates with `sextant keys new` and give --keys in place of --open"
)

PUBLISHED_BY: Mapping[str, topics.Topic[Any]] = {  # a topic that only the process publishes, of those read on other machines
    "actuator": topics.ACTUATOR_STATE,
    "perception": topics.BODY_POSE,
    "mapper": topics.TERRAIN,
    "planner": topics.STEP_PLAN,
    "recorder": topics.RECORDER_STATE,
}


@dataclass(frozen=True, slots=True)
class Gate:
    """Where a router listens and whom it lets in."""

    listen: tuple[str, ...]
    namespace: str = "sextant"
    keys: Path | None = None  # of this machine, for endpoints of tls
    open: bool = False  # whether anybody is let in, through endpoints beyond loopback
    upstream: tuple[str, ...] = ()  # endpoints of other machines' routers that this one is chained to

    def __post_init__(self) -> None:
        if wrong := fault((*self.listen, *self.upstream)):
            raise AccessError(wrong)
        elsewhere = access.plain_elsewhere(self.listen)
        secure = [endpoint for endpoint in self.listen if endpoint.startswith("tls/")]
        chained = access.plain_elsewhere(self.upstream)
        if chained and not self.open:
            raise AccessError(
                f"{', '.join(chained)} is another machine without certificates: whoever is there or in between may lead the "
                "robot; connect to its endpoint of tls with --keys DIR, or give --open to do without"
            )
        if elsewhere and not self.open:
            raise AccessError(
                f"{', '.join(elsewhere)} would let anybody in who reaches it: give --keys DIR and listen on {SECURE_ENDPOINT} "
                "(`sextant keys new` makes keys), or --open to let anybody in"
            )
        secure += [endpoint for endpoint in self.upstream if endpoint.startswith("tls/")]
        if secure and self.keys is None:
            raise AccessError(f"{', '.join(secure)} needs certificates: give --keys DIR, which `sextant keys new` makes")
        if self.keys is not None and not secure:
            raise AccessError(
                f"--keys is for endpoints of tls, e.g. {SECURE_ENDPOINT}, found {', '.join(self.listen + self.upstream)}"
            )
        if self.open and self.keys is not None:
            raise AccessError("either --keys or --open expected, found both")

    @property
    def guarded(self) -> bool:
        """Whether somebody may be refused here."""
        return self.open or self.keys is not None

    @property
    def secure(self) -> tuple[str, ...]:
        """Where other machines meet it, by certificates."""
        return tuple(endpoint for endpoint in self.listen if endpoint.startswith("tls/"))

    def behind_proxy(self, port: int) -> tuple[str, ...]:
        """Return the endpoints of the router, those of tls replaced by one of loopback for the TLS proxy alone.

        Raises:
            AccessError: The keys have no certificates for it.
        """
        plain = tuple(endpoint for endpoint in self.listen if endpoint not in self.secure)
        if not self.secure or self.keys is None:
            return plain
        return (*plain, Keys.load(self.keys).behind_proxy(port))

    @property
    def own(self) -> str:
        """Where processes of this machine meet it."""
        return re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", self.listen[0])

    @property
    def name(self) -> str:
        """Of the router, among the services of all machines."""
        return f"{access.ROUTER_OF}{Keys.load(self.keys).role.name}" if self.keys is not None else "router"

    def role(self, offboard: bool) -> str:
        """Role of this machine: that of its certificate, or without one the robot's or, `offboard`, that of a base."""
        return Keys.load(self.keys).role.name if self.keys is not None else "base" if offboard else "robot"

    def configuration(self) -> Mapping[str, Any]:
        """Zenoh configuration of who is let in.

        Raises:
            AccessError: The keys are wrong.
        """
        if self.keys is not None:
            self.behind_proxy(0)  # which may lack its certificates
            return Keys.load(self.keys).hosting(self.namespace, limited=bool(self.secure))
        if self.open:
            return access.opened(self.namespace, [name for _, name in socket.if_nameindex() if name != "lo"])
        return {}

    def knock(self) -> str:
        """Why another machine's router does not let this one in, in words, or nothing."""
        keys = Keys.load(self.keys) if self.keys is not None else None
        refused = (refusal(one, keys) if keys and one.startswith("tls/") else obstacle(one) for one in self.upstream)
        return "; ".join(filter(None, refused))

    def misplaced(self, processes: Sequence[str]) -> str:
        """That what is started here will not be heard by the machine that this one is chained to, in words, or nothing."""
        if self.keys is None or not self.upstream:
            return ""
        keys = Keys.load(self.keys)
        barred = [name for name in processes if name in PUBLISHED_BY and keys.refusal([PUBLISHED_BY[name]])]
        refused = keys.refusal([PUBLISHED_BY[name] for name in barred])
        return f"{', '.join(barred)} would not be heard: {refused}; or leave out with --without" if refused else ""

    def warning(self) -> str:
        """What must be said for as long as it is open, or nothing."""
        return WARNING.format(endpoints=", ".join(access.plain_elsewhere(self.listen + self.upstream))) if self.open else ""

    def words(self) -> tuple[str, ...]:
        """As arguments of the router's process."""
        listen = [word for endpoint in self.listen for word in ("--listen", endpoint)]
        listen += [word for endpoint in self.upstream for word in ("--connect", endpoint)]
        keys = ["--keys", str(self.keys.resolve())] if self.keys is not None else []
        return (*listen, "--namespace", self.namespace, *keys, *(["--open"] if self.open else []))


def of_arguments(
    listen: Sequence[str], keys: str | None, open_: bool, namespace: str, plain: str, upstream: tuple[str, ...] = ()
) -> Gate:
    """A gate as it is asked for.

    Args:
        listen: Endpoints; with keys and nothing else said, one of tls for other machines, unless it is chained to one.
        keys: Folder of this machine's.
        open_: Whether anybody may come in.
        namespace: Prefix of every key.
        plain: Endpoint on loopback for this machine's own processes, where none is among `listen`.
        upstream: Endpoints of other machines' routers.
    """
    secure = [endpoint for endpoint in listen if endpoint.startswith("tls/")]
    others = [endpoint for endpoint in listen if not endpoint.startswith("tls/")]
    if keys is not None and not secure and not upstream:
        secure = [SECURE_ENDPOINT]
    return Gate((*(others or [plain]), *secure), namespace, Path(keys) if keys is not None else None, open_, upstream)
