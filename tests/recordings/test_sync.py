"""Alignment in time, against exhaustive search."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.recordings.sync import find_gaps, last_sample, nearest_sample, sampling_rate

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


def test_one_sample_is_near_to_all_and_has_no_rate() -> None:
    np.testing.assert_array_equal(nearest_sample(np.arange(3.0), np.array([9.0])), 0)
    np.testing.assert_array_equal(last_sample(np.arange(3.0), np.array([9.0])), 0)
    assert sampling_rate(np.array([1.0])) == 0
    assert find_gaps(np.array([1.0, 2.0])) == ()
