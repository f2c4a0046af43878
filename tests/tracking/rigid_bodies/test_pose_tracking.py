"""Poses of bodies against scenes whose motion is known: refined in one frame, and tracked through all."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigid_body_scenes import FRAMES, Scene, still_camera_moves, two_plates
from scipy.spatial.transform import Rotation

from flowlab.tracking.trackers.rigid_bodies import _costs, _gauss_newton
from flowlab.tracking.trackers.rigid_bodies.motion import RigidMotion
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import RigidBody, track_poses


def align(scene: Scene, k: int, t: int, R: np.ndarray, s: np.ndarray, iterations: int = 10) -> tuple[np.ndarray, ...]:
    """The pose of a plate in frame t, from one nearby."""
    uv, p = scene.some_pixels(k, 200, border=3), scene.pictures
    lightness = _costs.features_at(p.feature[0], uv.astype(np.float32))[:, 1].astype(float)
    found = _gauss_newton.align(
        scene.points(uv)[None], lightness[None], R[None], s[None], p.lightness(t), p.smooth[t], p.normal[t], p.K,
        iterations,
    )  # fmt: skip
    return found[0][0], found[1][0]


def off(scene: Scene, k: int, t: int, R: np.ndarray, s: np.ndarray) -> float:
    """Mean distance [m] of a plate's points from where they truly are."""
    points, truth = scene.points(scene.some_pixels(k, 200)), scene.motion(k)
    return float(np.linalg.norm(points @ (R - truth.R[t]).T + (s - truth.t[t]), axis=1).mean())


@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    turn=st.lists(st.floats(-0.02, 0.02), min_size=3, max_size=3),
    shift=st.lists(st.floats(-0.004, 0.004), min_size=3, max_size=3),
    k=st.sampled_from([1, 2]),
    t=st.integers(1, FRAMES - 1),
)
def test_alignment_mends_a_wrong_pose(turn: list[float], shift: list[float], k: int, t: int) -> None:
    scene = two_plates()
    truth, center = scene.motion(k), scene.plates[k].t[t]
    R = Rotation.from_rotvec(turn).as_matrix()
    wrong = R @ truth.R[t], R @ (truth.t[t] - center) + center + shift
    assert off(scene, k, t, *align(scene, k, t, *wrong)) < max(0.0015, 0.3 * off(scene, k, t, *wrong))


def test_a_right_pose_stays() -> None:
    scene, t = two_plates(), 8
    truth = scene.motion(1)
    R, s = align(scene, 1, t, truth.R[t], truth.t[t])
    assert off(scene, 1, t, R, s) < 0.001
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)


def test_a_body_that_is_nowhere_in_the_picture_is_left_alone() -> None:
    scene = two_plates()
    away = np.array([5.0, 0, 0])
    R, s = align(scene, 1, 3, np.eye(3), away)
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(s, away)


def body(scene: Scene, k: int, motion: RigidMotion | None = None) -> RigidBody:
    frames = len(scene.pictures)
    guess = motion or RigidMotion.identity(frames)
    return RigidBody(scene.pixels(k), guess, np.full(frames, motion is not None))


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_bodies_are_tracked_without_a_guess(noise: float) -> None:
    scene = two_plates(noise)
    found = track_poses(scene.pictures, [body(scene, 2), body(scene, 1)], np.random.default_rng(0))
    for k, one in zip((2, 1), found, strict=True):
        np.testing.assert_array_equal(one.pixels, scene.pixels(k))
        np.testing.assert_array_equal(one.motion.R[0], np.eye(3))
        worst = max(off(scene, k, t, one.motion.R[t], one.motion.t[t]) for t in range(FRAMES))
        assert worst < 0.003 + noise, k


def test_a_good_guess_helps_over_a_leap() -> None:
    """For some frames the camera saw nothing: afterwards only the guess knows where the body is."""
    scene = two_plates()
    dark = scene.pictures.depth.copy(), scene.pictures.smooth.copy(), scene.pictures.flow.copy()
    for values in dark:
        values[5:13] = 0
    pictures = type(scene.pictures)(**{
        **{f: getattr(scene.pictures, f) for f in ("K", "factor", "offset", "normal", "feature")},
        "depth": dark[0], "smooth": dark[1], "flow": dark[2],
    })  # fmt: skip
    (found,) = track_poses(pictures, [body(scene, 1, scene.motion(1))], np.random.default_rng(0))
    assert off(scene, 1, FRAMES - 1, found.motion.R[-1], found.motion.t[-1]) < 0.003


def test_a_moving_camera_moves_the_wall() -> None:
    scene = still_camera_moves()
    (found,) = track_poses(scene.pictures, [body(scene, 0)], np.random.default_rng(0))
    assert off(scene, 0, FRAMES - 1, found.motion.R[-1], found.motion.t[-1]) < 0.006


def test_a_lost_body_is_held_by_one_that_is_not() -> None:
    """A handle that shows no depth from the third frame on goes where the plate goes that it lies on."""
    scene = two_plates()
    inner = scene.some_pixels(1, 40, border=12)
    lid = RigidBody(inner, RigidMotion.identity(FRAMES), np.zeros(FRAMES, bool))
    found = track_poses(scene.pictures, [body(scene, 1), lid], np.random.default_rng(0))
    points = scene.points(inner)
    error = np.linalg.norm(found[1].motion.apply(points) - scene.motion(1).apply(points), axis=-1)
    assert error.max() < 0.006


def test_no_bodies_are_no_work() -> None:
    assert track_poses(two_plates().pictures, [], np.random.default_rng(0)) == []
