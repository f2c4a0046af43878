"""The Observer: depth pictures made by hand, clouds checked by plain geometry."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from thoroughness import examples

from flowlab.config import SettingsError
from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.perception.observer import Box, Observer, ObserverSettings
from flowlab.records import Cloud, Entity, Frame, Role

WIDTH, HEIGHT = 20, 14
EVERYWHERE = Box(low=(-100, -100, -100), high=(100, 100, 100))
FLOOR = Entity("floor", "world", Role.BACKGROUND)
CUP = Entity("cup", "cup", Role.OBJECT)


def camera(seed: int = 0) -> Camera:
    """Off-center, with pixels that are not square, anywhere within half a meter of the origin."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.uniform(-0.5, 0.5, 3)
    K = np.array([[30.0, 0, 8.2], [0, 37.0, 7.9], [0, 0, 1]])
    return Camera(WIDTH, HEIGHT, K, T)


def rays(cam: Camera) -> np.ndarray:
    """World direction (H, W, 3) of every pixel's ray, 1 m deep along the optical axis."""
    v, u = np.mgrid[: cam.height, : cam.width]
    in_camera = np.stack([(u - cam.K[0, 2]) / cam.K[0, 0], (v - cam.K[1, 2]) / cam.K[1, 1], np.ones(u.shape)], -1)
    return in_camera @ cam.T_world_cam[:3, :3].T


def picture(cam: Camera, seed: int = 0) -> Frame:
    """Random depth, random owners of two entities and of nothing."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.2, 2, (cam.height, cam.width)).astype(np.float32)
    owner = rng.integers(-1, 2, depth.shape).astype(np.int16)
    return Frame(depth, cam, owner, (FLOOR, CUP))


def owners(seen: Frame | Cloud) -> np.ndarray:
    assert seen.owner is not None
    return seen.owner


def observer(**values: Any) -> Observer:
    return Observer(ObserverSettings(**{"crop": EVERYWHERE, "points": 50, **values}), "hammer")


@settings(max_examples=examples(50), deadline=None, derandomize=True)
@given(st.integers(0, 10**6))
def test_every_point_of_a_tilted_plane_lies_on_it(seed: int) -> None:
    cam = camera(seed)
    toward = rays(cam)
    ahead = cam.T_world_cam[:3, 2]
    normal = -ahead + np.random.default_rng(seed).uniform(-0.3, 0.3, 3)
    on_plane = cam.T_world_cam[:3, 3] + ahead
    depth = ((on_plane - cam.T_world_cam[:3, 3]) @ normal) / (toward @ normal)
    cloud = observer().cloud(Frame(depth.astype(np.float32), cam))
    assert len(cloud.xyz_world) == WIDTH * HEIGHT
    off_plane = (cloud.xyz_world - on_plane) @ normal / np.linalg.norm(normal)
    assert np.abs(off_plane).max() < 1e-6
    assert cloud.owner is None


@settings(max_examples=examples(50), deadline=None, derandomize=True)
@given(st.integers(0, 10**6))
def test_the_cloud_is_what_a_mask_keeps_in_pixel_order(seed: int) -> None:
    frame = picture(camera(seed), seed)
    low, high = np.array([-0.6, -0.5, -0.7]), np.array([0.5, 0.6, 0.4])
    xyz = frame.camera.T_world_cam[:3, 3] + rays(frame.camera) * frame.depth[..., None].astype(float)
    keep = ((low < xyz) & (xyz < high)).all(-1) & (owners(frame) != 0)
    cloud = observer(crop=Box(low=tuple(low), high=tuple(high))).cloud(frame)
    np.testing.assert_array_equal(cloud.pixel, np.flatnonzero(keep))
    np.testing.assert_allclose(cloud.xyz_world, xyz[keep], atol=1e-6)
    np.testing.assert_array_equal(cloud.owner, owners(frame)[keep])


def test_points_on_the_faces_of_the_box_are_outside() -> None:
    cam = Camera(3, 1, np.array([[1.0, 0, 1], [0, 1, 0], [0, 0, 1]]), np.eye(4))
    frame = Frame(np.ones((1, 3), np.float32), cam)  # points (-1, 0, 1), (0, 0, 1), (1, 0, 1)
    assert len(observer(crop=Box(low=(-1, -1, 0), high=(1, 1, 2))).cloud(frame).xyz_world) == 1
    for low, high in [((-2, 0, 0), (2, 1, 2)), ((-2, -1, 1), (2, 1, 2)), ((-2, -1, 0), (2, 1, 1))]:
        assert len(observer(crop=Box(low=low, high=high)).cloud(frame).xyz_world) == 0


def test_background_goes_by_its_role_and_nothing_else() -> None:
    frame = picture(camera())
    kept = observer().cloud(frame)
    assert set(np.unique(owners(kept))) == {-1, 1}
    assert len(kept.xyz_world) == (owners(frame) != 0).sum()
    everything = observer(drop_background=False).cloud(frame)
    assert len(everything.xyz_world) == WIDTH * HEIGHT
    namesake = Frame(frame.depth, frame.camera, frame.owner, (Entity("floor", "world", Role.PROP), CUP))
    assert len(observer().cloud(namesake).xyz_world) == WIDTH * HEIGHT


@pytest.mark.parametrize("hole", [0.0, np.nan, np.inf])
def test_pixels_without_a_reading_give_no_points(hole: float) -> None:
    frame = picture(camera())
    depth = frame.depth.copy()
    depth[2, 3] = depth[13, 19] = hole
    cloud = observer(drop_background=False).cloud(Frame(depth, frame.camera, frame.owner, frame.entities))
    np.testing.assert_array_equal(
        cloud.pixel, np.delete(np.arange(WIDTH * HEIGHT), [2 * WIDTH + 3, WIDTH * HEIGHT - 1])
    )
    assert np.isfinite(cloud.xyz_world).all()


def test_a_sample_is_distinct_points_of_the_cloud_and_their_count() -> None:
    cloud = observer().cloud(picture(camera()))
    seen = observer().sample(cloud)
    assert seen.count == 50
    assert seen.points_world.shape == (50, 3)
    assert len(np.unique(seen.points_world, axis=0)) == 50
    assert set(map(tuple, seen.points_world)) <= set(map(tuple, cloud.xyz_world))
    np.testing.assert_array_equal(seen.points_world[0], cloud.xyz_world[0])
    assert spread(seen.points_world) > 2 * spread(cloud.xyz_world[:50])


def spread(xyz: np.ndarray) -> float:
    """Least distance between any two points."""
    distance = np.linalg.norm(xyz[:, None] - xyz[None], axis=-1)
    return float(distance[~np.eye(len(xyz), dtype=bool)].min())


@pytest.mark.parametrize("padding", ["repeat", "zeros"])
def test_too_few_points_are_filled_up_and_counted(padding: str) -> None:
    xyz = np.array([[1, 1, 1], [2, 2, 2], [5, 5, 5]], np.float32)
    seen = observer(points=8, padding=padding).sample(Cloud(xyz, np.arange(3, dtype=np.int32)))
    assert seen.count == 3
    np.testing.assert_array_equal(seen.points_world[:3], xyz[[0, 2, 1]])
    fill = xyz[[0, 2, 1, 0, 2]] if padding == "repeat" else np.zeros((5, 3))
    np.testing.assert_array_equal(seen.points_world[3:], fill)


def test_a_task_may_have_a_crop_of_its_own() -> None:
    small = Box(low=(-0.1, -0.1, 0), high=(0.1, 0.1, 1))
    values = ObserverSettings(crop=EVERYWHERE, crop_of_task={"hammer": small}, drop_background=False)
    frame = picture(Camera(WIDTH, HEIGHT, camera().K, np.eye(4)))
    mine, other = Observer(values, "hammer").cloud(frame), Observer(values, "push").cloud(frame)
    assert 0 < len(mine.xyz_world) < len(other.xyz_world) == WIDTH * HEIGHT
    assert (np.abs(mine.xyz_world[:, :2]) < 0.1).all()


def test_an_empty_crop_says_which_task_and_what_to_set() -> None:
    nowhere = observer(crop=Box(low=(50, 50, 50), high=(51, 51, 51)))
    with pytest.raises(DataError, match=r"hammer: no point .* in the crop .*50.*observer\.crop"):
        nowhere.observe(picture(camera()))


def test_a_box_must_hold_something() -> None:
    with pytest.raises(SettingsError, match="must be below"):
        Box(low=(0, 1, 0), high=(1, 1, 1))


def test_observing_is_sampling_the_cloud_of_the_frame() -> None:
    frame, eye = picture(camera()), observer()
    np.testing.assert_array_equal(eye.observe(frame).points_world, eye.sample(eye.cloud(frame)).points_world)


def test_frames_of_another_scene_get_their_own_background() -> None:
    frame, eye = picture(camera()), observer()
    swapped = Frame(frame.depth, frame.camera, frame.owner, (CUP, FLOOR))
    longer = Frame(frame.depth, frame.camera, frame.owner, (FLOOR, FLOOR, CUP))
    found = [set(np.unique(owners(eye.cloud(f)))) for f in (frame, swapped, longer, frame)]
    assert found == [{-1, 1}, {-1, 0}, {-1}, {-1, 1}]
    assert eye.observe(frame).points_world.tolist() != eye.observe(swapped).points_world.tolist()
