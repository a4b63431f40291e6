"""Fuzz targets: parsers of external data, each with valid examples."""

import asyncio
import json
import struct
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np

from benchmarks.fuzz import message_corpus, recording_mutators
from benchmarks.fuzz.file_targets import file_targets
from benchmarks.fuzz.mutators import broken, odd, odd_table
from benchmarks.fuzz.pulse_targets import pulse_targets
from benchmarks.fuzz.servo_targets import servo_targets
from benchmarks.fuzz.target import Target
from sextant.deploy.ros2 import message_types as ros
from sextant.deploy.ros2.bridge import TWIST, TWIST_STAMPED, read_twist
from sextant.deploy.ros2.depth_images import CAMERA_INFO, IMAGE, read_depth
from sextant.services.console.config import Settings
from sextant.services.console.drive.gamepad import GamepadError, events_of
from sextant.services.console.drive.keyboard import UNKNOWN, Keyboard
from sextant.services.console.web import requests
from sextant.services.console.web.connection import SOCKET, Connection
from sextant.services.console.web.origin_policy import PROTOCOL, OriginPolicy, RejectionLog
from sextant.services.console.web.pages import Page
from sextant.shared.runtime.service import AnyTopic
from sextant.shared.servo import bridge_protocol
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.firmware import framing
from sextant.shared.wire import codec, topics
from sextant.shared.wire.codec import DecodeError

_EXAMPLES = 32  # examples of a message
_PREFIX = struct.Struct("<I")
_JOYSTICK = struct.Struct("<IhBB")  # event of a joystick: time, value, type, number
_ALIGNMENT = 8


def targets(rng: Random) -> tuple[Target, ...]:
    """Return all targets.

    They are topics, servo bus, both ends of the microcontroller's protocol, ROS 2, the page, recordings and files.
    """
    return (
        *(_of_topic(topic, rng) for topic in topics.TOPICS),
        Target("servo bus", tuple(_packets()), _broken_behind(0), _take_packets),
        *servo_targets(),
        *pulse_targets(),
        Target("bridge, host", tuple(_wire_messages()), _odd_frame, lambda data: _take_wire(data, bridge_protocol.TO_HOST)),
        Target("bridge, board", tuple(_wire_messages()), _odd_frame, lambda data: _take_wire(data, bridge_protocol.FROM_HOST)),
        *(_of_twist(kind) for kind in (TWIST, TWIST_STAMPED)),
        _of_depth_image(),
        Target("drive, keys", (b"wwww sd\x1b[A\x1bOC\x03",), _broken_behind(0), _take_keys),
        Target(
            "drive, gamepad", (_JOYSTICK.pack(1, 0, 0x82, 1) + _JOYSTICK.pack(2, 1, 1, 4),), _broken_behind(0), _take_gamepad
        ),
        Target("page, request", tuple(text.encode() for text in _asked()), _odd_request, _take_request),
        _of_socket(),
        Target("recording", recording_mutators.examples(rng), recording_mutators.twisted, recording_mutators.Taker().take),
        *file_targets(),
    )


# ---------------------------------------------------------------------------------------------------------------- topics


def _of_topic(topic: AnyTopic, rng: Random) -> Target:
    def take(data: bytes) -> bool:
        try:
            codec.label(data)
            message, timing = codec.decode(data, topic.type, topic.max_bytes)
        except DecodeError:
            return False
        codec.encode(message, timing)  # a recorder or a bridge may encode it again
        return True

    return Target(topic.key, tuple(message_corpus.frame(topic.type, rng) for _ in range(_EXAMPLES)), _odd_header, take)


def _odd_header(frame: bytes, rng: Random) -> bytes:
    """Mutate a frame's header, with a correct length."""
    (length,) = _PREFIX.unpack_from(frame)
    end = _PREFIX.size + length
    header = odd(codec.unpack_values(frame[_PREFIX.size : end]), rng)
    packed = codec.pack_values(header)
    gap = -(_PREFIX.size + len(packed)) % _ALIGNMENT
    return _PREFIX.pack(len(packed)) + packed + bytes(gap) + frame[end + (-end % _ALIGNMENT) :]


# ------------------------------------------------------------------------------------------------------------ the servos


def _packets() -> list[bytes]:
    return [
        dxl.status(3, 0, b"\x00\x08\x00\x00"),
        dxl.status(7, 32, b"") + dxl.status(8, 0, b"\xff" * 11),
        dxl.ping(4),
        dxl.read(5, 36, 8),
        dxl.write(5, 30, b"\x00\x08"),
        dxl.sync_write(30, 4, [(number, b"\x00\x08\x20\x00") for number in range(1, 19)]),
    ]


def _take_packets(data: bytes) -> bool:
    parser = dxl.PacketParser()
    found = [packet for half in (data[: len(data) // 2], data[len(data) // 2 :]) for packet in parser.feed(half)]
    if parser.pending > dxl.OVERHEAD + 0xFF:
        raise AssertionError(f"{parser.pending} bytes are held back")
    return bool(found + parser.flush())


def _broken_behind(start: int) -> Callable[[bytes, Random], bytes]:
    return lambda data, rng: data[:start] + broken(data[start:], (data,), rng)


# ------------------------------------------------------------------------------------------------- the microcontroller


def _wire_messages() -> list[bytes]:
    ids, each, many = bytes(range(1, 19)), bytes(18), (512,) * 18
    said = (
        bridge_protocol.Hello(bridge_protocol.VERSION, 7, 10**6, ids),
        bridge_protocol.Goals(7, 1, 10**6, 100, many, many),
        bridge_protocol.Torque(7, 2, 10**6, 1),
        bridge_protocol.Limits(7, 3, 10**6, many),
        bridge_protocol.Ask(7, 4, 10**6, 3, 2, 36, 8, b""),
        bridge_protocol.First(7, 5, 10**6, ids[:3]),
        bridge_protocol.Welcome(bridge_protocol.VERSION, 7, 9, 10**6, "reference board", "AX-12A"),
        bridge_protocol.State(
            7,
            1,
            10**6,
            bridge_protocol.Mode(1),
            1,
            10,
            bridge_protocol.Refusal(0),
            0,
            0,
            0,
            0,
            *(many,) * 3,
            *(each,) * 3,
            many,
        ),
        bridge_protocol.Answer(7, 4, bridge_protocol.Result.ANSWERED, 0, b"\x00\x08"),
    )
    return [bridge_protocol.encode(message) for message in said]


def _odd_frame(frame: bytes, rng: Random) -> bytes:
    """Mutate a frame, with correct stuffing and checksum."""
    payload = framing.Deframer().feed(frame)[0]
    twisted = codec.pack_values(odd(codec.unpack_values(payload, framing.MAX_PAYLOAD), rng))
    return framing.frame(twisted) if len(twisted) < framing.MAX_PAYLOAD - _PREFIX.size else frame


def _take_wire(data: bytes, expected: frozenset[type[bridge_protocol.Message]]) -> bool:
    receiver = bridge_protocol.Receiver(expected)
    found = receiver.feed(data)
    if receiver.pending > framing.MAX_FRAME:
        raise AssertionError(f"{receiver.pending} bytes are held back")
    for message in found:
        bridge_protocol.encode(message)
    return bool(found)


# ----------------------------------------------------------------------------------------------------------------- ROS 2


def _of_twist(kind: str) -> Target:
    twist = ros.Twist(ros.Vector3(0.1, 0.0, 0.0), ros.Vector3(0.0, 0.0, 0.2))
    stamped = ros.TwistStamped(ros.Header(ros.Time(1, 2), "base_link"), twist)

    def take(data: bytes) -> bool:
        try:
            read_twist(kind, data)
        except ros.CdrError:
            return False
        return True

    return Target(
        f"ROS 2, {kind.rpartition('/')[2]}",
        (ros.encode(kind, stamped if kind == TWIST_STAMPED else twist),),
        _broken_behind(4),
        take,
    )


def _of_depth_image() -> Target:
    lens = np.array([58.5, 0.0, 31.5, 0.0, 58.5, 23.5, 0.0, 0.0, 1.0])
    projection = np.array([58.5, 0.0, 31.5, 0.0, 0.0, 58.5, 23.5, 0.0, 0.0, 0.0, 1.0, 0.0])
    header, region = ros.Header(ros.Time(1, 2), "camera"), ros.RegionOfInterest(0, 0, 0, 0, False)
    info = ros.CameraInfo(header, 48, 64, "plumb_bob", np.zeros(5), lens, np.eye(3).ravel(), projection, 0, 0, region)
    about = ros.encode(CAMERA_INFO, info)
    examples = tuple(
        ros.encode(IMAGE, ros.Image(header, 48, 64, encoding, 0, 64 * size, np.full(48 * 64 * size, 7, np.uint8)))
        for encoding, size in (("16UC1", 2), ("32FC1", 4))
    )

    def take(data: bytes) -> bool:
        try:
            read_depth(data, about, 1000.0, lambda at_ns: at_ns)
        except ros.CdrError:
            return False
        return True

    return Target("ROS 2, Image", examples, _broken_behind(4), take)


# ------------------------------------------------------------------------------------------------------ keys and gamepad


def _take_keys(data: bytes) -> bool:
    keyboard = Keyboard()
    others = keyboard.read(data, 0)
    keyboard.motion.wish(0)
    return UNKNOWN not in others


def _take_gamepad(data: bytes) -> bool:
    try:
        list(events_of(data))
    except GamepadError:
        return False
    return True


# -------------------------------------------------------------------------------------------------------------- the page


def _asked() -> list[str]:
    walk = {"height": 0.11, "lift": 0.03, "gait": "tripod"}
    drive = {"press": 3, "forward": 0.1, "left": 0.0, "turn": 0.1, **walk, "blind_walking": False}
    goal = {"waypoints": [[0.5, 0.1], [1.0, 0.2]], "speed": 0.1, **walk, "passage": False}
    said: list[dict[str, Any]] = [
        {"type": "drive", **drive},
        {"type": "go to", **goal},
        {"type": "order", "order": "stand"},
        {"type": "watch", "layer": "score", "picture": True},
        {"type": "seen", "what": "map"},
        {"type": "record", "on": True},
        {"type": "name", "name": "Ada"},
        *({"type": kind} for kind in ("release", "take over", "give up", "here")),
    ]
    return [json.dumps(one) for one in said]


def _odd_request(data: bytes, rng: Random) -> bytes:
    return json.dumps(odd_table(json.loads(data), rng), default=repr).encode()


def _take_request(data: bytes) -> bool:
    try:
        requests.parse(data.decode(errors="replace"))
    except requests.RequestError:
        return False
    return True


class _Host:
    """Host without pages that counts their requests."""

    origin_policy, rejection_log = OriginPolicy(Settings()), RejectionLog()
    files: dict[str, bytes] = {"index.html": b"<!doctype html>"}  # noqa: RUF012 - required by its protocol

    def __init__(self) -> None:
        self.heard = 0

    def opened(self, connection: Connection) -> None: ...

    def closed(self, connection: Connection) -> None: ...

    def page_closed(self, page: Page) -> None: ...

    def pages_open(self) -> int:
        return 0

    def page_opened(self, connection: Connection, glances: bool) -> Page:
        return Page(0)

    def receive_text(self, page: Page, text: str) -> None:
        self.heard += _take_request(text.encode(errors="replace"))


class _Nowhere(asyncio.Transport):
    """Transport that discards its data."""

    def write(self, data: Any) -> None: ...

    def write_eof(self) -> None: ...

    def can_write_eof(self) -> bool:
        return True

    def abort(self) -> None: ...


class _Still(asyncio.AbstractEventLoop):
    """Event loop in which no time passes."""

    def get_debug(self) -> bool:
        return False

    def time(self) -> float:
        return 0.0

    def call_later(self, delay: float, callback: Any, *args: Any, context: Any = None) -> asyncio.TimerHandle:  # type: ignore[override]
        return asyncio.TimerHandle(delay, callback, args, self, context)

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None: ...


def _of_socket() -> Target:
    """Return the target for a browser's HTTP request and socket messages, in pieces."""
    loop = _Still()  # type: ignore[abstract]  # a connection needs no other methods
    greeting = "\r\n".join(
        (
            f"GET {SOCKET} HTTP/1.1",
            "Host: 127.0.0.1:8080",
            "Origin: http://127.0.0.1:8080",
            "Connection: Upgrade",
            "Upgrade: websocket",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
            f"Sec-WebSocket-Protocol: {PROTOCOL}",
            "\r\n",
        )
    ).encode()
    examples = [greeting + b"".join(map(_framed, _asked()[at : at + 2])) for at in range(len(_asked()))]
    examples.append(b"GET / HTTP/1.1\r\nHost: 127.0.0.1:8080\r\n\r\n")

    def take(data: bytes) -> bool:
        host = _Host()
        asyncio._set_running_loop(loop)
        try:
            connection = Connection(host)
            connection.connection_made(_Nowhere())
            for start in range(0, len(data), 512):
                connection.data_received(data[start : start + 512])
            connection.eof_received()
            connection.connection_lost(None)
        finally:
            asyncio._set_running_loop(None)
        return host.heard > 0

    return Target("page, socket", tuple(examples), _broken_behind(len(greeting)), take)


def _framed(text: str) -> bytes:
    """Frame a text as a browser does, masked with zeros."""
    data = text.encode()
    length = bytes([0x80 | len(data)]) if len(data) < 126 else b"\xfe" + struct.pack(">H", len(data))
    return b"\x81" + length + bytes(4) + data
