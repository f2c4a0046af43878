"""The pinhole camera against geometry done by hand."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from thoroughness import examples

from flowlab.geometry.camera import Camera


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.uniform(-2, 2, 3)
    return T


cameras = st.builds(
    lambda width, height, fx, fy, cx, cy, seed: Camera(
        width, height, np.array([[fx, 0, cx * width], [0, fy, cy * height], [0, 0, 1]]), pose(seed)
    ),
    st.integers(1, 700),
    st.integers(1, 700),
    st.floats(20, 900),
    st.floats(20, 900),
    st.floats(-0.5, 1.5),
    st.floats(-0.5, 1.5),
    st.integers(0, 10**6),
)


def facing_x() -> Camera:
    """At (1, 2, 3), looking along the world's +x, with the world's z up: 4x3 pixels, 100 px focal length."""
    T = np.array([[0, 0, 1, 1], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1.0]])
    return Camera(4, 3, np.array([[100, 0, 1.5], [0, 100, 1], [0, 0, 1.0]]), T)


@settings(max_examples=examples(200), deadline=None, derandomize=True)
@given(camera=cameras, seed=st.integers(0, 10**6))
def test_unproject_undoes_project(camera: Camera, seed: int) -> None:
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.5, 1.5, (2, 20, 2)) * [camera.width, camera.height]
    z = rng.uniform(0.05, 10, (2, 20))
    uv_again, z_again = camera.project(camera.unproject(uv, z))
    np.testing.assert_allclose(z_again, z, rtol=1e-9)
    np.testing.assert_allclose(uv_again, uv, atol=1e-6)


@settings(max_examples=examples(100), deadline=None, derandomize=True)
@given(camera=cameras, seed=st.integers(0, 10**6))
def test_project_is_the_homogeneous_textbook_formula(camera: Camera, seed: int) -> None:
    xyz = np.random.default_rng(seed).uniform(-3, 3, (20, 3))
    P = camera.K @ np.linalg.inv(camera.T_world_cam)[:3]
    homogeneous = np.concatenate([xyz, np.ones((20, 1))], 1) @ P.T
    uv, z = camera.project(xyz)
    np.testing.assert_allclose(z, homogeneous[:, 2], atol=1e-9)
    np.testing.assert_allclose(uv * z[:, None], homogeneous[:, :2], atol=1e-6)


def test_by_hand_a_point_to_the_left_and_above_falls_into_the_top_left_pixel() -> None:
    # 2 m ahead; 0.03 m to the left (+y) and 0.02 m up make 1.5 px left and 1 px up of the middle.
    uv, z = facing_x().project(np.array([3.0, 2.03, 3.02]))
    np.testing.assert_allclose(uv, [0, 0], atol=1e-12)
    assert z == pytest.approx(2.0)


def test_by_hand_the_center_of_the_bottom_right_pixel() -> None:
    xyz = facing_x().unproject(np.array([3.0, 2.0]), np.array(2.0))
    np.testing.assert_allclose(xyz, [3.0, 1.97, 2.98], atol=1e-12)


def test_depth_is_along_the_axis_not_along_the_ray() -> None:
    camera = Camera.from_fovy(101, 101, 90.0, np.eye(4))
    corner = camera.unproject(np.array([0.0, 0.0]), np.array(1.0))
    assert corner[2] == pytest.approx(1.0)
    assert np.linalg.norm(corner) > 1.7


def test_centerd_camera_has_its_axis_between_the_middle_pixels() -> None:
    camera = Camera.from_fovy(128, 96, 60.0, np.eye(4))
    assert (camera.K[0, 2], camera.K[1, 2]) == (63.5, 47.5)
    uv, _ = camera.project(np.array([0, 0, 1.0]))
    np.testing.assert_allclose(uv, [63.5, 47.5])


@pytest.mark.parametrize(("width", "height", "fovy"), [(128, 128, 60.0), (48, 36, 40.0), (31, 77, 100.0)])
def test_field_of_view_spans_the_image_from_edge_to_edge(width: int, height: int, fovy: float) -> None:
    camera = Camera.from_fovy(width, height, fovy, np.eye(4))
    y = np.tan(np.deg2rad(fovy / 2))
    uv, _ = camera.project(np.array([[0, -y, 1], [0, y, 1], [-y * width / height, 0, 1], [y * width / height, 0, 1]]))
    np.testing.assert_allclose(uv[:2, 1], [-0.5, height - 0.5], atol=1e-9)
    np.testing.assert_allclose(uv[2:, 0], [-0.5, width - 0.5], atol=1e-9)


def test_points_behind_the_camera_have_no_positive_depth() -> None:
    _, z = facing_x().project(np.array([[0.9, 2, 3], [1.0, 5, 3], [-8, 0, 0], [1.1, 2, 3]]))
    assert (z[:3] <= 0).all()
    assert z[3] > 0


def test_camera_survives_json_bit_for_bit() -> None:
    camera = Camera(17, 5, np.array([[np.pi, 0, 1 / 3], [0, np.e, 2 / 7], [0, 0, 1]]), pose(3))
    again = Camera.from_json(json.loads(json.dumps(camera.to_json())))
    assert (again.width, again.height) == (17, 5)
    np.testing.assert_array_equal(again.K, camera.K)
    np.testing.assert_array_equal(again.T_world_cam, camera.T_world_cam)
