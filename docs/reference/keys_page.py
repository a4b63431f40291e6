"""Generator of docs/keys.md, a page with every key, and of pages with every message, docs/keys_*.md.

It reads the topic table, the process table and the message declarations. The meaning of a field is its comment in the source.
"""

import importlib
import inspect
import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from docs.reference.parts import Part, anchor, split
from sextant.deploy.launch.process_table import ROUTER_ENDPOINT, TABLE
from sextant.deploy.live.send_command import Order
from sextant.deploy.ros2.bridge import Bridge
from sextant.evaluation.observers.operator import Operator
from sextant.evaluation.scoring.scorer import Scorer
from sextant.services.perception.calibration.calibration_client import CalibrationClient
from sextant.shared.field_comments import comments
from sextant.shared.robot.profile import JOINTS, LEGS
from sextant.shared.robot.profiles import load_profile
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.wire import codec, messages, topics
from sextant.shared.wire.field_table import field_rows
from sextant.shared.wire.messages import Mode, VelocityCommand
from sextant.shared.wire.transport import Endpoints

CLIENT = Path(__file__).resolve().parents[1] / "walk_client.py"
_TOPICS = [topic for topic in topics.TOPICS if topic is topics.OF_TYPE[topic.type]]  # one of each message

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
- A subscriber refuses a frame that is larger than its topic allows, or not as declared. It counts the frame and reports
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
  {{odom}} is the estimate by the legs alone, {{body}} moves with the robot, x forward, y left, z up. {{odom}} starts again
  whenever the robot has stood up ([Odometry](#actuatorodometry-odometry)).
- `sextant topics echo KEY` prints messages, `sextant topics hz` measures rates and bandwidth.
- A program of your own may publish under any other key, such as `{namespace}_survey/ground`: no service reads it, and `sextant
  record` does not record it. Choose a first word other than the namespace, below which a later version may add topics. A router
  with `--keys` or `--open` passes messages of other machines only under the keys of the table, with a certificate only those of
  its role ([access.md](access.md)). It drops all others without a report. Processes on its own machine may use any key.
"""
_OF_FRAMES = """`schema` is the id that each message has on its page. The dtype of an array is in NumPy's notation: `<f8` is a
little-endian float64, `|u1` a uint8, `|b1` a boolean of one byte. `began_ns` and `sent_ns` are the times at which the sender
began to make the message and sent it; 0 if they are not recorded.

For example, a velocity command:
"""
_OF_CLIENT = """## A client

[walk_client.py](walk_client.py) needs `eclipse-zenoh` and `msgpack`, but not Sextant. It takes the lease, walks the robot
and prints the robot's state; `sextant up all --scenario flat` starts a robot to try it on. `sextant topics list --json` has the
schema and the fields of each message for programs, so that none has to copy the tables of the messages.
"""
_PAGES = {  # name of a page of messages: its title, and the first words of their keys
    "keys_robot": ("Messages of camera, IMU and actuator", ("camera", "imu", "actuator")),
    "keys_map": ("Messages of pose and maps", ("perception", "external", "mapper", "passage")),
    "keys_walk": ("Messages of planner and operator", ("planner", "operator")),
    "keys_system": ("Messages of recorder, simulator and machines", ("recorder", "simulator", "health", "machine")),
}
_OF_FIELDS = "[Keys and messages](keys.md#the-messages) states the order of legs, joints and points in the arrays."


def pages() -> dict[str, str]:
    """Return the pages in Markdown by their names.

    Raises:
        ImportError: A service needs a package that is not installed.
    """
    parts = {
        name: Part(title, _OF_FIELDS, tuple(_title(topic) for topic in _TOPICS if topic.key.partition("/")[0] in words))
        for name, (title, words) in _PAGES.items()
    }
    return split("keys", _page(), parts, {})


def _page() -> str:
    """Return all in one page."""
    written, read = _writers_and_readers()
    said = comments(inspect.getsource(messages))
    return "\n".join(
        (
            _BEGINNING.format(router=ROUTER_ENDPOINT, namespace=Endpoints((ROUTER_ENDPOINT,)).namespace),
            *_table(written, read),
            *_frame(),
            *_client(),
            *_modes(said),
            *_arrays(),
            *(line for topic in _TOPICS for line in _message(topic)),
        )
    )


def _table(written: Mapping[str, list[str]], read: Mapping[str, list[str]]) -> Iterator[str]:
    yield "## The keys"
    yield ""
    yield "| key | message | rate | delivery | lane | at most, KiB | published by | subscribed by | over the radio |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for topic in topics.TOPICS:
        cells = (
            f"`{topic.key}`",
            f"[{topic.type.__name__}](#{anchor(_title(topics.OF_TYPE[topic.type]))})",
            topic.rate,
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
        ("`sextant camera calibrate`", CalibrationClient),
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


def _arrays() -> Iterator[str]:
    """Yield the lines before the messages: the order of fields, legs and joints."""
    profile = load_profile("phantomx_mk2")
    yield "## The messages"
    yield ""
    yield "Their fields are on these pages:"
    yield ""
    yield from (f"- [{title}]({name}.md)" for name, (title, _) in _PAGES.items())
    yield ""
    yield "The fields are in the order of the frame. An array of six has one entry or one row for each leg:"
    yield f"{', '.join(LEGS)}."
    yield f"The columns of joint angles and torques are {', '.join(JOINTS)}, those of points x, y, z."
    yield "A foot is a sphere: `feet` and `touchdown` are its centre, `touchdown_point` is on its underside, lower by"
    yield f"the profile's `foot.radius` ({1000 * profile.foot.radius:g} mm for `{profile.name}`)."
    yield ""


def _message(topic: AnyTopic) -> Iterator[str]:
    kind = topic.type
    yield f"### {_title(topic)}"
    yield ""
    yield " ".join((inspect.getdoc(kind) or "").split())
    yield ""
    yield f"Schema `{codec.schema_id(kind)}`"
    yield ""
    yield "| field | type | shape | unit | frame | what |"
    yield "|---|---|---|---|---|---|"
    for row in field_rows(kind):
        names = "the [modes](#modes)" if row.choices == tuple(Mode) else ", ".join(f"`{name}`" for name in row.choices)
        what = "; ".join(filter(None, (row.what, names and f"one of {names}"))).replace("|", "\\|")
        yield f"| `{row.name}` | {row.type} | {' × '.join(map(str, row.shape))} | {row.unit} | {row.frame} | {what} |"
    yield ""


def _title(topic: AnyTopic) -> str:
    return f"{topic.key} {topic.type.__name__}"
