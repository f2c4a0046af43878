"""Query points: which are chosen, whose they are, and what each sampling promises."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowlab.errors import DataError
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import QuerySettings, sample_queries
from flowlab.records import Cloud, Entity, Role

PARTS = tuple(Entity(role.name.lower(), role.name.lower(), role) for role in Role)
CUP = list(Role).index(Role.OBJECT)


def scene(n: int = 600, objects: int = 30, seed: int = 0) -> Cloud:
    """Points of every role and of none in a cubic metre; the object's in a corner of 5 cm."""
    rng = np.random.default_rng(seed)
    owner = rng.choice([i for i in range(-1, len(PARTS)) if i != CUP], n).astype(np.int16)
    owner[rng.choice(n, objects, replace=False)] = CUP
    xyz = np.where((owner == CUP)[:, None], rng.uniform(0, 0.05, (n, 3)), rng.uniform(0, 1, (n, 3)))
    return Cloud(xyz.astype(np.float32), np.arange(n, dtype=np.int32), owner, PARTS)


def query(cloud: Cloud, points: int = 60, sampling: Any = "scene", **values: Any) -> tuple[np.ndarray, np.ndarray, int]:
    """Positions, owners and count."""
    q = sample_queries(cloud, QuerySettings(points=points, sampling=sampling, **values))
    assert q.entities == cloud.entities
    assert len(q.xyz_world) == len(q.owner) == points
    assert_owners_are_of_the_points(cloud, q.xyz_world, q.owner)
    return q.xyz_world, q.owner, q.count


def assert_owners_are_of_the_points(cloud: Cloud, xyz: np.ndarray, owner: np.ndarray) -> None:
    if cloud.owner is not None:
        owner_of = dict(zip(map(tuple, cloud.xyz_world), cloud.owner, strict=True))
        assert [owner_of[tuple(p)] for p in xyz] == owner.tolist()


def distinct(xyz: np.ndarray) -> int:
    return len(np.unique(xyz, axis=0))


@pytest.mark.parametrize("m", [1, 50, 100, 200])
def test_scene_queries_begin_the_observation_itself(m: int) -> None:
    cloud = scene()
    seen = Observer(ObserverSettings(points=256), "hammer").sample(cloud)
    xyz, _, count = query(cloud, m)
    np.testing.assert_array_equal(xyz, seen.points_world[:m])
    assert count == m


def test_object_queries_lie_on_objects_only() -> None:
    xyz, owner, count = query(scene(), 25, "object")
    assert (owner == CUP).all()
    assert count == distinct(xyz) == 25


def test_object_queries_are_spread_over_the_object() -> None:
    cloud = scene(objects=200)
    mine = cloud.xyz_world[cloud.owner == CUP]
    alone = Cloud(mine, np.arange(len(mine), dtype=np.int32))
    np.testing.assert_array_equal(query(cloud, 40, "object")[0], query(alone, 40)[0])


def test_few_object_points_are_repeated_and_counted() -> None:
    xyz, owner, count = query(scene(objects=7), 20, "object")
    assert count == distinct(xyz) == 7
    np.testing.assert_array_equal(xyz[7:14], xyz[:7])
    assert (owner == CUP).all()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(2, 120), st.floats(0.01, 0.99), st.integers(0, 80), st.integers(100, 400), st.integers(0, 1000))
def test_stratified_queries_keep_their_promise(points: int, share: float, objects: int, n: int, seed: int) -> None:
    cloud = scene(n, min(objects, n), seed)
    xyz, owner, count = query(cloud, points, "stratified", object_share=share)
    assert (owner == CUP).sum() >= min(np.ceil(points * share), objects)
    assert count == min(points, n)
    assert distinct(xyz) == count


def test_stratified_gives_small_objects_more_than_scene_does() -> None:
    cloud = scene()
    on_object = [int((query(cloud, 60, sampling)[1] == CUP).sum()) for sampling in ("scene", "stratified", "object")]
    assert on_object[0] < 5 < 20 <= on_object[1] < on_object[2]


def test_the_rest_of_a_stratified_sample_stays_clear_of_the_object_points() -> None:
    xyz, _, _ = query(scene(), 60, "stratified")
    first, rest = xyz[:20], xyz[20:]
    gap = np.linalg.norm(rest[:, None] - first[None], axis=-1).min(1)
    assert gap.min() > 0.1  # the scene is a metre wide: farthest points do not crowd what is covered


@pytest.mark.parametrize("sampling", ["object", "stratified"])
def test_samplings_by_owner_say_so_when_owners_are_unknown(sampling: str) -> None:
    cloud = Cloud(scene().xyz_world, scene().pixel)
    with pytest.raises(DataError, match=r"queries\.sampling=scene"):
        query(cloud, 10, sampling)


def test_scene_queries_need_no_owners() -> None:
    _, owner, _ = query(Cloud(scene().xyz_world, scene().pixel), 10)
    assert (owner == -1).all()


def test_nothing_to_follow_is_an_error() -> None:
    with pytest.raises(DataError, match="nothing for 'object'"):
        query(scene(objects=0), 10, "object")
    empty = Cloud(np.empty((0, 3), np.float32), np.empty(0, np.int32))
    with pytest.raises(DataError, match="nothing for 'scene'"):
        query(empty)
