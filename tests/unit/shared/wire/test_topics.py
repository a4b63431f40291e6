"""The topic table: one row per topic, no duplicates, a topic for every message."""

from enum import StrEnum
from typing import Any

import numpy as np
import pytest

from sextant.shared.wire import codec, messages, topics
from sextant.shared.wire.topics import TOPICS, Delivery, Lane, Topic


def test_keys_and_types_are_unique() -> None:
    assert len({t.key for t in TOPICS}) == len(TOPICS)
    of_roles = {*topics.HEALTH_OF.values(), *topics.PRESENCE_OF.values()}
    assert len({t.type for t in TOPICS if t not in of_roles}) == len(TOPICS) - len(of_roles)
    assert {t.type for t in of_roles} == {messages.Health, messages.Presence}


def test_health_and_presence_have_one_key_per_role() -> None:
    assert [topic.key for topic in topics.HEALTH_OF.values()] == [f"health/{role}" for role in topics.ROLE_NAMES]
    assert [topic.key for topic in topics.PRESENCE_OF.values()] == [f"machine/presence/{role}" for role in topics.ROLE_NAMES]
    assert topics.OF_TYPE[messages.Health] is topics.HEALTH_OF["robot"]
    assert set(topics.RENAMED.values()) <= {topic.key for topic in TOPICS}
    assert not set(topics.RENAMED) & {topic.key for topic in TOPICS}


def test_every_topic_is_in_table() -> None:
    rows = [value for value in vars(topics).values() if isinstance(value, Topic)]
    assert dict.fromkeys([*rows, *topics.HEALTH_OF.values(), *topics.PRESENCE_OF.values()]).keys() == set(TOPICS)


def test_every_message_except_tick_has_topic() -> None:
    kinds = {
        value
        for value in vars(messages).values()
        if isinstance(value, type) and issubclass(value, messages.Message) and value is not messages.Message
    }
    assert kinds - set(topics.OF_TYPE) == {messages.Tick}


@pytest.mark.parametrize("topic", TOPICS, ids=lambda t: t.key)
def test_topic_properties_are_consistent(topic: Topic[messages.Message]) -> None:
    assert 0.0 < topic.rate_hz <= 1000.0
    assert topic.fresh_for_ns == pytest.approx(3e9 / topic.rate_hz, abs=1)
    assert 0.0 < topic.latency_s < 0.1
    assert len(codec.encode(_smallest(topic.type))) < topic.max_bytes <= 1 << 26
    assert topic.key == topic.key.strip("/")
    assert not set(topic.key) & set("*$?# ")


@pytest.mark.parametrize("topic", TOPICS, ids=lambda t: t.key)
def test_large_frames_are_not_sent_with_control_priority(topic: Topic[messages.Message]) -> None:
    assert topic.lane is Lane.BULK or topic.max_bytes <= 64 * 1024


def test_single_use_messages_are_delivered_reliably() -> None:
    for topic in (topics.MODE, topics.STEP_PLAN, topics.ODOMETRY, topics.IMU, topics.HEALTH):
        assert topic.delivery is Delivery.EVERY


def test_depth_frame_of_profile_fits_topic() -> None:
    assert topics.DEPTH.max_bytes > 640 * 480 * 2
    assert topics.COLOR.max_bytes > 640 * 480 * 3
    assert topics.SCAN.max_bytes > 60_000


def _smallest(kind: type[messages.Message]) -> messages.Message:
    values: dict[str, Any] = {}
    for name, base, detail in messages.schema(kind):
        if base is np.ndarray:
            least = (detail[1].lengths or (0, 0))[0]
            values[name] = np.zeros([n if isinstance(n, int) else least for n in detail[1].shape], detail[0])
        elif isinstance(base, type) and issubclass(base, StrEnum):
            values[name] = next(iter(base))
        elif isinstance(detail, tuple):
            values[name] = detail[0]
        else:
            values[name] = base()
    return kind(**values)


@pytest.mark.parametrize("topic", [topics.TERRAIN, topics.PASSAGE, topics.DEPTH, topics.COLOR], ids=lambda topic: topic.key)
def test_largest_configurable_map_and_image_fit_their_message(topic: Topic[Any]) -> None:
    rows = 500
    columns = topics.cells_that_fit(topic) // rows
    rng, values = np.random.default_rng(0), {}
    for name, base, detail in messages.schema(topic.type):
        if base is np.ndarray:
            dtype, dims = detail
            shape = (rows, columns, *dims.shape[2:]) if len(dims.shape) >= 2 and isinstance(dims.shape[0], str) else dims.shape
            if dims.lengths and dims.optional:  # the grey image
                shape = (dims.lengths[1], dims.lengths[1])
            most = dims.most or 1
            noise = rng.integers(0, 2 if dtype.kind == "b" else most + 1 if dims.most else 120, shape)
            if dims.packed:
                noise = (
                    rng.integers(np.iinfo(dtype).min, np.iinfo(dtype).max, shape)
                    if dtype.kind in "iu" and not dims.most
                    else noise
                )
            values[name] = np.eye(4) if shape == (4, 4) else noise.astype(dtype)
        else:
            values[name] = "x" * messages.MAX_TEXT if base is str else 1 if base is int else 0.5
    for packs in (False, True):
        frame = codec.encode(topic.type(**values), packs=packs)
        assert len(frame) <= topic.max_bytes
        assert packs or len(frame) > 0.9 * topic.max_bytes
        codec.decode(frame, topic.type, topic.max_bytes)
