"""Rigid motions from points: least squares, robustly, and where points leave something open."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion, fit_rigid, nearest_rotation

vectors = st.lists(st.floats(-2, 2), min_size=3, max_size=3)


def assert_rotation(R: np.ndarray) -> None:
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1)


@settings(deadline=None)
@given(rotation=vectors, t=vectors, outliers=st.integers(0, 4), seed=st.integers(0, 99))
def test_finds_the_motion_despite_outliers(rotation: list[float], t: list[float], outliers: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(0, 0.1, (30, 3))
    R = Rotation.from_rotvec(rotation).as_matrix()
    b = a @ R.T + t
    b[:outliers] += rng.normal(0, 0.02, (outliers, 3))
    R_found, t_found = fit_rigid(a, b, np.ones(30), refinements=12)
    np.testing.assert_allclose(R_found, R, atol=0.02)
    np.testing.assert_allclose(t_found, t, atol=0.002)
    assert_rotation(R_found)


def test_agrees_with_scipy() -> None:
    rng = np.random.default_rng(0)
    a, b, w = rng.normal(size=(20, 3)), rng.normal(size=(20, 3)), rng.uniform(0.1, 1, 20)
    R, t = fit_rigid(a, b, w, refinements=0)
    mean_a, mean_b = np.average(a, axis=0, weights=w), np.average(b, axis=0, weights=w)
    expected = Rotation.align_vectors(b - mean_b, a - mean_a, weights=w)[0].as_matrix()
    np.testing.assert_allclose(R, expected, atol=1e-8)
    np.testing.assert_allclose(t, mean_b - expected @ mean_a, atol=1e-8)


@settings(deadline=None)
@given(rotation=vectors, t=vectors, rank=st.sampled_from([0, 1, 2]), seed=st.integers(0, 99))
def test_points_in_a_plane_on_a_line_or_all_the_same_get_a_rotation_that_fits(
    rotation: list[float], t: list[float], rank: int, seed: int
) -> None:
    """A mirror image would fit points in a plane as well."""
    rng = np.random.default_rng(seed)
    a = rng.normal(0, 0.1, (12, rank)) @ rng.normal(size=(rank, 3)) + rng.normal(size=3)
    b = a @ Rotation.from_rotvec(rotation).as_matrix().T + t
    R, s = fit_rigid(a, b, np.ones(12), refinements=2)
    assert_rotation(R)
    np.testing.assert_allclose(a @ R.T + s, b, atol=1e-6)


def test_points_that_were_mirrored_get_a_rotation_all_the_same() -> None:
    a = np.random.default_rng(0).normal(size=(20, 3))
    R, _ = fit_rigid(a, a * [-1, 1, 1], np.ones(20), refinements=0)
    assert_rotation(R)


def test_what_has_no_weight_is_no_motion() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 20, 3))
    R, t = fit_rigid(a, b, np.zeros(20), refinements=3)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(t, 0, atol=1e-9)
    half = (np.arange(20) < 10).astype(float)
    for x, y in zip(fit_rigid(a, b, half, 0), fit_rigid(a[:10], b[:10], np.ones(10), 0), strict=True):
        np.testing.assert_allclose(x, y)


def test_many_at_once_are_each_alone() -> None:
    rng = np.random.default_rng(0)
    a, b, w = rng.normal(size=(5, 1, 8, 3)), rng.normal(size=(5, 4, 8, 3)), rng.uniform(size=(5, 4, 8))
    R, t = fit_rigid(a, b, w, refinements=2)
    assert R.shape == (5, 4, 3, 3)
    for i in range(5):
        for j in range(4):
            Rij, tij = fit_rigid(a[i, 0], b[i, j], w[i, j], refinements=2)
            np.testing.assert_allclose(R[i, j], Rij, atol=1e-12)
            np.testing.assert_allclose(t[i, j], tij, atol=1e-12)


def test_a_motion_moves_points() -> None:
    R = Rotation.from_rotvec([[0, 0, 0], [0, 0, np.pi / 2]]).as_matrix()
    motion = RigidMotion(R, np.array([[0, 0, 0], [1.0, 0, 0]]))
    np.testing.assert_allclose(motion.apply(np.array([[1.0, 0, 2.0]]))[:, 0], [[1, 0, 2], [1, 1, 2]], atol=1e-12)
    points = np.random.default_rng(0).normal(size=(4, 3))
    np.testing.assert_array_equal(RigidMotion.identity(3).apply(points), np.repeat(points[None], 3, 0))


@settings(deadline=None)
@given(rotation=vectors, noise=st.floats(0, 0.02))
def test_the_nearest_rotation(rotation: list[float], noise: float) -> None:
    R = Rotation.from_rotvec(rotation).as_matrix()
    bent = R + np.random.default_rng(0).normal(0, noise, (3, 3))
    assert_rotation(nearest_rotation(bent))
    np.testing.assert_allclose(nearest_rotation(R), R, atol=1e-12)
    assert np.abs(nearest_rotation(bent) - bent).max() <= np.abs(R - bent).max() + 0.02
    with pytest.raises(AssertionError):
        assert_rotation(R * [-1, 1, 1])
