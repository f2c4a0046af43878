"""The pictures that the rigid-body fit works on: shrunk, smoothed, with normals, features and flow."""

import moving_planes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigid_body_scenes import two_plates

from flowlab.geometry.camera import Camera
from flowlab.records import Clip
from flowlab.tracking.trackers.rigid_bodies import _surfaces
from flowlab.tracking.trackers.rigid_bodies.features import extract_features

K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])


def tilted(normal: np.ndarray, distance: float = 0.8) -> np.ndarray:
    """Depth of a plane that the optical axis meets at a distance."""
    v, u = np.mgrid[:120, :160]
    rays = np.stack([(u - 79.5) / 150, (v - 59.5) / 150, np.ones_like(u, float)], -1)
    return (normal @ [0, 0, distance] / (rays @ normal)).astype(np.float32)


@pytest.mark.parametrize(("width", "factor"), [(160, 1), (320, 1), (640, 2), (960, 3)])
def test_shrunk_pictures_are_the_clips_pixels_and_see_along_the_same_rays(width: int, factor: int) -> None:
    whole, _ = moving_planes.film(two_plates().plates, width=width, height=3 * width // 4)
    clip = Clip(whole.rgb[:2], whole.depth[:2], whole.camera)
    pictures = extract_features(clip, 4.0)
    assert pictures.factor == factor
    v, u = np.mgrid[: pictures.depth.shape[1], : pictures.depth.shape[2]]
    uv = np.stack([u, v], -1).astype(float)
    there = pictures.to_clip_pixels(uv)
    np.testing.assert_allclose(pictures.from_clip_pixels(there), uv)
    x, y = there.astype(int).transpose(2, 0, 1)
    np.testing.assert_array_equal(there, np.stack([x, y], -1))
    np.testing.assert_array_equal(pictures.depth, clip.depth[:, y, x])
    np.testing.assert_allclose(pictures.unproject(uv, v + 1.0), clip.camera.unproject(there, v + 1.0))
    np.testing.assert_allclose(pictures.project(pictures.unproject(uv, v + 1.0)), uv, atol=1e-9)


def test_depth_beyond_the_limit_is_missing() -> None:
    clip = two_plates().clip
    pictures = extract_features(Clip(clip.rgb[:2], clip.depth[:2], clip.camera), 1.0)
    np.testing.assert_array_equal(pictures.depth, np.where(clip.depth[:2] > 1, 0, clip.depth[:2]))
    assert (pictures.smooth[pictures.depth == 0] == 0).all()
    assert clip.depth.max() > 1


def test_smoothing_removes_noise_keeps_edges_and_leaves_holes() -> None:
    rng = np.random.default_rng(0)
    depth = np.full((60, 80), 0.8, np.float32)
    depth[:, 40:] = 0.9
    noisy = depth + rng.normal(0, 0.002, depth.shape).astype(np.float32)
    noisy[20:25, 10:15] = 0
    smooth = _surfaces.smooth_depth(noisy)
    assert (smooth[20:25, 10:15] == 0).all()
    assert (smooth > 0).sum() == (noisy > 0).sum()
    off = (smooth - depth)[noisy > 0]
    assert np.abs(off).max() < 0.01  # nothing lies between the two
    assert off.std() == pytest.approx(0.002 / 3, rel=0.15)


@settings(deadline=None)
@given(tilt=st.lists(st.floats(-0.5, 0.5), min_size=2, max_size=2), distance=st.floats(0.4, 2))
def test_normals_are_those_of_the_plane(tilt: list[float], distance: float) -> None:
    normal = np.array([*tilt, -1.0]) / np.linalg.norm([*tilt, 1])
    found = _surfaces.surface_normals(tilted(normal, distance), K) / 127
    known = (found != 0).any(-1)
    assert known[2:-2, 2:-2].mean() > 0.5
    np.testing.assert_allclose(np.abs(found[known] @ normal), 1, atol=0.02)


def test_there_are_no_normals_at_edges_holes_and_borders() -> None:
    depth = np.full((60, 80), 0.8, np.float32)
    depth[:, 40:] = 0.9
    depth[30, 20] = 0
    found = (_surfaces.surface_normals(depth, K) != 0).any(-1)
    expected = np.zeros_like(found)
    expected[2:-2, 2:-2] = True
    expected[:, 38:42] = False
    for y, x in ((30, 20), (28, 20), (32, 20), (30, 18), (30, 22)):
        expected[y, x] = False
    np.testing.assert_array_equal(found, expected)


def test_normalized_lightness_does_not_mind_the_light() -> None:
    clip = two_plates().clip
    one = Clip(clip.rgb[:1] // 2 + 20, clip.depth[:1], clip.camera)
    other = Clip(one.rgb + np.uint8(30), clip.depth[:1], clip.camera)
    a, b = (extract_features(c, 4.0).feature[0].astype(int) for c in (one, other))
    assert np.abs(a - b)[..., 1].mean() > 20  # lightness does
    assert np.abs(a - b)[..., 0].mean() < 3
    assert a[..., 0].std() > 15


def test_flow_is_how_the_picture_moved_and_none_in_the_first() -> None:
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(0, 255, (40, 50, 3)), np.ones((4, 4, 1))).astype(np.uint8)
    rgb = np.stack([texture[10:130, 20 - 3 * t : 180 - 3 * t] for t in range(3)])
    clip = Clip(rgb, np.ones((3, 120, 160), np.float32), Camera(160, 120, K, np.eye(4)))
    flow = extract_features(clip, 4.0).flow
    assert (flow[0] == 0).all()
    np.testing.assert_allclose(np.median(flow[1:, 20:-20, 20:-20], (1, 2)), [[3, 0], [3, 0]], atol=0.1)
