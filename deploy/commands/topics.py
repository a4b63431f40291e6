"""`sextant topics`: the topic table, and the messages that are received."""

import json
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from sextant.deploy.commands import options
from sextant.deploy.commands.common import INTERRUPTED, SUCCESS, CommandError, InputError, complain, say
from sextant.deploy.commands.recordings import foxglove
from sextant.deploy.commands.ros2 import ros2
from sextant.deploy.terminal.arguments import Group, argument, flag, option

if TYPE_CHECKING:
    from sextant.deploy.topics.passive_subscriber import ReceivedMessage
    from sextant.shared.runtime.service import AnyTopic
    from sextant.shared.wire.transport import Endpoints

_LOOK_S = 0.1

topics = Group("topics", "List topics, print messages, measure rates; pass them on to Foxglove or ROS 2.")
_keys = argument("keys", "topics to receive (default: all except camera images)", "[KEY]...", nargs=-1)


@topics.command("list")
@options.as_json
def list_topics(as_json: bool) -> int:
    """Print the topic table of this version; it needs no robot.

    With --json it has the schema and the fields of each message, in the order of its frame. `sextant topics hz` shows which
    topics a running robot publishes, and `sextant topics echo` their messages.
    """
    from sextant.shared.wire.field_table import table_of
    from sextant.shared.wire.topics import TOPICS

    if as_json:
        say(json.dumps([table_of(topic) for topic in TOPICS], indent=1, ensure_ascii=False))
        return SUCCESS
    say(f"{'key':<24} {'type':<16} {'rate':<24}  delivery  what")
    for t in TOPICS:
        doc = (t.type.__doc__ or "").split("\n")[0]
        say(f"{t.key:<24} {t.type.__name__:<16} {t.rate:<24}  {t.delivery.value:<8}  {doc}")
    return SUCCESS


@topics.command("echo")
@_keys
@options.connection
@option("--count", "number of messages to print (default: until Ctrl-C)", "N", type=options.POSITIVE)
@option("--within", "time to wait for the first message", "S", type=options.SECONDS, default=5.0)
@flag("--json", "print one JSON object per line", "as_json")
def echo(keys: tuple[str, ...], connection: options.Connection, count: int | None, within: float, as_json: bool) -> int:
    """Print received messages, large arrays as shape and range."""
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.deploy.topics.passive_subscriber import Mailbox, listen
    from sextant.shared.wire.transport import ZenohLink

    wanted, told = _wanted(keys, connection.namespace), 0
    mailbox, endpoints = Mailbox(), connection.endpoints()
    with Interrupts() as interrupts, ZenohLink(endpoints) as link:
        listen(link, wanted, mailbox.take, time.monotonic_ns)
        patience_ns = time.monotonic_ns() + round(within * 1e9)
        while not interrupts.asked():
            mailbox.news.wait(_LOOK_S)
            for heard in mailbox.drain():
                told += _tell(heard, as_json)
                if told == count:
                    return SUCCESS
                if interrupts.asked():
                    break
                patience_ns = 0
            if patience_ns and time.monotonic_ns() > patience_ns:
                raise CommandError(_silence(wanted, within, endpoints))
    complain("stopped by the operator")
    return INTERRUPTED


def _tell(heard: "ReceivedMessage", as_json: bool) -> int:
    """Print one message, or why it cannot be decoded; return how many were printed."""
    from sextant.deploy.topics import message_format
    from sextant.shared.wire.codec import DecodeError

    try:
        text = (
            json.dumps(message_format.for_scripts(heard), ensure_ascii=False)
            if as_json
            else message_format.in_words(heard) + "\n"
        )
    except DecodeError as error:
        complain(message_format.refusal(heard.topic, error))
        return 0
    say(text)
    return 1


@topics.command("hz")
@_keys
@options.connection
@option("--seconds", "measuring time", "S", type=options.SECONDS, default=5.0)
@options.as_json
def hz(keys: tuple[str, ...], connection: options.Connection, seconds: float, as_json: bool) -> int:
    """Measure rate and bandwidth of each topic, and compare with the topic table."""
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.deploy.topics import topic_stats
    from sextant.deploy.topics.passive_subscriber import listen
    from sextant.shared.wire.transport import ZenohLink

    wanted = _wanted(keys, connection.namespace)
    counted, endpoints = topic_stats.Rates(wanted), connection.endpoints()
    with Interrupts() as interrupts, ZenohLink(endpoints) as link:
        began_ns = time.monotonic_ns()
        listen(link, wanted, counted.take, time.monotonic_ns)
        duration_s = _wait(seconds, began_ns, interrupts.asked)
        rows = counted.rows(duration_s)
    if not any(row.frames for row in rows):
        raise CommandError(_silence(wanted, duration_s, endpoints))
    say(json.dumps(topic_stats.for_scripts(rows, duration_s), indent=1) if as_json else topic_stats.in_words(rows))
    return INTERRUPTED if interrupts.asked() else SUCCESS


def _wait(seconds: float, began_ns: int, asked: Callable[[], bool]) -> float:
    """Wait for some seconds, or until `asked`; return how long it was [s]."""
    while (passed_s := (time.monotonic_ns() - began_ns) * 1e-9) < seconds and not asked():
        time.sleep(min(_LOOK_S, seconds - passed_s))
    return passed_s


def _wanted(keys: tuple[str, ...], namespace: str) -> "tuple[AnyTopic, ...]":
    from sextant.deploy.topics.passive_subscriber import ONLY_BY_NAME, topics_named

    try:
        wanted = topics_named(keys, namespace)
    except ValueError as error:
        raise InputError(str(error)) from None
    if not keys:
        complain(f"not subscribed: {', '.join(t.key for t in ONLY_BY_NAME)} (large, or published only on request); name them")
    return wanted


def _silence(wanted: "tuple[AnyTopic, ...]", within_s: float, endpoints: "Endpoints") -> str:
    what = wanted[0].key if len(wanted) == 1 else f"any of {len(wanted)} topics"
    return (
        f"no message of {what} received within {within_s:.3g} s at {', '.join(endpoints.connect)}, namespace "
        f"{endpoints.namespace}; is the robot up (`sextant up`), and does it use this --namespace? `sextant topics hz` "
        "shows which topics are published"
    )


topics.add_command(foxglove)
topics.add_command(ros2)
