"""Rigid transforms against linear algebra and SciPy."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from thoroughness import examples

from flowlab.geometry.transforms import apply, inverse, pose_9d, rigid, rotation_from_6d

seeds = st.integers(0, 10**6)
thoroughly = settings(max_examples=examples(100), deadline=None, derandomize=True)


def transforms(seed: int, n: int = 6) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rigid(Rotation.random(n, random_state=seed).as_matrix(), rng.uniform(-5, 5, (n, 3)))


def points(seed: int, n: int = 6) -> np.ndarray:
    return np.random.default_rng(seed + 1).uniform(-5, 5, (n, 3))


@thoroughly
@given(seeds)
def test_inverse_is_the_matrix_inverse(seed: int) -> None:
    T = transforms(seed)
    np.testing.assert_allclose(inverse(T), np.linalg.inv(T), atol=1e-12)


@thoroughly
@given(seeds)
def test_apply_is_multiplication_of_homogeneous_points(seed: int) -> None:
    T, xyz = transforms(seed), points(seed)
    homogeneous = np.concatenate([xyz, np.ones((len(xyz), 1))], 1)
    expected = np.stack([matrix @ point for matrix, point in zip(T, homogeneous, strict=True)])
    np.testing.assert_allclose(apply(T, xyz), expected[:, :3], atol=1e-12)


@thoroughly
@given(seeds, seeds)
def test_applying_a_product_is_applying_one_after_the_other(a: int, b: int) -> None:
    A, B, xyz = transforms(a), transforms(b), points(a)
    np.testing.assert_allclose(apply(A @ B, xyz), apply(A, apply(B, xyz)), atol=1e-12)


@thoroughly
@given(seeds)
def test_inverse_brings_points_back_and_keeps_distances(seed: int) -> None:
    T, xyz = transforms(seed, 1)[0], points(seed)
    np.testing.assert_allclose(apply(inverse(T), apply(T, xyz)), xyz, atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(apply(T, xyz), axis=0), axis=1), np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    )


def test_one_transform_applies_to_many_points_and_a_series_to_one_point() -> None:
    T, xyz = transforms(0), points(0)
    assert apply(T[0], xyz).shape == (6, 3)
    np.testing.assert_allclose(apply(T, xyz[0])[2], T[2, :3, :3] @ xyz[0] + T[2, :3, 3])


def test_rigid_by_hand_turns_and_then_shifts() -> None:
    quarter_turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    T = rigid(quarter_turn, np.array([10.0, 20, 30]))
    np.testing.assert_allclose(apply(T, np.array([1.0, 0, 0])), [10, 21, 30], atol=1e-12)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


@thoroughly
@given(seeds)
def test_a_rotation_survives_its_six_numbers(seed: int) -> None:
    R = Rotation.random(8, random_state=seed)
    T = rigid(R.as_matrix(), points(seed, 8))
    pose = pose_9d(T)
    np.testing.assert_array_equal(pose[:, :3], T[:, :3, 3])
    again = Rotation.from_matrix(rotation_from_6d(pose[:, 3:]))
    assert (again * R.inv()).magnitude().max() < 1e-7
    # Zhou et al.: the six numbers are the images of the x axis and the y axis.
    np.testing.assert_allclose(pose[:, 3:6], R.apply([1, 0, 0]), atol=1e-12)
    np.testing.assert_allclose(pose[:, 6:9], R.apply([0, 1, 0]), atol=1e-12)


@thoroughly
@given(seeds)
def test_any_six_numbers_become_a_rotation_that_keeps_the_first_direction(seed: int) -> None:
    r = np.random.default_rng(seed).normal(size=(8, 6))
    R = rotation_from_6d(r)
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-9)
    np.testing.assert_allclose(np.cross(R[:, :, 0], r[:, :3]), 0, atol=1e-9)
    assert ((R[:, :, 1] * r[:, 3:]).sum(1) > 0).all()
