"""The report on a long walk: growing memory, delayed streams, ended processes."""

import mmap
import os
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from benchmarks.robot import soak
from benchmarks.robot.soak import PARTS, WARM_UP, Soak

HOUR = 3600.0
PART = np.arange(PARTS)
NOISE = np.random.default_rng(0).normal(0.0, 0.1, PARTS)


def soak_result(mb_h: float = 0.0, later_ms: float = 0.0) -> Soak:
    ages = (8.0 + later_ms * (PART > PARTS / 2) + NOISE).tolist()
    memory = (120.0 + mb_h * PART / PARTS + NOISE).tolist()
    return Soak(
        HOUR, 130, {"mapper": memory}, {"perception/pose": ages}, {"perception/pose": ages}, [], {"mapper": 0}, {"mapper": 3}
    )


@given(st.floats(-5.0, 5.0))
def test_memory_growth_is_estimated_despite_noise(mb_h: float) -> None:
    assert soak.growth_mb_h(soak_result(mb_h).memory_mb["mapper"], HOUR) == pytest.approx(mb_h, abs=0.2)


def test_collected_garbage_and_start_up_memory_are_no_growth() -> None:
    saw = 100.0 + 10.0 * (PART % 7) / 7 + 50.0 * np.minimum(PART / WARM_UP, 1.0)
    assert abs(soak.growth_mb_h(saw.tolist(), HOUR)) < 0.5
    assert soak.faults(replace(soak_result(), memory_mb={"console": saw.tolist()})) == []


@given(at=st.integers(0, PARTS - 1), step_mb=st.floats(0.0, 1.5))
def test_single_small_memory_step_is_no_growth(at: int, step_mb: float) -> None:
    assume(abs(at - (WARM_UP + PARTS) / 2) > 4)
    once = 120.0 + NOISE / 5.0 + step_mb * (at <= PART)
    assert soak.growth_mb_h(once.tolist(), HOUR) < 1.0
    assert soak.faults(replace(soak_result(), memory_mb={"mapper": once.tolist()})) == []
    much = (np.array(soak_result().memory_mb["mapper"]) + 30.0 * (PARTS / 2 <= PART)).tolist()
    found = soak.faults(replace(soak_result(), memory_mb={"mapper": much}))
    assert any(
        re.fullmatch(r"mapper: memory has grown by (29.9|30.0|30.1) MB in all, less than 2 wanted", words) for words in found
    )


@given(every=st.integers(1, 20), first=st.integers(0, 19), mb_h=st.floats(1.5, 5.0))
def test_repeated_memory_steps_are_growth(every: int, first: int, mb_h: float) -> None:
    steps = np.array(soak_result().memory_mb["mapper"]) + mb_h * every / PARTS * ((PART + first) // every)
    assert soak.faults(replace(soak_result(), memory_mb={"mapper": steps.tolist()})) != []


def test_soak_faults_are_named() -> None:
    assert soak.faults(soak_result()) == []
    grows, _ = soak.faults(soak_result(mb_h=4.0))
    assert grows.startswith(("mapper: memory grows by 4.", "mapper: memory grows by 3.9"))
    (later,) = soak.faults(soak_result(later_ms=4.0))
    assert later == "perception/pose: age 12.0 ms at the end, 8.0 ms at the beginning"
    broken = replace(soak_result(), ended=["mapper ended (killed)"], refused={"planner": 2, "mapper": 0})
    assert soak.faults(broken) == ["mapper ended (killed)", "planner: 2 messages were refused"]


@pytest.mark.parametrize("parts", [[float("nan")] * PARTS, [100.0] + [float("nan")] * (PARTS - 1)])
def test_missing_samples_fail_limits(parts: Sequence[float]) -> None:
    found, _ = soak.faults(replace(soak_result(), memory_mb={"mapper": parts}))
    assert found == "mapper: memory grows by nan MB/h, less than 1 wanted"
    assert len(soak.faults(replace(soak_result(), age_p50_ms={"perception/pose": parts}))) == 1


def test_soak_report_text_survives_json_round_trip() -> None:
    gap = replace(soak_result(mb_h=5.0), age_p99_ms={"perception/pose": [float("nan"), *[9.0] * (PARTS - 1)]})
    assert soak.in_words(soak.from_json(soak.to_json(gap))) == soak.in_words(gap)
    assert "| mapper | 121.5 | 124.4 | +5." in soak.in_words(gap)
    assert soak.in_words(soak_result()).endswith("All limits are kept.")
    assert soak.in_words(gap).splitlines()[-2].startswith("mapper: memory grows by 5.")


@given(st.lists(st.tuples(st.floats(0.0, HOUR), st.floats(0.0, 100.0)), min_size=1, max_size=50))
def test_each_sample_belongs_to_one_part(samples: list[tuple[float, float]]) -> None:
    parts = soak.by_part(samples, HOUR, 50)
    assert len(parts) == PARTS
    least, most = min(v for _, v in samples), max(v for _, v in samples)
    assert all(least - 1e-3 <= v <= most + 1e-3 for v in parts if np.isfinite(v))
    assert {n for n, v in enumerate(parts) if np.isfinite(v)} == {min(int(t / HOUR * PARTS), PARTS - 1) for t, _ in samples}


def test_own_memory_is_measured_and_nan_without_process() -> None:
    before = soak.own_mb(os.getpid())
    # Not with NumPy: it would reuse memory that earlier tests freed, and the process would not grow.
    with mmap.mmap(-1, 64_000_000, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as held:
        for page in range(0, len(held), mmap.PAGESIZE):
            held[page] = 1
        assert soak.own_mb(os.getpid()) - before == pytest.approx(64.0, abs=6.4)
    assert np.isnan(soak.own_mb(2**22 + 1))
