"""Access control: certificate roles, and the Zenoh configuration to enforce them.

Everything is denied by default. The topics of each role are listed here by hand, because a robot does not have all services
installed that could be queried; a test compares the lists with the topics of the services. No role includes the simulator's
topics, so they stay on the simulator's machine. The listener also limits the size and rate of publications.
"""

import ipaddress
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

from sextant.shared.errors import SextantError
from sextant.shared.files import input_file
from sextant.shared.wire import topics as t

AnyTopic: TypeAlias = t.Topic[Any]
CERTIFICATE, KEY, AUTHORITY, ROLE = "certificate.pem", "key.pem", "ca.pem", "role.toml"  # files of a key folder
PROXY = "proxy"  # subfolder with the certificates between the TLS proxy and the router of one machine
ROUTER = "router"  # name of the router's own certificate in that subfolder
SITE = "site"  # role of a router between other routers
ROUTER_OF = "router of "  # followed by a role: name of a router among the services
PLAIN = ("tcp",)  # links without certificates, on loopback only
SECURE = ("tls",)
_SLACK = 10.0  # factor of a topic's rate up to which a client may publish
_LEAST_HZ = 200.0  # publication rate that is always allowed, even for slow topics
_EVENTS_HZ = 1000.0  # the same for EVERY topics: a stalled link delivers several messages at once
_ROOM = 1 << 16  # [B] of a message besides its payload
_ALL_MESSAGES = (
    *("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)


class AccessError(SextantError, ValueError):
    """The keys are unusable or insufficient; the text gives what to do."""


@dataclass(frozen=True, slots=True)
class Role:
    """Permissions of a certificate."""

    name: str  # common name of the certificate
    what: str  # description of the machine that has it
    publishes: tuple[AnyTopic, ...]
    subscribes: tuple[AnyTopic, ...]
    relays: tuple[AnyTopic, ...] = ()  # published by other roles and forwarded by this role's router

    def refusal(self, written: Sequence[AnyTopic]) -> str:
        """Return why this role may not publish these topics, or an empty text."""
        barred = [topic.key for topic in written if topic not in self.publishes]
        if not barred:
            return ""
        others = ", ".join(role.name for role in _ENDS if all(topic in role.publishes for topic in written))
        may = ", ".join(topic.key for topic in self.publishes) or "nothing"
        return (
            f"this certificate ({self.name}: {self.what}) may not send {', '.join(barred)}, only {may}; "
            f"use the keys of another role: {others or 'no role may'}"
        )


def _of_roles(of: Mapping[str, AnyTopic], *names: str) -> tuple[AnyTopic, ...]:
    return tuple(of[name] for name in names)


def _own(name: str) -> tuple[AnyTopic, ...]:
    """Return the health and presence topics of a role.

    Those of a viewer stay on its own machine.
    """
    return (t.HEALTH_OF[name], t.PRESENCE_OF[name])


_HEARD_OF = ("robot", "base", "console", "site")  # roles whose health and presence other machines read
_HEALTHS, _PRESENCES = _of_roles(t.HEALTH_OF, *_HEARD_OF), _of_roles(t.PRESENCE_OF, *_HEARD_OF)
_SEEN: tuple[AnyTopic, ...] = (  # topics that the console displays, and small ones
    *(t.ACTUATOR_STATE, t.BODY_POSE, t.ODOMETRY, t.STEP_PLAN, t.PLANNER_STATUS, t.PASSAGE_PLAN, t.PASSAGE_REQUEST),
    *(t.CAMERA_STATE, t.CAMERA_ERRORS, t.HORN_ERRORS, t.TERRAIN, t.PREVIEW, t.RECORDER_STATE),
    *(t.VELOCITY, t.GOAL, t.POSTURE, t.CALIBRATION, t.MODE, t.STOP, t.RECORD),
    *_HEALTHS,
    *_PRESENCES,
)
_PLANNED = (t.SCAN_RECEIPT, t.TERRAIN, t.PASSAGE, t.PASSAGE_REQUEST, t.PASSAGE_PLAN, t.STEP_PLAN, t.PLANNER_STATUS)
_LED = (t.VELOCITY, t.GOAL, t.POSTURE, t.CALIBRATION, t.MODE, t.STOP, t.RECORD)
_SENSED = (t.DEPTH, t.COLOR, t.CAMERA_STATE, t.PREVIEW, t.IMU)
_PERCEIVED = (t.BODY_POSE, t.CAMERA_ERRORS, t.FLOOR, t.SCAN)
_OBEYED = (t.STEP_PLAN, t.MODE, t.STOP)
_EXTERNAL = (t.EXTERNAL_POSE, t.EXTERNAL_DEPTH)  # of other programs
_ENDS = (  # roles that publish or subscribe themselves, unlike a site router
    Role(
        "robot",
        "the robot's computer: actuator, stop, camera, IMU, perception",
        (*_SENSED, *_PERCEIVED, t.ODOMETRY, t.ACTUATOR_STATE, t.HORN_ERRORS, *_EXTERNAL, *_own("robot")),
        (*_OBEYED, t.DEPTH, t.COLOR, t.IMU, t.ODOMETRY, t.ACTUATOR_STATE, *_EXTERNAL, t.SCAN_RECEIPT, *_PRESENCES),
        (*_own("base"), *_own("console")),
    ),
    Role(
        "base",
        "a base computer next to the robot: mapper, planner, console, recorder",
        (*_PLANNED, *_LED, t.RECORDER_STATE, t.EXTERNAL_POSE, *_own("base")),
        (*_SEEN, t.FLOOR, t.SCAN, t.SCAN_RECEIPT, t.PASSAGE, t.IMU, t.EXTERNAL_POSE),
    ),
    Role(
        "console",
        "an operator's computer: commands and views, but does not plan",
        (*_LED, *_own("console")),
        (*_SEEN, t.FLOOR),
    ),
    Role("viewer", "a viewer's computer: views, and may stop the robot", (t.STOP,), _SEEN),
)


def _together(groups: Iterable[tuple[AnyTopic, ...]]) -> tuple[AnyTopic, ...]:
    return tuple(dict.fromkeys(topic for group in groups for topic in group))


ROLES: tuple[Role, ...] = (
    *_ENDS,
    Role(
        SITE,
        "a router between a robot and its clients, which enforces their roles",
        _together((*(role.publishes for role in _ENDS), _own(SITE))),
        _together(role.subscribes for role in _ENDS),
    ),
)
ROLE_NAMED: Mapping[str, Role] = {role.name: role for role in ROLES}


@dataclass(frozen=True, slots=True)
class Keys:
    """Key folder of this machine: certificate, private key and trusted authority."""

    folder: Path
    role: Role
    ends: datetime  # expiry of the certificate

    @classmethod
    def load(cls, folder: Path) -> "Keys":
        """Read a key folder made by `sextant keys new`.

        Raises:
            AccessError: A file is missing or invalid, or the certificate has expired.
        """
        missing = [name for name in (AUTHORITY, CERTIFICATE, KEY, ROLE) if not (folder / name).is_file()]
        if missing:
            hint = "; it contains a folder for each role: give one of these" if (folder / "robot").is_dir() else ""
            raise AccessError(
                f"keys in {folder}: {', '.join(missing)} expected, not found{hint or '; `sextant keys new DIR` creates keys'}"
            )
        try:
            stated = input_file.read_toml(folder / ROLE)
        except input_file.FileError as error:
            raise AccessError(str(error)) from None
        name, end = stated.get("role"), stated.get("ends")
        dated = isinstance(end, datetime) and end.tzinfo is not None and 2000 <= end.year < 9000
        if not (isinstance(name, str) and name in ROLE_NAMED and isinstance(end, datetime) and dated):
            expected = f"a role ({', '.join(ROLE_NAMED)}) and its end time"
            raise AccessError(f"{folder / ROLE}: {expected} expected, found {name!s:.60} and {end!s:.60}")
        role, ends = ROLE_NAMED[name], end.astimezone(UTC)
        found = cls(folder.resolve(), role, ends)
        if (left := found.days_left(datetime.now(UTC))) <= 0:
            raise AccessError(
                f"the certificate in {folder} expired {-left:.0f} days ago, on {ends:%Y-%m-%d}; "
                "make new keys with `sextant keys new`"
            )
        return found

    def days_left(self, now: datetime) -> float:
        """Return the days until the certificate expires."""
        return (self.ends - now).total_seconds() / 86400.0

    def refusal(self, written: Sequence[AnyTopic]) -> str:
        """Return why this machine may not publish these topics, or an empty text."""
        return self.role.refusal(written)

    def connecting(self) -> dict[str, Any]:
        """Return the Zenoh configuration of a client."""
        return {"transport": {"link": {"tls": self._tls("connect")}}}

    def hosting(self, namespace: str, limited: bool = True) -> dict[str, Any]:
        """Return the Zenoh configuration of a router.

        It uses mutual TLS in both directions and enforces the role of each connecting certificate. `limited` also limits the
        rate and size of incoming messages; it is False where they come only from the chosen upstream router.

        Links without certificates must be on loopback (`plain_elsewhere`), because local processes may do everything.
        """
        limits = _limits(namespace, {"link_protocols": list(SECURE)})
        transport = {"link": {"tls": self._tls("connect", "listen"), "rx": limits.pop("rx")}}
        return {"transport": transport, "access_control": _control(namespace), **(limits if limited else {})}

    def proxy_file(self, name: str) -> Path:
        """Return the file with certificate and private key of a role, or of the router.

        It is for links between the TLS proxy and the router.

        Raises:
            AccessError: The file is missing.
        """
        file = self.folder / PROXY / f"{name}.pem"
        if not file.is_file():
            raise AccessError(f"{file} is missing: these keys are of an older version; make new ones with `sextant keys new`")
        return file

    def behind_proxy(self, port: int) -> str:
        """Return the endpoint on which the router listens for the TLS proxy only.

        It is a port of 127.0.0.1.

        Raises:
            AccessError: The folder has no certificates for it, or its path cannot be part of an endpoint.
        """
        return self._on_loopback("listen", port)

    def to_dialer(self, port: int) -> str:
        """Return the endpoint for the router's connection to another machine's dialer.

        It is a port of 127.0.0.1.

        Raises:
            AccessError: The folder has no certificates for it, or its path cannot be part of an endpoint.
        """
        return self._on_loopback("connect", port)

    def _on_loopback(self, side: str, port: int) -> str:
        own = self.proxy_file(ROUTER)
        if any(sign in str(own) for sign in ";=#?"):
            raise AccessError(f"the folder of keys {self.folder} has one of ; = # ? in its path; move it to another path")
        files = f"{side}_certificate_file={own};{side}_private_key_file={own}"
        return f"tls/127.0.0.1:{port}#root_ca_certificate_file={own.with_name(AUTHORITY)};{files}"

    def _tls(self, *sides: str) -> dict[str, Any]:
        own = {f"{side}_private_key": self._file(KEY) for side in sides}
        own |= {f"{side}_certificate": self._file(CERTIFICATE) for side in sides}
        checked = {"enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True}
        return {"root_ca_certificate": self._file(AUTHORITY), **checked, **own}

    def _file(self, name: str) -> str:
        return str(self.folder / name)


LOCAL_ROLES = tuple(
    role for role in ROLES if t.HEALTH_OF[role.name] not in role.publishes
)  # their health stays on their machine


def refusal_here(roles: Iterable[str], written: Sequence[AnyTopic]) -> str:
    """Return why this machine's router refuses a publication, or an empty text.

    `roles` are the roles whose health messages arrive here. The health of a role in `LOCAL_ROLES` does not cross routers, so
    its presence shows that this machine's own router has that role.
    """
    return next((why for role in LOCAL_ROLES if role.name in roles and (why := role.refusal(written))), "")


def plain_elsewhere(endpoints: Iterable[str]) -> tuple[str, ...]:
    """Return the endpoints without certificates that are not on loopback.

    An example is tcp/0.0.0.0:7447.
    """
    return tuple(endpoint for endpoint in endpoints if not endpoint.startswith("tls/") and not _on_loopback(endpoint))


def _on_loopback(endpoint: str) -> bool:
    host = endpoint.partition("/")[2].partition("?")[0].partition("#")[0].rpartition(":")[0]
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def opened(namespace: str, interfaces: Iterable[str]) -> dict[str, Any]:
    """Return the Zenoh configuration of a router for clients without certificates.

    Messages from other machines are limited in size and rate, and to the topics of a site router.

    Args:
        namespace: Prefix of every key.
        interfaces: Network interfaces of this machine besides loopback; all others are denied.
    """
    names = list(interfaces)
    anybody = Role("anybody", "", ROLE_NAMED[SITE].publishes, ROLE_NAMED[SITE].subscribes)
    subjects = [{"id": "own", "interfaces": ["lo"]}, *([{"id": "anybody", "interfaces": names}] if names else [])]
    limits = _limits(namespace, {"interfaces": names})
    rx = limits.pop("rx")
    control = {
        "enabled": True,
        "default_permission": "deny",
        "rules": [_everything(), *_rules(anybody, namespace)],
        "subjects": subjects,
        "policies": [{"rules": ["everything"], "subjects": ["own"]}, *(_policies(anybody, namespace) if names else [])],
    }
    return {"transport": {"link": {"rx": rx}}, "access_control": control, **(limits if names else {})}


def _control(namespace: str) -> dict[str, Any]:
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [_everything(), *(rule for role in ROLES for rule in _rules(role, namespace))],
        "subjects": [
            {"id": "own", "link_protocols": list(PLAIN), "interfaces": ["lo"]},
            *({"id": role.name, "link_protocols": list(SECURE), "cert_common_names": [role.name]} for role in ROLES),
        ],
        "policies": [
            {"rules": ["everything"], "subjects": ["own"]},
            *(policy for role in ROLES for policy in _policies(role, namespace)),
        ],
    }


def _everything() -> dict[str, Any]:
    return {
        "id": "everything",
        "messages": list(_ALL_MESSAGES),
        "flows": ["ingress", "egress"],
        "permission": "allow",
        "key_exprs": ["**"],
    }


def _rules(role: Role, namespace: str) -> list[dict[str, Any]]:
    """Return the rules of a role.

    Messages pass in one direction, and subscriptions in the other.
    """
    rows = (
        ("publishes", "put", "ingress", role.publishes + role.relays),
        ("publishes-wanted", "declare_subscriber", "egress", role.publishes + role.relays),
        ("reads", "put", "egress", role.subscribes),
        ("reads-wanted", "declare_subscriber", "ingress", role.subscribes),
    )
    return [
        {
            "id": f"{role.name}-{name}",
            "messages": [message],
            "flows": [flow],
            "permission": "allow",
            "key_exprs": [topic.address(namespace) for topic in allowed],
        }
        for name, message, flow, allowed in rows
        if allowed
    ]


def _policies(role: Role, namespace: str) -> list[dict[str, Any]]:
    return [{"rules": [rule["id"] for rule in _rules(role, namespace)], "subjects": [role.name]}]


def most_hz(topic: AnyTopic) -> float:
    """Return the maximum rate [Hz] of a client on a topic.

    The listener drops faster messages.
    """
    return max(_SLACK * topic.rate_hz, _EVENTS_HZ if topic.delivery is t.Delivery.EVERY else _LEAST_HZ)


def _limits(namespace: str, where: Mapping[str, Any]) -> dict[str, Any]:
    incoming = {**where, "flows": ["ingress"], "messages": ["put"]}
    return {
        "rx": {"max_message_size": max(topic.max_bytes for topic in t.TOPICS) + _ROOM},
        "downsampling": [
            {
                **incoming,
                "id": "rate",
                "rules": [{"key_expr": topic.address(namespace), "freq": most_hz(topic)} for topic in t.TOPICS],
            }
        ],
        "low_pass_filter": [
            {
                **incoming,
                "id": f"size-{topic.key.replace('/', '-')}",
                "key_exprs": [topic.address(namespace)],
                "size_limit": topic.max_bytes + len(topic.address(namespace).encode()),  # a frame carries its address
            }
            for topic in t.TOPICS
        ],
    }
