"""Who may say and hear what on the network: roles of certificates, and the Zenoh configuration that holds clients to them.

Deny by default. What a role may put and read is written down here by hand, for a robot has not all services installed that
would have to be asked; a test holds it to what the processes of the role write and read. Keys of the simulator are nobody's but
the machine's on which it runs, and a servo has none. What may be put is limited in size and rate at the listener, too.
"""

import ipaddress
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

from sextant.shared.files import input_file
from sextant.shared.wire import topics as t

AnyTopic: TypeAlias = t.Topic[Any]
CERTIFICATE, KEY, AUTHORITY, ROLE = "certificate.pem", "key.pem", "ca.pem", "role.toml"  # files of a folder of keys
PROXY = "proxy"  # folder within it: certificates between the TLS proxy and the router of one machine
ROUTER = "router"  # name of the router's own certificate there
SITE = "site"  # role of a router between others
ROUTER_OF = "router of "  # a role: name of a router among the services
PLAIN = ("tcp",)  # links without certificates, on loopback alone
SECURE = ("tls",)
_SLACK = 10.0  # times the rate of a topic that a client may put at
_LEAST_HZ = 200.0  # that it may put at, however slow the topic is
_EVENTS_HZ = 1000.0  # likewise, of topics all of whose messages count: a link that stalled delivers some at once
_ROOM = 1 << 16  # [B] of a message beside its payload
_ALL_MESSAGES = (
    *("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)


class AccessError(ValueError):
    """Keys that cannot be used or do not suffice, with what was expected and what to do."""


@dataclass(frozen=True, slots=True)
class Role:
    """What the holder of a certificate may do."""

    name: str  # common name of its certificate
    what: str  # who holds it, in words
    puts: tuple[AnyTopic, ...]
    reads: tuple[AnyTopic, ...]
    relays: tuple[AnyTopic, ...] = ()  # that its router passes on for others

    def refusal(self, written: Sequence[AnyTopic]) -> str:
        """Why what is to be put will not be let through, in words, or nothing."""
        barred = [topic.key for topic in written if topic not in self.puts]
        if not barred:
            return ""
        others = ", ".join(role.name for role in _ENDS if all(topic in role.puts for topic in written))
        may = ", ".join(topic.key for topic in self.puts) or "nothing"
        return (
            f"this certificate ({self.name}: {self.what}) may not send {', '.join(barred)}, only {may}; "
            f"use the keys of another role: {others or 'none may'}"
        )


def _of_roles(of: Mapping[str, AnyTopic], *names: str) -> tuple[AnyTopic, ...]:
    return tuple(of[name] for name in names)


def _own(name: str) -> tuple[AnyTopic, ...]:
    """How the processes of a role's machines fare, and which they are; a viewer's stay on its machine."""
    return (t.HEALTH_OF[name], t.PRESENCE_OF[name])


_HEARD_OF = ("robot", "base", "console", "site")  # on other machines
_HEALTHS, _PRESENCES = _of_roles(t.HEALTH_OF, *_HEARD_OF), _of_roles(t.PRESENCE_OF, *_HEARD_OF)
_SEEN: tuple[AnyTopic, ...] = (  # what a page shows, and what is small
    *(t.ACTUATOR_STATE, t.BODY_POSE, t.ODOMETRY, t.STEP_PLAN, t.PLANNER_STATUS, t.PASSAGE_PLAN, t.PASSAGE_REQUEST),
    *(t.CAMERA_STATE, t.TERRAIN, t.PREVIEW, t.RECORDER_STATE),
    *(t.VELOCITY, t.GOAL, t.MODE, t.STOP, t.RECORD),
    *_HEALTHS,
    *_PRESENCES,
)
_PLANNED = (t.SCAN_RECEIPT, t.TERRAIN, t.PASSAGE, t.PASSAGE_REQUEST, t.PASSAGE_PLAN, t.STEP_PLAN, t.PLANNER_STATUS)
_LED = (t.VELOCITY, t.GOAL, t.MODE, t.STOP, t.RECORD)
_ENDS = (  # whoever is at an end of what is said
    Role(
        "robot",
        "the robot's computer: actuator, stop, camera, perception",
        (t.DEPTH, t.COLOR, t.CAMERA_STATE, t.PREVIEW, t.ODOMETRY, t.ACTUATOR_STATE, t.BODY_POSE, t.SCAN, *_own("robot")),
        (t.STEP_PLAN, t.MODE, t.STOP, t.DEPTH, t.COLOR, t.ODOMETRY, t.ACTUATOR_STATE, t.IMU, t.SCAN_RECEIPT, *_PRESENCES),
        (*_own("base"), *_own("console")),
    ),
    Role(
        "base",
        "a computer beside the robot: mapper, planner, console, recorder",
        (*_PLANNED, *_LED, t.RECORDER_STATE, *_own("base")),
        (*_SEEN, t.SCAN, t.SCAN_RECEIPT, t.PASSAGE, t.IMU),
    ),
    Role("console", "an operator's computer: commands and looks, but plans nothing", (*_LED, *_own("console")), _SEEN),
    Role("viewer", "somebody's computer that looks on, and may stop", (t.STOP,), _SEEN),
)


def _together(groups: Iterable[tuple[AnyTopic, ...]]) -> tuple[AnyTopic, ...]:
    return tuple(dict.fromkeys(topic for group in groups for topic in group))


ROLES: tuple[Role, ...] = (
    *_ENDS,
    Role(
        SITE,
        "a router between a robot and others, which holds each of them to its role",
        _together((*(role.puts for role in _ENDS), _own(SITE))),
        _together(role.reads for role in _ENDS),
    ),
)
ROLE_NAMED: Mapping[str, Role] = {role.name: role for role in ROLES}


@dataclass(frozen=True, slots=True)
class Keys:
    """The folder with the certificate of this machine, its private key, and the authority whose certificates it takes."""

    folder: Path
    role: Role
    ends: datetime  # when the certificate does

    @classmethod
    def load(cls, folder: Path) -> "Keys":
        """Read a folder that `sextant keys new` has made.

        Raises:
            AccessError: Something is missing, or the certificate has ended.
        """
        missing = [name for name in (AUTHORITY, CERTIFICATE, KEY, ROLE) if not (folder / name).is_file()]
        if missing:
            hint = "; it has a folder for each role: name one of them" if (folder / "robot").is_dir() else ""
            raise AccessError(
                f"keys in {folder}: {', '.join(missing)} expected, not found{hint or '; `sextant keys new DIR` makes keys'}"
            )
        try:
            stated = input_file.read_toml(folder / ROLE)
        except input_file.FileError as error:
            raise AccessError(str(error)) from None
        name, end = stated.get("role"), stated.get("ends")
        dated = isinstance(end, datetime) and end.tzinfo is not None and 2000 <= end.year < 9000
        if not (isinstance(name, str) and name in ROLE_NAMED and isinstance(end, datetime) and dated):
            expected = f"a role of {', '.join(ROLE_NAMED)} and the time at which it ends"
            raise AccessError(f"{folder / ROLE}: {expected} expected, found {name!s:.60} and {end!s:.60}")
        role, ends = ROLE_NAMED[name], end.astimezone(UTC)
        found = cls(folder.resolve(), role, ends)
        if (left := found.days_left(datetime.now(UTC))) <= 0:
            raise AccessError(
                f"the certificate in {folder} ended {-left:.0f} days ago, on {ends:%Y-%m-%d}; `sextant keys new` makes new ones"
            )
        return found

    def days_left(self, now: datetime) -> float:
        """For how many days the certificate is good."""
        return (self.ends - now).total_seconds() / 86400.0

    def refusal(self, written: Sequence[AnyTopic]) -> str:
        """Why what is to be put will not be let through, in words, or nothing."""
        return self.role.refusal(written)

    def connecting(self) -> dict[str, Any]:
        """Zenoh configuration of who connects."""
        return {"transport": {"link": {"tls": self._tls("connect")}}}

    def hosting(self, namespace: str, limited: bool = True) -> dict[str, Any]:
        """Zenoh configuration of a router: mutual TLS to both sides, and each certificate that comes held to its role.

        What comes is `limited` in rate and size, but where it comes from the one router alone that this one has chosen.

        Links without certificates must be on loopback (`plain_elsewhere`): who is on this machine may do everything.
        """
        limits = _limits(namespace, {"link_protocols": list(SECURE)})
        transport = {"link": {"tls": self._tls("connect", "listen"), "rx": limits.pop("rx")}}
        return {"transport": transport, "access_control": _control(namespace), **(limits if limited else {})}

    def proxy_file(self, name: str) -> Path:
        """Return the certificate and private key of a role, or of the router, between the TLS proxy and the router.

        Raises:
            AccessError: The folder has none.
        """
        file = self.folder / PROXY / f"{name}.pem"
        if not file.is_file():
            raise AccessError(f"{file} is missing: these keys are of an older version; make new ones with `sextant keys new`")
        return file

    def behind_proxy(self, port: int) -> str:
        """Return the endpoint on which the router listens for the TLS proxy alone, on a port of 127.0.0.1.

        Raises:
            AccessError: The folder has no certificates for it, or a path that cannot be part of an endpoint.
        """
        return self._on_loopback("listen", port)

    def to_dialer(self, port: int) -> str:
        """Return the endpoint at which the router connects to the dialer of another machine, on a port of 127.0.0.1.

        Raises:
            AccessError: The folder has no certificates for it, or a path that cannot be part of an endpoint.
        """
        return self._on_loopback("connect", port)

    def _on_loopback(self, side: str, port: int) -> str:
        own = self.proxy_file(ROUTER)
        if any(sign in str(own) for sign in ";=#?"):
            raise AccessError(f"the folder of keys {self.folder} has one of ; = # ? in its path; move it to another")
        files = f"{side}_certificate_file={own};{side}_private_key_file={own}"
        return f"tls/127.0.0.1:{port}#root_ca_certificate_file={own.with_name(AUTHORITY)};{files}"

    def _tls(self, *sides: str) -> dict[str, Any]:
        own = {f"{side}_private_key": self._file(KEY) for side in sides}
        own |= {f"{side}_certificate": self._file(CERTIFICATE) for side in sides}
        checked = {"enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True}
        return {"root_ca_certificate": self._file(AUTHORITY), **checked, **own}

    def _file(self, name: str) -> str:
        return str(self.folder / name)


LOCAL_ROLES = tuple(role for role in ROLES if t.HEALTH_OF[role.name] not in role.puts)  # no other machine reads their health


def refusal_here(roles: Iterable[str], written: Sequence[AnyTopic]) -> str:
    """Why this machine's router refuses a publication, by the roles whose health is read here; empty if it does not.

    The health of a role in `LOCAL_ROLES` crosses no router, so the router that publishes it is this machine's own.
    """
    return next((why for role in LOCAL_ROLES if role.name in roles and (why := role.refusal(written))), "")


def plain_elsewhere(endpoints: Iterable[str]) -> tuple[str, ...]:
    """The endpoints that need no certificate and are not on loopback, e.g. tcp/0.0.0.0:7447."""
    return tuple(endpoint for endpoint in endpoints if not endpoint.startswith("tls/") and not _on_loopback(endpoint))


def _on_loopback(endpoint: str) -> bool:
    host = endpoint.partition("/")[2].partition("?")[0].partition("#")[0].rpartition(":")[0]
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def opened(namespace: str, interfaces: Iterable[str]) -> dict[str, Any]:
    """Zenoh configuration of who listens to anybody: only size and rate of messages are limited, where they come from outside.

    Args:
        namespace: Prefix of every key.
        interfaces: Network interfaces of this machine beside loopback; through others nobody is let in.
    """
    names = list(interfaces)
    anybody = Role("anybody", "", ROLE_NAMED[SITE].puts, ROLE_NAMED[SITE].reads)
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
    """A message goes one way, the declaration that it is wanted the other."""
    rows = (
        ("puts", "put", "ingress", role.puts + role.relays),
        ("puts-wanted", "declare_subscriber", "egress", role.puts + role.relays),
        ("reads", "put", "egress", role.reads),
        ("reads-wanted", "declare_subscriber", "ingress", role.reads),
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
    """How often a client may put a message of a topic; what comes sooner behind another is dropped at the listener."""
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
                "size_limit": topic.max_bytes + len(topic.address(namespace).encode()),  # which goes with a frame
            }
            for topic in t.TOPICS
        ],
    }
