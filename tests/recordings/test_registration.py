"""Depth moved to the color camera, against planes and spheres whose depth is known in closed form."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from thoroughness import examples

from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.registration import Registration

DEPTH = Intrinsics(fx=60.0, fy=62.0, cx=39.2, cy=29.1)
SIZE = (80, 60)
COLOR_K = np.array([[70.0, 0, 44.0], [0, 68.0, 33.5], [0, 0, 1]])
COLOR_SIZE = (90, 66)


def rays(K: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    v, u = np.mgrid[: size[1], : size[0]]
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)


def plane_depth(K: np.ndarray, size: tuple[int, int], normal: np.ndarray, offset: float) -> np.ndarray:
    """z-depth of the plane ``normal . x = offset`` in a camera."""
    return (offset / (rays(K, size) @ normal)).astype(np.float32)


def pose(seed: int) -> np.ndarray:
    """A small turn and shift between the two cameras of one device."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.05, 0.05, 3)).as_matrix()
    T[:3, 3] = rng.uniform(-0.06, 0.06, 3)
    return T


def test_the_same_camera_gives_the_same_picture() -> None:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 3, (60, 80)).astype(np.float32) * (rng.random((60, 80)) < 0.8)
    move = Registration.make(DEPTH, SIZE, np.eye(4), DEPTH.K, SIZE)
    np.testing.assert_array_equal(move(depth), depth)


@settings(max_examples=examples(40), deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.floats(0.4, 2.5), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_a_plane_is_where_it_is(seed: int, distance: float, a: float, b: float) -> None:
    T = pose(seed)
    normal = np.array([a, b, 1.0])
    seen = Registration.make(DEPTH, SIZE, T, COLOR_K, COLOR_SIZE)(plane_depth(DEPTH.K, SIZE, normal, distance))
    there = T[:3, :3] @ normal
    truth = plane_depth(COLOR_K, COLOR_SIZE, there, distance + there @ T[:3, 3])
    # A depth pixel is flat, so what it says half a pixel off its center is off by half a pixel of slope.
    step = np.abs(truth) ** 2 / distance * np.hypot(*there[:2]) / 60 * 1.3 + 1e-5
    hit = seen > 0
    assert (np.abs(seen - truth)[hit] <= step[hit]).all()
    inside = overlap(T, truth)
    assert hit[inside].mean() > 0.99, "a whole plane has hardly any holes"
    assert not hit[~overlap(T, truth, margin=-2.0)].any(), "nothing is seen where the depth camera does not look"


def overlap(T: np.ndarray, depth: np.ndarray, margin: float = 2.0) -> np.ndarray:
    """Pixels of the color camera whose points lie in the picture of the depth camera, by a margin [px]."""
    xyz = rays(COLOR_K, COLOR_SIZE) * depth[..., None]
    back = (xyz - T[:3, 3]) @ T[:3, :3]
    uv = (back @ DEPTH.K.T)[..., :2] / back[..., 2:]
    return ((uv > margin - 0.5) & (uv < np.array(SIZE) - 0.5 - margin)).all(-1) & (depth > 0)


def test_what_is_in_front_hides_what_is_behind() -> None:
    """A near square before a far wall, the color camera 10 cm to the right: the square shifts, and casts a shadow."""
    depth = np.full((60, 80), 2.0, np.float32)
    depth[20:40, 30:50] = 0.5
    T = np.eye(4)
    T[0, 3] = -0.1
    seen = Registration.make(DEPTH, SIZE, T, DEPTH.K, SIZE)(depth)
    shift_near, shift_far = round(0.1 * 60 / 0.5), round(0.1 * 60 / 2.0)
    assert (seen[20:40, 30 - shift_near : 50 - shift_near] == 0.5).all()
    assert (seen[20:40, 50 - shift_near : 50 - shift_far] == 0).all(), (
        "the wall behind was not seen by the depth camera"
    )
    np.testing.assert_array_equal(np.unique(seen), [0.0, 0.5, 2.0])


@pytest.mark.parametrize("factor", [2, 3])
def test_coarse_depth_fills_a_fine_picture(factor: int) -> None:
    """Every color pixel takes the reading of the depth pixel it lies in: no holes, no mixing."""
    fine = Intrinsics(
        fx=60.0 * factor, fy=62.0 * factor, cx=39.2 * factor + (factor - 1) / 2, cy=29.1 * factor + (factor - 1) / 2
    )
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.5, 1, (60, 80)).astype(np.float32)
    seen = Registration.make(DEPTH, SIZE, np.eye(4), fine.K, (80 * factor, 60 * factor))(depth)
    np.testing.assert_array_equal(seen, depth.repeat(factor, 0).repeat(factor, 1))


def test_a_distorted_depth_camera_is_straightened() -> None:
    """A wall at 1 m is at 1 m wherever the lens puts it; a mark on it lies where a pinhole camera sees it."""
    bent = DEPTH.model_copy(update={"distortion": (0.3, -0.1, 0.001, -0.002, 0.0)})
    mark = np.array([[0.5, -0.35, 1.0]])
    (at,), _ = cv2.projectPoints(mark, np.zeros(3), np.zeros(3), bent.K, np.array(bent.distortion))
    u, v = np.rint(at[0]).astype(int)
    depth = np.full((60, 80), 1.0, np.float32)
    depth[v - 1 : v + 2, u - 1 : u + 2] = 0.5
    seen = Registration.make(bent, SIZE, np.eye(4), DEPTH.K, SIZE)(depth)
    expected = (DEPTH.K @ mark[0])[:2]
    rows, cols = np.nonzero(seen == 0.5)
    np.testing.assert_allclose([cols.mean(), rows.mean()], expected, atol=0.75)
    assert np.linalg.norm(at[0] - expected) > 1, "the lens moves the mark by more than that"


def test_points_behind_the_color_camera_are_not_drawn() -> None:
    T = np.eye(4)
    T[2, 3] = -1.0
    depth = np.full((60, 80), 0.8, np.float32)
    assert not Registration.make(DEPTH, SIZE, T, DEPTH.K, SIZE)(depth).any()


def test_points_beside_the_color_camera_are_not_smeared_over_its_picture() -> None:
    """The cameras look 70 degrees apart: some depth pixels lie half before and half behind the color camera."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", 70, degrees=True).as_matrix()
    seen = Registration.make(DEPTH, SIZE, T, DEPTH.K, SIZE)(np.full((60, 80), 1.0, np.float32))
    assert (rays(DEPTH.K, SIZE) @ T[2, :3]).min() < 0 < (rays(DEPTH.K, SIZE) @ T[2, :3]).max()
    assert not (seen[seen > 0] < 0.3).any(), "what is nearer than that lies outside the picture"
