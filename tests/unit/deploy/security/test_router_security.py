"""Refusals of a secured router, by real connections on loopback.

No message of an unauthorized client comes through.
"""

import contextlib
import dataclasses
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from sextant.deploy import cli
from sextant.deploy.commands import up
from sextant.deploy.security import router_security
from sextant.deploy.security.hosting import hosted
from sextant.deploy.security.router_security import Gate
from sextant.shared.wire import topics
from sextant.shared.wire.access import PROXY, ROLES, AccessError, Keys
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.transport import Endpoints, TransportError, ZenohLink
from tests.support import gated
from tests.support.gated import NAMESPACE, Inside, again, put_until, session, stranger, tls_of

N = 200  # unauthorized messages of each kind
CLAIMED = (*topics.HEALTH_OF.values(), *topics.PRESENCE_OF.values())
READ = (topics.STEP_PLAN, topics.MODE, topics.STOP, topics.VELOCITY, topics.ACTUATOR_STATE, *CLAIMED)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return gated.make_keys(tmp_path_factory.mktemp("keys"))


@dataclasses.dataclass
class Robot:
    """The endpoints of a router."""

    plain: str
    secure: str


@pytest.fixture(scope="module")
def robot(keys: Path) -> Iterator[Robot]:
    at = Robot(f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}")
    here = Gate((at.plain, at.secure), NAMESPACE, keys / "robot")
    with hosted(here):
        yield at


@pytest.fixture
def inside(robot: Robot) -> Iterator[Inside]:
    made = Inside(robot.plain, *READ)
    yield made
    made.close()


def link(robot: Robot, keys: Path, role: str) -> ZenohLink:
    return ZenohLink(Endpoints((robot.secure,), namespace=NAMESPACE, keys=Keys.load(keys / role)))


def test_base_can_publish_plans_and_commands_and_read_state(robot: Robot, keys: Path, inside: Inside) -> None:
    with link(robot, keys, "base") as base:
        put_until(inside, base, topics.STEP_PLAN, b"plan")
        put_until(inside, base, topics.MODE, b"mode")
        heard = threading.Event()
        base.subscribe(topics.ACTUATOR_STATE, lambda _topic, _frame: heard.set())
        for _ in range(500):
            inside.link.send(topics.ACTUATOR_STATE, b"state")
            if heard.wait(0.02):
                break
        assert heard.is_set()


def test_console_commands_pass_and_its_plans_are_dropped(robot: Robot, keys: Path, inside: Inside) -> None:
    with link(robot, keys, "console") as console:
        put_until(inside, console, topics.MODE, b"ready")
        for number in range(N):
            console.send(topics.STEP_PLAN, b"plan %d" % number)
        put_until(inside, console, topics.MODE, b"done")
    assert inside.count[topics.STEP_PLAN.key] == 0


def test_unlisted_keys_and_wildcard_puts_are_dropped(robot: Robot, keys: Path, inside: Inside) -> None:
    """Reject a message to a key pattern, even if the pattern matches an allowed key."""
    with link(robot, keys, "base") as base, session(robot.secure, tls_of(keys / "base")) as wild:
        put_until(inside, base, topics.HEALTH_OF["base"], b"ready")
        before = inside.count[topics.ACTUATOR_STATE.key]
        for number in range(N):
            for key in ("**", f"{NAMESPACE}/**", f"{NAMESPACE}/planner/*", f"{NAMESPACE}/actuator/state", "servo/1/goal"):
                wild.put(key, b"wild %d" % number)
            wild.delete(f"{NAMESPACE}/planner/step")
        again(inside, topics.VELOCITY, b"done", lambda: wild.put(f"{NAMESPACE}/operator/velocity", b"done"))
    assert inside.count[topics.ACTUATOR_STATE.key] == before
    assert inside.count[topics.STEP_PLAN.key] == inside.count[topics.MODE.key] == 0


@pytest.mark.parametrize("role", ["base", "console", "viewer"])
def test_health_and_presence_of_another_role_are_dropped(robot: Robot, keys: Path, inside: Inside, role: str) -> None:
    own = () if role == "viewer" else (topics.HEALTH_OF[role], topics.PRESENCE_OF[role])
    last = topics.STOP if role == "viewer" else topics.MODE
    with link(robot, keys, role) as client:
        for topic in (*own, last):  # the client loses messages until it knows the subscribers
            put_until(inside, client, topic, b"ready")
        for topic in CLAIMED:
            for number in range(20):
                client.send(topic, b"a claim %d" % number)
        put_until(inside, client, last, b"done")
    came = {topic.key for topic in CLAIMED if inside.count[topic.key]}
    assert came == {topic.key for topic in own}


def test_viewer_receives_only_permitted_topics(robot: Robot, keys: Path, inside: Inside) -> None:
    with session(robot.secure, tls_of(keys / "viewer")) as viewer:
        everything = viewer.declare_subscriber("**", zenoh.handlers.FifoChannel(10_000))
        barred = [viewer.declare_subscriber(f"{NAMESPACE}/{key}") for key in ("simulator/truth", "camera/depth")]
        states, pause = viewer.declare_subscriber(f"{NAMESPACE}/actuator/state"), threading.Event()
        for _ in range(500):
            for topic in (topics.TRUTH, topics.DEPTH, topics.STEP_PLAN, topics.ACTUATOR_STATE):
                inside.link.send(topic, b"state")
            pause.wait(0.01)
            if states.try_recv() is not None:
                break
        heard = set()
        while (sample := everything.try_recv()) is not None:
            heard.add(str(sample.key_expr))
        assert heard == {f"{NAMESPACE}/actuator/state"}, "of all that is said, what was asked for by its name and is allowed"
        assert [one.try_recv() for one in barred] == [None, None]


@pytest.mark.parametrize(
    ("who", "words"),
    [("foreign", "is not the expected machine"), ("expired", "expired 1 days ago")],
)
def test_client_with_invalid_keys_fails_with_reason(robot: Robot, keys: Path, who: str, words: str) -> None:
    with pytest.raises((TransportError, AccessError), match=words), link(robot, keys, who):
        pass


@pytest.mark.parametrize("who", ["foreign", "expired", "nobody", "plain"])
def test_unauthorized_client_is_refused(robot: Robot, keys: Path, who: str) -> None:
    """Refuse a client without this project's rules, even if it trusts the robot."""
    match who:
        case "plain":
            endpoint, tls = robot.secure.replace("tls/", "tcp/"), None
        case "nobody":
            endpoint, tls = robot.secure, {"root_ca_certificate": str(keys / "robot" / "ca.pem")}
        case _:
            endpoint, tls = robot.secure, tls_of(keys / who, trusted=keys / "robot")
    with pytest.raises(zenoh.ZError):
        stranger(endpoint, tls)


def test_peer_without_certificate_is_isolated(robot: Robot, keys: Path, inside: Inside) -> None:
    """Accept nothing from a peer without a certificate.

    In peer mode, opening a session never fails.
    """
    config = {"root_ca_certificate": str(keys / "robot" / "ca.pem")}
    try:
        peer = stranger(robot.secure, config, mode="peer")
    except zenoh.ZError:
        return
    with peer, link(robot, keys, "base") as base:
        for number in range(N):
            peer.put(f"{NAMESPACE}/planner/step", b"plan %d" % number)
        put_until(inside, base, topics.MODE, b"done")
        assert list(peer.info.routers_zid()) == list(peer.info.peers_zid()) == []
    assert inside.count[topics.STEP_PLAN.key] == 0


def test_clients_do_not_connect_directly_to_each_other(robot: Robot, keys: Path, inside: Inside) -> None:
    """Keep clients from connecting to each other past the router.

    A peer that listens is not announced to clients. Its messages are authorized by its own certificate.
    """
    around = f"tcp/127.0.0.1:{free_port()}"
    with (
        session(robot.secure, tls_of(keys / "viewer"), mode="peer", listen=around) as peer,
        session(robot.secure, tls_of(keys / "base")) as base,
        base.declare_subscriber(f"{NAMESPACE}/actuator/state", zenoh.handlers.FifoChannel(1000)) as states,
        link(robot, keys, "base") as ours,
    ):
        for number in range(N):
            peer.put(f"{NAMESPACE}/actuator/state", b"lie %d" % number)
            peer.put(f"{NAMESPACE}/planner/step", b"plan %d" % number)
        put_until(inside, ours, topics.MODE, b"done")
        assert list(base.info.peers_zid()) == []
        assert states.try_recv() is None
    assert inside.count[topics.STEP_PLAN.key] == inside.count[topics.ACTUATOR_STATE.key] == 0


@pytest.mark.parametrize("role", ["base", "viewer"])
def test_chained_machine_has_permissions_of_its_certificate(role: str, robot: Robot, keys: Path, inside: Inside) -> None:
    """Authorize a chained machine by its certificate.

    The machine's processes use its loopback without certificates; its router presents the machine's certificate.
    """
    plain = f"tcp/127.0.0.1:{free_port()}"
    there = router_security.of_arguments((plain,), str(keys / role), False, NAMESPACE, plain, (robot.secure,))
    assert there.listen == (plain,)
    with (
        hosted(there),
        ZenohLink(Endpoints((plain,), namespace=NAMESPACE)) as process,
        link(robot, keys, "base") as base,
    ):
        heard = threading.Event()
        process.subscribe(topics.ACTUATOR_STATE, lambda _topic, _frame: heard.set())
        for _ in range(500):
            inside.link.send(topics.ACTUATOR_STATE, b"state")
            if heard.wait(0.02):
                break
        assert heard.is_set(), "every client with a certificate sees the robot"
        if role == "base":
            put_until(inside, process, topics.STEP_PLAN, b"plan")
            return
        for number in range(N):
            process.send(topics.STEP_PLAN, b"plan %d" % number)
            process.send(topics.MODE, b"mode %d" % number)
        put_until(inside, base, topics.VELOCITY, b"done")
        assert inside.count[topics.STEP_PLAN.key] == inside.count[topics.MODE.key] == 0


@pytest.mark.parametrize("role", ["base", "console"])
def test_site_router_enforces_role_of_each_machine(role: str, keys: Path) -> None:
    """Authorize each machine at a site's router between robot and base.

    Robot and base are chained to a router on a third machine. It rejects a console's unauthorized messages.
    """
    plain = {name: f"tcp/127.0.0.1:{free_port()}" for name in ("robot", "site", "base")}
    secure = f"tls/127.0.0.1:{free_port()}"
    site = Gate((plain["site"], secure), NAMESPACE, keys / "site")
    robot = Gate((plain["robot"],), NAMESPACE, keys / "robot", upstream=(secure,))
    base = Gate((plain["base"],), NAMESPACE, keys / role, upstream=(secure,))
    with contextlib.ExitStack() as stack:
        for one in (site, robot, base):
            stack.enter_context(hosted(one))
        inside = Inside(plain["robot"], *READ)
        stack.callback(inside.close)
        process = stack.enter_context(ZenohLink(Endpoints((plain["base"],), namespace=NAMESPACE)))
        heard = threading.Event()
        process.subscribe(topics.ACTUATOR_STATE, lambda _topic, _frame: heard.set())
        for _ in range(500):
            inside.link.send(topics.ACTUATOR_STATE, b"state")
            if heard.wait(0.02):
                break
        assert heard.is_set(), "the robot's messages arrive at the other side"
        if role == "base":
            put_until(inside, process, topics.STEP_PLAN, b"plan")
        else:
            for number in range(N):
                process.send(topics.STEP_PLAN, b"plan %d" % number)
        put_until(inside, process, topics.MODE, b"mode")
        assert (inside.count[topics.STEP_PLAN.key] > 0) is (role == "base")


def test_services_not_permitted_by_certificate_are_reported(keys: Path) -> None:
    there = Gate(("tcp/127.0.0.1:7447",), NAMESPACE, keys / "console", upstream=("tls/robot.local:7448",))
    assert there.misplaced(["console"]) == ""
    assert there.misplaced(["mapper", "planner", "console"]).startswith("mapper, planner would be refused: this certificate")
    assert Gate(("tcp/127.0.0.1:7447", "tls/0.0.0.0:7448"), NAMESPACE, keys / "robot").misplaced(["planner"]) == ""


def test_flooding_client_is_rate_limited_and_others_pass(robot: Robot, keys: Path, inside: Inside) -> None:
    with link(robot, keys, "console") as flooding, link(robot, keys, "base") as base:
        put_until(inside, flooding, topics.MODE, b"ready")
        before = inside.count[topics.MODE.key]
        for _ in range(10_000):
            flooding.send(topics.MODE, b"flood")
        put_until(inside, base, topics.MODE, b"from another")
        put_until(inside, flooding, topics.MODE, b"done")
        assert inside.count[topics.MODE.key] - before < 1500, "a thousand a second are let through"


def test_oversized_messages_are_dropped(robot: Robot, keys: Path, inside: Inside) -> None:
    with link(robot, keys, "console") as console:
        put_until(inside, console, topics.MODE, b"ready")
        before = inside.count[topics.VELOCITY.key]
        for _ in range(10):
            console.send(topics.VELOCITY, bytes(topics.VELOCITY.max_bytes + 1))  # one byte over the limit, which covers the key
        console.send(topics.VELOCITY, bytes(10_000_000))
        put_until(inside, console, topics.MODE, b"done")
        assert inside.count[topics.VELOCITY.key] == before
        put_until(inside, console, topics.VELOCITY, bytes(topics.VELOCITY.max_bytes))


@pytest.mark.parametrize(
    ("listen", "with_keys", "open_", "hint"),
    [
        (("tcp/0.0.0.0:7447",), False, False, "would admit any client that reaches it: give --keys DIR"),
        (("tls/0.0.0.0:7448",), False, False, "needs certificates: give --keys DIR"),
        (("tcp/127.0.0.1:7447", "tcp/192.168.1.20:7447", "tls/0.0.0.0:7448"), True, False, "tcp/192.168.1.20:7447 would admit"),
        (("tcp/127.0.0.1:7447",), True, False, "--keys needs a tls endpoint"),
        (("tls/0.0.0.0:7448",), True, True, "either --keys or --open"),
        (("tcp/127.0.0.1:7447", "up:tcp/192.168.1.20:7447"), False, False, "is another machine without certificates"),
        (("tcp/127.0.0.1:7447", "up:tls/192.168.1.20:7448"), False, False, "needs certificates"),
    ],
)
def test_open_listener_requires_explicit_option(
    listen: tuple[str, ...], with_keys: bool, open_: bool, hint: str, keys: Path
) -> None:
    upstream = tuple(endpoint[3:] for endpoint in listen if endpoint.startswith("up:"))
    own = tuple(endpoint for endpoint in listen if not endpoint.startswith("up:"))
    with pytest.raises(AccessError, match=hint):
        Gate(own, keys=keys / "robot" if with_keys else None, open=open_, upstream=upstream)


def test_secured_router_listens_on_loopback_and_tls(keys: Path) -> None:
    made = router_security.of_arguments((), str(keys / "robot"), False, NAMESPACE, "tcp/127.0.0.1:7447")
    assert made.listen == ("tcp/127.0.0.1:7447", router_security.SECURE_ENDPOINT)
    assert router_security.of_arguments((), None, False, NAMESPACE, "tcp/127.0.0.1:7447").configuration() == {}


def test_up_refuses_public_endpoint_without_keys(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["up", "all", "--scenario", "flat", "--no-page", "--listen", "tcp/0.0.0.0:17447"]) == 2
    assert "tcp/0.0.0.0:17447 would admit any client" in capsys.readouterr().err


@pytest.mark.parametrize("role", ["console", "viewer"])
def test_command_publishes_health_under_role_of_its_keys(keys: Path, role: str) -> None:
    assert Endpoints(("tls/robot.local:7448",), keys=Keys.load(keys / role)).role == role
    assert Endpoints(("tcp/127.0.0.1:7447",)).role == "robot"


def test_open_router_gives_own_processes_separate_loopback_port() -> None:
    public = Gate(("tcp/0.0.0.0:7447",), open=True)
    own, *others = up._apart(public).listen
    assert own.startswith("tcp/127.0.0.1:")
    assert own != public.own
    assert tuple(others) == public.listen
    alone = Gate(("tcp/127.0.0.1:7447", "tcp/0.0.0.0:7449"), open=True)
    assert up._apart(alone) is alone


def test_unusable_router_keys_are_refused_before_start(keys: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for change, words in (
        ("old", "these keys are of an older version; make new ones"),
        ("a;b", "has one of ; = # ? in its path"),
    ):
        folder = Path(shutil.copytree(keys / "robot", tmp_path / change))
        if change == "old":
            shutil.rmtree(folder / PROXY)
        assert cli.main(["up", "all", "--scenario", "flat", "--no-page", "--keys", str(folder)]) == 2
        assert words in capsys.readouterr().err


def test_print_zenoh_prints_configuration_without_starting(keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["up", "offboard", "--connect", "tls/robot.local:7448", "--keys", str(keys / "base"), "--namespace", NAMESPACE]
    assert cli.main([*words, "--print-zenoh"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["mode"] == "router"
    assert len(printed["connect"]["endpoints"]) == 2, "a link for each lane"
    assert printed["access_control"]["default_permission"] == "deny"
    assert printed["access_control"] == Keys.load(keys / "base").hosting(NAMESPACE)["access_control"]
    assert zenoh.Config.from_json5(json.dumps(printed)) is not None


def test_new_keys_are_private_and_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "keys"
    assert cli.main(["keys", "new", str(folder), "--robot-address", "hexapod.local", "--robot-address", "10.0.0.7"]) == 0
    private = [file for file in folder.rglob("*.pem") if b"PRIVATE KEY" in file.read_bytes()]
    assert {file.name for file in private} == {"key.pem", "router.pem", *(f"{role.name}.pem" for role in ROLES)}
    assert {file.stat().st_mode & 0o777 for file in private} == {0o600}
    before = {file: file.read_bytes() for file in folder.rglob("*.pem")}
    assert cli.main(["keys", "new", str(folder)]) == 2
    assert "keys are not overwritten; give another folder" in capsys.readouterr().err
    assert before == {file: file.read_bytes() for file in folder.rglob("*.pem")}
    assert cli.main(["keys", "show", str(folder)]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in shown] == ["robot", "base", "console", "viewer", "site"]
    assert all("in 365 days" in line for line in shown)
    assert cli.main(["keys", "show", str(tmp_path)]) == 2
