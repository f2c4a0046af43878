"""Alignment in time, against exhaustive search."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.recordings.sync import common_clock, find_gaps, last_sample, nearest_sample, sampling_rate

instants = st.lists(st.integers(0, 40).map(lambda k: k / 8), min_size=1, max_size=40)


@settings(max_examples=examples(300), deadline=None, derandomize=True)
@given(instants, instants.map(sorted))
def test_nearest_is_what_a_search_of_all_finds(clock: list[float], time_s: list[float]) -> None:
    found = nearest_sample(np.array(clock), np.array(time_s))
    distance = np.abs(np.array(time_s)[None] - np.array(clock)[:, None])
    np.testing.assert_array_equal(distance[np.arange(len(clock)), found], distance.min(1))
    ties = [min(np.array(time_s)[row == row.min()]) for row in distance]
    np.testing.assert_array_equal(np.array(time_s)[found], ties)


@settings(max_examples=examples(300), deadline=None, derandomize=True)
@given(instants, instants.map(sorted))
def test_previous_is_the_last_that_is_not_later(clock: list[float], time_s: list[float]) -> None:
    found = last_sample(np.array(clock), np.array(time_s))
    for t, k in zip(clock, found, strict=True):
        before = [i for i, s in enumerate(time_s) if s <= t]
        assert k == (before[-1] if before else 0)


@settings(max_examples=examples(100), deadline=None, derandomize=True)
@given(st.integers(3, 60), st.floats(0.001, 2), st.data())
def test_missing_samples_are_gaps_and_nothing_else_is(count: int, step: float, data: st.DataObject) -> None:
    lost = data.draw(st.integers(1, count - 1))
    time_s = step * np.array([k for k in range(2 * count) if k != lost])
    assert find_gaps(step * np.arange(count)) == ()
    ((start, length),) = find_gaps(time_s)
    assert (start, length) == pytest.approx((step * (lost - 1), 2 * step))
    assert sampling_rate(time_s) == pytest.approx(1 / step)


def test_a_jittering_stream_has_no_gaps() -> None:
    rng = np.random.default_rng(0)
    time_s = np.arange(200) / 30 + rng.uniform(-0.005, 0.005, 200)
    assert find_gaps(time_s) == ()
    assert sampling_rate(time_s) == pytest.approx(30, rel=0.05)


def test_rows_that_share_their_times_are_no_gaps_and_have_a_rate() -> None:
    time_s = np.repeat(np.arange(20) / 10, 2)
    assert find_gaps(time_s) == ()
    assert sampling_rate(time_s) == pytest.approx(10)
    assert sampling_rate(np.ones(5)) == 0


def test_one_sample_is_near_to_all_and_has_no_rate() -> None:
    np.testing.assert_array_equal(nearest_sample(np.arange(3.0), np.array([9.0])), 0)
    np.testing.assert_array_equal(last_sample(np.arange(3.0), np.array([9.0])), 0)
    assert sampling_rate(np.array([1.0])) == 0
    assert find_gaps(np.array([1.0, 2.0])) == ()


@settings(max_examples=examples(60), deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1 / 30, 0.1, 3.0]))
def test_a_common_clock_has_the_instants_that_every_stream_was_seen_near(seed: int, near: float) -> None:
    rng = np.random.default_rng(seed)
    times = [np.cumsum(rng.exponential(1 / 30, 40) * rng.choice([1, 1, 1, 60], 40)) for _ in "ab"]
    clock = common_clock(times, 1 / 30, near)
    start, stop = max(t[0] for t in times), min(t[-1] for t in times)
    for t in times:
        assert all(np.abs(t - at).min() <= near + 1e-6 for at in clock)
    if len(clock):
        every = clock[0] + np.arange(np.floor((stop - clock[0]) / (1 / 30)) + 1) / 30
        seen = [at for at in every if all(np.abs(t - at).min() < near - 1e-6 for t in times)]
        assert all(np.abs(clock - at).min() < 1e-6 for at in seen)
        assert clock[0] >= start - 1e-6
        assert clock[-1] <= stop + 1e-6


def test_a_common_clock_of_a_fast_robot_takes_no_more_room_than_its_instants() -> None:
    tracemalloc.start()
    clock = common_clock([np.arange(0, 3600, 1 / 30), np.arange(0, 3600, 1e-2)], 1 / 30, 3.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(clock) == pytest.approx(108_000, abs=2)
    assert peak < 3e7
    bursts = np.sort(np.concatenate([np.arange(0, 600, 0.1) + 2e-5 * k for k in range(6)]))
    assert not len(common_clock([bursts, bursts], 2e-5, 3.0)), "millions of instants tell that stamps are wrong"
