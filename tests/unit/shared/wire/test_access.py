"""Each role may publish and read exactly what its processes publish and read."""

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from docs.reference.keys_page import _service
from sextant.deploy.launch.process_table import TABLE, rows
from sextant.deploy.security import access_page
from sextant.deploy.security.authority import Authority, held
from sextant.shared.recording.writer import LEFT_OUT
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import access, topics
from sextant.shared.wire.access import ROLE_NAMED, ROLES, SITE, AccessError, Keys, Role
from sextant.shared.wire.topics import TOPICS

HEARD_OF = ("robot", "base", "console", "site")  # presence of these roles is read on other machines
LOCAL: set[AnyTopic] = {topics.HEALTH_OF["viewer"], topics.PRESENCE_OF["viewer"]}
OF_THE_SIMULATOR = {topic for topic in TOPICS if topic.key.startswith("simulator/")}


def written_and_read(names: set[str], role: str) -> tuple[set[AnyTopic], set[AnyTopic]]:
    """Return the topics that processes publish and read on a machine of a role.

    Health and presence of the machine are included.
    """
    written: set[AnyTopic] = {topics.HEALTH_OF[role], topics.PRESENCE_OF[role]}
    read: set[AnyTopic] = {topics.PRESENCE_OF[name] for name in HEARD_OF}
    for process in TABLE:
        if process.name in names:
            service = _service(process.module)
            pace = getattr(service, "trigger", None)
            written |= set(service.publishes)
            subscribes = {*service.subscribes} - {topics.HEALTH_OF["viewer"]}  # it crosses no router
            read |= {*subscribes, *([pace] if isinstance(pace, topics.Topic) else [])}
    return written, read


@pytest.mark.parametrize(
    ("role", "processes"),
    [
        ("robot", {process.name for process in rows("onboard", simulated=False)}),
        ("base", {process.name for process in rows("offboard", simulated=False, page=True)}),
        ("console", {"console"}),
    ],
)
def test_role_may_publish_and_subscribe_as_its_processes_do(role: str, processes: set[str]) -> None:
    written, read = written_and_read(processes, role)
    held = ROLE_NAMED[role]
    # Of clients on these machines; no process sends them.
    commands = {topics.POSTURE, topics.CALIBRATION} if topics.VELOCITY in written else set()
    others = {"robot": {topics.EXTERNAL_POSE, topics.EXTERNAL_DEPTH}, "base": {topics.EXTERNAL_POSE}}  # of other programs
    assert set(held.publishes) == written | commands | others.get(role, set())
    assert set(held.subscribes) >= read


def test_robot_receives_only_topics_of_its_processes() -> None:
    _, read = written_and_read({process.name for process in rows("onboard", simulated=False)}, "robot")
    assert set(ROLE_NAMED["robot"].subscribes) == read


def test_base_recorder_receives_all_recorded_topics() -> None:
    heard = {*ROLE_NAMED["base"].subscribes, *ROLE_NAMED["base"].publishes}
    assert heard >= set(TOPICS) - LEFT_OUT - OF_THE_SIMULATOR - LOCAL


@pytest.mark.parametrize("role", ROLES, ids=lambda role: role.name)
def test_simulator_and_servos_are_unreachable_from_other_machines(role: Role) -> None:
    assert not {*role.publishes, *role.subscribes} & OF_THE_SIMULATOR
    assert not [topic.key for topic in TOPICS if "servo" in topic.key or "bus" in topic.key]


def test_only_planner_role_publishes_plans() -> None:
    assert [role.name for role in ROLES if topics.STEP_PLAN in role.publishes] == ["base", SITE], "a site passes on"
    assert [role.name for role in ROLES if topics.MODE in role.publishes] == ["base", "console", SITE]


OF_ROLES = {**{t: r for r, t in topics.HEALTH_OF.items()}, **{t: r for r, t in topics.PRESENCE_OF.items()}}


@pytest.mark.parametrize("role", [role for role in ROLES if role.name != SITE], ids=lambda role: role.name)
def test_health_and_presence_are_published_only_by_named_role(role: Role) -> None:
    """Publish health and presence by their own role only.

    A console cannot publish an actuator's health or a robot's presence. Only a robot publishes its time.
    """
    assert {OF_ROLES[topic] for topic in role.publishes if topic in OF_ROLES} <= {role.name}
    assert (topics.ACTUATOR_STATE in role.publishes) == (role.name == "robot"), "whose clock other machines follow"
    assert {OF_ROLES[topic] for topic in role.relays} <= {"base", "console"}
    assert not role.relays or role.name == "robot", "whose router is between machines"
    assert not LOCAL & {*role.publishes, *role.subscribes, *role.relays}


def test_router_refusal_is_accepted_only_from_its_role_key() -> None:
    order = [topics.MODE]
    assert "this certificate (viewer: " in access.refusal_here(["viewer", "robot"], order)
    assert access.refusal_here(["robot", "base", "console", "site"], order) == ""
    assert access.refusal_here(["viewer"], [topics.STOP]) == ""


def test_site_relays_topics_of_other_roles() -> None:
    site, ends = ROLE_NAMED[SITE], [role for role in ROLES if role.name != SITE]
    own = {topics.HEALTH_OF[SITE], topics.PRESENCE_OF[SITE]}
    assert set(site.publishes) == {topic for role in ends for topic in role.publishes} | own
    assert set(site.subscribes) == {topic for role in ends for topic in role.subscribes}


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    authority = Authority(days=30)
    for role in ROLES:
        authority.issue(folder / role.name, role.name)
    return folder


def rules(keys: Path, role: str) -> Iterator[tuple[str, str, str]]:
    """Yield (message, flow, key) of all that a role is allowed."""
    control = Keys.load(keys / "robot").hosting("here")["access_control"]
    (subject,) = (s for s in control["subjects"] if s.get("cert_common_names") == [role])
    allowed = {rule for policy in control["policies"] if subject["id"] in policy["subjects"] for rule in policy["rules"]}
    for rule in control["rules"]:
        if rule["id"] in allowed:
            assert rule["permission"] == "allow"
            for message in rule["messages"]:
                for flow in rule["flows"]:
                    for key in rule["key_exprs"]:
                        yield message, flow, key


@pytest.mark.parametrize("role", ROLES, ids=lambda role: role.name)
def test_allowed_keys_have_no_wildcards(role: Role, keys: Path) -> None:
    allowed = set(rules(keys, role.name))
    assert {key for _, _, key in allowed if "*" in key} == set()
    assert {key for message, flow, key in allowed if (message, flow) == ("put", "ingress")} == {
        f"here/{topic.key}" for topic in role.publishes + role.relays
    }
    assert {key for message, flow, key in allowed if (message, flow) == ("put", "egress")} == {
        f"here/{topic.key}" for topic in role.subscribes
    }
    assert {message for message, _, _ in allowed} == {"put", "declare_subscriber"}


def test_clients_without_certificate_are_limited_to_loopback(keys: Path) -> None:
    control = Keys.load(keys / "robot").hosting("here")["access_control"]
    assert control["default_permission"] == "deny"
    (own,) = (subject for subject in control["subjects"] if "cert_common_names" not in subject)
    assert own == {"id": "own", "link_protocols": ["tcp"], "interfaces": ["lo"]}


def test_every_key_has_rate_and_size_limit(keys: Path) -> None:
    listening = Keys.load(keys / "robot").hosting("here")
    rates = {rule["key_expr"]: rule["freq"] for rule in listening["downsampling"][0]["rules"]}
    sizes = {key: one["size_limit"] for one in listening["low_pass_filter"] for key in one["key_exprs"]}
    assert rates.keys() == sizes.keys() == {f"here/{topic.key}" for topic in TOPICS}
    for topic in TOPICS:
        assert 10.0 * topic.rate_hz <= rates[f"here/{topic.key}"] <= 1000.0
        assert sizes[f"here/{topic.key}"] == topic.max_bytes + len(f"here/{topic.key}"), "a frame and its address"
    assert listening["transport"]["link"]["rx"]["max_message_size"] < 10_000_000


def test_own_certificate_explains_refusal(keys: Path) -> None:
    viewer, console = Keys.load(keys / "viewer"), Keys.load(keys / "console")
    assert "this certificate (viewer: a viewer's computer" in viewer.refusal([topics.MODE])
    assert "may not send operator/mode" in viewer.refusal([topics.MODE])
    assert "keys of another role: base, console" in viewer.refusal([topics.MODE])
    assert console.refusal([topics.MODE, topics.GOAL]) == ""
    assert "may not send planner/step" in console.refusal([topics.MODE, topics.STEP_PLAN])


@pytest.mark.parametrize(
    ("broken", "hint"),
    [
        (lambda folder: (folder / access.KEY).unlink(), "key.pem expected, not found; `sextant keys new DIR` creates keys"),
        (
            lambda folder: (folder / access.ROLE).write_text('role = "king"\nends = 2100-01-01'),
            "robot, base, console",
        ),
        (lambda folder: (folder / access.ROLE).write_text("role = "), "role.toml: no valid TOML"),
        (lambda folder: (folder / access.ROLE).write_text('role = "base"\nends = "soon"'), "robot, base, console"),
    ],
)
def test_unusable_keys_are_refused_with_reason(broken: Callable[[Path], object], hint: str, tmp_path: Path) -> None:
    Authority(days=30).issue(tmp_path / "base", "base")
    broken(tmp_path / "base")
    with pytest.raises(AccessError, match=hint):
        Keys.load(tmp_path / "base")


def test_folder_of_all_roles_is_refused(keys: Path) -> None:
    with pytest.raises(AccessError, match="it contains a folder for each role: give one of these"):
        Keys.load(keys)


def test_expired_certificate_is_refused_by_holder(tmp_path: Path) -> None:
    now = datetime.now(UTC)
    Authority(days=30).issue(tmp_path / "base", "base", ends=now - timedelta(days=3))
    with pytest.raises(AccessError, match="expired 3 days ago"):
        Keys.load(tmp_path / "base")


@pytest.mark.parametrize(
    ("endpoint", "plain"),
    [
        ("tcp/127.0.0.1:7447", False),
        ("tcp/localhost:7447", False),
        ("tcp/[::1]:7447", False),
        ("tls/0.0.0.0:7448", False),
        ("tcp/0.0.0.0:7447", True),
        ("tcp/[::]:7447", True),
        ("udp/192.168.1.20:7447", True),
        ("quic/127.0.0.1.evil.example:7447", True),
        ("tcp/localhost.evil.example:7447", True),
    ],
)
def test_plain_endpoints_are_for_loopback_only(endpoint: str, plain: bool) -> None:
    assert access.plain_elsewhere([endpoint]) == ((endpoint,) if plain else ())


def test_open_access_keeps_limits_and_hides_simulator() -> None:
    opened = access.opened("here", ["eth0", "wlan0"])
    (limit,) = opened["downsampling"]
    assert limit["interfaces"] == ["eth0", "wlan0"]
    said = str([rule for rule in opened["access_control"]["rules"] if rule["id"] != "everything"])
    assert "here/operator/mode" in said
    assert "simulator" not in said


def test_documented_access_tables_match_rules() -> None:
    page = (Path(__file__).parents[4] / "docs" / "access.md").read_text(encoding="utf-8")
    for table in (access_page.roles(), access_page.keys()):
        assert "\n".join(table) in page, "made again: the lines of deploy/security/access_page.py"


@pytest.mark.parametrize("name", [access.CERTIFICATE, access.AUTHORITY, access.KEY])
@pytest.mark.parametrize("data", [b"", b"none", b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n", None])
def test_broken_certificate_file_is_named(name: str, data: bytes | None, tmp_path: Path) -> None:
    Authority(days=30).write(tmp_path / "ca")
    Authority(days=30).issue(tmp_path / "base", "base")
    for folder in ("ca", "base"):
        file = tmp_path / folder / name
        file.unlink(missing_ok=True)
        if data is None:
            file.mkdir()
        else:
            file.write_bytes(data)
    if name == access.CERTIFICATE:
        with pytest.raises(AccessError, match=name if data is not None else "no certificate.pem in"):
            list(held(tmp_path / "base"))
    else:
        with pytest.raises(AccessError, match=name):
            Authority.load(tmp_path / "ca")
