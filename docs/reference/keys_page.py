"""Generator of docs/keys.md, a page with every key and message.

It reads the topic table, the process table and the message declarations. The meaning of a field is its comment in the source.
"""

import importlib
import inspect
import json
from collections.abc import Iterable, Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

import numpy as np

from docs.reference.field_comments import Meaning, comments, parse
from sextant.deploy.launch.process_table import ROUTER_ENDPOINT, TABLE
from sextant.deploy.live.send_command import Order
from sextant.deploy.ros2.bridge import Bridge
from sextant.evaluation.observers.operator import Operator
from sextant.evaluation.scoring.scorer import Scorer
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, messages, topics
from sextant.shared.wire.messages import Dims, Message, Mode, VelocityCommand
from sextant.shared.wire.transport import Endpoints

CLIENT = Path(__file__).resolve().parents[1] / "walk_client.py"
_FRAMES = ("world", "odom", "body")
_NAMES = {float: "float", int: "int", bool: "bool", str: "text"}

_BEGINNING = """# Keys and messages

*`python -m docs.reference keys` makes this page from the topic table, the process table and the declarations of the messages
(`shared/wire/topics.py`, `deploy/launch/process_table.py`, `shared/wire/messages.py`); a test checks that it is up to date.*

All topics are on [Zenoh](https://zenoh.io), at the router that `sextant up` hosts on `{router}` (`--listen` sets another
address), with scouting off. A key of this page follows the namespace of the run: `actuator/state` is
`{namespace}/actuator/state`, or the bare key in a session whose configuration has `namespace: "{namespace}"`.

- Topics of delivery **latest** are states: a subscriber keeps the newest and may drop the others. Those of **every** are events
  and increments: a subscriber processes all, in order.
- No message is sent with blocking congestion control: messages that a peer does not receive in time are dropped. The lane
  **control** has precedence (priority `REAL_TIME`, express), **bulk** has priority `DATA`. Services use one session for each.
- A subscriber refuses a frame that is larger than its topic allows, or not as declared here. It counts the frame and reports
  the reason in `health`; the last good frame stays in use.
- Services send a frame with its address, namespace and key as Zenoh's attachment. They drop a frame that arrives under another
  key, as happens behind a suspended router (`shared/wire/transport.py`), and count it in `health`. A frame without attachment
  is accepted: attach exactly the address, or nothing.
- A stamp is the time [ns] at which the message's content was valid, on the robot's monotonic clock (`CLOCK_MONOTONIC`), not the
  time of day. A subscriber judges freshness by the time of arrival: a message is stale three periods after it arrived.
  Processes on another machine also use the robot's clock, which they follow through the send times of `actuator/state`.
- A client that orders takes the lease, by the `holder` of a `ModeCommand`: only one client at a time may move the legs, any
  client may stop them. Each client needs its own `holder`: of two clients under one name, the newer order holds. An order to
  move, a velocity and a goal count only if their stamp is at most two seconds off the robot's clock, because older ones may be
  a replayed recording. The `sequence` of an order is the time at which it was given, and does not change when the order is
  repeated: an order that the actuator first receives more than two seconds later neither stands
  the robot up nor turns torque on. A client on any machine may take stamp and `sequence` from the newest `actuator/state`; the
  client below does. Orders `off` and `stop` with a fresh stamp are obeyed even if their `sequence` is older than one already
  received, unless it is not newer than that holder's last stop.
- Transforms `T_a_b` are 4 × 4 and map coordinates of frame b to frame a: {{world}} is fixed where the robot started, z up,
  {{odom}} is the estimate by the legs alone, {{body}} moves with the robot, x forward, y left, z up.
- `sextant topics echo KEY` prints messages, `sextant topics hz` measures rates and bandwidth.
"""
_OF_FRAMES = """`schema` is the id that each message has below. The dtype of an array is in NumPy's notation: `<f8` is a
little-endian float64, `|u1` a uint8, `|b1` a boolean of one byte. `began_ns` and `sent_ns` are the times at which the sender
began to make the message and sent it; 0 if they are not recorded.

For example, a velocity command:
"""
_OF_CLIENT = """## A client

[walk_client.py](walk_client.py) needs `eclipse-zenoh` and `msgpack`, but not Sextant. It takes the lease, walks the robot
and prints the robot's state; `sextant up all --scenario flat` starts a robot to try it on.
"""


def page() -> str:
    """Return the page in Markdown.

    Raises:
        ImportError: A service needs a package that is not installed.
    """
    written, read = _writers_and_readers()
    said = comments(inspect.getsource(messages))
    return "\n".join(
        (
            _BEGINNING.format(router=ROUTER_ENDPOINT, namespace=Endpoints((ROUTER_ENDPOINT,)).namespace),
            *_table(written, read),
            *_frame(),
            *_client(),
            *_modes(said),
            "## The messages",
            "",
            *(line for topic in topics.TOPICS if topic is topics.OF_TYPE[topic.type] for line in _message(topic, said)),
        )
    )


def _table(written: Mapping[str, list[str]], read: Mapping[str, list[str]]) -> Iterator[str]:
    yield "## The keys"
    yield ""
    yield "| key | message | rate, Hz | delivery | lane | at most, KiB | published by | subscribed by | over the radio |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for topic in topics.TOPICS:
        name = topic.type.__name__
        cells = (
            f"`{topic.key}`",
            f"[{name}](#{topics.OF_TYPE[topic.type].key.replace('/', '')}-{name.lower()})",
            f"{topic.rate_hz:g}",
            topic.delivery.value,
            topic.lane.value,
            f"{topic.max_bytes / 1024:g}",
            ", ".join(written.get(topic.key, ["any client"])),
            ", ".join(read.get(topic.key, ["any client"])),
            _over_the_radio(written.get(topic.key, []), read.get(topic.key, [])),
        )
        yield f"| {' | '.join(cells)} |"
    yield ""


def _over_the_radio(writers: Iterable[str], readers: Iterable[str]) -> str:
    """Return in which direction a topic crosses the link between robot and base.

    Each process is assumed to run where it usually does.
    """
    sides = {p.name: "robot" if p.side in ("robot", "device", "simulation") else "base" for p in TABLE}
    ways = {(sides[a], sides[b]) for a in writers for b in readers if a in sides and b in sides and sides[a] != sides[b]}
    of = next((word.rpartition(" ")[2] for word in writers if word.startswith(("every process", "`sextant up`"))), "")
    if of in ("robot", "site"):
        ways |= {("robot", "base")}
    elif of in ("base", "console"):
        ways |= {("robot", "base"), ("base", "robot")}
    return "both ways" if len(ways) > 1 else "".join(f"to the {there}" for _, there in ways)


def _writers_and_readers() -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Return topic key -> publishers, and topic key -> subscribers.

    They are processes of the table, then commands.
    """
    written: dict[str, list[str]] = {}
    read: dict[str, list[str]] = {}
    own = [(process.name, _service(process.module)) for process in TABLE]
    commands = (
        ("`sextant run`", Operator),
        ("`sextant run`", Scorer),
        ("`sextant order`", Order),
        ("`sextant topics ros2`", Bridge),
    )
    for name, service in (*own, *commands):
        pace = getattr(service, "trigger", None)
        subscribes = [*([pace] if isinstance(pace, topics.Topic) else []), *service.subscribes]
        for table, found in ((written, service.publishes), (read, subscribes)):
            for topic in found:
                names = table.setdefault(topic.key, [])
                if name not in names:
                    names.append(name)
    for role in topics.ROLE_NAMES:
        written[topics.HEALTH_OF[role].key] = [f"every process of a {role}"]
        written[topics.PRESENCE_OF[role].key] = [f"`sextant up` of a {role}"]
        read[topics.PRESENCE_OF[role].key] = ["`sextant up`"]
    return written, read


def _service(module: str) -> Any:
    """Return the service class that a process runs."""
    service = importlib.import_module(f"{module}.service")
    (found,) = (
        kind
        for _, kind in inspect.getmembers(service, inspect.isclass)
        if kind.__module__ == service.__name__ and hasattr(kind, "subscribes") and hasattr(kind, "publishes")
    )
    return found


# ------------------------------------------------------------------------------------------------------------ the frame


def _frame() -> Iterator[str]:
    _, _, words = (inspect.getdoc(codec) or "").partition("\n\n")
    command = VelocityCommand(1_000_000_000, np.array([0.06, 0.0]), 0.0, 0.11, 0.04)
    frame = codec.encode(command)
    length = int.from_bytes(frame[:4], "little")
    header = codec.unpack_values(frame[4 : 4 + length])
    padding, arrays = frame[4 + length : -16], frame[-16:]
    yield "## A frame"
    yield ""
    for paragraph in words.split("\n\n"):
        yield from ("    " + line.strip() for line in paragraph.splitlines()) if paragraph.startswith("    ") else [paragraph]
        yield ""
    yield _OF_FRAMES
    yield "```text"
    yield f"{frame[:4].hex(' '):<58} uint32: {length} bytes of header"
    rows = [frame[4 + k : 4 + min(k + 16, length)] for k in range(0, length, 16)]
    yield f"{rows[0].hex(' '):<58} msgpack: {json.dumps(header)}"
    yield from (row.hex(" ") for row in rows[1:])
    yield f"{padding.hex(' '):<58} padding to 8 bytes"
    yield f"{arrays.hex(' '):<58} <f8 [2]: {', '.join(map(str, command.velocity))}"
    yield "```"
    yield ""


def _client() -> Iterator[str]:
    yield _OF_CLIENT
    yield "```python"
    yield from CLIENT.read_text(encoding="utf-8").splitlines()
    yield "```"
    yield ""


# --------------------------------------------------------------------------------------------------------- the messages


def _modes(said: Mapping[tuple[str, str], str]) -> Iterator[str]:
    yield "## Modes"
    yield ""
    yield f"{inspect.getdoc(Mode)}"
    yield ""
    yield "| mode | what |"
    yield "|---|---|"
    for mode in Mode:
        yield f"| `{mode.value}` | {said['Mode', mode.name]} |"
    yield ""


def _message(topic: AnyTopic, said: Mapping[tuple[str, str], str]) -> Iterator[str]:
    kind = topic.type
    yield f"### {topic.key} {kind.__name__}"
    yield ""
    yield " ".join((inspect.getdoc(kind) or "").split())
    yield ""
    yield f"Schema `{codec.schema_id(kind)}`"
    yield ""
    yield "| field | type | shape | unit | frame | what |"
    yield "|---|---|---|---|---|---|"
    for name, base, detail in messages.schema(kind):
        meaning = _meaning(name, said.get((_declared_in(kind, name), name), ""))
        type_, shape, limits = _type(base, detail)
        what = "; ".join(words for words in (meaning.what, limits) if words).replace("|", "\\|")
        yield f"| `{name}` | {type_} | {shape} | {meaning.unit} | {meaning.frame} | {what} |"
    yield ""


def _meaning(name: str, comment: str) -> Meaning:
    """Parse a field's comment; a transform T_to_from has its frames in its name."""
    unit, frame, what = parse(comment)
    match name.split("_"):
        case ["T", to, source] if to in _FRAMES and source in _FRAMES:
            takes = f"takes {source} coordinates to {to}"
            return Meaning(unit or "m", frame or to, f"{takes}; {what}" if what else takes)
    return Meaning(unit, frame, what)


def _type(base: Any, detail: Any) -> tuple[str, str, str]:
    """Return type, shape and limits of a field as text."""
    if base is np.ndarray:
        dtype, dims = detail
        return str(dtype), " × ".join(map(str, dims.shape)), _limits(dtype, dims)
    if base is Literal:
        return "text", "", f"one of {', '.join(f'`{one}`' for one in detail)}"
    if base is tuple:
        return "texts", f"≤ {messages.MAX_ITEMS}", ""
    if issubclass(base, StrEnum):
        return "text", "", "one of the [modes](#modes)" if base is Mode else f"one of {', '.join(f'`{one}`' for one in base)}"
    return _NAMES[base], "", ""


def _limits(dtype: np.dtype[Any], dims: Dims) -> str:
    low, high = dims.lengths or (0, 0)
    words = (
        "may hold NaN" if dtype.kind == "f" and not dims.finite else "",
        f"at most {dims.most}" if dims.most is not None else "",
        f"{low} to {high} of them" if dims.lengths else "",
        "may be empty" if dims.optional else "",
        "packed" if dims.packed else "",
    )
    return ", ".join(filter(None, words))


def _declared_in(kind: type[Message], name: str) -> str:
    """Return the name of the class that declares a field."""
    return next(base.__name__ for base in kind.__mro__ if name in inspect.get_annotations(base))
