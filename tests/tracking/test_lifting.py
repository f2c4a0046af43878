"""Lifting against closed-form scenes: slanted and turning surfaces, occluders, edges, holes, models, no depth."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import apply
from flowlab.records import Clip, PositionSource, Tracks2D
from flowlab.testing.trackers import AXIS, FRAMES, rolling
from flowlab.tracking.lifting import Lifted, LiftSettings, lift

WIDTH, HEIGHT = 80, 60
K = np.array([[90.0, 0, 41.5], [0, 95.0, 28.0], [0, 0, 1]])
T_WORLD_CAM = np.array([[0.0, 0, 1, 0.2], [-1, 0, 0, -0.4], [0, -1, 0, 0.7], [0, 0, 0, 1]])
CAMERA = Camera(WIDTH, HEIGHT, K, T_WORLD_CAM)
U, V = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
RAY = np.linalg.inv(K) @ np.stack([U.ravel(), V.ravel(), np.ones(U.size)])
NORMAL, OFFSET = np.array([0.35, -0.2, 1.0]), 1.0
"""The plane n x = d in camera coordinates: depth changes by 4 mm from pixel to pixel."""


def clip_of(depth: np.ndarray, camera: Camera = CAMERA) -> Clip:
    return Clip(np.zeros((*depth.shape, 3), np.uint8), np.ascontiguousarray(depth, np.float32), camera)


def plane_depth(offset: float = OFFSET) -> np.ndarray:
    return (offset / (NORMAL @ RAY)).reshape(HEIGHT, WIDTH)


def tracks_of(xy: np.ndarray, visible: np.ndarray | bool = True, xyz_cam: np.ndarray | None = None) -> Tracks2D:
    shape = xy.shape[:2]
    seen = np.broadcast_to(visible, shape).copy()
    return Tracks2D(xy.astype(np.float32), seen, seen.astype(np.float32), xyz_cam=xyz_cam)


def lifted(clip: Clip, tracks: Tracks2D, **options: float) -> Lifted:
    out = lift(clip, tracks, LiftSettings(**options))
    measured = out.source == PositionSource.MEASURED
    assert np.isfinite(out.xyz_world).all()
    assert out.depth_valid[measured].all()
    assert (tracks.visible & out.visible)[measured].all()
    return out


def z_of(out: Lifted, camera: Camera = CAMERA) -> np.ndarray:
    return camera.project(out.xyz_world.astype(np.float64))[1]


def test_points_that_slide_over_a_slanted_plane_are_on_it_between_pixels_too() -> None:
    rng = np.random.default_rng(0)
    start = rng.integers(10, (50, 40), (30, 2))
    xy = start + np.arange(12)[:, None, None] * rng.uniform(-0.6, 1.4, (30, 2))
    out = lifted(clip_of(np.repeat(plane_depth()[None], 12, 0)), tracks_of(xy))
    ray = np.concatenate([xy, np.ones((12, 30, 1))], -1) @ np.linalg.inv(K).T
    truth = apply(T_WORLD_CAM, ray * (OFFSET / (ray @ NORMAL))[..., None])
    error = np.linalg.norm(out.xyz_world - truth, axis=-1)
    assert error[0].max() < 1e-5  # its own pixel, unchanged
    assert error.max() < 1e-3  # a fourth of what the nearest pixel may be off
    assert (out.source == PositionSource.MEASURED).all()
    assert out.visible.all()


def test_points_of_a_rolling_camera_turn_about_its_axis() -> None:
    clip = rolling().clip
    xy = np.stack(np.meshgrid(np.arange(30, 130, 14), np.arange(30, 100, 12)), -1).reshape(-1, 2)
    path = rolling().move(xy, 0, np.arange(FRAMES)[:, None])
    inside = ((path > 3) & (path < (188, 124))).all((0, 2))
    out = lifted(clip, tracks_of(path[:, inside]), layer_m=0.03)
    first = clip.camera.unproject(xy[inside], clip.depth[0][xy[inside, 1], xy[inside, 0]].astype(float))
    arm = path[:, inside] - AXIS
    angle = np.arctan2(arm[..., 1], arm[..., 0]) - np.arctan2(arm[0, :, 1], arm[0, :, 0])
    c, s = np.cos(angle), np.sin(angle)
    truth = np.stack([c * first[:, 0] - s * first[:, 1], s * first[:, 0] + c * first[:, 1], first[:, 2] + 0 * c], -1)
    assert inside.sum() > 20
    assert np.linalg.norm(out.xyz_world - truth, axis=-1).max() < 3e-3
    assert (out.source == PositionSource.MEASURED).all()


def passing(depth: float, speed: float, width: int, frames: int) -> np.ndarray:
    """A wall at 1 m, and before it a board that comes from the left, at ``speed`` pixels a frame."""
    right = speed * np.arange(frames)[:, None, None]
    return np.where((right - width <= U) & (right > U), depth, 1.0)


@pytest.mark.parametrize("depth", [0.5, 0.8, 0.94])
@pytest.mark.parametrize("speed", [0.5, 2.0, 7.0])
def test_what_passes_in_front_is_never_taken_for_the_point(depth: float, speed: float) -> None:
    """Though the tracker, fooled, says all along that it sees the points."""
    frames = int(120 / speed)
    board = passing(depth, speed, 30, frames)
    xy = np.broadcast_to(np.array([[20.0, 10], [33, 30], [40, 50]]), (frames, 3, 2))
    out = lifted(clip_of(board), tracks_of(xy))
    whole = np.stack([(board[:, y, x - 2 : x + 3] < 1).all(1) for x, y in xy[0].astype(int)], 1)
    assert whole.sum() > 5
    assert (out.source[whole] == PositionSource.FILLED).all()
    assert not out.visible[whole].any()
    assert not out.depth_valid[whole].any()
    np.testing.assert_allclose(z_of(out), 1, atol=1e-5)  # filled or measured, it is where it was
    bare = np.stack([(board[:, y, x - 2 : x + 3] == 1).all(1) for x, y in xy[0].astype(int)], 1)
    assert (out.source[bare] == PositionSource.MEASURED).all()


@pytest.mark.parametrize("offset", [-0.9, 0.0, 0.9])
def test_depths_of_two_surfaces_are_never_averaged_at_an_edge(offset: float) -> None:
    depth = np.repeat(np.where(U < 40, 0.6, 1.0)[None], 20, 0)
    columns = np.array([38.0, 39.0, 40.0, 41.0])
    xy = np.stack([columns, np.full(4, 20.0)], -1)[None] + np.where(np.arange(20) > 0, offset, 0)[:, None, None] * (
        1,
        0,
    )
    out = lifted(clip_of(depth), tracks_of(xy))
    np.testing.assert_allclose(z_of(out), np.broadcast_to([0.6, 0.6, 1.0, 1.0], (20, 4)), atol=1e-5)


def test_a_track_that_slides_off_its_surface_is_not_on_the_one_behind() -> None:
    depth = np.repeat(np.where(U < 40, 0.6, 1.0)[None], 20, 0)
    xy = np.stack([30 + np.arange(20.0), np.full(20, 20.0)], -1)[:, None]
    out = lifted(clip_of(depth), tracks_of(xy))
    off = xy[:, 0, 0] > 42
    assert off.any()
    assert (out.source[off] == PositionSource.FILLED).all()
    assert not out.visible[off].any()
    np.testing.assert_allclose(z_of(out), 0.6, atol=1e-5)


def test_a_point_that_comes_nearer_is_followed_in_depth() -> None:
    z = 1.2 - 0.015 * np.arange(40)
    out = lifted(clip_of(np.broadcast_to(z[:, None, None], (40, HEIGHT, WIDTH))), tracks_of(np.full((40, 1, 2), 30.0)))
    np.testing.assert_allclose(z_of(out)[:, 0], z, atol=1e-5)


def test_a_hole_is_filled_on_the_ray_of_the_tracked_pixel() -> None:
    """The plane comes nearer at a steady pace and the point moves unsteadily: only its depth is interpolated."""
    z = 1.2 - 0.01 * np.arange(15)
    depth = np.broadcast_to(z[:, None, None], (15, HEIGHT, WIDTH)).copy()
    depth[5:9] = 0
    xy = np.stack([20 + 0.2 * np.arange(15) ** 2, np.full(15, 30.0)], -1)[:, None]
    out = lifted(clip_of(depth), tracks_of(xy))
    hole = (np.arange(15) >= 5) & (np.arange(15) < 9)
    assert (out.source[:, 0] == np.where(hole, PositionSource.FILLED, PositionSource.MEASURED)).all()
    assert (out.depth_valid[:, 0] == ~hole).all()
    assert out.visible.all()
    np.testing.assert_allclose(out.xyz_world, CAMERA.unproject(xy, z[:, None]), atol=1e-4)


def test_where_the_tracker_loses_a_point_it_moves_straight_and_then_stays() -> None:
    depth = np.full((20, HEIGHT, WIDTH), 0.8)
    xy = np.stack([20 + 1.5 * np.arange(20), 10 + np.arange(20)], -1)[:, None].astype(float)
    seen = np.ones((20, 1), bool)
    seen[5:9], seen[15:] = False, False
    wrong = xy + 7 * ~seen[..., None]  # where it says it might be does not matter
    out = lifted(clip_of(depth), tracks_of(wrong, seen))
    truth = CAMERA.unproject(xy, np.full((20, 1), 0.8))
    truth[15:] = truth[14]
    np.testing.assert_allclose(out.xyz_world, truth, atol=1e-5)
    assert (out.source == np.where(seen, PositionSource.MEASURED, PositionSource.FILLED)).all()
    assert (out.visible == seen).all()


def test_a_point_may_have_moved_while_it_was_out_of_sight_but_not_by_much() -> None:
    """8 cm in 15 frames is plausible, 40 cm is not; in two frames in sight, neither is."""
    seen = np.ones((40, 1), bool)
    seen[5:20] = False
    for step, believed in ((0.08, True), (0.4, False)):
        z = np.where(np.arange(40) < 12, 1.0, 1.0 - step)
        depth = np.broadcast_to(z[:, None, None], (40, HEIGHT, WIDTH))
        xy = np.full((40, 1, 2), 30.0)
        assert (lifted(clip_of(depth), tracks_of(xy, seen)).source[20:] == PositionSource.MEASURED).all() == believed
        assert (lifted(clip_of(depth), tracks_of(xy)).source[12:] == PositionSource.FILLED).all()


def test_a_model_places_points_in_and_out_of_sight() -> None:
    depth = np.full((10, HEIGHT, WIDTH), 1.0)
    depth[:, :, :40] = 0.7
    xy = np.broadcast_to(np.array([[60.0, 20], [10, 20], [60, 40]]), (10, 3, 2))
    model = np.full((10, 3, 3), 1.005, np.float32)
    model[..., :2] = np.random.default_rng(0).uniform(-0.4, 0.4, (10, 3, 2))  # off the rays of the pixels
    model[4:, 2] = 0  # it knows nothing of the third point from here on
    seen = np.ones((10, 3), bool)
    seen[3:, 0] = False
    out = lift(clip_of(depth), tracks_of(xy, seen, model), LiftSettings())
    assert (out.source[0] == PositionSource.MEASURED).all()
    np.testing.assert_allclose(z_of(out)[0], [1.0, 0.7, 1.0], atol=1e-6)  # their own readings
    assert (out.source[1:, :2] == PositionSource.MODEL).all()
    np.testing.assert_allclose(out.xyz_world[1:, :2], apply(T_WORLD_CAM, model[1:, :2].astype(float)), atol=1e-6)
    assert (out.depth_valid[1:, 0]).all()
    assert not out.depth_valid[1:, 1].any()  # the sensor sees something 30 cm before it
    assert (out.visible[:, :2] == seen[:, :2]).all()
    assert (out.source[4:, 2] == PositionSource.MEASURED).all()
    np.testing.assert_allclose(z_of(out)[4:, 2], 1.0, atol=1e-6)


def test_a_query_without_depth_takes_it_from_beside_from_later_or_from_the_scene() -> None:
    depth = np.full((10, HEIGHT, WIDTH), 1.0)
    depth[0, 20, 20] = depth[:4, 35:46, 15:26] = 0
    depth[:, 10:21, 50:61] = 0
    depth[:, :5] = 3.0
    xy = np.broadcast_to(np.array([[20.0, 20], [20, 40], [55, 15]]), (10, 3, 2))
    out = lifted(clip_of(depth), tracks_of(xy))
    np.testing.assert_allclose(z_of(out), 1.0, atol=1e-6)
    assert (out.source[0] == [PositionSource.MEASURED, PositionSource.FILLED, PositionSource.FILLED]).all()
    assert (out.source[4:, 1] == PositionSource.MEASURED).all()
    assert (out.source[:, 2] == PositionSource.FILLED).all()


def test_a_clip_without_any_depth_is_filled_throughout() -> None:
    out = lifted(clip_of(np.zeros((3, HEIGHT, WIDTH))), tracks_of(np.full((3, 2, 2), 20.0)))
    assert (out.source == PositionSource.FILLED).all()
    assert not out.depth_valid.any()
    np.testing.assert_allclose(z_of(out), 1.0, atol=1e-6)


def test_points_outside_the_picture_are_not_seen() -> None:
    depth = np.full((4, HEIGHT, WIDTH), 1.0)
    at = np.array([[0.0, 0], [79, 59], [-0.6, 20], [20, 59.6]])
    xy = np.concatenate([np.full((1, 4, 2), 20.0), np.broadcast_to(at, (3, 4, 2))])
    out = lifted(clip_of(depth), tracks_of(xy))
    assert (out.visible[1:] == [True, True, False, False]).all()
    assert (out.source[1:, 2:] == PositionSource.FILLED).all()


def test_scatter_that_grows_with_distance_is_no_occlusion() -> None:
    rng = np.random.default_rng(1)
    for z in (0.7, 3.0):
        depth = z + 0.0015 * z**2 * rng.normal(size=(30, HEIGHT, WIDTH))
        xy = np.broadcast_to(rng.uniform(5, (70, 50), (1, 40, 2)).round(), (30, 40, 2))
        out = lifted(clip_of(depth), tracks_of(xy))
        assert (out.source == PositionSource.MEASURED).mean() > 0.99
        assert np.std(z_of(out)[1:]) < 0.8 * 0.0015 * z**2  # averaged over the layer


@given(seed=st.integers(0, 10_000), holes=st.floats(0, 1), layers=st.integers(1, 3))
@settings(max_examples=examples(60), deadline=None)
def test_what_is_measured_was_read_beside_the_point(seed: int, holes: float, layers: int) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.choice(rng.uniform(0.3, 2, layers), (8, 12, 16)) * (rng.random((8, 12, 16)) > holes)
    camera = Camera(16, 12, np.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]), T_WORLD_CAM)
    xy = rng.uniform(-2, (18, 14), (8, 9, 2)).astype(np.float32)
    xy[0] = rng.integers(0, (16, 12), (9, 2))
    seen = (rng.random((8, 9)) < 0.7) | (np.arange(8) == 0)[:, None]
    out = lifted(clip_of(depth, camera), tracks_of(xy, seen))
    measured = out.source == PositionSource.MEASURED
    assert (out.depth_valid == measured).all()
    assert not (out.visible & ~seen).any()
    uv, z = camera.project(out.xyz_world.astype(np.float64))
    np.testing.assert_allclose(uv[measured], xy[measured], atol=1e-3)
    for t, m in np.argwhere(measured):
        x, y = np.rint(xy[t, m]).astype(int)
        around = depth[t, max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3].ravel()
        around = around[around > 0]
        assert around.min() - 1e-6 <= z[t, m] <= around.max() + 1e-6
        assert np.abs(around - z[t, m]).min() < 0.02 + 0.005 * 4


def test_a_frame_of_100_points_is_lifted_in_two_milliseconds() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.9, 0.92, (40, 240, 320)) * (rng.random((40, 240, 320)) > 0.2)
    clip = clip_of(depth, Camera(320, 240, np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]), T_WORLD_CAM))
    tracks = tracks_of(rng.uniform(0, (319, 239), (40, 100, 2)), rng.random((40, 100)) < 0.8)
    took = []
    for _ in range(4):  # the first compiles
        start = time.perf_counter()
        lift(clip, tracks, LiftSettings())
        took.append(time.perf_counter() - start)
    assert min(took) / 40 < 2e-3
