"""Windows of several datasets are drawn as their weights say, by a function of the seed and the step alone."""

import heapq
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.data.window_sampler import MixedSampler, WindowIndex, WindowSampler, deal, shares


def numbered(count: int, first: int = 0) -> WindowIndex:
    now = first + np.arange(count)
    return WindowIndex(now // 10, now, np.zeros(count, int))


def dealt_one_by_one(share: list[float], count: int) -> list[tuple[int, int]]:
    """By a queue of who is next: turn j of owner k is due at (j + 1/2) / share."""
    queue = [(0.5 / s, k, 0) for k, s in enumerate(share)]
    heapq.heapify(queue)
    found = []
    for _ in range(count):
        _, k, j = heapq.heappop(queue)
        found.append((k, j))
        heapq.heappush(queue, ((j + 1.5) / share[k], k, j + 1))
    return found


@settings(max_examples=examples(100), deadline=None)
@given(
    weights=st.lists(st.one_of(st.integers(1, 9).map(float), st.floats(1e-6, 1e6)), min_size=2, max_size=6),
    runs=st.integers(1, 17),
    step=st.integers(0, 40),
)
def test_any_step_has_the_runs_that_a_queue_would_give_it(weights: list[float], runs: int, step: int) -> None:
    share = shares(weights)
    owner, turn = deal(share, step * runs, runs)
    expected = dealt_one_by_one(share.tolist(), (step + 1) * runs)[step * runs :]
    assert list(zip(owner.tolist(), turn.tolist(), strict=True)) == expected


@settings(max_examples=examples(100), deadline=None)
@given(weights=st.lists(st.floats(1e-3, 1e3), min_size=2, max_size=6), first=st.sampled_from([0, 7, 10**6, 10**12]))
def test_the_shares_are_those_of_the_weights_however_long_a_run_is(weights: list[float], first: int) -> None:
    share = shares(weights)
    owner, turn = deal(share, first, 200)
    for k, wanted in enumerate(np.array(weights) / sum(weights)):
        assert abs((owner == k).sum() - 200 * wanted) < len(weights)
        if (mine := turn[owner == k]).size:
            assert mine.tolist() == list(range(mine[0], mine[0] + mine.size)), "none is left out or given twice"
            assert abs(mine[0] - first * wanted) < len(weights)


def test_each_dataset_is_seen_in_epochs_of_its_own() -> None:
    small, large = numbered(20), numbered(200, first=1000)
    sampler = MixedSampler([small, large], (1.0, 1.0), size=8, segment=1, seed=0)
    seen = np.concatenate([sampler.windows(step).now for step in range(50)])
    counts = Counter(seen.tolist())
    assert sum(n for x, n in counts.items() if x < 1000) == 200
    assert {counts[x] for x in range(20)} == {10}, "ten times every window of the small one"
    assert {counts[x] for x in range(1000, 1200)} == {1}, "and once every window of the large one"
    assert all((sampler.windows(step).now < 1000).sum() == 4 for step in range(50))


def test_two_datasets_of_one_length_are_not_shuffled_alike() -> None:
    sampler = MixedSampler([numbered(64), numbered(64, first=1000)], (1.0, 1.0), size=64, segment=1, seed=0)
    now = sampler.windows(0).now
    assert now[now < 1000].tolist() != (now[now >= 1000] - 1000).tolist()


def test_a_dataset_with_fewer_windows_than_a_run_has_its_share_all_the_same() -> None:
    sampler = MixedSampler([numbered(3), numbered(100, first=1000)], (3.0, 1.0), size=32, segment=8, seed=0)
    for step in range(5):
        windows = sampler.windows(step)
        assert len(windows.now) == 32
        assert (windows.now < 1000).sum() == 24
        for run in range(4):
            mine = windows.now[windows.run == run]
            first, count = (0, 3) if mine[0] < 1000 else (1000, 100)
            assert mine.tolist() == [first + (mine[0] - first + k) % count for k in range(8)]


def test_windows_are_a_function_of_seed_and_step() -> None:
    def at(seed: int, step: int) -> list[int]:
        return MixedSampler([numbered(30), numbered(50, 1000)], (0.7, 0.3), 16, 4, seed).windows(step).now.tolist()

    assert at(0, 7) == at(0, 7)
    assert len({tuple(at(*x)) for x in ((0, 7), (0, 8), (1, 7))}) == 3


@pytest.mark.parametrize(
    ("step", "drawn"),
    [(0, [39, 35, 11, 47]), (2, [27, 43, 23, 15]), (3, [31, 19, 3, 15]), (1000, [27, 35, 23, 39])],
)
def test_without_weights_what_is_drawn_is_what_earlier_versions_drew(step: int, drawn: list[int]) -> None:
    sampler = WindowSampler(numbered(50), 16, 4, 3)
    assert sampler.windows(step).now[::4].tolist() == drawn
