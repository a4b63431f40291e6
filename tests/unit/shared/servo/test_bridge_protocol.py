"""Messages of the bridge: round trips, invalid data, and ages.

The worked example of the document is included.
"""

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.shared.servo import bridge_protocol
from sextant.shared.servo import dynamixel as dxl
from sextant.shared.servo.bridge_fields import Choice, Kind, Octets, Text, Whole, Words
from sextant.shared.servo.bridge_protocol import FROM_HOST, MESSAGES, TO_HOST, Message, Receiver, RemoteClock
from sextant.shared.servo.firmware import commands
from sextant.shared.servo.firmware.framing import frame
from sextant.shared.servo.models import AX_12A, LX_16A, STS3215, XL430_W250
from sextant.shared.wire.codec import DecodeError, pack_values

WILD = settings(deadline=None, derandomize=True, max_examples=150)
DOCUMENT = (Path(__file__).parents[4] / "docs" / "bridge.md").read_text(encoding="utf-8")
N = 18


def values_of(kind: Kind, count: int) -> st.SearchStrategy[Any]:
    match kind:
        case Whole(low, high):
            return st.integers(low, high)
        case Choice(of):
            return st.sampled_from(list(of))
        case Text(most):
            return st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=most)
        case Octets(_, high):
            return st.lists(st.integers(0, high), min_size=count, max_size=count, unique=True).map(bytes)
        case Words(low, high, _):
            return st.lists(st.integers(low, high), min_size=count, max_size=count).map(tuple)
    raise AssertionError(kind)


@st.composite
def messages(draw: st.DrawFn, expected: frozenset[type[Message]] = FROM_HOST | TO_HOST) -> Message:
    message = draw(st.sampled_from(sorted(expected, key=lambda kind: kind.code)))
    count = draw(st.integers(1, bridge_protocol.MAX_SERVOS))
    fields = {name: draw(values_of(kind, count)) for name, kind in bridge_protocol._kinds(message)}
    if "version" in fields:
        fields["version"] = bridge_protocol.VERSION
    return message(**fields)


def anything() -> st.SearchStrategy[Any]:
    leaf = st.none() | st.booleans() | st.integers(-(1 << 63), (1 << 64) - 1) | st.floats() | st.binary(max_size=60) | st.text()
    return st.recursive(leaf, lambda inner: st.lists(inner, max_size=22) | st.dictionaries(st.text(), inner, max_size=2))


@pytest.mark.slow
@WILD
@given(messages())
def test_messages_survive_round_trip(message: Message) -> None:
    receiver = Receiver(FROM_HOST | TO_HOST)
    assert receiver.feed(bridge_protocol.encode(message)) == [message]
    assert receiver.dropped.total() == 0


@WILD
@given(st.lists(st.binary(max_size=300), max_size=6), messages(FROM_HOST))
def test_any_bytes_decode_to_messages_or_are_dropped(parts: list[bytes], message: Message) -> None:
    receiver = Receiver(FROM_HOST)
    for part in parts:
        receiver.feed(part)
    assert receiver.feed(bridge_protocol.encode(message)) == [message]


@pytest.mark.slow
@WILD
@given(st.sampled_from(sorted(MESSAGES)) | st.integers(), st.lists(anything(), max_size=20))
def test_any_intact_frame_is_message_or_refused(code: int, values: list[Any]) -> None:
    try:
        payload = pack_values([code, *values])
        sent = frame(payload)
    except (ValueError, OverflowError):
        return  # longer than a frame, or no number of msgpack
    receiver = Receiver(FROM_HOST | TO_HOST)
    found = receiver.feed(sent)
    assert len(found) + receiver.dropped[bridge_protocol.REFUSED] == 1
    assert found or receiver.last_refusal


@pytest.mark.slow
@WILD
@given(messages(), st.data())
def test_message_with_any_field_value_is_valid_or_refused(message: Message, data: st.DataObject) -> None:
    kinds = bridge_protocol._kinds(type(message))
    values = [kind.to_wire(getattr(message, name)) for name, kind in kinds]
    values[data.draw(st.integers(0, len(values) - 1))] = data.draw(anything())
    try:
        sent = frame(pack_values([message.code, *values]))
    except (ValueError, OverflowError):
        return
    for found in Receiver(FROM_HOST | TO_HOST).feed(sent):
        assert type(found)(*(getattr(found, field.name) for field in dataclasses.fields(found))) == found  # type: ignore[arg-type]


def test_each_side_accepts_only_messages_of_the_other() -> None:
    order = bridge_protocol.Torque(7, 1, 0, 0)
    receiver = Receiver(TO_HOST)
    assert receiver.feed(bridge_protocol.encode(order)) == []
    assert receiver.last_refusal == "one of the types [129, 130, 131] expected, found 3"


def test_greeting_of_other_version_is_recognized() -> None:
    receiver = Receiver(FROM_HOST)
    assert receiver.feed(frame(pack_values([1, 9, "all", "different"]))) == []
    assert receiver.other_version == 9
    assert receiver.last_refusal == "version 2 of the bridge's wire expected, found version 9"
    receiver.feed(bridge_protocol.encode(bridge_protocol.Hello(bridge_protocol.VERSION, 1, 0, bytes([1]))))
    assert receiver.other_version is None


@pytest.mark.parametrize(
    ("message", "fields", "words"),
    [
        (
            bridge_protocol.Goals,
            (7, 1, 0, 200, (-32768,), (0,)),
            "Goals.position: at most 24 whole numbers from -32767 to 32767 expected",
        ),
        (
            bridge_protocol.Goals,
            (7, 1, 0, 200, (512,), (-1,)),
            "Goals.speed: at most 24 whole numbers from 0 to 32767 expected",
        ),
        (bridge_protocol.Goals, (7, 1, 0, 200, (512, 512), (0,)), "equal numbers of values expected"),
        (
            bridge_protocol.Goals,
            (7, 1, 0, 1001, (512,), (0,)),
            "Goals.lifetime_ms: a whole number from 20 to 1000 expected, found 1001",
        ),
        (bridge_protocol.Goals, (7, 1, 0, 200, (512,) * 25, (0,) * 25), "at most 24 whole numbers"),
        (bridge_protocol.Goals, (7, 1, 0, 200, (512.0,), (0,)), "Goals.position"),
        (bridge_protocol.Torque, (7, 1, 0, True), "Torque.on"),
        (bridge_protocol.Torque, (0, 1, 0, 1), "Torque.session"),
        (bridge_protocol.Hello, (2, 7, 0, bytes([1, 1])), "each once"),
        (bridge_protocol.Hello, (2, 7, 0, bytes([254])), "bytes of 0 to 253"),
        (bridge_protocol.Welcome, (2, 7, 0, 0, "x" * 33, ""), "a text of at most 32"),
    ],
)
def test_invalid_message_is_refused_with_expectation(message: type[Message], fields: tuple[Any, ...], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        message(*fields)


def test_state_of_max_servos_fits_frame() -> None:
    n, top = bridge_protocol.MAX_SERVOS, 0xFFFF_FFFF
    octets = bytes([255] * n)
    state = bridge_protocol.State(
        *(top, top, (1 << 64) - 1, bridge_protocol.Mode.ON, top, 0xFFFF, bridge_protocol.Refusal.FAR, top, top, top, top),
        *((-32767,) * n, (32767,) * n, (-32767,) * n, octets, octets, octets, (bridge_protocol.NEVER,) * n),
    )
    assert Receiver(TO_HOST).feed(bridge_protocol.encode(state)) == [state]


# ------------------------------------------------------------------------------------------------------ the document


def test_documented_examples_match_encoding() -> None:
    examples = re.findall(r"^`(\w+)\((.*?)\)` is\n\n```text\n(.*?)\n```$", DOCUMENT, re.MULTILINE | re.DOTALL)
    assert {name for name, _, _ in examples} >= {"Hello", "Goals", "Torque", "State"}
    for name, arguments, dump in examples:
        known = {"bridge": bridge_protocol, "Mode": bridge_protocol.Mode, "Refusal": bridge_protocol.Refusal}
        message = eval(f"bridge.{name}({arguments})", known)
        sent = bytes.fromhex(re.sub(r"#.*", "", dump))
        assert bridge_protocol.encode(message) == sent, name
        assert Receiver(FROM_HOST | TO_HOST).feed(sent) == [message], name


def test_document_lists_every_message_and_field() -> None:
    for kind in MESSAGES.values():
        row = next(row for row in DOCUMENT.splitlines() if row.startswith(f"| {kind.code} | {kind.__name__} |"))
        listed = re.findall(r"`(\w+)`", row.split("|")[3])
        assert listed == [name for name, _ in bridge_protocol._kinds(kind)], kind.__name__


@pytest.mark.parametrize(
    "table", [bridge_protocol.Mode, bridge_protocol.Refusal, bridge_protocol.Result, bridge_protocol.Instruction]
)
def test_document_lists_every_mode_refusal_and_result(table: Any) -> None:
    for member in table:
        assert f"| {member.value} | {member.name} |" in DOCUMENT


def test_documented_times_match_frames() -> None:
    top, octets = 0xFFFF_FFFF, bytes([255] * N)
    late = (top, top, (1 << 64) - 1)
    state = bridge_protocol.State(
        *(*late, bridge_protocol.Mode.ON, top, 0xFFFF, bridge_protocol.Refusal.FAR, top, top, top, top),
        *((-32767,) * N, (32767,) * N, (-32767,) * N, octets, octets, octets, (bridge_protocol.NEVER,) * N),
    )
    ask = bridge_protocol.Ask(*late, dxl.MAX_ID, int(dxl.Instruction.READ), 36, 8, b"")
    answer = bridge_protocol.Answer(top, top, bridge_protocol.Result.ANSWERED, 255, bytes(8))
    sizes = {
        "Goals": len(bridge_protocol.encode(bridge_protocol.Goals(*late, 200, (32767,) * N, (32767,) * N))),
        "State": len(bridge_protocol.encode(state)),
        "Ask and Answer": len(bridge_protocol.encode(ask)) + len(bridge_protocol.encode(answer)),
    }
    for model in (AX_12A, STS3215, XL430_W250):
        bus, table = model.protocol, model.table
        answer_size = len(bus.status(1, 0, bytes(table.state.size)))
        reading = len(bus.read(1, table.state.address, table.state.size)) + answer_size
        goals = len(bus.sync_write(table.goals.address, table.goals.size, [(i, bytes(table.goals.size)) for i in range(N)]))
        cycle = goals + N * reading
        sizes |= {f"{model.name}: goals": goals, f"{model.name}: one reading": reading, f"{model.name}: a cycle": cycle}
    for name, size in sizes.items():
        assert f"| {name} | {size} | {size * dxl.BITS_PER_BYTE * 1e-3:.2f} ms |" in DOCUMENT


def test_documented_times_of_commands_match_what_the_firmware_writes_and_reads() -> None:
    bus, table = LX_16A.protocol, LX_16A.table
    position = table.present_position
    goal = len(bus.write(1, table.goal_position.address, bytes(4)))
    reading = len(bus.read(1, position.address, position.size)) + bus.OVERHEAD + position.size
    sizes = {"one goal": goal, "one reading": reading, "18 goals and readings": N * (goal + reading)}
    byte_ms = dxl.BITS_PER_BYTE * 1e3 / LX_16A.bus_rate
    for named in (0, 3, 6):
        reads = named + commands.IN_TURN
        goals = int((commands.GOALS_US * 1e-3 - reads * (reading * byte_ms + 0.1)) / (goal * byte_ms))
        sizes[f"{goals} goals, {reads} readings"] = goals * goal + reads * reading
    for name, size in sizes.items():
        assert f"| LX-16A: {name} | {size} | {size * byte_ms:.2f} ms |" in DOCUMENT


# -------------------------------------------------------------------------------------------------------------- times


@WILD
@given(
    st.integers(0, 1 << 50),
    st.integers(-(1 << 50), 1 << 50),
    st.lists(st.tuples(st.integers(1, 10**9), st.integers(0, 10**8)), min_size=1, max_size=30),
)
def test_age_is_bounded_by_delay_and_exact_after_quick_message(
    began_us: int, offset_ns: int, sent: list[tuple[int, int]]
) -> None:
    clock, now_us, arrived_ns = RemoteClock(), began_us, 0
    clock.age_ns(now_us, 1000 * now_us + offset_ns)  # a message without delay
    for gap_us, delay_ns in sent:
        now_us += gap_us
        arrived_ns = max(arrived_ns, 1000 * now_us + offset_ns + delay_ns)
        true_ns = arrived_ns - 1000 * now_us - offset_ns
        age_ns = clock.age_ns(now_us, arrived_ns)
        assert 0 <= age_ns <= true_ns + 1000
        assert age_ns >= true_ns - 1000 - 2e-4 * (arrived_ns - 1000 * began_us - offset_ns)


def test_buffered_bytes_are_dated_as_old() -> None:
    clock = RemoteClock()
    for k in range(5):
        assert clock.age_ns(20_000 * k, 20_000_000 * k) == 0
    late_ns = 2_000_000_000
    ages = [clock.age_ns(20_000 * k, late_ns) for k in range(5, 100)]
    assert ages == sorted(ages, reverse=True)
    assert ages[0] == pytest.approx(1.9e9, rel=1e-3)


def test_codec_error_is_bridge_error() -> None:
    with pytest.raises(DecodeError, match="not msgpack"):
        bridge_protocol.decode(b"\xc1", FROM_HOST)
    with pytest.raises(DecodeError, match="a message type and its fields expected"):
        bridge_protocol.decode(b"\x01", FROM_HOST)
    with pytest.raises(DecodeError, match="Torque: 4 fields expected, found 1"):
        bridge_protocol.decode(pack_values([3, 7]), FROM_HOST)
