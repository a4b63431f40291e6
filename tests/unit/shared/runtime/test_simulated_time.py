"""Simulated time: monotonic, at most real time, and held for late services."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sextant.shared.runtime import clock
from sextant.shared.runtime.simulated_time import SPAN_NS, SimulatedTime, hold, ready

MS = 1_000_000
SEC = 1000 * MS


class Machine:
    """A monotonic clock that a test moves."""

    def __init__(self, now_ns: int = 5 * SEC):
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def machine() -> Machine:
    return Machine()


@pytest.fixture
def time_(tmp_path: Path, machine: Machine) -> SimulatedTime:
    return SimulatedTime.create(tmp_path / "time", ["mapper", "planner"], machine)


def let_run(time_: SimulatedTime, machine: Machine, real_ns: int, step_ns: int = 4 * MS) -> int:
    """Grant time repeatedly as a simulator does; return the resulting time."""
    for _ in range(real_ns // step_ns):
        machine.now_ns += step_ns
        time_.grant()
    return time_()


def test_time_stands_until_granted_then_follows_real_time(time_: SimulatedTime, machine: Machine) -> None:
    begun = time_()
    machine.now_ns += 7 * SEC
    assert time_() == begun == 5 * SEC
    time_.grant()
    assert let_run(time_, machine, SEC) == begun + SEC


def test_time_stands_without_simulator(time_: SimulatedTime, machine: Machine) -> None:
    time_.grant()
    before = let_run(time_, machine, 100 * MS)
    machine.now_ns += 3 * SEC
    assert time_() == before + SPAN_NS


def test_time_waits_for_late_service_and_names_it(time_: SimulatedTime, machine: Machine) -> None:
    time_.grant()
    limit = time_() + 50 * MS
    time_.hold("mapper", limit)
    assert let_run(time_, machine, 600 * MS) == limit
    waited_s = time_.waited_s()
    assert waited_s["mapper"] == pytest.approx(0.55, abs=0.01)
    assert waited_s["planner"] == 0.0
    time_.hold("mapper", limit + 20 * MS)
    assert let_run(time_, machine, 600 * MS) == limit + 20 * MS
    time_.hold("mapper", None)
    assert let_run(time_, machine, 600 * MS) == pytest.approx(limit + 620 * MS, abs=5 * MS)


def test_time_continues_without_ended_or_hung_service(time_: SimulatedTime, machine: Machine) -> None:
    time_.grant()
    limit = time_() + 50 * MS
    time_.hold("mapper", limit)
    assert let_run(time_, machine, 5 * SEC) == pytest.approx(limit + 3950 * MS, abs=50 * MS)
    time_.hold("mapper", limit + 1 * MS)  # it is back and late: time waits for it again
    assert let_run(time_, machine, 500 * MS) <= limit + 4 * SEC
    assert let_run(time_, machine, 5 * SEC) > limit + 7 * SEC


def test_time_is_slow_at_start_until_services_are_ready(tmp_path: Path, machine: Machine) -> None:
    time_ = SimulatedTime.create(
        tmp_path / "start", ["mapper"], machine, starting=["mapper", "planner"], before_ready_ns=2 * SEC
    )
    begun = time_()
    time_.grant()
    assert let_run(time_, machine, 2 * SEC) == begun + 2 * SEC, "the robot stands up meanwhile"
    assert let_run(time_, machine, 20 * SEC) == pytest.approx(begun + 3 * SEC, abs=10 * MS)
    before = time_()
    assert let_run(time_, machine, SEC) > before, "it never stops for as long as a watchdog waits"
    with clock.going_by(time_):
        ready("mapper")
        assert let_run(time_, machine, SEC) == pytest.approx(before + 100 * MS, abs=10 * MS)
        ready("planner")
    before = time_()
    assert let_run(time_, machine, SEC) == pytest.approx(before + SEC, abs=10 * MS)
    assert not any(time_.waited_s().values()), "a start does not count as a slow computer"


def test_time_runs_without_service_that_never_is_ready(tmp_path: Path, machine: Machine) -> None:
    time_ = SimulatedTime.create(tmp_path / "start", [], machine, starting=["mapper"])
    begun = time_()
    assert let_run(time_, machine, 170 * SEC) < begun + 10 * SEC
    assert let_run(time_, machine, 20 * SEC) > begun + 15 * SEC


def test_processes_share_time_through_file(time_: SimulatedTime, machine: Machine, tmp_path: Path) -> None:
    other = SimulatedTime(tmp_path / "time", machine)
    assert other.names == ("mapper", "planner")
    time_.grant()
    let_run(time_, machine, SEC)
    assert other() == time_()
    other.hold("planner", time_() + 10 * MS)
    limit = time_() + 10 * MS
    assert let_run(time_, machine, 500 * MS) == other() == limit
    other.hold("operator", 0)  # a name that is not in the file has no limit
    other.hold("planner", None)
    assert let_run(time_, machine, 500 * MS) > limit


@given(
    steps=st.lists(
        st.tuples(
            st.integers(0, 300 * MS),
            st.sampled_from(["grant", "read", "mapper", "planner"]),
            st.integers(-SEC, SEC) | st.none(),
        ),
        max_size=80,
    )
)
def test_time_is_monotonic_and_never_faster_than_real_time(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[int, str, int | None]]
) -> None:
    machine = Machine()
    time_ = SimulatedTime.create(tmp_path_factory.mktemp("law") / "time", ["mapper", "planner"], machine)
    before, begun = time_(), machine.now_ns
    for passed_ns, act, limit_ns in steps:
        machine.now_ns += passed_ns
        if act == "grant":
            time_.grant()
        elif act != "read":
            time_.hold(act, None if limit_ns is None else time_() + limit_ns)
        now = time_()
        assert before <= now <= before + passed_ns
        assert now - begun <= machine.now_ns - begun
        before = now


def test_reader_sees_consistent_records_during_writes(tmp_path: Path) -> None:
    writer = SimulatedTime.create(tmp_path / "time", ["mapper"])
    reader = SimulatedTime(tmp_path / "time")
    told: list[int] = []

    def read() -> None:
        told.extend(reader() for _ in range(20_000))

    thread = threading.Thread(target=read)
    thread.start()
    while thread.is_alive():
        writer.grant()
    thread.join()
    assert told == sorted(told)


def test_invalid_time_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cannot map simulated time in .*nowhere"):
        SimulatedTime(tmp_path / "nowhere")
    for content in (b"", b"eight by"):
        (tmp_path / "wrong").write_bytes(content)
        with pytest.raises(ValueError, match="simulated time"):
            SimulatedTime(tmp_path / "wrong")
    with pytest.raises(ValueError, match="at most 16 names"):
        SimulatedTime.create(tmp_path / "many", [str(k) for k in range(17)])


@pytest.fixture
def going_by(time_: SimulatedTime) -> Iterator[SimulatedTime]:
    with clock.going_by(time_):
        yield time_


def test_process_states_limits_only_with_simulated_time(going_by: SimulatedTime, machine: Machine) -> None:
    going_by.grant()
    assert clock.now_ns() == going_by()
    limit = going_by() + 10 * MS
    hold("mapper", limit)
    assert let_run(going_by, machine, 400 * MS) == limit
    with clock.going_by(lambda: 42):
        assert clock.now_ns() == 42
        hold("mapper", None)  # real time waits for no service, and no file is written
    assert let_run(going_by, machine, 100 * MS) == limit
