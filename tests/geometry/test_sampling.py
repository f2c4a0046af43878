"""Farthest-point sampling is the textbook loop, only faster."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from thoroughness import examples

from flowlab.geometry.sampling import farthest_points


def textbook(xyz: np.ndarray, k: int, chosen: Sequence[int] = ()) -> list[int]:
    """The O(N k) loop on float32 coordinates; argmax takes the lowest index among equals."""
    xyz = xyz.astype(np.float32)
    gap = np.full(len(xyz), np.inf, np.float32)
    order: list[int] = []
    for step in range(len(chosen) + min(k, len(xyz) - len(chosen))):
        new = chosen[step] if step < len(chosen) else int(np.argmax(gap))
        order.append(new)
        d = xyz - xyz[new]
        gap = np.minimum(gap, d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2])
    return order[len(chosen) :]


def meters(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit, width=32, allow_subnormal=False)


def any_cloud(limit: float = 1000.0) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float32, st.tuples(st.integers(1, 60), st.just(3)), elements=meters(limit))


lattices = arrays(np.int64, st.tuples(st.integers(1, 80), st.just(3)), elements=st.integers(-2, 2)).map(
    lambda a: a.astype(np.float32) / 7
)
"""Full of duplicates and of equal distances."""
big_clouds = st.builds(
    lambda seed, n, flat: np.random.default_rng(seed).normal(size=(n, 3)).astype(np.float32) * [1, 1, flat],
    st.integers(0, 10**6),
    st.integers(100, 3000),
    st.sampled_from([1.0, 0.01, 0.0]),
)
"""Large enough to be cut into many cells; some are flat."""
lines = st.builds(
    lambda s, direction: np.outer(s, direction).astype(np.float32),
    arrays(np.float32, st.integers(1, 60), elements=meters(1)),
    arrays(np.float32, 3, elements=meters(1)),
)
clouds = st.one_of(any_cloud(), any_cloud(2**-10), lattices, big_clouds, lines)


@settings(max_examples=examples(300), deadline=None, derandomize=True)
@given(xyz=clouds, k=st.integers(0, 90))
def test_same_indices_as_the_textbook_loop(xyz: np.ndarray, k: int) -> None:
    assert farthest_points(xyz, k).tolist() == textbook(xyz, k)


@settings(max_examples=examples(100), deadline=None, derandomize=True)
@given(xyz=clouds, k=st.integers(1, 60), data=st.data())
def test_the_first_m_of_k_are_the_sample_of_m(xyz: np.ndarray, k: int, data: st.DataObject) -> None:
    m = data.draw(st.integers(0, k))
    assert farthest_points(xyz, m).tolist() == farthest_points(xyz, k)[:m].tolist()


@settings(max_examples=examples(150), deadline=None, derandomize=True)
@given(xyz=clouds, k=st.integers(0, 60), data=st.data())
def test_goes_on_from_chosen_points_as_if_it_had_picked_them(xyz: np.ndarray, k: int, data: st.DataObject) -> None:
    chosen = data.draw(st.lists(st.integers(0, len(xyz) - 1), max_size=min(10, len(xyz)), unique=True))
    assert farthest_points(xyz, k, np.array(chosen, int)).tolist() == textbook(xyz, k, chosen)


def test_going_on_from_its_own_sample_changes_nothing() -> None:
    xyz = np.random.default_rng(0).uniform(size=(5000, 3))
    whole = farthest_points(xyz, 200)
    assert len(set(whole.tolist())) == 200
    np.testing.assert_array_equal(farthest_points(xyz, 140, whole[:60]), whole[60:])


def test_corners_of_a_square_come_before_its_middle() -> None:
    xyz = np.array([[0, 0, 0], [0.5, 0.5, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    assert farthest_points(xyz, 5).tolist() == [0, 3, 2, 4, 1]


@pytest.mark.parametrize("n", [0, 1, 2])
def test_never_more_points_than_there_are(n: int) -> None:
    assert farthest_points(np.eye(3)[:n], 10).tolist() == list(range(n))
    assert farthest_points(np.eye(3)[:n], 10, np.arange(n)).tolist() == []


def test_a_depth_picture_of_a_plane_has_ties_at_every_step() -> None:
    """What real clouds look like: a pixel lattice, where one wrong comparison changes the order."""
    u, v = np.meshgrid(np.arange(60), np.arange(60))
    xyz = np.stack([u.ravel(), v.ravel(), np.zeros(3600)], 1) * 0.01
    assert farthest_points(xyz, 300).tolist() == textbook(xyz, 300)
