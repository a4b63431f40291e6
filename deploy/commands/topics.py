"""`sextant topics`: the topic table, and the messages that are received."""

import argparse
import json
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from sextant.deploy.commands.common import FAILED, INTERRUPTED, ROUTER, SUCCESS, InputError, complain, met, say

if TYPE_CHECKING:
    from sextant.deploy.topics.passive_subscriber import ReceivedMessage
    from sextant.shared.runtime.service import AnyTopic

_LOOK_S = 0.1


def list_topics(arguments: argparse.Namespace) -> int:
    """`sextant topics list`: print the topic table."""
    from sextant.shared.wire.topics import TOPICS

    if arguments.json:
        rows = [{"key": t.key, "type": t.type.__name__, "rate_hz": t.rate_hz, "delivery": t.delivery.value} for t in TOPICS]
        say(json.dumps(rows, indent=1))
        return SUCCESS
    say(f"{'key':<20} {'type':<16} {'rate':>8}  delivery  what")
    for t in TOPICS:
        doc = (t.type.__doc__ or "").split("\n")[0]
        say(f"{t.key:<20} {t.type.__name__:<16} {t.rate_hz:>5.1f} Hz  {t.delivery.value:<8}  {doc}")
    return SUCCESS


def docs(arguments: argparse.Namespace) -> int:
    """`sextant topics docs`: print docs/keys.md or docs/parameters.md."""
    try:
        from sextant.deploy.topics import keys_page, params_page

        text = (params_page if arguments.page == "parameters" else keys_page).page()
    except ImportError as error:
        raise InputError(f"{error}; the page needs all services installed: pip install 'sextant[all]'") from None
    say(text.rstrip("\n"))
    return SUCCESS


def echo(arguments: argparse.Namespace) -> int:
    """`sextant topics echo`: print messages until Ctrl-C or up to a count."""
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.deploy.topics.passive_subscriber import Mailbox, listen
    from sextant.shared.wire.transport import ZenohLink

    wanted, told = _wanted(arguments), 0
    mailbox, endpoints = Mailbox(), met(arguments)
    with Interrupts() as interrupts, ZenohLink(endpoints) as link:
        listen(link, wanted, mailbox.take, time.monotonic_ns)
        patience_ns = time.monotonic_ns() + round(arguments.within * 1e9)
        while not interrupts.asked():
            mailbox.news.wait(_LOOK_S)
            for heard in mailbox.drain():
                told += _tell(heard, arguments.json)
                if told == arguments.count:
                    return SUCCESS
                if interrupts.asked():
                    break
                patience_ns = 0
            if patience_ns and time.monotonic_ns() > patience_ns:
                return _silent(wanted, arguments)
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


def hz(arguments: argparse.Namespace) -> int:
    """`sextant topics hz`: measure rate and bandwidth of each topic."""
    from sextant.deploy.terminal.interrupts import Interrupts
    from sextant.deploy.topics import topic_stats
    from sextant.deploy.topics.passive_subscriber import listen
    from sextant.shared.wire.transport import ZenohLink

    wanted = _wanted(arguments)
    counted, endpoints = topic_stats.Rates(wanted), met(arguments)
    with Interrupts() as interrupts, ZenohLink(endpoints) as link:
        began_ns = time.monotonic_ns()
        listen(link, wanted, counted.take, time.monotonic_ns)
        duration_s = _wait(arguments.seconds, began_ns, interrupts.asked)
        rows = counted.rows(duration_s)
    if not any(row.frames for row in rows):
        return _silent(wanted, argparse.Namespace(**{**vars(arguments), "within": duration_s}))
    say(json.dumps(topic_stats.for_scripts(rows, duration_s), indent=1) if arguments.json else topic_stats.in_words(rows))
    return INTERRUPTED if interrupts.asked() else SUCCESS


def _wait(seconds: float, began_ns: int, asked: Callable[[], bool]) -> float:
    """Wait for some seconds, or until `asked`; return how long it was [s]."""
    while (passed_s := (time.monotonic_ns() - began_ns) * 1e-9) < seconds and not asked():
        time.sleep(min(_LOOK_S, seconds - passed_s))
    return passed_s


def _wanted(arguments: argparse.Namespace) -> "tuple[AnyTopic, ...]":
    from sextant.deploy.topics.passive_subscriber import ONLY_BY_NAME, topics_named

    try:
        wanted = topics_named(arguments.keys)
    except ValueError as error:
        raise InputError(str(error)) from None
    if not arguments.keys:
        complain(f"not subscribed: {', '.join(t.key for t in ONLY_BY_NAME)} (large, or published only on request); name them")
    return wanted


def _silent(wanted: "tuple[AnyTopic, ...]", arguments: argparse.Namespace) -> int:
    where = ", ".join(arguments.connect or [ROUTER])
    what = wanted[0].key if len(wanted) == 1 else f"any of {len(wanted)} topics"
    complain(
        f"sextant {arguments.name}: no message of {what} received within {arguments.within:.3g} s at {where}, namespace "
        f"{arguments.namespace}; is the robot up (`sextant up`), and does it use this --namespace? `sextant topics hz` "
        "shows which topics are published"
    )
    return FAILED
