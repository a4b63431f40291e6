"""A passive subscriber: newest states, all events, rates and ages.

Messages for which there is no room are counted.
"""

import json
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sextant.deploy import cli
from sextant.deploy.topics import message_format, topic_stats
from sextant.deploy.topics.passive_subscriber import ONLY_BY_NAME, Mailbox, ReceivedMessage, age_ns, listen, topics_named
from sextant.shared.wire import codec, topics
from sextant.shared.wire.codec import DecodeError, Timing
from sextant.shared.wire.messages import CameraState, Odometry, TerrainMap, VelocityCommand
from sextant.shared.wire.ports import free_port
from sextant.shared.wire.topics import TOPICS, Lane
from sextant.shared.wire.transport import Endpoints, Router, ZenohLink

MS, S = 1_000_000, 1_000_000_000
NOW = 50 * S
ODOMETRY = Odometry(NOW - 20 * MS, np.eye(4), 1.25, 0.5, np.ones(6, dtype=bool), True)


def frame_of(message: Any, sent_ns: int = NOW - 5 * MS) -> bytes:
    return codec.encode(message, Timing(sent_ns - MS, sent_ns))


def of_another_version(message: Any) -> bytes:
    frame = codec.encode(message)
    name = codec.schema_id(type(message)).encode()
    return frame.replace(name, name[:-8] + b"00000000")


def terrain() -> TerrainMap:
    height = np.linspace(-0.02, 0.3, 64, dtype=np.float32).reshape(8, 8).copy()
    height[:4] = np.nan
    known = np.zeros((8, 8), dtype=bool)
    return TerrainMap(NOW, 0.01, np.zeros(2), height, height, height, known, known.astype(np.int8))


# --------------------------------------------------------------------------------------------------------- which topics


def test_default_topics_exclude_on_demand_topics() -> None:
    assert {*topics_named([], "sextant")} == {*TOPICS} - {*ONLY_BY_NAME}
    assert topics_named(["camera/color", "imu", "imu"], "sextant") == (topics.COLOR, topics.IMU)


def test_key_may_have_the_namespace_as_prefix_but_not_another_one() -> None:
    assert topics_named(["site/imu", "imu", "site/camera/color"], "site") == (topics.IMU, topics.COLOR)
    with pytest.raises(ValueError, match="no topic 'sextant/camera/color'; did you mean 'camera/color'"):
        topics_named(["sextant/camera/color"], "site")


@pytest.mark.parametrize(
    ("key", "near"),
    [("actuator/odo", "actuator/odometry"), ("mapper/terain", "mapper/terrain"), ("helth/robot", "health/robot")],
)
def test_unknown_key_is_refused_with_nearest_match(key: str, near: str) -> None:
    with pytest.raises(ValueError, match=f"did you mean '{near}'"):
        topics_named(["imu", key], "sextant")


# -------------------------------------------------------------------------------------------------------------- mailbox


@given(st.lists(st.sampled_from((topics.ODOMETRY, topics.TERRAIN, topics.MODE)), max_size=600))
@settings(max_examples=30, deadline=None)
def test_mailbox_keeps_newest_state_all_events_and_counts_frames(sent: list[Any]) -> None:
    mailbox = Mailbox()
    for n, topic in enumerate(sent):
        mailbox.take(topic, b"%d" % n, n)
    assert mailbox.news.is_set() == bool(sent)
    found = mailbox.drain()
    assert [heard.at_ns for heard in found] == sorted(heard.at_ns for heard in found)
    assert len(found) + sum(heard.passed_over for heard in found) == len(sent)
    assert sum(heard.topic is topics.TERRAIN for heard in found) <= 1
    for topic in {*sent}:
        newest = max(n for n, other in enumerate(sent) if other is topic)
        assert [h for h in found if h.topic is topic][-1].frame == b"%d" % newest
    assert mailbox.drain() == []


# ------------------------------------------------------------------------------------------------------------------ age


@pytest.mark.parametrize(
    ("stamp", "sent", "age"),
    [
        (NOW - 20 * MS, NOW - 5 * MS, 20 * MS),
        (NOW - 20 * MS, 0, 20 * MS),  # without a time of sending the stamp counts
        (NOW + MS, NOW - 5 * MS, 0),  # a simulator's stamp may lie slightly ahead
        (NOW + S, NOW - 5 * MS, -S),
        (NOW - 20 * MS, NOW + 5 * MS, None),
        (NOW - 20 * MS, NOW - 11 * S, None),
        (7 * S, 0, None),
    ],
)
def test_age_is_known_only_for_same_clock(stamp: int, sent: int, age: int | None) -> None:
    found = codec.label(codec.encode(replace(ODOMETRY, stamp_ns=stamp), Timing(0, sent)))
    assert found.schema_id == codec.schema_id(Odometry)
    assert age_ns(found, NOW) == age


@given(st.binary(max_size=64))
def test_random_bytes_are_counted_as_undecodable(data: bytes) -> None:
    counted = topic_stats.Rates((topics.IMU,))
    counted.take(topics.IMU, data, NOW)
    (row,) = counted.rows(1.0)
    assert (row.frames, row.refused) == (1, 1)
    assert row.refusal
    with pytest.raises(DecodeError):
        message_format.in_words(ReceivedMessage(topics.IMU, data, NOW, 0))


# ---------------------------------------------------------------------------------------------------------------- shown


def test_small_array_is_printed_and_large_array_is_summarized() -> None:
    words = message_format.in_words(ReceivedMessage(topics.TERRAIN, frame_of(terrain()), NOW, 3))
    assert "mapper/terrain  TerrainMap" in words
    assert "3 skipped" in words
    assert "float32 (8, 8)  50 % finite, 0.14254 to 0.3" in words
    assert "bool (8, 8)  0 % true" in words
    assert "float64 (2,)  [0 0]" in words
    odometry = message_format.in_words(ReceivedMessage(topics.ODOMETRY, frame_of(ODOMETRY), NOW, 0))
    assert "20 ms old" in odometry
    assert odometry.count("[") - 1 >= 4, "a row of the pose on each line"
    assert "skipped" not in odometry


def test_small_numbers_are_printed_and_rounding_errors_are_not() -> None:
    T_odom_body = np.eye(4)
    T_odom_body[:3, 3] = 12.3456, 1.5e-6, 1e-17
    lines = message_format.in_words(
        ReceivedMessage(topics.ODOMETRY, frame_of(replace(ODOMETRY, T_odom_body=T_odom_body)), NOW, 0)
    ).splitlines()
    assert [line.split()[-1].rstrip("]") for line in lines if line.endswith("]")][-5:-1] == ["12.346", "1.5e-06", "0", "1"]


def test_script_output_is_json_without_nan() -> None:
    found = message_format.for_scripts(ReceivedMessage(topics.TERRAIN, frame_of(terrain()), NOW, 0))
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["message"]["elevation"] == {
        "dtype": "float32",
        "shape": [8, 8],
        "finite": 0.5,
        "min": pytest.approx(0.14254, abs=1e-5),
        "max": pytest.approx(0.3),
    }
    again = message_format.for_scripts(ReceivedMessage(topics.ODOMETRY, frame_of(ODOMETRY), NOW, 2))
    assert np.array_equal(again["message"]["T_odom_body"], ODOMETRY.T_odom_body)
    assert (again["age_ms"], again["passed_over"], again["message"]["stance"]) == (20.0, 2, [True] * 6)


# ---------------------------------------------------------------------------------------------------------------- rates


def test_rates_sizes_gaps_and_ages_match_frames() -> None:
    wanted = (topics.ODOMETRY, topics.TERRAIN, topics.IMU)
    counted = topic_stats.Rates(wanted)
    frame, large = frame_of(ODOMETRY, NOW), frame_of(terrain(), NOW)
    for n in (0, 1, 2, 5):
        counted.take(topics.ODOMETRY, frame, NOW + n * 20 * MS)
    counted.take(topics.TERRAIN, large, NOW + 20 * S)
    odometry, map_, imu = counted.rows(2.0)
    assert (odometry.frames, odometry.rate_hz, odometry.gap_ms) == (4, 2.0, 60.0)
    assert (odometry.mean_bytes, odometry.largest_bytes, odometry.bytes_per_s) == (len(frame), len(frame), 2 * len(frame))
    assert odometry.age_ms == pytest.approx((50.0, 120.0))
    assert (map_.gap_ms, map_.age_ms, map_.lane) == (None, None, Lane.BULK)
    assert imu.frames == 0
    found = topic_stats.totals([odometry, map_, imu])
    assert found["onboard", Lane.CONTROL] == found["sum", Lane.CONTROL]
    budget = 50.0 * topics.ODOMETRY.max_bytes + 100.0 * topics.IMU.max_bytes
    assert found["onboard", Lane.CONTROL] == topic_stats.Total(2.0, odometry.bytes_per_s, budget)
    assert found["offboard", Lane.BULK] == topic_stats.Total(
        0.5, map_.bytes_per_s, topics.TERRAIN.rate_hz * topics.TERRAIN.max_bytes
    )
    words = topic_stats.in_words([odometry, map_, imu])
    assert "2.0, 50 Hz" in words
    assert "*" not in words
    assert "another clock" in words
    assert "silent: imu" in words
    table = topic_stats.for_scripts([odometry, map_, imu], 2.0)
    assert json.loads(json.dumps(table)) == table


def test_rates_of_topics_with_more_messages_are_explained() -> None:
    counted = topic_stats.Rates((topics.HEALTH,))
    for n in range(10):
        counted.take(topics.HEALTH, b"", NOW + n * 100 * MS)
    words = topic_stats.in_words(counted.rows(1.0))
    assert "10.0, 1 Hz*" in words
    assert "* health/robot 1 Hz from each process" in words


def test_undecodable_frames_are_counted_and_reported() -> None:
    counted = topic_stats.Rates((topics.VELOCITY,))
    command = VelocityCommand(NOW, np.zeros(2), 0.0, 0.1, 0.04)
    for frame in (codec.encode(command), of_another_version(command), b"\1", bytes(3000)):
        counted.take(topics.VELOCITY, frame, NOW)
    (row,) = counted.rows(1.0)
    assert (row.frames, row.refused) == (4, 3)
    assert f"operator/velocity: 3 of 4 cannot be decoded: {row.refusal}" in topic_stats.in_words([row])


def test_each_topic_has_a_side() -> None:
    found = {topic.key: topic_stats.side(topic) for topic in TOPICS}
    assert {*found.values()} == {"onboard", "offboard", "operators", "simulation", "all"}
    assert (found["imu"], found["planner/step"], found["operator/mode"]) == ("onboard", "offboard", "operators")


# -------------------------------------------------------------------------------------- the commands, over a real router


@pytest.fixture(scope="module")
def robot() -> Iterator[list[str]]:
    """Publish odometry, a camera's state, and velocities of another version.

    Yields the options with which a command connects to this robot.
    """
    endpoint, over = f"tcp/127.0.0.1:{free_port()}", threading.Event()

    def speak(link: ZenohLink) -> None:
        while not over.wait(0.01):
            now = time.monotonic_ns()
            link.send(topics.ODOMETRY, codec.encode(replace(ODOMETRY, stamp_ns=now), Timing(now, now)))
            link.send(topics.CAMERA_STATE, codec.encode(CameraState(now, "a camera", True, ""), Timing(now, now)))
            link.send(topics.VELOCITY, of_another_version(VelocityCommand(now, np.zeros(2), 0.0, 0.1, 0.04)))

    with Router((endpoint,)), ZenohLink(Endpoints((endpoint,), namespace="heard")) as link:
        speaking = threading.Thread(target=speak, args=(link,), name="robot")
        speaking.start()
        yield ["--connect", endpoint, "--namespace", "heard"]
        over.set()
        speaking.join()


def test_echo_prints_requested_number_of_messages(robot: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["topics", "echo", "actuator/odometry", "--count", "2", *robot]) == 0
    assert capsys.readouterr().out.count("actuator/odometry  Odometry") == 2
    assert cli.main(["topics", "echo", "--count", "3", "--json", *robot]) == 0
    printed = capsys.readouterr()
    found = [json.loads(line) for line in printed.out.splitlines()]
    assert len(found) == 3
    assert {one["type"] for one in found} <= {"Odometry", "CameraState"}
    assert "not subscribed: camera/depth" in printed.err


def test_echo_reports_undecodable_messages_and_continues(robot: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    words = ["topics", "echo", "operator/velocity", "camera/state", "--count", "2", *robot]
    said = ""
    for _ in range(20):  # either may arrive first
        assert cli.main(words) == 0
        printed = capsys.readouterr()
        assert printed.out.count("camera/state  CameraState") == 2
        said += printed.err
        if said:
            break
    assert f"schema {codec.schema_id(VelocityCommand)} expected" in said
    assert "restart the older program" in said


def test_slow_terminal_skips_states_and_counts_them(
    robot: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sextant.deploy.commands import topics as commands

    others = Mailbox()  # a subscriber that is not delayed meanwhile
    said: list[dict[str, Any]] = []

    def say_slowly(text: str) -> None:
        said.append(json.loads(text))
        come = 0
        while come < 5:
            assert others.news.wait(10.0)
            come += sum(1 + heard.passed_over for heard in others.drain())

    monkeypatch.setattr(commands, "say", say_slowly)
    with ZenohLink(Endpoints((robot[1],), namespace="heard")) as link:
        listen(link, (topics.CAMERA_STATE,), others.take, time.monotonic_ns)
        assert cli.main(["topics", "echo", "camera/state", "--json", "--count", "4", *robot]) == 0
    assert sum(one["passed_over"] for one in said) > 3
    stamps = [one["message"]["stamp_ns"] for one in said]
    assert stamps == sorted(stamps)


def test_echo_ends_on_ctrl_c(robot: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from sextant.deploy.terminal.interrupts import Interrupts

    looks = iter([False] * 3)
    monkeypatch.setattr(Interrupts, "asked", lambda _: next(looks, True))
    assert cli.main(["topics", "echo", "camera/state", *robot]) == 130
    assert "stopped by the operator" in capsys.readouterr().err


def test_hz_measures_and_prints_totals(robot: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["topics", "hz", "--seconds", "0.5", *robot]) == 0
    printed = capsys.readouterr().out
    assert "operator/velocity" in printed
    assert "sum" in printed
    assert cli.main(["topics", "hz", "actuator/odometry", "--seconds", "0.5", "--json", *robot]) == 0
    (row,) = json.loads(capsys.readouterr().out)["topics"]
    assert row["key"] == "actuator/odometry"
    assert row["frames"] > 0
    assert row["age_ms"]["p50"] >= 0.0


@pytest.mark.parametrize("command", [["echo", "--within", "0.2"], ["hz", "--seconds", "0.2"]], ids=lambda words: words[0])
def test_no_received_message_is_reported_with_advice(
    command: list[str], robot: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    name, *words = command
    assert cli.main(["topics", name, "operator/goal", *words, *robot]) == 1
    said = capsys.readouterr().err
    assert "no message of operator/goal received within 0.2" in said
    assert "is the robot up" in said
    assert cli.main(["topics", name, "operator/goals", *words, *robot]) == 2
    assert "did you mean 'operator/goal'" in capsys.readouterr().err


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "soon", "1e9"])
def test_invalid_seconds_are_refused(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["topics", "hz", "--seconds", seconds]) == 2
    assert "seconds from 0.001 to 86400 expected" in capsys.readouterr().err
