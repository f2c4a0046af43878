"""Query points: which are chosen, whose they are, and what each sampling promises."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.errors import DataError
from flowlab.perception.observer import Observer, ObserverSettings
from flowlab.perception.queries import EdgeSettings, QuerySettings, away_from_edges, near_edges, sample_queries
from flowlab.records import Cloud, Entity, Role

PARTS = tuple(Entity(role.name.lower(), role.name.lower(), role) for role in Role)
CUP = list(Role).index(Role.OBJECT)


def scene(n: int = 600, objects: int = 30, seed: int = 0) -> Cloud:
    """Points of every role and of none in a cubic meter; the object's in a corner of 5 cm."""
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


@settings(max_examples=examples(60), deadline=None, derandomize=True)
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
    assert gap.min() > 0.1  # the scene is a meter wide: farthest points do not crowd what is covered


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


def step_edge(width: int = 24, height: int = 18) -> np.ndarray:
    """A wall at 1 m, and before its right half something at 80 cm; a hole of one pixel in the wall."""
    depth = np.full((height, width), 1.0, np.float32)
    depth[:, width // 2 :] = 0.8
    depth[4, 5] = 0
    return depth


@pytest.mark.parametrize("margin", [0, 1, 3])
def test_near_edges_is_within_the_margin_of_a_step_or_a_hole(margin: int) -> None:
    """Chebyshev distance to the pixels on either side of the step, and to the hole."""
    depth = step_edge()
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    to_step = np.minimum(np.abs(u - 11), np.abs(u - 12))
    to_hole = np.maximum(np.abs(v - 4), np.abs(u - 5))
    found = near_edges(depth, EdgeSettings(jump=0.1, margin_px=margin))
    np.testing.assert_array_equal(found, (to_step <= margin) | (to_hole <= margin))


def test_what_counts_as_a_step_is_relative_to_the_nearer_reading() -> None:
    for scale in (0.5, 1.0, 3.0):
        depth = step_edge()[:, 8:] * np.float32(scale)
        assert near_edges(depth, EdgeSettings(jump=0.24, margin_px=0)).any()
        assert not near_edges(depth, EdgeSettings(jump=0.26, margin_px=0)).any()


def test_a_slanted_surface_has_no_edges_and_a_flying_pixel_is_one() -> None:
    slanted = np.tile(np.linspace(0.5, 1.0, 60, dtype=np.float32), (20, 1))
    assert not near_edges(slanted, EdgeSettings()).any()
    slanted[9, 30] += 0.1
    assert near_edges(slanted, EdgeSettings())[7:12, 28:33].all()
    assert near_edges(slanted, EdgeSettings(margin_px=0)).sum() == 5  # itself and its neighbors


def seen(depth: np.ndarray) -> Cloud:
    """Every pixel of a camera with one-pixel focal length, owned in turn by two things."""
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    pixel = np.flatnonzero(depth > 0).astype(np.int32)
    xyz = np.stack([u * depth, v * depth, depth], -1).reshape(-1, 3)[pixel].astype(np.float32)
    return Cloud(xyz, pixel, (pixel % 2).astype(np.int16), PARTS)


def test_clouds_away_from_edges_are_the_rest_of_them_in_order() -> None:
    depth = step_edge()
    cloud = seen(depth)
    clear = away_from_edges(cloud, depth, EdgeSettings(jump=0.1, margin_px=2))
    mask = ~near_edges(depth, EdgeSettings(jump=0.1, margin_px=2)).reshape(-1)
    np.testing.assert_array_equal(clear.pixel, np.flatnonzero(mask))
    assert clear.owner is not None
    np.testing.assert_array_equal(clear.owner, clear.pixel % 2)
    kept = np.isin(cloud.pixel, clear.pixel)
    np.testing.assert_array_equal(clear.xyz_world, cloud.xyz_world[kept])
    assert clear.entities == PARTS


def test_nothing_clear_of_edges_is_an_error_that_says_what_to_change() -> None:
    depth = step_edge()
    with pytest.raises(DataError, match=r"within 30 pixels of an edge .* lower queries\.avoid_edges\.margin_px"):
        away_from_edges(seen(depth), depth, EdgeSettings(margin_px=30))
